//! Files that this program makes and replaces, recognised by how they begin.
//!
//! None of these functions follows a symbolic link at the name that it is given.
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use crate::check_regular;

/// Opens the regular file `path` for reading and writing, its content untouched; makes it if it is
/// not there.
pub fn open_own(path: &Path) -> io::Result<File> {
    match fs::symlink_metadata(path) {
        Ok(found) => check_regular(&found)?,
        Err(e) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(e),
    }
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false);
    do_not_follow(&mut options);
    let file = options.open(path)?;
    check_regular(&file.metadata()?)?;
    Ok(file)
}

/// Whether `path` is a regular file that begins with `mark`; false if nothing is there.
pub fn begins_with(path: &Path, mark: &[u8]) -> io::Result<bool> {
    Ok(beginning(path, mark.len())?.is_some_and(|found| found == mark))
}

/// Writes `content`, which begins with `mark`, beside `path`, flushes it and renames it to `path`:
/// a reader of `path` finds the earlier content or this one, after a power cut, too.
///
/// # Errors
/// Those of the system, and [`io::ErrorKind::AlreadyExists`] if `path`, or `.NAME.partial` beside
/// it, is there and does not begin with `mark`: then nothing is changed.
pub fn replace(path: &Path, content: &[u8], mark: &[u8]) -> io::Result<()> {
    debug_assert!(content.starts_with(mark), "the mark begins the content");
    if beginning(path, mark.len())?.is_some_and(|found| found != mark) {
        return Err(not_ours(path));
    }
    let partial = partial_of(path);
    if let Some(left) = beginning(&partial, mark.len())? {
        // A run that was killed may have written less than the mark.
        if !mark.starts_with(&left) {
            return Err(not_ours(&partial));
        }
        fs::remove_file(&partial)?;
    }
    // Made anew, so that a link that came to the name since is not followed.
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(&partial)?;
    let written = file
        .write_all(content)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&partial, path));
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written?;
    match path.parent().filter(|p| !p.as_os_str().is_empty()) {
        Some(parent) => sync_folder(parent),
        None => sync_folder(Path::new(".")),
    }
}

/// What a killed [`replace`] of `path` left beside it: `.NAME.partial`, if it begins with `mark` or with a part of
/// that.
pub fn left_of_replacing(path: &Path, mark: &[u8]) -> Option<PathBuf> {
    let partial = partial_of(path);
    // What is not a regular file is none of ours.
    let left = beginning(&partial, mark.len()).ok()??;
    mark.starts_with(&left).then_some(partial)
}

/// Flushes the content of a regular file, one that this program wrote, to the disk.
pub fn sync_file(path: &Path) -> io::Result<()> {
    check_regular(&fs::metadata(path)?)?;
    let mut options = OpenOptions::new();
    // Windows flushes through handles that may write; elsewhere a file without that permission is flushed, too.
    options.read(cfg!(unix)).write(cfg!(not(unix)));
    do_not_wait(&mut options);
    let file = options.open(path)?;
    check_regular(&file.metadata()?)?;
    file.sync_all()
}

/// Flushes the names in a folder to the disk, where the file system can.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    if cfg!(not(unix)) {
        return Ok(());
    }
    match File::open(folder)?.sync_all() {
        // The file system flushes no folders. The files in it have been flushed.
        Err(e) if e.kind() == io::ErrorKind::InvalidInput => Ok(()),
        other => other,
    }
}

/// The first `length` bytes of a regular file, fewer if it is shorter; `None` if nothing is there.
/// What is not a regular file is an error.
pub fn beginning(path: &Path, length: usize) -> io::Result<Option<Vec<u8>>> {
    match fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => return Err(not_ours(path)),
        Ok(_) => {}
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e),
    }
    let mut options = OpenOptions::new();
    options.read(true);
    do_not_follow(&mut options);
    let mut found = Vec::with_capacity(length);
    options
        .open(path)?
        .take(length as u64)
        .read_to_end(&mut found)?;
    Ok(Some(found))
}

fn partial_of(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.partial"))
}

fn not_ours(path: &Path) -> io::Error {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    io::Error::new(
        io::ErrorKind::AlreadyExists,
        format!("\"{name}\" is there already and dipir did not make it"),
    )
}

#[cfg(unix)]
fn add_flags(options: &mut OpenOptions, flags: rustix::fs::OFlags) {
    use std::os::unix::fs::OpenOptionsExt;
    options.custom_flags(flags.bits() as i32);
}

#[cfg(unix)]
fn do_not_follow(options: &mut OpenOptions) {
    use rustix::fs::OFlags;
    add_flags(options, OFlags::NOFOLLOW | OFlags::NONBLOCK);
}

#[cfg(unix)]
pub(crate) fn do_not_wait(options: &mut OpenOptions) {
    add_flags(options, rustix::fs::OFlags::NONBLOCK);
}

#[cfg(not(unix))]
fn do_not_follow(_: &mut OpenOptions) {}

#[cfg(not(unix))]
pub(crate) fn do_not_wait(_: &mut OpenOptions) {}

#[cfg(test)]
mod tests {
    use super::*;

    const MARK: &[u8] = b"made by us\n";

    fn content(text: &str) -> Vec<u8> {
        [MARK, text.as_bytes()].concat()
    }

    #[test]
    fn only_a_file_that_begins_with_the_mark_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        replace(&path, &content("one"), MARK).unwrap();
        replace(&path, &content("two"), MARK).unwrap();
        assert_eq!(fs::read(&path).unwrap(), content("two"));
        assert!(begins_with(&path, MARK).unwrap());
        fs::write(&path, "mine").unwrap();
        let error = replace(&path, &content("three"), MARK).unwrap_err();
        assert_eq!(
            error.to_string(),
            "\"page\" is there already and dipir did not make it"
        );
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_a_killed_run_left_is_cleared_and_anothers_file_of_that_name_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let (path, partial) = (
            folder.path().join("page"),
            folder.path().join(".page.partial"),
        );
        for left in [&b""[..], &MARK[..4], MARK] {
            fs::write(&partial, left).unwrap();
            assert_eq!(left_of_replacing(&path, MARK), Some(partial.clone()));
            replace(&path, &content("x"), MARK).unwrap();
            assert!(!partial.exists());
        }
        fs::write(&partial, "mine").unwrap();
        replace(&path, &content("y"), MARK).unwrap_err();
        assert_eq!(left_of_replacing(&path, MARK), None);
        assert_eq!(fs::read(&partial).unwrap(), b"mine");
        assert_eq!(fs::read(&path).unwrap(), content("x"));
    }

    #[test]
    fn what_is_flushed_is_a_file_and_stays_as_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        fs::write(&path, "x").unwrap();
        sync_file(&path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"x");
        sync_file(folder.path()).unwrap_err();
        let missing = folder.path().join("none");
        assert_eq!(
            sync_file(&missing).unwrap_err().kind(),
            io::ErrorKind::NotFound
        );
        assert!(!missing.exists());
    }

    #[cfg(unix)]
    #[test]
    fn links_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let thesis = folder.path().join("thesis");
        for name in ["page", ".page.partial"] {
            fs::write(&thesis, content("years")).unwrap();
            let link = folder.path().join(name);
            std::os::unix::fs::symlink(&thesis, &link).unwrap();
            open_own(&link).unwrap_err();
            replace(&folder.path().join("page"), &content("x"), MARK).unwrap_err();
            assert_eq!(fs::read(&thesis).unwrap(), content("years"));
            fs::remove_file(&link).unwrap();
        }
    }
}
