//! The model that an adapter belongs to.
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::Artifact;
use dipir_pipeline::stage::StagePlan;

use crate::scene::unnumbered;

/// The hash of the weights that are adapted: of the UNet's file, of all its shards, or of the one file of the model.
pub(super) fn base_hash(plan: &StagePlan) -> Option<String> {
    let name = |i: &Artifact| i.path.file_name().map(|n| n.to_string_lossy().into_owned());
    let model = plan
        .inputs
        .iter()
        .filter(|i| unnumbered(&i.role) == "model");
    let weights: Vec<&Artifact> = model
        .filter(|i| i.path.extension().is_some_and(|e| e == "safetensors"))
        .collect();
    let of_unet: Vec<&Artifact> = weights
        .iter()
        .filter(|i| {
            i.path
                .parent()
                .is_some_and(|folder| folder.ends_with("unet"))
        })
        .copied()
        .collect();
    if of_unet.is_empty() {
        return weights.first().map(|i| i.blake3.clone());
    }
    // In the order in which the model is looked for.
    for variant in ["", ".fp16", ".bf16"] {
        let whole = format!("diffusion_pytorch_model{variant}.safetensors");
        if let Some(file) = of_unet.iter().find(|i| name(i).as_deref() == Some(&whole)) {
            return Some(file.blake3.clone());
        }
    }
    let shards: Vec<Artifact> = of_unet.into_iter().cloned().collect();
    let together = Fingerprint::of("unet").inputs(&shards).finish();
    Some(together.as_str().to_owned())
}
