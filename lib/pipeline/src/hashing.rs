//! Hashes of files, each taken once.
//!
//! Within a process, and from a run to the stages that it starts, a file's hash is known by the
//! file's identity: device, inode, length, and the times of its last change. Any change of its
//! bytes changes one of them, unless it follows the last within one tick of the file system's
//! clock. So a file that changed that recently is hashed each time. Nothing is remembered beyond a
//! run.
use std::collections::{BTreeMap, HashMap};
use std::fs::{File, Metadata};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::error::StageError;

/// Bytes that are hashed at a time, on all threads; smaller files need not wake them.
const PIECE: usize = 4 << 20;
/// How files of hashes begin.
const HEAD: &[u8] = b"{\"dipir_hashes\":1,";

/// What identifies the bytes of a file without reading them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
struct Identity {
    device: u64,
    inode: u64,
    bytes: u64,
    modified_ns: i128,
    changed_ns: i128,
}

impl Identity {
    #[cfg(unix)]
    fn of(found: &Metadata) -> Option<Self> {
        use std::os::unix::fs::MetadataExt;
        let ns = |s: i64, ns: i64| i128::from(s) * 1_000_000_000 + i128::from(ns);
        Some(Self {
            device: found.dev(),
            inode: found.ino(),
            bytes: found.len(),
            modified_ns: ns(found.mtime(), found.mtime_nsec()),
            changed_ns: ns(found.ctime(), found.ctime_nsec()),
        })
    }

    /// Elsewhere nothing identifies a changed file for certain.
    #[cfg(not(unix))]
    fn of(_: &Metadata) -> Option<Self> {
        None
    }

    /// Whether a change from now on would show in the times.
    fn is_settled(&self, now: SystemTime) -> bool {
        // A tick is 10 ms at most on systems with fine clocks, 2 s on FAT.
        let tick_ns: i128 = match self.changed_ns % 1_000_000_000 {
            0 => 2_000_000_000,
            _ => 50_000_000,
        };
        let now = now.duration_since(SystemTime::UNIX_EPOCH);
        let now = now.map_or(0, |d| d.as_nanos() as i128);
        now - self.changed_ns.max(self.modified_ns) > tick_ns
    }
}

/// Hashes that are known, and how often each file was read for one.
#[derive(Clone, Debug, Default)]
pub struct Hashes {
    known: HashMap<Identity, String>,
    read: BTreeMap<PathBuf, u32>,
}

static OF_THIS_PROCESS: LazyLock<Mutex<Hashes>> = LazyLock::new(Mutex::default);

fn shared() -> MutexGuard<'static, Hashes> {
    let poisoned = PoisonError::into_inner;
    OF_THIS_PROCESS.lock().unwrap_or_else(poisoned)
}

/// The file in which a run hands hashes to a stage and takes them back.
#[derive(Serialize, Deserialize)]
struct HandOver {
    dipir_hashes: u32,
    known: Vec<(Identity, String)>,
    read: Vec<(PathBuf, u32)>,
}

impl Hashes {
    /// Those that this process knows.
    pub fn of_this_process() -> Self {
        shared().clone()
    }

    /// The same without the count of reads: to be handed to another process.
    pub fn to_hand_over() -> Self {
        Self {
            read: BTreeMap::new(),
            ..shared().clone()
        }
    }

    /// Adds these, and the reads that they took, to those of this process.
    pub fn adopt(self) {
        let mut shared = shared();
        shared.known.extend(self.known);
        for (path, times) in self.read {
            *shared.read.entry(path).or_default() += times;
        }
    }

    /// How often each file was read to be hashed.
    pub fn reads(&self) -> &BTreeMap<PathBuf, u32> {
        &self.read
    }

    /// Writes them to `path`, over an earlier such file and over no other.
    pub fn write(self, path: &Path) -> Result<(), StageError> {
        let failed = |e| StageError::io("write", path, e);
        let content = HandOver {
            dipir_hashes: 1,
            known: self.known.into_iter().collect(),
            read: self.read.into_iter().collect(),
        };
        let text = serde_json::to_vec(&content).map_err(|e| failed(e.into()))?;
        dipir_files::replace(path, &text, HEAD).map_err(failed)
    }

    /// Reads what [`write`](Self::write) wrote; nothing is known where that fails.
    pub fn read(path: &Path) -> Self {
        let content = dipir_files::read(path).ok();
        let content = content.and_then(|text| serde_json::from_slice::<HandOver>(&text).ok());
        content.map_or_else(Self::default, |content| Self {
            known: content.known.into_iter().collect(),
            read: content.read.into_iter().collect(),
        })
    }

    /// Removes the file `path` if [`write`](Self::write) wrote it; whether it did.
    pub fn remove(path: &Path) -> Result<bool, StageError> {
        let failed = |e| StageError::io("remove", path, e);
        // What is not a regular file is none of ours.
        let is_ours = dipir_files::begins_with(path, HEAD).unwrap_or(false);
        if is_ours {
            std::fs::remove_file(path).map_err(failed)?;
        }
        Ok(is_ours)
    }

    /// Whether `path` is a file that [`write`](Self::write) wrote.
    pub fn are_in(path: &Path) -> bool {
        dipir_files::begins_with(path, HEAD).unwrap_or(false)
    }

