//! `dipir shot`: the objects in every frame of a shot, under one light.
use std::path::PathBuf;

use clap::Args;
use dipir_cli::args::CommonArgs;
use dipir_cli::exit::{Usage, printable};
use dipir_cli::session::Session;
use dipir_stages::names::LIGHT;
use dipir_stages::shot;
use serde_json::Value;

use crate::plan;
use crate::project::{ProjectArgs, Stage};
use crate::run::{RunArgs, run_each, run_one};

#[derive(Args)]
pub struct ShotArgs {
    /// The frames, in any order; each gets a folder of its name in frames/ of the folder of artifacts
    #[arg(value_name = "FRAME", required = true)]
    frames: Vec<PathBuf>,

    /// Take every frame to be exposed as the photograph is, whatever the Exif data say
    #[arg(long)]
    same_exposure: bool,

    /// As --set pipeline.quality=draft
    #[arg(long)]
    draft: bool,

    /// Say what would run and what it takes, and start nothing
    #[arg(long)]
    plan: bool,

    #[command(flatten)]
    common: CommonArgs,
}

/// Recovers the light once, and puts the objects into every frame under it.
pub fn run(args: &ShotArgs) -> anyhow::Result<()> {
    let mut common = args.common.clone();
    if args.draft {
        common.set.push("pipeline.quality=draft".into());
    }
    let base = ProjectArgs::of(&common);
    let (session, graph) = base.open()?;
    let mut frames = frames(args, &session, &base)?;
    let until_light = RunArgs::needed(&common, Some(Stage::Light));
    let is_recovered = graph.node(LIGHT.name).is_some_and(|n| n.unneeded.is_none());
    if is_recovered {
        for (_, frame) in &mut frames {
            frame.light = Some(LIGHT.folder(&session));
        }
    }
    if args.plan {
        let light = is_recovered.then(|| run_one(&until_light.planned(), &base));
        let (words, json) = plan::frames(&session, light.transpose()?, &frames)?;
        common.output.result(|| words, || json);
        return Ok(());
    }
    if is_recovered {
        let done = run_one(&until_light, &base)?;
        if !common.output.json {
            common.output.result(|| done.0, || Value::Null);
        }
    }
    run_each(&RunArgs::needed(&common, None), frames)
}

/// The frames, each with its project.
fn frames(
    args: &ShotArgs,
    session: &Session,
    base: &ProjectArgs,
) -> anyhow::Result<Vec<(PathBuf, ProjectArgs)>> {
    let mut frames: Vec<(PathBuf, ProjectArgs)> = Vec::new();
    for path in &args.frames {
        let stops = match args.same_exposure {
            true => 0.0,
            false => shot::exposure_stops(session, path)?.unwrap_or_default(),
        };
        let mut frame = base.clone();
        frame.set.extend(shot::overrides(session, path, stops)?);
        if stops != 0.0 {
            session.remark(|| format!("{}: exposed by {stops:.2} stops more", path.display()));
        }
        let name = path.file_stem().unwrap_or_default();
        frame.out = Some(session.out.join(shot::FOLDER).join(name));
        if frames.iter().any(|(_, other)| other.out == frame.out) {
            let message = format!("{}: another frame has the same name", path.display());
            return Err(Usage(printable(&message)).into());
        }
        frames.push((path.clone(), frame));
    }
    Ok(frames)
}
