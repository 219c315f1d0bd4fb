//! Seconds that the parts of a model take.

use std::sync::Arc;
use std::time::Instant;

use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};

use super::{image, latents, normal, text};
use crate::distillation::{InpaintCondition, ScoreDistillation, ScoreRule, Weighting};
use crate::error::{Error, Result};
use crate::lora::Lora;
use crate::model::Model;
use crate::noise::NoiseStream;
use crate::pass::Pass;
use crate::training::{Example, LoraTrainer, TrainingConfig, TrainingData};

/// What is timed.
#[derive(Debug, Clone)]
pub struct TimesSettings {
    /// Side of the latents.
    pub side: usize,
    /// Rank of the adapter, whether activations are recomputed, examples of each kind in an update.
    pub training: TrainingConfig,
    /// Whether an update has an image of the class beside the photograph's crop.
    pub with_prior: bool,
}

/// Wall seconds, the least of a few turns; of one turn where it takes more than a second.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Side of the image, pixels.
    pub size: usize,
    /// Whether the model lies on the CPU.
    pub on_cpu: bool,
    /// States of two prompts.
    pub text_s: f64,
    /// One prediction.
    pub unet_s: f64,
    /// Image to latents.
    pub encode_s: f64,
    /// The same with the gradient at the image.
    pub encode_with_gradient_s: f64,
    /// Latents to image.
    pub decode_s: f64,
    /// One step of a sampler: two predictions in a batch.
    pub sampling_step_s: f64,
    /// One iteration of light distillation: encoding, two predictions, one of them adapted, and the gradient.
    pub guidance_s: f64,
    /// One update of a LoRA.
    pub lora_step_s: f64,
}

/// How many parts are timed.
const PARTS: usize = 8;

/// Times every part. `progress` is called with the share done, and returns false to stop, which is an error.
pub fn times(
    model: &Model,
    settings: &TimesSettings,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Times> {
    let (mut done, on_cpu) = (0, model.device().is_cpu());
    let mut time = |work: &mut dyn FnMut() -> Result<()>| -> Result<f64> {
        let seconds = least(on_cpu, work)?;
        done += 1;
        match progress(done as f64 / PARTS as f64) {
            true => Ok(seconds),
            false => Err(Error::Argument("the measurement was stopped".into())),
        }
    };
    let side = settings.side;
    let bench = Bench::new(model, settings)?;
    let mut trainer = LoraTrainer::new(model, settings.training.clone(), None)?;
    let data = bench.data(settings);
    Ok(Times {
        size: side * model.vae.downscale(),
        on_cpu,
        text_s: time(&mut || wait(&text(model, side)?))?,
        unet_s: time(&mut || wait(&bench.predict(1)?))?,
        encode_s: time(&mut || wait(&model.vae.encode(&bench.image)?))?,
        encode_with_gradient_s: time(&mut || bench.encode_with(|z| Ok(z.clone())))?,
        decode_s: time(&mut || wait(&model.vae.decode(&bench.latents)?))?,
        sampling_step_s: time(&mut || wait(&bench.predict(2)?))?,
        guidance_s: time(&mut || bench.guide())?,
        lora_step_s: time(&mut || trainer.step(&data).map(|_| ()))?,
    })
}

/// Seconds of the fastest of at most five turns within a second, on a GPU after one that compiles and allocates.
fn least(on_cpu: bool, work: &mut dyn FnMut() -> Result<()>) -> Result<f64> {
    let (mut least, mut all) = (f64::INFINITY, 0.0);
    if !on_cpu {
        work()?;
    }
    for _ in 0..5 {
        let clock = Instant::now();
        work()?;
        let seconds = clock.elapsed().as_secs_f64();
        least = least.min(seconds);
        all += seconds;
        if all > 1.0 {
            break;
        }
    }
    Ok(least)
}

/// Waits until the device has computed `t`: reading a number of it does.
fn wait(t: &Tensor) -> Result<()> {
    let number = t.detach().to_dtype(DType::F32)?.sum_all()?;
    number.to_scalar::<f32>()?;
    Ok(())
}

/// What the parts are applied to.
struct Bench<'a> {
    model: &'a Model,
    image: Tensor,
    latents: Tensor,
    context: Tensor,
    condition: Option<InpaintCondition>,
    lora: Arc<Lora>,
}

