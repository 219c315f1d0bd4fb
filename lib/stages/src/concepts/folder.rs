//! What the concepts stage leaves, for the LoRA stage and the report.
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Device, Tensor};
use dipir_cli::session::Session;
use dipir_diffusion::concepts::Concept;
use dipir_diffusion::weights::Weights;
use serde::{Deserialize, Serialize};

use crate::names::CONCEPTS;

/// One entry of `concepts.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConceptEntry {
    /// Relative to the stage's folder.
    pub image: PathBuf,
    /// What was asked for, and the key of its noise.
    #[serde(flatten)]
    pub concept: Concept,
}

/// `concepts.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConceptList {
    /// The class.
    pub class: String,
    /// The caption under which the images are trained.
    pub class_prompt: String,
    /// In the order of `latents.safetensors`.
    pub concepts: Vec<ConceptEntry>,
}

/// The concepts stage's folder, its files checked by hash.
pub struct ConceptsFolder {
    /// `concepts.json`.
    pub list: ConceptList,
    /// The file of latents.
    pub latents: PathBuf,
}

impl ConceptsFolder {
    /// Reads what the concepts stage wrote.
    pub fn read(session: &Session) -> anyhow::Result<Self> {
        let manifest = CONCEPTS.manifest(session)?;
        let folder = CONCEPTS.folder(session);
        let path = manifest.output(&folder, "concepts")?;
        let text = dipir_files::read_to_string(&path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let list = serde_json::from_str(&text).with_context(|| {
            format!(
                "{} was written by another version; run {} again",
                path.display(),
                CONCEPTS.executable
            )
        })?;
        let latents = manifest.output(&folder, "latents")?;
        Ok(Self { list, latents })
    }
}

/// The tensor `latents` of a file of this stage.
pub fn read_latents(path: &Path) -> anyhow::Result<Tensor> {
    Weights::open_file(path)?
        .tensor("latents", DType::F32, &Device::Cpu)?
        .with_context(|| {
            format!(
                "{} holds no tensor \"latents\"; delete it and run {} again",
                path.display(),
                CONCEPTS.executable
            )
        })
}
