//! Why the system ended a process, in words.
use std::process::ExitStatus;

/// The message when the process aborts, as Rust does when an allocation fails.
#[cfg(unix)]
const ABORTED: &[u8] = b"error: the process cannot go on; where the line above speaks of an \
    allocation, memory ran out: give it more (ulimit -v), or ask for less, as with --set \
    pipeline.quality=draft; earlier results are as they were\n";

/// Gives a cause to ends that are silent otherwise: a file that grows beyond the size limit becomes
/// a write error, and an abort prints what it comes from.
pub(crate) fn prepare() {
    // SAFETY: called first thing in main. Ignoring a signal runs no code of ours, and the handler
    // calls only `write`, `signal` and `raise`, which are safe in handlers.
    #[cfg(unix)]
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
        let handler: extern "C" fn(libc::c_int) = say_aborted;
        libc::signal(libc::SIGABRT, handler as libc::sighandler_t);
    }
}

/// Prints the message and ends the process by the signal, whoever sent it.
#[cfg(unix)]
extern "C" fn say_aborted(_: libc::c_int) {
    // SAFETY: the bytes outlive the call, and handlers may call all three.
    unsafe {
        libc::write(libc::STDERR_FILENO, ABORTED.as_ptr().cast(), ABORTED.len());
        libc::signal(libc::SIGABRT, libc::SIG_DFL);
        libc::raise(libc::SIGABRT);
    }
}

/// Whether the process printed what it ended by, though it gave no exit code: it aborted, as one does when memory runs out.
pub fn is_told(status: ExitStatus) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::process::ExitStatusExt;
        status.signal() == Some(libc::SIGABRT)
    }
    #[cfg(not(unix))]
    {
        let _ = status;
        false
    }
}

/// What ended a process that gave no exit code, as far as the system reports it.
pub fn cause(status: ExitStatus) -> &'static str {
    #[cfg(unix)]
    {
        use std::os::unix::process::ExitStatusExt;
        match status.signal() {
            Some(libc::SIGKILL) => {
                return "somebody killed it, or the system did for want of memory";
            }
            Some(libc::SIGXFSZ) => return "a file grew beyond the limit (ulimit -f)",
            Some(libc::SIGXCPU) => return "it used more processor time than the limit (ulimit -t)",
            Some(libc::SIGTERM | libc::SIGHUP) => return "another program asked it to end",
            Some(libc::SIGSEGV | libc::SIGBUS | libc::SIGILL) => {
                return "a defect of dipir, or a stack or a mapped file that was cut short";
            }
            _ => {}
        }
    }
    let _ = status;
    "the system does not say why"
}

#[cfg(all(test, unix))]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn a_killed_process_and_a_limit_are_told_apart() {
        let ended = |signal: &str| {
            let script = format!("kill -{signal} $$");
            cause(Command::new("sh").args(["-c", &script]).status().unwrap())
        };
        assert!(ended("KILL").contains("want of memory"));
        let told = |signal: &str| {
            let script = format!("kill -{signal} $$");
            is_told(Command::new("sh").args(["-c", &script]).status().unwrap())
        };
        assert!(told("ABRT") && !told("KILL"));
        assert!(ended("XCPU").contains("ulimit -t"));
        assert!(ended("TERM").contains("another program"));
        let done = Command::new("true").status().unwrap();
        assert_eq!(cause(done), "the system does not say why");
    }
}
