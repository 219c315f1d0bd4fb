//! The `[light]` table and what follows from it.
use std::f64::consts::PI;
use std::path::PathBuf;

use dipir_render::transport::Precision;
use dipir_sun::table::{ShadowTable, SunTable};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::objective::TermWeights;
use crate::tensors::Group;

/// Where the gradient of the picture comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum GuidanceKind {
    /// `"auto"`: `"lds"` with a model of `[model] path`, `"none"` with the embedded one.
    #[default]
    Auto,
    /// Nothing guides: the light is what the optimisation would start from.
    None,
    /// Score distillation with a personalised diffusion model [DiPIR, eq. 8].
    Lds,
    /// Score distillation sampling [DiPIR, eq. 7].
    Sds,
    /// Classifier score distillation.
    Csd,
    /// Towards what the model makes of the picture when it edits it [DiPIR, "dataset update"].
    SdEdit,
    /// A picture that the composite should equal.
    Reference,
}

impl GuidanceKind {
    /// The kind that is meant, where a configuration names a model or does not.
    pub fn resolved(self, names_model: bool) -> Self {
        match (self, names_model) {
            (Self::Auto, true) => Self::Lds,
            (Self::Auto, false) => Self::None,
            (other, _) => other,
        }
    }
}

/// Where the optimisation starts: one of the words below, or a file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum Start {
    /// `"auto"`: `"neutral"` with a reference, `"read"` where a model guides that knows light, else
    /// `"estimated"`.
    #[default]
    Auto,
    /// `"estimated"`: what the light estimator says of the whole photograph.
    Estimated,
    /// `"read"`: what a model that knows light reads off the photograph.
    Read,
    /// `"encoder"`: what that model's light encoder sees, without asking the model itself.
    Encoder,
    /// `"neutral"`: nearly uniform light as bright as the photograph.
    Neutral,
    /// Anything else: a `lighting.json`.
    File(PathBuf),
}

impl From<String> for Start {
    fn from(text: String) -> Self {
        match text.as_str() {
            "auto" => Self::Auto,
            "estimated" => Self::Estimated,
            "read" => Self::Read,
            "encoder" => Self::Encoder,
            "neutral" => Self::Neutral,
            _ => Self::File(text.into()),
        }
    }
}

impl From<Start> for String {
    fn from(start: Start) -> Self {
        match start {
            Start::Auto => "auto".into(),
            Start::Estimated => "estimated".into(),
            Start::Read => "read".into(),
            Start::Encoder => "encoder".into(),
            Start::Neutral => "neutral".into(),
            Start::File(path) => path.to_string_lossy().into_owned(),
        }
    }
}

