//! Training of the diffusion model: AdamW on batches of random examples, a moving average of the weights, checkpoints.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::config::ConfigFile;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::optimizer::{AdamW, AdamWConfig};
use dipir_diffusion::unet::UNetConfig;
use dipir_diffusion::weights::{Weights, write_safetensors};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::architecture::{Architecture, WEIGHT_FILES};
use crate::batch::Batch;
use crate::data_parallel::{PARTS, Workers, mean_gradients};
use crate::dataset::Dataset;
use crate::denoiser::Denoiser;
use crate::error::{Error, Result};
use crate::examples::{Example, Recipe};

/// Settings of a training run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrainerSettings {
    /// Examples of the whole run, over which the learning rate falls to 0.
    pub samples: usize,
    /// Examples of an update. With a contrastive loss an alternative counts as an example.
    pub batch: usize,
    /// Learning rate after the warm-up.
    pub learning_rate: f64,
    /// Key of all random numbers.
    pub seed: u64,
    /// Weight of the contrastive loss; at 0 there are no alternatives.
    #[serde(default)]
    pub contrast: f64,
}

impl Default for TrainerSettings {
    fn default() -> Self {
        Self {
            samples: 400_000,
            batch: 64,
            learning_rate: 5e-4,
            seed: 1,
            contrast: 0.0,
        }
    }
}

/// Alternative captions of an example that has any.
const ALTERNATIVES: usize = 3;
/// Examples with alternatives in a part of `rows` rows: they and their alternatives are three rows of four.
fn contrasted_of(rows: usize) -> usize {
    rows * 3 / 4 / (ALTERNATIVES + 1)
}

/// Weights [outputs, inputs, 1, 1] of a convolution whose outputs are its first inputs.
fn first_channels(shape: &[usize]) -> Result<Tensor> {
    let (outputs, inputs) = (shape[0], shape[1]);
    let mut values = vec![0f32; outputs * inputs];
    for channel in 0..outputs.min(inputs) {
        values[channel * inputs + channel] = 1.0;
    }
    Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
}

/// Initialises a variable of a new residual block so that the block passes on its first inputs. Its residual branch is
/// 0 already.
fn start_as_identity(name: &str, variable: &Var) -> Result<()> {
    if name.ends_with(".conv_shortcut.weight") {
        variable.set(&first_channels(variable.dims())?)?;
    } else if name.ends_with(".conv_shortcut.bias") {
        variable.set(&variable.zeros_like()?)?;
    }
    Ok(())
}

/// Updates of the warm-up, over which the learning rate rises.
const WARMUP: f64 = 200.0;

/// Results of one update.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// Examples so far.
    pub seen: usize,
    /// Velocity loss of the batch.
    pub loss: f64,
    /// Contrastive loss of the batch, 1 at chance and 0 at best; NaN without alternatives.
    pub contrastive_loss: f64,
}

/// Results of a part of a batch.
struct PartialBatch {
    gradients: BTreeMap<String, Tensor>,
    loss: f64,
    contrastive_loss: f64,
}

/// A training run.
pub struct Trainer {
    architecture: Architecture,
    settings: TrainerSettings,
    recipe: Recipe,
    denoiser: Denoiser,
    optimizer: AdamW,
    average: BTreeMap<String, Tensor>,
    workers: Workers,
}

impl Trainer {
    /// A new run. `folder` holds configurations and tokenizer.
    pub fn new(
        architecture: &Architecture,
        folder: &Path,
        settings: TrainerSettings,
        recipe: Recipe,
    ) -> Result<Self> {
        if settings.batch == 0 || !settings.batch.is_multiple_of(PARTS) {
            return Err(Error::Argument(format!(
                "batch = {}: accepted are even numbers from {PARTS}",
                settings.batch
            )));
        }
        if settings.contrast > 0.0 && contrasted_of(settings.batch / PARTS) == 0 {
            return Err(Error::Argument(format!(
                "batch = {}: with a contrastive loss, accepted are even numbers from {}",
                settings.batch,
                PARTS * (ALTERNATIVES + 1) * 3 / 2
            )));
        }
        let denoiser = Denoiser::new(architecture, folder, settings.seed)?;
        let config = AdamWConfig {
            beta1: 0.9,
            beta2: 0.99,
            weight_decay: 0.01,
            ..AdamWConfig::default()
        };
        let optimizer = AdamW::new(denoiser.variables(), config)?;
        let average = denoiser
            .variables()
            .iter()
            .map(|(n, v)| Ok((n.clone(), v.as_detached_tensor().copy()?)))
            .collect::<Result<_>>()?;
        Ok(Self {
            architecture: architecture.clone(),
            settings,
            recipe,
            denoiser,
            optimizer,
            average,
            workers: Workers::new()?,
        })
    }

