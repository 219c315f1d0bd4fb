//! `dipir clean`.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use dipir_cli::exit::Usage;
use dipir_pipeline::lock::{FolderLock, WhenLocked};
use dipir_pipeline::manifest::FILE_NAME;
use serde_json::json;

use crate::project::{ProjectArgs, Stage};
use crate::run::lock;

#[derive(Args)]
pub struct CleanArgs {
    #[command(flatten)]
    project: ProjectArgs,

    /// Remove the outputs of this stage only; may be repeated
    #[arg(long = "stage", value_name = "STAGE")]
    stages: Vec<Stage>,

    /// Remove the concept images that scenes share, too
    #[arg(long)]
    cache: bool,

    /// Say what would be removed, and remove nothing
    #[arg(long)]
    dry_run: bool,
}

/// Removes what stages wrote, and nothing else.
pub fn run(args: &CleanArgs) -> anyhow::Result<()> {
    let (session, graph) = args.project.open()?;
    let out = &session.out;
    let all = args.stages.is_empty();
    let mut found = Vec::new();
    let mut locks = Vec::new();
    if out.is_dir() {
        locks.push(lock(&session)?);
    }
    for node in graph.nodes() {
        let stage = node.stage;
        if !all && !args.stages.iter().any(|s| s.name() == stage) {
            continue;
        }
        if out.is_dir() {
            locks.push(FolderLock::take(&out.join(stage), WhenLocked::Refuse)?);
        }
        let folder = out.join(stage);
        let is_ours = folder.join(FILE_NAME).is_file();
        if folder.exists() && !is_ours && fs::read_dir(&folder)?.next().is_some() {
            return Err(Usage(format!(
                "{} holds no {FILE_NAME}, so no stage wrote it and it is left alone; nothing was \
                 removed",
                folder.display()
            ))
            .into());
        }
        let beside = ["partial", "previous"].map(|s| out.join(format!(".{stage}.{s}")));
        found.push(folder);
        found.extend(beside);
        found.push(out.join(format!("{stage}-checkpoints")));
    }
    if all {
        found.push(out.join("report.html"));
    }
    if args.cache {
        found.push(out.join("concepts-cache"));
    }
    found.retain(|p| p.exists());
    if !args.dry_run {
        found.iter().try_for_each(|p| remove(p))?;
    }
    session.result(
        || in_words(&found, args.dry_run),
        || json!({"removed": found}),
    );
    Ok(())
}

fn remove(path: &Path) -> anyhow::Result<()> {
    match path.is_dir() {
        true => fs::remove_dir_all(path),
        false => fs::remove_file(path),
    }
    .with_context(|| format!("cannot remove {}", path.display()))
}

fn in_words(found: &[PathBuf], dry_run: bool) -> String {
    if found.is_empty() {
        return "nothing to remove".into();
    }
    let verb = if dry_run { "would remove" } else { "removed" };
    let names: Vec<String> = found.iter().map(|p| p.display().to_string()).collect();
    format!("{verb} {}", names.join(", "))
}
