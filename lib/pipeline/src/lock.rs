//! One writer a stage folder.
//!
//! The lock is the operating system's own on an open file, so it ends with its process, however
//! that ends: a killed run leaves nothing that blocks the next. The holder removes the file when
//! done. A process that gets the lock of a file that is no longer at its name starts over, so that
//! two processes never hold locks on two files of the same name. A file system without locks refuses nobody.
use std::fs::{self, File};
use std::io::ErrorKind::NotFound;
use std::io::{self, Read, Seek, Write};
use std::path::{Path, PathBuf};

use dipir_files::{is_anothers, is_at};

use crate::error::StageError;

/// How lock files begin; the number of the process follows.
const HEAD: &str = "dipir lock ";
/// How often a folder that goes while its lock is taken is made again.
const TRIES: usize = 100;

/// What to do when another process writes the folder.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenLocked {
    /// Fail, naming the other process.
    #[default]
    Refuse,
    /// Wait for it to end.
    Wait,
}

/// Held while a stage writes; released when dropped or when the process ends.
#[derive(Debug)]
pub struct FolderLock {
    path: PathBuf,
    file: File,
}

impl FolderLock {
    /// Takes the lock of `folder`, which need not exist, though its parent must.
    pub fn take(folder: &Path, when_locked: WhenLocked) -> Result<Self, StageError> {
        Self::take_file(&lock_path(folder), folder, when_locked)
    }

    /// Takes the lock called `name` inside `folder`, which is made if it is not there: for what
    /// concerns all that is in it.
    pub fn take_inside(
        folder: &Path,
        name: &str,
        when_locked: WhenLocked,
    ) -> Result<Self, StageError> {
        let path = lock_path(&folder.join(name));
        for _ in 0..TRIES {
            // A run that fails removes the folder that it made: then making it or its lock can fail.
            if create_folder(folder).is_err() {
                continue;
            }
            match Self::take_file(&path, folder, when_locked) {
                Err(StageError::Io { source, .. }) if source.kind() == NotFound => {}
                taken => return taken,
            }
        }
        create_folder(folder)?;
        Self::take_file(&path, folder, when_locked)
    }

    fn take_file(path: &Path, folder: &Path, when_locked: WhenLocked) -> Result<Self, StageError> {
        loop {
            let mut file =
                dipir_files::open_own(path).map_err(|e| StageError::io("write", path, e))?;
            if is_anothers(&file) {
                if when_locked == WhenLocked::Refuse {
                    return Err(StageError::Locked {
                        folder: folder.into(),
                        holder: holder(&mut file),
                    });
                }
                file.lock().map_err(|e| StageError::io("lock", path, e))?;
            }
            if is_at(&file, path) {
                sign(&mut file, path)?;
                let path = path.into();
                return Ok(Self { path, file });
            }
        }
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // Where it was removed meanwhile, the name can be another process's lock, or a file of the user's. Without a way to
        // tell, the file has to stay.
        if cfg!(unix) && is_at(&self.file, &self.path) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Writes who holds the lock into its file, unless another program made that.
fn sign(file: &mut File, path: &Path) -> Result<(), StageError> {
    let failed = |e| StageError::io("write", path, e);
    let mut begins = Vec::new();
    let read = (&*file).take(64).read_to_end(&mut begins);
    read.map_err(failed)?;
    let length = begins.len().min(HEAD.len());
    // Locks of earlier versions hold a number alone.
    let is_number = begins.len() < 16 && begins.trim_ascii().iter().all(u8::is_ascii_digit);
    if !HEAD.as_bytes().starts_with(&begins[..length]) && !is_number {
        let message = "it is there already and is no lock of dipir";
        return Err(failed(io::Error::new(
            io::ErrorKind::AlreadyExists,
            message,
        )));
    }
    // On a full disk there is no room for it, and the lock holds without.
    let _ = file
        .set_len(0)
        .and_then(|()| file.rewind())
        .and_then(|()| writeln!(file, "{HEAD}{}", std::process::id()));
    Ok(())
}

fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let read = file.take(64).read_to_string(&mut text);
    match text.trim().strip_prefix(HEAD) {
        Some(process) if read.is_ok() => format!("process {process}"),
        _ => "another process".into(),
    }
}

/// Beside the folder, not inside: the folder is swapped as a whole.
fn lock_path(folder: &Path) -> PathBuf {
    sibling(folder, "lock")
}

/// `.NAME.suffix` beside `folder`.
pub(crate) fn sibling(folder: &Path, suffix: &str) -> PathBuf {
    let name = folder
        .file_name()
        .map_or_else(|| "stage".into(), |n| n.to_string_lossy().into_owned());
    folder.with_file_name(format!(".{name}.{suffix}"))
}

/// Makes `folder` and its parents.
pub(crate) fn create_folder(folder: &Path) -> Result<(), StageError> {
    fs::create_dir_all(folder).map_err(|e| StageError::io("create", folder, e))
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;
    use std::sync::atomic::Ordering::SeqCst;

    use super::*;

    #[test]
    fn a_second_writer_is_refused_by_name_until_the_first_is_done() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        let first = FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
        // Locks belong to the open file, so a second handle stands for a second process.
        let refused = FolderLock::take(&folder, WhenLocked::Refuse).unwrap_err();
        assert_eq!(
            refused.to_string(),
            format!(
                "{} is being written by process {}; wait for it to end, pass --wait, or choose \
                 another folder with --out",
                folder.display(),
                std::process::id()
            )
        );
        drop(first);
        FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
    }

