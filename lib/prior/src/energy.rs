//! How well the model explains a picture under a caption: the error of its noise prediction, with the same noise for
//! every caption.

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::distillation::{InpaintCondition, ScoreDistillation, ScoreRule, Weighting};
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
    /// Mask and masked latents.
    pub condition: InpaintCondition,
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
    for &share in shares {
        let t = model.schedule.timestep_at(share);
        let noise = stream.normal_tensor(observation.latents.dims(), DType::F32, &Device::Cpu)?;
        let noisy = model.schedule.add_noise(&observation.latents, &noise, t)?;
        let input = observation.condition.join(&noisy)?;
        let (_, c, h, w) = input.dims4()?;
        let input = input.broadcast_as((sums.len(), c, h, w))?.contiguous()?;
        let output = model
            .unet
            .forward(&input, &[t as f64], contexts, &Pass::default())?;
        let noisy = noisy.broadcast_as(output.shape())?.contiguous()?;
        let predicted = model.schedule.noise_of(&output, &noisy, t)?;
        let error = predicted.broadcast_sub(&noise)?.sqr()?;
        let error = error.broadcast_mul(&observation.weights)?;
        let errors = error.flatten_from(1)?.sum(1)?.to_vec1::<f32>()?;
        let weight = 1.0 / shares.len() as f64;
        sums.iter_mut()
            .zip(errors)
            .for_each(|(s, e)| *s += e as f64 * weight);
    }
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
    let latents = &observation.latents;
    let lds = ScoreDistillation {
        unet: &model.unet,
        schedule: &model.schedule,
        rule: ScoreRule::Lds,
        weighting: Weighting::Uniform,
        lora: None,
        conditional: &contexts.narrow(0, 0, 1)?,
        unconditional: &contexts.narrow(0, 1, contexts.dim(0)? - 1)?,
        inpaint: Some(&observation.condition),
    };
    let mut sum = latents.zeros_like()?;
    for &share in shares {
        let t = model.schedule.timestep_at(share);
        let noise = stream.normal_tensor(latents.dims(), DType::F32, &Device::Cpu)?;
        let found = lds.gradient(latents, t, &noise)?;
        sum = (sum + (found.gradient * (1.0 / shares.len() as f64))?)?;
    }
    Ok(sum)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::caption::{Caption, LightDescription};
    use crate::picture::PIXELS;
    use crate::text_conditioning::{add_placeholders, caption_states};

    #[test]
    fn energies_and_the_gradient_of_lds_are_those_of_single_predictions() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/prior");
        let mut model = Model::load(&folder, DType::F32, &Device::Cpu).unwrap();
        add_placeholders(&mut model.tokenizer);
        let captions = [0.2, 1.8, 4.0].map(|azimuth| {
            let light = LightDescription {
                azimuth,
                elevation: 0.6,
                sun_share: 0.8,
            };
            Some(Caption::new("red car", Some(&light)))
        });
        let contexts = caption_states(&model, &captions).unwrap();
        let image: Vec<f32> = (0..3 * PIXELS).map(|i| (i % 11) as f32 / 11.0).collect();
        let mut mask = vec![0.0; PIXELS];
        mask[400..500].fill(1.0);
        let seen = Observation::new(&image, &image, &mask, &mask).unwrap();
        let stream = || NoiseStream::new(1, 2);
        let single = |k: usize| -> Result<(Tensor, f64)> {
            let t = model.schedule.timestep_at(0.6);
            let noise = stream().normal_tensor(seen.latents.dims(), DType::F32, &Device::Cpu)?;
            let noisy = model.schedule.add_noise(&seen.latents, &noise, t)?;
            let input = seen.condition.join(&noisy)?;
            let context = contexts.narrow(0, k, 1)?;
            let output = model
                .unet
                .forward(&input, &[t as f64], &context, &Pass::default())?;
            let predicted = model.schedule.noise_of(&output, &noisy, t)?;
            let error = ((&predicted - &noise)?.sqr()? * &seen.weights)?;
            Ok((predicted, error.sum_all()?.to_scalar::<f32>()?.into()))
        };
        let [(a, of_a), (b, of_b), (c, of_c)] = [0, 1, 2].map(|k| single(k).unwrap());
        let found = energies(&model, &seen, &contexts, &[0.6], &mut stream()).unwrap();
        // Sums of 3,072 positive terms in f32, and predictions in a batch of three: some 1e-6.
        for (found, wanted) in found.iter().zip([of_a, of_b, of_c]) {
            assert!((found / wanted - 1.0).abs() < 1e-5, "{found} {wanted}");
        }
        let found = prediction_difference(&model, &seen, &contexts, &[0.6], &mut stream()).unwrap();
        let wanted = (a - ((b + c).unwrap() * 0.5).unwrap()).unwrap();
        let largest = |t: Tensor| t.abs().unwrap().max_all().unwrap().to_scalar::<f32>();
        let size = largest(wanted.clone()).unwrap();
        let apart = largest((found - wanted).unwrap()).unwrap();
        assert!(size > 1e-3 && apart < 1e-4 * size, "{apart} of {size}");
    }
}
