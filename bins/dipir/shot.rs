//! `dipir shot`: the objects in every frame of a shot, under one light.
use std::path::PathBuf;

use clap::Args;
use dipir_cli::args::OutputArgs;
use dipir_cli::exit::{Usage, printable};
use dipir_stages::names::LIGHT;
use dipir_stages::shot;
use serde_json::Value;

use crate::project::{ProjectArgs, Stage};
use crate::run::{RunArgs, run_each, run_one};

#[derive(Args)]
pub struct ShotArgs {
    /// The frames, in any order; each gets a folder of its name in frames/ of the folder of artifacts
    #[arg(value_name = "FRAME", required = true)]
    frames: Vec<PathBuf>,

    /// The file that configures all stages; its photograph is the one that the light comes from
    #[arg(
        long,
        short = 'p',
        value_name = "FILE",
        default_value = "pipeline.toml"
    )]
    pipeline: PathBuf,

    /// Set a key of the file, as in --set scene.class=car; may be repeated, the last one wins
    #[arg(long = "set", short = 's', value_name = "KEY=VALUE")]
    set: Vec<String>,

    /// Folder of all artifacts, relative to the current folder [default: [pipeline] out]
    #[arg(long, short = 'o', value_name = "DIR")]
    out: Option<PathBuf>,

    /// Seed of every random number [default: [pipeline] seed]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,

    /// Worker threads of each stage, 0 for one a core; the results do not depend on it
    /// [default: [pipeline] threads]
    #[arg(long, short = 'j', value_name = "N")]
    threads: Option<usize>,

    #[command(flatten)]
    output: OutputArgs,
}

/// Recovers the light once, and puts the objects into every frame under it.
pub fn run(args: &ShotArgs) -> anyhow::Result<()> {
    let base = ProjectArgs {
        files: vec![args.pipeline.clone()],
        pipeline: None,
        set: args.set.clone(),
        out: args.out.clone(),
        seed: args.seed,
        light: None,
        output: args.output,
    };
    let (session, graph) = base.open()?;
    let mut frames: Vec<(PathBuf, ProjectArgs)> = Vec::new();
    for path in &args.frames {
        let mut frame = base.clone();
        frame.set.extend(shot::overrides(&session, path)?);
        let name = path.file_stem().unwrap_or_default();
        frame.out = Some(session.out.join(shot::FOLDER).join(name));
        if frames.iter().any(|(_, other)| other.out == frame.out) {
            let message = format!("{}: another frame has the same name", path.display());
            return Err(Usage(printable(&message)).into());
        }
        frames.push((path.clone(), frame));
    }
    if graph.node(LIGHT.name).is_some_and(|n| n.unneeded.is_none()) {
        let until_light = RunArgs::needed(base.clone(), Some(Stage::Light), args.threads);
        let done = run_one(&until_light, &base)?;
        if !args.output.json {
            args.output.result(|| done.0, || Value::Null);
        }
        for (_, frame) in &mut frames {
            frame.light = Some(LIGHT.folder(&session));
        }
    }
    let to_the_end = RunArgs::needed(base, None, args.threads);
    run_each(&to_the_end, frames)
}
