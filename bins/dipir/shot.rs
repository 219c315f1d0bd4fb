//! `dipir shot`: the objects in every frame of a shot, under one light.
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use clap::Args;
use dipir_cli::args::CommonArgs;
use dipir_cli::exit::{Usage, printable};
use dipir_cli::interrupt;
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_stages::names::{LIGHT, SCENE};
use dipir_stages::{report, shot};
use serde_json::{Map, Value, json};

use crate::lock::lock_folder;
use crate::plan;
use crate::project::{ProjectArgs, Stage};
use crate::run::{RunArgs, all_fresh, page, run_each, run_one};

#[derive(Args)]
pub struct ShotArgs {
    /// The frames, in any order; each gets a folder of its name in frames/ of the folder of artifacts
    #[arg(value_name = "FRAME", required = true)]
    frames: Vec<PathBuf>,

    /// Take every frame to be exposed as the photograph is, whatever the Exif data say
    #[arg(long)]
    same_exposure: bool,

    /// Make every frame that is named, up to date or not
    #[arg(long)]
    force: bool,

    /// As --set pipeline.quality=draft
    #[arg(long)]
    draft: bool,

    /// Say what would run and what it takes, and start nothing
    #[arg(long)]
    plan: bool,

    #[command(flatten)]
    common: CommonArgs,
}

/// Places the objects and recovers the light once, in the photograph, and puts the objects into every frame.
pub fn run(args: &ShotArgs) -> anyhow::Result<()> {
    let mut common = args.common.clone();
    if args.draft {
        common.set.push("pipeline.quality=draft".into());
    }
    refuse_pipeline(&args.frames)?;
    let base = ProjectArgs::of(&common);
    let (session, graph) = base.open()?;
    let mut frames = frames(args, &session, &base)?;
    let is_recovered = graph.node(LIGHT.name).is_some_and(|n| n.unneeded.is_none());
    for (_, frame) in &mut frames {
        frame.placed = Some(SCENE.folder(&session));
        frame.light = is_recovered.then(|| LIGHT.folder(&session));
    }
    let last = match is_recovered {
        true => Stage::Light,
        false => Stage::Scene,
    };
    let of_photo = RunArgs::needed(&common, Some(last));
    if args.plan {
        let photo = run_one(&of_photo.planned(), &base)?;
        let (words, json) = plan::frames(&session, photo, &frames, args.force)?;
        common.output.result(|| words, || json);
        return Ok(());
    }
    interrupt::listen_patiently()?;
    let (done, photo) = run_one(&of_photo, &base)?;
    // Held while frames are made: another run would replace their light, another shot the frames.
    let _lock = match lock_folder(&session, common.wait, common.output.quiet) {
        // Where nothing can be written nobody replaces anything, and a frame that is not made yet says so.
        Err(e) if matches!(e.downcast_ref(), Some(StageError::Io { .. })) => None,
        lock => Some(lock?),
    };
    if !all_fresh(&session, &graph, &graph.up_to(last.name()))? {
        anyhow::bail!(
            "another run has just replaced what the frames share in {}; run again",
            session.out.display()
        );
    }
    if !common.output.json {
        common.output.result(|| done, || Value::Null);
    }
    let of_frames = RunArgs::needed(&common, None).forced(args.force);
    run_each(&of_frames, frames, |failed| {
        // The page of the photograph shows its frames.
        let page = match failed.is_empty() && report::is_current(&session) {
            true => None,
            false => page(&base, &session, &graph, failed).map(|(path, _)| path),
        };
        if let Some(path) = page.as_ref().filter(|_| !common.output.json) {
            let words = || format!("wrote {}", printable(&path.display().to_string()));
            common.output.result(words, || Value::Null);
        }
        let report = json!(page.map(json_path));
        Map::from_iter([("photo".into(), photo), ("report".into(), report)])
    })
}

/// Refuses a file that configures stages among the frames: other commands take it there.
fn refuse_pipeline(frames: &[PathBuf]) -> Result<(), Usage> {
    let is_pipeline = |path: &&PathBuf| path.extension().is_some_and(|e| e == "toml");
    match frames.iter().find(is_pipeline) {
        None => Ok(()),
        Some(file) => {
            let file = file.display();
            let message = format!("{file} is no frame: write dipir shot --pipeline {file} FRAME…");
            Err(Usage(printable(&message)))
        }
    }
}

/// The frames, each with its project.
fn frames(
    args: &ShotArgs,
    session: &Session,
    base: &ProjectArgs,
) -> anyhow::Result<Vec<(PathBuf, ProjectArgs)>> {
    let mut frames: Vec<(PathBuf, ProjectArgs)> = Vec::new();
    let stands_still = shot::camera_stands_still(session)?;
    for path in &args.frames {
        let name = name(path)?;
        let stops = match args.same_exposure {
            true => 0.0,
            false => shot::exposure_stops(session, path)?.unwrap_or_default(),
        };
        let mut frame = base.clone();
        frame
            .set
            .extend(shot::overrides(session, path, stops, stands_still)?);
        if stops != 0.0 {
            let than = if stops > 0.0 { "more" } else { "less" };
            let stops = stops.abs();
            session.remark(|| format!("{}: exposed by {stops:.2} stops {than}", path.display()));
        }
        frame.out = Some(session.out.join(shot::FOLDER).join(name));
        if frames.iter().any(|(_, other)| other.out == frame.out) {
            let message = format!("{}: another frame has the same name", path.display());
            return Err(Usage(printable(&message)).into());
        }
        frames.push((path.clone(), frame));
    }
    Ok(frames)
}

/// The name of a frame's folder: that of its file without the extension.
fn name(path: &Path) -> Result<&OsStr, Usage> {
    match path.file_stem() {
        // Names of another folder.
        None => {}
        Some(name) if name.is_empty() || name == "." || name == ".." => {}
        Some(name) => return Ok(name),
    }
    let message = format!(
        "{}: without its extension this is no name of a folder; rename the file, as in frame_0001.png",
        path.display()
    );
    Err(Usage(printable(&message)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_of_dots_is_no_name_of_a_folder() {
        for wrong in ["...png", "..png", "a/...png", "..", "/"] {
            let told = name(Path::new(wrong)).unwrap_err().to_string();
            assert!(told.starts_with(&format!("{wrong}: ")), "{told}");
        }
        for (path, folder) in [("a/b.png", "b"), (".b.png", ".b"), ("....png", "...")] {
            assert_eq!(name(Path::new(path)).unwrap(), folder);
        }
    }
}
