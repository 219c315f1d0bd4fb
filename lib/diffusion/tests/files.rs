//! Model folders: sharded and half-precision weights, wrong and hostile
//! files, each refused with the tensor or key that is wrong.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::Error;
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::{Model, load_unet};
use dipir_diffusion::pass::Pass;
use dipir_diffusion::text_encoder::TextEncoder;
use dipir_diffusion::tokenizer::Tokenizer;
use dipir_diffusion::vae::Vae;
use dipir_diffusion::weights::{Weights, write_safetensors};

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn family() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/references/sd15")
}

fn tensors(path: &Path) -> Result<BTreeMap<String, Tensor>, Error> {
    let weights = Weights::open_file(path)?;
    let names: Vec<String> = weights.names().map(str::to_owned).collect();
    let mut tensors = BTreeMap::new();
    for name in names {
        if let Some(tensor) = weights.tensor(&name, DType::F32, &Device::Cpu)? {
            tensors.insert(name, tensor);
        }
    }
    Ok(tensors)
}

/// A copy of the reference's whole folder.
fn model_folder() -> Result<tempfile::TempDir, Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    std::fs::write(folder.path().join("model_index.json"), "{}")?;
    for part in ["unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
        std::fs::create_dir(folder.path().join(part))?;
        for entry in std::fs::read_dir(family().join(part))? {
            let entry = entry?;
            std::fs::copy(
                entry.path(),
                folder.path().join(part).join(entry.file_name()),
            )?;
        }
    }
    Ok(folder)
}

/// A UNet folder with the reference's configuration and these tensors.
fn unet_folder(
    tensors: &BTreeMap<String, Tensor>,
) -> Result<tempfile::TempDir, Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    std::fs::copy(
        family().join("unet/config.json"),
        folder.path().join("config.json"),
    )?;
    write_safetensors(
        &folder.path().join("diffusion_pytorch_model.safetensors"),
        tensors,
        &BTreeMap::new(),
    )?;
    Ok(folder)
}

fn unet_tensors() -> Result<BTreeMap<String, Tensor>, Error> {
    tensors(&family().join("unet/diffusion_pytorch_model.safetensors"))
}

#[test]
fn missing_extra_and_mis_shaped_tensors_are_all_named() -> Outcome {
    let mut tensors = unet_tensors()?;
    tensors.remove("mid_block.resnets.1.conv2.weight");
    tensors.insert(
        "conv_in.weight".into(),
        Tensor::zeros((16, 4, 5, 5), DType::F32, &Device::Cpu)?,
    );
    tensors.insert(
        "up_blocks.7.surprise".into(),
        Tensor::zeros(3, DType::F32, &Device::Cpu)?,
    );
    let folder = unet_folder(&tensors)?;
    let message = load_unet(folder.path(), DType::F32, &Device::Cpu)
        .expect_err("refused")
        .to_string();
    for part in [
        "\"mid_block.resnets.1.conv2.weight\" of shape [32, 32, 3, 3] is missing",
        "\"conv_in.weight\" has shape [16, 4, 5, 5], the configuration asks for [16, 4, 3, 3]",
        "\"up_blocks.7.surprise\" belongs to no layer",
    ] {
        assert!(message.contains(part), "{message}");
    }
    Ok(())
}

