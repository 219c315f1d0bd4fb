//! `dipir run --watch`: once more whenever a file that it reads changes.
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, SystemTime};

use anyhow::Context;
use dipir_cli::exit::{AlreadyReported, INTERRUPTED};
use dipir_cli::interrupt;
use dipir_cli::output::say;
use dipir_cli::session::Session;
use dipir_stages::names;

use crate::project::ProjectArgs;

/// How often files are looked at.
const PAUSE: Duration = Duration::from_millis(500);

/// Time of change and length of files; `None` of one that is not there.
type Stamps = BTreeMap<PathBuf, Option<(SystemTime, u64)>>;

/// Runs this command without `--watch`, as a process of its own: what it knows of files it forgets.
/// Then waits until a file that it read changes, until Ctrl-C.
pub fn watch(project: &ProjectArgs) -> anyhow::Result<()> {
    interrupt::listen_patiently()?;
    let own = std::env::current_exe().context("cannot tell where dipir is")?;
    let args: Vec<OsString> = std::env::args_os()
        .skip(1)
        .filter(|a| a != "--watch")
        .collect();
    loop {
        let before = stamps(project);
        let mut run = Command::new(&own);
        let status = run.args(&args).status().context("cannot run dipir")?;
        if interrupt::asked() || status.code() == Some(i32::from(INTERRUPTED)) {
            return Err(AlreadyReported(INTERRUPTED).into());
        }
        if !project.output.quiet {
            say("waiting for a change of the files that were read; Ctrl-C ends this");
        }
        if !changed(project, before) {
            return Ok(());
        }
    }
}

/// Waits until a file is not as in `before`, and then until none changes any more; false on Ctrl-C.
fn changed(project: &ProjectArgs, before: Stamps) -> bool {
    let mut known = stamps(project);
    // What changed during the run counts; what it made known is seen for the first time.
    known.extend(before);
    let mut last = None;
    while !interrupt::asked() {
        let now: Stamps = known.keys().map(|p| (p.clone(), stamp(p))).collect();
        if now != known && last.as_ref() == Some(&now) {
            return true;
        }
        last = Some(now);
        thread::sleep(PAUSE);
    }
    false
}

fn stamp(path: &PathBuf) -> Option<(SystemTime, u64)> {
    let found = fs::metadata(path).ok()?;
    Some((found.modified().ok()?, found.len()))
}

/// The project's file and the files that its stages read, except those that they wrote themselves.
fn stamps(project: &ProjectArgs) -> Stamps {
    let mut files: Vec<PathBuf> = project.each().iter().map(|p| p.file().to_owned()).collect();
    for project in project.each() {
        // What is wrong with it the run has said.
        let Ok(session) = Session::open(&project.common()) else {
            continue;
        };
        for stage in names::ALL {
            let Ok(manifest) = stage.manifest(&session) else {
                continue;
            };
            let read = manifest.inputs.iter().map(|i| session.resolve(&i.path));
            files.extend(read.filter(|path| !path.starts_with(&session.out)));
        }
    }
    files.into_iter().map(|p| (p.clone(), stamp(&p))).collect()
}
