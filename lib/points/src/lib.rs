//! Points of a scene, as scanners, reconstructions and depth maps give them: their files, the ground
//! through them, and free places on it.
//!
//! Coordinates are those of dipir: right-handed, +y up, metres.
mod cells;
pub mod cloud;
pub mod depth;
pub mod error;
pub mod file;
pub mod ground;
mod pcd;
pub mod place;
mod plane;
pub mod ply;
pub mod relief;
pub mod scale;

pub use cloud::Cloud;
pub use error::PointsError;
pub use ground::{Ground, ground};
