//! Files that were read once, and change while the page is open.
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// A file as it was when it was read.
pub(crate) struct Reading {
    path: PathBuf,
    stamp: Option<(SystemTime, u64)>,
}

fn stamp(path: &Path) -> Option<(SystemTime, u64)> {
    let found = fs::metadata(path).ok()?;
    Some((found.modified().ok()?, found.len()))
}

impl Reading {
    /// Remembers how a file is now.
    pub(crate) fn new(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            stamp: stamp(path),
        }
    }

    /// What became of the file since, one sentence; `None` if nothing.
    pub(crate) fn change(&self) -> Option<String> {
        let now = stamp(&self.path);
        if now == self.stamp {
            return None;
        }
        let how = match now {
            None => "is missing now: dipir run will need it",
            Some(_) => "was written since it was read: start dipir place anew to see it",
        };
        Some(format!("\"{}\" {how}", self.path.display()))
    }
}
