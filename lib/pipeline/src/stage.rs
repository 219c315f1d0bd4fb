//! A stage's output folder: all of it, or nothing.
//!
//! A stage writes into `.NAME.partial` beside its target under a lock. When it is done, its files
//! are flushed to disk, `stage.json` is written last, and the two folders change places in one
//! step. Killed at any instant, the target holds either the earlier result or the new one. What
//! others put beside the earlier result moves into the new folder.
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::error::{Foreign, StageError};
use crate::lock::{FolderLock, WhenLocked, create_folder, sibling};
use crate::manifest::{Artifact, FILE_NAME, Manifest, SCHEMA, check_inside, peak_rss_bytes};
use crate::mark::{self, Kind, Mark, Owned, foreign, is_empty, is_folder};

/// What begins the role of a file that a run looked for in vain. Another content than that of [`StagePlan::missing`] means
/// that it is there now.
pub const MISSING: &str = "missing ";

/// What identifies a run of a stage, before it has run.
#[derive(Clone, Debug)]
pub struct StagePlan {
    /// Name of the stage, as in `scene`.
    pub stage: String,
    /// Version of the stage's code.
    pub version: u32,
    /// Settings, defaults filled in.
    pub params: serde_json::Value,
    /// Makes settings that were recorded, by an earlier version, too, such as are compared with these.
    pub comparable: fn(serde_json::Value) -> serde_json::Value,
    /// Seed of every random number.
    pub seed: u64,
    /// What computes it, as in `cpu`.
    pub device: String,
    /// Files that are read, hashed.
    pub inputs: Vec<Artifact>,
}

impl StagePlan {
    /// A plan without inputs on the CPU.
    pub fn new(stage: &str, version: u32, params: serde_json::Value, seed: u64) -> Self {
        Self {
            stage: stage.into(),
            version,
            params,
            comparable: |params| params,
            seed,
            device: "cpu".into(),
            inputs: Vec::new(),
        }
    }

    /// Adds the file `location`, which the configuration calls `path`. Further files of one role
    /// are numbered: `object`, `object 2`.
    pub fn input(&mut self, role: &str, path: &Path, location: &Path) -> Result<(), StageError> {
        let artifact = Artifact::of(&self.free_role(role), path, location)?;
        self.inputs.push(artifact);
        Ok(())
    }

    /// Adds a file that was looked for at `path` and could not be opened, by a role that begins with [`MISSING`].
    pub fn missing(&mut self, role: &str, path: &Path) {
        self.inputs.push(Artifact {
            role: self.free_role(&format!("{MISSING}{role}")),
            path: path.into(),
            bytes: 0,
            // Not that of an empty file, which may be there later.
            blake3: blake3::hash(b"missing").to_hex().to_string(),
        });
    }

    /// As [`StagePlan::input`], for what is no file: `content`, to be known as `path`.
    pub fn input_of_bytes(&mut self, role: &str, path: &Path, content: &[u8]) {
        self.inputs.push(Artifact {
            role: self.free_role(role),
            path: path.into(),
            bytes: content.len() as u64,
            blake3: blake3::hash(content).to_hex().to_string(),
        });
    }

    /// The role itself, or it with the number behind that of the last file of this role. Looked for from the end: files of a
    /// role mostly follow one another.
    fn free_role(&self, role: &str) -> String {
        let number = |a: &Artifact| match a.role.strip_prefix(role)? {
            "" => Some(1),
            behind => behind.strip_prefix(' ')?.parse::<usize>().ok(),
        };
        match self.inputs.iter().rev().find_map(number) {
            Some(last) => format!("{role} {}", last.saturating_add(1)),
            None => role.to_string(),
        }
    }

    /// Adds outputs of an earlier stage by their roles, known by `STAGE/file`, with the hashes
    /// that its manifest states. Whoever reads them checks them with [`Manifest::output`].
    pub fn outputs_of(&mut self, earlier: &Manifest, roles: &[&str]) -> Result<(), StageError> {
        for role in roles {
            let output = earlier.artifact(role, Path::new(&earlier.stage))?;
            self.inputs.push(Artifact {
                path: Path::new(&earlier.stage).join(&output.path),
                ..output.clone()
            });
        }
        Ok(())
    }
}

