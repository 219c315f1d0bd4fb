//! Images from prompts.

use candle_core::{DType, Tensor};

use crate::distillation::InpaintCondition;
use crate::error::{Error, Result, argument};
use crate::model::Model;
use crate::noise::NoiseStream;
use crate::pass::Pass;
use crate::sampler::{Sampler, Solver, guided, sample};
use crate::text_encoder::LearnedTokens;

/// Settings of [`generate`].
#[derive(Debug, Clone)]
pub struct GenerateSettings {
    /// Solver.
    pub solver: Solver,
    /// Evaluations of the network, each of two predictions.
    pub steps: usize,
    /// Classifier-free guidance scale; 1 is none.
    pub guidance: f64,
    /// Height and width in pixels, multiples of what the model needs.
    pub size: (usize, usize),
    /// Key of the noise.
    pub seed: u64,
}

/// An image and the latents that it was decoded from.
#[derive(Debug, Clone)]
pub struct Generated {
    /// [1, 3, h, w] in [-1, 1], f32.
    pub image: Tensor,
    /// Scaled latents [1, c, h, w].
    pub latents: Tensor,
}

/// Pixels that height and width have to be a multiple of.
fn size_multiple(model: &Model) -> usize {
    model.vae.downscale()
}

/// Refuses values that are no numbers or without bound.
fn check_finite(what: &'static str, values: &Tensor) -> Result<()> {
    // 0 times anything else is NaN.
    let sum = (values.to_dtype(DType::F32)? * 0.0)?.sum_all()?;
    match sum.to_scalar::<f32>()? == 0.0 {
        true => Ok(()),
        false => Err(Error::NotFinite { what }),
    }
}

/// Samples an image for `prompt`. `progress` is called after each step with
/// the share that is done and returns false to stop early, which is an error.
/// So is an output that is not finite.
pub fn generate(
    model: &Model,
    prompt: &str,
    settings: &GenerateSettings,
    pass: &Pass,
    learned: Option<&LearnedTokens>,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Generated> {
    let factor = size_multiple(model);
    let (height, width) = settings.size;
    if height == 0 || width == 0 || height % factor != 0 || width % factor != 0 {
        return argument(format!(
            "image size {width}x{height}: accepted are multiples of {factor}"
        ));
    }
    let shape = [
        1,
        model.vae.latent_channels(),
        height / factor,
        width / factor,
    ];
    let mut stream = NoiseStream::new(settings.seed, 0);
    let start = stream
        .normal_tensor(&shape, DType::F32, model.device())?
        .to_dtype(model.dtype())?;
    let context = model.encode_prompts(&[prompt, ""], learned)?;
    let everything = model
        .is_inpainting()
        .then(|| paint_everything(model, height, width))
        .transpose()?;
    let mut sampler = Sampler::new(&model.schedule, settings.solver, settings.steps)?;
    let mut done = 0;
    let latents = sample(&mut sampler, 0, &start, |x, t| {
        let input = match &everything {
            Some(condition) => condition.join(x)?,
            None => x.clone(),
        };
        let both = Tensor::cat(&[&input, &input], 0)?;
        let output = model.unet.predict(&both, &[t as f64], &context, pass)?;
        done += 1;
        if !progress(done as f64 / settings.steps as f64) {
            return argument("sampling was stopped");
        }
        guided(
            &output.narrow(0, 1, 1)?,
            &output.narrow(0, 0, 1)?,
            settings.guidance,
        )
    })?;
    check_finite("sampled latents", &latents)?;
    let image = model.vae.decode(&latents)?.to_dtype(DType::F32)?;
    check_finite("decoded picture", &image)?;
    let image = image.clamp(-1f32, 1f32)?;
    Ok(Generated { image, latents })
}

/// An inpainting network that may paint every pixel.
fn paint_everything(model: &Model, height: usize, width: usize) -> Result<InpaintCondition> {
    let image = Tensor::zeros((1, 3, height, width), model.dtype(), model.device())?;
    let mask = Tensor::ones((1, 1, height, width), model.dtype(), model.device())?;
    InpaintCondition::new(&model.vae, &image, &mask)
}
