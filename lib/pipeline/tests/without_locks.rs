//! Stages on a file system without locks: a `flock` that fails stands for one.
#![cfg(target_os = "linux")]
use std::ffi::c_int;
use std::fs::{File, TryLockError};

use dipir_pipeline::lock::{FolderLock, WhenLocked};

const ENOSYS: c_int = 38;

unsafe extern "C" {
    fn __errno_location() -> *mut c_int;
}

/// In place of the C library's.
#[unsafe(no_mangle)]
extern "C" fn flock(_: c_int, _: c_int) -> c_int {
    // SAFETY: the address is that of this thread's errno.
    unsafe { *__errno_location() = ENOSYS };
    -1
}

#[test]
fn a_file_system_without_locks_refuses_nobody() {
    let parent = tempfile::tempdir().unwrap();
    let file = File::create(parent.path().join("file")).unwrap();
    assert!(matches!(file.try_lock(), Err(TryLockError::Error(_))));
    for when_locked in [WhenLocked::Refuse, WhenLocked::Wait] {
        let folder = parent.path().join("scene");
        let first = FolderLock::take(&folder, when_locked).unwrap();
        let second = FolderLock::take_inside(&folder, "run", when_locked).unwrap();
        drop((first, second));
    }
    let left = std::fs::read_dir(parent.path()).unwrap();
    assert_eq!(left.count(), 2, "the file and the folder");
}
