//! Score distillation: what a diffusion model would change about latents,
//! as a gradient that is injected there. The network is never differentiated.

use std::sync::Arc;

use candle_core::Tensor;

use crate::error::{Result, argument};
use crate::lora::Lora;
use crate::pass::Pass;
use crate::sampler::{Sampler, Solver, edit, guided};
use crate::schedule::NoiseSchedule;
use crate::unet::UNet;
use crate::vae::Vae;

/// Which difference of predictions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ScoreRule {
    /// Guided prediction minus the noise that was added [Poole et al. 2023];
    /// `scale` as in [`guided`].
    Sds {
        /// Classifier-free guidance scale, 1 + s in the paper's notation.
        scale: f64,
    },
    /// Conditional minus unconditional prediction [Yu et al. 2024].
    Csd,
    /// Adapted conditional minus un-adapted unconditional prediction
    /// [Liang et al. 2024, eq. 8].
    Lds,
    /// Latents minus what they become when they are noised up to t and denoised under the prompt
    /// (SDEdit) [Meng et al. 2022; as "dataset update" Haque et al. 2023]: the gradient of half their
    /// squared distance. w(t) is left out.
    Edit {
        /// Classifier-free guidance scale.
        scale: f64,
        /// Steps of DPM-Solver++(2M) over the whole schedule, of which those below t are taken.
        steps: usize,
    },
}

/// w(t).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Weighting {
    /// 1 - alpha bar, the usual choice: it vanishes with the noise.
    #[default]
    NoiseVariance,
    /// 1.
    Uniform,
}

impl Weighting {
    /// w at this alpha bar.
    pub fn at(self, alpha_bar: f64) -> f64 {
        match self {
            Self::NoiseVariance => 1.0 - alpha_bar,
            Self::Uniform => 1.0,
        }
    }
}

/// Channels that an inpainting network sees beside the noisy latents.
#[derive(Debug, Clone)]
pub struct InpaintCondition {
    /// 1 where the network may paint, [batch or 1, 1, h, w] in latent pixels.
    pub mask: Tensor,
    /// Latents of the image with the masked part blanked, [batch or 1, c, h, w].
    pub masked_latents: Tensor,
}

impl InpaintCondition {
    /// From images [batch, 3, h, w] in [-1, 1] and masks [batch, 1, h, w], 1
    /// where the network may paint: what is masked becomes grey before it is
    /// encoded, the mask is read at the top left of each latent pixel.
    pub fn new(vae: &Vae, image: &Tensor, mask: &Tensor) -> Result<Self> {
        let (batch, _, height, width) = image.dims4()?;
        let factor = vae.downscale();
        if mask.dims() != [batch, 1, height, width] || height % factor != 0 || width % factor != 0 {
            return argument(format!(
                "inpainting: image {:?} and mask {:?} must have one size, a multiple of {factor}",
                image.dims(),
                mask.dims()
            ));
        }
        // A mask is yes or no at every pixel.
        let hard = mask.ge(0.5)?.to_dtype(image.dtype())?;
        let masked = image.broadcast_mul(&hard.affine(-1.0, 1.0)?)?;
        let grid = |n: usize| {
            (0..n / factor)
                .map(|i| (i * factor) as u32)
                .collect::<Vec<_>>()
        };
        let rows = Tensor::from_vec(grid(height), height / factor, image.device())?;
        let columns = Tensor::from_vec(grid(width), width / factor, image.device())?;
        let mask = hard.index_select(&rows, 2)?.index_select(&columns, 3)?;
        Ok(Self {
            mask,
            masked_latents: vae.encode(&masked)?.detach(),
        })
    }

    /// Latents, mask and masked latents side by side.
    pub fn join(&self, latents: &Tensor) -> Result<Tensor> {
        let (batch, _, h, w) = latents.dims4()?;
        let spread = |t: &Tensor| -> Result<Tensor> {
            Ok(t.broadcast_as((batch, t.dim(1)?, h, w))?.contiguous()?)
        };
        Ok(Tensor::cat(
            &[
                latents,
                &spread(&self.mask)?,
                &spread(&self.masked_latents)?,
            ],
            1,
        )?)
    }
}

/// A score-distillation step: everything but latents, t and noise.
#[derive(Debug)]
pub struct ScoreDistillation<'a> {
    /// The network.
    pub unet: &'a UNet,
    /// Its schedule.
    pub schedule: &'a NoiseSchedule,
    /// Which difference.
    pub rule: ScoreRule,
    /// w(t).
    pub weighting: Weighting,
    /// Adapter of the personalised model. LDS uses it in the conditional term only, all others in
    /// both.
    pub lora: Option<&'a Arc<Lora>>,
    /// States of the prompt, [1 or batch, tokens, width].
    pub conditional: &'a Tensor,
    /// States of the empty prompt, or, for a batch of 1, of several prompts [prompts, tokens, width], over which the
    /// prediction is averaged: the alternatives that the prompt is contrasted with.
    pub unconditional: &'a Tensor,
    /// For 9-channel networks.
    pub inpaint: Option<&'a InpaintCondition>,
}

