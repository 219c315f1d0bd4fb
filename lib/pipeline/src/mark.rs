//! Folders that are ours: each holds a file [`FILE_NAME`] that says so and lists what in it is ours.
//!
//! Nothing is removed that neither such a list nor a stage's manifest names. Symbolic links are
//! never followed here, and never removed.
use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{MAIN_SEPARATOR, Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::{Foreign, StageError};
use crate::lock::create_folder;
use crate::manifest::{self, Manifest};

/// Name of the mark in a folder of ours.
pub const FILE_NAME: &str = ".dipir";
/// Version of the mark's own layout.
const SCHEMA: u32 = 1;
/// How every mark begins.
const HEAD: &[u8] = b"{\"made_by\":\"dipir\",";

/// What a folder of ours is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A stage's result.
    Stage,
    /// A stage's result while it is being written: everything in it is ours.
    Unfinished,
    /// Where an interrupted run goes on.
    Checkpoints,
    /// What several runs share.
    Cache,
}

/// The content of [`FILE_NAME`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark {
    made_by: String,
    schema: u32,
    /// What the folder is for.
    pub kind: Kind,
    /// The stage that made it.
    pub stage: String,
    /// Files in it that are ours, relative to it; `#` stands for any row of digits.
    pub files: Vec<String>,
}

impl Mark {
    /// The mark of a folder that `stage` makes.
    pub fn new(kind: Kind, stage: &str, files: Vec<String>) -> Self {
        Self {
            made_by: "dipir".into(),
            schema: SCHEMA,
            kind,
            stage: stage.into(),
            files,
        }
    }

    /// The mark in `folder`; none where there is no folder, no mark, or one that cannot be read.
    pub fn read(folder: &Path) -> Option<Self> {
        let path = folder.join(FILE_NAME);
        if !is_folder(folder) || !fs::symlink_metadata(&path).ok()?.is_file() {
            return None;
        }
        let mark: Self = serde_json::from_slice(&dipir_files::read(&path).ok()?).ok()?;
        (mark.made_by == "dipir" && mark.schema == SCHEMA).then_some(mark)
    }

    /// Writes the mark into `folder`, over an earlier one.
    pub fn write(&self, folder: &Path) -> Result<(), StageError> {
        let path = folder.join(FILE_NAME);
        let failed = |e| StageError::io("write", &path, e);
        let text = serde_json::to_vec(self).map_err(|e| failed(e.into()))?;
        dipir_files::replace(&path, &text, HEAD).map_err(failed)
    }

    /// Makes `folder` with this mark, or takes it if it has a mark of that kind and stage; one that
    /// is there otherwise is refused unless it is empty.
    pub fn make(&self, folder: &Path) -> Result<(), StageError> {
        let known = Self::read(folder);
        let is_ours = |m: &Self| m.kind == self.kind && m.stage == self.stage;
        if known.as_ref() == Some(self) {
            return Ok(());
        }
        let is_known = known.as_ref().is_some_and(is_ours);
        let mut is_new = false;
        if !is_known {
            match fs::symlink_metadata(folder) {
                Err(e) if e.kind() == io::ErrorKind::NotFound => {
                    create_folder(folder)?;
                    is_new = true;
                }
                Err(e) => return Err(StageError::io("read", folder, e)),
                Ok(_) if is_empty(folder)? => {
                    // Of runs that were killed at this point: a mark without content, and what was to become one.
                    let mark = folder.join(FILE_NAME);
                    let _ = fs::remove_file(&mark);
                    while let Some(left) = dipir_files::left_of_replacing(&mark, HEAD)
                        && fs::remove_file(left).is_ok()
                    {}
                }
                Ok(_) => return Err(foreign(folder, Foreign::NoMark)),
            }
        }
        match self.write(folder) {
            // A folder that is only read keeps the list that another version wrote.
            Err(StageError::Io { source, .. }) if is_known && is_refused(&source) => Ok(()),
            written => written.inspect_err(|_| {
                if is_new {
                    let _ = fs::remove_dir(folder);
                }
            }),
        }
    }

    /// What in `folder` this mark calls ours.
    pub fn owned(&self) -> Owned {
        Owned {
            files: self.files.clone(),
            stage: self.stage.clone(),
            kind: self.kind,
        }
    }
}

