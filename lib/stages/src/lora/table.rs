//! The `[lora]` table.
use std::path::PathBuf;

use dipir_diffusion::training::TrainingConfig;
use dipir_pipeline::config::Config;
use dipir_pipeline::error::ConfigError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest rank, above the width of any published adapter.
const MAX_RANK: usize = 1024;

/// The `[lora]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LoraTable {
    /// A finished LoRA that is used in place of one that is trained here, with the keys of diffusers, peft or kohya: a
    /// `.safetensors` file, or a folder that peft or diffusers wrote.
    #[schemars(extend("format" = "path"), extend("x-default" = "none: one is trained on the photograph"), example = &"style.safetensors")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path: Option<PathBuf>,
    /// Rank of the adapters.
    #[schemars(range(min = 1, max = 1024), example = 8)]
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
    /// The word that stands for the photograph's light in prompts; one that is learnt has no white space.
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
            path: None,
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
    /// Refuses what no run can work with.
    pub(super) fn check(&self, config: &Config) -> Result<(), ConfigError> {
        let wrong = |key: &str, value: &dyn std::fmt::Display, accepted: &str| {
            Err(config.out_of_range(&format!("lora.{key}"), value, accepted))
        };
        if !(1..=MAX_RANK).contains(&self.rank) {
            return wrong("rank", &self.rank, &format!("1 to {MAX_RANK}"));
        }
        if self.accumulation == 0 {
            return wrong("accumulation", &self.accumulation, "at least 1");
        }
        let above_0 = [
            ("alpha", self.alpha.unwrap_or(1.0)),
            ("learning_rate", self.learning_rate),
        ];
        for (key, value) in above_0 {
            if !(value > 0.0 && value.is_finite()) {
                return wrong(key, &value, "above 0");
            }
        }
        let from_0 = [
            ("prior_weight", self.prior_weight),
            ("word_learning_rate", self.word_learning_rate),
        ];
        for (key, value) in from_0 {
            if !(value >= 0.0 && value.is_finite()) {
                return wrong(key, &value, "at least 0");
            }
        }
        if !(self.min_crop > 0.0 && self.min_crop <= 1.0) {
            return wrong("min_crop", &self.min_crop, "above 0, up to 1");
        }
        if let Some(s) = self.time_budget_s
            && !(s > 0.0)
        {
            return wrong("time_budget_s", &s, "above 0");
        }
        if self.path.as_ref().is_some_and(|p| p.as_os_str().is_empty()) {
            return Err(config.invalid(
                "lora.path",
                "is empty: name a .safetensors file, or a folder that peft or diffusers wrote, as in path = \
                 \"style.safetensors\"; without the key one is trained",
            ));
        }
        if self.path.is_some() && self.learn_word {
            return Err(config.invalid(
                "lora.learn_word",
                "true has no meaning with lora.path, for nothing is trained then; leave one of them out",
            ));
        }
        let word = &self.word;
        if self.learn_word && (word.is_empty() || word.contains(char::is_whitespace)) {
            return Err(config.invalid(
                "lora.word",
                format!(
                    "{word:?} cannot be learnt; accepted: one word without white space, as in \"sks\" or \"<sks>\""
                ),
            ));
        }
        Ok(())
    }

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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn values_that_no_run_can_work_with_are_refused_by_line_and_key() {
        let refusal = |line: &str| {
            let text = format!("[lora]\n{line}\n");
            let config = Config::parse(Path::new("pipeline.toml"), &text, &[]).expect("TOML");
            let table: LoraTable = config.table("lora").expect("a table");
            table.check(&config).err().map(|e| e.to_string())
        };
        for (line, key, accepted) in [
            ("rank = 0", "rank: 0", "1 to 1024"),
            ("rank = 1025", "rank: 1025", "1 to 1024"),
            ("accumulation = 0", "accumulation: 0", "at least 1"),
            ("alpha = inf", "alpha: inf", "above 0"),
            ("learning_rate = nan", "learning_rate: NaN", "above 0"),
            ("prior_weight = -1.0", "prior_weight: -1", "at least 0"),
            (
                "word_learning_rate = inf",
                "word_learning_rate: inf",
                "at least 0",
            ),
            ("min_crop = 1.5", "min_crop: 1.5", "above 0, up to 1"),
            ("time_budget_s = 0.0", "time_budget_s: 0", "above 0"),
        ] {
            let wanted =
                format!("pipeline.toml:2: lora.{key} is out of range; accepted: {accepted}");
            assert_eq!(refusal(line).as_deref(), Some(wanted.as_str()));
        }
        for word in ["", " ", "my word", " sks ", "a\tb"] {
            let message = refusal(&format!("learn_word = true\nword = {word:?}"));
            let message = message.expect("refused");
            assert!(
                message.contains("pipeline.toml:3: lora.word: "),
                "{message}"
            );
        }
        let message = refusal("path = \"a.safetensors\"\nlearn_word = true").expect("refused");
        let part = "pipeline.toml:3: lora.learn_word: true has no meaning with lora.path";
        assert!(message.contains(part), "{message}");
        let message = refusal("path = \"\"").expect("refused");
        let part = "pipeline.toml:2: lora.path: is empty: name a .safetensors file";
        assert!(message.contains(part), "{message}");
        // Without learning, several words may stand for the light.
        assert_eq!(refusal("word = \"my word\""), None);
        for word in ["sks", "<sks>", "*"] {
            assert_eq!(
                refusal(&format!("learn_word = true\nword = {word:?}")),
                None
            );
        }
        assert_eq!(
            refusal("rank = 1024\nalpha = 0.5\ntime_budget_s = inf"),
            None
        );
    }
}