/// The `[light]` table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LightTable {
    /// Steps of the optimiser; 0 keeps the light that it would start from. Without this key 50 where a model reads the
    /// start off the photograph, and 200 for `materials`.
    #[schemars(range(min = 0, max = 1000000), example = 300)]
    pub iterations: Option<usize>,
    /// Seconds that the optimisation may take: its first step is timed, and as many of `iterations`
    /// are run as fit. Loading, recording and reading are not counted.
    #[schemars(extend("exclusiveMinimum" = 0, "x-default" = "no limit"), example = 600.0)]
    pub time_budget_s: Option<f64>,
    /// What guides the light. `auto`: `lds` with a model of `[model] path`, `none` with the
    /// embedded one. `none`: the start is kept. `lds`, `sds`, `csd`: score distillation. `sdedit`:
    /// what the model makes of the picture. `reference`: the picture `reference`.
    #[schemars(example = &"lds")]
    pub guidance: GuidanceKind,
    /// With `guidance = "reference"`: the picture that the composite should equal, of the
    /// photograph's size; EXR or HDR (linear), PNG or JPEG (encoded as the photograph).
    #[schemars(extend("format" = "path"), example = &"reference.exr")]
    pub reference: Option<PathBuf>,
    /// Where the optimisation starts, and what `recover_light = false` keeps: `estimated` (from the photograph), `read` or
    /// `encoder` (by a model that knows light), `neutral` (nearly uniform), or a `lighting.json`. `auto` is `neutral` with
    /// a reference, `read` under a model that knows light, else `estimated`.
    #[schemars(with = "String", extend("anyOf" = [{"enum": ["auto", "estimated", "read", "encoder", "neutral"]}, {"format": "path"}]), example = &"neutral")]
    pub start: Start,
    /// With an estimated start: the candidate of `candidates.json` that is used, counted from 1.
    #[schemars(range(min = 1), extend("x-default" = "the mean of all"), example = 2)]
    pub candidate: Option<usize>,
    /// With an estimated start: what is known of the sun. Without it, what the photograph's own
    /// data say (time, place and heading).
    pub sun: Option<SunTable>,
    /// With an estimated start: a shadow drawn on the photograph, from an object's foot to the tip.
    pub shadow: Option<ShadowTable>,
    /// Whether what the photograph shows belongs to the light.
    #[schemars(extend("x-default" = "true with an estimated start that no model guides, else false"), example = false)]
    pub visible: Option<bool>,
    /// With a diffusion model: least and largest noise that it is asked at, as shares of its
    /// timesteps from 0 to 1. A second pair is reached linearly in the last iteration.
    #[schemars(extend("x-default" = "`[[0.5, 0.9]]` with a model that knows light, else `[[0.02, 0.6], [0.02, 0.3]]`"), extend("examples" = [[[0.02, 0.6], [0.02, 0.3]]]))]
    pub timesteps: Option<Vec<[f64; 2]>>,
    /// With a diffusion model: what the picture should show.
    #[schemars(extend("x-default" = "from `scene.class`, `lora.word` and the light"), example = &"a photo of a red car at noon")]
    pub prompt: Option<String>,
    /// With a diffusion model: draws of noise in each iteration.
    #[schemars(range(min = 1, max = 64), extend("default" = 1), example = 4)]
    pub draws: Option<usize>,
    /// With a diffusion model: side of the crops that it is shown, pixels, a multiple of 8.
    #[schemars(range(min = 32, max = 1024), extend("x-default" = "the model's own size, at most 256 on the CPU"), example = 512)]
    pub crop: Option<usize>,
    /// With `guidance = "sds"` or `"sdedit"`: scale of classifier-free guidance.
    #[schemars(extend("default" = 7.5), example = 7.5)]
    pub guidance_scale: Option<f64>,
    /// Whether the LoRA adapts the model that guides.
    #[schemars(extend("default" = true), example = false)]
    pub adapt: Option<bool>,
    /// Lobes of each light set, where `start` does not say.
    #[schemars(range(min = 1, max = 1024), example = 48)]
    pub lobes: Option<usize>,
    /// Longest side of the picture that is optimised, pixels: the photograph is scaled down to it,
    /// never up.
    #[schemars(range(min = 1, max = 16384), example = 256)]
    pub size: Option<usize>,
    /// Columns (2 to 2048) and rows (1 to 1024) of the environment map.
    #[schemars(extend("examples" = [[128, 64]]))]
    pub environment: Option<[usize; 2]>,
    /// Paths per pixel of the record of light transport.
    #[schemars(range(min = 1, max = 1 << 20), example = 256)]
    pub samples: Option<u32>,
    /// How the record stores its weights: `half` takes half of the memory and holds at most 65536
    /// texels.
    #[schemars(extend("x-default" = "`half` where the environment has few enough texels, else `single`"), example = &"single")]
    pub precision: Option<Precision>,
    /// How far each parameter moves per step. Where a model reads the start off the photograph, a twentieth of these
    /// defaults holds, unless one of them is set to another value.
    pub learning_rates: LearningRates,
    /// Weight of the consistency of both light sets.
    #[schemars(range(min = 0.0, max = 1e6), extend("default" = CONSISTENCY), example = 0.1)]
    pub consistency: Option<f64>,
    /// Weight of the regulariser of the shadow's light.
    #[schemars(range(min = 0.0, max = 1e6), extend("default" = REGULARIZER), example = 0.05)]
    pub regularizer: Option<f64>,
    /// Share of the iterations after which both light sets are fused; from there on one light is
    /// optimised.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1.0), extend("default" = FUSED_AFTER), example = 0.75)]
    pub fused_after: Option<f64>,
    /// Whether a reference is compared on random crops, as a diffusion model sees the picture,
    /// instead of as a whole.
    #[schemars(example = true)]
    pub crops: bool,
    /// Names of materials to recover from the reference instead of the light, under the known light
    /// of `composite.environment`: base colour, metalness, roughness and strength of emission.
    #[schemars(extend("examples" = [["paint"]]))]
    pub materials: Vec<String>,
    /// Whether the light is recovered.
    #[schemars(extend("default" = true), example = false)]
    pub recover_light: Option<bool>,
    /// Whether the tone curves are recovered.
    #[schemars(extend("default" = true), example = false)]
    pub recover_tone: Option<bool>,
    /// Iterations between previews; 0 for none.
    #[schemars(extend("default" = PREVIEW_EVERY), example = 10)]
    pub preview_every: Option<usize>,
    /// Iterations between checkpoints; 0 for none.
    #[schemars(extend("default" = CHECKPOINT_EVERY), example = 100)]
    pub checkpoint_every: Option<usize>,
    /// Iterations over which the loss has to fall by a thousandth, or the optimisation stops; 0
    /// never stops it.
    #[schemars(example = 50)]
    pub patience: usize,
    /// Key of every random number of the light stage.
    #[schemars(extend("x-default" = "that of `pipeline.seed`"), example = 7)]
    pub seed: Option<u64>,
}

