//! Training runs as `dipir-pretrain` starts them: from folders to folders.

use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device};
use dipir_diffusion::model::Model;
use dipir_diffusion::weights::Weights;
use dipir_prior::encoder;
use dipir_prior::picture::SIZE;
use dipir_prior::text_conditioning::add_placeholders;
use dipir_tensors::from_planes;

use crate::architecture::{Architecture, WEIGHT_FILES};
use crate::contact_sheet;
use crate::dataset::{Dataset, DatasetSettings, SceneMix};
use crate::encoder_training::{self, EncoderSettings, SAVED_EVERY};
use crate::error::{Result, io};
use crate::examples::Recipe;
use crate::scene::ObjectSet;
use crate::trainer::{Trainer, TrainerSettings, Update};

/// Columns of the contact sheet of a training's pictures.
const SHEET_COLUMNS: usize = 12;
/// Rows of it.
const SHEET_ROWS: usize = 8;

/// Traces those of `count` training scenes that the folder `cache` lacks. `progress` is called with the share that is done
/// and may stop the work; then the result is `None`.
pub fn scenes(
    cache: &Path,
    count: usize,
    mix: SceneMix,
    seed: u64,
    progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
) -> Result<Option<Dataset>> {
    let settings = DatasetSettings {
        seed,
        scenes: count,
        mix,
        objects: ObjectSet::Training,
    };
    Dataset::make(&cache.join("scenes"), &settings, &mut |done| {
        // The last file may hold more than are asked for.
        progress((done as f64 / count as f64).min(1.0))
    })
}

/// A model whose captions may describe light.
pub fn load_model(folder: &Path) -> Result<Model> {
    let mut model = Model::load(folder, DType::F32, &Device::Cpu)?;
    add_placeholders(&mut model.tokenizer);
    Ok(model)
}

/// A moving mean over about fifty values.
#[derive(Debug, Default)]
struct MovingMean(Option<f64>);

impl MovingMean {
    fn add(&mut self, value: f64) -> f64 {
        let mean = self.0.map_or(value, |mean| 0.98 * mean + 0.02 * value);
        self.0 = Some(mean);
        mean
    }
}

/// What a training run of the diffusion model needs.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelRunSettings {
    /// Folder of the model to be written.
    pub out: PathBuf,
    /// Folder of scenes and checkpoint.
    pub cache: PathBuf,
    /// Model folder whose weights a new run starts from.
    pub from: Option<PathBuf>,
    /// Updates between checkpoints.
    pub checkpoint_every: usize,
    /// Sizes of the networks.
    pub architecture: Architecture,
    /// Length, batch and rates.
    pub settings: TrainerSettings,
    /// Which examples are drawn.
    pub recipe: Recipe,
}

/// A training run of the diffusion model.
pub struct ModelRun {
    settings: ModelRunSettings,
    trainer: Trainer,
    resumed_at: usize,
}

/// Progress of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State {
    /// Examples so far.
    pub seen: usize,
    /// Moving mean of the velocity loss.
    pub loss: f64,
    /// Moving mean of the contrastive loss, if the run has one.
    pub contrastive_loss: Option<f64>,
    /// Whether a checkpoint follows.
    pub at_checkpoint: bool,
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} examples, loss {:.4}", self.seen, self.loss)?;
        match self.contrastive_loss {
            Some(loss) => write!(f, ", contrastive loss {loss:.3}"),
            None => Ok(()),
        }
    }
}

/// Results of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// Examples in all.
    pub seen: usize,
    /// Examples of the checkpoint that the run continued from.
    pub resumed_at: usize,
    /// Moving mean of the velocity loss; `None` without an update.
    pub loss: Option<f64>,
}

