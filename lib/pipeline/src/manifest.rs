//! `stage.json`: what a stage read, with which settings, and what it wrote.
//!
//! The file ends with a checksum of all that stands before it, so that damage of the manifest is
//! found as surely as damage of the files that it lists.
use std::collections::BTreeMap;
use std::fs;
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::{Damage, StageError, plain};
pub use crate::hashing::hash_file;

/// Version of the manifest's own layout.
pub const SCHEMA: u32 = 2;
/// The manifest's file name in a stage's folder.
pub const FILE_NAME: &str = "stage.json";

/// One file that a stage read or wrote.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Artifact {
    /// What it is to the stage, as in `background`; unique among the stage's inputs or outputs.
    pub role: String,
    /// Inputs: as named in the configuration. Outputs: relative to the stage's folder.
    pub path: PathBuf,
    /// Length.
    pub bytes: u64,
    /// Hash of the content, 64 hexadecimal digits.
    pub blake3: String,
}

impl Artifact {
    /// Hashes the file `location`, to be known as `path`.
    pub fn of(role: &str, path: &Path, location: &Path) -> Result<Self, StageError> {
        let (bytes, blake3) = hash_file(location)?;
        Ok(Self {
            role: role.into(),
            path: path.into(),
            bytes,
            blake3,
        })
    }

    /// How the file `location` differs from this entry, if it does.
    pub fn damage(&self, location: &Path) -> Result<Option<Damage>, StageError> {
        let (found, hash) = match hash_file(location) {
            Ok(found) => found,
            Err(StageError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                return Ok(Some(Damage::Missing));
            }
            Err(e) => return Err(e),
        };
        Ok(if found != self.bytes {
            Some(Damage::Length {
                written: self.bytes,
                found,
            })
        } else if hash != self.blake3 {
            Some(Damage::Content {
                written: self.blake3.clone(),
                found: hash,
            })
        } else {
            None
        })
    }
}

/// The content of `stage.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Layout of this file: [`SCHEMA`].
    pub schema: u32,
    /// Name of the stage, as in `scene`.
    pub stage: String,
    /// Version of the stage's code; raised whenever the same inputs give other outputs.
    pub version: u32,
    /// Settings, defaults filled in.
    pub params: serde_json::Value,
    /// Seed of every random number.
    pub seed: u64,
    /// What computed it, as in `cpu`.
    pub device: String,
    /// Files that were read.
    pub inputs: Vec<Artifact>,
    /// Files that were written, but this one.
    pub outputs: Vec<Artifact>,
    /// Wall time, seconds.
    pub elapsed_s: f64,
    /// Where the time went, if the stage says: seconds by the stage's own names. All that differs
    /// from run to run is kept in this file, so that outputs can be compared byte by byte.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub timings_s: BTreeMap<String, f64>,
    /// Largest resident memory of the process, where the operating system reports it.
    pub peak_rss_bytes: Option<u64>,
    /// The stage's own estimate of its error, in the unit that its documentation names.
    pub estimated_error: Option<f64>,
}

impl Manifest {
    /// Reads the manifest in a stage's `folder`; `executable` is named if it is not there.
    pub fn read(folder: &Path, executable: &str) -> Result<Self, StageError> {
        let path = folder.join(FILE_NAME);
        let bytes = match dipir_files::read(&path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                return Err(StageError::NotRun {
                    path,
                    executable: executable.into(),
                });
            }
            Err(e) => return Err(StageError::io("read", path, e)),
        };
        match String::from_utf8(bytes) {
            Ok(text) => Self::parse(&text, &path),
            Err(_) => Err(StageError::Manifest {
                path,
                message: "damaged: it is not text".into(),
            }),
        }
    }

    /// Reads a manifest from its text; `path` is for messages.
    pub fn parse(text: &str, path: &Path) -> Result<Self, StageError> {
        let wrong = |message: String| StageError::Manifest {
            path: path.into(),
            message,
        };
        check_sum(text).map_err(wrong)?;
        let manifest: Self = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
        if manifest.schema != SCHEMA {
            return Err(wrong(format!(
                "schema {} is not the {SCHEMA} that this version reads",
                manifest.schema
            )));
        }
        for artifact in &manifest.outputs {
            check_inside(&artifact.path)?;
        }
        Ok(manifest)
    }

    /// The file's text, its checksum last.
    pub fn to_text(&self) -> serde_json::Result<String> {
        let text = serde_json::to_string_pretty(self)?;
        let body = text.strip_suffix("\n}").unwrap_or(&text);
        let hash = blake3::hash(body.as_bytes()).to_hex();
        Ok(format!("{body}{CHECKSUM}{hash}{END}"))
    }

    /// Every output that no longer has the bytes that were written.
    pub fn damages(&self, folder: &Path) -> Result<Vec<(PathBuf, Damage)>, StageError> {
        let mut damages = Vec::new();
        for artifact in &self.outputs {
            let location = folder.join(&artifact.path);
            if let Some(damage) = artifact.damage(&location)? {
                damages.push((location, damage));
            }
        }
        Ok(damages)
    }

    /// The entry of the output with the given role; `folder` is for the message without one.
    pub fn artifact(&self, role: &str, folder: &Path) -> Result<&Artifact, StageError> {
        let listed = self.outputs.iter().find(|a| a.role == role);
        listed.ok_or_else(|| StageError::Manifest {
            path: folder.join(FILE_NAME),
            message: format!("it lists no output \"{role}\""),
        })
    }

    /// The output with the given role, checked against its hash.
    pub fn output(&self, folder: &Path, role: &str) -> Result<PathBuf, StageError> {
        let artifact = self.artifact(role, folder)?;
        let path = folder.join(&artifact.path);
        match artifact.damage(&path)? {
            None => Ok(path),
            Some(damage) => Err(StageError::Damaged {
                path,
                stage: self.stage.clone(),
                damage,
            }),
        }
    }
}

/// What stands between the body of the file and its checksum.
const CHECKSUM: &str = ",\n  \"checksum\": \"";
/// What stands behind the checksum.
const END: &str = "\"\n}\n";

fn check_sum(text: &str) -> Result<(), String> {
    let written = text
        .strip_suffix(END)
        .and_then(|t| t.rsplit_once(CHECKSUM))
        .ok_or("damaged: it does not end with its checksum")?;
    let (body, written) = written;
    let found = blake3::hash(body.as_bytes()).to_hex();
    match found.as_str() == written {
        true => Ok(()),
        false => Err("damaged: its checksum does not fit its content".into()),
    }
}

/// Refuses paths that leave the folder that they are relative to.
pub(crate) fn check_inside(path: &Path) -> Result<(), StageError> {
    let inside = path.components().all(|c| matches!(c, Component::Normal(_)));
    if inside && path.components().next().is_some() {
        Ok(())
    } else {
        Err(StageError::Escapes { path: path.into() })
    }
}

/// The process's largest resident memory so far, where the operating system tells.
pub fn peak_rss_bytes() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}

/// For messages about files that other crates read: the operating system's reason alone.
pub fn plain_reason(error: &std::io::Error) -> String {
    plain(error)
}
