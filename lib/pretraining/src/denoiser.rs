//! The networks of the small model as they are trained, and the losses of a batch.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::schedule::NoiseSchedule;
use dipir_diffusion::text_encoder::TextEncoder;
use dipir_diffusion::tokenizer::Tokenizer;
use dipir_diffusion::unet::UNet;
use dipir_prior::caption::{CLOCK, Caption, HEIGHTS, SKIES};
use dipir_prior::picture::latents_of;
use dipir_prior::text_conditioning::{EncodedCaptions, add_placeholders};

use crate::architecture::Architecture;
use crate::batch::Batch;
use crate::error::{Error, Result};
use crate::examples::AlternativeLight;

/// Text encoder and UNet whose weights are variables.
#[derive(Debug)]
pub struct Denoiser {
    unet: UNet,
    text: TextEncoder,
    tokenizer: Tokenizer,
    pub(crate) schedule: NoiseSchedule,
    variables: BTreeMap<String, Var>,
}

/// Losses of a batch, scalars of the graph.
pub struct Losses {
    /// Weighted mean squared error of the velocity, over examples and those alternatives that have pictures.
    pub velocity: Tensor,
    /// Cross-entropy of the right caption among its alternatives, relative to chance; `None` without alternatives.
    pub contrastive: Option<Tensor>,
}

/// Nats for a mean squared error of 1 of the noise. About the value that minimises the contrastive loss of one draw of
/// noise before contrastive training, 300. Half the number of latent values, 1,500, is far too confident.
const NATS: f64 = 400.0;

/// Weighted squared errors of rows, [rows].
fn errors(output: &Tensor, target: &Tensor, weights: &Tensor) -> Result<Tensor> {
    let error = ((output - target)?.sqr()? * weights)?;
    Ok(error.flatten_from(1)?.sum(1)?)
}

/// A timestep of training. One in four is anywhere, the others are where light can be recognised.
fn draw_timestep(steps: usize, stream: &mut NoiseStream) -> usize {
    let share = if stream.uniform() < 0.25 {
        0.01 + 0.98 * stream.uniform()
    } else {
        0.37 + 0.6 * stream.uniform()
    };
    ((share * steps as f64) as usize).min(steps - 1)
}

/// The UNet's output for the rows of a batch: every example, then the alternatives of the first examples.
struct Rows {
    /// Example of each row.
    example: Vec<u32>,
    timesteps: Vec<usize>,
    noisy: Tensor,
    output: Tensor,
    weights: Tensor,
}

impl Denoiser {
    /// New networks. `folder` holds configurations and tokenizer.
    pub fn new(architecture: &Architecture, folder: &Path, seed: u64) -> Result<Self> {
        let mut tokenizer = Tokenizer::load(&folder.join("tokenizer"))?;
        let vocab = tokenizer.vocab_size();
        add_placeholders(&mut tokenizer);
        let text = TextEncoder::new(
            architecture.text(vocab),
            Parameters::random(seed, &Device::Cpu),
        )?;
        let unet = UNet::new(
            architecture.unet(),
            Parameters::random(seed ^ 0xa11, &Device::Cpu),
        )?;
        let mut variables = BTreeMap::new();
        for (prefix, part) in [("unet.", unet.variables()), ("text.", text.variables())] {
            let named = part
                .iter()
                .map(|(n, v)| (format!("{prefix}{n}"), v.clone()));
            variables.extend(named);
        }
        let denoiser = Self {
            unet,
            text,
            tokenizer,
            schedule: NoiseSchedule::new(architecture.schedule())?,
            variables,
        };
        denoiser.initialise()?;
        Ok(denoiser)
    }

