//! The diffusion model of the `[model]` table.
mod embedded;

use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Device};
use dipir_cli::exit::Usage;
use dipir_cli::session::Session;
use dipir_diffusion::model::Model;
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
    /// Folder of a diffusion model in the diffusers layout.
    #[schemars(extend("format" = "path"), extend("x-default" = "the embedded model"), example = &"models/sd15")]
    pub path: Option<PathBuf>,
    /// Numbers that the model computes with; `bf16` and `f16` need a GPU.
    #[schemars(extend("enum" = ["f32", "bf16", "f16"]), example = &"bf16")]
    pub precision: String,
}

impl Default for ModelTable {
    fn default() -> Self {
        Self {
            path: None,
            precision: "f32".into(),
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
    let device = device(&session.pipeline.device)?;
    let dtype = match table.precision.as_str() {
        "f32" => DType::F32,
        "bf16" => DType::BF16,
        "f16" => DType::F16,
        other => {
            let message = format!("\"{other}\" is no precision; accepted: f32, bf16, f16");
            return Err(session.config.invalid("model.precision", message).into());
        }
    };
    dipir_diffusion::memory::keep_freed();
    let (folder, unpacked) = match &table.path {
        Some(path) => (session.resolve(path), None),
        None => {
            let unpacked = embedded::unpack()?;
            (unpacked.path().to_owned(), Some(unpacked))
        }
    };
    let model = Model::load(&folder, dtype, &device)
        .with_context(|| format!("cannot use {}", table.name()))?;
    Ok(Loaded {
        model,
        _unpacked: unpacked,
    })
}

fn device(name: &str) -> anyhow::Result<Device> {
    match name.split_once(':') {
        None if name == "cpu" => Ok(Device::Cpu),
        None if name == "auto" => Ok(if candle_core::utils::cuda_is_available() {
            Device::new_cuda(0)?
        } else {
            Device::Cpu
        }),
        Some(("cuda", number)) if number.parse::<usize>().is_ok() => {
            if !candle_core::utils::cuda_is_available() {
                let message = format!(
                    "pipeline.device = \"{name}\": this build has no CUDA; use \"cpu\", or build with --features cuda"
                );
                return Err(Usage(message).into());
            }
            Ok(Device::new_cuda(number.parse()?)?)
        }
        _ => {
            let message = format!("pipeline.device = \"{name}\"; accepted: cpu, cuda:N, auto");
            Err(Usage(message).into())
        }
    }
}

/// Adds every file of the model to the plan of a stage.
pub fn inputs(session: &Session, table: &ModelTable, plan: &mut StagePlan) -> anyhow::Result<()> {
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
    for part in ["", "unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
        let mut names: Vec<PathBuf> = match std::fs::read_dir(folder.join(part)) {
            Ok(entries) => entries
                .filter_map(|e| e.ok().map(|e| PathBuf::from(e.file_name())))
                .collect(),
            Err(_) => continue, // loading says what is missing
        };
        names.sort();
        for name in names {
            let used = name
                .extension()
                .is_some_and(|e| e == "json" || e == "safetensors" || e == "txt");
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