/// Which files of a folder are ours.
#[derive(Clone, Debug)]
pub struct Owned {
    files: Vec<String>,
    stage: String,
    kind: Kind,
}

/// The content of a folder, relative to it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Contents {
    /// Files that are ours.
    pub ours: Vec<PathBuf>,
    /// Files, links and whole folders that are not.
    pub others: Vec<PathBuf>,
    /// Folders that hold ours, the outer ones first.
    folders: Vec<PathBuf>,
}

impl Owned {
    /// What is `stage`'s own in its `folder`, as the mark and the manifest in it say; `None` if
    /// neither is there and valid.
    pub fn of_stage(folder: &Path, stage: &str) -> Option<Self> {
        if !is_folder(folder) {
            return None;
        }
        let mark = Mark::read(folder).filter(|m| m.kind == Kind::Stage && m.stage == stage);
        let manifest = Manifest::read(folder, "").ok();
        let manifest = manifest.filter(|m| m.stage == stage);
        if mark.is_none() && manifest.is_none() {
            return None;
        }
        let mut files = mark.map(|m| m.files).unwrap_or_default();
        let listed = manifest.iter().flat_map(|m| &m.outputs);
        files.extend(listed.filter_map(|a| a.path.to_str().map(String::from)));
        files.push(manifest::FILE_NAME.into());
        Some(Self {
            files,
            stage: stage.into(),
            kind: Kind::Stage,
        })
    }

    fn covers(&self, name: &Path) -> bool {
        let name = slashed(name.to_str().unwrap_or_default(), MAIN_SEPARATOR);
        let covers = |pattern: &String| {
            let pattern = slashed(pattern, MAIN_SEPARATOR);
            pattern == name || fits(&pattern, &name)
        };
        name == FILE_NAME || self.files.iter().any(covers)
    }

    fn covers_folder(&self, name: &Path) -> bool {
        let mut files = self.files.iter().map(Path::new);
        files.any(|f| f != name && f.starts_with(name))
    }

    /// What in `folder` is ours and what is not.
    pub fn contents(&self, folder: &Path) -> Result<Contents, StageError> {
        let mut contents = Contents::default();
        self.collect(folder, Path::new(""), &mut contents)?;
        Ok(contents)
    }

    fn collect(&self, root: &Path, below: &Path, into: &mut Contents) -> Result<(), StageError> {
        let folder = root.join(below);
        let failed = |e| StageError::io("read", &folder, e);
        let entries: io::Result<Vec<_>> = fs::read_dir(&folder).map_err(failed)?.collect();
        let mut entries = entries.map_err(failed)?;
        entries.sort_by_key(fs::DirEntry::file_name);
        for entry in entries {
            // Of a link itself, not of what it points to.
            let kind = entry.file_type().map_err(failed)?;
            let name = below.join(entry.file_name());
            match () {
                () if kind.is_dir() && self.covers_folder(&name) => {
                    into.folders.push(name.clone());
                    self.collect(root, &name, into)?;
                }
                () if kind.is_file() && self.covers(&name) => into.ours.push(name),
                () => into.others.push(name),
            }
        }
        Ok(())
    }

    /// Removes from `folder` what is ours, and the folder if nothing else is in it. Otherwise its
    /// mark stays, so that a later run takes the folder for its own.
    pub fn remove(&self, folder: &Path) -> Result<(), StageError> {
        let Contents {
            ours,
            others,
            folders,
        } = self.contents(folder)?;
        // The list that marks the files as ours is removed last, so that it still names the rest after a kill.
        let (last, first): (Vec<_>, Vec<_>) = ours
            .into_iter()
            .partition(|name| is_named(name, FILE_NAME) || is_named(name, manifest::FILE_NAME));
        first
            .iter()
            .try_for_each(|name| remove_file(&folder.join(name)))?;
        for name in folders.iter().rev() {
            // One that holds something else stays.
            let _ = fs::remove_dir(folder.join(name));
        }
        let (mark, manifest): (Vec<_>, Vec<_>) =
            last.into_iter().partition(|name| is_named(name, FILE_NAME));
        manifest
            .iter()
            .try_for_each(|name| remove_file(&folder.join(name)))?;
        if others.is_empty() {
            mark.iter()
                .try_for_each(|name| remove_file(&folder.join(name)))?;
            return fs::remove_dir(folder).map_err(|e| StageError::io("remove", folder, e));
        }
        if Mark::read(folder).is_none() {
            mark.iter()
                .try_for_each(|name| remove_file(&folder.join(name)))?;
        }
        Mark::new(self.kind, &self.stage, Vec::new()).write(folder)
    }

