//! All scores, as JSON, CSV, a table in Markdown, and a page with the pictures side by side.
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::bail;
use dipir_cli::exit::Usage;
use dipir_evaluation::lpips::Lpips;
use dipir_evaluation::summary::Summary;
use dipir_imaging::raster::DisplayImage;
use serde_json::{Value, json};

use crate::bench::{Bench, SceneInfo, read_json, write, write_json};
use crate::cli::ReportArgs;
use crate::methods;
use crate::page::{Page, image, text};
use crate::run::{Score, Shown, TRUTH};

/// Seed of every bootstrap.
const SEED: u64 = 1;

/// A number of a score.
struct Metric {
    name: &'static str,
    /// In words, for the page.
    about: &'static str,
    digits: usize,
    of: fn(&Score) -> Option<f64>,
}

static METRICS: [Metric; 9] = [
    Metric {
        name: "RMSE",
        about: "display-referred, all pixels; less is better",
        digits: 4,
        of: |s| s.picture.map(|p| p.rmse),
    },
    Metric {
        name: "RMSE touched",
        about: "the same, over what object or shadow touch",
        digits: 4,
        of: |s| s.picture.map(|p| p.rmse_touched),
    },
    Metric {
        name: "SSIM",
        about: "structural similarity, all pixels; more is better",
        digits: 4,
        of: |s| s.picture.map(|p| p.ssim),
    },
    Metric {
        name: "si-RMSE",
        about: "RMSE after the best scale, all pixels",
        digits: 4,
        of: |s| s.picture.map(|p| p.si_rmse),
    },
    Metric {
        name: "si-RMSE object",
        about: "the same, over the object alone",
        digits: 4,
        of: |s| s.picture.map(|p| p.si_rmse_object),
    },
    Metric {
        name: "LPIPS",
        about: "learned perceptual distance with AlexNet, all pixels; less is better",
        digits: 4,
        of: |s| s.lpips,
    },
    Metric {
        name: "peak, degrees",
        about: "between the directions of most light",
        digits: 1,
        of: |s| s.light.and_then(|l| l.peak_deg),
    },
    Metric {
        name: "mean, degrees",
        about: "between the mean directions that light comes from",
        digits: 1,
        of: |s| s.light.and_then(|l| l.mean_deg),
    },
    Metric {
        name: "seconds",
        about: "of all stages of one scene; shared stages count where they ran",
        digits: 1,
        of: |s| Some(s.seconds.iter().map(|(_, t)| t).sum()),
    },
];

/// The metric by which methods are compared with the baseline.
const COMPARED: usize = 1;

/// A method's scores by scene.
struct Column {
    name: String,
    title: String,
    scores: BTreeMap<String, Score>,
}

/// Writes the report.
pub fn run(args: &ReportArgs) -> anyhow::Result<()> {
    let bench = Bench::new(&args.folder.out);
    let scenes = bench.chosen(&args.scene)?;
    let mut columns = read(&bench, &scenes)?;
    if let Some(file) = &args.lpips {
        add_lpips(&bench, &Lpips::load(file)?, &mut columns)?;
    }
    let baseline = baseline(args, &columns)?;
    let report = Report::new(columns, baseline);
    let files = ["json", "csv", "md", "html"].map(|e| bench.root().join(format!("report.{e}")));
    write_json(&files[0], &report.json())?;
    write(&files[1], report.csv())?;
    let table = report.markdown();
    write(&files[2], &table)?;
    write(&files[3], report.html(&bench, &scenes)?)?;
    args.folder.output.result(
        || {
            let names: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
            format!("{}\nwrote {}", table.trim_end(), names.join(", "))
        },
        || json!({"files": files}),
    );
    Ok(())
}

