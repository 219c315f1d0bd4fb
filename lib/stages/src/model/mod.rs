//! The diffusion model of the `[model]` table.
mod embedded;
pub mod forecast;

use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Device};
use dipir_cli::exit::Usage;
use dipir_cli::session::Session;
use dipir_diffusion::model::Model;
use dipir_diffusion::schedule::Prediction;
use dipir_diffusion::weights::weight_files;
use dipir_pipeline::error::ConfigError;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::stage::StagePlan;
use dipir_prior::encoder;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tempfile::TempDir;

/// The `[model]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ModelTable {
    /// A diffusion model: a folder in the layout of diffusers, or one `.safetensors` file of Stable Diffusion 1 or 2 in the
    /// original layout.
    #[schemars(extend("format" = "path"), extend("x-default" = "the embedded model"), example = &"models/sd15")]
    pub path: Option<PathBuf>,
    /// Numbers that the model computes with. `bf16` halves the memory of its weights; it is faster on GPUs and on processors with tiles
    /// (AMX). `f16` needs a GPU.
    #[schemars(extend("enum" = ["f32", "bf16", "f16"]), example = &"bf16")]
    pub precision: String,
    /// What its UNet predicts, whatever the model's files say.
    #[schemars(extend("enum" = ["epsilon", "v_prediction"]), extend("x-default" = "what a folder's `scheduler_config.json`, a file's header or a `.yaml` beside it says; `epsilon` for Stable Diffusion 1"), example = &"v_prediction")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prediction: Option<String>,
}

impl Default for ModelTable {
    fn default() -> Self {
        Self {
            path: None,
            precision: "f32".into(),
            prediction: None,
        }
    }
}

impl ModelTable {
    /// Whether the model reads light off photographs.
    pub fn knows_light(&self, session: &Session) -> bool {
        self.path
            .as_ref()
            .is_none_or(|path| session.resolve(path).join(encoder::FILE).is_file())
    }

    /// The model as errors call it.
    pub fn name(&self) -> String {
        self.path.as_ref().map_or("the embedded model".into(), |p| {
            format!("model.path = \"{}\"", p.display())
        })
    }
}

/// A model and the folder that it lies in.
pub struct Loaded {
    model: Model,
    /// Of the embedded model.
    _unpacked: Option<TempDir>,
}

impl Deref for Loaded {
    type Target = Model;

    fn deref(&self) -> &Model {
        &self.model
    }
}

impl DerefMut for Loaded {
    fn deref_mut(&mut self) -> &mut Model {
        &mut self.model
    }
}

/// Loads the model onto the session's device.
pub fn load(session: &Session, table: &ModelTable) -> anyhow::Result<Loaded> {
    let placed = device(&session.pipeline.device, "pipeline.device = ")?;
    if let Some(why) = &placed.fallback {
        session.warn(why);
    }
    let dtype = precision(&table.precision)
        .map_err(|message| session.config.invalid("model.precision", message))?;
    let prediction = table.prediction.as_deref().map(prediction).transpose();
    let prediction = prediction.map_err(|m| session.config.invalid("model.prediction", m))?;
    let path = table.path.as_ref().map(|path| session.resolve(path));
    open(path.as_deref(), dtype, prediction, &placed.device)
        .with_context(|| format!("cannot use {}", table.name()))
}

/// Warns where the model's scheduler asks for pictures that are sampled otherwise than here.
pub(crate) fn warn_of_sampler(session: &Session, model: &Model) {
    if let Some(warning) = sampler_warning(model.schedule.unused()) {
        session.warn(&warning);
    }
}

fn sampler_warning(unused: &[String]) -> Option<String> {
    (!unused.is_empty()).then(|| {
        format!(
            "{} of the model's scheduler_config.json: not used; pictures are sampled by DPM-Solver++(2M) at the schedule's \
             own timesteps",
            unused.join(", ")
        )
    })
}

/// Refuses more denoising steps in `key` than the model has timesteps.
pub(crate) fn check_steps(
    session: &Session,
    model: &Model,
    key: &str,
    steps: usize,
) -> Result<(), ConfigError> {
    let most = model.schedule.len();
    match steps <= most {
        true => Ok(()),
        false => {
            let accepted = format!("up to {most}, the model's timesteps");
            Err(session.config.out_of_range(key, steps, &accepted))
        }
    }
}

