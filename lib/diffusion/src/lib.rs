//! Latent diffusion models at any size: model folders in the diffusers
//! layout, layers whose gradients pass, samplers, LoRA and score distillation.

#[cfg(test)]
extern crate self as dipir_diffusion;

mod added_tokens;
pub mod backward;
pub mod check;
pub mod concepts;
pub mod config;
pub mod crop;
#[cfg(feature = "cuda")]
mod cuda;
pub mod description;
#[cfg(test)]
#[path = "../tests/differences/mod.rs"]
mod differences;
pub mod distillation;
pub mod error;
pub mod extent;
pub mod generate;
mod kernels;
pub mod layers;
pub mod lora;
pub mod memory;
pub mod model;
pub mod noise;
pub mod optimizer;
pub mod parameters;
pub mod pass;
pub mod recompute;
mod resnet;
pub mod sampler;
pub mod schedule;
pub mod single_file;
pub mod text_encoder;
pub mod tokenizer;
pub mod training;
pub mod unet;
pub mod vae;
pub mod validation;
pub mod weights;

pub use error::{Error, Result};
pub use kernels::tiles::bf16_products;
