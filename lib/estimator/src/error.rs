//! What can go wrong with an estimate.
use std::path::PathBuf;

/// Why weights or estimates were refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EstimatorError {
    /// The file of weights could not be read.
    #[error("cannot read the light estimator's weights `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The bytes are no weights of this estimator.
    #[error(
        "the light estimator's weights are refused: {0}; train them again with `dipir-pretrain light`"
    )]
    Weights(String),
    /// Nothing to combine.
    #[error("no estimates were given to combine; at least one is needed")]
    Nothing,
    /// The light could not be made into a map.
    #[error(transparent)]
    Light(#[from] dipir_light::error::LightError),
}
