//! `dipir-model fetch`.
use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use candle_core::{DType, Device};
use dipir_cli::exit::Usage;
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::output::json_path;
use dipir_cli::progress::Progress;
use dipir_diffusion::model::Model;
use dipir_hub::{Error, Hub, Outcome, Revision, SOURCE_FILE, Source, Variant};
use dipir_pipeline::lock::{FolderLock, WhenLocked};
use serde_json::json;

use dipir_stages::command_line::model::{FetchArgs, Precision};

/// Where models are if nothing else is said.
const ENDPOINT: &str = "https://huggingface.co";

pub fn run(args: &FetchArgs) -> anyhow::Result<()> {
    interrupt::listen()?;
    let set = |name: &str| env::var(name).ok().filter(|v| !v.is_empty());
    let endpoint = args.endpoint.clone().or_else(|| set("HF_ENDPOINT"));
    let hub = Hub::new(endpoint.as_deref().unwrap_or(ENDPOINT), set("HF_TOKEN")).map_err(usage)?;
    let revision = hub.revision(&args.repo, &args.revision).map_err(usage)?;
    let variant = match args.variant {
        Precision::Full => Variant::Full,
        Precision::Fp16 => Variant::Half,
    };
    let files = dipir_hub::select(&revision, variant)?;
    let target = target(args)?;
    if let Some(parent) = target.parent().filter(|p| !p.as_os_str().is_empty()) {
        fs::create_dir_all(parent)
            .with_context(|| format!("cannot create {}", parent.display()))?;
    }
    let _lock = FolderLock::take(&target, WhenLocked::Refuse)?;
    if occupied(&target, &revision, files.iter().map(|f| f.path.as_str()))? {
        dipir_hub::verify(&files, &target)?;
        return finish(args, &target, &revision, Outcome::default());
    }
    let partial = hidden(&target, "partial");
    let progress = Progress::new("fetching", args.output.quiet);
    let outcome = dipir_hub::fetch(&hub, &revision, &files, &partial, args.retries, |p| {
        progress.set(p.done as f64 / p.total.max(1) as f64);
        progress.say(p.path);
        !interrupt::asked()
    });
    progress.done();
    let outcome = match outcome {
        Err(Error::Interrupted) => return Err(Interrupted.into()),
        other => other?,
    };
    // Loading needs every tensor of every part, and that the parts fit.
    Model::load(&partial, DType::F32, &Device::Cpu)
        .with_context(|| format!("{} was fetched whole, but it does not load", args.repo))?;
    if target.is_dir() {
        // It is empty: a folder that holds anything was refused above.
        fs::remove_dir(&target).with_context(|| format!("cannot write {}", target.display()))?;
    }
    fs::rename(&partial, &target).with_context(|| format!("cannot write {}", target.display()))?;
    finish(args, &target, &revision, outcome)
}

/// A wrong name is an error of usage: only another command line mends it.
fn usage(error: Error) -> anyhow::Error {
    match error {
        Error::Name { .. } => Usage(error.to_string()).into(),
        other => other.into(),
    }
}

fn target(args: &FetchArgs) -> anyhow::Result<PathBuf> {
    let target = match &args.to {
        Some(to) => to.clone(),
        None => PathBuf::from(args.repo.rsplit('/').next().unwrap_or_default()),
    };
    match target.file_name() {
        Some(_) => Ok(target),
        None => Err(Usage(format!(
            "--to {}: name the folder that is to be made",
            target.display()
        ))
        .into()),
    }
}

/// `.NAME.SUFFIX` beside the folder.
fn hidden(target: &Path, suffix: &str) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!(".{name}.{suffix}"))
}

/// Whether `target` holds this very model already; an error if it holds anything else.
fn occupied<'a>(
    target: &Path,
    revision: &Revision,
    files: impl Iterator<Item = &'a str>,
) -> anyhow::Result<bool> {
    match fs::read_dir(target).map(|mut entries| entries.next().is_none()) {
        Ok(true) => return Ok(false),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(false),
        _ => {}
    }
    let source = fs::read(target.join(SOURCE_FILE)).ok();
    let source = source.and_then(|text| serde_json::from_slice::<Source>(&text).ok());
    let same = source.is_some_and(|s| {
        s.repo == revision.repo && s.commit == revision.commit && s.files.iter().eq(files)
    });
    if same {
        return Ok(true);
    }
    let message = format!(
        "{} is there already and is not {} at {}; name another folder with --to, or remove it",
        target.display(),
        revision.repo,
        revision.commit
    );
    Err(Usage(message).into())
}

fn finish(
    args: &FetchArgs,
    target: &Path,
    revision: &Revision,
    outcome: Outcome,
) -> anyhow::Result<()> {
    let there = outcome.files == 0;
    let folder = target.display();
    args.output.result(
        || match there {
            true => format!("{folder} is there already, and whole"),
            false => format!(
                "wrote {folder}: {} files, {:.1} MB, {:.1} MB of them received now\n  \
                 it loads; use it with [model] path = \"{folder}\"",
                outcome.files,
                outcome.bytes as f64 / 1e6,
                outcome.received as f64 / 1e6
            ),
        },
        || {
            json!({
                "folder": json_path(target), "repo": revision.repo, "commit": revision.commit,
                "already_there": there, "files": outcome.files, "bytes": outcome.bytes,
                "received": outcome.received,
            })
        },
    );
    Ok(())
}
