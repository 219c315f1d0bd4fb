//! What `[pipeline] quality` stands for (`presets.json`, chosen by what `dipir-tradeoff` measured), and
//! what a run would have cost with the next cheaper and the next better preset.
use std::sync::OnceLock;

use dipir_cli::session::duration;
use dipir_optimize::settings::{LightPreset, LightTable};
use dipir_pipeline::config::Quality;
use dipir_render::foresight::Guess;
use serde::Deserialize;
use serde_json::{Value, json};

/// The file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Presets {
    /// The day, as in 2026-11-21; absent where a preset is an assumption.
    pub measured: Option<String>,
    /// The command that measured it.
    pub command: Option<String>,
    /// From the cheapest to the best.
    pub presets: [Preset; 3],
}

/// What one quality sets where nothing else does.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Preset {
    /// Which.
    pub quality: Quality,
    /// Of `[composite]`.
    pub composite: CompositePreset,
    /// Of `[light]`.
    pub light: LightPreset,
    /// What recovering light was measured to cost.
    pub recovery: Option<Measured>,
}

impl Preset {
    /// What it means for light where `table` sets some keys itself.
    pub fn light_with(&self, table: &LightTable) -> LightPreset {
        LightPreset {
            iterations: table.iterations.unwrap_or(self.light.iterations),
            samples: table.samples.unwrap_or(self.light.samples),
            size: table.size.unwrap_or(self.light.size),
            environment: table.environment.unwrap_or(self.light.environment),
            ..self.light
        }
    }
}

/// Of `[composite]`.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompositePreset {
    /// Display-referred RMSE at which sampling stops.
    pub target_error: f32,
    /// Whether object and shadow are denoised.
    pub denoise: bool,
    /// Whether caustics on the object are blurred.
    pub blur_caustics: bool,
    /// Whether object and shadow are rendered at no more pixels than the photograph's sharpness needs.
    pub follow_sharpness: bool,
    /// Most pixels at which object and shadow are rendered.
    pub most_pixels: Option<u64>,
}

/// Means over the measured scenes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Measured {
    /// Processor seconds of recording and optimising; only ratios mean something elsewhere.
    pub cost_s: f64,
    /// Display-referred RMSE of the composite under the recovered light.
    pub error: f64,
}

/// All presets.
pub fn all() -> &'static Presets {
    static PRESETS: OnceLock<Presets> = OnceLock::new();
    PRESETS.get_or_init(|| {
        serde_json::from_str(include_str!("presets.json")).expect("a test reads the built-in file")
    })
}

/// What `quality` stands for.
pub fn of(quality: Quality) -> &'static Preset {
    let [draft, standard, high] = &all().presets;
    match quality {
        Quality::Draft => draft,
        Quality::Standard => standard,
        Quality::High => high,
    }
}

/// Name of a quality, as the configuration has it.
pub fn name(quality: Quality) -> &'static str {
    match quality {
        Quality::Draft => "draft",
        Quality::Standard => "standard",
        Quality::High => "high",
    }
}

/// What a run would have cost with another preset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Which preset.
    pub quality: Quality,
    /// About so many seconds.
    pub seconds: f64,
    /// Why it is a guess, if it is one.
    pub guess: Option<Guess>,
    /// The error that it is made for, display-referred RMSE.
    pub error: Option<f64>,
}

/// The next cheaper and the next better preset.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outlook(pub Vec<Estimate>);

impl Outlook {
    /// The presets next to `quality`, estimated by `estimate`: seconds and error.
    pub fn beside(
        quality: Quality,
        estimate: impl Fn(&Preset) -> Option<(f64, Option<f64>)>,
    ) -> Self {
        let presets = &all().presets;
        let here = presets
            .iter()
            .position(|p| p.quality == quality)
            .unwrap_or(1);
        let next = [here.checked_sub(1), Some(here + 1)];
        let next = next.into_iter().flatten().filter_map(|k| presets.get(k));
        let estimated = |p: &Preset| {
            estimate(p).map(|(seconds, error)| Estimate {
                quality: p.quality,
                seconds,
                guess: None,
                error,
            })
        };
        Self(next.filter_map(estimated).collect())
    }

