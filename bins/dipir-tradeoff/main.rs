//! `dipir-tradeoff`: what accuracy costs, knob by knob and together.
mod cli;
mod knobs;
mod scenes;
mod sweep;
mod tables;

use std::process::ExitCode;

use clap::Parser;
use cli::{Cli, Track};
use dipir_cli::exit::{self, Usage};
use dipir_cli::interrupt;
use dipir_cli::progress::Progress;
use dipir_stages::children::Executables;
use knobs::{Part, Setting};
use scenes::Scene;
use serde_json::json;
use sweep::{Bench, Point};

fn main() -> ExitCode {
    exit::run(|| run(&Cli::parse()))
}

fn run(cli: &Cli) -> anyhow::Result<()> {
    if !(cli.reference_error > 0.0 && cli.reference_error < 1.0) || cli.repeats == 0 {
        let text = "--reference-error must lie above 0 and below 1, --repeats must be at least 1";
        return Err(Usage(text.into()).into());
    }
    interrupt::listen()?;
    let executables = Executables::beside_this()?;
    let scenes = chosen(cli)?;
    let parts: &[Part] = match (cli.track, cli.pipeline.is_empty()) {
        (Track::Light, false) => {
            let text = "--track light measures the built-in scenes alone: leave out --pipeline";
            return Err(Usage(text.into()).into());
        }
        (Track::Render, _) | (Track::All, false) => &[Part::Render],
        (Track::Light, true) => &[Part::Light],
        (Track::All, true) => &[Part::Render, Part::Light],
    };
    // What is measured of scenes of another size is something else.
    let [width, height] = cli.size;
    let out = cli.out.join(match cli.pipeline.is_empty() {
        true => format!("{width}x{height}"),
        false => "projects".into(),
    });
    let bench = |scene| Bench {
        executables: &executables,
        out: &out,
        scene,
        threads: cli.threads,
        reference_error: cli.reference_error,
    };
    let mut work: Vec<(&Scene, Setting)> = Vec::new();
    for &part in parts {
        for scene in &scenes {
            let effects = match part {
                Part::Render => bench(scene).effects_on()?,
                Part::Light => Vec::new(),
            };
            let settings = knobs::settings(part, &effects, cli.joint).into_iter();
            let wanted = |s: &Setting| cli.knob.is_empty() || cli.knob.contains(&s.series);
            work.extend(settings.filter(wanted).map(|s| (scene, s)));
        }
    }
    if work.is_empty() {
        let known = knobs::names().join(", ");
        return Err(Usage(format!(
            "no point is left to measure; --knob accepts: {known}"
        ))
        .into());
    }
    let progress = Progress::new("tradeoff", cli.output.quiet);
    let mut points: Vec<Point> = Vec::new();
    for (n, (scene, setting)) in work.iter().enumerate() {
        progress.set(n as f64 / work.len() as f64);
        progress.say(format!(
            "{}: {} {}",
            scene.name, setting.series, setting.label
        ));
        let bench = bench(scene);
        let point = match cli.report_only {
            false => bench.measure(setting, cli.repeats)?,
            true => Some(bench.measured(setting)?)
                .filter(|s| !s.is_empty())
                .map(|samples| Point {
                    scene: scene.name.clone(),
                    part: setting.part.name().into(),
                    series: setting.series.clone(),
                    label: setting.label.clone(),
                    set: setting.set.clone(),
                    samples,
                }),
        };
        if cli.output.verbose && !cli.report_only {
            eprintln!(
                "{} of {}: {}, {} {}",
                n + 1,
                work.len(),
                scene.name,
                setting.series,
                setting.label
            );
        }
        points.extend(point);
    }
    progress.done();
    let about = json!({
        "size": cli.size, "repeats": cli.repeats, "joint": cli.joint,
        "reference_error": cli.reference_error, "threads": cli.threads,
        "version": env!("CARGO_PKG_VERSION"),
    });
    let files = tables::write_all(&points, &about, &cli.out)?;
    cli.output.result(
        || {
            let names: Vec<String> = files.iter().map(|f| format!("  {}", f.display())).collect();
            format!("{} points; wrote\n{}", points.len(), names.join("\n"))
        },
        || json!({"points": points.len(), "files": files}),
    );
    Ok(())
}

fn chosen(cli: &Cli) -> anyhow::Result<Vec<Scene>> {
    if !cli.pipeline.is_empty() {
        return Ok(cli.pipeline.iter().map(|p| scenes::given(p)).collect());
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
        scenes::built_in(name, &folder.join(name.replace(' ', "-")), cli.size)
    };
    names.into_iter().map(make).collect()
}
