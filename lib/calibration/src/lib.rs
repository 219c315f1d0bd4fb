//! Pitch, roll and field of view of the camera that took a photograph, as a distribution.
//!
//! Three things are multiplied: what straight lines tell ([`lines`]), what the picture's look tells (networks over
//! [`features`], for training on views of real places), and what is known of the focal length. How far each is trusted
//! is part of the weights. Those in the repository are not trained: lines and the known focal length alone decide.
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