/// How far each parameter moves in one of the first steps. Adam's steps have the size of the rate,
/// whatever the scale of the gradient; the rates fall along a cosine. With half of these, a studio's
/// lamp of 3 degrees is still 4 degrees wide after 600 iterations (docs/recovery.md).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LearningRates {
    /// Rate of log-radiance, nats a step: 0.1 is 10%.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.05)]
    pub radiance: f64,
    /// Rate of directions, about radians a step: 0.02 is 1.1 degrees.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.01)]
    pub direction: f64,
    /// Rate of the log of a lobe's width, nats a step: 0.04 is 4%.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.02)]
    pub sigma: f64,
    /// Rate of the parameters of the tone curve, their own units a step: slower than the light,
    /// which should explain what it can.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.001)]
    pub tone: f64,
    /// Rate of the log of the exposure, nats a step. It scales all radiance at once.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.01)]
    pub exposure: f64,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            radiance: 0.1,
            direction: 0.02,
            sigma: 0.04,
            tone: 0.003,
            exposure: 0.02,
        }
    }
}

impl LearningRates {
    /// All rates times `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        Self {
            radiance: self.radiance * factor,
            direction: self.direction * factor,
            sigma: self.sigma * factor,
            tone: self.tone * factor,
            exposure: self.exposure * factor,
        }
    }
}

/// How much work is done where the table does not say: one row of the presets of a quality.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightPreset {
    /// Steps of the optimiser.
    pub iterations: usize,
    /// Lobes of each light set.
    pub lobes: usize,
    /// Columns and rows of the environment. A shadow's edge is as wide as the texel that holds the
    /// sun: 1.4 degrees with 256 columns, and with 2.8 that can be seen.
    pub environment: [usize; 2],
    /// Paths per pixel of the record.
    pub samples: u32,
    /// Longest side of the picture that is optimised, pixels.
    pub size: usize,
}

/// A value of the table that is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct BadSetting {
    /// The key, without its table: `learning_rates.tone`.
    pub key: &'static str,
    /// What is wrong, and what is accepted.
    pub message: String,
}

