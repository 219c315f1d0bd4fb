//! From an error to a message and an exit code.
use std::fmt;
use std::io::{Write, stdout};
use std::path::Path;
use std::process::ExitCode;

use clap::Parser;
use dipir_pipeline::error::ConfigError;

use crate::ending;
use crate::interrupt::{self, Interrupted};
use crate::output;
use crate::session::check_threads;
use crate::style::{bold_red, color_on_stderr};

/// Done.
pub const DONE: u8 = 0;
/// Failed.
pub const FAILED: u8 = 1;
/// Wrong usage or configuration.
pub const USAGE: u8 = 2;
/// Interrupted: 128 + SIGINT, as shells count.
pub const INTERRUPTED: u8 = 130;

/// Refuses a name of a PNG that says otherwise. `what` is written, as in `example`.
///
/// # Errors
/// If the extension is not `png`.
pub fn check_png(path: &Path, what: &str, example: &str) -> Result<(), Usage> {
    if path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("png"))
    {
        return Ok(());
    }
    let path = path.display();
    let message = format!("{path}: {what} is written as a PNG: name it so, as in {example}");
    Err(Usage(printable(&message)))
}

/// Marks an error as the fault of the command line or the configuration.
#[derive(Debug)]
pub struct Usage(pub String);

impl fmt::Display for Usage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Usage {}

/// Ends with this exit code and prints nothing, because a child process has printed the error.
#[derive(Debug)]
pub struct AlreadyReported(pub u8);

impl fmt::Display for AlreadyReported {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "exit code {}", self.0)
    }
}

impl std::error::Error for AlreadyReported {}

/// Runs `main`, prints what went wrong with all its causes, and picks the exit code.
pub fn run(main: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    one_tensor_thread();
    ending::prepare();
    let done = few_threads().and_then(|()| main());
    let code = match done.and_then(|()| printed()) {
        Ok(()) => DONE,
        Err(error) => {
            let code = code_of(&error);
            if error.is::<AlreadyReported>() {
                return ExitCode::from(code);
            }
            if code == INTERRUPTED {
                interrupt::say();
            } else {
                print(&error);
            }
            code
        }
    };
    ExitCode::from(code)
}

/// Reads the command line. What help and `--version` print has been printed then, and the error is only the exit code.
pub fn parse<C: Parser>() -> anyhow::Result<C> {
    C::try_parse().map_err(|e| answered(&e))
}

/// Prints what the parser of the command line answers; the exit code.
pub fn answered(error: &clap::Error) -> anyhow::Error {
    let printed = error.print();
    if error.use_stderr() {
        return AlreadyReported(USAGE).into();
    }
    output::noted(printed.and_then(|()| stdout().flush()));
    match output::all_printed() {
        Ok(()) => AlreadyReported(DONE).into(),
        Err(e) => e,
    }
}

/// Fails if the result could not be printed. A stage of a run leaves that to the process which started it and prints to the
/// same place: its own work is done.
fn printed() -> anyhow::Result<()> {
    match interrupt::is_supervised() {
        true => Ok(()),
        false => output::all_printed(),
    }
}

/// Prints what went wrong with all its causes.
pub fn print(error: &anyhow::Error) {
    let label = bold_red("error:", color_on_stderr());
    output::say(format!("{label} {}", printable(&describe(error))));
}

/// Makes the tensor library do its element-wise work on the calling thread. Its pool of spinning
/// threads gains little beside kernels that are parallel themselves, and where processors are
/// shared it costs dearly: on two busy cores training the small model does 1.4 times as much per
/// processor second without it.
fn one_tensor_thread() {
    const KEY: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(KEY).is_none() {
        // SAFETY: called first thing in main, before any other thread exists.
        unsafe { std::env::set_var(KEY, "1") };
    }
}

/// Refuses a number of threads that no machine has. Libraries with a pool of threads of their own start as many as the
/// environment says, whatever `[pipeline] threads` is.
fn few_threads() -> anyhow::Result<()> {
    const KEY: &str = "RAYON_NUM_THREADS";
    let Some(value) = std::env::var_os(KEY) else {
        return Ok(());
    };
    // What is no number is not heeded.
    let threads = value.to_str().and_then(|v| v.parse().ok()).unwrap_or(0);
    check_threads(threads)
        .map_err(|why| Usage(format!("{KEY}={threads} in the environment: {why}")).into())
}

