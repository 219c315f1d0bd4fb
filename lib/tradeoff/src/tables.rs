//! What was measured, as JSON, CSV, Markdown and plots.
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use dipir_evaluation::front::{elbow, excess_error, pareto, three_presets};
use dipir_evaluation::results::{write, write_json};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_numerics::stats::{Running, median, t_half_width};
use dipir_plotting::chart::{Chart, Mark, Panel, Point as Dot, Scale, Series};
use serde_json::{Value, json};

use crate::knobs::PRESETS;
use crate::measure::{Point, Sample};

/// One setting in one scene, summed up over its runs.
#[derive(Clone, Debug)]
pub struct Row {
    /// What was measured.
    pub point: Point,
    /// Root of the mean squared error.
    pub error: f64,
    /// Its 95% interval, from the spread over seeds; absent for a single run.
    pub interval: Option<(f64, f64)>,
    /// Median processor seconds.
    pub cost_s: f64,
    /// Median wall seconds.
    pub wall_s: f64,
    /// Peak memory, bytes.
    pub peak_rss_bytes: u64,
    /// Whether no other setting beats it.
    pub on_front: bool,
    /// Whether it is the elbow, beyond which accuracy gets dear.
    pub is_elbow: bool,
    /// Its error over that of the front at the same cost.
    pub excess: f64,
}

impl Row {
    fn new(point: Point) -> Option<Self> {
        let samples = &point.samples;
        let squares: Running = samples.iter().map(|s| s.error * s.error).collect();
        let all = |f: fn(&Sample) -> f64| -> Vec<f64> { samples.iter().map(f).collect() };
        let half = t_half_width(squares.count(), squares.std_error(), 0.95);
        let end = |v: f64| v.max(0.0).sqrt();
        Some(Self {
            error: squares.mean().sqrt(),
            interval: half
                .is_finite()
                .then(|| (end(squares.mean() - half), end(squares.mean() + half))),
            cost_s: median(&all(|s| s.cost_s))?,
            wall_s: median(&all(|s| s.wall_s))?,
            peak_rss_bytes: samples.iter().map(|s| s.peak_rss_bytes).max()?,
            on_front: false,
            is_elbow: false,
            excess: f64::NAN,
            point,
        })
    }

    fn place(&self) -> (f64, f64) {
        (self.cost_s, self.error)
    }
}

/// Rows of one scene under its name.
type SceneRows = (String, Vec<Row>);
/// A track with its scenes.
type TrackRows<'a> = (&'a str, Vec<SceneRows>);

/// Name of the panel of means over scenes.
const OVERALL: &str = "all scenes";

/// Rows of one part by scene, with fronts and elbows marked. With several scenes, their geometric
/// means come last.
fn by_scene(points: &[Point], part: &str) -> Vec<SceneRows> {
    let mut scenes: Vec<SceneRows> = Vec::new();
    for point in points.iter().filter(|p| p.part == part) {
        let Some(row) = Row::new(point.clone()) else {
            continue;
        };
        match scenes.iter_mut().find(|(name, _)| *name == point.scene) {
            Some((_, rows)) => rows.push(row),
            None => scenes.push((point.scene.clone(), vec![row])),
        }
    }
    if scenes.len() > 1 {
        let rows = overall(&scenes);
        scenes.push((OVERALL.into(), rows));
    }
    for (_, rows) in &mut scenes {
        mark(rows);
    }
    scenes
}

/// For each setting that all scenes have, the geometric means over the scenes.
fn overall(scenes: &[SceneRows]) -> Vec<Row> {
    let mean = |values: Vec<f64>| {
        let n = values.len() as f64;
        (values.iter().map(|v| v.max(1e-12).ln()).sum::<f64>() / n).exp()
    };
    let of = |row: &Row| {
        let same = |r: &&Row| r.point.set == row.point.set && r.point.series == row.point.series;
        let all: Vec<&Row> = scenes
            .iter()
            .filter_map(|(_, rows)| rows.iter().find(same))
            .collect();
        (all.len() == scenes.len()).then(|| Row {
            point: Point {
                scene: OVERALL.into(),
                samples: Vec::new(),
                ..row.point.clone()
            },
            error: mean(all.iter().map(|r| r.error).collect()),
            interval: None,
            cost_s: mean(all.iter().map(|r| r.cost_s).collect()),
            wall_s: mean(all.iter().map(|r| r.wall_s).collect()),
            peak_rss_bytes: all.iter().map(|r| r.peak_rss_bytes).max().unwrap_or(0),
            ..row.clone()
        })
    };
    scenes[0].1.iter().filter_map(of).collect()
}

