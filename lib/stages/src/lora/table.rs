//! The `[lora]` table.
use std::path::PathBuf;

use dipir_diffusion::training::TrainingConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The `[lora]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LoraTable {
    /// Rank of the adapters.
    #[schemars(range(min = 1), example = 8)]
    pub rank: usize,
    /// Scale of the adapters times their rank.
    #[schemars(extend("exclusiveMinimum" = 0), extend("x-default" = "the rank"), example = 8.0)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alpha: Option<f64>,
    /// Updates of the training.
    #[schemars(example = 300)]
    pub steps: usize,
    /// Learning rate of the adapters.
    #[schemars(extend("exclusiveMinimum" = 0), example = 0.0002)]
    pub learning_rate: f64,
    /// Updates over which the learning rates rise from 0.
    #[schemars(example = 50)]
    pub warmup_steps: usize,
    /// Examples of each kind that an update averages.
    #[schemars(range(min = 1), example = 4)]
    pub accumulation: usize,
    /// Weight of the loss of the concept images; 0 leaves them out.
    #[schemars(range(min = 0.0), example = 0.5)]
    pub prior_weight: f64,
    /// Smallest crop of the photograph, as a share of its shorter side.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1.0), example = 0.7)]
    pub min_crop: f64,
    /// The word that stands for the photograph's light in prompts.
    #[schemars(example = &"sks")]
    pub word: String,
    /// Whether an embedding for that word is learnt, too.
    #[schemars(example = true)]
    pub learn_word: bool,
    /// Learning rate of the embedding.
    #[schemars(range(min = 0.0), example = 0.001)]
    pub word_learning_rate: f64,
    /// Whether activations are computed again in the backward pass: less memory, a third more time.
    #[schemars(extend("x-default" = "on a GPU once its memory has run out, on a CPU always"), example = false)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recompute: Option<bool>,
    /// Updates between checkpoints; 0 for none.
    #[schemars(example = 100)]
    pub checkpoint_every: usize,
    /// Updates between sample images; 0 for none.
    #[schemars(example = 100)]
    pub sample_every: usize,
    /// Updates between two looks at the loss of the same crops at the same noise, beside those before the first and after
    /// the last; 0 for these alone.
    #[schemars(example = 50)]
    pub validate_every: usize,
    /// Denoising steps of each picture of `sheet.png`, which shows what the adapter changes; 0 for no sheet.
    #[schemars(example = 25)]
    pub sheet_steps: usize,
    /// Seconds after which no further update begins, however many `steps` asks for. Loading the model, validation and the
    /// sheet are not counted.
    #[schemars(extend("exclusiveMinimum" = 0), extend("x-default" = "no limit"), example = 600.0)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_budget_s: Option<f64>,
    /// Folder in which adapters are kept and found again: scenes of one photograph, class, model and settings train once.
    #[schemars(extend("format" = "path"), extend("x-default" = "none: every scene trains its own"), example = &"../lora-cache")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cache: Option<PathBuf>,
}

impl Default for LoraTable {
    fn default() -> Self {
        let training = TrainingConfig::default();
        Self {
            rank: training.rank,
            alpha: None,
            steps: training.steps,
            learning_rate: training.learning_rate,
            warmup_steps: training.warmup_steps,
            accumulation: training.accumulation,
            prior_weight: training.prior_weight,
            min_crop: 0.5,
            word: "sks".into(),
            learn_word: false,
            word_learning_rate: training.token_learning_rate,
            recompute: training.recompute,
            checkpoint_every: 50,
            sample_every: 0,
            validate_every: 100,
            // DPM-Solver++ is recognisable from 10 steps on.
            sheet_steps: 12,
            time_budget_s: None,
            cache: None,
        }
    }
}

impl LoraTable {
    /// The settings of the training.
    pub(crate) fn training(&self, seed: u64) -> TrainingConfig {
        TrainingConfig {
            rank: self.rank,
            alpha: self.alpha.unwrap_or(self.rank as f64),
            steps: self.steps,
            learning_rate: self.learning_rate,
            token_learning_rate: self.word_learning_rate,
            warmup_steps: self.warmup_steps,
            accumulation: self.accumulation,
            prior_weight: self.prior_weight,
            recompute: self.recompute,
            seed,
            ..TrainingConfig::default()
        }
    }

    /// The caption of the photograph's crops.
    pub(super) fn instance_prompt(&self) -> String {
        format!("a scene in the style of {} rendering", self.word)
    }

    /// What decides what is written: neither how often the state is kept nor where finished adapters are does.
    pub(super) fn deciding(self) -> Self {
        Self {
            checkpoint_every: 0,
            cache: None,
            ..self
        }
    }

    /// The settings that determine each step of a run, so not the number of steps.
    pub(super) fn without_steps(&self) -> Self {
        Self {
            steps: 0,
            checkpoint_every: 0,
            sheet_steps: 0,
            time_budget_s: None,
            cache: None,
            ..self.clone()
        }
    }
}
