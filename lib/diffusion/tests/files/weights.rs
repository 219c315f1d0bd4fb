//! Tensors of a folder: sharded, in half precision, missing, hostile.
use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::Error;
use dipir_diffusion::model::{Model, load_unet};
use dipir_diffusion::pass::Pass;
use dipir_diffusion::weights::{Weights, write_safetensors};

use super::{Outcome, model_folder, tensors, unet_folder, unet_tensors};

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
fn an_output_that_is_not_finite_is_refused() -> Outcome {
    use dipir_diffusion::generate::{GenerateSettings, generate};
    use dipir_diffusion::sampler::Solver;
    let settings = GenerateSettings {
        solver: Solver::DpmSolver2M,
        steps: 2,
        guidance: 5.0,
        size: (16, 16),
        seed: 1,
    };
    for (part, name, what) in [
        ("unet", "conv_out.bias", "sampled latents"),
        ("vae", "decoder.conv_out.bias", "decoded picture"),
    ] {
        let folder = model_folder()?;
        let path = folder
            .path()
            .join(part)
            .join("diffusion_pytorch_model.safetensors");
        let mut weights = tensors(&path)?;
        let bias = weights.get_mut(name).ok_or(name)?;
        *bias = (&*bias * f64::NAN)?;
        write_safetensors(&path, &weights, &BTreeMap::new())?;
        let model = Model::load(folder.path(), DType::F32, &Device::Cpu)?;
        let message = generate(&model, "a toy", &settings, &Pass::default(), None, |_| true)
            .expect_err(part)
            .to_string();
        assert!(
            message.contains(what) && message.contains("dipir-model check"),
            "{message}"
        );
    }
    Ok(())
}

#[test]
fn a_file_that_cannot_be_written_leaves_nothing_beside_it() -> Outcome {
    let folder = tempfile::tempdir()?;
    let weights = BTreeMap::from([("a".to_string(), Tensor::zeros(4, DType::F32, &Device::Cpu)?)]);
    // Nothing replaces a folder.
    let path = folder.path().join("lora.safetensors");
    std::fs::create_dir(&path)?;
    assert!(write_safetensors(&path, &weights, &BTreeMap::new()).is_err());
    assert_eq!(std::fs::read_dir(folder.path())?.count(), 1);
    // Nor is there a way into one that is not there.
    let path = folder.path().join("gone/lora.safetensors");
    assert!(write_safetensors(&path, &weights, &BTreeMap::new()).is_err());
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

#[test]
fn variants_are_read_and_other_files_are_listed() -> Outcome {
    let folder = unet_folder(&unet_tensors()?)?;
    let file = |variant: &str| {
        folder
            .path()
            .join(format!("diffusion_pytorch_model{variant}"))
    };
    let load = || load_unet(folder.path(), DType::F32, &Device::Cpu);
    std::fs::rename(file(".safetensors"), file(".bf16.safetensors"))?;
    load()?;
    std::fs::rename(file(".bf16.safetensors"), file(".non_ema.safetensors"))?;
    let refusal = |parts: &[&str]| {
        let message = load().expect_err("refused").to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    };
    refusal(&[
        "there is diffusion_pytorch_model.non_ema.safetensors",
        "rename the variant that is wanted to diffusion_pytorch_model.safetensors",
    ]);
    std::fs::rename(file(".non_ema.safetensors"), file(".fp16.bin"))?;
    refusal(&[
        "there is diffusion_pytorch_model.fp16.bin",
        "safe_serialization=True",
    ]);
    std::fs::remove_file(file(".fp16.bin"))?;
    refusal(&["fetch the model's folder again"]);
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
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 3438167540\n";
    std::fs::write(&path, pointer)?;
    let message = Weights::open_file(&path)
        .expect_err("a pointer")
        .to_string();
    assert!(message.contains("git lfs pull"), "{message}");
    Ok(())
}
