//! How well the model explains a picture under a caption: the error of its noise prediction, with the same noise for
//! every caption.

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;

use crate::error::Result;
use crate::picture::{dilate, inpainting_condition, latent_weights, latents_of};

/// Timesteps at which the model recognises light, as shares of all.
pub const TIMESTEP_SHARES: [f64; 4] = [0.5, 0.6, 0.7, 0.8];

/// A picture as the model denoises it.
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
    /// The picture `image`, where the model sees `visible` outside of `mask`: pictures [3, SIZE, SIZE] in [0, 1]. Errors
    /// count 1.15 within 5 pixels of `focus`, [SIZE, SIZE], and .15 elsewhere.
    pub fn new(image: &[f32], visible: &[f32], mask: &[f32], focus: &[f32]) -> Result<Self> {
        let weights = latent_weights(dilate(focus, 5).iter().map(|m| 0.15 + m).collect())?;
        let total = weights.sum_all()?.to_scalar::<f32>()? as f64;
        Ok(Self {
            latents: latents_of(image.to_vec())?,
            condition: inpainting_condition(visible.to_vec(), &[mask.to_vec()])?,
            weights: (weights / total)?,
        })
    }
}

/// Calls `each` with the noise and its predictions under every context, [contexts, c, h, w], for noise drawn at each of
/// the `shares` of the timesteps.
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
        let input = Tensor::cat(&[&noisy, &observation.condition], 1)?;
        let (_, c, h, w) = input.dims4()?;
        let input = input
            .broadcast_as((contexts.dims()[0], c, h, w))?
            .contiguous()?;
        let output = model
            .unet
            .forward(&input, &[t as f64], contexts, &Pass::default())?;
        let noisy = noisy.broadcast_as(output.shape())?.contiguous()?;
        each(&noise, &model.schedule.noise_of(&output, &noisy, t)?)?;
    }
    Ok(())
}

/// Weighted mean squared error of the noise prediction under each context, averaged over one draw of noise at each of
/// `shares` of the timesteps.
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

/// The noise prediction under the first context minus the mean of those under the others, averaged over `shares` of the
/// timesteps, [1, c, h, w]: the gradient of LDS.
pub fn prediction_difference(
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
