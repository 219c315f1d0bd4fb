//! A stage's folder: what `stage.json` says, and whether every file is as it was written.
use std::path::Path;

use anyhow::bail;
use dipir_cli::output::json_path;
use dipir_cli::session::{duration, size};
use dipir_pipeline::manifest::{FILE_NAME, Manifest};
use serde_json::json;

use crate::report::{Report, Table, number};

pub(crate) fn inspect(path: &Path) -> anyhow::Result<Report> {
    if !path.join(FILE_NAME).exists() {
        bail!(
            "{} holds no {FILE_NAME}, so it is not the folder of a finished stage; name one, as \
             in out/scene, or a single file",
            path.display()
        );
    }
    let manifest = Manifest::read(path, "its stage")?;
    let damages = manifest.damages(path)?;
    let mut table = Table::new(&["output", "file", ">size", "blake3", ""]);
    let mut outputs = Vec::new();
    for artifact in &manifest.outputs {
        let location = path.join(&artifact.path);
        let damage = damages.iter().find(|(p, _)| *p == location).map(|(_, d)| d);
        let state = damage.map_or("whole".to_string(), ToString::to_string);
        let hash = artifact.blake3.get(..12).unwrap_or(&artifact.blake3);
        table.row([
            artifact.role.clone(),
            artifact.path.display().to_string(),
            size(artifact.bytes),
            hash.into(),
            state,
        ]);
        let mut entry = serde_json::to_value(artifact)?;
        entry["whole"] = damage.is_none().into();
        outputs.push(entry);
    }
    let mut text = summary(&manifest);
    text.push_str(&table.render());
    let mut json = json!({"path": json_path(path), "kind": "stage", "whole": damages.is_empty()});
    json["manifest"] = serde_json::to_value(&manifest)?;
    json["manifest"]["outputs"] = outputs.into();
    Ok(Report {
        title: format!("{}: stage \"{}\"", path.display(), manifest.stage),
        text,
        json,
        problems: damages
            .iter()
            .map(|(location, damage)| {
                format!(
                    "{}: {damage}; run the stage \"{}\" again",
                    location.display(),
                    manifest.stage
                )
            })
            .collect(),
    })
}

/// Version, seed, device, time, memory, error, inputs.
pub(crate) fn summary(manifest: &Manifest) -> String {
    let mut text = format!(
        "  version {}, seed {}, on {}, {}",
        manifest.version,
        manifest.seed,
        manifest.device,
        duration(manifest.elapsed_s)
    );
    if let Some(bytes) = manifest.peak_rss_bytes {
        text.push_str(&format!(", at most {} of memory", size(bytes)));
    }
    if let Some(error) = manifest.estimated_error {
        text.push_str(&format!(", estimated error {}", number(error)));
    }
    text.push('\n');
    if !manifest.inputs.is_empty() {
        let mut table = Table::new(&["input", "file", ">size", "blake3"]);
        for artifact in &manifest.inputs {
            let hash = artifact.blake3.get(..12).unwrap_or(&artifact.blake3);
            table.row([
                artifact.role.clone(),
                artifact.path.display().to_string(),
                size(artifact.bytes),
                hash.into(),
            ]);
        }
        text.push_str(&table.render());
    }
    text
}