/// Scores of all methods, in the order of the table of methods, others behind.
fn read(bench: &Bench, scenes: &[SceneInfo]) -> anyhow::Result<Vec<Column>> {
    let mut columns = Vec::new();
    for name in bench.methods()?.into_iter().filter(|n| n != TRUTH) {
        let mut scores = BTreeMap::new();
        for scene in scenes {
            let file = bench.run(&name, &scene.name).join("score.json");
            if file.is_file() {
                let score: Score = read_json(&file)?;
                scores.insert(scene.name.clone(), score);
            }
        }
        if let Some(title) = scores.values().next().map(|s| s.title.clone()) {
            columns.push(Column {
                name,
                title,
                scores,
            });
        }
    }
    if columns.is_empty() {
        bail!(
            "nothing has run in {}; run dipir-evaluate run first",
            bench.root().display()
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

/// Adds LPIPS to the scores of pictures.
fn add_lpips(bench: &Bench, network: &Lpips, columns: &mut [Column]) -> anyhow::Result<()> {
    let picture = |method: &str, scene: &str| -> anyhow::Result<DisplayImage> {
        let file = bench.run(method, scene).join("composite/composite.exr");
        Ok(Shown::read(&file)?.picture)
    };
    let mut truths = BTreeMap::new();
    for column in columns {
        for (scene, score) in &mut column.scores {
            if !truths.contains_key(scene) {
                truths.insert(scene.clone(), picture(TRUTH, scene)?);
            }
            let found = picture(&column.name, scene)?;
            score.lpips = Some(network.distance(&found, &truths[scene])?);
        }
    }
    Ok(())
}

/// The metrics that some score has.
fn told(columns: &[Column]) -> Vec<&'static Metric> {
    let has = |m: &&Metric| {
        let mut scores = columns.iter().flat_map(|c| c.scores.values());
        scores.any(|s| (m.of)(s).is_some())
    };
    METRICS.iter().filter(has).collect()
}

/// The column that others are compared with.
fn baseline(args: &ReportArgs, columns: &[Column]) -> anyhow::Result<Option<usize>> {
    let find = |name: &str| columns.iter().position(|c| c.name == name);
    match &args.baseline {
        Some(name) => match find(name) {
            Some(k) => Ok(Some(k)),
            None => {
                let names: Vec<&str> = columns.iter().map(|c| c.name.as_str()).collect();
                Err(Usage(format!("--baseline {name}: accepted: {}", names.join(", "))).into())
            }
        },
        None => Ok(find("ours").or_else(|| find("neutral"))),
    }
}

/// What is said of one method.
struct Row {
    metrics: Vec<Option<Summary>>,
    /// Of the differences from the baseline, scene by scene, in the compared metric.
    beside: Option<Summary>,
}

/// All that is told.
struct Report {
    columns: Vec<Column>,
    metrics: Vec<&'static Metric>,
    /// The column that others are compared with.
    baseline: Option<usize>,
    /// One for each column.
    rows: Vec<Row>,
}

impl Report {
    fn new(columns: Vec<Column>, baseline: Option<usize>) -> Self {
        let metrics = told(&columns);
        let compared = METRICS[COMPARED].of;
        let row = |(k, column): (usize, &Column)| {
            let all = |of: fn(&Score) -> Option<f64>| -> Vec<f64> {
                column.scores.values().filter_map(of).collect()
            };
            let beside = baseline.filter(|b| *b != k).and_then(|b| {
                let difference = |(scene, score): (&String, &Score)| {
                    let other = columns[b].scores.get(scene).and_then(compared)?;
                    Some(compared(score)? - other)
                };
                let all: Vec<f64> = column.scores.iter().filter_map(difference).collect();
                Summary::of(&all, SEED)
            });
            Row {
                metrics: metrics
                    .iter()
                    .map(|m| Summary::of(&all(m.of), SEED))
                    .collect(),
                beside,
            }
        };
        let rows = columns.iter().enumerate().map(row).collect();
        Self {
            columns,
            metrics,
            baseline,
            rows,
        }
    }

    /// Head of the differences from the baseline.
    fn beside(&self) -> Option<String> {
        let title = &self.columns[self.baseline?].title;
        Some(format!("{} less that of {title}", METRICS[COMPARED].name))
    }

    fn json(&self) -> Value {
        let methods = self.columns.iter().zip(&self.rows).map(|(column, row)| {
            let medians: BTreeMap<&str, &Option<Summary>> = self
                .metrics
                .iter()
                .map(|m| m.name)
                .zip(&row.metrics)
                .collect();
            json!({
                "name": column.name, "title": column.title, "medians": medians,
                "beside_baseline": row.beside, "scores": column.scores.values().collect::<Vec<_>>(),
            })
        });
        json!({
            "baseline": self.baseline.map(|b| &self.columns[b].name),
            "compared_by": METRICS[COMPARED].name,
            "methods": methods.collect::<Vec<_>>(),
        })
    }

    fn csv(&self) -> String {
        let heads: Vec<&str> = self.metrics.iter().map(|m| m.name).collect();
        let mut out = format!("method,scene,\"{}\"\n", heads.join("\",\""));
        for column in &self.columns {
            for (scene, score) in &column.scores {
                let cell = |m: &&Metric| (m.of)(score).map_or(String::new(), |v| v.to_string());
                let cells: Vec<String> = self.metrics.iter().map(cell).collect();
                let _ = writeln!(out, "{},{scene},{}", column.name, cells.join(","));
            }
        }
        out
    }

    fn markdown(&self) -> String {
        let mut out = String::from("| method | scenes |");
        for metric in &self.metrics {
            let _ = write!(out, " {} |", metric.name);
        }
        let beside = self.beside();
        if let Some(head) = &beside {
            let _ = write!(out, " {head} |");
        }
        out += "\n|---|--:|";
        out += &"---|".repeat(self.metrics.len() + usize::from(beside.is_some()));
        out.push('\n');
        for (column, row) in self.columns.iter().zip(&self.rows) {
            let _ = write!(out, "| {} | {} |", column.title, column.scores.len());
            for (metric, summary) in self.metrics.iter().zip(&row.metrics) {
                let _ = write!(out, " {} |", cell(summary, metric.digits));
            }
            if beside.is_some() {
                let _ = write!(out, " {} |", cell(&row.beside, METRICS[COMPARED].digits));
            }
            out.push('\n');
        }
        out
    }

    /// The page, with the pictures of `scenes`.
    fn html(&self, bench: &Bench, scenes: &[SceneInfo]) -> anyhow::Result<String> {
        let mut page = Page::new("Evaluation");
        page.push(&format!(
            "<p class=\"soft\">Medians over scenes with 95% bootstrap intervals; {} scenes.</p>",
            scenes.len()
        ));
        page.push("<div class=\"wide\"><table><thead><tr><th>method</th><th>scenes</th>");
        for metric in &self.metrics {
            page.push(&format!(
                "<th title=\"{}\">{}</th>",
                text(metric.about),
                text(metric.name)
            ));
        }
        let beside = self.beside();
        if let Some(head) = &beside {
            page.push(&format!("<th>{}</th>", text(head)));
        }
        page.push("</tr></thead><tbody>");
        for (column, row) in self.columns.iter().zip(&self.rows) {
            page.push(&format!(
                "<tr><td>{}</td><td>{}</td>",
                text(&column.title),
                column.scores.len()
            ));
            for (metric, summary) in self.metrics.iter().zip(&row.metrics) {
                page.push(&format!("<td>{}</td>", text(&cell(summary, metric.digits))));
            }
            if beside.is_some() {
                page.push(&format!(
                    "<td>{}</td>",
                    text(&cell(&row.beside, METRICS[COMPARED].digits))
                ));
            }
            page.push("</tr>");
        }
        page.push("</tbody></table></div><ul class=\"soft\">");
        for metric in &self.metrics {
            page.push(&format!(
                "<li>{}: {}</li>",
                text(metric.name),
                text(metric.about)
            ));
        }
        page.push("</ul>");
        for scene in scenes {
            page.push(&format!(
                "<h2>{}</h2><p class=\"soft\">{}</p><div class=\"grid\">",
                text(&scene.name),
                text(&scene.made_from)
            ));
            page.push(&figure(
                &bench.scene(&scene.name).join("photo.png"),
                "photograph",
                "",
            )?);
            page.push(&figure(&picture(bench, TRUTH, &scene.name), "truth", "")?);
            for column in &self.columns {
                if let Some(score) = column.scores.get(&scene.name) {
                    let said = (METRICS[COMPARED].of)(score);
                    let said = said.map_or(String::new(), |v| format!("{v:.4}"));
                    let path = picture(bench, &column.name, &scene.name);
                    page.push(&figure(&path, &column.title, &said)?);
                }
            }
            page.push("</div>");
        }
        Ok(page.finish())
    }
}

fn cell(summary: &Option<Summary>, digits: usize) -> String {
    summary.as_ref().map_or("-".into(), |s| s.text(digits))
}

/// Where a method's picture of a scene is.
pub fn picture(bench: &Bench, method: &str, scene: &str) -> PathBuf {
    bench.run(method, scene).join("composite/composite.png")
}

fn figure(path: &Path, title: &str, said: &str) -> anyhow::Result<String> {
    if !path.is_file() {
        return Ok(String::new());
    }
    Ok(format!(
        "<figure>{}<figcaption>{} <span>{}</span></figcaption></figure>",
        image(path, title)?,
        text(title),
        text(said)
    ))
}
