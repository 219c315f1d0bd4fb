//! Pooled text states that join the timestep embedding (`addition_embed_type`
//! = "text"): what a caption says about the whole picture reaches every
//! residual block.

use candle_core::Tensor;

use super::config::UNetConfig;
use crate::error::Result;
use crate::layers::{Attention, Causality, LayerNorm, Linear};
use crate::parameters::{Init, Parameters};

/// Added to variances, PyTorch's default.
const EPS: f64 = 1e-5;

/// Norm, attention pooling, projection, norm: states [batch, tokens, width]
/// to [batch, 4 block_out_channels[0]].
#[derive(Debug)]
pub(super) struct PooledText {
    norm1: LayerNorm,
    position: Tensor,
    q: Linear,
    k: Linear,
    v: Linear,
    attention: Attention,
    projection: Linear,
    norm2: LayerNorm,
}

impl PooledText {
    pub(super) fn new(parameters: &Parameters, config: &UNetConfig) -> Result<Self> {
        let (width, size) = (config.cross_attention_dim, 4 * config.block_out_channels[0]);
        let p = parameters.sub("add_embedding");
        let pool = p.sub("pool");
        let linear = |name: &str| Linear::new(&pool.sub(name), width, width);
        Ok(Self {
            norm1: LayerNorm::new(&p.sub("norm1"), width, EPS)?,
            position: pool.get(
                "positional_embedding",
                &[1, width],
                Init::Normal((width as f64).powf(-0.5)),
            )?,
            q: linear("q_proj")?,
            k: linear("k_proj")?,
            v: linear("v_proj")?,
            attention: Attention {
                heads: config.addition_embed_type_num_heads,
                causality: Causality::Full,
            },
            projection: Linear::new(&p.sub("proj"), width, size)?,
            norm2: LayerNorm::new(&p.sub("norm2"), size, EPS)?,
        })
    }

    /// The vector that is added to the timestep embedding.
    pub(super) fn forward(&self, context: &Tensor) -> Result<Tensor> {
        let x = self.norm1.forward(context)?;
        // The query is the mean state; it also is one of the keys.
        let mean = x.mean_keepdim(1)?.broadcast_add(&self.position)?;
        let x = Tensor::cat(&[&mean, &x], 1)?;
        let pooled = self.attention.forward(
            &self.q.forward(&mean)?,
            &self.k.forward(&x)?,
            &self.v.forward(&x)?,
        )?;
        self.norm2
            .forward(&self.projection.forward(&pooled.squeeze(1)?)?)
    }
}