#[test]
fn shards_give_the_same_prediction_as_one_file() -> Outcome {
    let tensors = unet_tensors()?;
    let folder = unet_folder(&tensors)?;
    let whole = load_unet(folder.path(), DType::F32, &Device::Cpu)?;
    std::fs::remove_file(folder.path().join("diffusion_pytorch_model.safetensors"))?;
    let mut map = serde_json::Map::new();
    for shard in 0..3 {
        let name = format!("diffusion_pytorch_model-{shard}.safetensors");
        let part: BTreeMap<String, Tensor> = tensors
            .iter()
            .enumerate()
            .filter(|(i, _)| i % 3 == shard)
            .map(|(_, (k, v))| (k.clone(), v.clone()))
            .collect();
        map.extend(part.keys().map(|k| (k.clone(), serde_json::json!(name))));
        write_safetensors(&folder.path().join(name), &part, &BTreeMap::new())?;
    }
    let index = folder
        .path()
        .join("diffusion_pytorch_model.safetensors.index.json");
    std::fs::write(&index, serde_json::json!({"weight_map": map}).to_string())?;
    let sharded = load_unet(folder.path(), DType::F32, &Device::Cpu)?;
    let x = Tensor::ones((1, 4, 8, 8), DType::F32, &Device::Cpu)?;
    let context = Tensor::ones((1, 3, 24), DType::F32, &Device::Cpu)?;
    let predict =
        |unet: &dipir_diffusion::unet::UNet| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
            Ok(unet
                .forward(&x, &[10.0], &context, &Pass::default())?
                .flatten_all()?
                .to_vec1()?)
        };
    assert_eq!(predict(&whole)?, predict(&sharded)?);
    // An index that points outside its folder, and one that lies.
    std::fs::write(&index, r#"{"weight_map": {"a": "../secret.safetensors"}}"#)?;
    let message = load_unet(folder.path(), DType::F32, &Device::Cpu)
        .expect_err("refused")
        .to_string();
    assert!(message.contains("not a plain file name"), "{message}");
    std::fs::write(
        &index,
        r#"{"weight_map": {"nowhere": "diffusion_pytorch_model-0.safetensors"}}"#,
    )?;
    let message = load_unet(folder.path(), DType::F32, &Device::Cpu)
        .expect_err("refused")
        .to_string();
    assert!(
        message.contains("places tensor \"nowhere\" here"),
        "{message}"
    );
    Ok(())
}

#[test]
fn half_precision_files_are_read_as_f32() -> Outcome {
    let tensors = unet_tensors()?;
    let x = Tensor::ones((1, 4, 8, 8), DType::F32, &Device::Cpu)?;
    let context = Tensor::ones((1, 3, 24), DType::F32, &Device::Cpu)?;
    let predict = |dtype: DType| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let stored = tensors
            .iter()
            .map(|(k, v)| Ok((k.clone(), v.to_dtype(dtype)?)))
            .collect::<Result<_, Error>>()?;
        let folder = unet_folder(&stored)?;
        let unet = load_unet(folder.path(), DType::F32, &Device::Cpu)?;
        let y = unet.forward(&x, &[10.0], &context, &Pass::default())?;
        Ok(y.flatten_all()?.to_vec1()?)
    };
    let exact = predict(DType::F32)?;
    // The reference's weights are numbers of f16 ...
    assert_eq!(predict(DType::F16)?, exact);
    // ... and bf16 rounds each by up to 2^-9, of which a few dozen layers
    // make some hundredths.
    let size = exact.iter().fold(0f32, |m, v| m.max(v.abs()));
    for (a, b) in predict(DType::BF16)?.iter().zip(&exact) {
        assert!((a - b).abs() < 0.05 * size, "{a} instead of {b}");
    }
    Ok(())
}

/// A safetensors file of this header and data.
fn file(header: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

#[test]
fn hostile_headers_are_refused_without_a_panic() -> Outcome {
    let one = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;
    let good = file(one, &[0; 8]);
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("x.safetensors");
    std::fs::write(&path, &good)?;
    assert!(Weights::open_file(&path).is_ok());
    let huge = usize::MAX;
    let mut cases: Vec<(&str, Vec<u8>)> = vec![
        ("empty", vec![]),
        ("shorter than its length field", vec![1, 2, 3]),
        (
            "header length beyond the file",
            [&u64::MAX.to_le_bytes()[..], b"{}"].concat(),
        ),
        (
            "header length that overflows with 8",
            [&(u64::MAX - 7).to_le_bytes()[..], b"{}"].concat(),
        ),
        ("header is no JSON", file("not json", &[])),
        ("header is a list", file("[1]", &[])),
        (
            "header is not UTF-8",
            [&2u64.to_le_bytes()[..], &[0xff, 0xfe]].concat(),
        ),
        ("data cut off", good[..good.len() - 3].to_vec()),
        ("data left over", [&good[..], &[1, 2, 3]].concat()),
        (
            "end before start",
            file(
                r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}}"#,
                &[0; 8],
            ),
        ),
        (
            "offsets beyond the file",
            file(
                r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[80,88]}}"#,
                &[0; 8],
            ),
        ),
        (
            "shape and length disagree",
            file(
                r#"{"a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]}}"#,
                &[0; 8],
            ),
        ),
        (
            "overlapping tensors",
            file(
                r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}}"#,
                &[0; 12],
            ),
        ),
        (
            "unknown type",
            file(
                r#"{"a":{"dtype":"F37","shape":[2],"data_offsets":[0,8]}}"#,
                &[0; 8],
            ),
        ),
        (
            "negative shape",
            file(
                r#"{"a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}}"#,
                &[0; 8],
            ),
        ),
        ("deep nesting", file(&("[".repeat(100_000)), &[])),
    ];
    let overflow =
        format!(r#"{{"a":{{"dtype":"F32","shape":[{huge},{huge}],"data_offsets":[0,8]}}}}"#);
    cases.push(("shape product overflows", file(&overflow, &[0; 8])));
    for (what, bytes) in cases {
        std::fs::write(&path, bytes)?;
        match Weights::open_file(&path) {
            Err(Error::Safetensors { message, .. }) => assert!(!message.is_empty(), "{what}"),
            Err(Error::Io { .. }) if what == "empty" => {}
            other => panic!("{what}: {other:?}"),
        }
    }
    Ok(())
}

