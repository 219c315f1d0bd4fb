//! All scores as JSON, CSV, tables in Markdown, and a page with the pictures side by side.
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::PathBuf;

use dipir_cli::exit::Usage;
use dipir_evaluation::lpips::Lpips;
use dipir_evaluation::results::{write, write_json};
use dipir_evaluation::scores::DisplayedComposite;
use dipir_evaluation::summary::Summary;
use dipir_imaging::raster::DisplayImage;
use serde_json::{Value, json};

use crate::columns::{Column, read};
use crate::command_line::ReportArgs;
use crate::folder::{EvaluationFolder, SceneInfo, TRUTH};
use crate::metrics::{COMPARED, METRICS, Metric, SECONDS};
use crate::score::Score;

/// Seed of every bootstrap.
const SEED: u64 = 1;

/// A report that was written.
pub struct Written {
    /// Its files: JSON, CSV, Markdown, HTML.
    pub files: [PathBuf; 4],
    /// The tables in Markdown.
    pub tables: String,
}

/// Writes the report.
///
/// # Errors
/// If nothing has run, a score cannot be read, or the arguments name what is not there.
pub fn report(args: &ReportArgs) -> anyhow::Result<Written> {
    let evaluation = EvaluationFolder::new(&args.folder.out);
    let scenes = evaluation.chosen(&args.scene)?;
    let mut earlier = Vec::new();
    let mut columns = read(&evaluation, &scenes, &mut earlier)?;
    if let Some(file) = &args.lpips {
        add_lpips(&evaluation, &Lpips::load(file)?, &mut columns)?;
    }
    let baseline = baseline(args, &columns)?;
    let mut report = Report::new(columns, baseline, &scenes);
    report.notes.extend(earlier);
    let files =
        ["json", "csv", "md", "html"].map(|e| evaluation.root().join(format!("report.{e}")));
    write_json(&files[0], &report.json())?;
    write(&files[1], report.csv())?;
    let tables = report.markdown();
    write(&files[2], &tables)?;
    write(&files[3], report.html(&evaluation, &scenes)?)?;
    Ok(Written { files, tables })
}

