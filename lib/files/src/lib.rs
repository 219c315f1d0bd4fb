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
    beginning, begins_with, is_anothers, is_at, is_partial_of, left_of_replacing, open_own,
    replace, sync_file, sync_folder,
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

/// The text of a regular file in UTF-8. Errors as [`open`] and [`refuse_utf16`], and
/// [`io::ErrorKind::InvalidData`] for other bytes that are not UTF-8.
pub fn read_to_string(path: impl AsRef<Path>) -> io::Result<String> {
    let bytes = read(path)?;
    refuse_utf16(&bytes)?;
    String::from_utf8(bytes)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8 text"))
}

/// What is said of text in UTF-16.
pub const UTF_16: &str = "it is UTF-16 text; save it as UTF-8 (Notepad: Save as, Encoding UTF-8; PowerShell: Out-File \
                          -Encoding utf8)";

/// Refuses text that begins with the byte order mark of UTF-16, as editors on Windows save it.
///
/// # Errors
/// [`io::ErrorKind::InvalidData`], with the way to save it.
pub fn refuse_utf16(bytes: &[u8]) -> io::Result<()> {
    match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => {
            Err(io::Error::new(io::ErrorKind::InvalidData, UTF_16))
        }
        _ => Ok(()),
    }
}

/// The bytes of a text without the byte order mark that editors on Windows put before it.
pub fn without_byte_order_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    use rustix::fs::{CWD, FileType, Mode};

    use super::*;

    #[test]
    fn utf_16_text_is_refused_with_how_to_save_it_and_a_mark_of_utf_8_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipeline.toml");
        for bytes in [&b"\xff\xfe[\0s\0"[..], b"\xfe\xff\0[\0s"] {
            fs::write(&path, bytes).unwrap();
            let error = read_to_string(&path).unwrap_err();
            assert_eq!(error.to_string(), UTF_16);
        }
        fs::write(&path, b"caf\xe9").unwrap();
        let error = read_to_string(&path).unwrap_err();
        assert_eq!(error.to_string(), "it is not UTF-8 text");
        fs::write(&path, b"\xef\xbb\xbf[s").unwrap();
        let text = read_to_string(&path).unwrap();
        assert_eq!(without_byte_order_mark(text.as_bytes()), b"[s");
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_refused_without_waiting_for_a_writer() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let error = read(&pipe).unwrap_err();
        assert_eq!(error.to_string(), "not a regular file");
    }

    #[cfg(unix)]
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
