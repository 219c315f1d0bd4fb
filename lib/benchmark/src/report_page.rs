//! The report as a page, with the pictures of every scene.
use std::path::Path;

use crate::folder::{EvaluationFolder, SceneInfo, TRUTH};
use crate::metrics::COMPARED;
use crate::page::{Page, image, text};
use crate::report::Report;

impl Report {
    /// The page, with the pictures of `scenes`.
    pub(crate) fn html(
        &self,
        evaluation: &EvaluationFolder,
        scenes: &[SceneInfo],
    ) -> anyhow::Result<String> {
        let mut page = Page::new("Evaluation");
        page.push(&format!(
            "<p class=\"soft\">Medians over scenes with 95% bootstrap intervals; {} scenes.</p>",
            scenes.len()
        ));
        push_table(&mut page, &self.table());
        page.push("<ul class=\"soft\">");
        for metric in &self.metrics {
            let (name, about) = (text(metric.name), text(metric.about));
            page.push(&format!("<li>{name}: {about}</li>"));
        }
        // What seconds are is among the metrics already.
        for note in &self.notes[1..] {
            page.push(&format!("<li>{}</li>", text(note)));
        }
        page.push("</ul>");
        if !self.kinds.is_empty() {
            page.push(&format!("<h2>{} by kind of place</h2>", COMPARED.name));
            push_table(&mut page, &self.kinds_table());
        }
        for scene in scenes {
            self.push_scene(&mut page, evaluation, scene)?;
        }
        Ok(page.finish())
    }

    /// The photograph, the truth, and what each method made of it.
    fn push_scene(
        &self,
        page: &mut Page,
        evaluation: &EvaluationFolder,
        scene: &SceneInfo,
    ) -> anyhow::Result<()> {
        page.push(&format!(
            "<h2>{}</h2><p class=\"soft\">{}</p><div class=\"grid\">",
            text(&scene.name),
            text(&scene.made_from)
        ));
        let photo = evaluation.scene(&scene.name).join("photo.png");
        page.push(&figure(&photo, "photograph", "")?);
        let truth = evaluation.picture(TRUTH, &scene.name);
        page.push(&figure(&truth, "truth", "")?);
        for column in &self.columns {
            if let Some(score) = column.scores.get(&scene.name) {
                let error = (COMPARED.of)(score).map_or(String::new(), |v| format!("{v:.4}"));
                let path = evaluation.picture(&column.name, &scene.name);
                page.push(&figure(&path, &column.title, &error)?);
            }
        }
        page.push("</div>");
        Ok(())
    }
}

/// Adds a table whose first row is its head.
fn push_table(page: &mut Page, rows: &[Vec<String>]) {
    let line = |tag: &str, cells: &[String]| {
        let cells = cells.iter().map(|c| format!("<{tag}>{}</{tag}>", text(c)));
        format!("<tr>{}</tr>", cells.collect::<String>())
    };
    let [head, body @ ..] = rows else { return };
    page.push("<div class=\"wide\"><table><thead>");
    page.push(&line("th", head));
    page.push("</thead><tbody>");
    body.iter().for_each(|row| page.push(&line("td", row)));
    page.push("</tbody></table></div>");
}

/// A picture with its title and a note; nothing if it is not there.
fn figure(path: &Path, title: &str, note: &str) -> anyhow::Result<String> {
    if !path.is_file() {
        return Ok(String::new());
    }
    Ok(format!(
        "<figure>{}<figcaption>{} <span>{}</span></figcaption></figure>",
        image(path, title)?,
        text(title),
        text(note)
    ))
}
