//! The course of a fine-tuning without its noise: the loss of the same crops, at the same timesteps, with the same noise.
//!
//! The loss of one update hangs on its timestep and its noise far more than on the adapter, so that its mean over a few
//! dozen updates rises or falls by chance.

use std::sync::Arc;

use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};

use crate::error::{Result, argument};
use crate::lora::Lora;
use crate::noise::NoiseStream;
use crate::pass::Pass;
use crate::text_encoder::LearnedTokens;
use crate::training::{Example, LoraTrainer, TrainingData};

/// Keeps these streams apart from those of the updates.
const KEY: u64 = 0x7a11_da7e;

/// What is kept fixed, and what the un-adapted model makes of it.
#[derive(Debug)]
pub struct Validation {
    sets: Vec<Fixed>,
    start: ValidationRow,
}

#[derive(Debug)]
struct Fixed {
    examples: Vec<Example>,
    noisy: Tensor,
    target: Tensor,
    timestep: f64,
    /// Prediction of the un-adapted model, f32.
    unadapted: Tensor,
}

/// The fixed examples' losses after some updates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ValidationRow {
    /// Updates so far.
    pub step: usize,
    /// Mean squared error on the picture.
    pub instance_loss: f64,
    /// Mean squared error on class images, 0 without them.
    pub prior_loss: f64,
    /// How far the adapter moves the prediction under the picture's caption, over the prediction's own size; both as roots
    /// of mean squares.
    pub change: f64,
}

impl Validation {
    /// Draws `count` examples of each kind, their timesteps spread evenly over those of the training. Call it before the
    /// trainer's first update or the resumption of an earlier run. `watch` gets the share that is done, and ends the work
    /// if it returns false.
    pub fn new(
        trainer: &LoraTrainer,
        data: &dyn TrainingData,
        count: usize,
        mut watch: impl FnMut(f64) -> bool,
    ) -> Result<Self> {
        let mut sets = vec![];
        for i in 0..count {
            proceed(&mut watch, i, count)?;
            sets.push(Fixed::draw(trainer, data, i, count)?);
        }
        let mut validation = Self {
            start: ValidationRow {
                step: 0,
                instance_loss: 0.0,
                prior_loss: 0.0,
                change: 0.0,
            },
            sets,
        };
        validation.start = validation.row(0, |_| true, |fixed| Ok(fixed.unadapted.clone()))?;
        Ok(validation)
    }

    /// The losses of the un-adapted model.
    pub fn start(&self) -> ValidationRow {
        self.start
    }

    /// The losses of the adapter as it is now; `watch` as in [`Self::new`].
    pub fn evaluate(
        &self,
        trainer: &LoraTrainer,
        watch: impl FnMut(f64) -> bool,
    ) -> Result<ValidationRow> {
        let lora = Arc::new(trainer.lora().constant(trainer.model.dtype())?);
        let learned = learned(trainer);
        self.row(trainer.steps(), watch, |fixed| {
            let (examples, t) = (&fixed.examples, fixed.timestep);
            predict(
                trainer,
                examples,
                &fixed.noisy,
                t,
                Some(&lora),
                learned.as_ref(),
            )
        })
    }

    fn row(
        &self,
        step: usize,
        mut watch: impl FnMut(f64) -> bool,
        predict: impl Fn(&Fixed) -> Result<Tensor>,
    ) -> Result<ValidationRow> {
        let mean_square = |t: Tensor| -> Result<f64> {
            Ok(t.to_dtype(DType::F64)?.sqr()?.mean_all()?.to_scalar()?)
        };
        let share = 1.0 / self.sets.len().max(1) as f64;
        let mut losses = [0.0; 2];
        let (mut moved, mut size) = (0.0, 0.0);
        for (index, fixed) in self.sets.iter().enumerate() {
            proceed(&mut watch, index, self.sets.len())?;
            let output = predict(fixed)?;
            for i in 0..fixed.examples.len().min(2) {
                losses[i] += mean_square((output.get(i)? - fixed.target.get(i)?)?)? * share;
            }
            moved += mean_square((output.get(0)? - fixed.unadapted.get(0)?)?)?;
            size += mean_square(fixed.unadapted.get(0)?)?;
        }
        Ok(ValidationRow {
            step,
            instance_loss: losses[0],
            prior_loss: losses[1],
            change: (moved / size.max(f64::MIN_POSITIVE)).sqrt(),
        })
    }
}

/// Tells `watch` that `done` of `count` are done; an error if it ends the work.
fn proceed(watch: &mut impl FnMut(f64) -> bool, done: usize, count: usize) -> Result<()> {
    match watch(done as f64 / count as f64) {
        true => Ok(()),
        false => argument("validation was stopped"),
    }
}

impl Fixed {
    fn draw(
        trainer: &LoraTrainer,
        data: &dyn TrainingData,
        index: usize,
        count: usize,
    ) -> Result<Self> {
        let (model, config) = (trainer.model, &trainer.config);
        let mut stream = NoiseStream::new(config.seed ^ KEY, index as u64);
        let mut examples = vec![data.instance(&mut stream)?];
        if config.prior_weight > 0.0 {
            examples.extend(data.prior(&mut stream)?);
        }
        let (low, high) = config.timesteps;
        let share = (index as f64 + 0.5) / count as f64;
        let t = model.schedule.timestep_at(low + (high - low) * share);
        let latents: Vec<&Tensor> = examples.iter().map(|e| &e.latents).collect();
        let latents = Tensor::cat(&latents, 0)?;
        let noise = stream
            .normal_tensor(latents.dims(), DType::F32, model.device())?
            .to_dtype(model.dtype())?;
        let timesteps = vec![t; examples.len()];
        let noisy = model.schedule.add_noise(&latents, &noise, t)?;
        let target = model.schedule.target(&latents, &noise, &timesteps)?;
        let word = learned(trainer);
        Ok(Self {
            unadapted: predict(trainer, &examples, &noisy, t as f64, None, word.as_ref())?,
            target: target.to_dtype(DType::F32)?,
            timestep: t as f64,
            examples,
            noisy,
        })
    }
}

/// The learned word without its gradient.
fn learned(trainer: &LoraTrainer) -> Option<LearnedTokens> {
    let learned = trainer.learned()?;
    Some(LearnedTokens {
        embeddings: learned.embeddings.detach(),
    })
}

fn predict(
    trainer: &LoraTrainer,
    examples: &[Example],
    noisy: &Tensor,
    timestep: f64,
    lora: Option<&Arc<Lora>>,
    learned: Option<&LearnedTokens>,
) -> Result<Tensor> {
    let prompts: Vec<&str> = examples.iter().map(|e| e.prompt.as_str()).collect();
    let context = trainer.model.encode_prompts(&prompts, learned)?;
    let input = trainer.join_conditions(examples, noisy)?;
    let pass = lora.map(Pass::with_lora).unwrap_or_default();
    let output = trainer
        .model
        .unet
        .predict(&input, &[timestep], &context, &pass)?;
    Ok(output.to_dtype(DType::F32)?)
}
