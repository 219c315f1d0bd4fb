//! The scores that a report is made of, method by method.
use std::collections::BTreeMap;

use anyhow::{Context, bail};
use dipir_evaluation::results::read_json;

use crate::definition::Definition;
use crate::folder::{EvaluationFolder, SceneInfo, TRUTH};
use crate::methods::{self, Source};
use crate::score::Score;

/// A method's scores by scene.
pub(crate) struct Column {
    pub name: String,
    pub title: String,
    /// What all scores were made with.
    pub definition: Definition,
    pub scores: BTreeMap<String, Score>,
}

/// Scores of all methods: those of the table of methods in its order, then the others. Scores of scenes that have changed
/// since are left out; `earlier` gets a line for each method that has such.
pub(crate) fn read(
    evaluation: &EvaluationFolder,
    scenes: &[SceneInfo],
    earlier: &mut Vec<String>,
) -> anyhow::Result<Vec<Column>> {
    let digests: Vec<String> = scenes.iter().map(|s| evaluation.digest(s)).collect();
    let mut columns = Vec::new();
    for name in evaluation.methods()?.into_iter().filter(|n| n != TRUTH) {
        let mut scores = BTreeMap::new();
        let mut changed = Vec::new();
        for (scene, digest) in scenes.iter().zip(&digests) {
            let file = evaluation.run(&name, &scene.name).join("score.json");
            if file.is_file() {
                let score: Score = read_json(&file).with_context(|| {
                    format!(
                        "a score cannot be used; delete {} and run dipir-evaluate run again",
                        file.display()
                    )
                })?;
                match score.scene_digest.as_ref().is_none_or(|d| d == digest) {
                    true => drop(scores.insert(scene.name.clone(), score)),
                    false => changed.push(scene.name.as_str()),
                }
            }
        }
        if !changed.is_empty() {
            earlier.push(format!(
                "{name} has scores of scenes that have changed since, which are left out; run dipir-evaluate run again: {}",
                changed.join(", ")
            ));
        }
        if let Some(first) = scores.values().next() {
            refuse_mixture(&name, &scores)?;
            columns.push(Column {
                title: first.title.clone(),
                definition: first.definition.clone(),
                name,
                scores,
            });
        }
    }
    if columns.is_empty() && !earlier.is_empty() {
        bail!("no score is left to report: {}", earlier.join("; "));
    }
    if columns.is_empty() {
        bail!(
            "nothing has run in {}; run dipir-evaluate run first",
            evaluation.root().display()
        );
    }
    let order: Vec<String> = methods::read(None)?.into_iter().map(|m| m.name).collect();
    let place = |c: &Column| {
        order
            .iter()
            .position(|n| *n == c.name)
            .unwrap_or(order.len())
    };
    columns.sort_by_key(place);
    Ok(columns)
}

/// Refuses scores of one method that were not made alike.
fn refuse_mixture(name: &str, scores: &BTreeMap<String, Score>) -> anyhow::Result<()> {
    let mut all = scores.iter();
    let Some((first, Score { definition, .. })) = all.next() else {
        return Ok(());
    };
    let found = all.find_map(|(s, score)| Some((s, definition.unlike(&score.definition)?)));
    let Some((other, [a, b])) = found else {
        return Ok(());
    };
    let option = match definition.row.light {
        Source::Imported => "--environment-from and the folder of its maps".to_owned(),
        _ => format!("--method {name}"),
    };
    bail!(
        "the scores of the method \"{name}\" were made in more than one way: {first} with {a}, {other} with {b}; run \
         dipir-evaluate run with {option} and the same options for all scenes, or report on some scenes with --scene"
    )
}

#[cfg(test)]
pub(crate) mod tests {
    use dipir_evaluation::results::{write, write_json};
    use serde_json::json;

    use super::*;
    use crate::definition::tests::of;

    /// A score with this error.
    pub(crate) fn score(rmse_touched: f64, made: &Definition) -> Score {
        let picture = json!({"rmse": 0.0, "ssim": 1.0, "si_rmse": 0.0, "rmse_touched": rmse_touched,
            "si_rmse_object": 0.0});
        serde_json::from_value(json!({"key": "", "method": "m", "title": "M", "scene": "",
            "definition": made, "picture": picture, "light": null,
            "seconds": [["dipir-light", 2.0], ["dipir-composite", 1.0]], "peak_rss_bytes": 0}))
        .unwrap()
    }

