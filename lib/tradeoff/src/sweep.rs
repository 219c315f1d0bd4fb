//! The whole sweep: measures points, then writes tables and plots.
use std::path::PathBuf;

use dipir_cli::executables::Executables;
use dipir_cli::exit::Usage;
use dipir_cli::interrupt;
use serde_json::json;

use crate::command_line::{Cli, Track};
use crate::knobs::{self, Part, Variant};
use crate::measure::{Point, SceneMeasurement};
use crate::scenes::{self, MeasuredScene};
use crate::tables;

/// The point that is measured next.
pub struct Step<'a> {
    /// Points before it.
    pub done: usize,
    /// Points in all.
    pub total: usize,
    /// Share of the sweep's time before it, as expected.
    pub share: f64,
    /// The scene.
    pub scene: &'a str,
    /// The series.
    pub series: &'a str,
    /// What distinguishes it from others of the series.
    pub label: &'a str,
    /// Seconds that the whole sweep is expected to take, those of processors; 0 if all is measured, and only known of the
    /// built-in scenes.
    pub expected_s: Option<f64>,
}

/// What was measured.
pub struct Outcome {
    /// Points.
    pub points: usize,
    /// Tables and plots.
    pub files: Vec<PathBuf>,
}

/// Measures what is not measured yet, and writes tables and plots. `report` gets every point before
/// it is measured.
///
/// # Errors
/// If the arguments name a scene or a series that does not exist, nothing is measured of what is to be reported, an
/// executable fails, or the user interrupts.
pub fn sweep(cli: &Cli, report: &mut dyn FnMut(Step)) -> anyhow::Result<Outcome> {
    if !(cli.reference_error > 0.0 && cli.reference_error < 1.0) || cli.repeats == 0 {
        let text = "--reference-error must lie above 0 and below 1, --repeats must be at least 1";
        return Err(Usage(text.into()).into());
    }
    let known = knobs::names();
    if let Some(unknown) = cli.knob.iter().find(|k| !known.contains(&k.as_str())) {
        let text = format!(
            "no series is called \"{unknown}\"; --knob accepts: {}",
            known.join(", ")
        );
        return Err(Usage(text).into());
    }
    interrupt::listen()?;
    let executables = Executables::beside_this()?;
    let scenes = chosen_scenes(cli)?;
    let parts = chosen_parts(cli)?;
    // A scene of another size is another scene.
    let [width, height] = cli.size;
    let out = cli.out.join(match cli.pipeline.is_empty() {
        true => format!("{width}x{height}"),
        false => "projects".into(),
    });
    let measurement = |scene| SceneMeasurement {
        executables: &executables,
        out: &out,
        scene,
        threads: cli.threads,
        reference_error: cli.reference_error,
    };
    let mut work: Vec<(&MeasuredScene, Variant)> = Vec::new();
    for &part in parts {
        for scene in &scenes {
            let effects = match part {
                Part::Render if cli.report_only => measurement(scene).known_effects()?,
                Part::Render => measurement(scene).effects_on()?,
                Part::Light => Vec::new(),
            };
            let variants = knobs::variants(part, &effects, cli.joint).into_iter();
            let wanted = |v: &Variant| cli.knob.is_empty() || cli.knob.contains(&v.series);
            work.extend(variants.filter(wanted).map(|v| (scene, v)));
        }
    }
    if work.is_empty() {
        let text = "no point is left to measure: scene and track have none of the --knob";
        return Err(Usage(text.into()).into());
    }
    let mut costs = Vec::new();
    let mut referred: Vec<&str> = Vec::new();
    for (scene, variant) in &work {
        let is_first = !referred.contains(&scene.name.as_str());
        let cost = measurement(scene).cost(variant, cli.repeats, is_first);
        if variant.part == Part::Render && cost > 0.0 {
            referred.push(&scene.name);
        }
        costs.push(cost);
    }
    let all = costs.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    // Costs are those of pictures of 96 x 64 pixels; how large a user's are is not known here.
    let larger = (width * height) as f64 / (96.0 * 64.0);
    let expected_s = cli
        .pipeline
        .is_empty()
        .then_some(costs.iter().sum::<f64>() * larger);
    let mut points: Vec<Point> = Vec::new();
    for (n, (scene, variant)) in work.iter().enumerate() {
        report(Step {
            done: n,
            total: work.len(),
            share: costs[..n].iter().sum::<f64>() / all,
            scene: &scene.name,
            series: &variant.series,
            label: &variant.label,
            expected_s,
        });
        let measurement = measurement(scene);
        points.extend(match cli.report_only {
            false => measurement.measure(variant, cli.repeats)?,
            true => Some(measurement.measured(variant)?)
                .filter(|samples| !samples.is_empty())
                .map(|samples| Point::new(&scene.name, variant, samples)),
        });
    }
    if points.is_empty() {
        // Tables of nothing would take the place of earlier ones.
        let text = format!(
            "--report-only: nothing of this is measured in {}; give --size, --pipeline, --track and --reference-error as they \
             were for the measurement",
            out.display()
        );
        return Err(Usage(text).into());
    }
    let about = json!({
        "size": cli.size, "repeats": cli.repeats, "joint": cli.joint,
        "reference_error": cli.reference_error, "threads": cli.threads,
        "version": env!("CARGO_PKG_VERSION"),
    });
    Ok(Outcome {
        points: points.len(),
        files: tables::write_all(&points, &about, &cli.out)?,
    })
}

