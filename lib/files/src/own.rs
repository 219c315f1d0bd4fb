//! Files that this program makes and replaces, recognised by how they begin.
//!
//! None of these functions follows a symbolic link at the name that it is given.
use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

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
/// a reader of `path` finds the earlier content or this one, after a power cut, too. Of several processes that
/// replace it at once, the last one to end wins.
///
/// # Errors
/// Those of the system, and [`io::ErrorKind::AlreadyExists`] if `path`, or `.NAME.partial` beside
/// it, is there and does not begin with `mark`: then nothing is changed.
pub fn replace(path: &Path, content: &[u8], mark: &[u8]) -> io::Result<()> {
    debug_assert!(content.starts_with(mark), "the mark begins the content");
    if beginning(path, mark.len())?.is_some_and(|found| found != mark) {
        return Err(not_ours(path));
    }
    let (partial, mut file) = begin(path, mark)?;
    let written = file
        .write_all(content)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&partial, path));
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written?;
    sync_folder(folder_of(path))
}

fn folder_of(path: &Path) -> &Path {
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty());
    parent.unwrap_or(Path::new("."))
}

/// A new, locked file beside `path`: `.NAME.partial`, or a name of this process's own where another process is writing
/// that. What a killed process left there is removed.
fn begin(path: &Path, mark: &[u8]) -> io::Result<(PathBuf, File)> {
    let partial = partial_of(path);
    if let Some(left) = left_at(&partial, mark)? {
        // Locked and at its name, so it is nobody else's meanwhile.
        if is_at(&left, &partial) {
            fs::remove_file(&partial)?;
        }
    }
    if let Some(file) = create_locked(&partial)? {
        return Ok((partial, file));
    }
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    loop {
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let process = std::process::id();
        let own = path.with_file_name(format!(".{name}.{process}-{count}.partial"));
        if let Some(file) = create_locked(&own)? {
            return Ok((own, file));
        }
    }
}

/// Makes the file anew, so that a link that came to the name since is not followed. The lock tells others that it is
/// being written; a file system without locks does without. `None` if the name is, or has just been, another process's.
fn create_locked(partial: &Path) -> io::Result<Option<File>> {
    let mut options = OpenOptions::new();
    let file = match options.write(true).create_new(true).open(partial) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => return Ok(None),
        opened => opened?,
    };
    Ok((!is_anothers(&file) && is_at(&file, partial)).then_some(file))
}

/// Locks `file`, unless another process has; whether one has. On a file system without locks none has, and `file` is not
/// locked either.
pub fn is_anothers(file: &File) -> bool {
    matches!(file.try_lock(), Err(TryLockError::WouldBlock))
}

/// What a killed [`replace`] left at `partial`, locked; `None` if nothing is there or a running one writes it. What does
/// not begin with `mark` or a part of it is an error.
fn left_at(partial: &Path, mark: &[u8]) -> io::Result<Option<File>> {
    let left = match open_regular(partial)? {
        Some(left) => left,
        None => return Ok(None),
    };
    if is_anothers(&left) {
        return Ok(None);
    }
    let mut begins = Vec::with_capacity(mark.len());
    (&left).take(mark.len() as u64).read_to_end(&mut begins)?;
    match mark.starts_with(&begins) {
        true => Ok(Some(left)),
        false => Err(not_ours(partial)),
    }
}

/// Whether the open file is the one at `path`. Only unix tells; elsewhere it is taken to be.
#[cfg(unix)]
pub fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let same = |a: fs::Metadata, b: fs::Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    let (open, named) = (file.metadata(), fs::symlink_metadata(path));
    open.ok().zip(named.ok()).is_some_and(|(a, b)| same(a, b))
}

/// Whether the open file is the one at `path`. Only unix tells; elsewhere it is taken to be.
#[cfg(not(unix))]
pub fn is_at(_: &File, _: &Path) -> bool {
    true
}

