//! Configurations that contradict the weights.
use candle_core::{DType, Device, Tensor};
use dipir_diffusion::Error;
use dipir_diffusion::description::Description;
use dipir_diffusion::model::{Model, load_unet};
use dipir_diffusion::pass::Pass;
use dipir_diffusion::schedule::{NoiseSchedule, Prediction};

use super::{Outcome, family, model_folder, unet_folder, unet_tensors};

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
        (
            "mid_block_type",
            serde_json::Value::Null,
            "mid_block_type = null is not supported, accepted: \"UNetMidBlock2DCrossAttn\"",
        ),
        (
            "layers_per_block",
            serde_json::json!([1, 2, 1]),
            "layers_per_block = [1,2,1] is not supported, accepted: one number for all levels",
        ),
        (
            "cross_attention_dim",
            serde_json::json!([24, 24, 24]),
            "cross_attention_dim = [24,24,24] is not supported, accepted: one number",
        ),
        (
            "downsample_padding",
            serde_json::json!(2),
            "downsample_padding = 2; accepted: 0 or 1",
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

/// Zeros after the last row and column are zeros before the first ones of the mirrored picture.
#[test]
fn without_downsample_padding_zeros_come_after_the_last_row_and_column() -> Outcome {
    let mirrored = |t: &Tensor| -> candle_core::Result<Tensor> {
        match t.dims() {
            [_, _, height, width] if *height > 1 && *width > 1 => t.flip(&[2, 3])?.contiguous(),
            _ => Ok(t.clone()),
        }
    };
    let own = unet_tensors()?;
    let mut other = own.clone();
    for tensor in other.values_mut() {
        *tensor = mirrored(tensor)?;
    }
    let x: Vec<f32> = (0..4 * 64).map(|n| (n as f32 * 0.7).sin()).collect();
    let x = Tensor::from_vec(x, (1, 4, 8, 8), &Device::Cpu)?;
    let context = Tensor::ones((1, 5, 24), DType::F32, &Device::Cpu)?;
    let predict =
        |tensors, padding: usize, x: &Tensor| -> Result<Tensor, Box<dyn std::error::Error>> {
            let folder = unet_folder(tensors)?;
            let path = folder.path().join("config.json");
            let mut config: serde_json::Value = serde_json::from_slice(&std::fs::read(&path)?)?;
            config["downsample_padding"] = padding.into();
            std::fs::write(&path, config.to_string())?;
            let unet = load_unet(folder.path(), DType::F32, &Device::Cpu)?;
            Ok(unet.predict(x, &[500.0], &context, &Pass::default())?)
        };
    let found = predict(&own, 0, &x)?;
    let wanted = mirrored(&predict(&other, 1, &mirrored(&x)?)?)?;
    let apart = (&found - &wanted)?.abs()?.max_all()?.to_scalar::<f32>()?;
    let size = wanted.abs()?.max_all()?.to_scalar::<f32>()?;
    // Sums in another order.
    assert!(apart < 1e-4 * size, "{apart} of {size}");
    let padded = (predict(&own, 1, &x)? - &found)?.abs()?.max_all()?;
    assert!(
        padded.to_scalar::<f32>()? > 1e-3 * size,
        "both paddings are one"
    );
    Ok(())
}

#[test]
fn schedulers_whose_noise_is_not_of_variances_are_refused_by_class() -> Outcome {
    let folder = tempfile::tempdir()?;
    let load = |class: &str| {
        let text = format!("{{\"_class_name\": \"{class}\", \"num_train_timesteps\": 1000}}");
        std::fs::write(folder.path().join("scheduler_config.json"), text)?;
        NoiseSchedule::load(folder.path())
            .map(|_| ())
            .map_err(|e| std::io::Error::other(e.to_string()))
    };
    for class in [
        "FlowMatchEulerDiscreteScheduler",
        "FlowMatchOfTomorrow",
        "EDMDPMSolverMultistepScheduler",
        "ScoreSdeVeScheduler",
        "IPNDMScheduler",
        "CMStochasticIterativeScheduler",
        "CogVideoXDDIMScheduler",
    ] {
        let message = load(class).expect_err(class).to_string();
        assert!(
            message.contains(&format!("_class_name = \"{class}\" is not supported"))
                && message.contains("scheduler_config.json"),
            "{message}"
        );
    }
    for class in [
        "PNDMScheduler",
        "EulerDiscreteScheduler",
        "SchedulerOfTomorrow",
    ] {
        load(class)?;
    }
    Ok(())
}

/// The betas of diffusers 0.42.1, by the class's own defaults.
#[test]
fn betas_that_a_scheduler_s_file_leaves_out_are_its_class_s() -> Outcome {
    use serde_json::json;
    let folder = tempfile::tempdir()?;
    let read = |text: String| -> Result<_, Box<dyn std::error::Error>> {
        std::fs::write(folder.path().join("scheduler_config.json"), text)?;
        let config = NoiseSchedule::load(folder.path())?.config().clone();
        Ok((
            config.beta_start,
            config.beta_end,
            json!(config.beta_schedule),
        ))
    };
    for (class, start, end, curve) in [
        ("DDIMScheduler", 1e-4, 0.02, "linear"),
        ("PNDMScheduler", 1e-4, 0.02, "linear"),
        ("EulerDiscreteScheduler", 1e-4, 0.02, "linear"),
        ("LMSDiscreteScheduler", 1e-4, 0.02, "linear"),
        ("LCMScheduler", 8.5e-4, 0.012, "scaled_linear"),
        ("TCDScheduler", 8.5e-4, 0.012, "scaled_linear"),
        ("HeunDiscreteScheduler", 8.5e-4, 0.012, "linear"),
        ("KDPM2DiscreteScheduler", 8.5e-4, 0.012, "linear"),
        ("KDPM2AncestralDiscreteScheduler", 8.5e-4, 0.012, "linear"),
        ("DPMSolverSDEScheduler", 8.5e-4, 0.012, "linear"),
        ("UnCLIPScheduler", 1e-4, 0.02, "squaredcos_cap_v2"),
    ] {
        let found = read(format!(
            "{{\"_class_name\": \"{class}\", \"beta_end\": null}}"
        ))?;
        assert_eq!(found, (start, end, json!(curve)), "{class}");
        let said = format!("{{\"_class_name\": \"{class}\", \"beta_start\": 0.001}}");
        assert_eq!(read(said)?.0, 0.001, "{class}");
    }
    Ok(())
}

#[test]
fn settings_of_samplers_that_nothing_heeds_are_told() -> Outcome {
    let folder = tempfile::tempdir()?;
    let unused = |text: &str| -> Result<Vec<String>, Box<dyn std::error::Error>> {
        std::fs::write(folder.path().join("scheduler_config.json"), text)?;
        Ok(NoiseSchedule::load(folder.path())?.unused().to_vec())
    };
    let karras = r#"{"_class_name": "HeunDiscreteScheduler", "use_karras_sigmas": true, "thresholding": true}"#;
    assert_eq!(unused(karras)?, ["use_karras_sigmas", "thresholding"]);
    assert_eq!(
        unused(r#"{"_class_name": "LCMScheduler"}"#)?,
        ["LCMScheduler"]
    );
    let clips =
        r#"{"_class_name": "DDIMScheduler", "clip_sample": true, "use_karras_sigmas": false}"#;
    assert_eq!(unused(clips)?, ["clip_sample"]);
    let none = r#"{"_class_name": "PNDMScheduler", "clip_sample": true, "skip_prk_steps": true}"#;
    assert!(unused(none)?.is_empty());
    Ok(())
}

/// As diffusers 0.42.1 writes the configuration of every DPM-Solver.
#[test]
fn infinity_as_python_writes_it_hinders_no_key_that_does_not_need_it() -> Outcome {
    let folder = tempfile::tempdir()?;
    let read = |text: &str| {
        std::fs::write(folder.path().join("scheduler_config.json"), text)?;
        NoiseSchedule::load(folder.path())
            .map_err(|e| Box::<dyn std::error::Error>::from(e.to_string()))
    };
    let schedule = read(
        r#"{"_class_name": "DPMSolverMultistepScheduler", "lambda_min_clipped": -Infinity, "note": "a \\\" NaN, -Infinity",
            "beta_start": 0.00085, "sample_max_value": Infinity, "other": [NaN, 1]}"#,
    )?;
    assert_eq!(schedule.config().beta_start, 0.00085);
    assert_eq!(schedule.config().beta_end, 0.02);
    for (text, part) in [
        (
            r#"{"beta_end": Infinity}"#,
            "beta_end: invalid type: string \"Infinity\", expected f64",
        ),
        (
            "{\"a\": -Infinity,\n\"b\": }",
            "not JSON: expected value at line 2",
        ),
        (r#"{"a": "NaN\"#, "not JSON"),
    ] {
        let message = read(text).expect_err(part).to_string();
        assert!(message.contains(part), "{message}");
    }
    Ok(())
}

#[test]
fn a_part_of_a_model_and_the_hub_s_cache_are_told_from_a_model() -> Outcome {
    let folder = model_folder()?;
    let load = |path: &std::path::Path| {
        let error = Model::load(path, DType::F32, &Device::Cpu).expect_err("no model");
        error.to_string()
    };
    for part in ["unet", "scheduler", "text_encoder"] {
        let message = load(&folder.path().join(part));
        assert!(message.contains("name the model's folder"), "{message}");
    }
    let cache = tempfile::tempdir()?;
    for commit in ["1a", "0b"] {
        std::fs::create_dir_all(cache.path().join("snapshots").join(commit))?;
    }
    let message = load(cache.path());
    let wanted = "name a folder in it, snapshots/0b or snapshots/1a";
    assert!(message.contains(wanted), "{message}");
    Ok(())
}

#[test]
fn a_prediction_that_is_given_overrules_the_folder_s() -> Outcome {
    let folder = model_folder()?;
    let load = |prediction| Model::load_as(folder.path(), prediction, DType::F32, &Device::Cpu);
    let own = load(None)?;
    let given = load(Some(Prediction::Velocity))?;
    assert_eq!(own.schedule.prediction(), Prediction::Epsilon);
    assert_eq!(given.schedule.prediction(), Prediction::Velocity);
    assert_eq!(own.schedule.alpha_bar(500)?, given.schedule.alpha_bar(500)?);
    // What contradicts the rest of the file is refused by the file.
    let path = folder.path().join("scheduler/scheduler_config.json");
    let text = r#"{"rescale_betas_zero_snr": true, "prediction_type": "v_prediction"}"#;
    std::fs::write(path, text)?;
    load(None)?;
    let message = load(Some(Prediction::Epsilon))
        .expect_err("no sample")
        .to_string();
    assert!(message.contains("scheduler_config.json"), "{message}");
    Ok(())
}

#[test]
fn what_was_read_of_a_model_is_described() -> Outcome {
    let folder = model_folder()?;
    let half: std::collections::BTreeMap<String, Tensor> = unet_tensors()?
        .into_iter()
        .map(|(name, t)| Ok((name, t.to_dtype(DType::BF16)?)))
        .collect::<Result<_, Error>>()?;
    let unet = folder
        .path()
        .join("unet/diffusion_pytorch_model.safetensors");
    dipir_diffusion::weights::write_safetensors(&unet, &half, &Default::default())?;
    let model = Model::load(folder.path(), DType::F32, &Device::Cpu)?;
    let found = Description::of(&model)?;
    assert_eq!(found.stored["unet"], ["BF16"]);
    assert_eq!(found.stored["vae"], ["F16"]);
    assert_eq!(
        (found.inpainting, found.native_size),
        (false, model.native_size())
    );
    let words = found.in_words();
    let of = |name: &str| {
        words
            .iter()
            .find(|(n, _)| *n == name)
            .map(|(_, w)| w.as_str())
    };
    assert_eq!(of("prediction"), Some("epsilon"));
    assert_eq!(
        of("family"),
        Some("a model of other sizes (text states of 24)")
    );
    assert!(
        of("noise").is_some_and(|n| n.contains("1000 timesteps")),
        "{words:?}"
    );
    assert_eq!(of("not used"), None);
    Ok(())
}

#[test]
fn sizes_that_a_tensor_without_numbers_states_are_refused_by_key() -> Outcome {
    let mut tensors = unet_tensors()?;
    let empty = Tensor::zeros((0, 1usize << 62), DType::F32, &Device::Cpu)?;
    tensors.insert("empty".into(), empty);
    let folder = unet_folder(&tensors)?;
    let path = folder.path().join("config.json");
    let mut config: serde_json::Value = serde_json::from_slice(&std::fs::read(&path)?)?;
    config["in_channels"] = (1u64 << 62).into();
    std::fs::write(&path, config.to_string())?;
    let error = load_unet(folder.path(), DType::F32, &Device::Cpu);
    let message = error.expect_err("refused").to_string();
    let said = "in_channels = 4611686018427387904 does not fit the weights";
    assert!(message.contains(said), "{message}");
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
    for (class, family) in [
        ("StableDiffusionXLPipeline", "Stable Diffusion XL"),
        ("StableDiffusionXLInpaintPipeline", "Stable Diffusion XL"),
        ("StableDiffusion3Pipeline", "Stable Diffusion 3"),
        ("FluxPipeline", "Flux"),
    ] {
        let index = format!("{{\"_class_name\": \"{class}\"}}");
        std::fs::write(folder.path().join("model_index.json"), index)?;
        let message = load().expect_err(class).to_string();
        assert!(
            message.contains(&format!(
                "this is {family}; accepted: Stable Diffusion 1 and 2"
            )),
            "{message}"
        );
    }
    Ok(())
}
