//! LoRA files of other tools.
use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::lora::{Lora, LoraInfo, LoraStyle};
use dipir_diffusion::model::load_unet;
use dipir_diffusion::weights::{Weights, write_safetensors};

use super::{Outcome, family, tensors};

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
            "key \"lora_te_text_model_x.lora_down.weight\" adapts the text encoder",
        ),
        (
            vec![("text_encoder.text_model.x.lora_A.weight", matrix(4, 8)?)],
            "key \"text_encoder.text_model.x.lora_A.weight\" adapts the text encoder",
        ),
        (
            vec![("base_model.model.text_model.x.lora_A.weight", matrix(4, 8)?)],
            "key \"base_model.model.text_model.x.lora_A.weight\" adapts the text encoder",
        ),
        (
            vec![("unet.nowhere.lora_A.weight", matrix(4, 8)?)],
            "\"unet.nowhere.lora_A.weight\" belongs to no layer",
        ),
        (
            vec![(
                "lora_unet_down_blocks_0_resnets_0_conv1.lora_down.weight",
                matrix(4, 8)?,
            )],
            "conv1.lora_down.weight\" adapts a layer outside the attentions",
        ),
        (
            vec![(
                "base_model.model.down_blocks.0.resnets.0.time_emb_proj.lora_A.weight",
                matrix(4, 8)?,
            )],
            "time_emb_proj.lora_A.weight\" adapts a layer outside the attentions",
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
fn rank_stabilised_adapters_are_scaled_by_alpha_over_the_root_of_the_rank() -> Outcome {
    let unet = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let module = "unet.down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let matrix = |a, b| Tensor::ones((a, b), DType::F32, &Device::Cpu);
    let tensors = BTreeMap::from([
        (format!("{module}.lora_A.weight"), matrix(4, 16)?),
        (format!("{module}.lora_B.weight"), matrix(16, 4)?),
    ]);
    for (metadata, scale) in [
        (r#"{"unet.lora_alpha": 6}"#, 6.0 / 4.0),
        (
            r#"{"unet.lora_alpha": 6, "unet.use_rslora": false}"#,
            6.0 / 4.0,
        ),
        (
            r#"{"unet.lora_alpha": 6, "unet.use_rslora": true}"#,
            6.0 / 2.0,
        ),
        (r#"{"lora_alpha": 6, "use_rslora": true}"#, 6.0 / 2.0),
    ] {
        let header = BTreeMap::from([("lora_adapter_metadata".into(), metadata.into())]);
        write_safetensors(&path, &tensors, &header)?;
        let lora = Lora::load(&path, &unet.adapter_targets(), DType::F32, &Device::Cpu)?;
        let adapter = lora.adapters().values().next().ok_or("no adapter")?;
        let y = adapter.forward(&matrix(1, 16)?)?.max_all()?;
        // Ones: 16 inputs, then 4 of the rank.
        assert_eq!(y.to_scalar::<f32>()?, 64.0 * scale, "{metadata}");
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

/// The scale of the first adapter that a file of ones holds.
fn scale_of_ones(path: &Path, rank: usize) -> Result<f64, Box<dyn std::error::Error>> {
    let unet = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?;
    let lora = Lora::load(path, &unet.adapter_targets(), DType::F32, &Device::Cpu)?;
    let adapter = lora.adapters().values().next().ok_or("no adapter")?;
    let ones = Tensor::ones((1, 16), DType::F32, &Device::Cpu)?;
    let y = adapter.forward(&ones)?.max_all()?.to_scalar::<f32>()?;
    Ok(f64::from(y) / (16 * rank) as f64)
}

#[test]
fn adapters_that_peft_wrote_have_the_alpha_of_the_configuration_beside_them() -> Outcome {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("adapter_model.safetensors");
    let config = folder.path().join("adapter_config.json");
    let layer = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let ones = |a, b| Tensor::ones((a, b), DType::F32, &Device::Cpu);
    let tensors = BTreeMap::from([
        (
            format!("base_model.model.{layer}.lora_A.weight"),
            ones(4, 16)?,
        ),
        (
            format!("base_model.model.{layer}.lora_B.weight"),
            ones(16, 4)?,
        ),
    ]);
    let header = BTreeMap::from([("format".into(), "pt".into())]);
    write_safetensors(&path, &tensors, &header)?;
    let refusal = |part: &str| -> Outcome {
        let message = scale_of_ones(&path, 4).expect_err(part).to_string();
        assert!(message.contains(part), "{message}");
        Ok(())
    };
    refusal("nothing tells its alpha")?;
    refusal("put that file beside it")?;
    for (text, scale) in [
        (
            r#"{"r": 4, "lora_alpha": 16, "peft_type": "LORA", "use_dora": false}"#,
            4.0,
        ),
        (r#"{"r": 4, "lora_alpha": 16, "use_rslora": true}"#, 8.0),
        (
            r#"{"r": 4, "lora_alpha": 16, "alpha_pattern": {"attn2.to_q": 1, "to_q": 8, "attn1.to_q": 2}}"#,
            2.0,
        ),
        (
            r#"{"r": 8, "lora_alpha": 16, "rank_pattern": {"attn1.to_q": 4}, "alpha_pattern": {"^to_q": 1}}"#,
            4.0,
        ),
    ] {
        std::fs::write(&config, text)?;
        assert_eq!(scale_of_ones(&path, 4)?, scale, "{text}");
        assert_eq!(scale_of_ones(folder.path(), 4)?, scale, "{text}");
    }
    for (text, part) in [
        (r#"{"r": 4}"#, "has no number lora_alpha"),
        (
            r#"{"r": 4, "lora_alpha": 16, "use_dora": true}"#,
            "it is a DoRA (use_dora)",
        ),
        (
            r#"{"r": 4, "lora_alpha": 16, "peft_type": "LOHA"}"#,
            "peft_type = \"LOHA\"",
        ),
        (
            r#"{"r": 8, "lora_alpha": 16}"#,
            "of rank 4, the settings of the training say 8",
        ),
        (
            r#"{"r": 4, "lora_alpha": 16, "alpha_pattern": {"to_[qk": 1}}"#,
            "has \"to_[qk\", which is no regular expression",
        ),
        (
            r#"{"r": 4, "lora_alpha": 16, "init_lora_weights": "pissa_niter_4"}"#,
            "changes the model's own weights",
        ),
        ("[]", "adapter_config.json"),
    ] {
        std::fs::write(&config, text)?;
        refusal(part)?;
    }
    // So have keys without a prefix, of a UNet on its own.
    let renamed = |prefix: &str| -> BTreeMap<String, Tensor> {
        let entries = tensors.iter();
        let entries = entries.map(|(k, v)| (k.replace("base_model.model.", prefix), v.clone()));
        entries.collect()
    };
    write_safetensors(&path, &renamed(""), &header)?;
    for (text, scale) in [
        (r#"{"r": 4, "lora_alpha": 16}"#, 4.0),
        (r#"{"r": 4, "lora_alpha": 16, "use_rslora": true}"#, 8.0),
        (
            r#"{"r": 4, "lora_alpha": 16, "alpha_pattern": {"to_q": 8}}"#,
            2.0,
        ),
    ] {
        std::fs::write(&config, text)?;
        assert_eq!(scale_of_ones(&path, 4)?, scale, "{text}");
    }
    std::fs::remove_file(&config)?;
    assert_eq!(scale_of_ones(&path, 4)?, 1.0);
    // Beside keys of diffusers the configuration counts for nothing, as in load_lora_weights of diffusers 0.42.1.
    write_safetensors(&path, &renamed("unet."), &header)?;
    for text in [
        r#"{"r": 4, "lora_alpha": 16}"#,
        r#"{"r": 8, "lora_alpha": 16, "rank_pattern": {"to_q": 2}, "alpha_pattern": {"to_q": 1}, "use_rslora": true}"#,
    ] {
        std::fs::write(&config, text)?;
        assert_eq!(scale_of_ones(&path, 4)?, 1.0, "{text}");
    }
    Ok(())
}

/// What a file of ones with these settings in its header is read as: the scale, or what is wrong.
fn scale_with_metadata(metadata: &str) -> Result<f64, Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let layer = "unet.down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let ones = |a, b| Tensor::ones((a, b), DType::F32, &Device::Cpu);
    let tensors = BTreeMap::from([
        (format!("{layer}.lora_A.weight"), ones(4, 16)?),
        (format!("{layer}.lora_B.weight"), ones(16, 4)?),
    ]);
    let header = BTreeMap::from([("lora_adapter_metadata".into(), metadata.into())]);
    write_safetensors(&path, &tensors, &header)?;
    scale_of_ones(&path, 4)
}

#[test]
fn patterns_are_regular_expressions_of_the_end_of_a_name() -> Outcome {
    // What peft's get_pattern_key finds for down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q.
    for (pattern, is_found) in [
        ("to_q", true),
        ("o_q", false),
        ("to_", false),
        ("attn1.to_q", true),
        ("attn..to_q", true),
        ("to.q", true),
        (".to_q", false),
        (r"attn1\\.to_q", true),
        (r"attn\\d.to_[qk]", true),
        ("to_k|to_q", true),
        (".*to_q", true),
        ("down_blocks.*", true),
        ("^to_q", false),
        (
            "^down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q",
            true,
        ),
        ("attn1.to_q$", true),
        ("attentions.*attn2.*", false),
    ] {
        let metadata =
            format!(r#"{{"unet.lora_alpha": 8, "unet.alpha_pattern": {{"{pattern}": 2}}}}"#);
        let scale = if is_found { 0.5 } else { 2.0 };
        assert_eq!(scale_with_metadata(&metadata)?, scale, "{pattern}");
        let metadata = format!(r#"{{"r": 4, "rank_pattern": {{"{pattern}": 8}}}}"#);
        assert_eq!(
            scale_with_metadata(&metadata).is_err(),
            is_found,
            "{pattern}"
        );
    }
    // The first that fits counts.
    let metadata = r#"{"alpha_pattern": {"attn2.*": 1, "attn1.*": 2, "to_q": 4}}"#;
    assert_eq!(scale_with_metadata(metadata)?, 0.5);
    Ok(())
}

/// A hundred patterns of 7 kB would be a gigabyte when compiled.
#[test]
fn patterns_that_are_much_when_compiled_are_refused_before() -> Outcome {
    let repeated: Vec<String> = (0..30)
        .map(|n| format!("{}a", "(x){5}".repeat(n % 3)))
        .collect();
    let name = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let mut names: Vec<String> = (0..2000).map(|n| format!("{name}{n}")).collect();
    names.extend((0..200).map(|n| format!("{name}{n}").replace('.', r"\.")));
    let many: Vec<String> = (100..200).map(|n| format!("\\w{{{n}}}")).collect();
    let nested = vec!["(((\\w{9}){9}){9}){9}".to_owned()];
    for (patterns, is_taken) in [
        (names, true),
        (repeated, true),
        (many, false),
        (nested, false),
    ] {
        let entries: serde_json::Map<_, _> = patterns.into_iter().map(|p| (p, 2.into())).collect();
        let metadata = serde_json::json!({ "alpha_pattern": entries }).to_string();
        let message = scale_with_metadata(&metadata).map_err(|e| e.to_string());
        let said = "the regular expressions of alpha_pattern have";
        assert_eq!(message.is_ok(), is_taken, "{message:?}");
        assert!(is_taken || message.is_err_and(|m| m.contains(said)));
    }
    Ok(())
}

#[test]
fn settings_of_a_wrong_type_are_quoted() -> Outcome {
    for (metadata, part) in [
        (
            r#"{"lora_alpha": "16"}"#,
            "lora_adapter_metadata has \"lora_alpha\": \"16\" (accepted: a number without quotes); correct it",
        ),
        (
            r#"{"unet.lora_alpha": 16, "unet.use_rslora": "yes"}"#,
            "has \"unet.use_rslora\": \"yes\" (accepted: true or false)",
        ),
        (
            r#"{"r": 4.5, "use_dora": 1}"#,
            "has \"r\": 4.5 (accepted: a whole number above 0, without quotes), \"use_dora\": 1 (accepted: true or false)",
        ),
        (
            r#"{"alpha_pattern": [["to_q", 8]]}"#,
            "\"alpha_pattern\": [[\"to_q\",8]] (accepted:",
        ),
        (
            r#"{"alpha_pattern": {"to_q": "8"}}"#,
            "has \"to_q\": \"8\" in alpha_pattern (accepted: a number without quotes)",
        ),
        (
            r#"{"rank_pattern": {"to_v": 0}}"#,
            "has \"to_v\": 0 in rank_pattern (accepted: a whole number above 0",
        ),
        (r#"{"peft_type": 3}"#, "\"peft_type\": 3 (accepted: a text)"),
        ("[16]", "lora_adapter_metadata is not a JSON object"),
    ] {
        let message = scale_with_metadata(metadata).expect_err(metadata);
        assert!(message.to_string().contains(part), "{message}");
    }
    let nothing_said = r#"{"lora_alpha": null, "use_rslora": null, "init_lora_weights": true}"#;
    assert_eq!(scale_with_metadata(nothing_said)?, 1.0);
    Ok(())
}

#[test]
fn matrices_of_convolutions_have_the_shape_of_convolutions_in_files() -> Outcome {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    // Stable Diffusion 1 has convolutions there, 2 has matrices.
    for (family, dims) in [(family(), 4), (family().with_file_name("sd21"), 2)] {
        let targets = load_unet(&family.join("unet"), DType::F32, &Device::Cpu)?.adapter_targets();
        let layers = [
            "down_blocks.0.attentions.0.proj_in",
            "up_blocks.1.attentions.1.proj_out",
        ];
        let mut flat = BTreeMap::new();
        for layer in layers {
            let target = targets.iter().find(|t| t.name == layer).ok_or(layer)?;
            let ones = |a, b| Tensor::ones((a, b), DType::F32, &Device::Cpu);
            flat.insert(
                format!("unet.{layer}.lora_A.weight"),
                ones(4, target.inputs)?,
            );
            flat.insert(
                format!("unet.{layer}.lora_B.weight"),
                ones(target.outputs, 4)?,
            );
        }
        write_safetensors(&path, &flat, &BTreeMap::new())?;
        let lora = Lora::load(&path, &targets, DType::F32, &Device::Cpu)?;
        // What trains or guides has matrices; a copy in another precision is written alike.
        for lora in [&lora, &lora.constant(DType::F32)?] {
            for style in [LoraStyle::Peft, LoraStyle::Kohya] {
                lora.save(&path, style, &LoraInfo::new())?;
                let written = tensors(&path)?;
                let matrices = written.iter().filter(|(key, _)| !key.ends_with(".alpha"));
                for (key, matrix) in matrices {
                    assert_eq!(matrix.dims().len(), dims, "{key}: {:?}", matrix.dims());
                    assert!(matrix.dims()[2..].iter().all(|&n| n == 1), "{key}");
                }
                let again = Lora::load(&path, &targets, DType::F32, &Device::Cpu)?;
                for (name, adapter) in lora.adapters() {
                    let other = again.adapter(name).ok_or(name.as_str())?;
                    let values = |t: &Tensor| t.to_vec2::<f32>();
                    assert_eq!(values(adapter.down())?, values(other.down())?);
                    assert_eq!(values(adapter.up())?, values(other.up())?);
                }
            }
        }
    }
    Ok(())
}

#[test]
fn adapters_are_written_in_f32_with_the_alpha_that_was_given() -> Outcome {
    let targets = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?.adapter_targets();
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    // 1 / 49 * 49 is not 1 in f64.
    let lora = Lora::new(&targets, 49, 1.0, 7, &Device::Cpu)?;
    for style in [LoraStyle::Peft, LoraStyle::Kohya] {
        for lora in [&lora, &lora.constant(DType::BF16)?] {
            lora.save(&path, style, &LoraInfo::new())?;
            let weights = Weights::open_file(&path)?;
            assert_eq!(weights.precisions(), ["F32"]);
            assert_eq!(weights.metadata()["alpha"], "1");
            if style == LoraStyle::Peft {
                let settings = &weights.metadata()["lora_adapter_metadata"];
                assert!(settings.contains("\"unet.lora_alpha\":1,"), "{settings}");
            }
        }
    }
    Ok(())
}

#[test]
fn two_keys_of_one_matrix_are_named() -> Outcome {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let layer = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let flat = layer.replace('.', "_");
    let ones = |a, b| Tensor::ones((a, b), DType::F32, &Device::Cpu);
    let tensors = BTreeMap::from([
        (format!("unet.{layer}.lora_A.weight"), ones(4, 16)?),
        (format!("unet.{layer}.lora_B.weight"), ones(16, 4)?),
        // Of another LoRA: which one counts?
        (format!("lora_unet_{flat}.lora_up.weight"), ones(16, 4)?),
    ]);
    write_safetensors(&path, &tensors, &BTreeMap::new())?;
    let message = scale_of_ones(&path, 4).expect_err("two").to_string();
    assert!(
        message.contains("lora_up.weight\" and \"unet."),
        "{message}"
    );
    Ok(())
}

#[test]
fn kohya_files_with_the_original_names_of_blocks_mean_the_same() -> Outcome {
    let unet = load_unet(&family().join("unet"), DType::F32, &Device::Cpu)?;
    let targets = unet.adapter_targets();
    let load = |path: &Path| Lora::load(path, &targets, DType::F32, &Device::Cpu);
    let known = family().join("lora_kohya.safetensors");
    let wanted = load(&known)?;
    // A level of this UNet has one block and what shrinks it on the way down, two on the way up.
    let original = |key: &str| {
        key.replace("down_blocks_0_attentions_0", "input_blocks_1_1")
            .replace("down_blocks_1_attentions_0", "input_blocks_3_1")
            .replace("mid_block_attentions_0", "middle_block_1")
            .replace("up_blocks_1_attentions_0", "output_blocks_2_1")
            .replace("up_blocks_1_attentions_1", "output_blocks_3_1")
            .replace("up_blocks_2_attentions_0", "output_blocks_4_1")
            .replace("up_blocks_2_attentions_1", "output_blocks_5_1")
    };
    let renamed: BTreeMap<String, Tensor> = tensors(&known)?
        .into_iter()
        .map(|(key, tensor)| (original(&key), tensor))
        .collect();
    assert!(renamed.keys().all(|key| !key.contains("attentions")));
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    write_safetensors(&path, &renamed, &BTreeMap::new())?;
    let found = load(&path)?;
    assert_eq!(found.adapters().len(), wanted.adapters().len());
    for (name, adapter) in wanted.adapters() {
        let other = found.adapter(name).ok_or(name.as_str())?;
        assert_eq!(other.alpha(), adapter.alpha(), "{name}");
        let values = |t: &Tensor| t.to_vec2::<f32>();
        assert_eq!(values(other.up())?, values(adapter.up())?, "{name}");
    }
    // Of a larger model.
    let key = "lora_unet_input_blocks_7_1_transformer_blocks_0_attn1_to_q.lora_down.weight";
    let matrix = Tensor::zeros((4, 16), DType::F32, &Device::Cpu)?;
    write_safetensors(
        &path,
        &BTreeMap::from([(key.into(), matrix)]),
        &BTreeMap::new(),
    )?;
    let message = load(&path).expect_err(key).to_string();
    assert!(message.contains("belongs to no layer"), "{message}");
    Ok(())
}

#[test]
fn what_is_no_lora_is_called_by_its_name() -> Outcome {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("lora.safetensors");
    let layer = "unet.down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q";
    let zeros = |a| Tensor::zeros((a, 16), DType::F32, &Device::Cpu);
    for (end, kind) in [
        ("lora_magnitude_vector", "it is a DoRA"),
        ("lora_magnitude_vector.weight", "it is a DoRA"),
        ("dora_scale", "it is a DoRA"),
        ("hada_w1_a", "it is a LoHa"),
        ("lokr_w1", "it is a LoKr"),
        ("lora_mid.weight", "it is a LoCon with a third matrix"),
        ("lora_B.bias", "it is a LoRA with biases"),
        ("diff", "it is made of whole differences"),
        ("diff_b", "it is made of whole differences"),
    ] {
        let tensors = BTreeMap::from([
            (format!("{layer}.{end}"), zeros(1)?),
            (format!("{layer}.lora_A.weight"), zeros(4)?),
        ]);
        write_safetensors(&path, &tensors, &BTreeMap::new())?;
        let message = scale_of_ones(&path, 4).expect_err(end).to_string();
        assert!(message.contains(kind), "{message}");
    }
    let pickled = folder.path().join("pytorch_lora_weights.bin");
    for (path, part) in [
        (pickled.as_path(), "accepted: a .safetensors file"),
        (folder.path(), "holds neither"),
    ] {
        let message = scale_of_ones(path, 4).expect_err(part).to_string();
        assert!(message.contains(part), "{message}");
    }
    Ok(())
}