fn chosen_parts(cli: &Cli) -> anyhow::Result<&'static [Part]> {
    Ok(match (cli.track, cli.pipeline.is_empty()) {
        (Track::Light, false) => {
            let text = "--track light measures the built-in scenes alone: leave out --pipeline";
            return Err(Usage(text.into()).into());
        }
        (Track::Render, _) | (Track::All, false) => &[Part::Render],
        (Track::Light, true) => &[Part::Light],
        (Track::All, true) => &[Part::Render, Part::Light],
    })
}

fn chosen_scenes(cli: &Cli) -> anyhow::Result<Vec<MeasuredScene>> {
    if !cli.pipeline.is_empty() {
        return Ok(scenes::projects(&cli.pipeline));
    }
    let names: Vec<&str> = match cli.scene.is_empty() {
        true => scenes::NAMES.to_vec(),
        false => cli.scene.iter().map(String::as_str).collect(),
    };
    let [width, height] = cli.size;
    let folder = cli.out.join(format!("{width}x{height}")).join("scenes");
    let make = |name: &str| {
        if !scenes::NAMES.contains(&name) {
            let text = format!("--scene \"{name}\": accepted: {}", scenes::NAMES.join(", "));
            return Err(Usage(text).into());
        }
        let folder = folder.join(name.replace(' ', "-"));
        match cli.report_only {
            true => Ok(scenes::kept(name, &folder)),
            false => scenes::built_in(name, &folder, cli.size),
        }
    };
    names.into_iter().map(make).collect()
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[test]
    fn a_report_of_nothing_is_refused_leaves_earlier_tables_and_makes_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let earlier = folder.path().join("tradeoff.csv");
        std::fs::write(&earlier, "earlier").unwrap();
        let out = folder.path().to_str().unwrap();
        let arguments = ["dipir-tradeoff", "--report-only", "--out", out];
        let refused = sweep(&Cli::parse_from(arguments), &mut |_| {});
        let error = refused.err().expect("is refused");
        assert!(error.is::<Usage>(), "{error:#}");
        assert!(
            error
                .to_string()
                .starts_with("--report-only: nothing of this is measured in "),
            "{error:#}"
        );
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        assert_eq!(std::fs::read_to_string(earlier).unwrap(), "earlier");
    }

    #[test]
    fn a_series_that_does_not_exist_is_refused_beside_one_that_does() {
        let arguments = ["dipir-tradeoff", "--knob", "depth", "--knob", "dept"];
        let refused = sweep(&Cli::parse_from(arguments), &mut |_| {});
        let text = refused.err().expect("is refused").to_string();
        assert!(
            text.starts_with("no series is called \"dept\"; --knob accepts: "),
            "{text}"
        );
        assert!(text.contains("depth"), "{text}");
    }
}