    /// Initialises residual branches to 0, and embeddings of words on a scale in the order of the scale.
    fn initialise(&self) -> Result<()> {
        for (name, variable) in &self.variables {
            let ends = [
                ".conv2.weight",
                ".conv2.bias",
                ".proj_out.weight",
                ".proj_out.bias",
            ];
            if ends.iter().any(|e| name.ends_with(e)) || name.starts_with("unet.conv_out.") {
                variable.set(&variable.zeros_like()?)?;
            }
        }
        let name = "text.text_model.embeddings.token_embedding.weight";
        let Some(table) = self.variables.get(name) else {
            return Err(Error::Argument(format!("the text encoder has no {name}")));
        };
        let width = table.dims()[1];
        let mut rows = table.to_vec2::<f32>()?;
        let scale = 0.15;
        let mut place = |word: &str, at: usize, values: &[f32]| -> Result<()> {
            if let [id] = self.tokenizer.words(word)?[..] {
                for (i, v) in values.iter().enumerate() {
                    if at + i < width {
                        rows[id as usize][at + i] += scale * v;
                    }
                }
            }
            Ok(())
        };
        for (hour, word) in CLOCK.iter().enumerate() {
            let a = hour as f32 / 12.0 * std::f32::consts::TAU;
            let harmonics = [a.cos(), a.sin(), (2.0 * a).cos(), (2.0 * a).sin()];
            place(word, 0, &harmonics)?;
        }
        for (scale, at) in [(HEIGHTS, 4), (SKIES, 6)] {
            for (i, (word, _)) in scale.iter().enumerate() {
                let x = i as f32 - 1.0;
                place(word, at, &[x, x * x - 0.5])?;
            }
        }
        table.set(&Tensor::new(rows, &Device::Cpu)?)?;
        Ok(())
    }

    /// All variables by name.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// The losses of a batch under noise from `stream`.
    pub fn loss(&self, batch: &Batch, stream: &mut NoiseStream) -> Result<Losses> {
        let count = batch.latents.dims()[0];
        let steps = self.schedule.len();
        let contrasted = batch.alternatives.len();
        let timesteps: Vec<usize> = (0..count)
            .map(|i| match i < contrasted || batch.relit[i] {
                true => ((0.4 + 0.5 * stream.uniform()) * steps as f64) as usize,
                false => draw_timestep(steps, stream),
            })
            .collect();
        let noise = stream.normal_tensor(batch.latents.dims(), DType::F32, &Device::Cpu)?;
        let rows = self.rows(batch, timesteps, &noise)?;
        // The target's velocity: the noise that leads from the target to the noisy latents, which for a relit example
        // includes the difference of the two lights.
        let noisy = rows.noisy.narrow(0, 0, count)?;
        let noise = self
            .schedule
            .noise_between_each(&batch.latents, &noisy, &rows.timesteps)?;
        let target = self
            .schedule
            .target(&batch.latents, &noise, &rows.timesteps)?;
        let index = Tensor::new(rows.example.as_slice(), &Device::Cpu)?;
        let target = target.index_select(&index, 0)?;
        let error = errors(&rows.output, &target, &rows.weights)?;
        let mut sum = error.narrow(0, 0, count)?.sum_all()?;
        let mut total = batch.weights.sum_all()?;
        if let Some((of_alternatives, weights)) = self.alternatives_error(batch, &rows)? {
            sum = (sum + of_alternatives)?;
            total = (total + weights)?;
        }
        Ok(Losses {
            velocity: sum.div(&total)?,
            contrastive: match contrasted {
                0 => None,
                _ => Some(self.contrastive_loss(batch, &rows, &error)?),
            },
        })
    }

