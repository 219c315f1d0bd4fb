//! Why a stage has to run, by the keys that the user writes: manifests hold what decides outputs under names of their own.
use dipir_pipeline::fingerprint::StaleReason;

use crate::names::{COMPOSITE, CONCEPTS, LIGHT, LORA, SCENE};

/// Keys that choose what a stage does. What comes or goes with them needs no telling.
const CHOICES: [&str; 6] = [
    RECORD,
    "lora.path",
    "light.guidance",
    "light.start",
    "light.materials",
    "composite.environment",
];
/// Whether the scene stage records.
const RECORD: &str = "light transport";

/// A parameter: its key, what it was and what it is, as JSON.
type Change = (String, Option<String>, Option<String>);

/// Names the parameters in the `reasons` of `stage` by the user's keys, and leaves out what follows from others.
pub(crate) fn by_keys(stage: &str, reasons: &mut Vec<StaleReason>) {
    let is_parameter = |r: &StaleReason| matches!(r, StaleReason::Parameter { .. });
    let Some(first) = reasons.iter().position(is_parameter) else {
        return;
    };
    let mut changes: Vec<Change> = Vec::new();
    for reason in reasons.extract_if(.., |r| is_parameter(r)) {
        if let StaleReason::Parameter { key, was, now } = reason {
            add(&mut changes, named(stage, key, was, now));
        }
    }
    let has_seed = reasons
        .iter()
        .any(|r| matches!(r, StaleReason::Seed { .. }));
    let is_choice = |key: &str| CHOICES.iter().any(|choice| key.starts_with(choice));
    let is_chosen = changes.iter().any(|(key, ..)| is_choice(key));
    let follows = |(key, was, now): &Change| {
        let comes_or_goes = was.is_none() || now.is_none();
        // A start is read only where nothing else gives the light.
        let is_own = (is_choice(key) && key != "light.start") || key.starts_with("scene.");
        (is_chosen && comes_or_goes && !is_own) || (has_seed && key == "light.seed")
    };
    if !(reasons.is_empty() && changes.iter().all(follows)) {
        changes.retain(|change| !follows(change));
    }
    let told = changes.into_iter();
    let told = told.map(|(key, was, now)| StaleReason::Parameter { key, was, now });
    reasons.splice(first..first, told);
}

/// Adds a change to those of other keys. Two of one key are one, and none if nothing is left of them.
fn add(changes: &mut Vec<Change>, (key, was, now): Change) {
    let set = |v: Option<String>| v.filter(|v| !["null", "{}", "[]"].contains(&v.as_str()));
    let (was, now) = (set(was), set(now));
    match changes.iter().position(|c| c.0 == key) {
        Some(k) => {
            let earlier = changes.remove(k);
            add(changes, (key, earlier.1.or(was), earlier.2.or(now)));
        }
        None if was != now => changes.push((key, was, now)),
        None => {}
    }
}

