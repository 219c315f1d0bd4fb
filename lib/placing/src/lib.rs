//! `dipir place`: a page, served to this machine alone, on which objects are put into a photograph.
//!
//! The page draws and points; everything that is computed, it asks here: one camera, one
//! parser, one renderer for page, preview and pipeline.
pub mod desk;
pub mod document;
mod drafts;
pub mod edit;
pub mod gate;
mod lens;
mod mask;
mod patient;
mod readings;
pub mod relighting;
pub mod server;
mod shown;
mod standing;
pub mod vanishing;
