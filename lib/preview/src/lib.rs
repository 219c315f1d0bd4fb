//! A project's scene at the size of a screen, without running a stage: what stands where, and a
//! draft of how it will look.
//!
//! All positions in the picture are pixels of the photograph at its full size; what draws scales
//! them.
pub mod arrangement;
pub mod canvas;
pub mod draft;
pub mod lines;
pub mod marks;
pub mod picture;
pub mod relit;
pub mod small;

pub use dipir_imaging::marked_png as png;