/// An output folder being written. Dropped unfinished, it leaves nothing behind.
#[derive(Debug)]
pub struct StageWriter {
    target: PathBuf,
    partial: PathBuf,
    plan: StagePlan,
    outputs: Vec<(String, PathBuf)>,
    estimated_error: Option<f64>,
    timings_s: BTreeMap<String, f64>,
    started: Instant,
    finished: bool,
    _lock: FolderLock,
}

impl StageWriter {
    /// Locks `target` and opens an empty folder beside it.
    pub fn begin(
        target: &Path,
        plan: StagePlan,
        when_locked: WhenLocked,
    ) -> Result<Self, StageError> {
        let started = Instant::now();
        if let Some(parent) = target.parent().filter(|p| !p.as_os_str().is_empty()) {
            create_folder(parent)?;
        }
        let lock = FolderLock::take(target, when_locked)?;
        tidy(target, &plan.stage)?;
        refuse_foreign(target, &plan.stage)?;
        let partial = sibling(target, "partial");
        Mark::new(Kind::Unfinished, &plan.stage, Vec::new()).make(&partial)?;
        Ok(Self {
            target: target.into(),
            partial,
            plan,
            outputs: Vec::new(),
            estimated_error: None,
            timings_s: BTreeMap::new(),
            started,
            finished: false,
            _lock: lock,
        })
    }

    /// The folder that is written to; whoever ends the process on purpose should call [`discard`]
    /// with it.
    pub fn partial(&self) -> &Path {
        &self.partial
    }

    /// Registers the output `name` (relative, `/` allowed) and returns where to write it.
    pub fn output(&mut self, role: &str, name: impl AsRef<Path>) -> Result<PathBuf, StageError> {
        let name = name.as_ref();
        check_inside(name)?;
        let path = self.partial.join(name);
        // Made again, the folder would not bear the mark that it is ours.
        if !is_folder(&self.partial) {
            let why = "it was removed while the stage ran; run again";
            let source = io::Error::new(io::ErrorKind::NotFound, why);
            return Err(StageError::io("write", &self.partial, source));
        }
        if let Some(parent) = path.parent().filter(|p| *p != self.partial) {
            create_folder(parent)?;
        }
        self.outputs.push((role.into(), name.into()));
        Ok(path)
    }

    /// Writes `value` as indented JSON with a final newline.
    pub fn write_json(
        &mut self,
        role: &str,
        name: &str,
        value: &impl serde::Serialize,
    ) -> Result<(), StageError> {
        let path = self.output(role, name)?;
        write_json(&path, value)
    }

    /// What `stage.json` will say of the stage's error.
    pub fn set_estimated_error(&mut self, error: f64) {
        self.estimated_error = Some(error);
    }

    /// How long a part of the work took, for `stage.json`.
    pub fn set_timing(&mut self, name: &str, seconds: f64) {
        self.timings_s.insert(name.into(), seconds);
    }

    /// Counts what went before [`begin`](Self::begin), too: reading what the stage reads.
    pub fn add_time(&mut self, before: Duration) {
        self.started = self.started.checked_sub(before).unwrap_or(self.started);
    }

    /// Seconds since [`begin`](Self::begin), and those of [`add_time`](Self::add_time).
    pub fn elapsed_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Writes `stage.json`, flushes everything and swaps the folder in.
    pub fn finish(self) -> Result<Manifest, StageError> {
        self.finish_and(|| {})
    }

