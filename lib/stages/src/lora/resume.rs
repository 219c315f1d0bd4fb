//! Where an interrupted training goes on: its checkpoint, its history and the samples on the way.
use std::path::PathBuf;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_diffusion::training::LoraTrainer;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::mark::Kind;
use dipir_pipeline::resume;

use super::history::History;
use crate::names::LORA;

/// The files of a run: the checkpoint, the losses so far, and samples, each with the name under
/// which it is written.
const FILES: [&str; 6] = [
    "checkpoint.safetensors",
    "checkpoint.partial",
    "history.json",
    "history.partial",
    "sample-#.png",
    "sample-#.partial.png",
];

/// Where an interrupted run goes on.
pub(super) struct Resume {
    kept: resume::Resume,
}

impl Resume {
    pub(super) fn open(session: &Session, fingerprint: &Fingerprint) -> anyhow::Result<Self> {
        let root = session.out.join("lora-checkpoints");
        let kind = Kind::Checkpoints;
        let kept = resume::Resume::open(&root, kind, LORA.name, fingerprint, &FILES)?;
        Ok(Self { kept })
    }

    /// Where the sample after an update is kept until the end.
    pub(super) fn sample(&self, step: usize) -> PathBuf {
        self.kept.file(format!("sample-{step:06}.png"))
    }

    /// Loads the last checkpoint, if there is a usable one; returns its history.
    pub(super) fn restore(
        &self,
        session: &Session,
        trainer: &mut LoraTrainer,
        steps: usize,
    ) -> History {
        let path = self.kept.file("checkpoint.safetensors");
        let history = std::fs::read(self.kept.file("history.json"))
            .ok()
            .and_then(|text| serde_json::from_slice::<History>(&text).ok())
            .unwrap_or_default();
        if !path.is_file() {
            return History::default();
        }
        let usable = trainer
            .resume(&path)
            .map_err(anyhow::Error::from)
            .and_then(|()| {
                anyhow::ensure!(
                    trainer.steps() <= steps,
                    "it has {} updates, {steps} are wanted",
                    trainer.steps()
                );
                anyhow::ensure!(
                    history.updates.len() >= trainer.steps(),
                    "its history is incomplete"
                );
                Ok(())
            });
        match usable {
            Ok(()) => history.up_to(trainer.steps()),
            Err(e) => {
                session.warn(&format!("{} is not used: {e}", path.display()));
                if trainer.steps() > 0 {
                    let _ = trainer.reset();
                }
                History::default()
            }
        }
    }

    /// Writes the history, then the checkpoint, so that the history is never the shorter one.
    pub(super) fn save(&self, trainer: &LoraTrainer, history: &History) -> anyhow::Result<()> {
        let path = self.kept.file("history.json");
        let partial = self.kept.file("history.partial");
        std::fs::write(&partial, serde_json::to_vec(history)?)
            .and_then(|()| std::fs::rename(&partial, &path))
            .with_context(|| format!("cannot write {}", path.display()))?;
        trainer.save_checkpoint(&self.kept.file("checkpoint.safetensors"))?;
        Ok(())
    }

    pub(super) fn remove(&self) {
        self.kept.remove();
    }
}