    /// Examples so far.
    pub fn seen(&self) -> usize {
        self.optimizer.steps() as usize * self.settings.batch
    }

    /// The averaged weights by name.
    pub fn average(&self) -> &BTreeMap<String, Tensor> {
        &self.average
    }

    fn learning_rate(&self) -> f64 {
        let step = self.optimizer.steps() as f64;
        let done = self.seen() as f64 / self.settings.samples.max(1) as f64;
        let rise = ((step + 1.0) / WARMUP).min(1.0);
        let fall = 0.5 * (1.0 + (std::f64::consts::PI * done.min(1.0)).cos());
        self.settings.learning_rate * rise * fall.max(0.005)
    }

    /// One update on examples of `data`.
    pub fn step(&mut self, data: &Dataset) -> Result<Update> {
        let step = self.optimizer.steps();
        let parts = self.workers.run(|part| self.part(data, step, part))?;
        let mut gradients = vec![];
        let (mut loss, mut contrastive_loss) = (0.0, 0.0);
        for part in parts {
            loss += part.loss / PARTS as f64;
            contrastive_loss += part.contrastive_loss / PARTS as f64;
            gradients.push(part.gradients);
        }
        // All parts have all gradients, because `collect` fails otherwise.
        let gradients = mean_gradients(&gradients)?;
        let rate = self.learning_rate();
        self.optimizer.step(&gradients, 1.0, |_| rate)?;
        let step = self.optimizer.steps() as f64;
        let keep = (1.0 - 1.0 / (0.1 * step + 2.0)).min(0.999);
        let variables = self.denoiser.variables();
        self.average
            .par_iter_mut()
            .try_for_each(|(name, average)| {
                // Detached, because the average would keep the graph of every update.
                let value = variables[name].as_detached_tensor();
                *average = ((&*average * keep)? + (value * (1.0 - keep))?)?.detach();
                Ok::<_, Error>(())
            })?;
        Ok(Update {
            seen: self.seen(),
            loss,
            contrastive_loss,
        })
    }

    /// Losses and gradients of one part of the batch.
    fn part(&self, data: &Dataset, step: u64, part: usize) -> Result<PartialBatch> {
        let key = step * PARTS as u64 + part as u64;
        let mut stream = NoiseStream::new(self.settings.seed ^ 0x7eac4, key);
        let rows = self.settings.batch / PARTS;
        let contrasted = match self.settings.contrast > 0.0 {
            true => contrasted_of(rows),
            false => 0,
        };
        let plain = rows - contrasted * (ALTERNATIVES + 1);
        let contrastive = self.recipe.contrastive(ALTERNATIVES);
        let examples = (0..contrasted + plain)
            .map(|i| {
                let scene = data.scene(stream.below(data.len()));
                let recipe = match i < contrasted {
                    true => &contrastive,
                    false => &self.recipe,
                };
                Example::draw(scene, recipe, &mut stream)
            })
            .collect();
        let losses = self.denoiser.loss(&Batch::new(examples)?, &mut stream)?;
        let value = |t: &Tensor| -> Result<f64> { Ok(t.to_scalar::<f32>()? as f64) };
        let mut total = losses.velocity.clone();
        let mut contrastive_loss = f64::NAN;
        if let Some(contrastive) = &losses.contrastive {
            total = (total + (contrastive * self.settings.contrast)?)?;
            contrastive_loss = value(contrastive)?;
        }
        Ok(PartialBatch {
            gradients: self.optimizer.collect(&total.backward()?)?,
            loss: value(&losses.velocity)?,
            contrastive_loss,
        })
    }

    /// Trains to the end. `report` is called after every update and may stop the run.
    pub fn run(
        &mut self,
        data: &Dataset,
        report: &mut dyn FnMut(&Self, &Update) -> Result<ControlFlow<()>>,
    ) -> Result<()> {
        while self.seen() < self.settings.samples {
            let update = self.step(data)?;
            if report(self, &update)?.is_break() {
                break;
            }
        }
        Ok(())
    }

