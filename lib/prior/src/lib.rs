//! What the pipeline needs to estimate the light of a photograph with the small model: captions that describe light, the
//! light encoder, and inversion. `dipir-pretraining` trains the model.

pub mod caption;
pub mod encoder;
pub mod energy;
pub mod error;
pub mod inversion;
pub mod picture;
pub mod text_conditioning;

pub use error::{Error, Result};
