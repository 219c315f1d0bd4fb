//! Folders as diffusers and transformers write them.
use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::{Sampler, Solver};
use dipir_diffusion::schedule::NoiseSchedule;
use dipir_diffusion::text_encoder::TextEncoder;
use dipir_diffusion::vae::Vae;
use dipir_diffusion::weights::write_safetensors;
use serde_json::{Value, json};

use super::{Outcome, family, model_folder, tensors};

/// Puts the weights `stem` of `folder` into two shards in half precision, named as diffusers 0.42.1 and
/// transformers 5.24 name the variant fp16.
fn cut_in_half_precision(folder: &Path, stem: &str) -> Outcome {
    let whole = folder.join(format!("{stem}.safetensors"));
    let all = tensors(&whole)?;
    std::fs::remove_file(whole)?;
    let mut map = serde_json::Map::new();
    for shard in 0..2 {
        let name = format!("{stem}.fp16-0000{}-of-00002.safetensors", shard + 1);
        let entries = all.iter().enumerate().filter(|(i, _)| i % 2 == shard);
        let part: BTreeMap<String, Tensor> = entries
            .map(|(_, (k, v))| Ok((k.clone(), v.to_dtype(DType::F16)?)))
            .collect::<candle_core::Result<_>>()?;
        map.extend(part.keys().map(|k| (k.clone(), json!(name))));
        write_safetensors(&folder.join(name), &part, &BTreeMap::new())?;
    }
    let index = json!({"metadata": {"total_size": 1}, "weight_map": map});
    let name = format!("{stem}.safetensors.index.fp16.json");
    Ok(std::fs::write(folder.join(name), index.to_string())?)
}

/// Text states, a prediction and latents.
fn values(folder: &Path) -> Result<[Vec<f32>; 3], Box<dyn std::error::Error>> {
    let model = Model::load(folder, DType::F32, &Device::Cpu)?;
    let states = model.encode_prompts(&["a photo of a car"], None)?;
    let x = Tensor::ones((1, 4, 8, 8), DType::F32, &Device::Cpu)?;
    let y = model.unet.predict(&x, &[10.0], &states, &Pass::default())?;
    let image = (Tensor::ones((1, 3, 16, 16), DType::F32, &Device::Cpu)? * 0.3)?;
    let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
    Ok([flat(&states)?, flat(&y)?, flat(&model.vae.encode(&image)?)?])
}

#[test]
fn shards_in_half_precision_and_a_tokenizer_of_one_file_mean_the_same() -> Outcome {
    let folder = model_folder()?;
    let part = |name: &str| folder.path().join(name);
    let wanted = values(folder.path())?;
    cut_in_half_precision(&part("unet"), "diffusion_pytorch_model")?;
    cut_in_half_precision(&part("vae"), "diffusion_pytorch_model")?;
    cut_in_half_precision(&part("text_encoder"), "model")?;
    let tokenizer = part("tokenizer");
    let vocab: Value = serde_json::from_slice(&std::fs::read(tokenizer.join("vocab.json"))?)?;
    let merges = std::fs::read_to_string(tokenizer.join("merges.txt"))?;
    let pairs = merges.lines().skip(1).filter(|l| !l.is_empty());
    let pairs: Vec<Vec<&str>> = pairs.map(|l| l.split(' ').collect()).collect();
    let marker = |text: &str| json!({"id": vocab[text], "content": text, "special": true});
    let one = json!({
        "added_tokens": [marker("<|startoftext|>"), marker("<|endoftext|>")],
        "model": {"type": "BPE", "vocab": vocab, "merges": pairs},
    });
    std::fs::remove_dir_all(&tokenizer)?;
    std::fs::create_dir(&tokenizer)?;
    std::fs::write(tokenizer.join("tokenizer.json"), one.to_string())?;
    let config = json!({"pad_token": "<|endoftext|>", "model_max_length": 77});
    std::fs::write(tokenizer.join("tokenizer_config.json"), config.to_string())?;
    // The reference's weights are numbers of f16.
    assert_eq!(values(folder.path())?, wanted);
    Ok(())
}

/// Changes `config.json` of `folder`.
fn configure(folder: &Path, name: &str, change: impl Fn(&mut Value)) -> Outcome {
    let path = folder.join(name);
    let mut config: Value = serde_json::from_slice(&std::fs::read(&path)?)?;
    change(&mut config);
    Ok(std::fs::write(path, config.to_string())?)
}

#[test]
fn the_projection_of_an_openclip_text_encoder_changes_no_state() -> Outcome {
    let folder = model_folder()?;
    let part = folder.path().join("text_encoder");
    configure(&part, "config.json", |c| c["hidden_act"] = json!("gelu"))?;
    let states = || -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let encoder = TextEncoder::load(&part, DType::F32, &Device::Cpu)?;
        let states = encoder.forward(&[vec![1, 2, 3]], None)?;
        Ok(states.flatten_all()?.to_vec1()?)
    };
    let plain = states()?;
    let path = part.join("model.safetensors");
    let mut weights = tensors(&path)?;
    let projection = Tensor::ones((16, 24), DType::F32, &Device::Cpu)?;
    weights.insert("text_projection.weight".into(), projection);
    write_safetensors(&path, &weights, &BTreeMap::new())?;
    configure(&part, "config.json", |c| {
        c["architectures"] = json!(["CLIPTextModelWithProjection"]);
        c["projection_dim"] = json!(16);
    })?;
    assert_eq!(states()?, plain);
    for (key, value) in [
        ("model_type", json!("clip")),
        ("hidden_act", json!("gelu_new")),
    ] {
        let before = std::fs::read(part.join("config.json"))?;
        configure(&part, "config.json", |c| c[key] = value.clone())?;
        let message = states().expect_err(key).to_string();
        assert!(message.contains(&format!("{key} = {value}")), "{message}");
        std::fs::write(part.join("config.json"), before)?;
    }
    Ok(())
}

