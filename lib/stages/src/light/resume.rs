//! Where an interrupted recovery goes on: its checkpoint and the previews it has kept.
use std::path::PathBuf;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_optimize::OptimizeError;
use dipir_optimize::checkpoint::State;
use dipir_optimize::parameters::Parameters;
use dipir_optimize::settings::Settings;
use dipir_pipeline::stage::StagePlan;
use serde_json::{Value, json};

use crate::model;

/// Tells one run from another, so that a checkpoint is found by the run that it belongs to alone.
pub(crate) fn fingerprint(plan: &StagePlan, settings: &Settings) -> anyhow::Result<String> {
    run_fingerprint(plan, &serde_json::to_value(settings)?)
}

/// As [`fingerprint`], for settings of any kind.
pub(crate) fn run_fingerprint(plan: &StagePlan, settings: &Value) -> anyhow::Result<String> {
    let all = json!([plan.version, plan.inputs, plan.params, settings]);
    let hash = blake3::hash(serde_json::to_string(&all)?.as_bytes());
    Ok(hash.to_hex()[..16].to_owned())
}

/// Where an interrupted run goes on: a folder beside the stage's own.
pub(crate) struct Resume {
    pub(crate) folder: PathBuf,
}

impl Resume {
    pub(crate) fn open(session: &Session, fingerprint: &str) -> anyhow::Result<Self> {
        let folder = session.out.join("light-checkpoints").join(fingerprint);
        model::create_folder(&folder.join("previews"))?;
        Ok(Self { folder })
    }

    pub(crate) fn checkpoint(&self) -> PathBuf {
        self.folder.join("checkpoint.safetensors")
    }

    pub(crate) fn preview(&self, iteration: usize) -> PathBuf {
        self.folder
            .join("previews")
            .join(format!("{iteration:06}.png"))
    }

    /// The iteration at which the checkpoint stands; 0 without one. A damaged one is removed.
    pub(crate) fn restored(
        &self,
        session: &Session,
        settings: &Settings,
        start: &Parameters,
    ) -> anyhow::Result<usize> {
        let path = self.checkpoint();
        let read = State::read(&path, settings, start);
        self.resumed_at(session, read.map(|s| s.map(|s| s.iteration)))
    }

    /// The iteration of a checkpoint that was read. A damaged one is removed.
    pub(crate) fn resumed_at(
        &self,
        session: &Session,
        read: Result<Option<usize>, OptimizeError>,
    ) -> anyhow::Result<usize> {
        match read {
            Ok(None) => Ok(0),
            Ok(Some(iteration)) => {
                session.remark(|| format!("continuing with iteration {iteration}"));
                Ok(iteration)
            }
            Err(e) => {
                session.warn(&format!("{e}; starting from the beginning"));
                let path = self.checkpoint();
                std::fs::remove_file(&path)
                    .with_context(|| format!("cannot remove {}", path.display()))?;
                Ok(0)
            }
        }
    }

    /// Names of the pictures that were kept, in the order of their iterations.
    pub(crate) fn previews(&self) -> anyhow::Result<Vec<String>> {
        let folder = self.folder.join("previews");
        let failed = || format!("cannot read {}", folder.display());
        let mut names = Vec::new();
        for entry in std::fs::read_dir(&folder).with_context(failed)? {
            let name = entry.with_context(failed)?.file_name();
            names.push(name.to_string_lossy().into_owned());
        }
        names.sort();
        Ok(names)
    }

    pub(crate) fn remove(&self) {
        let _ = std::fs::remove_dir_all(&self.folder);
        // Only if nothing else is in it.
        let _ = self.folder.parent().map(std::fs::remove_dir);
    }
}