    /// As [`finish`](Self::finish), and then `tidy_up`, before another run may begin: that run would go on from what is being
    /// removed.
    pub fn finish_and(mut self, tidy_up: impl FnOnce()) -> Result<Manifest, StageError> {
        let mut outputs = Vec::with_capacity(self.outputs.len());
        for (role, name) in &self.outputs {
            let path = self.partial.join(name);
            flush(&path)?;
            outputs.push(Artifact::of(role, name, &path)?);
        }
        let plan = self.plan.clone();
        let manifest = Manifest {
            schema: SCHEMA,
            stage: plan.stage,
            version: plan.version,
            params: plan.params,
            seed: plan.seed,
            device: plan.device,
            inputs: plan.inputs,
            outputs,
            elapsed_s: self.elapsed_s(),
            timings_s: self.timings_s.clone(),
            peak_rss_bytes: peak_rss_bytes(),
            estimated_error: self.estimated_error,
        };
        let path = self.partial.join(FILE_NAME);
        let text = manifest.to_text();
        let text = text.map_err(|e| StageError::io("write", &path, e.into()))?;
        fs::write(&path, text).map_err(|e| StageError::io("write", &path, e))?;
        flush(&path)?;
        let listed = self.outputs.iter().map(|(_, name)| name);
        let listed = listed.map(|name| name.to_string_lossy().into_owned());
        Mark::new(Kind::Stage, &manifest.stage, listed.collect()).write(&self.partial)?;
        self.flush_folders()?;
        {
            let _no_discard = UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner);
            swap(&self.partial, &self.target)?;
            self.finished = true;
            // The result stands; what cannot be tidied up now is at the next run.
            let _ = tidy(&self.target, &manifest.stage);
        }
        if let Some(parent) = self.target.parent().filter(|p| !p.as_os_str().is_empty()) {
            sync_folder(parent)?;
        }
        tidy_up();
        Ok(manifest)
    }

    /// Flushes the names of the outputs.
    fn flush_folders(&self) -> Result<(), StageError> {
        let outputs = self.outputs.iter().map(|(_, name)| self.partial.join(name));
        let folders = outputs.filter_map(|path| path.parent().map(PathBuf::from));
        let folders: BTreeSet<PathBuf> = folders.chain([self.partial.clone()]).collect();
        folders.iter().try_for_each(|folder| sync_folder(folder))
    }
}

impl Drop for StageWriter {
    fn drop(&mut self) {
        if !self.finished {
            discard(&self.partial);
        }
    }
}

/// Held while a folder is swapped in or discarded: after the swap, what was the unfinished folder
/// is the earlier result, with whatever others put there.
static UNFINISHED: Mutex<()> = Mutex::new(());

/// Removes the folder that a [`StageWriter`] of this process has not finished.
pub fn discard(partial: &Path) {
    let _no_swap = UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner);
    if is_unfinished(partial) || is_empty(partial).unwrap_or(false) {
        let _ = remove_unfinished(partial);
    }
}

/// Removes an unfinished folder. What a kill leaves of it bears its mark or is empty.
fn remove_unfinished(partial: &Path) -> io::Result<()> {
    let mark = Mark::read(partial);
    for path in mark_last(partial)? {
        match is_folder(&path) {
            true => fs::remove_dir_all(&path)?,
            false => fs::remove_file(&path)?,
        }
    }
    // A thread of this process may have written there meanwhile.
    fs::remove_dir(partial).inspect_err(|_| {
        if let Some(mark) = mark {
            let _ = mark.write(partial);
        }
    })
}

/// What is in an unfinished folder, its mark last.
fn mark_last(partial: &Path) -> io::Result<Vec<PathBuf>> {
    let entries: io::Result<Vec<_>> = fs::read_dir(partial)?.collect();
    let mut paths: Vec<PathBuf> = entries?.iter().map(fs::DirEntry::path).collect();
    paths.sort_by_key(|path| path.ends_with(mark::FILE_NAME));
    Ok(paths)
}

fn is_unfinished(folder: &Path) -> bool {
    Mark::read(folder).is_some_and(|m| m.kind == Kind::Unfinished)
}

/// Clears up beside the folder `target` of `stage` what a run that was killed left there. Its lock
/// must be held.
pub fn tidy(target: &Path, stage: &str) -> Result<(), StageError> {
    recover(target, stage)?;
    let partial = sibling(target, "partial");
    if fs::symlink_metadata(&partial).is_err() {
        return Ok(());
    }
    if is_unfinished(&partial) || is_empty(&partial)? {
        return remove_unfinished(&partial).map_err(|e| StageError::io("remove", &partial, e));
    }
    match Owned::of_stage(&partial, stage) {
        // An earlier result that has been replaced.
        Some(owned) if is_folder(target) => owned.absorb(&partial, target),
        // A result that a kill kept from its place, or an earlier one, with what others put beside it.
        Some(_) if fs::symlink_metadata(target).is_err() => {
            fs::rename(&partial, target).map_err(|e| StageError::io("restore", target, e))
        }
        // Whoever writes there refuses what is at the target.
        Some(_) => Ok(()),
        None => Err(foreign(&partial, Foreign::NoMark)),
    }
}

