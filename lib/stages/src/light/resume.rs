//! Where an interrupted recovery goes on: its checkpoint and the previews it has kept.
use std::path::PathBuf;

use dipir_cli::session::Session;
use dipir_optimize::OptimizeError;
use dipir_optimize::checkpoint::State;
use dipir_optimize::parameters::Parameters;
use dipir_optimize::settings::Settings;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::mark::Kind;
use dipir_pipeline::resume;
use dipir_pipeline::stage::StagePlan;
use serde_json::{Value, json};

use crate::names::LIGHT;

/// Name of the checkpoint's file.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// Folder of the previews.
const PREVIEWS: &str = "previews";

/// Identifies a run, so that only the run that wrote a checkpoint finds it.
pub(crate) fn fingerprint(plan: &StagePlan, settings: &Settings) -> anyhow::Result<Fingerprint> {
    run_fingerprint(plan, &serde_json::to_value(settings)?)
}

/// As [`fingerprint`], for settings of any kind.
pub(crate) fn run_fingerprint(plan: &StagePlan, settings: &Value) -> anyhow::Result<Fingerprint> {
    let params = json!({"params": plan.params, "settings": settings});
    Ok(Fingerprint::of_plan(plan).params(params).finish())
}

/// Where an interrupted run goes on: a folder beside the stage's own.
pub(crate) struct Resume {
    kept: resume::Resume,
}

impl Resume {
    pub(crate) fn open(session: &Session, fingerprint: &Fingerprint) -> anyhow::Result<Self> {
        let root = session.out.join("light-checkpoints");
        let files = [CHECKPOINT, "checkpoint.partial", "previews/#.png"];
        let kept = resume::Resume::open(&root, Kind::Checkpoints, LIGHT.name, fingerprint, &files)?;
        Ok(Self { kept })
    }

    pub(crate) fn checkpoint(&self) -> PathBuf {
        self.kept.file(CHECKPOINT)
    }

    pub(crate) fn preview(&self, iteration: usize) -> PathBuf {
        self.kept.file(format!("{PREVIEWS}/{iteration:06}.png"))
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

    /// The iteration of the checkpoint that was `read`, 0 without one. A damaged one is removed.
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
                self.kept.remove_file(CHECKPOINT)?;
                Ok(0)
            }
        }
    }

    /// Where a picture of a name from [`previews`](Self::previews) is.
    pub(crate) fn preview_named(&self, name: &str) -> PathBuf {
        self.kept.file(format!("{PREVIEWS}/{name}"))
    }

    /// Names of the pictures that were kept, in the order of their iterations.
    pub(crate) fn previews(&self) -> anyhow::Result<Vec<String>> {
        Ok(self.kept.files_in(PREVIEWS)?)
    }

    pub(crate) fn remove(&self) {
        self.kept.remove();
    }
}
