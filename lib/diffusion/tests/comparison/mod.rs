//! Compares a model folder with the reference results that lie in it, made by
//! tests/references/make.py with diffusers, transformers and peft.

use std::path::Path;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::lora::{Lora, LoraStyle};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::recompute::Recompute;
use dipir_diffusion::vae::Vae;
use dipir_diffusion::weights::Weights;

/// Errors of any kind: the tests print them, the example too.
pub type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

/// max |a - b| / max |b|.
pub fn relative_error(a: &Tensor, b: &Tensor) -> Outcome<f64> {
    if a.dims() != b.dims() {
        return Err(format!("shapes {:?} and {:?} differ", a.dims(), b.dims()).into());
    }
    let max = |t: &Tensor| -> Outcome<f64> {
        Ok(t.to_dtype(DType::F64)?
            .abs()?
            .max_all()?
            .to_scalar::<f64>()?)
    };
    let error = max(&(a - b)?)? / max(b)?.max(1e-30);
    if error.is_nan() {
        Err("not a number".into())
    } else {
        Ok(error)
    }
}

/// The reference results of a folder.
pub struct Expected(Weights);

impl Expected {
    pub fn open(path: &Path) -> Outcome<Self> {
        Ok(Self(Weights::open_file(path)?))
    }

    pub fn get(&self, name: &str) -> Outcome<Tensor> {
        self.0
            .tensor(name, DType::F32, &Device::Cpu)?
            .ok_or_else(|| format!("no {name} in the references").into())
    }

    pub fn names(&self) -> Vec<String> {
        self.0.names().map(str::to_owned).collect()
    }
}

/// Relative error by what was compared.
pub type Errors = Vec<(String, f64)>;

/// Token sequences that differ from the reference.
pub fn tokenizer(folder: &Path, model: &Model) -> Outcome<Vec<String>> {
    let cases: Vec<serde_json::Value> =
        serde_json::from_slice(&std::fs::read(folder.join("tokens.json"))?)?;
    let mut wrong = vec![];
    for case in &cases {
        let prompt = case["prompt"].as_str().ok_or("prompt")?;
        let ids: Vec<u32> = serde_json::from_value(case["ids"].clone())?;
        let found = model.tokenizer.encode(prompt)?;
        if found != ids {
            wrong.push(format!(
                "{:.60?}: {:?} instead of {:?}",
                prompt,
                &found[..20],
                &ids[..20]
            ));
        }
    }
    Ok(wrong)
}

pub fn text_encoder(folder: &Path, model: &Model, expected: &Expected) -> Outcome<Errors> {
    let cases: Vec<serde_json::Value> =
        serde_json::from_slice(&std::fs::read(folder.join("tokens.json"))?)?;
    let ids = cases[1..3]
        .iter()
        .map(|c| serde_json::from_value(c["ids"].clone()))
        .collect::<Result<Vec<_>, _>>()?;
    let states = model.text_encoder.forward(&ids, None)?;
    Ok(vec![(
        "text states".into(),
        relative_error(&states, &expected.get("text_states")?)?,
    )])
}

pub fn vae(model: &Model, expected: &Expected) -> Outcome<Errors> {
    let Vae::Kl(vae) = &model.vae else {
        return Err("no AutoencoderKL".into());
    };
    let image = Var::from_tensor(&expected.get("image")?)?;
    let moments = vae.encode(&image)?;
    let probe = expected.get("probe")?;
    let gradients = (&moments.mean * &probe)?.sum_all()?.backward()?;
    let gradient = gradients.get(&image).ok_or("no gradient at the image")?;
    // The same with the encoder's inner values recomputed.
    let at_latents = (&probe / vae.config().scaling_factor)?;
    let again = model.vae.trace(&image)?.gradient(&at_latents)?;
    let wanted = expected.get("vae_image_grad")?;
    Ok(vec![
        (
            "vae mean".into(),
            relative_error(&moments.mean, &expected.get("vae_mean")?)?,
        ),
        (
            "vae log variance".into(),
            relative_error(&moments.log_variance, &expected.get("vae_logvar")?)?,
        ),
        (
            "vae image gradient".into(),
            relative_error(gradient, &wanted)?,
        ),
        (
            "vae image gradient, recomputed".into(),
            relative_error(&again, &wanted)?,
        ),
        (
            "vae decoded".into(),
            relative_error(
                &vae.decode(&expected.get("z")?)?,
                &expected.get("vae_decoded")?,
            )?,
        ),
    ])
}

