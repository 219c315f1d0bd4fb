//! `dipir run --watch`: once more whenever a file that it reads changes.
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use dipir_cli::exit::{AlreadyReported, INTERRUPTED};
use dipir_cli::interrupt;
use dipir_cli::output::say;
use dipir_cli::session::Session;
use dipir_stages::names;

use crate::project::ProjectArgs;

/// How often files are looked at.
const PAUSE: Duration = Duration::from_millis(500);

/// How often a run is asked whether it has ended.
const ASK_EVERY: Duration = Duration::from_millis(50);
/// How long a run may go on once this process was asked to stop, where no signal can ask the run.
const GRACE: Duration = Duration::from_secs(2);

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
        let child = run.args(&args).spawn().context("cannot run dipir")?;
        let status = wait(child).context("cannot follow dipir")?;
        if interrupt::asked() || status.code() == Some(i32::from(INTERRUPTED)) {
            return Err(AlreadyReported(INTERRUPTED).into());
        }
        if !project.output.quiet {
            say("waiting for a change of the files that were read; Ctrl-C ends this");
        }
        if !changed(project, before) {
            return Err(AlreadyReported(INTERRUPTED).into());
        }
    }
}

/// Waits for the end of a run. If this process is asked to stop, the run is asked, too, and ends as on Ctrl-C. Where it cannot
/// be asked, one that goes on for [`GRACE`] is killed, and its stages stop by themselves then.
fn wait(mut child: Child) -> io::Result<ExitStatus> {
    let mut asked = None;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if interrupt::asked() {
            let since = asked.get_or_insert_with(|| {
                interrupt::pass_on(&child);
                Instant::now()
            });
            if cfg!(not(unix)) && since.elapsed() > GRACE {
                child.kill()?;
            }
        }
        thread::sleep(ASK_EVERY);
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

/// None for a folder, too: what runs write changes it.
fn stamp(path: &Path) -> Option<(SystemTime, u64)> {
    let found = fs::metadata(path).ok().filter(fs::Metadata::is_file)?;
    Some((found.modified().ok()?, found.len()))
}

/// The project's file, what it names, there or not, and the files that its stages read, except those that they wrote
/// themselves.
fn stamps(project: &ProjectArgs) -> Stamps {
    let mut files: Vec<PathBuf> = project.each().iter().map(|p| p.file().to_owned()).collect();
    for project in project.each() {
        // What is wrong with it the run has said.
        let Ok(session) = Session::open(&project.common()) else {
            continue;
        };
        let named = session.config.texts().into_iter();
        let mut read: Vec<PathBuf> = named.map(|(_, text)| text.into()).collect();
        for stage in names::ALL {
            if let Ok(manifest) = stage.manifest(&session) {
                read.extend(manifest.inputs.into_iter().map(|i| i.path));
            }
        }
        let written = names::ALL.map(|stage| session.stage_folder(stage.name));
        let read = read.iter().map(|path| session.resolve(path));
        files.extend(read.filter(|path| !written.iter().any(|folder| path.starts_with(folder))));
    }
    files.into_iter().map(|p| (p.clone(), stamp(&p))).collect()
}

#[cfg(test)]
mod tests {
    use dipir_cli::args::OutputArgs;

    use super::*;

    #[test]
    fn files_of_the_project_are_watched_though_it_is_the_folder_of_artifacts_and_lacks_some() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let text = "[pipeline]\nout = \".\"\n[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"a.obj\"\n\
                    [composite]\nenvironment = \"light/environment.exr\"\n";
        fs::write(at("pipeline.toml"), text).unwrap();
        fs::write(at("photo.png"), "x").unwrap();
        let project = ProjectArgs {
            files: vec![at("pipeline.toml")],
            pipeline: None,
            set: Vec::new(),
            out: None,
            seed: None,
            light: None,
            placed: None,
            output: OutputArgs::default(),
        };
        let watched = stamps(&project);
        assert!(watched[&at("pipeline.toml")].is_some());
        assert!(watched[&at("photo.png")].is_some());
        assert_eq!(watched[&at("a.obj")], None);
        // What a stage wrote.
        assert!(!watched.contains_key(&at("light/environment.exr")));
        // A folder changes with what is written in it.
        assert_eq!(watched[&at(".")], None);
    }
}
