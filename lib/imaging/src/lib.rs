//! Linear and display images, their files, and what is computed on them.
pub mod composite;
mod decode;
pub mod encoding;
pub mod error;
pub mod exposure;
mod exr_file;
pub mod facts;
pub mod file;
mod format;
mod hdr_file;
mod jpeg_header;
pub mod layer_rows;
pub mod layers;
pub mod marked_png;
pub mod metrics;
mod png_colours;
mod png_file;
mod primaries;
pub mod raster;
pub mod resize;
mod sensors;
pub mod spline;
pub mod tone;
pub mod transfer;
mod unheeded;
pub mod warp;

pub use error::ImagingError;