    #[test]
    fn a_lock_file_left_by_a_dead_process_holds_nobody_up() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        for left in ["", "dipir", "dipir lock 999999999\n", "4711\n"] {
            fs::write(lock_path(&folder), left).unwrap();
            let lock = FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
            let text = fs::read_to_string(lock_path(&folder)).unwrap();
            assert_eq!(text, format!("dipir lock {}\n", std::process::id()));
            drop(lock);
            assert!(!lock_path(&folder).exists(), "nothing is left behind");
        }
    }

    #[cfg(unix)]
    #[test]
    fn anothers_file_at_the_name_of_a_lock_is_left_as_it_is() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        let thesis = parent.path().join("thesis");
        fs::write(&thesis, "years of work").unwrap();
        std::os::unix::fs::symlink(&thesis, lock_path(&folder)).unwrap();
        FolderLock::take(&folder, WhenLocked::Refuse).unwrap_err();
        assert_eq!(fs::read(&thesis).unwrap(), b"years of work");
        fs::remove_file(lock_path(&folder)).unwrap();
        fs::rename(&thesis, lock_path(&folder)).unwrap();
        let error = FolderLock::take(&folder, WhenLocked::Refuse).unwrap_err();
        let end = ".scene.lock: it is there already and is no lock of dipir; move it away or \
                   choose another folder with --out";
        assert!(error.to_string().ends_with(end), "{error}");
        assert_eq!(fs::read(lock_path(&folder)).unwrap(), b"years of work");
    }

    #[cfg(unix)]
    #[test]
    fn what_came_to_the_name_of_a_lock_while_it_was_held_stays() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        let first = FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
        fs::remove_file(lock_path(&folder)).unwrap();
        let second = FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
        drop(first);
        FolderLock::take(&folder, WhenLocked::Refuse).unwrap_err();
        fs::remove_file(lock_path(&folder)).unwrap();
        fs::write(lock_path(&folder), "mine").unwrap();
        drop(second);
        assert_eq!(fs::read(lock_path(&folder)).unwrap(), b"mine");
    }

    #[test]
    fn many_writers_never_hold_the_lock_together() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        let (inside, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..50 {
                        let _lock = FolderLock::take(&folder, WhenLocked::Wait).unwrap();
                        most.fetch_max(inside.fetch_add(1, SeqCst) + 1, SeqCst);
                        std::thread::yield_now();
                        inside.fetch_sub(1, SeqCst);
                    }
                });
            }
        });
        assert_eq!(most.into_inner(), 1);
    }

    #[test]
    fn a_folder_that_goes_while_others_wait_is_made_again() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("frames/a");
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..50 {
                        let lock = FolderLock::take_inside(&folder, "run", WhenLocked::Wait);
                        drop(lock.unwrap());
                        let _ = fs::remove_dir(&folder);
                    }
                });
            }
        });
        assert!(!folder.exists());
    }

    #[test]
    fn waiting_ends_when_the_first_writer_does() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("scene");
        let first = FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
        let waiting = {
            let folder = folder.clone();
            std::thread::spawn(move || FolderLock::take(&folder, WhenLocked::Wait).is_ok())
        };
        drop(first);
        assert!(waiting.join().unwrap());
    }
}
