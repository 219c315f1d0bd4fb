//! The light of a place from one photograph and its camera.
//!
//! The answer is a distribution: a smooth map of the light, the energy of the strongest source and a posterior over
//! where it stands, each on the photograph's linear scale. Its mean is the light to start from; where the photograph
//! decides nothing the mean is soft. Objects, presets and seeds do not enter.
mod candidates;
mod combine;
mod cues;
pub mod error;
mod estimate;
mod estimator;
pub mod features;
pub mod grid;
pub mod histogram;
mod known;
pub mod network;
pub mod posterior;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod unusual_tests;
mod visible;

pub use candidates::Candidate;
pub use combine::{ViewEstimate, combine};
pub use error::EstimatorError;
pub use estimate::{Interval, LightEstimate};
pub use estimator::{Calibration, Estimator};
pub use known::{KnownAngle, KnownSource, KnownSun};
pub use posterior::PeakPosterior;
pub use visible::{BORDER_DEG, Visible, merged, overlaid};

/// Raised whenever the same photograph and camera get another estimate.
pub const VERSION: u32 = 7;
