//! Finished adapters that scenes share: what a run wrote, in a folder named by everything that decides it, under a seal of
//! hashes that is written last.
use std::fs;
use std::path::{Component, Path, PathBuf};

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::{Manifest, hash_file};
use dipir_pipeline::mark::Kind;
use dipir_pipeline::resume::Resume;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use serde::{Deserialize, Serialize};

use crate::names::LORA;

/// The files that the cache holds.
const FILES: [&str; 8] = [
    "lora.safetensors",
    "lora_kohya.safetensors",
    "word.safetensors",
    "training.json",
    "training.csv",
    "sheet.png",
    "samples/#.png",
    SEAL,
];
const SEAL: &str = "seal.json";

/// A file of a finished run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Sealed {
    role: String,
    name: PathBuf,
    blake3: String,
}

/// Whether a name stays in the folder that it is joined to. A seal can come from anybody who shares the cache.
fn is_inside(name: &Path) -> bool {
    name.components()
        .all(|part| matches!(part, Component::Normal(_)))
        && name.file_name().is_some()
}

/// The place of one run among the finished ones.
pub(super) struct Cache {
    kept: Resume,
}

impl Cache {
    /// The place in `folder` of the planned run.
    pub(super) fn open(session: &Session, folder: &Path, plan: &StagePlan) -> anyhow::Result<Self> {
        let root = session.resolve(folder);
        let fingerprint = Fingerprint::of_plan(plan).finish();
        let kept = Resume::open(&root, Kind::Cache, LORA.name, &fingerprint, &FILES)?;
        Ok(Self { kept })
    }

    /// Copies what is there into the stage's folder, if all of it is there with the hashes that were noted.
    pub(super) fn restore(&self, writer: &mut StageWriter) -> anyhow::Result<bool> {
        let Some(files) = self.whole() else {
            return Ok(false);
        };
        for file in files {
            let (from, to) = (
                self.kept.file(&file.name),
                writer.output(&file.role, &file.name)?,
            );
            fs::copy(&from, &to).with_context(|| format!("cannot copy {}", from.display()))?;
        }
        Ok(true)
    }

    fn whole(&self) -> Option<Vec<Sealed>> {
        let seal = fs::read(self.kept.file(SEAL)).ok()?;
        let files: Vec<Sealed> = serde_json::from_slice(&seal).ok()?;
        let is_whole = |file: &Sealed| {
            let hash = || hash_file(&self.kept.file(&file.name)).ok();
            is_inside(&file.name) && hash().is_some_and(|(_, hash)| hash == file.blake3)
        };
        (!files.is_empty() && files.iter().all(is_whole)).then_some(files)
    }

    /// Keeps what a run wrote into `folder`.
    pub(super) fn keep(&self, folder: &Path, manifest: &Manifest) -> anyhow::Result<()> {
        let mut files = vec![];
        for output in &manifest.outputs {
            let from = folder.join(&output.path);
            self.put(&output.path, |to| fs::copy(&from, to).map(|_| ()))?;
            files.push(Sealed {
                role: output.role.clone(),
                name: output.path.clone(),
                blake3: output.blake3.clone(),
            });
        }
        let seal = serde_json::to_vec_pretty(&files)?;
        self.put(Path::new(SEAL), |to| fs::write(to, &seal))
    }

    fn put(
        &self,
        name: &Path,
        write: impl FnOnce(&Path) -> std::io::Result<()>,
    ) -> anyhow::Result<()> {
        let path = self.kept.file(name);
        let name = name.to_str().context("a file's name is not UTF-8")?;
        self.kept.put(name, |own| {
            write(own).with_context(|| format!("cannot write {}", path.display()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_a_seal_do_not_lead_out_of_its_folder() {
        for name in ["lora.safetensors", "samples/0001.png"] {
            assert!(is_inside(Path::new(name)), "{name}");
        }
        for name in [
            "",
            "..",
            "/etc/passwd",
            "a/../../x",
            "../x",
            "samples/..",
            "./..",
        ] {
            assert!(!is_inside(Path::new(name)), "{name}");
        }
    }
}
