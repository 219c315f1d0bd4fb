//! Concept images, and how the model was personalised.
use dipir_imaging::file::read_photo;
use dipir_imaging::transfer::Transfer;
use dipir_plotting::chart::Chart;
use serde_json::Value;

use super::curves::{noisy, over};
use super::html::Html;
use super::picture::figure;
use super::{Report, Section, json, outputs};
use crate::concepts::folder::ConceptList;
use crate::names::{CONCEPTS, LORA};

/// Longest side of a concept image.
const CONCEPT: usize = 128;
/// Longest side of a sample.
const SAMPLE: usize = 256;
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

fn losses(training: &Value) -> Vec<(&'static str, Chart)> {
    let none = Vec::new();
    let history = training["history"].as_array().unwrap_or(&none);
    let photograph = noisy(history, "step", "instance_loss", "the photograph", 0);
    let class = noisy(history, "step", "prior_loss", "the class", 1);
    let losses = photograph.into_iter().chain(class).collect();
    let norm = noisy(history, "step", "gradient_norm", "all", 2).into();
    vec![
        ("Loss of the personalisation", over("update", true, losses)),
        ("Norm of its gradient", over("update", true, norm)),
    ]
}
