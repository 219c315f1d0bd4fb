//! From a photograph and models to a first `pipeline.toml`.
//!
//! Values come from the photograph or a camera's file where these have them. All others are
//! defaults, which comments in the file mark as such. The world is dipir's: metres, +y up; without
//! a camera's file the camera stands above the origin of the ground y = 0 and looks along -z,
//! turned by pitch and roll.
pub mod camera_file;
pub mod document;
mod elsewhere;
pub mod error;
mod light;
pub mod model;
mod naming;
pub mod project;
pub mod size;
pub mod spots;
mod turn;
pub mod view;

pub use error::SetupError;
pub use project::{Draft, Request, draft};
