//! What can go wrong on the way to a model.

use std::path::{Path, PathBuf};

/// Results of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Every message says what failed and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// What was given cannot be the name of a repository or a revision.
    #[error("{what} {value:?} is not one; accepted: {accepted}")]
    Name {
        /// `repository`, `revision` or `endpoint`.
        what: &'static str,
        /// As given.
        value: String,
        /// In words.
        accepted: &'static str,
    },
    /// The hub answered with an error.
    #[error("{url}: the hub answers {status}: {remedy}")]
    Status {
        /// What was asked for.
        url: String,
        /// HTTP status code.
        status: u16,
        /// What to do.
        remedy: String,
    },
    /// The hub did not answer, or its answer broke off.
    #[error(
        "{url}: {source}; check the network and the endpoint, then run again: it goes on where it stopped"
    )]
    Network {
        /// What was asked for.
        url: String,
        /// The client's error.
        source: Box<ureq::Error>,
    },
    /// The connection ended before the file did.
    #[error(
        "{url}: the answer broke off after {found} of {wanted} bytes; run again: it goes on where it stopped"
    )]
    Truncated {
        /// What was asked for.
        url: String,
        /// Bytes of the file that are there.
        found: u64,
        /// Bytes of the file.
        wanted: u64,
    },
    /// The hub's answer is not what its protocol says.
    #[error("{url}: {message}; is this a hub that speaks Hugging Face's protocol?")]
    Protocol {
        /// What was asked for.
        url: String,
        /// What is wrong.
        message: String,
    },
    /// The repository holds no model that can be used.
    #[error("{repo} is no model in the diffusers layout:\n  {}", problems.join("\n  "))]
    Layout {
        /// The repository.
        repo: String,
        /// One line for each part that is missing.
        problems: Vec<String>,
    },
    /// A file's bytes are not those that the hub's hash was taken of.
    #[error(
        "{path}: its {kind} is {found}, the hub says {wanted}; the copy was removed, run again"
    )]
    Hash {
        /// Name in the repository.
        path: String,
        /// `size`, `SHA-256` or `git hash`.
        kind: &'static str,
        /// Of the received bytes, hexadecimal.
        found: String,
        /// Of the hub.
        wanted: String,
    },
    /// A file that was whole has changed since.
    #[error("{path}: its {kind} is {found}, the hub says {wanted}; remove the folder and fetch it again", path = path.display())]
    Damaged {
        /// Where.
        path: PathBuf,
        /// `size`, `SHA-256` or `git hash`.
        kind: &'static str,
        /// Found, hexadecimal where it is a hash.
        found: String,
        /// Of the hub.
        wanted: String,
    },
    /// The folder that is received into holds something else.
    #[error("{path} is there and dipir-model did not begin it; move it away or name another folder with --to", path = path.display())]
    Foreign {
        /// The folder.
        path: PathBuf,
    },
    /// Reading or writing failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// `read`, `write` or `remove`.
        action: &'static str,
        /// Where.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The progress callback asked to stop.
    #[error("interrupted; what was fetched is kept, run again to go on")]
    Interrupted,
}

/// Makes an [`Error::Io`].
pub(crate) fn io<'a>(
    action: &'static str,
    path: &'a Path,
) -> impl FnOnce(std::io::Error) -> Error + use<'a> {
    move |source| Error::Io {
        action,
        path: path.to_owned(),
        source,
    }
}
