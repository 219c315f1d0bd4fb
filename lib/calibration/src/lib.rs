//! Pitch, roll and field of view of the camera that took a photograph, as a distribution.
//!
//! Three things are multiplied: what straight lines tell ([`lines`]), what the picture's look tells (networks over
//! [`features`], trained on views of real places), and what is known of the focal length. How far each is trusted was
//! chosen on places that the networks had not seen, so that 90% intervals hold about that.
pub mod error;
mod estimate;
pub mod features;
pub mod generated;
pub mod lines;
pub mod network;
pub mod pose;
pub mod posterior;
pub mod segments;
#[cfg(test)]
mod tests;

pub use error::CalibrationError;
pub use estimate::{CameraEstimate, CameraEstimator, Evidence, KnownFocal, Terms, Trust};
pub use pose::Pose;
pub use posterior::{Interval, Posterior};