    /// The UNet's output for all captions of a batch.
    fn rows(&self, batch: &Batch, timesteps: Vec<usize>, noise: &Tensor) -> Result<Rows> {
        let noisy = self
            .schedule
            .add_noise_each(&batch.noised, noise, &timesteps)?;
        let repeated = batch.alternatives.iter().enumerate();
        let example: Vec<u32> = (0..batch.captions.len() as u32)
            .chain(repeated.flat_map(|(i, a)| vec![i as u32; a.len()]))
            .collect();
        let alternatives = batch.alternatives.iter().flatten();
        let captions: Vec<Option<Caption>> = batch
            .captions
            .iter()
            .cloned()
            .chain(alternatives.map(|a| Some(a.caption.clone())))
            .collect();
        let t: Vec<f64> = example
            .iter()
            .map(|&i| timesteps[i as usize] as f64)
            .collect();
        let index = Tensor::new(example.as_slice(), &Device::Cpu)?;
        let input = batch.condition.join(&noisy)?.index_select(&index, 0)?;
        let context = EncodedCaptions::new(&self.tokenizer, &captions)?.states(&self.text)?;
        Ok(Rows {
            output: self.unet.forward(&input, &t, &context, &Pass::default())?,
            noisy: noisy.index_select(&index, 0)?,
            weights: batch.weights.index_select(&index, 0)?,
            example,
            timesteps,
        })
    }

    /// Summed error of the velocity of the alternatives that have pictures, and their summed weights; `None` if none has.
    fn alternatives_error(&self, batch: &Batch, rows: &Rows) -> Result<Option<(Tensor, Tensor)>> {
        let count = batch.captions.len();
        let alternatives: Vec<&AlternativeLight> = batch.alternatives.iter().flatten().collect();
        let pictured: Vec<usize> = (0..alternatives.len())
            .filter(|&i| alternatives[i].image.is_some())
            .map(|i| count + i)
            .collect();
        if pictured.is_empty() {
            return Ok(None);
        }
        let index: Vec<u32> = pictured.iter().map(|&row| row as u32).collect();
        let index = Tensor::new(index, &Device::Cpu)?;
        let select = |t: &Tensor| t.index_select(&index, 0);
        let timesteps: Vec<usize> = pictured
            .iter()
            .map(|&row| rows.timesteps[rows.example[row] as usize])
            .collect();
        let pictures = alternatives.iter().filter_map(|a| a.image.as_ref());
        let latents = latents_of(pictures.flatten().copied().collect())?;
        let noise =
            self.schedule
                .noise_between_each(&latents, &select(&rows.noisy)?, &timesteps)?;
        let target = self.schedule.target(&latents, &noise, &timesteps)?;
        let weights = select(&rows.weights)?;
        let error = errors(&select(&rows.output)?, &target, &weights)?;
        Ok(Some((error.sum_all()?, weights.sum_all()?)))
    }

    /// Cross-entropy of the right captions, where the logits are minus the mean errors of the noise in nats, relative to
    /// chance. `error` is that of the velocity towards the picture under noise, by row.
    fn contrastive_loss(&self, batch: &Batch, rows: &Rows, error: &Tensor) -> Result<Tensor> {
        let count = batch.captions.len();
        let contrasted = batch.alternatives.len();
        let alternatives = rows.example.len() - count;
        let weights = batch.weights.flatten_from(1)?.sum(1)?;
        let weights = weights.narrow(0, 0, contrasted)?.to_vec1::<f32>()?;
        let scales: Vec<f32> = (0..contrasted)
            .map(|i| {
                let alpha = self.schedule.alpha_bar(rows.timesteps[i])?;
                Ok((NATS * alpha) as f32 / weights[i])
            })
            .collect::<Result<_>>()?;
        let scales = Tensor::from_vec(scales, (contrasted, 1), &Device::Cpu)?;
        let right = error.narrow(0, 0, contrasted)?.unsqueeze(1)?;
        let wrong = error.narrow(0, count, alternatives)?;
        let wrong = wrong.reshape((contrasted, ()))?;
        let logits = (Tensor::cat(&[&right, &wrong], 1)?.broadcast_mul(&scales)?).neg()?;
        let nats = (logits.log_sum_exp(1)? - logits.narrow(1, 0, 1)?.squeeze(1)?)?;
        let chance = (1.0 + alternatives as f64 / contrasted as f64).ln();
        Ok((nats.mean_all()? / chance)?)
    }
}

#[cfg(test)]
#[path = "denoiser_tests.rs"]
mod tests;