/// A parameter of a manifest by the key that the user writes.
fn named(stage: &str, key: String, was: Option<String>, now: Option<String>) -> Change {
    let below = |table: &str| key.strip_prefix(table).and_then(|k| k.strip_prefix('.'));
    let composite = |k: &str| format!("composite.{k}");
    let light = |k: &str| match k {
        "light" => "light.recover_light".into(),
        "tone" => "light.recover_tone".into(),
        // Of a map, while materials are recovered.
        "environment" | "exposure_ev" | "rotation_deg" => composite(k),
        k if k == "tint" || k.starts_with("tint.") => composite(k),
        k => format!("light.{k}"),
    };
    let name = match (stage, key.as_str()) {
        (s, "transport") if s == SCENE.name => {
            let record = |v: &Option<String>| {
                Some(if v.is_some() { "absent" } else { "recorded" }.to_string())
            };
            return (RECORD.into(), record(&was), record(&now));
        }
        (_, "class") => "scene.class".into(),
        (_, "precision") => "model.precision".into(),
        (_, "prediction") => "model.prediction".into(),
        (s, "transfer") if s == LORA.name => "scene.transfer".into(),
        (s, _) if s == CONCEPTS.name || s == LORA.name => key.clone(),
        (s, _) if s == SCENE.name => below("transport").map_or_else(|| key.clone(), light),
        // Told by the environment.
        (s, "light.recovered") if s == COMPOSITE.name => return (key, None, None),
        (s, k) if s == COMPOSITE.name => composite(below("light").or(below("stop")).unwrap_or(k)),
        (s, "reading") if s == LIGHT.name => {
            let start = |v: Option<String>| {
                v.map(|v| match v.as_str() {
                    "true" => "\"read\"".into(),
                    "false" => "another".into(),
                    _ => v,
                })
            };
            return ("light.start".into(), start(was), start(now));
        }
        (s, "guidance" | "guidance.guidance") if s == LIGHT.name => "light.guidance".into(),
        (s, k) if s == LIGHT.name => match (below("light"), below("guidance"), below("estimate")) {
            (Some(k), ..) => light(k),
            (_, Some(k), _) => format!("light.{k}"),
            (_, _, Some("estimator")) => "the version of the light estimator".into(),
            (_, _, Some(k)) if k.starts_with("views") => format!("scene.{k}"),
            (_, _, Some(k)) => format!("light.{k}"),
            _ if k == "tone" => composite(k),
            _ => format!("light.{k}"),
        },
        _ => key.clone(),
    };
    (name, was, now)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use dipir_pipeline::fingerprint::{in_words, parameter_changes};

    use super::*;

    fn told(stage: &str, was: Value, now: Value) -> String {
        let mut reasons = parameter_changes(&was, &now);
        by_keys(stage, &mut reasons);
        in_words(&reasons)
    }

    #[test]
    fn parameters_are_named_as_the_user_writes_them() {
        let stop = |key: &str, v: f64| json!({"light": {"recovered": true, "exposure_ev": v}, "stop": {key: v}, "tone": null});
        for (stage, was, now, expected) in [
            (
                "composite",
                stop("target_error", 0.5),
                stop("time_budget_s", 2.0),
                "composite.exposure_ev changed from 0.5 to 2.0; composite.target_error changed from 0.5 to unset; \
                 composite.time_budget_s changed from unset to 2.0",
            ),
            (
                "light",
                json!({"light": {"light": true, "size": 96, "learning_rates": {"tone": 0.1}}, "guidance": {"draws": 1}}),
                json!({"light": {"light": false, "size": 48, "learning_rates": {"tone": 0.2}}, "guidance": {"draws": 2}}),
                "light.draws changed from 1 to 2; light.learning_rates.tone changed from 0.1 to 0.2; \
                 light.recover_light changed from true to false; light.size changed from 96 to 48",
            ),
            (
                "light",
                json!({"estimate": {"sun": null, "candidate": 1, "views": []}}),
                json!({"estimate": {"sun": {"azimuth_deg": 60.0, "time": null}, "candidate": null, "views": [{"exposure_stops": 1.0}]}}),
                "light.candidate changed from 1 to unset; light.sun.azimuth_deg changed from unset to 60.0; \
                 scene.views.0.exposure_stops changed from unset to 1.0",
            ),
            (
                "light",
                json!({"materials": ["a"], "tone": null, "light": {"environment": "a", "exposure_ev": 0.0}}),
                json!({"materials": ["b"], "tone": "reinhard", "light": {"environment": "a", "exposure_ev": 1.0}}),
                "composite.exposure_ev changed from 0.0 to 1.0; light.materials.0 changed from \"a\" to \"b\"",
            ),
            (
                "lora",
                json!({"class": "a", "lora": {"rank": 4}, "transfer": "srgb", "precision": "f32"}),
                json!({"class": "b", "lora": {"rank": 8}, "transfer": "linear", "precision": "bf16", "prediction": "epsilon"}),
                "scene.class changed from \"a\" to \"b\"; lora.rank changed from 4 to 8; \
                 model.precision changed from \"f32\" to \"bf16\"; model.prediction changed from unset to \"epsilon\"; \
                 scene.transfer changed from \"srgb\" to \"linear\"",
            ),
            (
                "scene",
                json!({"scene": {"effects": {}}, "transport": {"size": 96}}),
                json!({"scene": {"effects": {"shadow": "off"}}, "transport": {"size": 48}}),
                "scene.effects.shadow changed from unset to \"off\"; light.size changed from 96 to 48",
            ),
        ] {
            assert_eq!(told(stage, was, now), expected);
        }
    }

    #[test]
    fn a_choice_stands_for_what_comes_and_goes_with_it() {
        let estimated = || json!({"lobes": 16, "start": "auto", "visible": true, "estimate": {"estimator": 4, "sun": null}});
        let guided = json!({"light": {"lobes": 16, "light": true}, "guidance": "reference", "visible": false});
        assert_eq!(
            told("light", estimated(), guided),
            "light.guidance changed from unset to \"reference\"; light.visible changed from true to false"
        );
        let neutral = json!({"lobes": 16, "start": "neutral", "visible": true, "size": 96});
        assert_eq!(
            told("light", estimated(), neutral),
            "light.start changed from \"auto\" to \"neutral\""
        );
        let own = json!({"lora": {"path": "a.safetensors", "word": "sks"}, "precision": "f32"});
        assert_eq!(
            told(
                "lora",
                json!({"lora": {"rank": 4, "word": "sks"}, "precision": "f32"}),
                own
            ),
            "lora.path changed from unset to \"a.safetensors\""
        );
        let recorded =
            json!({"scene": {"class": null}, "transport": {"size": 96, "environment": [64, 32]}});
        assert_eq!(
            told(
                "scene",
                json!({"scene": {"occluders": "a.png"}, "transport": null}),
                recorded
            ),
            "scene.occluders changed from \"a.png\" to unset; light transport changed from absent to recorded"
        );
        let map = json!({"light": {"environment": "sky.hdr", "exposure_ev": 0.0}});
        assert_eq!(
            told(
                "composite",
                json!({"light": {"recovered": true, "exposure_ev": 0.0}}),
                map
            ),
            "composite.environment changed from unset to \"sky.hdr\""
        );
    }
}
