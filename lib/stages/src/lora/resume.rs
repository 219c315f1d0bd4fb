//! Where an interrupted training goes on: its checkpoint, its history and the samples on the way.
use std::path::PathBuf;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_diffusion::training::{LoraTrainer, StepReport};

use crate::model;

/// Where an interrupted run goes on.
pub(super) struct Resume {
    folder: PathBuf,
}

impl Resume {
    pub(super) fn open(session: &Session, fingerprint: &str) -> anyhow::Result<Self> {
        let folder = session
            .out
            .join("lora-checkpoints")
            .join(&fingerprint[..16]);
        model::create_folder(&folder)?;
        Ok(Self { folder })
    }

    /// Where the sample after an update is kept until the end.
    pub(super) fn sample(&self, step: usize) -> PathBuf {
        self.folder.join(format!("sample-{step:06}.png"))
    }

    /// Loads the last checkpoint, if there is a usable one; returns its history.
    pub(super) fn restore(
        &self,
        session: &Session,
        trainer: &mut LoraTrainer,
        steps: usize,
    ) -> Vec<StepReport> {
        let path = self.folder.join("checkpoint.safetensors");
        let history = std::fs::read(self.folder.join("history.json"))
            .ok()
            .and_then(|text| serde_json::from_slice::<Vec<StepReport>>(&text).ok())
            .unwrap_or_default();
        if !path.is_file() {
            return vec![];
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
                    history.len() >= trainer.steps(),
                    "its history is incomplete"
                );
                Ok(())
            });
        match usable {
            Ok(()) => history[..trainer.steps()].to_vec(),
            Err(e) => {
                session.warn(&format!("{} is not used: {e}", path.display()));
                if trainer.steps() > 0 {
                    let _ = trainer.reset();
                }
                vec![]
            }
        }
    }

    /// The history first: it may be longer than the checkpoint, never shorter.
    pub(super) fn save(&self, trainer: &LoraTrainer, history: &[StepReport]) -> anyhow::Result<()> {
        let path = self.folder.join("history.json");
        let partial = self.folder.join("history.partial");
        std::fs::write(&partial, serde_json::to_vec(history)?)
            .and_then(|()| std::fs::rename(&partial, &path))
            .with_context(|| format!("cannot write {}", path.display()))?;
        trainer.save_checkpoint(&self.folder.join("checkpoint.safetensors"))?;
        Ok(())
    }

    pub(super) fn remove(&self) {
        let _ = std::fs::remove_dir_all(&self.folder);
        // Only if nothing else is in it.
        let _ = self.folder.parent().map(std::fs::remove_dir);
    }
}
