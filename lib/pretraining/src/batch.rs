//! A batch of examples as tensors.

use candle_core::Tensor;
use dipir_diffusion::distillation::InpaintCondition;
use dipir_prior::caption::Caption;
use dipir_prior::picture::{Picture, inpainting_condition, latent_weights, latents_of};

use crate::error::Result;
use crate::examples::{AlternativeLight, Example};

/// Tensors of a batch. Examples with alternatives come first.
pub struct Batch {
    /// Latents of the targets, [batch, c, h, w].
    pub latents: Tensor,
    /// Latents that noise is put on: the same, or under another light.
    pub noised: Tensor,
    /// Whether the two differ.
    pub relit: Vec<bool>,
    /// Masks and masked latents.
    pub condition: InpaintCondition,
    /// Weights of latent values, [batch, c, h, w].
    pub weights: Tensor,
    /// Captions; `None` is the empty one.
    pub captions: Vec<Option<Caption>>,
    /// Alternatives of the first examples, as many for each of them.
    pub alternatives: Vec<Vec<AlternativeLight>>,
}

impl Batch {
    /// Joins examples. All that have alternatives need as many.
    pub fn new(mut examples: Vec<Example>) -> Result<Self> {
        examples.sort_by_key(|e| e.alternatives.is_empty());
        let joined = |of: fn(&Example) -> &Vec<f32>| -> Vec<f32> {
            let parts = examples.iter().flat_map(|e| of(e).iter().copied());
            parts.collect()
        };
        let latents = |of: fn(&Example) -> &Picture| latents_of(joined(of));
        let masks: Vec<Vec<f32>> = examples.iter().map(|e| e.mask.clone()).collect();
        Ok(Self {
            latents: latents(|e| &e.image)?,
            noised: latents(|e| e.noised.as_ref().unwrap_or(&e.image))?,
            relit: examples.iter().map(|e| e.noised.is_some()).collect(),
            condition: inpainting_condition(joined(|e| &e.visible), &masks)?,
            weights: latent_weights(joined(|e| &e.weight))?,
            alternatives: examples
                .iter_mut()
                .map(|e| std::mem::take(&mut e.alternatives))
                .take_while(|a| !a.is_empty())
                .collect(),
            captions: examples.into_iter().map(|e| e.caption).collect(),
        })
    }
}
