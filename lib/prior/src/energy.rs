//! How well the model explains a picture under a caption: its denoising
//! error at high noise, with the same noise for every caption.

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::vae::pixel_unshuffle;

use crate::blueprint::FACTOR;
use crate::error::Result;
use crate::examples::{SIZE, dilate};
use crate::student::{Spoken, condition_of, latents_of};
use crate::words::{Caption, LightWords};

/// Timesteps, as shares of all, at which light is recognised.
pub const SHARES: [f64; 4] = [0.5, 0.6, 0.7, 0.8];

/// A picture of an object and what surrounds it.
#[derive(Debug, Clone)]
pub struct Observation {
    /// Scaled latents [1, c, h, w].
    pub latents: Tensor,
    /// Mask and masked latents [1, 1 + c, h, w].
    pub condition: Tensor,
    /// Weights of latent values, [1, c, h, w], that sum to 1.
    pub weights: Tensor,
}

impl Observation {
    /// Of `image` and what is `shown` around `mask`: pictures [3, SIZE, SIZE]
    /// in [0, 1]. The error counts near `focus`, [SIZE, SIZE], at most.
    pub fn new(image: &[f32], shown: &[f32], mask: &[f32], focus: &[f32]) -> Result<Self> {
        let weight: Vec<f32> = dilate(focus, 5).iter().map(|m| 0.15 + m).collect();
        let weight = Tensor::from_vec(weight, (1, 1, SIZE, SIZE), &Device::Cpu)?;
        let weight = pixel_unshuffle(&weight, FACTOR)?;
        let weights = Tensor::cat(&[&weight, &weight, &weight], 1)?;
        let total = weights.sum_all()?.to_scalar::<f32>()? as f64;
        Ok(Self {
            latents: latents_of(image.to_vec())?,
            condition: condition_of(shown.to_vec(), &[mask.to_vec()])?,
            weights: (weights / total)?,
        })
    }
}

/// States of captions under `model`, [captions, tokens, width].
pub fn states(model: &Model, captions: &[Option<Caption>]) -> Result<Tensor> {
    Spoken::new(&model.tokenizer, captions)?.states(&model.text_encoder)
}

/// Noise predictions [contexts, c, h, w] for one noisy latent under many
/// contexts.
fn predictions(
    model: &Model,
    observation: &Observation,
    noisy: &Tensor,
    t: usize,
    contexts: &Tensor,
) -> Result<Tensor> {
    let count = contexts.dims()[0];
    let input = Tensor::cat(&[noisy, &observation.condition], 1)?;
    let (_, c, h, w) = input.dims4()?;
    let input = input.broadcast_as((count, c, h, w))?.contiguous()?;
    Ok(model
        .unet
        .forward(&input, &[t as f64], contexts, &Pass::default())?)
}

/// Calls `each` with the noise and with what is predicted of it under every context, [contexts, c, h, w],
/// for noise drawn at each of the `shares` of the timesteps.
fn for_each_share(
    model: &Model,
    observation: &Observation,
    contexts: &Tensor,
    shares: &[f64],
    stream: &mut NoiseStream,
    mut each: impl FnMut(&Tensor, &Tensor) -> Result<()>,
) -> Result<()> {
    for &share in shares {
        let t = model.schedule.timestep_at(share);
        let noise = stream.normal_tensor(observation.latents.dims(), DType::F32, &Device::Cpu)?;
        let noisy = model.schedule.add_noise(&observation.latents, &noise, t)?;
        let output = predictions(model, observation, &noisy, t, contexts)?;
        let shown = noisy.broadcast_as(output.shape())?.contiguous()?;
        each(&noise, &model.schedule.noise_of(&output, &shown, t)?)?;
    }
    Ok(())
}

/// Mean squared error of the noise under each context, one draw of it at each of `shares` of the
/// timesteps.
pub fn energies(
    model: &Model,
    observation: &Observation,
    contexts: &Tensor,
    shares: &[f64],
    stream: &mut NoiseStream,
) -> Result<Vec<f64>> {
    let mut sums = vec![0f64; contexts.dims()[0]];
    let weight = 1.0 / shares.len() as f64;
    let add = |noise: &Tensor, predicted: &Tensor| {
        let error = predicted.broadcast_sub(noise)?.sqr()?;
        let error = error.broadcast_mul(&observation.weights)?;
        let errors = error.flatten_from(1)?.sum(1)?.to_vec1::<f32>()?;
        sums.iter_mut()
            .zip(errors)
            .for_each(|(s, e)| *s += e as f64 * weight);
        Ok(())
    };
    for_each_share(model, observation, contexts, shares, stream, add)?;
    Ok(sums)
}

/// Mean over `shares` of the timesteps of the noise prediction under the first context less that under the others, on
/// average: what LDS would change, [1, c, h, w].
pub fn difference(
    model: &Model,
    observation: &Observation,
    contexts: &Tensor,
    shares: &[f64],
    stream: &mut NoiseStream,
) -> Result<Tensor> {
    let mut sum = observation.latents.zeros_like()?;
    let weight = 1.0 / shares.len() as f64;
    let others = contexts.dims()[0] - 1;
    let add = |_: &Tensor, predicted: &Tensor| {
        let other = predicted.narrow(0, 1, others)?.mean_keepdim(0)?;
        let difference = (predicted.narrow(0, 0, 1)? - other)?;
        sum = (&sum + (difference * weight)?)?;
        Ok(())
    };
    for_each_share(model, observation, contexts, shares, stream, add)?;
    Ok(sum)
}

/// States of what guides towards `light`: the caption that says so, and those that it is told from
/// ([`LightWords::turned`]), or the empty one where there is no sun to turn.
pub fn guiding(model: &Model, class: &str, light: &LightWords) -> Result<Tensor> {
    let said = |light: &LightWords| Some(Caption::new(class, Some(light)));
    let captions: Vec<_> = match light.is_overcast() {
        true => vec![said(light), None],
        false => std::iter::once(said(light))
            .chain(light.turned().iter().map(said))
            .collect(),
    };
    states(model, &captions)
}