/// Loads the model at `path`, a folder or one file, or the embedded one.
pub fn open(
    path: Option<&Path>,
    dtype: DType,
    prediction: Option<Prediction>,
    device: &Device,
) -> anyhow::Result<Loaded> {
    dipir_diffusion::memory::keep_freed();
    let (path, unpacked) = match path {
        Some(path) => (path.to_owned(), None),
        None => {
            let unpacked = embedded::unpack()?;
            (unpacked.path().to_owned(), Some(unpacked))
        }
    };
    let one_file = path.is_file() || path.extension().is_some_and(|e| e == "safetensors");
    let model = match one_file {
        true => Model::load_file(&path, prediction, dtype, device)?,
        false => Model::load_as(&path, prediction, dtype, device)?,
    };
    Ok(Loaded {
        model,
        _unpacked: unpacked,
    })
}

/// The precision that a word of the configuration names.
pub fn precision(word: &str) -> Result<DType, String> {
    match word {
        "f32" => Ok(DType::F32),
        "bf16" => Ok(DType::BF16),
        "f16" => Ok(DType::F16),
        other => Err(format!(
            "\"{other}\" is no precision; accepted: f32, bf16, f16"
        )),
    }
}

/// What a UNet predicts, as a word of the configuration names it.
pub fn prediction(word: &str) -> Result<Prediction, String> {
    match word {
        "epsilon" => Ok(Prediction::Epsilon),
        "v_prediction" => Ok(Prediction::Velocity),
        other => Err(format!(
            "\"{other}\" is no prediction; accepted: epsilon, v_prediction"
        )),
    }
}

/// A device, and why it is not the one that `auto` prefers.
pub struct Placed {
    /// Where models are computed.
    pub device: Device,
    /// One line, if `auto` found no GPU.
    pub fallback: Option<String>,
}

/// The device that `name` stands for: `cpu`, `cuda:N`, `metal:N`, or `auto`, which is the first GPU of NVIDIA if there is one.
/// `asked` is what stands before the name in messages.
pub fn device(name: &str, asked: &str) -> anyhow::Result<Placed> {
    let placed = |device| Placed {
        device,
        fallback: None,
    };
    match name.split_once(':') {
        None if name == "cpu" => Ok(placed(Device::Cpu)),
        None if name == "auto" => Ok(match gpu(0) {
            Ok(device) => placed(device),
            Err(why) => Placed {
                device: Device::Cpu,
                fallback: Some(format!("{asked}\"auto\": {why}, so the CPU computes")),
            },
        }),
        Some(("cuda", number)) if number.parse::<usize>().is_ok() => {
            let device = gpu(number.parse()?).map_err(|why| {
                Usage(format!(
                    "{asked}\"{name}\": {why}; use \"cpu\", or \"auto\" for a GPU where there is one"
                ))
            })?;
            Ok(placed(device))
        }
        Some(("metal", number)) if number.parse::<usize>().is_ok() => {
            let device = apple_gpu(number.parse()?)
                .map_err(|why| Usage(format!("{asked}\"{name}\": {why}; use \"cpu\"")))?;
            Ok(placed(device))
        }
        _ => {
            let message = format!("{asked}\"{name}\"; accepted: cpu, cuda:N, metal:N, auto");
            Err(Usage(message).into())
        }
    }
}

/// The N-th GPU, or why it cannot be used.
fn gpu(number: usize) -> Result<Device, String> {
    if !candle_core::utils::cuda_is_available() {
        return Err("this build has no CUDA (it was built without --features cuda)".into());
    }
    // Where the driver's library is missing, what looks for it panics.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let found = std::panic::catch_unwind(|| Device::new_cuda(number));
    std::panic::set_hook(hook);
    match found {
        Ok(Ok(device)) => Ok(device),
        Ok(Err(e)) => Err(format!("GPU {number} cannot be used ({e})")),
        Err(_) => Err("no NVIDIA driver was found (libcuda.so)".into()),
    }
}

/// The N-th GPU of Apple, or why it cannot be used.
fn apple_gpu(number: usize) -> Result<Device, String> {
    if !candle_core::utils::metal_is_available() {
        return Err("this build has no Metal (it was built without --features metal)".into());
    }
    Device::new_metal(number).map_err(|e| format!("GPU {number} cannot be used ({e})"))
}