    /// Moves what is not ours from `old` to the same place in `new`, then removes `old`. Where
    /// `new` has a file of that name already, the moved one is called `NAME.kept`.
    pub fn absorb(&self, old: &Path, new: &Path) -> Result<(), StageError> {
        for name in self.contents(old)?.others {
            let (from, to) = (old.join(&name), free_name(&new.join(&name)));
            if let Some(parent) = to.parent() {
                create_folder(parent)?;
            }
            fs::rename(&from, &to).map_err(|e| StageError::io("move", from, e))?;
        }
        self.remove(old)
    }
}

/// Whether nothing may be written there.
fn is_refused(error: &io::Error) -> bool {
    use io::ErrorKind::{PermissionDenied, ReadOnlyFilesystem};
    matches!(error.kind(), PermissionDenied | ReadOnlyFilesystem)
}

fn is_named(name: &Path, file: &str) -> bool {
    name == Path::new(file)
}

fn remove_file(path: &Path) -> Result<(), StageError> {
    fs::remove_file(path).map_err(|e| StageError::io("remove", path, e))
}

/// `path`, or `path.kept`, `path.kept-2`, … where something is there already.
fn free_name(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let named = |n: usize| match n {
        0 => path.to_owned(),
        1 => path.with_file_name(format!("{name}.kept")),
        n => path.with_file_name(format!("{name}.kept-{n}")),
    };
    let mut numbers = 0..;
    let free = |n: &usize| fs::symlink_metadata(named(*n)).is_err();
    named(numbers.find(free).unwrap_or_default())
}

/// The text of a path with `/` between its parts, as marks and manifests have them.
fn slashed(path: &str, separator: char) -> Cow<'_, str> {
    match separator == '/' || !path.contains(separator) {
        true => Cow::Borrowed(path),
        false => Cow::Owned(path.replace(separator, "/")),
    }
}

/// Whether `name` is `pattern` with digits for every `#`.
fn fits(pattern: &str, name: &str) -> bool {
    let Some((head, rest)) = pattern.split_once('#') else {
        return pattern == name;
    };
    name.strip_prefix(head).is_some_and(|tail| {
        let after = tail.trim_start_matches(|c: char| c.is_ascii_digit());
        after.len() < tail.len() && fits(rest, after)
    })
}

/// Whether a folder, and no link to one, is there.
pub(crate) fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_dir())
}

/// Whether nothing is in `folder`, or only a mark that a killed run had not yet written.
pub(crate) fn is_empty(folder: &Path) -> Result<bool, StageError> {
    if !is_folder(folder) {
        return Ok(false);
    }
    let failed = |e| StageError::io("read", folder, e);
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let begins = |length: usize| {
            let read = dipir_files::beginning(&entry.path(), length);
            read.ok().flatten().unwrap_or_else(|| b"?".into())
        };
        let is_void = name == FILE_NAME && begins(1).is_empty();
        let is_begun = dipir_files::is_partial_of(Path::new(FILE_NAME), &name)
            && HEAD.starts_with(&begins(HEAD.len()));
        if !(is_begun || is_void) {
            return Ok(false);
        }
    }
    Ok(true)
}

