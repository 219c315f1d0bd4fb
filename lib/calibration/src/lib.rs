//! Pitch, roll and field of view of the camera that took a photograph, as a distribution.
//!
//! One network tells from the picture as a [`whole`] how probable cameras are. Another corrects it camera by camera: it is
//! told what straight lines ([`lines`]), edges, brightness and tint ([`look`]) look like under each. Their density is
//! multiplied with what is known of the focal length, on a grid that is drawn closer around what is probable.
pub mod error;
mod estimate;
pub mod generated;
pub mod lines;
pub mod look;
pub mod network;
pub mod pose;
pub mod posterior;
pub mod segments;
#[cfg(test)]
mod tests;
pub mod whole;

pub use error::CalibrationError;
pub use estimate::{CameraEstimate, CameraEstimator, Evidence, KnownFocal, SEARCHED, Scores};
pub use pose::Pose;
pub use posterior::{Interval, Posterior};