fn timesteps(expected: &Expected) -> Outcome<Vec<f64>> {
    Ok(expected
        .get("timesteps")?
        .to_vec1::<f32>()?
        .into_iter()
        .map(f64::from)
        .collect())
}

pub fn unet(model: &Model, expected: &Expected) -> Outcome<Errors> {
    let (sample, context) = (expected.get("sample")?, expected.get("context")?);
    let t = timesteps(expected)?;
    let output = model
        .unet
        .forward(&sample, &t, &context, &Pass::default())?;
    let odd = expected.get("odd_sample")?;
    let odd_output =
        model
            .unet
            .forward(&odd, &[400.0], &context.narrow(0, 0, 1)?, &Pass::default())?;
    Ok(vec![
        (
            "unet".into(),
            relative_error(&output, &expected.get("unet_output")?)?,
        ),
        (
            "unet, odd size".into(),
            relative_error(&odd_output, &expected.get("odd_output")?)?,
        ),
    ])
}

/// Loads both files, compares prediction, loss and every gradient, with and
/// without recomputation.
pub fn lora(
    folder: &Path,
    model: &Model,
    expected: &Expected,
    recompute_only: bool,
) -> Outcome<Errors> {
    let targets = model.unet.adapter_targets();
    let (sample, context, noise) = (
        expected.get("sample")?,
        expected.get("context")?,
        expected.get("noise")?,
    );
    let t = timesteps(expected)?;
    let mut errors = vec![];
    let load = |name: &str| Lora::load(&folder.join(name), &targets, DType::F32, &Device::Cpu);
    for name in ["lora_peft.safetensors", "lora_kohya.safetensors"] {
        let pass = Pass::with_lora(&Arc::new(load(name)?));
        let output = model.unet.forward(&sample, &t, &context, &pass)?;
        errors.push((
            name.into(),
            relative_error(&output, &expected.get("lora_output")?)?,
        ));
    }
    let frozen = load("lora_peft.safetensors")?;
    let mut lora = Lora::default();
    for (name, adapter) in frozen.adapters() {
        lora.insert(name, adapter.down(), adapter.up(), adapter.alpha())?;
    }
    let variables: Vec<Var> = lora.variables().values().cloned().collect();
    let lora = Arc::new(lora);
    for recompute in [Some(Recompute::new(variables)), None] {
        if recompute_only && recompute.is_none() {
            continue;
        }
        let how = if recompute.is_some() {
            ", recomputed"
        } else {
            ""
        };
        let pass = Pass {
            recompute: recompute.clone(),
            ..Pass::with_lora(&lora)
        };
        let output = model.unet.forward(&sample, &t, &context, &pass)?;
        let loss = (output - &noise)?.sqr()?.mean_all()?;
        errors.push((
            format!("lora loss{how}"),
            relative_error(&loss.reshape(1)?, &expected.get("lora_loss")?)?,
        ));
        let mut gradients = loss.backward()?;
        if let Some(recompute) = &recompute {
            recompute.drain_into(&mut gradients)?;
        }
        let mut compared = 0;
        for (name, variable) in lora.variables() {
            let gradient = gradients
                .get(variable)
                .ok_or_else(|| format!("{name} got no gradient"))?;
            let key = format!("grad.{name}.weight");
            if expected.names().contains(&key) {
                errors.push((
                    format!("{key}{how}"),
                    relative_error(gradient, &expected.get(&key)?)?,
                ));
                compared += 1;
            }
        }
        if compared == 0 {
            return Err("no gradient of the references was compared".into());
        }
    }
    // What is written here reads back as the same adapter.
    let scratch = tempfile::tempdir()?;
    for style in [LoraStyle::Peft, LoraStyle::Kohya] {
        let path = scratch.path().join("lora.safetensors");
        lora.save(&path, style, &Default::default())?;
        let again = Lora::load(&path, &targets, DType::F32, &Device::Cpu)?;
        for (name, adapter) in lora.adapters() {
            let other = again
                .adapter(name)
                .ok_or_else(|| format!("{style:?} file lost {name}"))?;
            if other.alpha() != adapter.alpha() {
                return Err(format!(
                    "{style:?} file: alpha {} became {}",
                    adapter.alpha(),
                    other.alpha()
                )
                .into());
            }
            errors.push((
                format!("{style:?} {name} up"),
                relative_error(other.up(), adapter.up())?,
            ));
            errors.push((
                format!("{style:?} {name} down"),
                relative_error(other.down(), adapter.down())?,
            ));
        }
    }
    Ok(errors)
}