pub(crate) fn foreign(folder: &Path, why: Foreign) -> StageError {
    StageError::Foreign {
        folder: folder.into(),
        why,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_fit_a_number_and_nothing_else_does() {
        assert!(fits("previews/#.png", "previews/000015.png"));
        assert!(fits("#.partial.png", "3.partial.png"));
        assert!(fits("history.json", "history.json"));
        for name in [
            "previews/.png",
            "previews/mine.png",
            "previews/1.png.bak",
            "a1.png",
        ] {
            assert!(!fits("previews/#.png", name), "{name}");
        }
    }

    #[test]
    fn only_listed_files_are_removed_and_what_is_left_stays_known() {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join("cache");
        let mark = Mark::new(Kind::Cache, "concepts", vec!["#.png".into(), "a/#".into()]);
        mark.make(&folder).unwrap();
        fs::create_dir_all(folder.join("a")).unwrap();
        for name in ["1.png", "a/2", "a/mine", "holiday.png"] {
            fs::write(folder.join(name), "x").unwrap();
        }
        let contents = mark.owned().contents(&folder).unwrap();
        let named = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        assert_eq!(contents.ours, named(&[".dipir", "1.png", "a/2"]));
        assert_eq!(contents.others, named(&["a/mine", "holiday.png"]));
        mark.owned().remove(&folder).unwrap();
        assert!(folder.join("holiday.png").exists() && folder.join("a/mine").exists());
        assert!(!folder.join("1.png").exists() && !folder.join("a/2").exists());
        mark.make(&folder).unwrap();
        assert_eq!(Mark::read(&folder), Some(mark.clone()));
        fs::remove_file(folder.join("holiday.png")).unwrap();
        fs::remove_dir_all(folder.join("a")).unwrap();
        mark.owned().remove(&folder).unwrap();
        assert!(!folder.exists());
    }

    #[test]
    fn a_folder_whose_mark_was_begun_when_its_maker_was_killed_is_free() {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join("folder");
        let mark = Mark::new(Kind::Unfinished, "scene", Vec::new());
        let whole = serde_json::to_vec(&mark).unwrap();
        for (name, content) in [
            (".dipir", &b""[..]),
            ("..dipir.partial", b""),
            ("..dipir.partial", &whole[..9]),
            ("..dipir.partial", &whole),
            // Beside one that another process was writing.
            ("..dipir.4711-0.partial", &whole[..9]),
        ] {
            fs::create_dir(&folder).unwrap();
            fs::write(folder.join(name), content).unwrap();
            assert!(is_empty(&folder).unwrap(), "{name} {}", content.len());
            mark.make(&folder).unwrap();
            assert_eq!(Mark::read(&folder), Some(mark.clone()));
            assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "{name}");
            fs::remove_dir_all(&folder).unwrap();
        }
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("..dipir.partial"), "mine").unwrap();
        assert!(!is_empty(&folder).unwrap());
    }

    #[test]
    fn a_folder_with_something_in_it_and_no_mark_is_refused() {
        let out = tempfile::tempdir().unwrap();
        let mark = Mark::new(Kind::Cache, "concepts", vec!["#.png".into()]);
        mark.make(out.path()).unwrap();
        fs::remove_file(out.path().join(FILE_NAME)).unwrap();
        fs::write(out.path().join("1.png"), "mine").unwrap();
        mark.make(out.path()).unwrap_err();
        assert!(Mark::read(out.path()).is_none());
    }

    #[test]
    fn files_in_folders_are_ours_whatever_separates_names_of_the_system() {
        let name = slashed("previews\\000015.png", '\\');
        assert_eq!(name, "previews/000015.png");
        assert!(fits("previews/#.png", &name));
        // Elsewhere it is a letter of the name.
        assert_eq!(slashed("a\\b", '/'), "a\\b");
        let mark = Mark::new(Kind::Cache, "lora", vec!["samples/#.png".into()]);
        assert!(mark.owned().covers(&Path::new("samples").join("1.png")));
    }

    #[cfg(unix)]
    #[test]
    fn nothing_is_removed_through_a_link() {
        let out = tempfile::tempdir().unwrap();
        let (folder, mine) = (out.path().join("folder"), out.path().join("mine"));
        fs::create_dir(&mine).unwrap();
        fs::write(mine.join("1"), "x").unwrap();
        let mark = Mark::new(Kind::Cache, "concepts", vec!["a/#".into()]);
        mark.make(&folder).unwrap();
        std::os::unix::fs::symlink(&mine, folder.join("a")).unwrap();
        mark.owned().remove(&folder).unwrap();
        assert!(mine.join("1").exists() && folder.join("a").exists());
    }
}
