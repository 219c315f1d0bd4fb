//! `dipir clean`.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use dipir_cli::exit::{Usage, printable};
use dipir_cli::output::json_paths;
use dipir_pipeline::error::StageError;
use dipir_pipeline::hashing::Hashes;
use dipir_pipeline::lock::{FolderLock, WhenLocked};
use dipir_pipeline::manifest::plain_reason;
use dipir_pipeline::mark::{Kind, Owned};
use dipir_pipeline::{resume, stage};
use dipir_stages::names::CONCEPTS;
use dipir_stages::{report, shot};
use serde_json::json;

use crate::hashed::hashes_file;
use crate::project::{ProjectArgs, Stage, one_file};

#[derive(Args)]
#[command(mut_arg("files", one_file))]
pub struct CleanArgs {
    #[command(flatten)]
    project: ProjectArgs,

    /// Remove the outputs of this stage only; may be repeated
    #[arg(long = "stage", value_name = "STAGE")]
    stages: Vec<Stage>,

    /// Remove finished concept images in concepts-cache of the folder of artifacts, too; a folder that [concepts] cache
    /// names stays
    #[arg(long)]
    cache: bool,

    /// Say what would be removed, and remove nothing
    #[arg(long)]
    dry_run: bool,
}

/// What is removed, and what is left in its place.
#[derive(Default)]
struct Found {
    /// Folders of which we know what in them is ours.
    folders: Vec<(PathBuf, Owned)>,
    /// What stages that were killed left, by the stage's folder.
    untidy: Vec<(PathBuf, &'static str)>,
    /// Files of ours outside of such folders.
    files: Vec<PathBuf>,
    /// Folders that go when nothing is in them any more.
    roots: Vec<PathBuf>,
}

/// Removes what stages wrote, and nothing else.
pub fn run(args: &CleanArgs) -> anyhow::Result<()> {
    let (session, graph) = args.project.open()?;
    let out = &session.out;
    let asked =
        |stage: &str| args.stages.is_empty() || args.stages.iter().any(|s| s.name() == stage);
    let stages = graph.nodes().iter().map(|n| n.stage);
    let stages: Vec<&'static str> = stages.filter(|stage| asked(stage)).collect();
    let mut frames = shot::folders(out);
    let is_ours = |frame: &Path| {
        stages.iter().any(|stage| {
            let folder = frame.join(stage);
            Owned::of_stage(&folder, stage).is_some() || !stage::untidy(&folder, stage).is_empty()
        })
    };
    frames.retain(|frame| is_ours(frame));
    let all = || std::iter::once(out).chain(&frames);
    let mut locks = Vec::new();
    if out.is_dir() && !args.dry_run {
        for out in all() {
            let lock = FolderLock::take_inside(out, "run", WhenLocked::Refuse);
            locks.push(lock.map_err(without_wait)?);
            for stage in &stages {
                let lock = FolderLock::take(&out.join(stage), WhenLocked::Refuse);
                locks.push(lock.map_err(without_wait)?);
            }
        }
    }
    let mut found = Found::default();
    for out in all() {
        find(&mut found, args, out, &stages)?;
    }
    if !frames.is_empty() {
        found.roots.extend(frames.iter().cloned());
        found.roots.push(out.join(shot::FOLDER));
    }
    let exposures = shot::exposure::kept_in(out);
    if args.stages.is_empty() {
        found
            .files
            .extend(shot::exposure::left_of_writing(&exposures));
        if shot::exposure::is_kept(&exposures) {
            found.files.push(exposures);
            found.roots.push(out.join(shot::FOLDER));
        }
    }
    let (removed, kept) = found.listed()?;
    let roots = std::mem::take(&mut found.roots);
    if !args.dry_run {
        found.remove()?;
    }
    drop(locks);
    if !args.dry_run {
        for root in &roots {
            // Only if nothing else is in it.
            let _ = fs::remove_dir(root);
        }
    }
    session.result(
        || in_words(&removed, &kept, args.dry_run),
        || json!({"removed": json_paths(&removed), "kept": json_paths(&kept), "dry_run": args.dry_run}),
    );
    Ok(())
}

/// The message about a folder that cannot be locked, in the words of a command that writes nothing.
fn without_wait(error: StageError) -> anyhow::Error {
    match error {
        StageError::Locked { folder, holder } => anyhow!(
            "{} is being written by {holder}; wait for it to end, and nothing was removed",
            folder.display()
        ),
        StageError::Io {
            action,
            path,
            source,
        } => anyhow!(
            "cannot {action} {}: {}; nothing was removed",
            path.display(),
            plain_reason(&source)
        ),
        other => other.into(),
    }
}

/// Looks for what is ours; an error if a stage's folder is another's.
fn find(
    found: &mut Found,
    args: &CleanArgs,
    out: &Path,
    stages: &[&'static str],
) -> anyhow::Result<()> {
    for stage in stages.iter().copied() {
        let folder = out.join(stage);
        if let Err(e) = stage::refuse_foreign(&folder, stage) {
            return Err(match e {
                StageError::Foreign { folder, why } => {
                    Usage(format!("{} {why}; nothing was removed", folder.display())).into()
                }
                other => other.into(),
            });
        }
        if !stage::untidy(&folder, stage).is_empty() {
            found.untidy.push((folder.clone(), stage));
        }
        if let Some(owned) = Owned::of_stage(&folder, stage) {
            found.folders.push((folder, owned));
        }
        found.add_folders_in(
            &out.join(format!("{stage}-checkpoints")),
            Kind::Checkpoints,
            stage,
        )?;
        let hashes = hashes_file(out, stage);
        found.files.extend(Hashes::left_of_writing(&hashes));
        if Hashes::are_in(&hashes) {
            found.files.push(hashes);
        }
    }
    let page = out.join(report::FILE);
    // What is not a regular file is none of ours.
    let is_ours = dipir_files::begins_with(&page, report::MARK).unwrap_or(false);
    if args.stages.is_empty() {
        found
            .files
            .extend(dipir_files::left_of_replacing(&page, report::MARK));
        if is_ours {
            found.files.push(page);
        }
    }
    if args.cache {
        found.add_folders_in(&out.join("concepts-cache"), Kind::Cache, CONCEPTS.name)?;
    }
    Ok(())
}

impl Found {
    fn add_folders_in(&mut self, root: &Path, kind: Kind, stage: &str) -> Result<(), StageError> {
        let folders = resume::folders_in(root, kind, stage)?;
        if !folders.is_empty() {
            self.roots.push(root.into());
        }
        self.folders.extend(folders);
        Ok(())
    }

    /// What is removed, and what lies in the same folders and is kept.
    fn listed(&self) -> Result<(Vec<PathBuf>, Vec<PathBuf>), StageError> {
        let (mut removed, mut kept) = (Vec::new(), Vec::new());
        for (folder, owned) in &self.folders {
            let contents = owned.contents(folder)?;
            let is_mark = |name: &PathBuf| name == Path::new(dipir_pipeline::mark::FILE_NAME);
            match contents.others.is_empty() {
                true => removed.push(folder.clone()),
                // The mark stays, so that the folder is known.
                false => removed.extend(
                    contents
                        .ours
                        .iter()
                        .filter(|name| !is_mark(name))
                        .map(|name| folder.join(name)),
                ),
            }
            kept.extend(contents.others.iter().map(|name| folder.join(name)));
        }
        removed.extend(
            self.untidy
                .iter()
                .flat_map(|(f, stage)| stage::untidy(f, stage)),
        );
        removed.extend(self.files.iter().cloned());
        Ok((removed, kept))
    }

    fn remove(self) -> anyhow::Result<()> {
        // First, for what others put beside an earlier result moves to the stage's folder.
        for (folder, stage) in &self.untidy {
            stage::tidy(folder, stage)?;
            // A result that a kill kept from its place is back there.
            let is_known = self.folders.iter().any(|(known, _)| known == folder);
            if let Some(owned) = Owned::of_stage(folder, stage).filter(|_| !is_known) {
                owned.remove(folder)?;
            }
        }
        for (folder, owned) in &self.folders {
            owned.remove(folder)?;
        }
        for file in &self.files {
            fs::remove_file(file).with_context(|| format!("cannot remove {}", file.display()))?;
        }
        Ok(())
    }
}

fn in_words(removed: &[PathBuf], kept: &[PathBuf], dry_run: bool) -> String {
    let listed = |paths: &[PathBuf]| {
        let names: Vec<String> = paths.iter().map(|p| p.display().to_string()).collect();
        names.join(", ")
    };
    let mut text = match (removed.is_empty(), dry_run) {
        (true, _) => "nothing to remove".into(),
        (false, true) => format!("would remove {}", listed(removed)),
        (false, false) => format!("removed {}", listed(removed)),
    };
    if !kept.is_empty() {
        text += &format!("\nleft alone, as no stage wrote it: {}", listed(kept));
    }
    printable(&text)
}

#[cfg(test)]
mod tests {
    use dipir_pipeline::stage::{StagePlan, StageWriter};

    use super::*;

    #[test]
    fn a_result_that_a_kill_kept_from_its_place_is_removed() {
        for suffix in ["partial", "previous"] {
            let out = tempfile::tempdir().unwrap();
            let folder = out.path().join("scene");
            let plan = StagePlan::new("scene", 1, json!({}), 0);
            let writer = StageWriter::begin(&folder, plan, WhenLocked::Refuse).unwrap();
            writer.finish().unwrap();
            fs::rename(&folder, out.path().join(format!(".scene.{suffix}"))).unwrap();
            let found = Found {
                untidy: vec![(folder, "scene")],
                ..Found::default()
            };
            assert_eq!(found.listed().unwrap().0.len(), 1);
            found.remove().unwrap();
            assert_eq!(fs::read_dir(out.path()).unwrap().count(), 0, "{suffix}");
        }
    }
}
