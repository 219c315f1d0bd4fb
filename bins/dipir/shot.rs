//! `dipir shot`: the objects in every frame of a shot, under one light.
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use clap::Args;
use dipir_cli::args::CommonArgs;
use dipir_cli::exit::{Usage, printable};
use dipir_cli::interrupt;
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::status::State;
use dipir_stages::names::{LIGHT, SCENE};
use dipir_stages::{graph, report, shot};
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

    /// Take every frame to be exposed and white-balanced as the photograph is, whatever Exif data and pictures say
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
    let (mut frames, told) = frames(args, &session, &base)?;
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
        // Where the scene is not set up yet, what is in focus is not known.
        if graph::state_of(&session, SCENE.name)? == State::Fresh {
            focus(&mut frames, &shot::focused(&session)?);
        }
        expose(args, &session, &mut frames, &told, false)?;
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
    focus(&mut frames, &shot::focused(&session)?);
    expose(args, &session, &mut frames, &told, true)?;
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

/// A frame, and its project.
type Frame = (PathBuf, ProjectArgs);

/// The frames, and how much more than the photograph each is exposed by Exif data, stops; nothing where they do not tell.
fn frames(
    args: &ShotArgs,
    session: &Session,
    base: &ProjectArgs,
) -> anyhow::Result<(Vec<Frame>, Vec<Option<f64>>)> {
    let (mut frames, mut told) = (Vec::<Frame>::new(), Vec::new());
    let stands_still = shot::camera_stands_still(session)?;
    let mut assumed = BTreeSet::new();
    let overrides = shot::overrides(session, &args.frames, stands_still, |words, is_doubtful| {
        // Of all frames it mostly is the same.
        if !assumed.insert(words.clone()) {
            return;
        }
        match is_doubtful {
            true => session.warn(&words),
            false => session.remark(|| words),
        }
    });
    for (path, overrides) in args.frames.iter().zip(overrides?) {
        let name = name(path)?;
        told.push(shot::exposure_stops(session, path)?);
        let mut frame = base.clone();
        frame.set.extend(overrides);
        frame.out = Some(session.out.join(shot::FOLDER).join(name));
        if frames.iter().any(|(_, other)| other.out == frame.out) {
            let message = format!("{}: another frame has the same name", path.display());
            return Err(Usage(printable(&message)).into());
        }
        frames.push((path.clone(), frame));
    }
    let open = |(path, frame): &Frame| Ok((path.clone(), frame.open()?.0));
    let opened: anyhow::Result<Vec<_>> = frames.iter().map(open).collect();
    shot::check_cameras(&opened?)?;
    Ok((frames, told))
}

/// Focuses all frames alike, as `focused` says if it says anything.
fn focus(frames: &mut [Frame], focused: &[String]) {
    if focused.is_empty() {
        return;
    }
    let is_of_focus = |set: &String| {
        let key = set.split('=').next().unwrap_or_default().trim();
        shot::FOCUS.contains(&key)
    };
    for (_, frame) in frames {
        frame.set.retain(|set| !is_of_focus(set));
        frame.set.extend_from_slice(focused);
    }
}

/// Gives each frame light of its exposure and white balance: the exposure is what is `told`, all else what the pictures tell,
/// which are read if `look`.
fn expose(
    args: &ShotArgs,
    session: &Session,
    frames: &mut [Frame],
    told: &[Option<f64>],
    look: bool,
) -> anyhow::Result<()> {
    if args.same_exposure {
        return Ok(());
    }
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by_key(|k| shot::order(&frames[*k].0));
    let open = |k: &usize| Ok((frames[*k].0.clone(), frames[*k].1.open()?.0));
    let open: anyhow::Result<Vec<_>> = order.iter().map(open).collect();
    let (found, unknown) = shot::exposure::exposures(session, &open?, look)?;
    let unknown = order.iter().zip(unknown);
    let mut unknown = unknown.filter(|(k, unknown)| *unknown && told[**k].is_none());
    if let Some((first, _)) = unknown.next() {
        let first = frames[*first].0.display();
        let who = match 1 + unknown.count() {
            1 => format!("{first} shows"),
            n => format!("{n} frames, the first of them {first}, show"),
        };
        session.warn(&format!(
            "{who} too little of what the photograph or another frame shows to tell the exposure: exposure and white balance \
             are taken to be those of the frame before"
        ));
    }
    for (k, found) in order.into_iter().zip(found) {
        let (path, frame) = &mut frames[k];
        let (stops, tint) = (
            told[k].unwrap_or(found.stops),
            found.tint.unwrap_or_default(),
        );
        frame.set.extend(shot::exposed(session, stops, tint)?);
        if stops != 0.0 {
            let than = if stops > 0.0 { "more" } else { "less" };
            let stops = stops.abs();
            session.remark(|| format!("{}: exposed by {stops:.2} stops {than}", path.display()));
        }
        // Less is not seen in the figures.
        if tint.iter().any(|stops| stops.abs() >= 0.005) {
            let [r, g, b] = tint;
            session.remark(|| {
                format!(
                    "{}: another white balance, red {r:+.2}, green {g:+.2}, blue {b:+.2} stops",
                    path.display()
                )
            });
        }
    }
    Ok(())
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