    /// For composites that no preset stopped: those next to a display-referred error, and the seconds of each.
    pub fn around_error(error: f64, seconds: impl Fn(&Preset) -> f64) -> Self {
        // Nearer targets are no other choice.
        const APART: f64 = 1.2;
        let target = |p: &&Preset| f64::from(p.composite.target_error);
        let presets = all().presets.iter();
        let cheaper = presets.clone().rfind(|p| target(p) > error * APART);
        let better = presets.clone().find(|p| target(p) * APART < error);
        let chosen = cheaper.into_iter().chain(better);
        let estimate = |p: &Preset| Estimate {
            quality: p.quality,
            seconds: seconds(p),
            guess: None,
            error: Some(target(&p)),
        };
        Self(chosen.map(estimate).collect())
    }

    /// The same, where `why` tells of a preset why its estimate is a guess.
    pub fn with_guesses(mut self, why: impl Fn(&Preset) -> Option<Guess>) -> Self {
        for estimate in &mut self.0 {
            estimate.guess = why(of(estimate.quality));
        }
        self
    }

    /// A sentence; empty without an estimate.
    pub fn text(&self) -> String {
        let one = |e: &Estimate| {
            let error = e
                .error
                .map_or(String::new(), |e| format!(" (error {e:.3})"));
            format!("{} about {}{error}", name(e.quality), duration(e.seconds))
        };
        let because = |e: &Estimate| {
            let why = match e.guess? {
                Guess::Highlights => "some highlights are smaller than a pixel",
                Guess::Denoiser => "the denoiser, which it uses, was not tried",
            };
            Some(format!(
                "; the time of {} is a guess: {why}",
                name(e.quality)
            ))
        };
        let because: String = self.0.iter().filter_map(because).collect();
        match self.0.is_empty() {
            true => String::new(),
            false => {
                let all: Vec<String> = self.0.iter().map(one).collect();
                format!(
                    "other presets would have taken: {}{because}",
                    all.join(", ")
                )
            }
        }
    }

    /// For programs.
    pub fn to_json(&self) -> Value {
        let one = |e: &Estimate| json!({"quality": name(e.quality), "seconds": e.seconds, "guess": e.guess.is_some(), "error": e.error});
        self.0.iter().map(one).collect()
    }
}

/// A run of the light stage, from which the time under another preset is estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightRun {
    /// Steps; absent where no preset says how many.
    pub iterations: Option<usize>,
    /// Paths per pixel of the record.
    pub samples: u32,
    /// Longest side of the picture, pixels.
    pub side: usize,
    /// Columns and rows of the record's map of directions.
    pub environment: [usize; 2],
    /// Longest side of the photograph, beyond which no preset goes.
    pub photo_side: usize,
    /// Seconds in which the stage recorded, or read what the scene stage had recorded.
    pub record_s: f64,
    /// Seconds that model or reference took.
    pub guidance_s: f64,
    /// Other seconds of the optimisation: pictures from the record, and their gradients.
    pub replay_s: f64,
    /// Other seconds, which no preset changes: reading the photograph, writing.
    pub rest_s: f64,
    /// Whether a model guided.
    pub by_model: bool,
}

/// A picture from the record takes this power of its samples and of its texels in time: samples meet texels that a row has
/// already. Chosen so that runs with the demo's car and the gallery's knot foretell one another (docs/performance.md).
const REPLAY_POWERS: [f64; 2] = [0.35, 0.08];

impl LightRun {
    /// About how long it would have taken with `preset`.
    pub(crate) fn seconds_with(&self, preset: &LightPreset) -> f64 {
        let side = preset.size.min(self.photo_side);
        let pixels = (side as f64 / self.side.max(1) as f64).powi(2);
        let samples = f64::from(preset.samples) / f64::from(self.samples.max(1));
        let iterations = self
            .iterations
            .map_or(1.0, |n| preset.iterations as f64 / n.max(1) as f64);
        let count = |[width, height]: [usize; 2]| (width * height).max(1) as f64;
        let texels = count(preset.environment) / count(self.environment);
        let replay = pixels * samples.powf(REPLAY_POWERS[0]) * texels.powf(REPLAY_POWERS[1]);
        // A model sees its own size.
        let guidance = if self.by_model { 1.0 } else { pixels };
        let optimization = self.replay_s * replay + self.guidance_s * guidance;
        self.rest_s + self.record_s * pixels * samples + optimization * iterations
    }

