//! LoRA files of other tools.
use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::lora::Lora;
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