    /// What a killed [`write`](Self::write) to `path` left beside it.
    pub fn left_of_writing(path: &Path) -> Option<PathBuf> {
        dipir_files::left_of_replacing(path, HEAD)
    }
}

/// Length and BLAKE3 hash of a regular file. One that was hashed before and has not changed since
/// is not read again.
pub fn hash_file(path: &Path) -> Result<(u64, String), StageError> {
    hash_at(path, SystemTime::now())
}

fn hash_at(path: &Path, now: SystemTime) -> Result<(u64, String), StageError> {
    let failed = |e| StageError::io("read", path, e);
    let mut file = dipir_files::open(path).map_err(failed)?;
    let before = Identity::of(&file.metadata().map_err(failed)?);
    if let Some(known) = before.and_then(|id| shared().known.get(&id).cloned()) {
        return Ok((before.map_or(0, |id| id.bytes), known));
    }
    let before = before.filter(|id| id.is_settled(now));
    let (bytes, hash) = hash(&mut file).map_err(failed)?;
    let after = Identity::of(&file.metadata().map_err(failed)?);
    let mut shared = shared();
    *shared.read.entry(path.into()).or_default() += 1;
    if let Some(id) = before.filter(|id| Some(*id) == after && id.bytes == bytes) {
        shared.known.insert(id, hash.clone());
    }
    Ok((bytes, hash))
}

fn hash(file: &mut File) -> std::io::Result<(u64, String)> {
    let length = file.metadata()?.len();
    let mut buffer = vec![
        0;
        PIECE
            .min(usize::try_from(length).unwrap_or(PIECE))
            .max(4096)
    ];
    let mut hasher = blake3::Hasher::new();
    let mut bytes = 0;
    loop {
        let filled = fill(file, &mut buffer)?;
        match filled == PIECE {
            true => hasher.update_rayon(&buffer),
            false => hasher.update(&buffer[..filled]),
        };
        bytes += filled as u64;
        if filled < buffer.len() {
            return Ok((bytes, hasher.finalize().to_hex().to_string()));
        }
    }
}

/// Reads until the buffer is full or the file ends.
fn fill(file: &mut File, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match file.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

#[cfg(test)]
mod tests {
    use std::fs;
    #[cfg(unix)]
    use std::time::Duration;

    use super::*;

    /// The hash, taken when the file is not young any more.
    #[cfg(unix)]
    fn hash_later(path: &Path) -> (u64, String) {
        hash_at(path, SystemTime::now() + Duration::from_secs(3)).unwrap()
    }

    fn reads_of(path: &Path) -> u32 {
        let all = Hashes::of_this_process();
        all.reads().get(path).copied().unwrap_or(0)
    }

    #[test]
    fn hashes_are_those_of_the_whole_content_whatever_the_length() {
        let folder = tempfile::tempdir().unwrap();
        for length in [
            0,
            1,
            4095,
            4096,
            4097,
            PIECE - 1,
            PIECE,
            PIECE + 1,
            2 * PIECE + 7,
        ] {
            let content: Vec<u8> = (0..length).map(|k| (k % 251) as u8).collect();
            let path = folder.path().join(length.to_string());
            fs::write(&path, &content).unwrap();
            let expected = blake3::hash(&content).to_hex().to_string();
            assert_eq!(hash_file(&path).unwrap(), (length as u64, expected));
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_file_is_read_once_until_it_changes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, "one").unwrap();
        let first = hash_later(&path);
        assert_eq!(hash_later(&path), first);
        assert_eq!(reads_of(&path), 1);
        // The same length, and the time of its last modification set back.
        let found = || fs::metadata(&path).unwrap();
        let (time, was) = (found().modified().unwrap(), Identity::of(&found()));
        // Until a tick of the file system's clock shows it.
        while Identity::of(&found()) == was {
            fs::write(&path, "two").unwrap();
            let file = File::options().write(true).open(&path).unwrap();
            file.set_modified(time).unwrap();
        }
        assert_ne!(hash_later(&path), first);
        assert_eq!(reads_of(&path), 2);
    }

    #[cfg(unix)]
    #[test]
    fn a_young_file_is_hashed_anew_each_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        for n in 0..200 {
            fs::write(&path, format!("{n:03}")).unwrap();
            let expected = blake3::hash(format!("{n:03}").as_bytes());
            assert_eq!(hash_file(&path).unwrap().1, expected.to_hex().as_str());
        }
    }

    #[cfg(unix)]
    #[test]
    fn another_process_takes_over_what_is_known() {
        let folder = tempfile::tempdir().unwrap();
        let (path, handed) = (folder.path().join("a"), folder.path().join("hashes"));
        fs::write(&path, "one").unwrap();
        let (_, hash) = hash_later(&path);
        Hashes::to_hand_over().write(&handed).unwrap();
        let read = Hashes::read(&handed);
        assert!(read.reads().is_empty());
        assert!(read.known.values().any(|h| *h == hash));
        assert!(Hashes::remove(&handed).unwrap() && !handed.exists());
        fs::write(&handed, "mine").unwrap();
        assert!(!Hashes::remove(&handed).unwrap() && handed.exists());
        Hashes::to_hand_over().write(&handed).unwrap_err();
    }
}