    /// Whether `preset` would have done the same.
    fn is_that_of(&self, preset: &LightPreset) -> bool {
        let same_steps = self.iterations.is_none_or(|n| n == preset.iterations);
        same_steps
            && self.samples == preset.samples
            && self.environment == preset.environment
            && self.side == preset.size.min(self.photo_side)
    }

    /// The presets next to `quality` that differ in keys that `table` does not set.
    pub fn outlook(&self, quality: Quality, table: &LightTable) -> Outlook {
        // Measured with a reference; what a model guides to is another matter.
        let error = |p: &Preset| p.recovery.filter(|_| !self.by_model).map(|l| l.error);
        Outlook::beside(quality, |p| {
            let there = p.light_with(table);
            (!self.is_that_of(&there)).then(|| (self.seconds_with(&there), error(p)))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_reads_and_presets_go_from_cheap_to_good() {
        let [draft, standard, high] = &all().presets;
        assert_eq!(
            [draft.quality, standard.quality, high.quality],
            [Quality::Draft, Quality::Standard, Quality::High]
        );
        assert!(draft.composite.target_error > standard.composite.target_error);
        assert!(standard.composite.target_error > high.composite.target_error);
        assert!(draft.light.samples <= standard.light.samples);
        for preset in &all().presets {
            assert!(LightTable::default().settings(&preset.light, 0).is_ok());
        }
        assert!(all().measured.is_some() && all().command.is_some());
        let [draft, standard, high] = [draft, standard, high].map(|p| p.recovery.unwrap());
        assert!(draft.cost_s < standard.cost_s && standard.cost_s < high.cost_s);
        assert!(draft.error > standard.error && standard.error > high.error);
    }

    fn standard_run(by_model: bool) -> LightRun {
        let here = of(Quality::Standard).light;
        LightRun {
            iterations: Some(here.iterations),
            samples: here.samples,
            side: here.size,
            environment: here.environment,
            photo_side: 4096,
            record_s: 2.0,
            guidance_s: 0.0,
            replay_s: 10.0,
            rest_s: 0.0,
            by_model,
        }
    }

    #[test]
    fn errors_measured_with_a_reference_are_not_promised_of_a_model() {
        for by_model in [false, true] {
            let table = LightTable::default();
            let outlook = standard_run(by_model).outlook(Quality::Standard, &table);
            assert_eq!(outlook.0.len(), 2);
            assert!(outlook.0.iter().all(|e| e.error.is_none() == by_model));
        }
    }

    /// Seconds of runs of each preset, as their manifests had them: of the demo's car and of the gallery's knot in its place,
    /// guided by the embedded model, and of the car guided by a picture.
    #[test]
    fn what_other_presets_took_is_foretold_within_a_quarter() {
        // Record or reading it, guidance, pictures from the record, the rest; and all of it.
        let car = [
            [0.01, 0.82, 0.25, 2.13, 3.21],
            [0.04, 1.16, 1.80, 2.45, 5.45],
            [0.26, 1.23, 4.43, 2.25, 8.17],
        ];
        let knot = [
            [0.01, 1.05, 0.34, 2.59, 3.99],
            [0.05, 1.12, 2.05, 2.76, 5.98],
            [0.30, 1.40, 5.89, 2.56, 10.15],
        ];
        let picture = [
            [1.12, 0.13, 1.45, 0.27, 2.97],
            [8.51, 1.58, 27.17, 0.31, 37.57],
            [53.70, 2.47, 66.35, 0.26, 122.78],
        ];
        for (runs, by_model) in [(car, true), (knot, true), (picture, false)] {
            let run = |k: usize| {
                let there = all().presets[k].light;
                LightRun {
                    // Where a model has read the light, no preset says how many steps refine it.
                    iterations: (!by_model).then_some(there.iterations),
                    samples: there.samples,
                    side: there.size,
                    environment: there.environment,
                    photo_side: 960,
                    record_s: runs[k][0],
                    guidance_s: runs[k][1],
                    replay_s: runs[k][2],
                    rest_s: runs[k][3],
                    by_model,
                }
            };
            for (from, to) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
                let foretold = run(from).seconds_with(&all().presets[to].light);
                let ratio = foretold / runs[to][4];
                assert!((0.8..=1.25).contains(&ratio), "{from} of {to}: {ratio}");
            }
        }
    }

    #[test]
    fn the_presets_beside_a_run_are_named_with_their_cost() {
        let cost = |p: &Preset| Some((1.0 / f64::from(p.composite.target_error), Some(0.5)));
        let names = |o: &Outlook| o.0.iter().map(|e| name(e.quality)).collect::<Vec<_>>();
        assert_eq!(names(&Outlook::beside(Quality::Draft, cost)), ["standard"]);
        assert_eq!(
            names(&Outlook::beside(Quality::Standard, cost)),
            ["draft", "high"]
        );
        assert_eq!(names(&Outlook::beside(Quality::High, cost)), ["standard"]);
        assert_eq!(Outlook::beside(Quality::High, |_| None).text(), "");

        let targets = all()
            .presets
            .each_ref()
            .map(|p| f64::from(p.composite.target_error));
        let around = |e: f64| {
            Outlook::around_error(e, |p| (e / f64::from(p.composite.target_error)).powi(2))
        };
        assert_eq!(names(&around(targets[1])), ["draft", "high"]);
        assert_eq!(names(&around(2.0 * targets[0])), ["draft"]);
        assert_eq!(names(&around(0.5 * targets[2])), ["high"]);
        let high = around(targets[1]).0[1];
        assert!((high.seconds - (targets[1] / targets[2]).powi(2)).abs() < 1e-9);
        assert!(
            around(targets[1])
                .text()
                .starts_with("other presets would have taken: draft about")
        );
        assert!(!around(targets[1]).text().contains("guess"));
        let of_high = |p: &Preset| (p.quality == Quality::High).then_some(Guess::Highlights);
        let guessed = around(targets[1]).with_guesses(of_high).text();
        let end = "; the time of high is a guess: some highlights are smaller than a pixel";
        assert!(guessed.ends_with(end), "{guessed}");
        let guessed = around(targets[1]).with_guesses(|_| Some(Guess::Denoiser));
        let one = "; the time of draft is a guess: the denoiser, which it uses, was not tried";
        assert!(guessed.text().contains(one), "{}", guessed.text());
    }

    #[test]
    fn a_light_run_costs_what_its_steps_and_paths_cost() {
        let here = of(Quality::Standard).light;
        let run = standard_run(false);
        assert!((run.seconds_with(&here) - 12.0).abs() < 1e-9);
        let more = LightPreset {
            samples: 64 * here.samples,
            ..here
        };
        // 64 times the paths; 4.29 times the pictures from them.
        assert!((run.seconds_with(&more) - 128.0 - 42.9).abs() < 0.1);
        let model = LightRun {
            guidance_s: 8.0,
            replay_s: 2.0,
            ..standard_run(true)
        };
        let half = LightPreset {
            iterations: here.iterations / 2,
            ..more
        };
        assert!((model.seconds_with(&half) - 128.0 - 4.0 - 4.29).abs() < 0.01);
        let refined = LightRun {
            iterations: None,
            ..model
        };
        assert!((refined.seconds_with(&half) - 128.0 - 8.0 - 8.57).abs() < 0.01);
        // A picture is compared pixel by pixel, a model sees its own size.
        let wide = LightPreset {
            size: 2 * here.size,
            ..here
        };
        let by_picture = LightRun {
            by_model: false,
            ..model
        };
        assert!((model.seconds_with(&wide) - 8.0 - 8.0 - 8.0).abs() < 1e-9);
        assert!((by_picture.seconds_with(&wide) - 8.0 - 32.0 - 8.0).abs() < 1e-9);
        let open = run.outlook(Quality::Standard, &LightTable::default()).0;
        assert_eq!(open.len(), 2);
        assert!(open[0].seconds < open[1].seconds);
        let table = LightTable {
            iterations: Some(here.iterations),
            samples: Some(here.samples),
            size: Some(here.size),
            environment: Some(here.environment),
            ..LightTable::default()
        };
        // Nothing is left to a preset.
        assert_eq!(run.outlook(Quality::Standard, &table).0, []);
        let table = LightTable {
            size: None,
            ..table
        };
        let [draft, high] = run.outlook(Quality::Standard, &table).0[..] else {
            panic!("presets differ in size");
        };
        assert!(draft.seconds < 12.0 && high.seconds > 12.0);
        // No preset goes beyond the photograph.
        let small = LightRun {
            side: 64,
            photo_side: 64,
            ..run
        };
        assert_eq!(small.outlook(Quality::Standard, &table).0, []);
    }
}
