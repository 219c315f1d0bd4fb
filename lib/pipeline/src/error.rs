//! What can go wrong with configuration and with stage folders.
use std::fmt;
use std::io;
use std::path::PathBuf;

use crate::config::Place;

/// A `pipeline.toml`, or a `--set` that amends it, cannot be used as it stands.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read {}: {cause}; name another file with --pipeline", path.display())]
    Read {
        /// The file that was asked for.
        path: PathBuf,
        /// The operating system's reason.
        cause: String,
    },
    /// The text is not TOML.
    #[error("{at}: not valid TOML: {message}")]
    Syntax {
        /// Where.
        at: Place,
        /// The parser's finding.
        message: String,
    },
    /// A `--set` is not of the form `table.key=value`.
    #[error("--set {text}: {message}; write --set table.key=value, as in --set scene.class=car")]
    Override {
        /// What followed `--set`.
        text: String,
        /// What is wrong with it.
        message: String,
    },
    /// A key or table that nothing reads.
    #[error("{at}: unknown key \"{key}\"{}; {} accepts: {}", did_you_mean(nearest), table_name(table), accepted.join(", "))]
    UnknownKey {
        /// Where.
        at: Place,
        /// The whole dotted key.
        key: String,
        /// The dotted name of the table that it stands in; empty for the top level.
        table: String,
        /// Keys that the table knows.
        accepted: Vec<String>,
        /// The accepted key with the most similar spelling.
        nearest: Option<String>,
    },
    /// A key or table by the name that it had before.
    #[error("{at}: {old} is called {new} now")]
    Renamed {
        /// Where.
        at: Place,
        /// The dotted name that stands there.
        old: String,
        /// The dotted name that it has.
        new: String,
    },
    /// A value of the wrong type or out of its type's range.
    #[error("{at}: {key} is {found}, accepted: {accepted}")]
    WrongType {
        /// Where.
        at: Place,
        /// The whole dotted key.
        key: String,
        /// What stands there.
        found: String,
        /// What may stand there.
        accepted: String,
    },
    /// A string that is not one of the accepted ones.
    #[error(
        "{at}: {key} is \"{found}\"{}, accepted: {}",
        did_you_mean(nearest),
        quoted(accepted)
    )]
    UnknownChoice {
        /// Where.
        at: Place,
        /// The whole dotted key.
        key: String,
        /// What stands there.
        found: String,
        /// What may stand there.
        accepted: Vec<String>,
        /// The accepted value with the most similar spelling.
        nearest: Option<String>,
    },
    /// A key without a default is absent.
    #[error(
        "{at}: {} lacks the key \"{key}\"; add it there or pass --set {dotted}=VALUE",
        table_name(table)
    )]
    MissingKey {
        /// Where.
        at: Place,
        /// The dotted name of the table that lacks it.
        table: String,
        /// The key's own name.
        key: String,
        /// The whole dotted key.
        dotted: String,
    },
    /// A value that its reader refuses, for the reason given.
    #[error("{at}: {}", about(key, message))]
    Invalid {
        /// Where.
        at: Place,
        /// The whole dotted key.
        key: String,
        /// The reader's own words.
        message: String,
    },
}

/// A message, with the key in front unless it begins with that.
fn about(key: &str, message: &str) -> String {
    match message.starts_with(key) {
        true => message.into(),
        false => format!("{key}: {message}"),
    }
}

fn did_you_mean(nearest: &Option<String>) -> String {
    nearest
        .as_ref()
        .map_or_else(String::new, |name| format!(" (did you mean \"{name}\"?)"))
}

fn table_name(table: &str) -> String {
    if table.is_empty() {
        "the top level".into()
    } else {
        format!("[{table}]")
    }
}

fn quoted(values: &[String]) -> String {
    let quoted: Vec<_> = values.iter().map(|v| format!("\"{v}\"")).collect();
    quoted.join(", ")
}