    #[test]
    fn seconds_of_no_stage_are_zero_without_a_sign() {
        let mut score = score(0.1, &of("ours", "", &[]));
        score.seconds.clear();
        let seconds = (crate::metrics::SECONDS.of)(&score).unwrap();
        assert_eq!(format!("{seconds:.1}"), "0.0");
    }

    #[test]
    fn a_damaged_score_is_named_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let evaluation = EvaluationFolder::new(folder.path());
        let scene =
            json!({"name": "a", "made_from": "", "map": "", "exposure_ev": 0.0, "tone": "none"});
        let scene: SceneInfo = serde_json::from_value(scene).unwrap();
        let file = evaluation.run("m", "a").join("score.json");
        write(&file, "{").unwrap();
        let error = read(&evaluation, &[scene], &mut Vec::new())
            .map(|_| ())
            .unwrap_err();
        let wanted = format!("delete {} and run dipir-evaluate run again", file.display());
        assert!(format!("{error:#}").contains(&wanted), "{error:#}");
    }

    #[test]
    fn scores_of_one_method_that_were_not_made_alike_are_refused() {
        let scores = |other: Definition| -> BTreeMap<String, Score> {
            let first = of("ours", "embedded", &["lora.steps=200"]);
            [("a", first), ("b", other)]
                .map(|(n, d)| (n.to_owned(), score(0.1, &d)))
                .into()
        };
        refuse_mixture("ours", &scores(of("ours", "embedded", &["lora.steps=200"]))).unwrap();
        let message = |other| {
            refuse_mixture("ours", &scores(other))
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            message(of("ours", "embedded", &["lora.steps=500"])),
            "the scores of the method \"ours\" were made in more than one way: a with --set lora.steps=200, b with \
             --set lora.steps=500; run dipir-evaluate run with --method ours and the same options for all scenes, or \
             report on some scenes with --scene"
        );
        let other = message(of("ours", "sd", &["lora.steps=200"]));
        assert!(
            other.contains("a with the embedded model (embedded), b with the model sd"),
            "{other}"
        );
    }

    #[test]
    fn a_mixture_in_the_folder_is_refused_unless_the_scenes_that_are_chosen_are_alike() {
        let folder = tempfile::tempdir().unwrap();
        let evaluation = EvaluationFolder::new(folder.path());
        let scenes = ["a", "b"].map(|name| -> SceneInfo {
            serde_json::from_value(
                json!({"name": name, "made_from": "", "map": "", "exposure_ev": 0.0,
                "tone": "none"}),
            )
            .unwrap()
        });
        for (scene, set) in scenes.iter().zip(["lora.steps=1", "lora.steps=2"]) {
            let made = of("ours", "embedded", &[set]);
            let file = evaluation.run("ours", &scene.name).join("score.json");
            write_json(&file, &score(0.1, &made)).unwrap();
        }
        assert!(read(&evaluation, &scenes, &mut Vec::new()).is_err());
        let one = read(&evaluation, &scenes[..1], &mut Vec::new()).unwrap();
        assert_eq!(one[0].definition.set["lora.steps"], "1");
    }

    #[test]
    fn scores_of_a_scene_that_has_changed_since_are_left_out_and_the_report_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let evaluation = EvaluationFolder::new(folder.path());
        let scenes = ["a", "b"].map(|name| -> SceneInfo {
            serde_json::from_value(
                json!({"name": name, "made_from": "", "map": "map.exr", "exposure_ev": 0.0, "tone": "none"}),
            )
            .unwrap()
        });
        for scene in &scenes {
            let scored = Score {
                scene_digest: Some(evaluation.digest(scene)),
                ..score(0.1, &of("neutral", "", &[]))
            };
            let file = evaluation.run("neutral", &scene.name).join("score.json");
            write_json(&file, &scored).unwrap();
        }
        let found = |earlier: &mut Vec<String>| {
            let columns = read(&evaluation, &scenes, earlier).unwrap();
            columns[0].scores.keys().cloned().collect::<Vec<_>>()
        };
        let mut earlier = Vec::new();
        assert_eq!(found(&mut earlier), ["a", "b"]);
        assert!(earlier.is_empty());
        write(&evaluation.scene("b").join("photo.png"), "another").unwrap();
        assert_eq!(found(&mut earlier), ["a"]);
        assert_eq!(
            earlier,
            [
                "neutral has scores of scenes that have changed since, which are left out; run dipir-evaluate run again: b"
            ]
        );
        let mut earlier = Vec::new();
        let error = read(&evaluation, &scenes[1..], &mut earlier).map(|_| ());
        let text = error.unwrap_err().to_string();
        assert!(
            text.starts_with("no score is left to report: neutral has scores"),
            "{text}"
        );
    }
}
