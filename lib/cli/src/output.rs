//! Lines on standard error and standard output, and paths in JSON.
use std::fmt::Display;
use std::io::{self, ErrorKind, Write, stderr, stdout};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use anyhow::anyhow;
use dipir_pipeline::manifest::plain_reason;
use serde_json::Value;

/// Why standard output took less than was printed.
static LOST: Mutex<Option<io::Error>> = Mutex::new(None);

/// Writes a line on standard error. That nobody reads it, or that there is no room for it, is no reason to end.
pub fn say(line: impl Display) {
    // In one piece: lines of several processes meet on one terminal.
    let _ = stderr().write_all(format!("{line}\n").as_bytes());
}

/// Prints a line on standard output, as [`print_bytes`].
pub fn print_line(text: &str) {
    print_bytes(format!("{text}\n").as_bytes());
}

/// Prints on standard output. A reader that went away, as `head` does, is no error; any other reason why the text is not
/// there is told when the process ends, by [`crate::exit::run`].
pub fn print_bytes(text: &[u8]) {
    let mut out = stdout().lock();
    noted(out.write_all(text).and_then(|()| out.flush()));
}

/// Keeps the error for [`all_printed`].
pub(crate) fn noted(printed: io::Result<()>) {
    if let Err(e) = printed
        && e.kind() != ErrorKind::BrokenPipe
    {
        let mut lost = LOST.lock().unwrap_or_else(PoisonError::into_inner);
        lost.get_or_insert(e);
    }
}

/// Fails if standard output did not take all that was printed.
pub(crate) fn all_printed() -> anyhow::Result<()> {
    let lost = LOST.lock().unwrap_or_else(PoisonError::into_inner).take();
    match lost {
        None => Ok(()),
        Some(e) => Err(anyhow!(
            "cannot write to standard output: {}; send it elsewhere or free some space (files that were written are whole)",
            plain_reason(&e)
        )),
    }
}

/// A path as a string of JSON, what is not UTF-8 in it replaced by U+FFFD.
pub fn json_path(path: impl AsRef<Path>) -> Value {
    Value::String(path.as_ref().to_string_lossy().into_owned())
}

/// Paths as a list of JSON, as [`json_path`].
pub fn json_paths<P: AsRef<Path>>(paths: impl IntoIterator<Item = P>) -> Value {
    paths.into_iter().map(json_path).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn a_path_that_is_not_utf_8_is_a_string_of_json() {
        use std::os::unix::ffi::OsStrExt;
        let path = Path::new(std::ffi::OsStr::from_bytes(b"a\xff/b"));
        assert_eq!(json_path(path), "a\u{fffd}/b");
        assert_eq!(json_paths([path, Path::new("c")])[1], "c");
    }

    #[test]
    fn a_reader_that_went_away_is_no_error_and_a_full_disk_is_one() {
        noted(Err(ErrorKind::BrokenPipe.into()));
        all_printed().unwrap();
        noted(Err(ErrorKind::StorageFull.into()));
        noted(Ok(()));
        let told = all_printed().unwrap_err().to_string();
        assert!(
            told.starts_with("cannot write to standard output: no storage space;"),
            "{told}"
        );
        all_printed().unwrap();
    }
}