/// The table with everything filled in and checked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Steps of the optimiser.
    pub iterations: usize,
    /// Seconds into which the steps have to fit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_budget_s: Option<f64>,
    /// Lobes of each light set.
    pub lobes: usize,
    /// Longest side of the picture that is optimised, pixels.
    pub size: usize,
    /// Columns and rows of the environment.
    pub environment: [usize; 2],
    /// Paths per pixel of the record.
    pub samples: u32,
    /// How the record stores its weights.
    pub precision: Precision,
    /// Rates of the first step.
    pub learning_rates: LearningRates,
    /// Weight of the consistency of both light sets.
    pub consistency: f64,
    /// Weight of the regulariser of the shadow's light.
    pub regularizer: f64,
    /// Share of the iterations after which both light sets are fused.
    pub fused_after: f64,
    /// Whether a reference is compared on random crops.
    pub crops: bool,
    /// Whether the light is optimised.
    pub light: bool,
    /// Whether the tone curves are optimised.
    pub tone: bool,
    /// Iterations between previews; 0 for none.
    pub preview_every: usize,
    /// Iterations between checkpoints; 0 for none.
    pub checkpoint_every: usize,
    /// Iterations without progress before the end; 0 for all of them.
    pub patience: usize,
    /// Key of every random number.
    pub seed: u64,
}

/// Share of the first step's learning rates that the last one has: small enough that the result
/// does not hang on the last step's noise.
const LAST_RATE: f64 = 0.02;

/// Weight of the consistency where the table does not say [DiPIR, section 4.3].
const CONSISTENCY: f64 = 0.03;
/// Weight of the regulariser where the table does not say [DiPIR, section 4.3].
const REGULARIZER: f64 = 0.01;
/// The paper's s reaches 1 in the last step; here the last half optimises exactly what is
/// delivered. Two sets find a light more easily, one finds its width (docs/recovery.md).
const FUSED_AFTER: f64 = 0.5;
/// Iterations between previews where the table does not say.
const PREVIEW_EVERY: usize = 50;
/// Iterations between checkpoints where the table does not say.
const CHECKPOINT_EVERY: usize = 25;

/// Entries of a record in half precision number their texel in 16 bits.
const MOST_TEXELS_IN_HALF: usize = 1 << 16;

impl LightTable {
    /// The given keys that only an estimated light uses.
    pub fn only_of_estimates(&self) -> impl Iterator<Item = &'static str> {
        let keys = [
            ("light.sun", self.sun.is_some()),
            ("light.shadow", self.shadow.is_some()),
            ("light.candidate", self.candidate.is_some()),
        ];
        keys.into_iter()
            .filter(|(_, given)| *given)
            .map(|(key, _)| key)
    }

    /// The settings: what the table says, else what `preset` says. `seed` is the pipeline's.
    pub fn settings(&self, preset: &LightPreset, seed: u64) -> Result<Settings, BadSetting> {
        let environment = self.environment.unwrap_or(preset.environment);
        let fits_half = environment[0].saturating_mul(environment[1]) <= MOST_TEXELS_IN_HALF;
        let settings = Settings {
            iterations: self.iterations.unwrap_or(preset.iterations),
            time_budget_s: self.time_budget_s,
            lobes: self.lobes.unwrap_or(preset.lobes),
            size: self.size.unwrap_or(preset.size),
            environment,
            samples: self.samples.unwrap_or(preset.samples),
            precision: self.precision.unwrap_or(match fits_half {
                true => Precision::Half,
                false => Precision::Single,
            }),
            learning_rates: self.learning_rates,
            consistency: self.consistency.unwrap_or(CONSISTENCY),
            regularizer: self.regularizer.unwrap_or(REGULARIZER),
            fused_after: self.fused_after.unwrap_or(FUSED_AFTER),
            crops: self.crops,
            light: self.recover_light.unwrap_or(true),
            tone: self.recover_tone.unwrap_or(true),
            preview_every: self.preview_every.unwrap_or(PREVIEW_EVERY),
            checkpoint_every: self.checkpoint_every.unwrap_or(CHECKPOINT_EVERY),
            patience: self.patience,
            seed: self.seed.unwrap_or(seed),
        };
        settings.check()?;
        Ok(settings)
    }
}

