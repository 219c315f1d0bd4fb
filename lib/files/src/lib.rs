//! Opening the files that users name, and replacing only those that this program made.
//!
//! A pipe can make a reader wait for ever and a device can be read without end, so anything but a
//! regular file is refused before it is opened. What is written over an earlier file is written
//! beside it first; the earlier one is replaced only if it begins with the mark of this program.
mod own;
mod rewrite;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read};
use std::path::Path;

pub use own::{
    beginning, begins_with, left_of_replacing, open_own, replace, sync_file, sync_folder,
};
pub use rewrite::rewrite;

/// Opens a regular file for reading. Symbolic links are followed.
///
/// # Errors
/// Those of the system, and [`io::ErrorKind::InvalidInput`] "is not a regular file" for folders,
/// pipes, sockets and devices.
pub fn open(path: impl AsRef<Path>) -> io::Result<File> {
    let path = path.as_ref();
    check_regular(&fs::metadata(path)?)?;
    let mut options = OpenOptions::new();
    options.read(true);
    // Something else may have taken the name since: it is refused, and nothing waits for it.
    own::do_not_wait(&mut options);
    let file = options.open(path)?;
    check_regular(&file.metadata()?)?;
    Ok(file)
}

/// Refuses what is not a regular file.
fn check_regular(found: &fs::Metadata) -> io::Result<()> {
    let kind = found.file_type();
    let message = match (kind.is_file(), kind.is_dir(), kind.is_symlink()) {
        (true, _, _) => return Ok(()),
        (_, true, _) => "a folder, not a regular file",
        (_, _, true) => "a symbolic link, not a regular file",
        _ => "not a regular file",
    };
    Err(io::Error::new(io::ErrorKind::InvalidInput, message))
}

/// The bytes of a regular file. Errors as [`open`].
pub fn read(path: impl AsRef<Path>) -> io::Result<Vec<u8>> {
    let mut file = open(path)?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The text of a regular file in UTF-8. Errors as [`open`].
pub fn read_to_string(path: impl AsRef<Path>) -> io::Result<String> {
    let mut file = open(path)?;
    let mut text = String::new();
    file.read_to_string(&mut text)?;
    Ok(text)
}

/// The bytes of a text without the byte order mark that editors on Windows put before it.
pub fn without_byte_order_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

#[cfg(all(test, unix))]
mod tests {
    use rustix::fs::{CWD, FileType, Mode};

    use super::*;

    #[test]
    fn a_pipe_is_refused_without_waiting_for_a_writer() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let error = read(&pipe).unwrap_err();
        assert_eq!(error.to_string(), "not a regular file");
    }

    #[test]
    fn a_device_and_a_folder_are_refused_and_a_link_to_a_file_is_read() {
        assert_eq!(
            open("/dev/zero").unwrap_err().to_string(),
            "not a regular file"
        );
        let folder = tempfile::tempdir().unwrap();
        let message = open(folder.path()).unwrap_err().to_string();
        assert_eq!(message, "a folder, not a regular file");
        fs::write(folder.path().join("a"), "text").unwrap();
        std::os::unix::fs::symlink("a", folder.path().join("link")).unwrap();
        assert_eq!(read_to_string(folder.path().join("link")).unwrap(), "text");
    }
}
