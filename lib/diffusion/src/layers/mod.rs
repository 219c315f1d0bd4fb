//! Layers through which gradients pass, on the CPU and on NVIDIA GPUs through
//! the crate's own kernels and elsewhere composed of candle's differentiable
//! operations.
//!
//! candle's fused `layer_norm`, `softmax_last_dim`, `rms_norm` and rotary
//! operations have no backward pass and cut the graph without an error: none
//! of them is used here. Gradients of parameters that are not variables are
//! never computed by the kernels.

mod activation;
mod attention;
mod backend;
#[cfg(test)]
mod composed;
mod conv2d;
mod embedding;
mod group_norm;
mod joining;
mod layer_norm;
mod linear;
#[cfg(all(test, feature = "cuda"))]
mod on_gpu;
mod resample;

pub use activation::{Activation, activate, geglu};
pub use attention::{Attention, Causality};
pub use backend::composed;
pub use conv2d::{Conv2d, Padding};
pub use embedding::Embedding;
pub use group_norm::{GroupNorm, NormActivation};
pub(crate) use joining::{add, add_to_channels, add_tokens, concatenate_channels, tokens_of};
pub use layer_norm::LayerNorm;
pub use linear::Linear;
pub use resample::upsample_nearest;