impl Settings {
    /// Refuses values that no run can work with.
    pub fn check(&self) -> Result<(), BadSetting> {
        let wrong = |key, message: String| Err(BadSetting { key, message });
        if self.iterations > 1_000_000 {
            let found = self.iterations;
            let message = format!("{found} is out of range; accepted: 0 to 1000000");
            return wrong("iterations", message);
        }
        if let Some(s) = self.time_budget_s
            && !(s > 0.0 && s.is_finite())
        {
            return wrong(
                "time_budget_s",
                format!("{s} is out of range; accepted: above 0"),
            );
        }
        let counts = [
            ("lobes", self.lobes, 1024),
            ("size", self.size, 1 << 14),
            ("samples", self.samples as usize, 1 << 20),
        ];
        for (key, value, most) in counts {
            if !(1..=most).contains(&value) {
                return wrong(
                    key,
                    format!("{value} is out of range; accepted: 1 to {most}"),
                );
            }
        }
        let [width, height] = self.environment;
        if !(2..=2048).contains(&width) || !(1..=1024).contains(&height) {
            let message = format!(
                "[{width}, {height}] is out of range; accepted: columns from 2 to 2048 and rows from 1 \
                 to 1024, as in [256, 128]"
            );
            return wrong("environment", message);
        }
        if self.precision == Precision::Half && width * height > MOST_TEXELS_IN_HALF {
            let message = format!(
                "\"half\" holds environments of at most {MOST_TEXELS_IN_HALF} texels, and [{width}, \
                 {height}] has {}; accepted: \"single\", or a smaller environment",
                width * height
            );
            return wrong("precision", message);
        }
        let r = &self.learning_rates;
        let rates = [
            ("learning_rates.radiance", r.radiance),
            ("learning_rates.direction", r.direction),
            ("learning_rates.sigma", r.sigma),
            ("learning_rates.tone", r.tone),
            ("learning_rates.exposure", r.exposure),
        ];
        for (key, value) in rates {
            if !(0.0..=1.0).contains(&value) {
                return wrong(key, format!("{value} is out of range; accepted: 0 to 1"));
            }
        }
        let weights = [
            ("consistency", self.consistency),
            ("regularizer", self.regularizer),
        ];
        for (key, value) in weights {
            if !(0.0..=1e6).contains(&value) {
                return wrong(key, format!("{value} is out of range; accepted: 0 to 1e6"));
            }
        }
        if !(self.fused_after > 0.0 && self.fused_after <= 1.0) {
            let message = format!(
                "{} is out of range; accepted: above 0, at most 1",
                self.fused_after
            );
            return wrong("fused_after", message);
        }
        if !self.light && !self.tone {
            let message = "light and tone are both off, so nothing is optimised; switch one on";
            return wrong("recover_light", message.into());
        }
        Ok(())
    }

    /// How far both light sets are fused in an iteration, s of the supplement's eqs. 17 and 18:
    /// linear from 0 in the first to 1 at [`fused_after`](Self::fused_after).
    pub fn fusion(&self, iteration: usize) -> f32 {
        let whole = self.fused_after * (self.iterations.max(2) - 1) as f64;
        (iteration as f64 / whole).min(1.0) as f32
    }

    /// The first iteration in which both sets are fused altogether.
    pub fn fused_at(&self) -> usize {
        (self.fused_after * (self.iterations.max(2) - 1) as f64).ceil() as usize
    }

    /// Factor on every learning rate: a cosine from 1 to [`LAST_RATE`].
    pub fn rate(&self, iteration: usize) -> f64 {
        let share = iteration as f64 / (self.iterations.max(2) - 1) as f64;
        LAST_RATE + (1.0 - LAST_RATE) * 0.5 * (1.0 + (PI * share.min(1.0)).cos())
    }

