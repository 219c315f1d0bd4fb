//! `dipir shot`: the objects in every frame of a shot, under one light.
use std::path::PathBuf;

use clap::Args;
use dipir_cli::args::CommonArgs;
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

    #[command(flatten)]
    common: CommonArgs,
}

/// Recovers the light once, and puts the objects into every frame under it.
pub fn run(args: &ShotArgs) -> anyhow::Result<()> {
    let common = &args.common;
    let base = ProjectArgs::of(common);
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
        let until_light = RunArgs::needed(common, Some(Stage::Light));
        let done = run_one(&until_light, &base)?;
        if !common.output.json {
            common.output.result(|| done.0, || Value::Null);
        }
        for (_, frame) in &mut frames {
            frame.light = Some(LIGHT.folder(&session));
        }
    }
    let to_the_end = RunArgs::needed(common, None);
    run_each(&to_the_end, frames)
}
