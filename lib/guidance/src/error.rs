//! What can go wrong while light is estimated and recovered.
use dipir_optimize::OptimizeError;

/// Why light was not recovered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The diffusion model failed.
    #[error(transparent)]
    Diffusion(#[from] dipir_diffusion::Error),
    /// The light encoder or the inversion failed.
    #[error("cannot estimate the light")]
    Estimate(#[from] dipir_prior::Error),
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
    /// The optimisation failed.
    #[error(transparent)]
    Optimize(OptimizeError),
    /// No gradient arrived where one is needed.
    #[error("{0}")]
    Cut(&'static str),
    /// No pixel shows the object.
    #[error("no pixel shows the object, so nothing can be guided; move it into the picture")]
    NothingToSee,
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
}

/// Results of this crate.
pub type Result<T> = std::result::Result<T, Error>;

impl From<OptimizeError> for Error {
    fn from(error: OptimizeError) -> Self {
        match error {
            OptimizeError::Interrupted => Self::Interrupted,
            other => Self::Optimize(other),
        }
    }
}
