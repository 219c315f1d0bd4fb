//! What a network that was trained on photographs of all kinds sees in a photograph: EfficientNet-Lite0 up to block 14.
//!
//! A picture of any size becomes two feature maps, one of 112 channels at a sixteenth of its size and one of 192
//! channels at a thirty-second. One thread computes them, so that the bytes never depend on threads.
pub mod frame;
mod layers;
mod network;
mod product;
mod tuned;

pub use layers::Map;
pub use network::{Backbone, BackboneError, CHANNELS};
pub use product::product;
pub use tuned::{TUNED_FROM, Tuned};