    /// Writes a checkpoint: all that a resumed run needs.
    pub fn save(&self, path: &Path) -> Result<()> {
        let mut tensors = self.optimizer.state();
        for (name, tensor) in &self.average {
            tensors.insert(format!("average.{name}"), tensor.clone());
        }
        let metadata = BTreeMap::from([
            ("steps".to_owned(), self.optimizer.steps().to_string()),
            ("layers".to_owned(), self.architecture.layers.to_string()),
            (
                "settings".to_owned(),
                serde_json::json!(self.settings).to_string(),
            ),
        ]);
        Ok(write_safetensors(path, &tensors, &metadata)?)
    }

    /// Starts from the weights of the model in `folder`, which has the same architecture or fewer layers. Added layers
    /// start as the identity, so that both models have the same output.
    pub fn start_from(&mut self, folder: &Path) -> Result<()> {
        let config = ConfigFile::read(&folder.join("unet/config.json"))?;
        let before = UNetConfig::from_file(&config)?.layers_per_block;
        let now = self.architecture.layers;
        if before > now {
            return Err(Error::Content {
                path: config.path().to_owned(),
                message: format!(
                    "layers_per_block is {before}, this run's {now}; accepted are models of as many or fewer"
                ),
            });
        }
        for (prefix, file) in WEIGHT_FILES {
            let path = folder.join(file);
            let weights = Weights::open_file(&path)?;
            for (name, variable) in self.denoiser.variables() {
                let Some(inner) = name.strip_prefix(prefix) else {
                    continue;
                };
                let inner = match prefix {
                    "unet." => self.architecture.name_before(inner, before),
                    _ => Some(inner.to_owned()),
                };
                let Some(inner) = inner else {
                    start_as_identity(name, variable)?;
                    let value = variable.as_detached_tensor().copy()?;
                    self.average.insert(name.clone(), value);
                    continue;
                };
                let value = weights.tensor(&inner, DType::F32, &Device::Cpu)?;
                let value = value.ok_or_else(|| Error::Content {
                    path: path.clone(),
                    message: format!("{inner} is missing"),
                })?;
                if value.dims() != variable.dims() {
                    return Err(Error::Content {
                        path: path.clone(),
                        message: format!(
                            "{inner} has the shape {:?}, this run's {:?}",
                            value.dims(),
                            variable.dims()
                        ),
                    });
                }
                variable.set(&value)?;
                self.average.insert(name.clone(), value);
            }
        }
        Ok(())
    }

    /// Continues from a checkpoint of [`Trainer::save`].
    pub fn resume(&mut self, path: &Path) -> Result<()> {
        let weights = Weights::open_file(path)?;
        let fail = |message: String| Error::Content {
            path: path.to_owned(),
            message,
        };
        let found = weights
            .metadata()
            .get("settings")
            .cloned()
            .unwrap_or_default();
        let expected = serde_json::json!(self.settings).to_string();
        // The length of a run and the weight of the contrastive loss may change on the way.
        let made = serde_json::from_str::<TrainerSettings>(&found).ok();
        let made = made.map(|made| TrainerSettings {
            samples: self.settings.samples,
            contrast: self.settings.contrast,
            ..made
        });
        if made != Some(self.settings) {
            return Err(fail(format!(
                "the checkpoint was made with {found}, this run has {expected}; delete it or use its settings"
            )));
        }
        // In a UNet of another depth, the same name is another block. Checkpoints without the number have one block a
        // level.
        let layers = weights.metadata().get("layers");
        let layers = layers.map_or("1", String::as_str);
        if layers != self.architecture.layers.to_string() {
            return Err(fail(format!(
                "the checkpoint has {layers} residual blocks a level, this run {}; use as many (--layers {layers}), or delete it",
                self.architecture.layers
            )));
        }
        let steps = weights.metadata().get("steps").and_then(|s| s.parse().ok());
        let steps = steps.ok_or_else(|| fail("the number of steps is missing".into()))?;
        let get = |name: &str| weights.tensor(name, DType::F32, &Device::Cpu);
        self.optimizer.restore(steps, get).map_err(&fail)?;
        for (name, tensor) in &mut self.average {
            *tensor = get(&format!("average.{name}"))?
                .ok_or_else(|| fail(format!("average.{name} is missing")))?;
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "trainer_tests.rs"]
mod tests;