/// What [`tidy`] would clear up.
pub fn untidy(target: &Path, stage: &str) -> Vec<PathBuf> {
    let [partial, previous] = ["partial", "previous"].map(|suffix| sibling(target, suffix));
    let is_owned = |path: &Path| Owned::of_stage(path, stage).is_some();
    let is_begun = |path: &Path| is_unfinished(path) || is_empty(path).unwrap_or(false);
    let mut found = Vec::new();
    if is_begun(&partial) || is_owned(&partial) {
        found.push(partial);
    }
    if is_owned(&previous) {
        found.push(previous);
    }
    found
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), StageError> {
    let failed = |e| StageError::io("write", path, e);
    let mut text = serde_json::to_vec_pretty(value).map_err(|e| failed(e.into()))?;
    text.push(b'\n');
    let mut file = File::create(path).map_err(failed)?;
    file.write_all(&text).map_err(failed)
}

fn flush(path: &Path) -> Result<(), StageError> {
    dipir_files::sync_file(path).map_err(|e| StageError::io("write", path, e))
}

fn sync_folder(folder: &Path) -> Result<(), StageError> {
    dipir_files::sync_folder(folder).map_err(|e| StageError::io("write", folder, e))
}

/// A crash between the two renames of [`swap`]'s slow way leaves the earlier result here.
fn recover(target: &Path, stage: &str) -> Result<(), StageError> {
    let previous = sibling(target, "previous");
    match Owned::of_stage(&previous, stage) {
        None => Ok(()),
        Some(owned) if is_folder(target) => owned.absorb(&previous, target),
        Some(_) => fs::rename(&previous, target).map_err(|e| StageError::io("restore", target, e)),
    }
}

/// Refuses a target that is there and that `stage` did not make.
pub fn refuse_foreign(target: &Path, stage: &str) -> Result<(), StageError> {
    let found = match fs::symlink_metadata(target) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(StageError::io("read", target, e)),
        Ok(found) => found.file_type(),
    };
    if found.is_dir() && (is_empty(target)? || Owned::of_stage(target, stage).is_some()) {
        return Ok(());
    }
    let has_manifest = fs::symlink_metadata(target.join(FILE_NAME)).is_ok();
    let why = match () {
        () if found.is_symlink() => Foreign::Link,
        () if has_manifest => Foreign::OtherManifest {
            stage: stage.into(),
        },
        () => Foreign::NoManifest,
    };
    Err(foreign(target, why))
}

/// Puts `partial` in `target`'s place; what was there before, if anything, ends up in `partial`.
fn swap(partial: &Path, target: &Path) -> Result<(), StageError> {
    let failed = |e| StageError::io("write", target, e);
    if fs::symlink_metadata(target).is_err() {
        return fs::rename(partial, target).map_err(failed);
    }
    #[cfg(any(target_os = "linux", target_vendor = "apple"))]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        use rustix::io::Errno;
        match renameat_with(CWD, partial, CWD, target, RenameFlags::EXCHANGE) {
            Ok(()) => return Ok(()),
            // Not every file system can exchange two names.
            Err(Errno::INVAL | Errno::NOSYS | Errno::NOTSUP) => {}
            Err(e) => return Err(failed(e.into())),
        }
    }
    swap_in_two_steps(partial, target)
}

fn swap_in_two_steps(partial: &Path, target: &Path) -> Result<(), StageError> {
    let failed = |e| StageError::io("write", target, e);
    let previous = sibling(target, "previous");
    fs::rename(target, &previous).map_err(failed)?;
    fs::rename(partial, target).map_err(|e| {
        // Where this fails, too, the next run does it.
        let _ = fs::rename(&previous, target);
        failed(e)
    })
}

#[cfg(test)]
mod tests;
