//! Concept images, and how the model was personalised.
use std::path::PathBuf;

use dipir_imaging::file::read_photo;
use dipir_imaging::transfer::Transfer;
use dipir_pipeline::manifest::Manifest;
use dipir_plotting::chart::Chart;
use serde_json::Value;

use super::curves::{column, noisy, over};
use super::html::Html;
use super::picture::figure;
use super::{Report, Section, json, outputs};
use crate::concepts::folder::ConceptList;
use crate::names::{CONCEPTS, LORA};

/// Longest side of a concept image.
const CONCEPT: usize = 128;
/// Longest side of a sample.
const SAMPLE: usize = 256;
/// Longest side of the sheet of what the adapter changes.
const SHEET: usize = 840;
/// Concept images that are shown at most.
const MOST_CONCEPTS: usize = 64;

/// Concept images, the course of the loss, samples.
pub fn section(report: &Report) -> Section {
    let mut parts = Vec::new();
    if let Some(run) = report.stage(CONCEPTS.name)? {
        let list: ConceptList = json(&run, "concepts")?;
        let mut figures = Vec::new();
        for entry in list.concepts.iter().take(MOST_CONCEPTS) {
            let photo = read_photo(run.0.join(&entry.image), Transfer::Srgb)?;
            let shown = Transfer::Srgb.encode(&photo.image);
            figures.push(figure(&shown, CONCEPT, &entry.concept.prompt)?);
        }
        let note = format!(
            "{} images of \"{}\", which keep the class in memory",
            list.concepts.len(),
            list.class
        );
        parts.push(Html::element("p", &[("class", "soft")], [Html::text(note)]));
        parts.push(Html::element("div", &[("class", "grid-of small")], figures));
    }
    if let Some(run) = report.stage(LORA.name)? {
        let training: Value = json(&run, "training")?;
        let plots = losses(&training);
        let plots = plots.iter().filter_map(|(t, c)| Html::chart(t, c));
        parts.push(Html::element("div", &[("class", "plots")], plots));
        parts.extend(change(&run, &training)?);
        let mut samples = Vec::new();
        for (name, path) in outputs(&run, "sample") {
            let shown = Transfer::Srgb.encode(&read_photo(path, Transfer::Srgb)?.image);
            let caption = format!("after {} updates", name.trim_start_matches('0'));
            samples.push(figure(&shown, SAMPLE, &caption)?);
        }
        parts.push(Html::element("div", &[("class", "grid-of")], samples));
    }
    Ok((!parts.is_empty()).then(|| Html::all(parts)))
}

/// What the adapter changed: in words, and the sheet.
fn change(run: &(PathBuf, Manifest), training: &Value) -> anyhow::Result<Vec<Html>> {
    let mut parts = Vec::new();
    if let Some(path) = training["own"]["path"].as_str() {
        let note = format!(
            "The adapter was read from {path} ({} layers), not trained on the photograph.",
            training["own"]["layers"]
        );
        parts.push(Html::element("p", &[("class", "soft")], [Html::text(note)]));
    }
    let rows = training["validation"].as_array();
    if let Some((first, last)) = rows.and_then(|r| Some((r.first()?, r.last()?))) {
        let number = |row: &Value, key: &str| row[key].as_f64().unwrap_or(f64::NAN);
        let note = format!(
            "At fixed crops, timesteps and noise the photograph's loss went from {:.4} to {:.4}; the loss of single updates \
             hangs on their noise. The adapter moves the prediction under the photograph's caption by {:.1}% of its size.",
            number(first, "instance_loss"),
            number(last, "instance_loss"),
            100.0 * number(last, "change")
        );
        parts.push(Html::element("p", &[("class", "soft")], [Html::text(note)]));
    }
    for (_, path) in outputs(run, "sheet") {
        let shown = Transfer::Srgb.encode(&read_photo(path, Transfer::Srgb)?.image);
        let prompts = training["sheet"]["prompts"].as_array();
        let prompts: Vec<&str> = prompts
            .into_iter()
            .flatten()
            .filter_map(Value::as_str)
            .collect();
        let caption = format!(
            "The same noise without the adapter (left) and with it (right). From the top: {}",
            prompts.join("; ")
        );
        parts.push(figure(&shown, SHEET, &caption)?);
    }
    Ok(parts)
}

fn losses(training: &Value) -> Vec<(&'static str, Chart)> {
    let none = Vec::new();
    let history = training["history"].as_array().unwrap_or(&none);
    let photograph = noisy(history, "step", "instance_loss", "the photograph", 0);
    let class = noisy(history, "step", "prior_loss", "the class", 1);
    let fixed = training["validation"].as_array().unwrap_or(&none);
    let at_fixed = |key, name, color| column(fixed, "step", key, name, color);
    let mut validated = vec![at_fixed("instance_loss", "the photograph", 0)];
    if fixed.iter().any(|row| row["prior_loss"] != 0.0) {
        validated.push(at_fixed("prior_loss", "the class", 1));
    }
    let losses = photograph.into_iter().chain(class).collect();
    let norm = noisy(history, "step", "gradient_norm", "all", 2).into();
    vec![
        (
            "Loss at fixed crops, timesteps and noise",
            over("update", true, validated),
        ),
        ("Loss of single updates", over("update", true, losses)),
        ("Norm of the gradient", over("update", true, norm)),
    ]
}
