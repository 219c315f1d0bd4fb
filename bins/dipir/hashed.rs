//! Hashes that a run hands to its stages, and how often it read files for them.
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use dipir_pipeline::hashing::Hashes;
use dipir_stages::names::ALL;
use serde_json::{Map, Value, json};

/// The file in which hashes are handed to a stage and back; removed when it is done.
pub fn hashes_file(out: &Path, stage: &str) -> PathBuf {
    out.join(format!(".{stage}.hashes"))
}

/// Removes the files of hashes that a killed run left in `out`. The caller holds the folder's lock.
pub fn remove_left(out: &Path) {
    for stage in ALL {
        // One that cannot be removed is replaced when its stage runs.
        let _ = Hashes::remove(&hashes_file(out, stage.name));
    }
}

/// How often each file was read to be hashed, up to a moment.
pub struct Reads(BTreeMap<PathBuf, u32>);

impl Reads {
    /// Up to now.
    pub fn until_now() -> Self {
        Self(Hashes::of_this_process().reads().clone())
    }

    /// The reads from then until now, by path, for programs.
    pub fn since(&self) -> Map<String, Value> {
        let Self(now) = Self::until_now();
        let since = now.into_iter().filter_map(|(path, times)| {
            let times = times - self.0.get(&path).copied().unwrap_or(0);
            (times > 0).then(|| (path.to_string_lossy().into_owned(), json!(times)))
        });
        since.collect()
    }
}
