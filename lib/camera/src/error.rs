//! What can be wrong with a camera's file.
use std::borrow::Cow;
use std::path::PathBuf;

/// A file of cameras that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The file cannot be read.
    #[error("cannot read the camera file \"{path}\"", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The contents are not what the format promises.
    #[error("the {format} file cannot be used: {detail}; {remedy}")]
    Malformed {
        /// Name of the format.
        format: &'static str,
        /// What is wrong, and where.
        detail: String,
        /// What to do.
        remedy: Cow<'static, str>,
    },
}

impl CameraError {
    pub(crate) fn new(format: &'static str, detail: impl Into<String>) -> Self {
        Self::Malformed {
            format,
            detail: detail.into(),
            remedy: "export the camera again".into(),
        }
    }

    pub(crate) fn with_remedy(
        format: &'static str,
        detail: impl Into<String>,
        remedy: impl Into<Cow<'static, str>>,
    ) -> Self {
        Self::Malformed {
            format,
            detail: detail.into(),
            remedy: remedy.into(),
        }
    }
}