impl<'a> Bench<'a> {
    fn new(model: &'a Model, settings: &TimesSettings) -> Result<Self> {
        let image = image(model, settings.side)?;
        let (_, _, height, width) = image.dims4()?;
        let condition = match model.is_inpainting() {
            true => {
                let mask = Tensor::ones((1, 1, height, width), model.dtype(), model.device())?;
                Some(InpaintCondition::new(&model.vae, &image, &mask)?)
            }
            false => None,
        };
        let (rank, alpha) = (settings.training.rank, settings.training.alpha);
        let targets = model.unet.adapter_targets();
        Ok(Self {
            latents: latents(model, settings.side)?,
            context: text(model, settings.side)?,
            lora: Arc::new(
                Lora::new(&targets, rank, alpha, 0, model.device())?.constant(model.dtype())?,
            ),
            model,
            image,
            condition,
        })
    }

    fn input(&self) -> Result<Tensor> {
        match &self.condition {
            Some(condition) => condition.join(&self.latents),
            None => Ok(self.latents.clone()),
        }
    }

    fn predict(&self, batch: usize) -> Result<Tensor> {
        let input = self.input()?;
        let inputs = Tensor::cat(&vec![&input; batch], 0)?;
        let context = self.context.narrow(0, 0, batch)?.contiguous()?;
        self.model
            .unet
            .predict(&inputs, &[400.0], &context, &Pass::default())
    }

    /// Encodes the image and carries `at_latents` of its latents back to it.
    fn encode_with(&self, at_latents: impl FnOnce(&Tensor) -> Result<Tensor>) -> Result<()> {
        let encoding = self.model.vae.trace(&self.image)?;
        let at_latents = at_latents(encoding.latents())?;
        wait(&encoding.gradient(&at_latents)?)
    }

    fn guide(&self) -> Result<()> {
        let (wanted, other) = (
            self.context.narrow(0, 0, 1)?.contiguous()?,
            self.context.narrow(0, 1, 1)?.contiguous()?,
        );
        let distillation = ScoreDistillation {
            unet: &self.model.unet,
            schedule: &self.model.schedule,
            rule: ScoreRule::Lds,
            weighting: Weighting::NoiseVariance,
            lora: Some(&self.lora),
            conditional: &wanted,
            unconditional: &other,
            inpaint: self.condition.as_ref(),
        };
        let t = self.model.schedule.timestep_at(0.4);
        self.encode_with(|latents| {
            let noise = normal(self.model, 6, latents.dims())?;
            Ok(distillation.gradient(latents, t, &noise)?.gradient)
        })
    }

    /// Crops that are encoded anew, as in training, and class images whose latents are at hand.
    fn data(&self, settings: &TimesSettings) -> Crops<'_> {
        Crops {
            bench: self,
            with_prior: settings.with_prior,
        }
    }
}

struct Crops<'a> {
    bench: &'a Bench<'a>,
    with_prior: bool,
}

impl Crops<'_> {
    fn example(&self, latents: Tensor) -> Example {
        Example {
            latents,
            prompt: "a scene in the style of sks rendering".into(),
            inpaint: self.bench.condition.clone(),
        }
    }
}

impl TrainingData for Crops<'_> {
    fn instance(&self, _: &mut NoiseStream) -> Result<Example> {
        let latents = self.bench.model.vae.encode(&self.bench.image)?;
        Ok(self.example(latents.detach()))
    }

    fn prior(&self, _: &mut NoiseStream) -> Result<Option<Example>> {
        Ok(self
            .with_prior
            .then(|| self.example(self.bench.latents.clone())))
    }
}