    /// The rate of a group's first step; 0 for what is not optimised. The exposure scales the
    /// light and rests with it.
    pub fn base_rate(&self, group: Group) -> f64 {
        let r = &self.learning_rates;
        let on = |on, rate| if on { rate } else { 0.0 };
        match group {
            Group::Radiance => on(self.light, r.radiance),
            Group::Direction => on(self.light, r.direction),
            Group::Sigma => on(self.light, r.sigma),
            Group::Exposure => on(self.light, r.exposure),
            Group::Tone => on(self.tone, r.tone),
            // Materials have a loop of their own.
            Group::Material => 0.0,
        }
    }

    /// Weights of the terms beside the guidance.
    pub fn weights(&self) -> TermWeights {
        TermWeights {
            consistency: self.consistency,
            regularizer: self.regularizer,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::PRESET;

    #[test]
    fn the_table_goes_before_the_preset_and_the_pipelines_seed() {
        let mut table = LightTable::default();
        let settings = table.settings(&PRESET, 7).unwrap();
        assert_eq!((settings.lobes, settings.seed), (PRESET.lobes, 7));
        table.lobes = Some(3);
        table.seed = Some(1);
        let settings = table.settings(&PRESET, 7).unwrap();
        assert_eq!(
            (settings.lobes, settings.seed, settings.iterations),
            (3, 1, PRESET.iterations)
        );
    }

    #[test]
    fn impossible_settings_are_refused_by_key() {
        let refused = |change: &dyn Fn(&mut LightTable)| {
            let mut table = LightTable::default();
            change(&mut table);
            table.settings(&PRESET, 0).unwrap_err()
        };
        let error = refused(&|t| t.iterations = Some(1_000_001));
        assert_eq!(error.key, "iterations");
        assert_eq!(
            error.to_string(),
            "1000001 is out of range; accepted: 0 to 1000000"
        );
        assert_eq!(refused(&|t| t.lobes = Some(0)).key, "lobes");
        assert_eq!(refused(&|t| t.size = Some(0)).key, "size");
        let too_fine = refused(&|t| {
            t.environment = Some([512, 256]);
            t.precision = Some(Precision::Half);
        });
        assert_eq!(
            (too_fine.key, too_fine.message.as_str()),
            (
                "precision",
                "\"half\" holds environments of at most 65536 texels, and [512, 256] has 131072; \
                 accepted: \"single\", or a smaller environment"
            )
        );
        assert_eq!(
            refused(&|t| t.environment = Some([1, 1])).key,
            "environment"
        );
        assert_eq!(
            refused(&|t| t.learning_rates.tone = f64::NAN).key,
            "learning_rates.tone"
        );
        assert_eq!(refused(&|t| t.consistency = Some(-1.0)).key, "consistency");
        assert_eq!(refused(&|t| t.fused_after = Some(0.0)).key, "fused_after");
        assert_eq!(
            refused(&|t| (t.recover_light, t.recover_tone) = (Some(false), Some(false))).key,
            "recover_light"
        );
    }

    #[test]
    fn fusion_and_rates_run_from_start_to_end() {
        let whole = LightTable {
            iterations: Some(600),
            ..Default::default()
        };
        let s = whole.settings(&PRESET, 0).unwrap();
        assert_eq!((s.fusion(0), s.fusion(300), s.fusion(599)), (0.0, 1.0, 1.0));
        assert_eq!((s.fused_at(), s.fusion(299) < 1.0), (300, true));
        assert!((s.fusion(150) - 0.5).abs() < 2e-3);
        assert_eq!(s.rate(0), 1.0);
        assert!((s.rate(599) - LAST_RATE).abs() < 1e-12);
        assert!((1..600).all(|i| s.rate(i) < s.rate(i - 1)));
        let one = LightTable {
            iterations: Some(1),
            ..Default::default()
        };
        let one = one.settings(&PRESET, 0).unwrap();
        assert_eq!((one.fusion(0), one.rate(0)), (0.0, 1.0));
    }
}
