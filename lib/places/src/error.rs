//! What can go wrong in training.
use std::path::PathBuf;

/// Why training stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlacesError {
    /// A folder or file could not be read or written.
    #[error("cannot {what} `{}`", path.display())]
    File {
        /// "read" or "write".
        what: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The folder holds too few panoramas.
    #[error("`{}` holds panoramas (*.hdr, *.exr) of {found} places; {folds} folds need at least {folds}", path.display())]
    TooFew {
        /// The folder.
        path: PathBuf,
        /// Places found; one that is seen again counts once.
        found: usize,
        /// Folds asked for.
        folds: usize,
    },
    /// A panorama is no map of light.
    #[error(transparent)]
    Light(#[from] dipir_light::error::LightError),
    /// Weights could not be made or read.
    #[error(transparent)]
    Estimator(#[from] dipir_estimator::EstimatorError),
    /// Weights of the camera could not be made or read.
    #[error(transparent)]
    Camera(#[from] dipir_calibration::CalibrationError),
    /// A setting that cannot be worked with.
    #[error("{0}")]
    Setting(String),
    /// The loss of a training, or a weight, is not finite.
    #[error(
        "training is not finite any more after {step} steps; lower the learning rate or the weight decay"
    )]
    Diverged {
        /// Steps so far.
        step: usize,
    },
    /// Training was stopped by the caller; what is finished is kept.
    #[error("training was stopped; the same command goes on from the folds that are finished")]
    Stopped,
}
