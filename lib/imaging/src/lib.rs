//! Linear and display images, their files, and what is computed on them.
pub mod composite;
pub mod error;
mod exr_file;
pub mod file;
mod format;
mod jpeg_header;
pub mod layers;
pub mod metrics;
pub mod raster;
pub mod resize;
pub mod spline;
pub mod tone;
pub mod transfer;

pub use error::ImagingError;
