//! What can go wrong with an estimate of the camera.

/// Why weights were refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// The bytes are no weights of this estimator.
    #[error(
        "the camera's weights are refused: {0}; train them again with the example `camera` of dipir-places"
    )]
    Weights(String),
}