#[test]
fn text_encoder_loads_with_and_without_the_prefix() -> Outcome {
    let with = family().join("text_encoder");
    let folder = tempfile::tempdir()?;
    std::fs::copy(with.join("config.json"), folder.path().join("config.json"))?;
    let without = tensors(&with.join("model.safetensors"))?
        .into_iter()
        .map(|(k, v)| (k.strip_prefix("text_model.").unwrap_or(&k).to_owned(), v))
        .collect();
    write_safetensors(
        &folder.path().join("model.safetensors"),
        &without,
        &BTreeMap::new(),
    )?;
    let tokens = vec![vec![1, 2, 3, 4]];
    let run = |folder: &Path| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let encoder = TextEncoder::load(folder, DType::F32, &Device::Cpu)?;
        Ok(encoder.forward(&tokens, None)?.flatten_all()?.to_vec1()?)
    };
    assert_eq!(run(&with)?, run(folder.path())?);
    Ok(())
}

#[test]
fn unsupported_configurations_are_refused_by_key() -> Outcome {
    let tensors = unet_tensors()?;
    let folder = unet_folder(&tensors)?;
    let path = folder.path().join("config.json");
    let text = std::fs::read_to_string(&path)?;
    for (key, value, part) in [
        (
            "class_embed_type",
            serde_json::json!("timestep"),
            "class_embed_type = \"timestep\" is not supported",
        ),
        ("act_fn", serde_json::json!("mish"), "accepted: \"silu\""),
        (
            "down_block_types",
            serde_json::json!(["ResnetDownsampleBlock2D", "DownBlock2D", "DownBlock2D"]),
            "ResnetDownsampleBlock2D",
        ),
        (
            "attention_head_dim",
            serde_json::json!([4, 4]),
            "need 1 or 3 entries",
        ),
        (
            "attention_head_dim",
            serde_json::json!(5),
            "no multiple of 5 heads",
        ),
    ] {
        let mut config: serde_json::Value = serde_json::from_str(&text)?;
        config[key] = value;
        std::fs::write(&path, config.to_string())?;
        let message = load_unet(folder.path(), DType::F32, &Device::Cpu)
            .expect_err(key)
            .to_string();
        assert!(
            message.contains(part) && message.contains("config.json"),
            "{message}"
        );
    }
    let mut config: serde_json::Value = serde_json::from_str(&text)?;
    config["a_key_of_tomorrow"] = serde_json::json!(1);
    std::fs::write(&path, config.to_string())?;
    assert!(
        load_unet(folder.path(), DType::F32, &Device::Cpu).is_ok(),
        "unknown keys are tolerated"
    );
    Ok(())
}