fn mark(rows: &mut [Row]) {
    let places: Vec<_> = rows.iter().map(Row::place).collect();
    let front = pareto(&places);
    let knee = elbow(&places, &front);
    for (k, row) in rows.iter_mut().enumerate() {
        row.on_front = front.contains(&k);
        row.is_elbow = knee == Some(k);
        row.excess = excess_error(&places, &front, places[k]).unwrap_or(1.0);
    }
}

fn chart(part: &str, scenes: &[SceneRows]) -> Chart {
    let panel = |(name, rows): &SceneRows| {
        let mut series: Vec<Series> = Vec::new();
        for row in rows {
            let dot = Dot {
                x: row.cost_s,
                y: row.error,
                interval: row.interval,
                label: match row.point.series == PRESETS {
                    true => row.point.label.clone(),
                    false => String::new(),
                },
            };
            match series.iter_mut().find(|s| s.name == row.point.series) {
                Some(s) => s.points.push(dot),
                None => series.push(Series {
                    name: row.point.series.clone(),
                    mark: Mark::Dots,
                    points: vec![dot],
                    ..Series::default()
                }),
            }
        }
        let mut front: Vec<_> = rows.iter().filter(|r| r.on_front).map(Row::place).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        Panel {
            title: name.clone(),
            series,
            front,
            elbow: rows.iter().find(|r| r.is_elbow).map(Row::place),
        }
    };
    let log = |label: String| Scale {
        label,
        log: true,
        range: None,
    };
    Chart {
        x: log(format!("processor seconds of the {part} track")),
        y: log("error: display-referred RMSE".into()),
        size: [330.0, 300.0],
        panels: scenes.iter().map(panel).collect(),
    }
}

/// Three rows of the front that the presets can take.
fn suggestion(rows: &[Row]) -> Option<Value> {
    let places: Vec<_> = rows.iter().map(Row::place).collect();
    let chosen = three_presets(&places, &pareto(&places))?.map(|k| row_json(&rows[k]));
    let [draft, standard, high] = chosen;
    Some(json!({"draft": draft, "standard": standard, "high": high}))
}

fn row_json(row: &Row) -> Value {
    json!({
        "series": row.point.series,
        "label": row.point.label,
        "set": row.point.set.iter().cloned().collect::<BTreeMap<_, _>>(),
        "error": row.error,
        "interval_95": row.interval,
        "cost_s": row.cost_s,
        "wall_s": row.wall_s,
        "peak_rss_bytes": row.peak_rss_bytes,
        "on_front": row.on_front,
        "elbow": row.is_elbow,
        "excess_error": row.excess,
        "runs": row.point.samples,
    })
}

fn csv(parts: &[TrackRows]) -> String {
    let mut text = String::from(
        "track,scene,series,label,error,error_low,error_high,cost_s,wall_s,peak_rss_bytes,on_front,elbow,excess_error\n",
    );
    for (part, scenes) in parts {
        for (scene, rows) in scenes {
            for row in rows {
                let scene = scene.replace('"', "\"\"");
                let (low, high) = row.interval.unwrap_or((f64::NAN, f64::NAN));
                let _ = writeln!(
                    text,
                    "{part},\"{scene}\",\"{}\",\"{}\",{},{low},{high},{},{},{},{},{},{}",
                    row.point.series,
                    row.point.label,
                    row.error,
                    row.cost_s,
                    row.wall_s,
                    row.peak_rss_bytes,
                    row.on_front,
                    row.is_elbow,
                    row.excess
                );
            }
        }
    }
    text
}

fn markdown(parts: &[TrackRows]) -> String {
    let mut text = String::new();
    for (part, scenes) in parts {
        for (scene, rows) in scenes {
            let _ = writeln!(
                text,
                "\n## {part}: {scene}\n\n| knob | value | error | 95% | processor s | MB | front | over the front |\n\
                 |---|---|--:|---|--:|--:|---|--:|"
            );
            for row in rows {
                let interval = match row.interval {
                    Some((low, high)) => format!("{low:.5} to {high:.5}"),
                    None => "-".into(),
                };
                let mark = match (row.is_elbow, row.on_front) {
                    (true, _) => "elbow",
                    (_, true) => "yes",
                    _ => "",
                };
                let _ = writeln!(
                    text,
                    "| {} | {} | {:.5} | {interval} | {:.2} | {:.0} | {mark} | {:.2} |",
                    row.point.series,
                    row.point.label,
                    row.error,
                    row.cost_s,
                    row.peak_rss_bytes as f64 * 1e-6,
                    row.excess
                );
            }
        }
    }
    text
}