/// A stage's folder cannot be read, locked or written.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// The file system refused.
    #[error("cannot {action} {}: {}{}", path.display(), plain(source), remedy(action, source))]
    Io {
        /// A verb, as in "write".
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The operating system's reason.
        source: io::Error,
    },
    /// Another process writes the same folder.
    #[error("{} is being written by {holder}; wait for it to end, pass --wait, or choose another folder with --out", folder.display())]
    Locked {
        /// The stage's folder.
        folder: PathBuf,
        /// Who holds the lock, in words.
        holder: String,
    },
    /// The target holds something that no stage wrote.
    #[error("{} is there already and {why}; move it away or choose another folder with --out", folder.display())]
    Foreign {
        /// The folder.
        folder: PathBuf,
        /// Why it is not ours.
        why: Foreign,
    },
    /// An earlier stage has not run.
    #[error("{} is missing: run {executable} first", path.display())]
    NotRun {
        /// The `stage.json` that was looked for.
        path: PathBuf,
        /// The executable that writes it.
        executable: String,
    },
    /// `stage.json` cannot be understood.
    #[error("{}: not a stage manifest: {message}; run the stage again", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Why not.
        message: String,
    },
    /// An output no longer has the bytes that its stage wrote.
    #[error("{}: {damage}; run the stage \"{stage}\" again", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The stage that wrote it.
        stage: String,
        /// What differs.
        damage: Damage,
    },
    /// A name that would leave the stage's folder.
    #[error("{}: an artifact's path must stay inside its stage's folder", path.display())]
    Escapes {
        /// The offending relative path.
        path: PathBuf,
    },
}

impl StageError {
    pub(crate) fn io(action: &'static str, path: impl Into<PathBuf>, source: io::Error) -> Self {
        Self::Io {
            action,
            path: path.into(),
            source,
        }
    }
}

/// Why a folder is not ours.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Foreign {
    /// Files, and no `stage.json` among them.
    #[error("holds no stage.json, so no stage wrote it and it is left alone")]
    NoManifest,
    /// A `stage.json` that is damaged, or that another stage or program wrote.
    #[error("holds a stage.json that the stage \"{stage}\" did not write, so it is left alone")]
    OtherManifest {
        /// The stage whose folder it would be.
        stage: String,
    },
    /// No mark of this program.
    #[error("holds no .dipir of this program, so it is left alone")]
    NoMark,
    /// A symbolic link.
    #[error("is a symbolic link, which no stage makes, so it is left alone")]
    Link,
}

/// How an artifact differs from what its manifest says.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(tag = "damage", rename_all = "snake_case")]
pub enum Damage {
    /// The file is gone.
    Missing,
    /// The file has another length.
    Length {
        /// Bytes when it was written.
        written: u64,
        /// Bytes now.
        found: u64,
    },
    /// Same length, other bytes.
    Content {
        /// Hash when it was written.
        written: String,
        /// Hash now.
        found: String,
    },
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing => write!(f, "the file is gone"),
            Self::Length { written, found } => {
                write!(f, "damaged: {found} bytes, but {written} were written")
            }
            Self::Content { written, found } => write!(
                f,
                "damaged: its BLAKE3 hash is {}…, but {}… was written",
                &found[..found.len().min(12)],
                &written[..written.len().min(12)]
            ),
        }
    }
}

/// The operating system's reason without Rust's "(os error 28)".
pub(crate) fn plain(error: &io::Error) -> String {
    let text = error.to_string();
    let end = text.find(" (os error").unwrap_or(text.len());
    let mut reason = text[..end].to_string();
    if let Some(first) = reason.get_mut(..1) {
        first.make_ascii_lowercase();
    }
    reason
}

/// On Windows: access is denied (5), or another program has a file open (32).
const IN_USE: [i32; 2] = [5, 32];

fn remedy(action: &str, error: &io::Error) -> &'static str {
    let is_in_use = || error.raw_os_error().is_some_and(|e| IN_USE.contains(&e));
    match error.kind() {
        io::ErrorKind::PermissionDenied if action == "read" => {
            "; it is there, but you may not read it: allow it, as with chmod u+r"
        }
        _ if action == "read" => "",
        // A folder is not renamed while a file in it is open.
        _ if cfg!(windows) && is_in_use() => {
            "; close the programs that show a file of it, or choose a folder that you may write with --out (earlier \
             results are untouched)"
        }
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "; free some space or choose another folder with --out (earlier results are untouched)"
        }
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            "; choose a folder that you may write with --out (earlier results are untouched)"
        }
        io::ErrorKind::FileTooLarge => {
            "; raise the limit on the size of files (ulimit -f; earlier results are untouched)"
        }
        io::ErrorKind::AlreadyExists => "; move it away or choose another folder with --out",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_read_is_not_answered_with_where_to_write() {
        let denied = || io::Error::from(io::ErrorKind::PermissionDenied);
        let told = |action| StageError::io(action, "a.png", denied()).to_string();
        assert_eq!(
            told("read"),
            "cannot read a.png: permission denied; it is there, but you may not read it: allow it, as with \
             chmod u+r"
        );
        assert!(told("write").contains("choose a folder that you may write with --out"));
    }
}