impl ModelRun {
    /// Opens a run: continues from the checkpoint of the cache, else starts from `from` or from random weights. Writes the
    /// model's configurations after it has seen that the files of `from` can be read.
    pub fn open(settings: ModelRunSettings) -> Result<Self> {
        let checkpoint = checkpoint(&settings);
        let from = settings.from.as_ref().filter(|_| !checkpoint.is_file());
        if let Some(from) = from {
            for (_, file) in WEIGHT_FILES {
                Weights::open_file(&from.join(file))?;
            }
        }
        settings.architecture.write_configs(&settings.out)?;
        let mut trainer = Trainer::new(
            &settings.architecture,
            &settings.out,
            settings.settings,
            settings.recipe,
        )?;
        match from {
            Some(from) => trainer.start_from(from)?,
            None if checkpoint.is_file() => trainer.resume(&checkpoint)?,
            None => {}
        }
        Ok(Self {
            resumed_at: trainer.seen(),
            settings,
            trainer,
        })
    }

    /// Trains to the end and writes checkpoint and weights. `report` is called after every update and may stop the run,
    /// which is written then, too.
    pub fn train(
        &mut self,
        data: &Dataset,
        report: &mut dyn FnMut(&State) -> ControlFlow<()>,
    ) -> Result<Summary> {
        let settings = &self.settings;
        let checkpoint = checkpoint(settings);
        let every = (settings.checkpoint_every.max(1) * settings.settings.batch).max(1);
        let (mut loss, mut contrastive) = (MovingMean::default(), MovingMean::default());
        self.trainer.run(data, &mut |trainer, update: &Update| {
            let of_lights = update.contrastive_loss;
            let state = State {
                seen: update.seen,
                loss: loss.add(update.loss),
                contrastive_loss: (!of_lights.is_nan()).then(|| contrastive.add(of_lights)),
                at_checkpoint: update.seen.is_multiple_of(every),
            };
            let stop = report(&state);
            if stop.is_break() || state.at_checkpoint {
                trainer.save(&checkpoint)?;
            }
            Ok(stop)
        })?;
        self.trainer.save(&checkpoint)?;
        let weights = self.trainer.average();
        settings
            .architecture
            .write_weights(&settings.out, weights)?;
        Ok(Summary {
            seen: self.trainer.seen(),
            resumed_at: self.resumed_at,
            loss: loss.0,
        })
    }
}

fn checkpoint(settings: &ModelRunSettings) -> PathBuf {
    settings.cache.join("checkpoint.safetensors")
}

/// A training run of the light encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct EncoderRun {
    /// Model folder that the encoder is written to.
    pub out: PathBuf,
    /// Model folder whose encoder it starts from.
    pub from: Option<PathBuf>,
    /// Contact sheet of some of its pictures.
    pub sheet: Option<PathBuf>,
    /// Length and rates.
    pub settings: EncoderSettings,
}

impl EncoderRun {
    /// Checks that all files can be read and written, before scenes are traced.
    pub fn check(&self) -> Result<()> {
        if let Some(png) = &self.sheet {
            contact_sheet::check_path(png)?;
        }
        if let Some(from) = &self.from {
            Weights::open_file(&from.join(encoder::FILE))?;
        }
        Ok(())
    }

    /// Trains to the end and returns the moving mean of the loss. `report` is called after every update with the number of
    /// pictures, that mean, and whether the encoder is written then; it may stop the run. Then the encoder is written and
    /// the result is `None`.
    pub fn train(
        &self,
        data: &Dataset,
        report: &mut dyn FnMut(usize, f64, bool) -> ControlFlow<()>,
    ) -> Result<Option<f64>> {
        std::fs::create_dir_all(&self.out).map_err(io("create", &self.out))?;
        if let Some(png) = &self.sheet {
            let count = SHEET_ROWS * SHEET_COLUMNS;
            let pictures = encoder_training::pictures(data, count, self.settings.seed)?;
            let pictures = pictures.iter().map(|p| from_planes(p, SIZE, SIZE));
            contact_sheet::write(png, &pictures.collect::<Vec<_>>(), SHEET_COLUMNS)?;
        }
        let mut mean = MovingMean::default();
        let from = self.from.as_deref();
        let finished =
            encoder_training::train(data, &self.settings, from, &self.out, &mut |seen, loss| {
                report(seen, mean.add(loss), seen.is_multiple_of(SAVED_EVERY))
            })?;
        Ok(finished.then(|| mean.0.unwrap_or(f64::NAN)))
    }
}