/// The result of a step.
#[derive(Debug, Clone)]
pub struct ScoreGradient {
    /// w(t) times the difference, [batch, c, h, w]: the gradient at the latents, dz_t/dz left out
    /// as is usual.
    pub gradient: Tensor,
    /// Mean square of the difference without w(t).
    pub difference: f64,
}

impl ScoreDistillation<'_> {
    /// The gradient at `latents` [batch, c, h, w] for timestep `t` and the
    /// given standard normal noise of the same shape.
    pub fn gradient(&self, latents: &Tensor, t: usize, noise: &Tensor) -> Result<ScoreGradient> {
        if latents.dims() != noise.dims() {
            return argument(format!(
                "score distillation: latents {:?}, noise {:?}",
                latents.dims(),
                noise.dims()
            ));
        }
        let latents = latents.detach();
        let weight = self.weighting.at(self.schedule.alpha_bar(t)?);
        let (difference, weight) = match self.rule {
            ScoreRule::Edit { scale, steps } => {
                let edited = self.edited(&latents, t, noise, scale, steps)?;
                ((&latents - edited)?, 1.0)
            }
            ScoreRule::Sds { scale } => {
                let (conditional, unconditional) = self.noise(&latents, t, noise)?;
                let guided = guided(&unconditional, &conditional, scale)?;
                ((guided - noise)?, weight)
            }
            ScoreRule::Csd | ScoreRule::Lds => {
                let (conditional, unconditional) = self.noise(&latents, t, noise)?;
                ((conditional - unconditional)?, weight)
            }
        };
        let mean_square = difference
            .to_dtype(candle_core::DType::F32)?
            .sqr()?
            .mean_all()?
            .to_scalar::<f32>()?;
        Ok(ScoreGradient {
            gradient: (&difference * weight)?,
            difference: mean_square as f64,
        })
    }

    /// What SDEdit makes of `latents`, from timestep `t` on.
    fn edited(
        &self,
        latents: &Tensor,
        t: usize,
        noise: &Tensor,
        scale: f64,
        steps: usize,
    ) -> Result<Tensor> {
        let mut sampler = Sampler::new(self.schedule, Solver::DpmSolver2M, steps)?;
        let strength = (t + 1) as f64 / self.schedule.len() as f64;
        edit(&mut sampler, latents, noise, strength, |x, t| {
            let (conditional, unconditional) = self.outputs(x, t)?;
            guided(&unconditional, &conditional, scale)
        })
    }

    /// Noise predictions (conditional, unconditional).
    fn noise(&self, latents: &Tensor, t: usize, noise: &Tensor) -> Result<(Tensor, Tensor)> {
        let x_t = self.schedule.add_noise(latents, noise, t)?;
        let (conditional, unconditional) = self.outputs(&x_t, t)?;
        Ok((
            self.schedule.noise_of(&conditional, &x_t, t)?,
            self.schedule.noise_of(&unconditional, &x_t, t)?,
        ))
    }

    /// The network's outputs (conditional, mean of the unconditional), in one batch.
    fn outputs(&self, x_t: &Tensor, t: usize) -> Result<(Tensor, Tensor)> {
        let batch = x_t.dim(0)?;
        let input = match self.inpaint {
            Some(condition) => condition.join(x_t)?,
            None => x_t.clone(),
        };
        let spread = |context: &Tensor| -> Result<Tensor> {
            let (_, tokens, width) = context.dims3()?;
            Ok(context.broadcast_as((batch, tokens, width))?.contiguous()?)
        };
        let mut contexts = vec![spread(self.conditional)?];
        let several = batch == 1 && self.unconditional.dim(0)? > 1;
        contexts.push(match several {
            true => self.unconditional.clone(),
            false => spread(self.unconditional)?,
        });
        let context = Tensor::cat(&contexts, 0)?;
        let rows = context.dim(0)?;
        let inputs = Tensor::cat(&vec![&input; rows / batch], 0)?;
        let lora_rows = (self.rule == ScoreRule::Lds).then_some(batch);
        let pass = Pass {
            lora: self.lora.cloned(),
            lora_rows,
            recompute: None,
        };
        let output = self.unet.predict(&inputs, &[t as f64], &context, &pass)?;
        let unconditional = output.narrow(0, batch, rows - batch)?;
        Ok((
            output.narrow(0, 0, batch)?,
            match several {
                true => unconditional.mean_keepdim(0)?,
                false => unconditional,
            },
        ))
    }
}