/// What a killed [`replace`] of `path` left beside it, if it begins with `mark` or with a part of that: `.NAME.partial`,
/// else the first one that has the number of a process in its name.
pub fn left_of_replacing(path: &Path, mark: &[u8]) -> Option<PathBuf> {
    // What is not a regular file is none of ours.
    let is_left = |partial: &PathBuf| left_at(partial, mark).is_ok_and(|left| left.is_some());
    let partial = partial_of(path);
    if is_left(&partial) {
        return Some(partial);
    }
    let entries = fs::read_dir(folder_of(path))
        .into_iter()
        .flatten()
        .flatten();
    let names = entries.map(|entry| entry.file_name());
    let names = names.filter(|name| is_partial_of(path, name));
    let names = names.map(|name| partial.with_file_name(name));
    names.filter(is_left).min()
}

/// Whether `name` is one under which [`replace`] writes `path`, with the number of a process in it or without.
pub fn is_partial_of(path: &Path, name: &OsStr) -> bool {
    let (of, name) = (path.file_name().unwrap_or_default(), name.to_string_lossy());
    let rest = name.strip_prefix(&format!(".{}.", of.to_string_lossy()));
    let numbers = rest.and_then(|rest| rest.strip_suffix("partial"));
    numbers.is_some_and(|n| n.is_empty() || n.ends_with('.') && is_number(n.trim_end_matches('.')))
}

fn is_number(text: &str) -> bool {
    text.bytes().all(|b| b.is_ascii_digit() || b == b'-')
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
    let Some(file) = open_regular(path)? else {
        return Ok(None);
    };
    let mut found = Vec::with_capacity(length);
    file.take(length as u64).read_to_end(&mut found)?;
    Ok(Some(found))
}

/// Opens a regular file for reading; `None` if nothing is there.
fn open_regular(path: &Path) -> io::Result<Option<File>> {
    let is_missing = |e: &io::Error| e.kind() == io::ErrorKind::NotFound;
    match fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => return Err(not_ours(path)),
        Ok(_) => {}
        Err(e) if is_missing(&e) => return Ok(None),
        Err(e) => return Err(e),
    }
    let mut options = OpenOptions::new();
    options.read(true);
    do_not_follow(&mut options);
    match options.open(path) {
        // Renamed since.
        Err(e) if is_missing(&e) => Ok(None),
        opened => opened.map(Some),
    }
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
    fn a_file_that_another_process_is_writing_is_left_alone_and_replaced_all_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let partial = folder.path().join(".page.partial");
        fs::write(&partial, MARK).unwrap();
        let other = File::open(&partial).unwrap();
        other.lock().unwrap();
        replace(&path, &content("x"), MARK).unwrap();
        assert_eq!(fs::read(&path).unwrap(), content("x"));
        assert!(partial.exists());
        assert_eq!(left_of_replacing(&path, MARK), None);
        drop(other);
        assert_eq!(left_of_replacing(&path, MARK), Some(partial.clone()));
        replace(&path, &content("y"), MARK).unwrap();
        assert!(!partial.exists());
        // Of another that was killed at the same time.
        let own = folder.path().join(".page.123-4.partial");
        for name in [
            ".page.old.partial",
            ".page.123-4.partial",
            ".pages.1-2.partial",
        ] {
            fs::write(folder.path().join(name), MARK).unwrap();
        }
        assert_eq!(left_of_replacing(&path, MARK), Some(own));
    }

    // Elsewhere nothing tells whether an open file is still at its name.
    #[cfg(unix)]
    #[test]
    fn writers_at_once_do_not_disturb_each_other_and_readers_find_whole_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let of = |writer: usize| content(&writer.to_string().repeat(1 << 16));
        replace(&path, &of(0), MARK).unwrap();
        std::thread::scope(|scope| {
            for writer in 0..4 {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..50 {
                        replace(path, &of(writer), MARK).unwrap();
                        let found = fs::read(path).unwrap();
                        assert!((0..4).any(|w| found == of(w)), "{} bytes", found.len());
                    }
                });
            }
        });
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
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