/// Were one of these read as it stands, the test would not end, or end for want of memory.
#[test]
fn sizes_that_the_weights_do_not_hold_are_refused_by_key() -> Outcome {
    use serde_json::json;
    let folder = model_folder()?;
    let load = || Model::load(folder.path(), DType::F32, &Device::Cpu);
    load()?;
    let many = json!(1_000_000_000u64);
    let levels = || json!(vec![16; 64]);
    for (file, key, value) in [
        ("unet/config.json", "layers_per_block", many.clone()),
        ("unet/config.json", "layers_per_block", json!(0)),
        ("unet/config.json", "layers_per_block", json!(-1)),
        ("unet/config.json", "layers_per_block", json!(1e9)),
        (
            "unet/config.json",
            "transformer_layers_per_block",
            many.clone(),
        ),
        ("unet/config.json", "transformer_layers_per_block", json!(0)),
        ("unet/config.json", "num_attention_heads", many.clone()),
        ("unet/config.json", "attention_head_dim", json!(0)),
        ("unet/config.json", "sample_size", many.clone()),
        ("unet/config.json", "sample_size", json!(0)),
        ("unet/config.json", "in_channels", json!(u64::MAX)),
        ("unet/config.json", "cross_attention_dim", json!(u64::MAX)),
        (
            "unet/config.json",
            "block_out_channels",
            json!([1u64 << 62, 32, 32]),
        ),
        ("unet/config.json", "block_out_channels", levels()),
        ("unet/config.json", "downsample_padding", many.clone()),
        ("unet/config.json", "norm_eps", json!(0)),
        ("vae/config.json", "layers_per_block", many.clone()),
        ("vae/config.json", "layers_per_block", json!(-1)),
        ("vae/config.json", "latent_channels", json!(u64::MAX)),
        ("vae/config.json", "block_out_channels", levels()),
        (
            "text_encoder/config.json",
            "num_hidden_layers",
            many.clone(),
        ),
        ("text_encoder/config.json", "num_hidden_layers", json!(0)),
        ("text_encoder/config.json", "num_hidden_layers", json!(-1)),
        (
            "text_encoder/config.json",
            "num_attention_heads",
            many.clone(),
        ),
        ("text_encoder/config.json", "num_attention_heads", json!(0)),
        (
            "text_encoder/config.json",
            "intermediate_size",
            many.clone(),
        ),
        ("text_encoder/config.json", "vocab_size", json!(u64::MAX)),
        (
            "scheduler/scheduler_config.json",
            "num_train_timesteps",
            json!(1_000_000_000_000u64),
        ),
        (
            "scheduler/scheduler_config.json",
            "num_train_timesteps",
            json!(0),
        ),
        (
            "scheduler/scheduler_config.json",
            "num_train_timesteps",
            json!(-5),
        ),
        (
            "scheduler/scheduler_config.json",
            "steps_offset",
            json!(u64::MAX),
        ),
    ] {
        let path = folder.path().join(file);
        let text = std::fs::read_to_string(&path)?;
        let mut config: serde_json::Value = serde_json::from_str(&text)?;
        config[key] = value.clone();
        std::fs::write(&path, config.to_string())?;
        let message = match load() {
            Ok(_) => return Err(format!("{file}: {key} = {value} is taken").into()),
            Err(e) => e.to_string(),
        };
        // The heads' error is about the channels that they have to divide.
        let names_it = message.contains(key) || message.contains("heads");
        assert!(names_it && message.contains(file), "{key}: {message}");
        std::fs::write(&path, text)?;
    }
    Ok(())
}

