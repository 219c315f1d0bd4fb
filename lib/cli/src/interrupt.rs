//! Ctrl-C, and the signals that ask a process to end (SIGTERM, SIGHUP): the work is asked to stop; if it does not within a
//! moment, the process ends anyway, its unfinished folder removed.
use std::fmt;
use std::io::{Read, stdin};
use std::path::{Path, PathBuf};
use std::process::{self, Child};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::Context;
use dipir_pipeline::stage::discard;

use crate::exit::INTERRUPTED;
use crate::output;

static ASKED: AtomicBool = AtomicBool::new(false);
/// Whether another process waits for this one, and tells the user when it is stopped.
static SUPERVISED: AtomicBool = AtomicBool::new(false);

/// The user asked to stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Interrupted;

impl fmt::Display for Interrupted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("interrupted")
    }
}

impl std::error::Error for Interrupted {}

/// The message to the user.
pub const MESSAGE: &str = "interrupted; earlier results are as they were";

const NO_THREAD: &str = "cannot listen for Ctrl-C, for which a thread is needed: memory or the \
                         number of processes is limited (ulimit -v, ulimit -u)";

/// How long the work may take to stop by itself.
const GRACE: Duration = Duration::from_millis(500);

/// The folder to remove when the process ends early.
static UNFINISHED: Mutex<Option<PathBuf>> = Mutex::new(None);

/// Starts to listen. Stages write beside their target and swap at the end, so that ending the
/// process at any moment leaves earlier results whole.
pub fn listen() -> anyhow::Result<()> {
    handle(stop)
}

/// Runs `act` on Ctrl-C and on the signals that ask to end. A closed terminal stays ignored where the process was started so,
/// as by nohup.
fn handle(act: impl FnMut() + Send + 'static) -> anyhow::Result<()> {
    let outlives_terminal = hangup::is_ignored();
    ctrlc::set_handler(act).context(NO_THREAD)?;
    if outlives_terminal {
        hangup::ignore();
    }
    Ok(())
}

#[cfg(unix)]
mod hangup {
    /// Whether the process ignores that its terminal is closed.
    pub fn is_ignored() -> bool {
        // SAFETY: all zeros are a valid action, and the call only writes the present one there.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            libc::sigaction(libc::SIGHUP, std::ptr::null(), &mut action) == 0
                && action.sa_sigaction == libc::SIG_IGN
        }
    }

    /// Ignores it from now on.
    pub fn ignore() {
        // SAFETY: ignoring a signal runs no code of ours.
        unsafe {
            libc::signal(libc::SIGHUP, libc::SIG_IGN);
        }
    }
}

#[cfg(not(unix))]
mod hangup {
    pub fn is_ignored() -> bool {
        false
    }

    pub fn ignore() {}
}

/// Starts to listen but never ends the process. For work that waits for its children to stop. Does
/// nothing when called again.
pub fn listen_patiently() -> anyhow::Result<()> {
    static LISTENS: AtomicBool = AtomicBool::new(false);
    if !LISTENS.swap(true, Ordering::SeqCst) {
        handle(|| ASKED.store(true, Ordering::SeqCst))?;
    }
    Ok(())
}

/// Asks a child to end, as whoever asked this process would have had to ask it. Only Ctrl-C reaches children by itself.
#[cfg(unix)]
pub fn pass_on(child: &Child) {
    // SAFETY: sending a signal touches no memory. The child has not been waited for, so the number is still its own.
    unsafe {
        libc::kill(child.id() as libc::pid_t, libc::SIGTERM);
    }
}

/// Other systems have no such signal.
#[cfg(not(unix))]
pub fn pass_on(_: &Child) {}

/// Takes the end of standard input for Ctrl-C. Whoever started this process holds the other end,
/// so the work stops when that process does, however it ends.
pub fn follow_standard_input() {
    SUPERVISED.store(true, Ordering::SeqCst);
    thread::spawn(|| {
        let mut buffer = [0; 64];
        let mut input = stdin().lock();
        while input.read(&mut buffer).is_ok_and(|n| n > 0) {}
        stop();
    });
}

fn stop() {
    ASKED.store(true, Ordering::SeqCst);
    thread::sleep(GRACE);
    if let Ok(mut folder) = UNFINISHED.lock()
        && let Some(folder) = folder.take()
    {
        discard(&folder);
    }
    say();
    process::exit(INTERRUPTED.into());
}

/// Tells the user, unless another process does.
pub(crate) fn say() {
    if !is_supervised() {
        output::say(MESSAGE);
    }
}

/// Whether another process started this one and waits for it.
pub(crate) fn is_supervised() -> bool {
    SUPERVISED.load(Ordering::SeqCst)
}

/// Notes the folder to remove when the process ends early.
pub fn unfinished(folder: &Path) {
    if let Ok(mut noted) = UNFINISHED.lock() {
        *noted = Some(folder.into());
    }
}

/// Whether the user asked to stop.
pub fn asked() -> bool {
    ASKED.load(Ordering::Relaxed)
}

/// Fails if the user asked to stop.
pub fn check() -> Result<(), Interrupted> {
    if asked() { Err(Interrupted) } else { Ok(()) }
}
