//! One run at a time in a folder of artifacts.
use std::thread;
use std::time::Duration;

use dipir_cli::exit::printable;
use dipir_cli::interrupt;
use dipir_cli::output::say;
use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::lock::{FolderLock, WhenLocked};

/// How often a folder that another run writes is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// One run at a time in a folder of artifacts; a second is refused, or waits until the user asks to stop.
pub fn lock_folder(session: &Session, waits: bool, quiet: bool) -> anyhow::Result<FolderLock> {
    let mut told = quiet;
    loop {
        match FolderLock::take_inside(&session.out, "run", WhenLocked::Refuse) {
            Err(StageError::Locked { folder, holder }) if waits => {
                if !told {
                    let folder = printable(&folder.display().to_string());
                    say(format!("waiting for {holder}, which writes {folder}"));
                }
                told = true;
                interrupt::check()?;
                thread::sleep(LOOK_EVERY);
            }
            taken => return Ok(taken?),
        }
    }
}
