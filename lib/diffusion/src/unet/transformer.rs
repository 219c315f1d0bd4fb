//! Spatial transformer: self-attention over pixels, cross-attention to the
//! text, gated feed-forward [Rombach et al. 2022].

use candle_core::Tensor;

use super::config::UNetConfig;
use super::projection::Projection;
use crate::error::Result;
use crate::layers::{
    Attention, Causality, GroupNorm, LayerNorm, NormActivation, add, add_tokens, geglu, tokens_of,
};
use crate::lora::AdapterTarget;
use crate::parameters::Parameters;
use crate::pass::Pass;

/// Added to variances in the transformer's own norms.
const GROUP_EPS: f64 = 1e-6;
const LAYER_EPS: f64 = 1e-5;

/// Attention with its four projections.
#[derive(Debug)]
struct CrossAttention {
    to_q: Projection,
    to_k: Projection,
    to_v: Projection,
    to_out: Projection,
    attention: Attention,
}

impl CrossAttention {
    fn new(parameters: &Parameters, width: usize, context: usize, heads: usize) -> Result<Self> {
        Ok(Self {
            to_q: Projection::without_bias(&parameters.sub("to_q"), width, width)?,
            to_k: Projection::without_bias(&parameters.sub("to_k"), context, width)?,
            to_v: Projection::without_bias(&parameters.sub("to_v"), context, width)?,
            to_out: Projection::linear(&parameters.sub("to_out.0"), width, width)?,
            attention: Attention {
                heads,
                causality: Causality::Full,
            },
        })
    }

    fn forward(&self, x: &Tensor, context: &Tensor, pass: &Pass) -> Result<Tensor> {
        let q = self.to_q.forward(x, pass)?;
        let k = self.to_k.forward(context, pass)?;
        let v = self.to_v.forward(context, pass)?;
        self.to_out
            .forward(&self.attention.forward(&q, &k, &v)?, pass)
    }
}

#[derive(Debug)]
struct TransformerBlock {
    norm1: LayerNorm,
    self_attention: CrossAttention,
    norm2: LayerNorm,
    cross_attention: CrossAttention,
    norm3: LayerNorm,
    expand: Projection,
    contract: Projection,
}

impl TransformerBlock {
    fn new(parameters: &Parameters, width: usize, context: usize, heads: usize) -> Result<Self> {
        let norm = |name| LayerNorm::new(&parameters.sub(name), width, LAYER_EPS);
        Ok(Self {
            norm1: norm("norm1")?,
            self_attention: CrossAttention::new(&parameters.sub("attn1"), width, width, heads)?,
            norm2: norm("norm2")?,
            cross_attention: CrossAttention::new(&parameters.sub("attn2"), width, context, heads)?,
            norm3: norm("norm3")?,
            expand: Projection::linear(&parameters.sub("ff.net.0.proj"), width, 8 * width)?,
            contract: Projection::linear(&parameters.sub("ff.net.2"), 4 * width, width)?,
        })
    }

    fn forward(&self, x: &Tensor, context: &Tensor, pass: &Pass) -> Result<Tensor> {
        let normed = self.norm1.forward(x)?;
        let x = add(x, &self.self_attention.forward(&normed, &normed, pass)?)?;
        let normed = self.norm2.forward(&x)?;
        let x = add(&x, &self.cross_attention.forward(&normed, context, pass)?)?;
        let hidden = geglu(&self.expand.forward(&self.norm3.forward(&x)?, pass)?)?;
        add(&x, &self.contract.forward(&hidden, pass)?)
    }
}

/// Transformer over the pixels of a feature map.
#[derive(Debug)]
pub(super) struct SpatialTransformer {
    norm: GroupNorm,
    proj_in: Projection,
    blocks: Vec<TransformerBlock>,
    proj_out: Projection,
}

impl SpatialTransformer {
    /// Every layer that an adapter may extend.
    pub(super) fn targets(&self) -> Vec<AdapterTarget> {
        let mut layers = vec![&self.proj_in, &self.proj_out];
        for block in &self.blocks {
            for attention in [&block.self_attention, &block.cross_attention] {
                layers.extend([
                    &attention.to_q,
                    &attention.to_k,
                    &attention.to_v,
                    &attention.to_out,
                ]);
            }
            layers.extend([&block.expand, &block.contract]);
        }
        layers.into_iter().map(Projection::target).collect()
    }

    pub(super) fn new(parameters: &Parameters, config: &UNetConfig, level: usize) -> Result<Self> {
        let width = config.block_out_channels[level];
        let (heads, context) = (config.heads(level), config.cross_attention_dim);
        let norm = &parameters.sub("norm");
        let around = |name| {
            let layer = parameters.sub(name);
            if config.use_linear_projection {
                Projection::linear(&layer, width, width)
            } else {
                Projection::pointwise_conv(&layer, width, width)
            }
        };
        let blocks = (0..config.transformer_layers(level))
            .map(|i| {
                TransformerBlock::new(
                    &parameters.sub(format!("transformer_blocks.{i}")),
                    width,
                    context,
                    heads,
                )
            })
            .collect::<Result<_>>()?;
        Ok(Self {
            norm: GroupNorm::new(
                norm,
                config.norm_num_groups,
                width,
                GROUP_EPS,
                NormActivation::None,
            )?,
            proj_in: around("proj_in")?,
            blocks,
            proj_out: around("proj_out")?,
        })
    }

    pub(super) fn forward(&self, x: &Tensor, context: &Tensor, pass: &Pass) -> Result<Tensor> {
        let mut tokens = self
            .proj_in
            .forward(&tokens_of(&self.norm.forward(x)?)?, pass)?;
        for block in &self.blocks {
            tokens = block.forward(&tokens, context, pass)?;
        }
        add_tokens(x, &self.proj_out.forward(&tokens, pass)?)
    }
}
