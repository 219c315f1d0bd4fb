//! Cameras that other programs know: lenses with distortion, and the files that poses come in.
//!
//! World and camera are those of dipir: right-handed, +y up, metres; a camera looks down its own -z
//! with +y up in the picture; pixel (0, 0) is the top left corner. Lenses count in image axes: +x to
//! the right, +y down, +z forward.
mod buffers;
pub mod camera;
pub mod chan;
pub mod colmap;
pub mod distortion;
pub mod error;
pub mod file;
mod foreign;
pub mod fspy;
pub mod gltf;
pub mod kitti;
pub mod moving;
pub mod neighbours;
pub mod nuscenes;
pub mod opencv;
pub mod orientation;
mod track;
pub mod transforms;
mod upright;

pub use camera::{Camera, Lens, Pose, WorldUp};
pub use distortion::Distortion;
pub use error::CameraError;
