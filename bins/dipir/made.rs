//! Folders that a run makes for what it writes.
use std::fs;
use std::path::{Path, PathBuf};

/// Folders that were made; those in which nothing is when this is dropped go again.
#[derive(Default)]
pub struct MadeFolders {
    /// The outer ones first.
    folders: Vec<PathBuf>,
}

impl MadeFolders {
    /// Makes `folder` and what is missing above it. Where that fails, whoever writes there says why.
    pub fn make(folder: &Path) -> Self {
        let mut made = Self::default();
        let mut missing: Vec<&Path> = folder.ancestors().take_while(|f| !f.exists()).collect();
        // Of a relative path the last ancestor is empty.
        missing.retain(|f| !f.as_os_str().is_empty());
        for folder in missing.into_iter().rev() {
            // What another process has just made is not ours.
            if fs::create_dir(folder).is_ok() {
                made.folders.push(folder.into());
            }
        }
        made
    }
}

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in self.folders.iter().rev() {
            // One that holds anything stays.
            let _ = fs::remove_dir(folder);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_empty_folders_that_were_made_here_go() {
        let root = tempfile::tempdir().unwrap();
        let of = |name: &str| root.path().join(name);
        fs::create_dir(of("there")).unwrap();
        drop(MadeFolders::make(&of("there")));
        drop(MadeFolders::make(&of("there/a/b")));
        assert!(of("there").is_dir() && !of("there/a").exists());
        let made = MadeFolders::make(&of("there/a/b"));
        fs::create_dir(of("there/a/mine")).unwrap();
        drop(made);
        assert!(of("there/a/mine").is_dir() && !of("there/a/b").exists());
    }
}
