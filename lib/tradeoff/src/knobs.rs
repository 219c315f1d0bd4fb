//! The settings that buy accuracy for time, and the values that are tried.
use dipir_numerics::hashing::hash_u64s;
use dipir_pipeline::config::Quality;
use dipir_stages::presets;

/// Which part of the pipeline a knob belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The composite under a known light.
    Render,
    /// The light recovered from a picture.
    Light,
}

impl Part {
    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Part::Render => "render",
            Part::Light => "light",
        }
    }
}

/// A setting and the values that are tried.
pub struct Knob {
    /// In tables and legends.
    pub name: &'static str,
    /// Where it belongs.
    pub part: Part,
    /// The key of `pipeline.toml`.
    pub key: &'static str,
    /// As written behind `--set KEY=`.
    pub values: &'static [&'static str],
    /// Other keys that are set with it.
    pub with: &'static [(&'static str, &'static str)],
    /// Whether the joint search varies it.
    pub joint: bool,
}

/// A target that no run reaches, so that the number of samples decides.
const NEVER: &[(&str, &str)] = &[("composite.target_error", "0.00001")];

/// All knobs but the switches of effects, which depend on the scene.
pub const KNOBS: &[Knob] = &[
    Knob {
        name: "target error",
        part: Part::Render,
        key: "composite.target_error",
        values: &["0.016", "0.008", "0.004", "0.002", "0.001", "0.0005"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "samples, not adaptive",
        part: Part::Render,
        key: "composite.max_samples",
        values: &["16", "64", "256"],
        with: NEVER,
        joint: false,
    },
    Knob {
        name: "effects tolerance",
        part: Part::Render,
        key: "scene.effects.tolerance",
        values: &["0.0005", "0.001", "0.002", "0.004", "0.008", "0.016"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "depth",
        part: Part::Render,
        key: "scene.effects.max_depth",
        values: &["1", "2", "3", "5"],
        with: &[],
        joint: false,
    },
    Knob {
        name: "everything simulated",
        part: Part::Render,
        key: "scene.effects.mode",
        values: &["all"],
        with: &[],
        joint: false,
    },
    Knob {
        name: "iterations",
        part: Part::Light,
        key: "light.iterations",
        values: &["50", "150", "300", "600"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "lobes",
        part: Part::Light,
        key: "light.lobes",
        values: &["4", "8", "16", "32", "48"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "environment",
        part: Part::Light,
        key: "light.environment",
        values: &["[32, 16]", "[64, 32]", "[128, 64]", "[256, 128]"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "samples of the record",
        part: Part::Light,
        key: "light.samples",
        values: &["8", "32", "128", "512"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "size of the picture",
        part: Part::Light,
        key: "light.size",
        values: &["48", "96", "144"],
        with: &[],
        joint: true,
    },
    Knob {
        name: "weights in f32",
        part: Part::Light,
        key: "light.precision",
        values: &["single"],
        with: &[],
        joint: false,
    },
];

/// A configuration that is measured.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Variant {
    /// Which part.
    pub part: Part,
    /// The series it is drawn in.
    pub series: String,
    /// Its name within the series.
    pub label: String,
    /// Keys and values, for `--set`.
    pub set: Vec<(String, String)>,
}

impl Variant {
    fn new(part: Part, series: &str, label: &str, set: &[(&str, &str)]) -> Self {
        let own = |(k, v): &(&str, &str)| (k.to_string(), v.to_string());
        Self {
            part,
            series: series.into(),
            label: label.into(),
            set: set.iter().map(own).collect(),
        }
    }
}

/// Processor seconds to render a picture of 96 x 64 pixels to an error of 1: they grow with its inverse square (README).
const RENDER_S: f64 = 4e-6;
/// Those of all else in a run of scene and composite.
const SET_UP_S: f64 = 0.4;
/// Those of one sample in every pixel, about.
const SAMPLE_S: f64 = 0.004;

/// About how long a render to `error` takes, by which shares of a sweep are told.
pub fn render_cost(error: f64) -> f64 {
    SET_UP_S + RENDER_S * error.powi(-2)
}

impl Variant {
    /// About how long a run takes, by which shares of a sweep are told.
    pub fn cost(&self) -> f64 {
        let text = |key: &str| {
            self.set
                .iter()
                .find(|(k, _)| k == key)
                .map(|(_, v)| v.as_str())
        };
        let number = |key: &str| text(key).and_then(|v| v.parse::<f64>().ok());
        let preset = presets::of(match text("pipeline.quality") {
            Some("draft") => Quality::Draft,
            Some("high") => Quality::High,
            _ => Quality::Standard,
        });
        match self.part {
            Part::Render => match number("composite.max_samples") {
                Some(samples) => SET_UP_S + SAMPLE_S * samples,
                None => render_cost(
                    number("composite.target_error")
                        .unwrap_or(preset.composite.target_error.into()),
                ),
            },
            Part::Light => {
                let of = |key: &str, usual: f64| number(key).unwrap_or(usual) / usual;
                let steps = of("light.iterations", preset.light.iterations as f64);
                let paths = of("light.samples", preset.light.samples.into());
                // Paths are traced once, and looked at in every step.
                let steps_and_paths = 0.75 * steps + 0.25 * paths;
                preset.recovery.map_or(1.0, |r| r.cost_s) * steps_and_paths
            }
        }
    }
}

/// What `set` changes of the standard preset. Variants that change the same are measured once.
pub fn beyond_standard(set: &[(String, String)]) -> Vec<(String, String)> {
    let preset = presets::of(Quality::Standard);
    let standard = [
        ("pipeline.quality", "standard".to_owned()),
        (
            "composite.target_error",
            preset.composite.target_error.to_string(),
        ),
        ("light.iterations", preset.light.iterations.to_string()),
        ("light.lobes", preset.light.lobes.to_string()),
        (
            "light.environment",
            format!("{:?}", preset.light.environment),
        ),
        ("light.samples", preset.light.samples.to_string()),
    ];
    let is_standard =
        |(key, value): &(String, String)| standard.iter().any(|(k, v)| k == key && v == value);
    set.iter().filter(|s| !is_standard(s)).cloned().collect()
}

/// Series of the three presets.
pub const PRESETS: &str = "preset";
/// Series of the joint search.
pub const JOINT: &str = "joint search";

/// Series of effects that the scene can show, switched off one at a time.
const EFFECT_OFF: &str = "effect off";

/// Names of all series.
pub fn names() -> Vec<&'static str> {
    let knobs = KNOBS.iter().map(|k| k.name);
    [PRESETS]
        .into_iter()
        .chain(knobs)
        .chain([EFFECT_OFF, JOINT])
        .collect()
}

/// Everything that is measured of a part: presets, knobs one at a time, effects that are on by default
/// switched off, and `joint` random combinations, the same for every scene.
pub fn variants(part: Part, effects_on: &[String], joint: usize) -> Vec<Variant> {
    let mut all = Vec::new();
    for quality in ["draft", "standard", "high"] {
        all.push(Variant::new(
            part,
            PRESETS,
            quality,
            &[("pipeline.quality", quality)],
        ));
    }
    let knobs = || KNOBS.iter().filter(|k| k.part == part);
    for knob in knobs() {
        for value in knob.values {
            let mut set = knob.with.to_vec();
            set.push((knob.key, value));
            all.push(Variant::new(part, knob.name, value, &set));
        }
    }
    if part == Part::Render {
        for effect in effects_on {
            let key = format!("scene.effects.{effect}");
            all.push(Variant::new(part, EFFECT_OFF, effect, &[(&key, "off")]));
        }
    }
    let joint_knobs: Vec<&Knob> = knobs().filter(|k| k.joint).collect();
    for n in 0..joint {
        let pick = |(k, knob): (usize, &&Knob)| {
            let draw = hash_u64s(&[part as u64, n as u64, k as u64]);
            (
                knob.key,
                knob.values[(draw % knob.values.len() as u64) as usize],
            )
        };
        let set: Vec<(&str, &str)> = joint_knobs.iter().enumerate().map(pick).collect();
        let values: Vec<&str> = set.iter().map(|(_, v)| *v).collect();
        let variant = Variant::new(part, JOINT, &values.join(" "), &set);
        if !all.iter().any(|s| s.set == variant.set) {
            all.push(variant);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_the_standard_preset_change_nothing() {
        let all = variants(Part::Light, &[], 0);
        let mut same: Vec<&str> = Vec::new();
        for variant in &all {
            if beyond_standard(&variant.set).is_empty() {
                same.push(&variant.series);
            }
        }
        let expected = [
            PRESETS,
            "iterations",
            "lobes",
            "environment",
            "samples of the record",
        ];
        assert_eq!(same, expected);
        let render = variants(Part::Render, &[], 0);
        let same = render.iter().filter(|s| beyond_standard(&s.set).is_empty());
        assert_eq!(same.count(), 2);
    }

    #[test]
    fn a_run_to_a_smaller_error_costs_more() {
        let cost = |part, set: (&str, &str)| Variant::new(part, "", "", &[set]).cost();
        let error = |e| cost(Part::Render, ("composite.target_error", e));
        assert!(error("0.0005") > 15.0 * error("0.004"));
        let quality = |part, q| cost(part, ("pipeline.quality", q));
        for part in [Part::Render, Part::Light] {
            assert!(quality(part, "draft") < quality(part, "standard"));
            assert!(quality(part, "standard") < quality(part, "high"));
        }
        let steps = |n| cost(Part::Light, ("light.iterations", n));
        assert!(steps("50") < 0.5 * steps("600"));
    }

    #[test]
    fn every_variant_is_measured_once_and_the_joint_search_turns_several_knobs() {
        for part in [Part::Render, Part::Light] {
            let all = variants(part, &["shadow".into()], 10);
            for (n, a) in all.iter().enumerate() {
                assert_eq!(a.part, part);
                assert!(!all[..n].iter().any(|b| b.set == a.set), "{a:?}");
            }
            let joint = all.iter().filter(|s| s.series == JOINT);
            assert!(joint.clone().count() > 5);
            assert!(joint.into_iter().all(|s| s.set.len() >= 2));
            assert_eq!(all, variants(part, &["shadow".into()], 10));
        }
        let off = variants(Part::Render, &["shadow".into()], 0);
        assert!(
            off.iter()
                .any(|s| s.set == [("scene.effects.shadow".into(), "off".into())])
        );
    }
}