/// Writes all tables and plots of `points` to `out`, and returns the files' names.
pub fn write_all(points: &[Point], about: &Value, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let parts: Vec<_> = ["render", "light"]
        .into_iter()
        .map(|part| (part, by_scene(points, part)))
        .filter(|(_, scenes)| !scenes.is_empty())
        .collect();
    let tracks: Vec<Value> = parts
        .iter()
        .map(|(part, scenes)| {
            // Read off the mean over scenes, which is last.
            let suggested = scenes.last().and_then(|(_, rows)| suggestion(rows));
            let scenes = scenes.iter().map(|(name, rows)| {
                json!({"scene": name, "points": rows.iter().map(row_json).collect::<Vec<_>>()})
            });
            json!({"track": part, "scenes": scenes.collect::<Vec<_>>(), "suggested": suggested})
        })
        .collect();
    let mut files = vec![out.join("tradeoff.json")];
    write_json(&files[0], &json!({"about": about, "tracks": tracks}))?;
    let save = |name: String, text: String| -> anyhow::Result<PathBuf> {
        let path = out.join(name);
        write(&path, text)?;
        Ok(path)
    };
    files.push(save("tradeoff.csv".into(), csv(&parts))?);
    files.push(save("tradeoff.md".into(), markdown(&parts))?);
    for (part, scenes) in &parts {
        let drawing = chart(part, scenes).draw();
        let svg = save(format!("tradeoff-{part}.svg"), drawing.to_svg())?;
        let png = svg.with_extension("png");
        let pixels = drawing.to_pixels(1);
        let raster = Raster::from_pixels(pixels.width, pixels.height, pixels.colors);
        write_png(&png, &DisplayImage(raster))?;
        files.extend([svg, png]);
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn point(scene: &str, label: &str, error: f64, cost_s: f64) -> Point {
        let sample = |seed: u64| Sample {
            seed,
            error: error * (1.0 + 0.01 * seed as f64),
            stated_error: None,
            cost_s,
            wall_s: cost_s,
            peak_rss_bytes: 10_000_000,
        };
        Point {
            scene: scene.into(),
            part: "render".into(),
            series: "samples".into(),
            label: label.into(),
            set: vec![("k".into(), label.into())],
            samples: vec![sample(0), sample(1), sample(2)],
        }
    }

    #[test]
    fn fronts_are_marked_and_scenes_meet_in_their_geometric_mean() {
        let points = [
            point("a", "1", 0.04, 1.0),
            point("a", "2", 0.01, 2.0),
            point("a", "3", 0.009, 8.0),
            point("a", "4", 0.05, 9.0),
            point("b", "1", 0.01, 4.0),
            point("b", "2", 0.0025, 8.0),
        ];
        let scenes = by_scene(&points, "render");
        assert_eq!(scenes.len(), 3);
        let a = &scenes[0].1;
        assert_eq!(
            a.iter().map(|r| r.on_front).collect::<Vec<_>>(),
            [true, true, true, false]
        );
        assert!(a[1].is_elbow && a[3].excess > 5.0);
        let (low, high) = a[0].interval.unwrap();
        assert!(low < a[0].error && a[0].error < high);
        // Only what both scenes have: labels 1 and 2.
        let both = &scenes[2].1;
        assert_eq!(both.len(), 2);
        assert!((both[0].cost_s - 2.0).abs() < 1e-12);
        assert!((both[0].error / (0.02 * 1.0101) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn quotes_in_the_name_of_a_scene_are_doubled_in_a_table() {
        let scenes = by_scene(&[point("my \"best\" shot", "1", 0.04, 1.0)], "render");
        let text = csv(&[("render", scenes)]);
        let row = text.lines().nth(1).unwrap();
        assert!(
            row.starts_with("render,\"my \"\"best\"\" shot\",\"samples\","),
            "{row}"
        );
    }

    #[test]
    fn every_file_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let points = [point("a", "1", 0.04, 1.0), point("a", "2", 0.01, 2.0)];
        let files = write_all(&points, &json!({}), folder.path()).unwrap();
        assert_eq!(files.len(), 5);
        assert!(files.iter().all(|f| f.is_file()));
        let csv = fs::read_to_string(folder.path().join("tradeoff.csv")).unwrap();
        assert_eq!(csv.lines().count(), 3);
    }
}