/// Adds LPIPS to the scores of pictures.
fn add_lpips(
    evaluation: &EvaluationFolder,
    network: &Lpips,
    columns: &mut [Column],
) -> anyhow::Result<()> {
    let picture = |method: &str, scene: &str| -> anyhow::Result<DisplayImage> {
        let file = evaluation
            .run(method, scene)
            .join("composite/composite.exr");
        Ok(DisplayedComposite::read(&file)?.picture)
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
fn present(columns: &[Column]) -> Vec<&'static Metric> {
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

/// Medians of one method.
pub(crate) struct Row {
    pub metrics: Vec<Option<Summary>>,
    /// Of the differences from the baseline, scene by scene, in the compared metric.
    pub difference: Option<Summary>,
}

/// Medians of the compared metric over the scenes of one kind of place.
pub(crate) struct KindRow {
    pub kind: String,
    pub scenes: usize,
    /// One for each method.
    pub medians: Vec<Option<Summary>>,
}

/// All that is reported.
pub(crate) struct Report {
    pub columns: Vec<Column>,
    pub metrics: Vec<&'static Metric>,
    /// The column that others are compared with.
    pub baseline: Option<usize>,
    /// One for each column.
    pub rows: Vec<Row>,
    /// What the table does not say, a line each: what seconds are, what methods were made with, which are not compared.
    pub notes: Vec<String>,
    /// One for each kind of place that is known.
    pub kinds: Vec<KindRow>,
}

impl Report {
    fn new(columns: Vec<Column>, baseline: Option<usize>, scenes: &[SceneInfo]) -> Self {
        let metrics = present(&columns);
        // What separates a method from the one that others are compared with.
        let apart = |k: usize| {
            let b = baseline.filter(|b| *b != k)?;
            columns[k].definition.unlike_shared(&columns[b].definition)
        };
        let row = |(k, column): (usize, &Column)| {
            let summary = |m: &&Metric| {
                let values: Vec<f64> = column.scores.values().filter_map(m.of).collect();
                Summary::of(&values, SEED)
            };
            Row {
                metrics: metrics.iter().map(summary).collect(),
                difference: baseline
                    .filter(|b| *b != k && apart(k).is_none())
                    .and_then(|b| difference(column, &columns[b])),
            }
        };
        let rows = columns.iter().enumerate().map(row).collect();
        let mut notes = vec![format!("{}: {}", SECONDS.name, SECONDS.about)];
        notes.extend(made_with(&columns));
        for (k, column) in columns.iter().enumerate() {
            if let (Some([own, other]), Some(b)) = (apart(k), baseline) {
                notes.push(format!(
                    "{} is not compared with {}: it was made with {own}, the other with {other}",
                    column.title, columns[b].title
                ));
            }
        }
        let kinds: BTreeSet<&String> = scenes.iter().filter_map(|s| s.kind.as_ref()).collect();
        let kinds = kinds.into_iter().map(|k| KindRow::new(k, scenes, &columns));
        Self {
            kinds: kinds.collect(),
            columns,
            metrics,
            baseline,
            rows,
            notes,
        }
    }

    /// Head of the differences from the baseline.
    pub(crate) fn difference_head(&self) -> Option<String> {
        let title = &self.columns[self.baseline?].title;
        Some(format!("{} less that of {title}", COMPARED.name))
    }

    fn json(&self) -> Value {
        let methods = self.columns.iter().zip(&self.rows).map(|(column, row)| {
            let names = self.metrics.iter().map(|m| m.name);
            let medians: BTreeMap<&str, &Option<Summary>> = names.zip(&row.metrics).collect();
            json!({
                "name": column.name, "title": column.title, "definition": column.definition, "medians": medians,
                "beside_baseline": row.difference, "scores": column.scores.values().collect::<Vec<_>>(),
            })
        });
        let kinds = self.kinds.iter().map(|row| {
            let names = self.columns.iter().map(|c| c.name.as_str());
            let medians: BTreeMap<&str, &Option<Summary>> = names.zip(&row.medians).collect();
            json!({"kind": row.kind, "scenes": row.scenes, "medians": medians})
        });
        json!({
            "baseline": self.baseline.map(|b| &self.columns[b].name),
            "compared_by": COMPARED.name,
            "methods": methods.collect::<Vec<_>>(),
            "kinds": kinds.collect::<Vec<_>>(),
            "notes": self.notes,
        })
    }

    fn csv(&self) -> String {
        let heads: Vec<&str> = self.metrics.iter().map(|m| m.name).collect();
        let mut out = format!(
            "method,scene,\"{}\",\"stages in seconds\",model,set,\"target error\"\n",
            heads.join("\",\"")
        );
        for column in &self.columns {
            for (scene, score) in &column.scores {
                let cell = |m: &&Metric| (m.of)(score).map_or(String::new(), |v| v.to_string());
                let cells: Vec<String> = self.metrics.iter().map(cell).collect();
                let ran: Vec<&str> = score.seconds.iter().map(|(s, _)| s.as_str()).collect();
                let made = &score.definition;
                let _ = writeln!(
                    out,
                    "{},{scene},{},{},{},{},{}",
                    column.name,
                    cells.join(","),
                    quoted(&ran.join(" ")),
                    quoted(&made.model_in_words()),
                    quoted(&made.set_in_words()),
                    made.target_error
                );
            }
        }
        out
    }

    fn markdown(&self) -> String {
        let [head, rows @ ..] = &self.table()[..] else {
            return String::new();
        };
        let mut out = markdown_table(head, rows);
        out.push('\n');
        for note in &self.notes {
            let _ = writeln!(out, "- {note}");
        }
        if let [head, rows @ ..] = &self.kinds_table()[..] {
            let _ = write!(out, "\n{} by kind of place:\n\n", COMPARED.name);
            out += &markdown_table(head, rows);
        }
        out
    }

    /// The table of methods, its head first.
    pub(crate) fn table(&self) -> Vec<Vec<String>> {
        let difference_head = self.difference_head();
        let mut head = vec!["method".to_owned(), "scenes".to_owned()];
        head.extend(self.metrics.iter().map(|m| m.name.to_owned()));
        head.extend(difference_head.clone());
        let mut table = vec![head];
        for (column, row) in self.columns.iter().zip(&self.rows) {
            let mut cells = vec![column.title.clone(), column.scores.len().to_string()];
            let metrics = self.metrics.iter().zip(&row.metrics);
            cells.extend(metrics.map(|(m, summary)| cell(summary, m.digits)));
            if difference_head.is_some() {
                cells.push(cell(&row.difference, COMPARED.digits));
            }
            table.push(cells);
        }
        table
    }

    /// The table of kinds of places, its head first; empty if no kind is known.
    pub(crate) fn kinds_table(&self) -> Vec<Vec<String>> {
        if self.kinds.is_empty() {
            return Vec::new();
        }
        let mut head = vec!["kind of place".to_owned(), "scenes".to_owned()];
        head.extend(self.columns.iter().map(|c| c.title.clone()));
        let mut table = vec![head];
        for row in &self.kinds {
            let mut cells = vec![row.kind.clone(), row.scenes.to_string()];
            cells.extend(row.medians.iter().map(|m| cell(m, COMPARED.digits)));
            table.push(cells);
        }
        table
    }
}

impl KindRow {
    fn new(kind: &str, scenes: &[SceneInfo], columns: &[Column]) -> Self {
        let is_of_kind = |s: &&SceneInfo| s.kind.as_deref() == Some(kind);
        let names: Vec<&str> = scenes
            .iter()
            .filter(is_of_kind)
            .map(|s| s.name.as_str())
            .collect();
        let median = |column: &Column| {
            let scores = names.iter().filter_map(|n| column.scores.get(*n));
            Summary::of(&scores.filter_map(COMPARED.of).collect::<Vec<_>>(), SEED)
        };
        Self {
            kind: kind.into(),
            scenes: names.len(),
            medians: columns.iter().map(median).collect(),
        }
    }
}

/// Differences of a method from the baseline, scene by scene.
fn difference(column: &Column, baseline: &Column) -> Option<Summary> {
    let of_scene = |(scene, score): (&String, &Score)| {
        let other = baseline.scores.get(scene).and_then(COMPARED.of)?;
        Some((COMPARED.of)(score)? - other)
    };
    let all: Vec<f64> = column.scores.iter().filter_map(of_scene).collect();
    Summary::of(&all, SEED)
}

/// What methods were made with, a line for those that were made alike.
fn made_with(columns: &[Column]) -> Vec<String> {
    let mut lines: Vec<(String, Vec<&str>)> = Vec::new();
    for column in columns {
        let words = column.definition.in_words();
        match lines.iter_mut().find(|(w, _)| *w == words) {
            Some((_, titles)) => titles.push(&column.title),
            None => lines.push((words, vec![&column.title])),
        }
    }
    let line = |(words, titles): (String, Vec<&str>)| format!("{}: {words}", titles.join(", "));
    lines.into_iter().map(line).collect()
}

/// A cell of CSV.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

fn cell(summary: &Option<Summary>, digits: usize) -> String {
    summary.as_ref().map_or("-".into(), |s| s.text(digits))
}

/// The first column is aligned to the left, the second to the right.
fn markdown_table(head: &[String], rows: &[Vec<String>]) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let rule = format!("|---|--:|{}\n", "---|".repeat(head.len().saturating_sub(2)));
    let mut out = line(head) + &rule;
    rows.iter().for_each(|row| out += &line(row));
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::columns::tests::score;
    use crate::definition::Definition;
    use crate::definition::tests::of;

    fn column(name: &str, made: Definition) -> Column {
        Column {
            name: name.into(),
            title: made.row.title.clone(),
            scores: [("a".to_owned(), score(0.1, &made))].into(),
            definition: made,
        }
    }

    #[test]
    fn methods_that_share_no_model_or_settings_are_not_compared_and_the_report_says_so() {
        let columns = vec![
            column("neutral", of("neutral", "", &[])),
            column("read", of("read", "sd", &[])),
            column("sds", of("sds", "embedded", &["light.lobes=8"])),
            column("ours", of("ours", "embedded", &[])),
        ];
        let report = Report::new(columns, Some(3), &[]);
        let compared: Vec<bool> = report.rows.iter().map(|r| r.difference.is_some()).collect();
        assert_eq!(compared, [true, false, false, false]);
        let markdown = report.markdown();
        for line in [
            "- Light as read, no guidance is not compared with Ours: it was made with the model sd (sd000000), the \
             other with the embedded model (embedded)\n",
            "- Ours (SDS) is not compared with Ours: it was made with --set light.lobes=8, the other with no --set \
             light.lobes\n",
            "- Ours (SDS): the embedded model (embedded), --set light.lobes=8, --target-error 0.004\n",
            "so seconds do not compare methods\n",
        ] {
            assert!(markdown.contains(line), "{markdown}");
        }
        let csv = report.csv();
        assert!(csv.contains("\"seconds\",\"stages in seconds\",model,set,\"target error\"\n"));
        let row = "sds,a,0,0.1,1,0,0,3,\"dipir-light dipir-composite\",\"the embedded model (embedded)\",\
                   \"--set light.lobes=8\",0.004\n";
        assert!(csv.contains(row), "{csv}");
        let json = report.json();
        assert_eq!(json["methods"][1]["definition"]["model"]["path"], "sd");
        assert_eq!(json["methods"][2]["definition"]["set"]["light.lobes"], "8");
        let folder = tempfile::tempdir().unwrap();
        let page = report
            .html(&EvaluationFolder::new(folder.path()), &[])
            .unwrap();
        assert!(
            page.contains("<li>Ours (SDS) is not compared with Ours: "),
            "{page}"
        );
    }

    #[test]
    fn scenes_of_a_kind_are_summed_up_apart_from_others() {
        let made = of("neutral", "", &[]);
        let scene = |name: &str, kind: Option<&str>| -> SceneInfo {
            serde_json::from_value(
                json!({"name": name, "made_from": "", "map": "", "exposure_ev": 0.0,
                "tone": "none", "kind": kind}),
            )
            .unwrap()
        };
        let scores = [("a", 0.1), ("b", 0.3), ("c", 0.5)];
        let columns = vec![Column {
            name: "m".into(),
            title: "M".into(),
            definition: made.clone(),
            scores: scores.map(|(n, v)| (n.to_owned(), score(v, &made))).into(),
        }];
        let scenes = [
            scene("a", Some("indoors")),
            scene("b", Some("sun")),
            scene("c", None),
        ];
        let report = Report::new(columns, None, &scenes);
        let markdown = report.markdown();
        assert!(markdown.contains("| M | 3 |"), "{markdown}");
        let tail = "RMSE touched by kind of place:\n\n| kind of place | scenes | M |\n|---|--:|---|\n\
                    | indoors | 1 | 0.1000 (no interval) |\n| sun | 1 | 0.3000 (no interval) |\n";
        assert!(markdown.ends_with(tail), "{markdown}");
    }
}