#[test]
fn a_rearrangement_of_pixels_has_a_largest_factor() -> Outcome {
    let folder = tempfile::tempdir()?;
    for factor in ["4294967296", "0", "-1"] {
        let text = format!(r#"{{"_class_name": "PixelUnshuffle", "factor": {factor}}}"#);
        std::fs::write(folder.path().join("config.json"), text)?;
        let message = Vae::load(folder.path(), DType::F32, &Device::Cpu)
            .expect_err(factor)
            .to_string();
        assert!(message.contains("factor"), "{message}");
    }
    Ok(())
}

#[test]
fn a_model_whose_parts_do_not_fit_is_refused() -> Outcome {
    let folder = tempfile::tempdir()?;
    for part in ["unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
        let from = if part == "text_encoder" {
            family().with_file_name("sd21")
        } else {
            family()
        };
        std::fs::create_dir(folder.path().join(part))?;
        for entry in std::fs::read_dir(from.join(part))? {
            let entry = entry?;
            std::fs::copy(
                entry.path(),
                folder.path().join(part).join(entry.file_name()),
            )?;
        }
    }
    let load = || Model::load(folder.path(), DType::F32, &Device::Cpu);
    assert!(
        matches!(load(), Err(Error::Io { .. })),
        "no model_index.json"
    );
    std::fs::write(folder.path().join("model_index.json"), "{}")?;
    let message = load().expect_err("widths 24 and 32").to_string();
    assert!(
        message.contains("cross_attention_dim 24") && message.contains("hidden_size 32"),
        "{message}"
    );
    Ok(())
}

#[test]
fn tokenizer_takes_nothing_a_thousand_words_and_a_placeholder() -> Outcome {
    let mut tokenizer = Tokenizer::load(&family().join("tokenizer"))?;
    let empty = tokenizer.encode("")?;
    assert_eq!(empty.len(), 77);
    assert!(
        empty[1..].iter().all(|&t| t == empty[1]),
        "start marker, then end markers"
    );
    let long = tokenizer.encode(&"word ".repeat(1000))?;
    assert_eq!(long.len(), 77);
    assert_eq!(long[76], empty[1], "cut, but ended");
    tokenizer.add_placeholder("SKS", 5000);
    assert_eq!(
        tokenizer
            .words("a sks car")?
            .iter()
            .filter(|&&t| t == 5000)
            .count(),
        1
    );
    assert_eq!(tokenizer.words("sks")?, [5000]);
    assert!(!tokenizer.words("sksx")?.contains(&5000));
    Ok(())
}

#[test]
fn tokenizer_json_alone_gives_the_same_tokens() -> Outcome {
    let source = family().join("tokenizer");
    let vocab: serde_json::Value =
        serde_json::from_slice(&std::fs::read(source.join("vocab.json"))?)?;
    let merges = std::fs::read_to_string(source.join("merges.txt"))?;
    let merges: Vec<&str> = merges.lines().skip(1).filter(|l| !l.is_empty()).collect();
    let folder = tempfile::tempdir()?;
    let json = serde_json::json!({"model": {"type": "BPE", "vocab": vocab, "merges": merges}});
    std::fs::write(folder.path().join("tokenizer.json"), json.to_string())?;
    let (a, b) = (Tokenizer::load(&source)?, Tokenizer::load(folder.path())?);
    let prompt = "a photo of the strangest 12 cars, isn't it? ☺";
    assert_eq!(a.encode(prompt)?, b.encode(prompt)?);
    Ok(())
}

#[test]
fn foreign_lora_keys_are_named() -> Outcome {
    let unet = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let matrix = |a, b| Tensor::zeros((a, b), DType::F32, &Device::Cpu);
    let module = "unet.down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let cases = [
        (
            vec![("lora_te_text_model_x.lora_down.weight", matrix(4, 8)?)],
            "adapts the text encoder",
        ),
        (
            vec![("unet.nowhere.lora_A.weight", matrix(4, 8)?)],
            "\"unet.nowhere.lora_A.weight\" belongs to no layer",
        ),
        (
            vec![("unet.bias", matrix(4, 8)?)],
            "neither a down nor an up matrix",
        ),
    ];
    for (tensors, part) in cases {
        let tensors = tensors
            .into_iter()
            .map(|(k, v)| (k.to_owned(), v))
            .collect();
        write_safetensors(&path, &tensors, &BTreeMap::new())?;
        let message = Lora::load(&path, &unet.adapter_targets(), DType::F32, &Device::Cpu)
            .expect_err(part)
            .to_string();
        assert!(message.contains(part), "{message}");
    }
    let (down, up) = (
        format!("{module}.lora_A.weight"),
        format!("{module}.lora_B.weight"),
    );
    for (tensors, part) in [
        (
            vec![(down.clone(), matrix(4, 16)?)],
            "only one of its two matrices",
        ),
        (
            vec![(down.clone(), matrix(4, 9)?), (up.clone(), matrix(16, 4)?)],
            "do not fit the layer of 16 inputs",
        ),
    ] {
        write_safetensors(&path, &tensors.into_iter().collect(), &BTreeMap::new())?;
        let message = Lora::load(&path, &unet.adapter_targets(), DType::F32, &Device::Cpu)
            .expect_err(part)
            .to_string();
        assert!(message.contains(part), "{message}");
    }
    Ok(())
}