#[test]
fn autoencoders_without_quantising_convolutions_and_of_other_scales_are_read() -> Outcome {
    let folder = model_folder()?;
    let part = folder.path().join("vae");
    let path = part.join("diffusion_pytorch_model.safetensors");
    let mut weights = tensors(&path)?;
    for (name, channels) in [("quant_conv", 8), ("post_quant_conv", 4)] {
        let one = Tensor::eye(channels, DType::F32, &Device::Cpu)?;
        let one = one.reshape((channels, channels, 1, 1))?;
        let zero = Tensor::zeros(channels, DType::F32, &Device::Cpu)?;
        weights.insert(format!("{name}.weight"), one);
        weights.insert(format!("{name}.bias"), zero);
    }
    write_safetensors(&path, &weights, &BTreeMap::new())?;
    let x: Vec<f32> = (0..3 * 256).map(|n| (n as f32 * 0.7).sin()).collect();
    let x = Tensor::from_vec(x, (1, 3, 16, 16), &Device::Cpu)?;
    let run = || -> Result<[Vec<f32>; 2], Box<dyn std::error::Error>> {
        let vae = Vae::load(&part, DType::F32, &Device::Cpu)?;
        let latents = vae.encode(&x)?;
        let image = vae.decode(&latents)?;
        Ok([latents, image].map(|t| t.flatten_all().and_then(|t| t.to_vec1()).expect("values")))
    };
    let with = run()?;
    weights.retain(|name, _| !name.contains("quant_conv"));
    write_safetensors(&path, &weights, &BTreeMap::new())?;
    let message = run().expect_err("a layer without weights").to_string();
    assert!(message.contains("\"quant_conv.weight\""), "{message}");
    configure(&part, "config.json", |c| {
        c["use_quant_conv"] = json!(false);
        c["use_post_quant_conv"] = json!(false);
        c["force_upcast"] = json!(true);
        c["shift_factor"] = Value::Null;
    })?;
    let without = run()?;
    assert_eq!(with, without);
    configure(&part, "config.json", |c| c["shift_factor"] = json!(0.0))?;
    assert_eq!(run()?, without);
    // A power of two times the factor: the latents are exactly that multiple, and come back.
    configure(&part, "config.json", |c| {
        c["scaling_factor"] = json!(4.0 * 0.18215)
    })?;
    let scaled = run()?;
    let four: Vec<f32> = without[0].iter().map(|v| 4.0 * v).collect();
    assert_eq!([&scaled[0], &scaled[1]], [&four, &without[1]]);
    for (key, value) in [
        ("shift_factor", json!(0.1159)),
        ("latents_mean", json!([0.0, 0.1, 0.2, 0.3])),
        ("scaling_factor", json!(0.0)),
        ("_class_name", json!("AutoencoderTiny")),
        ("act_fn", json!("relu")),
    ] {
        let before = std::fs::read(part.join("config.json"))?;
        configure(&part, "config.json", |c| c[key] = value.clone())?;
        let message = run().expect_err(key).to_string();
        let names_it = message.contains(&format!("{key} = "));
        assert!(names_it && message.lines().count() == 1, "{message}");
        std::fs::write(part.join("config.json"), before)?;
    }
    Ok(())
}

#[test]
fn predictions_and_spacings_of_a_scheduler_are_used_or_refused_by_key() -> Outcome {
    let folder = tempfile::tempdir()?;
    std::fs::copy(
        family().join("scheduler/scheduler_config.json"),
        folder.path().join("scheduler_config.json"),
    )?;
    let set = |key: &str, value: &str| -> Result<NoiseSchedule, Box<dyn std::error::Error>> {
        configure(folder.path(), "scheduler_config.json", |c| {
            c[key] = json!(value)
        })?;
        Ok(NoiseSchedule::load(folder.path())?)
    };
    for kind in ["epsilon", "v_prediction", "sample"] {
        let found = set("prediction_type", kind)?.prediction();
        assert_eq!(json!(found), json!(kind));
    }
    // Of DDIMScheduler.set_timesteps(4) with steps_offset 1, diffusers 0.42.1.
    for (spacing, wanted) in [
        ("leading", [751, 501, 251, 1]),
        ("trailing", [999, 749, 499, 249]),
        ("linspace", [999, 666, 333, 0]),
    ] {
        let schedule = set("timestep_spacing", spacing)?;
        let sampler = Sampler::new(&schedule, Solver::Ddim, 4)?;
        assert_eq!(sampler.timesteps(), wanted, "{spacing}");
    }
    for (key, value, usual) in [
        ("prediction_type", "flow_prediction", "epsilon"),
        ("timestep_spacing", "log", "leading"),
        ("beta_schedule", "sigmoid", "scaled_linear"),
    ] {
        let message = set(key, value).expect_err(key).to_string();
        let names_it = message.contains(key) && message.contains(value);
        assert!(names_it && message.lines().count() == 1, "{message}");
        set(key, usual)?;
    }
    Ok(())
}
