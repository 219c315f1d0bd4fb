//! Model folders: what is read, and hostile files, each refused with the tensor or key that is wrong.
mod adapters;
mod configurations;
mod exports;
mod pixels;
mod text;
mod weights;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::Error;
use dipir_diffusion::weights::{Weights, write_safetensors};

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn family() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/references/sd15")
}

fn tensors(path: &Path) -> Result<BTreeMap<String, Tensor>, Error> {
    let weights = Weights::open_file(path)?;
    let names: Vec<String> = weights.names().map(str::to_owned).collect();
    let mut tensors = BTreeMap::new();
    for name in names {
        if let Some(tensor) = weights.tensor(&name, DType::F32, &Device::Cpu)? {
            tensors.insert(name, tensor);
        }
    }
    Ok(tensors)
}

/// A copy of the reference's whole folder.
fn model_folder() -> Result<tempfile::TempDir, Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    std::fs::write(folder.path().join("model_index.json"), "{}")?;
    for part in ["unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
        std::fs::create_dir(folder.path().join(part))?;
        for entry in std::fs::read_dir(family().join(part))? {
            let entry = entry?;
            std::fs::copy(
                entry.path(),
                folder.path().join(part).join(entry.file_name()),
            )?;
        }
    }
    Ok(folder)
}

/// A UNet folder with the reference's configuration and these tensors.
fn unet_folder(
    tensors: &BTreeMap<String, Tensor>,
) -> Result<tempfile::TempDir, Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    std::fs::copy(
        family().join("unet/config.json"),
        folder.path().join("config.json"),
    )?;
    write_safetensors(
        &folder.path().join("diffusion_pytorch_model.safetensors"),
        tensors,
        &BTreeMap::new(),
    )?;
    Ok(folder)
}

fn unet_tensors() -> Result<BTreeMap<String, Tensor>, Error> {
    tensors(&family().join("unet/diffusion_pytorch_model.safetensors"))
}
