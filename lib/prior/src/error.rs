//! What can go wrong.

/// Failure to estimate light with the small model.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A value is out of its range.
    #[error("{0}")]
    Argument(String),
    /// From the diffusion model.
    #[error(transparent)]
    Diffusion(#[from] dipir_diffusion::Error),
    /// From a tensor operation.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// Shorthand.
pub type Result<T, E = Error> = std::result::Result<T, E>;
