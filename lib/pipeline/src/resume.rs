//! Where an interrupted run goes on: a folder named by the fingerprint of the run that it belongs
//! to, so that no other run finds it.
use std::fs;
use std::path::{Path, PathBuf};

use crate::error::StageError;
use crate::fingerprint::Fingerprint;
use crate::lock::create_folder;
use crate::mark::{Kind, Mark, Owned, is_folder};

/// A folder of checkpoints, or of a cache, of one fingerprint.
#[derive(Clone, Debug)]
pub struct Resume {
    root: PathBuf,
    folder: PathBuf,
    owned: Owned,
    files: Vec<String>,
}

impl Resume {
    /// Opens the folder of `fingerprint` in `root`, and makes it if it is not there. `files` are
    /// the names that `stage` writes in it, `#` for any row of digits; in a cache those of
    /// [`put`](Self::put), too.
    pub fn open(
        root: &Path,
        kind: Kind,
        stage: &str,
        fingerprint: &Fingerprint,
        files: &[&str],
    ) -> Result<Self, StageError> {
        let folder = root.join(fingerprint.short());
        let mut files: Vec<String> = files.iter().map(|f| f.to_string()).collect();
        if kind == Kind::Cache {
            let own: Vec<String> = files.iter().map(|f| own_name(f, "#")).collect();
            files.extend(own);
        }
        let mark = Mark::new(kind, stage, files.clone());
        mark.make(&folder)?;
        for file in &files {
            if let Some(parent) = folder.join(file).parent() {
                create_folder(parent)?;
            }
        }
        Ok(Self {
            root: root.into(),
            folder,
            owned: mark.owned(),
            files,
        })
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Where the file `name`, one of those that were named when it was opened, lies.
    pub fn file(&self, name: impl AsRef<Path>) -> PathBuf {
        self.folder.join(name)
    }

    /// Lets `write` make the file `name` of a cache under a name of this process's own beside it, and renames that: several
    /// processes that share the cache may make the file at once, and a kill leaves the earlier file or the new one.
    ///
    /// # Errors
    /// Those of `write`, and if the file cannot be renamed.
    pub fn put<E: From<StageError>>(
        &self,
        name: &str,
        write: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<(), E> {
        self.put_as(std::process::id(), name, write)
    }

    fn put_as<E: From<StageError>>(
        &self,
        process: u32,
        name: &str,
        write: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<(), E> {
        let path = self.file(name);
        let own = self.file(own_name(name, &process.to_string()));
        let written = write(&own).and_then(|()| {
            let renamed = fs::rename(&own, &path);
            Ok(renamed.map_err(|e| StageError::io("write", &path, e))?)
        });
        if written.is_err() {
            let _ = fs::remove_file(&own);
        }
        written
    }

    /// Those of its files that lie in its folder `below`, by name, sorted.
    pub fn files_in(&self, below: &str) -> Result<Vec<String>, StageError> {
        let contents = self.owned.contents(&self.folder)?;
        let inside = contents
            .ours
            .iter()
            .filter_map(|name| name.strip_prefix(below).ok());
        Ok(inside
            .map(|name| name.to_string_lossy().into_owned())
            .collect())
    }

    /// Removes the file `name` if it is there.
    pub fn remove_file(&self, name: &str) -> Result<(), StageError> {
        debug_assert!(self.files.iter().any(|f| f == name), "{name} is not listed");
        let path = self.file(name);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(StageError::io("remove", path, e))
            }
            _ => Ok(()),
        }
    }

    /// Removes what is ours, and the folders if nothing else is in them. What cannot be removed
    /// now is of no harm: `dipir clean` removes it.
    pub fn remove(&self) {
        let _ = self.owned.remove(&self.folder);
        let _ = fs::remove_dir(&self.root);
    }
}

/// `0001.4711.png` for `0001.png` and process 4711.
fn own_name(name: &str, process: &str) -> String {
    match name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem}.{process}.{extension}"),
        None => format!("{name}.{process}"),
    }
}

/// The folders of `kind` that `stage` made in `root`, with what in them is its own.
pub fn folders_in(
    root: &Path,
    kind: Kind,
    stage: &str,
) -> Result<Vec<(PathBuf, Owned)>, StageError> {
    if !is_folder(root) {
        return Ok(Vec::new());
    }
    let failed = |e| StageError::io("read", root, e);
    let mut found = Vec::new();
    for entry in fs::read_dir(root).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if let Some(mark) = Mark::read(&path).filter(|m| m.kind == kind && m.stage == stage) {
            found.push((path, mark.owned()));
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processes_that_make_one_file_of_a_cache_at_once_do_not_disturb_each_other() {
        let root = tempfile::tempdir().unwrap();
        let of = Fingerprint::of("concepts").seed(1).finish();
        let cache = Resume::open(root.path(), Kind::Cache, "concepts", &of, &["a/#.png"]).unwrap();
        let write = |path: &Path, text: &str| {
            fs::write(path, text).map_err(|e| StageError::io("write", path, e))
        };
        let whole = || fs::read_to_string(cache.file("a/1.png"));
        let both = cache.put_as(1, "a/1.png", |one| {
            write(one, "begun")?;
            cache.put_as(2, "a/1.png", |two| write(two, "the second"))?;
            assert_eq!(whole().unwrap(), "the second");
            write(one, "the first")
        });
        both.unwrap();
        assert_eq!(whole().unwrap(), "the first");
        // What cannot be made leaves nothing, and what a killed process left is the cache's own.
        let failed = cache.put("a/1.png", |own| {
            write(own, "begun")?;
            Err(StageError::io("write", own, std::io::Error::other("full")))
        });
        failed.unwrap_err();
        fs::write(cache.file("a/1.4711.png"), "begun").unwrap();
        let names = cache.files_in("a").unwrap();
        assert_eq!(names, ["1.4711.png", "1.png"]);
        cache.remove();
        assert!(!root.path().exists());
    }

    #[test]
    fn a_checkpoint_is_found_by_its_run_alone_and_goes_without_what_others_put_there() {
        let out = tempfile::tempdir().unwrap();
        let root = out.path().join("light-checkpoints");
        let of = |seed| Fingerprint::of("light").seed(seed).finish();
        let open = |seed| {
            let files = ["checkpoint", "previews/#.png"];
            Resume::open(&root, Kind::Checkpoints, "light", &of(seed), &files).unwrap()
        };
        let resume = open(1);
        fs::write(resume.file("checkpoint"), "x").unwrap();
        for name in ["previews/2.png", "previews/1.png", "previews/mine.png"] {
            fs::write(resume.file(name), "x").unwrap();
        }
        assert!(!open(2).file("checkpoint").exists());
        open(2).remove();
        assert!(open(1).file("checkpoint").exists());
        assert_eq!(resume.files_in("previews").unwrap(), ["1.png", "2.png"]);
        assert_eq!(
            folders_in(&root, Kind::Checkpoints, "light").unwrap().len(),
            1
        );
        assert!(folders_in(&root, Kind::Cache, "light").unwrap().is_empty());
        assert!(
            folders_in(&root, Kind::Checkpoints, "lora")
                .unwrap()
                .is_empty()
        );
        resume.remove();
        assert!(!resume.file("checkpoint").exists());
        assert!(resume.file("previews/mine.png").exists());
        fs::remove_file(resume.file("previews/mine.png")).unwrap();
        open(1).remove();
        assert!(!root.exists());
    }
}
