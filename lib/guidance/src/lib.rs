//! Light recovered under guidance.
//!
//! - [`reading`]: the light that a model with light captions sees in the photograph.
//! - [`distillation`]: what a diffusion model would change about the composite, as a gradient.
//! - [`recover`]: from a recorded scene to the light and tone curves that the guidance asks for.
pub mod distillation;
pub mod error;
pub mod reading;
pub mod recover;
mod timed;

pub use error::{Error, Result};
