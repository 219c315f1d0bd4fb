//! What can be wrong with points.
use std::borrow::Cow;
use std::path::PathBuf;

use dipir_cameras::CameraError;
use dipir_imaging::ImagingError;

/// Every message says what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum PointsError {
    /// A file cannot be read.
    #[error("cannot read the points \"{}\": {source}", path.display())]
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
        remedy: &'static str,
    },
    /// A depth map cannot be read.
    #[error(transparent)]
    Image(#[from] ImagingError),
    /// COLMAP's points or a sensor's calibration cannot be read.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// There is no ground in the points.
    #[error("no ground is found in the points: {detail}; {remedy}")]
    NoGround {
        /// Why not.
        detail: String,
        /// What to do.
        remedy: Cow<'static, str>,
    },
    /// The ground is to be a relief, and too few points are ground.
    #[error(
        "the ground through the points cannot be a relief: fewer than {fewest} of them are ground near the camera; \
         leave points_shape out, or write points_shape = \"plane\""
    )]
    NoRelief {
        /// Points that a relief takes.
        fewest: usize,
    },
}

impl PointsError {
    pub(crate) fn new(format: &'static str, detail: impl Into<String>) -> Self {
        Self::with_remedy(format, detail, "export the points again")
    }

    pub(crate) fn with_remedy(
        format: &'static str,
        detail: impl Into<String>,
        remedy: &'static str,
    ) -> Self {
        Self::Malformed {
            format,
            detail: detail.into(),
            remedy,
        }
    }
}

/// The beginning of what a file says, for a message.
pub(crate) fn shown(text: &str) -> String {
    let beginning: String = text.chars().take(60).collect();
    beginning.escape_debug().to_string()
}
