//! Linear and display images, their files, and what is computed on them.
pub mod raster;
