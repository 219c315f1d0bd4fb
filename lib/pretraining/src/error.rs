//! What can go wrong.

use std::path::{Path, PathBuf};

/// Failure of training or of measuring the small model.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be read or written.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// Which file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file does not hold what it should.
    #[error("{path}: {message}", path = path.display())]
    Content {
        /// Which file.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// A value is out of its range.
    #[error("{0}")]
    Argument(String),
    /// From the use of the small model.
    #[error(transparent)]
    Prior(#[from] dipir_prior::Error),
    /// From the diffusion model.
    #[error(transparent)]
    Diffusion(#[from] dipir_diffusion::Error),
    /// From a tensor operation.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
    /// From writing a picture.
    #[error(transparent)]
    Image(#[from] dipir_imaging::ImagingError),
}

/// Shorthand.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Turns an I/O error into [`Error::Io`].
pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io {
        action,
        path,
        source,
    }
}
