//! One writer a stage folder.
//!
//! The lock is the operating system's own on an open file, so it ends with its process however
//! that ends: a lock left behind by a killed run holds nobody up. The file itself stays, because
//! removing it would let two processes hold locks on two files of the same name.
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use crate::error::StageError;

/// What to do when somebody else writes the folder.
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
    _file: File,
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
        create_folder(folder)?;
        Self::take_file(&lock_path(&folder.join(name)), folder, when_locked)
    }

    fn take_file(path: &Path, folder: &Path, when_locked: WhenLocked) -> Result<Self, StageError> {
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .map_err(|e| StageError::io("write", path, e))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) if when_locked == WhenLocked::Wait => {
                file.lock().map_err(|e| StageError::io("lock", path, e))?;
            }
            Err(TryLockError::WouldBlock) => {
                return Err(StageError::Locked {
                    folder: folder.into(),
                    holder: holder(&mut file),
                });
            }
            Err(TryLockError::Error(e)) => return Err(StageError::io("lock", path, e)),
        }
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .map_err(|e| StageError::io("write", path, e))?;
        Ok(Self { _file: file })
    }
}

fn holder(file: &mut File) -> String {
    let mut text = String::new();
    match file.read_to_string(&mut text) {
        Ok(_) if !text.trim().is_empty() => format!("process {}", text.trim()),
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
        fs::write(lock_path(&folder), "999999999\n").unwrap();
        FolderLock::take(&folder, WhenLocked::Refuse).unwrap();
        let text = fs::read_to_string(lock_path(&folder)).unwrap();
        assert_eq!(text, format!("{}\n", std::process::id()));
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