/// The exit code of an error.
pub fn code_of(error: &anyhow::Error) -> u8 {
    if let Some(AlreadyReported(code)) = error.downcast_ref() {
        return *code;
    }
    let is = |test: fn(&(dyn std::error::Error + 'static)) -> bool| error.chain().any(test);
    if is(|e| e.is::<Interrupted>()) {
        INTERRUPTED
    } else if is(|e| e.is::<ConfigError>() || e.is::<Usage>()) {
        USAGE
    } else {
        FAILED
    }
}

/// The message, then its causes. A cause that its parent already quotes is not repeated. Numbers of
/// operating-system errors are left out, because their text says the same. Where no disk has room, the way out follows unless
/// a message has said it.
pub fn describe(error: &anyhow::Error) -> String {
    let mut text = String::new();
    let mut parent = String::new();
    for cause in error.chain() {
        let message = without_number(&cause.to_string());
        if parent.to_lowercase().contains(&message.to_lowercase()) {
            continue;
        }
        if !text.is_empty() {
            text.push_str("\n  caused by: ");
        }
        text.push_str(&message);
        parent = message;
    }
    if is_of_full_disk(error, &text) && !text.contains(FREE_SPACE) {
        text.push_str(&format!("; {FREE_SPACE} or write elsewhere"));
    }
    text
}

/// How the remedy for a full disk begins, here and in the errors of stages.
const FREE_SPACE: &str = "free some space";

/// Whether the system said so. Libraries that write hand on its words, but not always its error.
fn is_of_full_disk(error: &anyhow::Error, text: &str) -> bool {
    use std::io::ErrorKind::{QuotaExceeded, StorageFull};
    let cause = error.root_cause().downcast_ref::<std::io::Error>();
    let text = text.to_lowercase();
    cause.is_some_and(|e| matches!(e.kind(), StorageFull | QuotaExceeded))
        || text.contains("no space left on device")
        || text.contains("disk quota exceeded")
}

/// The text with what a terminal would obey, or what would turn the line around, written as an
/// escape: names of files and values come from anywhere. Line ends stay.
pub fn printable(text: &str) -> String {
    let is_obeyed = |c: char| {
        let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}'
            | '\u{2066}'..='\u{2069}');
        turns || (c.is_control() && c != '\n')
    };
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        match is_obeyed(c) {
            true => shown.extend(c.escape_default()),
            false => shown.push(c),
        }
    }
    shown
}

fn without_number(message: &str) -> String {
    match message.split_once(" (os error ") {
        Some((before, after)) => {
            let after = after.split_once(')').map_or("", |(_, rest)| rest);
            format!("{before}{after}")
        }
        None => message.into(),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use anyhow::Context;
    use dipir_pipeline::config::Config;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("cannot read a.png: {source}")]
    struct Quoting {
        source: std::io::Error,
    }

    #[test]
    fn causes_are_listed_once_each() {
        let source = std::io::Error::other("disk on fire");
        let error = anyhow::Error::new(Quoting { source }).context("the scene cannot be set up");
        assert_eq!(
            describe(&error),
            "the scene cannot be set up\n  caused by: cannot read a.png: disk on fire"
        );
    }

    #[test]
    fn a_full_disk_has_one_remedy_whoever_writes() {
        let full = || std::io::Error::from(std::io::ErrorKind::StorageFull);
        let picture = anyhow::Error::new(full()).context("cannot write a.exr");
        assert_eq!(
            describe(&picture),
            "cannot write a.exr\n  caused by: no storage space; free some space or write elsewhere"
        );
        let handed_on = describe(&anyhow::anyhow!(
            "cannot write a.png: No space left on device (os error 28)"
        ));
        assert_eq!(
            handed_on,
            "cannot write a.png: No space left on device; free some space or write elsewhere"
        );
        let stage = dipir_pipeline::error::StageError::Io {
            action: "write",
            path: "stage.json".into(),
            source: full(),
        };
        let text = describe(&stage.into());
        assert_eq!(text.matches(FREE_SPACE).count(), 1, "{text}");
    }

    #[test]
    fn numbers_of_system_errors_are_left_out() {
        let source = std::io::Error::from_raw_os_error(2);
        let text = describe(&anyhow::anyhow!(
            "cannot read a.png: {source}; check the path"
        ));
        assert!(
            text.ends_with("; check the path") && !text.contains("os error"),
            "{text}"
        );
    }

    #[test]
    fn terminal_escapes_are_shown_and_not_obeyed() {
        let name = "a\u{1b}[2J\u{7}\u{9b}31m\r\u{202e}gnp.b\nä";
        assert_eq!(
            printable(name),
            "a\\u{1b}[2J\\u{7}\\u{9b}31m\\r\\u{202e}gnp.b\nä"
        );
    }

    #[test]
    fn exit_codes_tell_failure_usage_and_interruption_apart() {
        let config = Config::parse(Path::new("p.toml"), "[x]\n", &[]).unwrap_err();
        assert_eq!(code_of(&anyhow::Error::new(config).context("outer")), USAGE);
        assert_eq!(code_of(&Usage("bad flag".into()).into()), USAGE);
        assert_eq!(code_of(&anyhow::Error::new(Interrupted)), INTERRUPTED);
        assert_eq!(code_of(&anyhow::anyhow!("broken")), FAILED);
        assert_eq!(code_of(&anyhow::Error::new(AlreadyReported(7))), 7);
        let wrapped = Err::<(), _>(Interrupted).context("while rendering");
        assert_eq!(code_of(&wrapped.unwrap_err()), INTERRUPTED);
    }
}