/// Adds every file of the model to the plan of a stage.
pub fn inputs(session: &Session, table: &ModelTable, plan: &mut StagePlan) -> anyhow::Result<()> {
    if let (Some(prediction), Some(params)) = (&table.prediction, plan.params.as_object_mut()) {
        params.insert("prediction".into(), prediction.clone().into());
    }
    match &table.path {
        Some(path) => files(path, &session.resolve(path), plan),
        None => {
            embedded::inputs(plan);
            Ok(())
        }
    }
}

/// Adds the files of the model in `folder`, which the configuration calls `path`.
fn files(path: &Path, folder: &Path, plan: &mut StagePlan) -> anyhow::Result<()> {
    if folder.is_file() {
        plan.input("model", path, folder)?;
        // It may say what the model predicts.
        let beside = folder.with_extension("yaml");
        if beside.is_file() {
            plan.input("model", &path.with_extension("yaml"), &beside)?;
        }
        return Ok(());
    }
    // What stands beside these is as large, and changes nothing: another precision, the model as one file.
    let diffusers = "diffusion_pytorch_model";
    for (part, stem) in [
        ("", None),
        ("unet", Some(diffusers)),
        ("vae", Some(diffusers)),
        ("text_encoder", Some("model")),
        ("tokenizer", None),
        ("scheduler", None),
    ] {
        let weights = match stem {
            Some(stem) => weight_files(&folder.join(part), stem),
            None => [encoder::FILE.to_owned()].into(),
        };
        let mut names: Vec<PathBuf> = match std::fs::read_dir(folder.join(part)) {
            Ok(entries) => entries
                .filter_map(|e| e.ok().map(|e| PathBuf::from(e.file_name())))
                .collect(),
            Err(_) => continue, // loading says what is missing
        };
        names.sort();
        for name in names {
            let is_text = name.extension().is_some_and(|e| e == "json" || e == "txt");
            let used = is_text || weights.contains(name.to_string_lossy().as_ref());
            let location = folder.join(part).join(&name);
            if used && location.is_file() {
                plan.input("model", &path.join(part).join(&name), &location)?;
            }
        }
    }
    Ok(())
}

/// One hash of all files of the model in `folder`, or of the embedded one.
pub fn digest(folder: Option<&Path>) -> anyhow::Result<String> {
    let mut plan = StagePlan::new("model", 0, Value::Null, 0);
    match folder {
        Some(folder) => files(Path::new(""), folder, &mut plan)?,
        None => embedded::inputs(&mut plan),
    }
    let fingerprint = Fingerprint::of("model").inputs(&plan.inputs).finish();
    Ok(fingerprint.as_str().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_that_are_not_read_change_no_stage() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let write = |name: &str, text: &str| -> anyhow::Result<()> {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().context("a folder")?)?;
            Ok(std::fs::write(path, text)?)
        };
        write("model_index.json", "{}")?;
        write(
            "unet/diffusion_pytorch_model.safetensors.index.json",
            r#"{"weight_map": {"a": "1.safetensors", "b": "2.safetensors"}}"#,
        )?;
        write("unet/1.safetensors", "1")?;
        write("unet/2.safetensors", "2")?;
        write("vae/diffusion_pytorch_model.safetensors", "vae")?;
        write("text_encoder/model.fp16.safetensors", "text")?;
        let digest = || digest(Some(folder.path()));
        let before = digest()?;
        for name in [
            "v1-5-pruned.safetensors",
            "unet/diffusion_pytorch_model.fp16.safetensors",
            "unet/diffusion_pytorch_model.non_ema.safetensors",
            "text_encoder/pytorch_model.safetensors",
        ] {
            write(name, "another")?;
            assert_eq!(digest()?, before, "{name}");
        }
        for name in [
            encoder::FILE,
            "unet/2.safetensors",
            "vae/diffusion_pytorch_model.safetensors",
            "text_encoder/model.fp16.safetensors",
            // Is read before the variant.
            "text_encoder/model.safetensors",
        ] {
            let before = digest()?;
            write(name, name)?;
            assert_ne!(digest()?, before, "{name}");
        }
        Ok(())
    }

    #[test]
    fn a_scheduler_s_settings_that_nothing_heeds_are_warned_of() {
        assert_eq!(sampler_warning(&[]), None);
        let warning = sampler_warning(&["use_karras_sigmas".into(), "thresholding".into()]);
        let warning = warning.expect("a warning");
        for part in ["use_karras_sigmas, thresholding of", "DPM-Solver++(2M)"] {
            assert!(warning.contains(part), "{warning}");
        }
    }
}
