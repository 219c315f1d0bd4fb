//! The small model that is part of the executables, for configurations that name no other.
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use anyhow::Context;
use dipir_pipeline::manifest::Artifact;
use dipir_pipeline::stage::StagePlan;
use serde_json::Value;
use tempfile::TempDir;

macro_rules! files {
    ($($name:literal)*) => {
        [$(($name, include_bytes!(concat!("../../../../data/prior/", $name)).as_slice())),*]
    };
}

/// Names within the model's folder, and contents.
const FILES: [(&str, &[u8]); 13] = files! {
    "light_encoder.safetensors"
    "model_index.json"
    "scheduler/scheduler_config.json"
    "text_encoder/config.json"
    "text_encoder/model.safetensors"
    "tokenizer/merges.txt"
    "tokenizer/special_tokens_map.json"
    "tokenizer/tokenizer_config.json"
    "tokenizer/vocab.json"
    "unet/config.json"
    "unet/diffusion_pytorch_model.safetensors"
    "vae/config.json"
    "README.md"
};

/// Adds its files to the plan of a stage, as `embedded/…`.
pub fn inputs(plan: &mut StagePlan) {
    // The content does not change while the process runs.
    static INPUTS: OnceLock<Vec<Artifact>> = OnceLock::new();
    let inputs = INPUTS.get_or_init(|| {
        let mut plan = StagePlan::new("model", 0, Value::Null, 0);
        for (name, content) in FILES {
            if name != "README.md" {
                plan.input_of_bytes("model", &Path::new("embedded").join(name), content);
            }
        }
        plan.inputs
    });
    plan.inputs.extend(inputs.iter().cloned());
}

/// The model as a folder, which lasts as long as what is returned.
pub fn unpack() -> anyhow::Result<TempDir> {
    let folder = tempfile::Builder::new()
        .prefix("dipir-model-")
        .tempdir()
        .context("cannot unpack the small model; set TMPDIR to a folder that can be written")?;
    for (name, content) in FILES {
        let path: PathBuf = folder.path().join(name);
        let failed = || format!("cannot unpack the small model to {}", path.display());
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).with_context(failed)?;
        }
        std::fs::write(&path, content).with_context(failed)?;
    }
    Ok(folder)
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};
    use dipir_diffusion::model::Model;

    use super::*;

    #[test]
    fn it_is_complete_and_gone_when_it_is_not_needed() {
        let folder = unpack().unwrap();
        let path = folder.path().to_owned();
        Model::load(&path, DType::F32, &Device::Cpu).unwrap();
        drop(folder);
        assert!(!path.exists());
    }

    #[test]
    fn every_file_of_the_repository_s_model_is_embedded() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/prior");
        let mut found = Vec::new();
        let mut folders = vec![root.clone()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                match path.is_dir() {
                    true => folders.push(path),
                    false => found.push(path.strip_prefix(&root).unwrap().to_owned()),
                }
            }
        }
        found.sort();
        let mut embedded: Vec<PathBuf> = FILES.iter().map(|(n, _)| n.into()).collect();
        embedded.sort();
        assert_eq!(found, embedded);
    }
}