#[test]
fn lora_files_of_older_tools_mean_the_same() -> Outcome {
    let unet = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?;
    let targets = unet.adapter_targets();
    let load = |path: &Path| Lora::load(path, &targets, DType::F32, &Device::Cpu);
    let known = family().join("lora_peft.safetensors");
    let wanted = load(&known)?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let metadata = Weights::open_file(&known)?.metadata().clone();
    type Rename = fn(&str) -> String;
    let styles: [(&str, Rename); 3] = [
        // peft on its own.
        ("peft", |key| key.replace("unet.", "base_model.model.")),
        // diffusers before it used peft: the projections' names differ, too.
        ("processor", |key| {
            key.replace(".to_out.0.", ".processor.to_out_lora.")
                .replace(".to_q.", ".processor.to_q_lora.")
                .replace(".to_k.", ".processor.to_k_lora.")
                .replace(".to_v.", ".processor.to_v_lora.")
                .replace("lora_A", "down")
                .replace("lora_B", "up")
        }),
        ("lora.down", |key| {
            key.replace("lora_A", "lora.down")
                .replace("lora_B", "lora.up")
        }),
    ];
    for (style, rename) in styles {
        let renamed = tensors(&known)?
            .into_iter()
            .map(|(key, tensor)| (rename(&key), tensor))
            .collect();
        write_safetensors(&path, &renamed, &metadata)?;
        let found = load(&path).map_err(|e| format!("{style}: {e}"))?;
        assert_eq!(found.adapters().len(), wanted.adapters().len(), "{style}");
        for (name, adapter) in wanted.adapters() {
            let other = found.adapter(name).ok_or(format!("{style}: {name}"))?;
            assert_eq!(other.alpha(), adapter.alpha(), "{style}: {name}");
            assert_eq!(
                other.down().to_vec2::<f32>()?,
                adapter.down().to_vec2::<f32>()?
            );
            assert_eq!(other.up().to_vec2::<f32>()?, adapter.up().to_vec2::<f32>()?);
        }
    }
    Ok(())
}

#[test]
fn pixel_unshuffle_is_exact_both_ways() -> Outcome {
    let folder = tempfile::tempdir()?;
    std::fs::write(
        folder.path().join("config.json"),
        r#"{"_class_name": "PixelUnshuffle", "factor": 2, "scaling_factor": 0.5}"#,
    )?;
    let vae = Vae::load(folder.path(), DType::F32, &Device::Cpu)?;
    assert_eq!((vae.downscale(), vae.latent_channels()), (2, 12));
    let image = Tensor::arange(0f32, 96.0, &Device::Cpu)?.reshape((2, 3, 4, 4))?;
    let latents = vae.encode(&image, None)?;
    assert_eq!(latents.dims(), [2, 12, 2, 2]);
    // Channel 0 is the top left pixel of each block, channel 1 the one right of it.
    assert_eq!(
        latents.get(0)?.get(1)?.to_vec2::<f32>()?,
        [[0.5, 1.5], [4.5, 5.5]]
    );
    assert_eq!(
        vae.decode(&latents)?.flatten_all()?.to_vec1::<f32>()?,
        image.flatten_all()?.to_vec1::<f32>()?
    );
    let message = vae
        .encode(&image.narrow(3, 0, 3)?, None)
        .expect_err("odd width")
        .to_string();
    assert!(message.contains("3x4"), "{message}");
    Ok(())
}

#[test]
fn extreme_latents_and_timesteps_stay_finite() -> Outcome {
    let model = Model::load(&family(), DType::F32, &Device::Cpu)?;
    let context = model.encode_prompts(&["", &"word ".repeat(1000)], None)?;
    let noise = dipir_diffusion::noise::NoiseStream::new(1, 1).normal_tensor(
        &[2, 4, 8, 8],
        DType::F32,
        &Device::Cpu,
    )?;
    let x = (noise * 1e4)?;
    for t in [0.0, 999.0] {
        let y = model.unet.forward(&x, &[t], &context, &Pass::default())?;
        let worst = y.abs()?.max_all()?.to_scalar::<f32>()?;
        assert!(worst.is_finite(), "t = {t}: {worst}");
    }
    let image = model
        .vae
        .decode(&x.narrow(0, 0, 1)?)?
        .abs()?
        .max_all()?
        .to_scalar::<f32>()?;
    assert!(image.is_finite());
    Ok(())
}
