//! Pretraining: AdamW on batches of drawn examples, an average of the
//! weights, checkpoints.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::config::ConfigFile;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::optimizer::{AdamW, AdamWConfig};
use dipir_diffusion::unet::UNetConfig;
use dipir_diffusion::weights::{Weights, write_safetensors};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::blueprint::{Blueprint, WEIGHT_FILES};
use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::examples::{Example, Recipe};
use crate::shards::{SHARDS, Shards, mean_gradients};
use crate::student::{Batch, Student};

/// Settings of a training run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrainerSettings {
    /// Examples in all; the learning rate falls to 0 over them.
    pub samples: usize,
    /// Examples of an update.
    pub batch: usize,
    /// Learning rate after the warm-up.
    pub learning_rate: f64,
    /// Key of all random numbers.
    pub seed: u64,
    /// Weight of telling the right light from wrong ones; 0: it is not asked.
    #[serde(default)]
    pub contrast: f64,
    /// Weight of naming the light that is seen, from the middle of the UNet; 0: it is not asked.
    #[serde(default)]
    pub naming: f64,
}

impl Default for TrainerSettings {
    fn default() -> Self {
        Self {
            samples: 400_000,
            batch: 64,
            learning_rate: 5e-4,
            seed: 1,
            contrast: 0.0,
            naming: 0.0,
        }
    }
}

/// Wrong captions beside a right one, where lights are contrasted.
const RIVALS: usize = 3;
/// Examples that are contrasted in a part of so many rows: three rows in four.
fn contrasted_in(rows: usize) -> usize {
    rows * 3 / 4 / (RIVALS + 1)
}

/// Weights [outputs, inputs, 1, 1] of a convolution that passes its first inputs on.
fn first_channels(shape: &[usize]) -> Result<Tensor> {
    let (outputs, inputs) = (shape[0], shape[1]);
    let mut values = vec![0f32; outputs * inputs];
    for channel in 0..outputs.min(inputs) {
        values[channel * inputs + channel] = 1.0;
    }
    Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
}

/// Updates over which the learning rate rises.
const WARMUP: f64 = 200.0;

/// What one update did.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// Examples so far.
    pub seen: usize,
    /// Loss of this batch.
    pub loss: f64,
    /// Surprise at the right light among wrong ones: 1 at chance, 0 if it is known; NaN if it is not
    /// asked.
    pub surprise: f64,
    /// Mean squared error of the named direction; NaN if it is not asked.
    pub naming: f64,
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Seconds that it took.
    pub seconds: f64,
}

/// What a part of a batch gave.
struct Shard {
    gradients: BTreeMap<String, Tensor>,
    loss: f64,
    surprise: f64,
    naming: f64,
}

/// A training run.
pub struct Trainer {
    blueprint: Blueprint,
    settings: TrainerSettings,
    recipe: Recipe,
    student: Student,
    optimizer: AdamW,
    average: BTreeMap<String, Tensor>,
    shards: Shards,
}

impl Trainer {
    /// Starts afresh; `folder` holds configurations and tokenizer.
    pub fn new(
        blueprint: &Blueprint,
        folder: &Path,
        settings: TrainerSettings,
        recipe: Recipe,
    ) -> Result<Self> {
        if settings.batch == 0 || !settings.batch.is_multiple_of(SHARDS) {
            return Err(Error::Argument(format!(
                "batch = {}: accepted are even numbers from {SHARDS}",
                settings.batch
            )));
        }
        if settings.contrast > 0.0 && contrasted_in(settings.batch / SHARDS) == 0 {
            return Err(Error::Argument(format!(
                "batch = {}: to contrast lights, accepted are even numbers from {}",
                settings.batch,
                SHARDS * (RIVALS + 1) * 3 / 2
            )));
        }
        let mut student = Student::new(blueprint, folder, settings.seed)?;
        if settings.naming > 0.0 {
            student = student.with_naming(settings.seed)?;
        }
        let config = AdamWConfig {
            beta1: 0.9,
            beta2: 0.99,
            weight_decay: 0.01,
            ..AdamWConfig::default()
        };
        let optimizer = AdamW::new(student.variables(), config)?;
        let average = student
            .variables()
            .iter()
            .map(|(n, v)| Ok((n.clone(), v.as_detached_tensor().copy()?)))
            .collect::<Result<_>>()?;
        Ok(Self {
            blueprint: blueprint.clone(),
            settings,
            recipe,
            student,
            optimizer,
            average,
            shards: Shards::new()?,
        })
    }

    /// Examples so far.
    pub fn seen(&self) -> usize {
        self.optimizer.steps() as usize * self.settings.batch
    }

    /// The averaged weights, by name.
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

    /// One update from `data`.
    pub fn step(&mut self, data: &Dataset) -> Result<Update> {
        let start = Instant::now();
        let step = self.optimizer.steps();
        let shards = self.shards.run(|shard| self.shard(data, step, shard))?;
        let mut gradients = vec![];
        let (mut loss, mut surprise, mut naming) = (0.0, 0.0, 0.0);
        for shard in shards {
            loss += shard.loss / SHARDS as f64;
            surprise += shard.surprise / SHARDS as f64;
            naming += shard.naming / SHARDS as f64;
            gradients.push(shard.gradients);
        }
        // Every shard has every gradient, or `collect` had failed.
        let gradients = mean_gradients(&gradients)?;
        let rate = self.learning_rate();
        let gradient_norm = self.optimizer.step(&gradients, 1.0, |_| rate)?;
        let step = self.optimizer.steps() as f64;
        let keep = (1.0 - 1.0 / (0.1 * step + 2.0)).min(0.999);
        let variables = self.student.variables();
        self.average
            .par_iter_mut()
            .try_for_each(|(name, average)| {
                // Detached, or the average would hold the graph of every update.
                let value = variables[name].as_detached_tensor();
                *average = ((&*average * keep)? + (value * (1.0 - keep))?)?.detach();
                Ok::<_, Error>(())
            })?;
        Ok(Update {
            seen: self.seen(),
            loss,
            surprise,
            naming,
            gradient_norm,
            seconds: start.elapsed().as_secs_f64(),
        })
    }

    fn shard(&self, data: &Dataset, step: u64, shard: usize) -> Result<Shard> {
        let key = step * SHARDS as u64 + shard as u64;
        let mut stream = NoiseStream::new(self.settings.seed ^ 0x7eac4, key);
        let rows = self.settings.batch / SHARDS;
        let contrasted = match self.settings.contrast > 0.0 {
            true => contrasted_in(rows),
            false => 0,
        };
        let plain = rows - contrasted * (RIVALS + 1);
        let contrasting = self.recipe.contrasted(RIVALS);
        let examples = (0..contrasted + plain)
            .map(|i| {
                let scene = data.scene(stream.below(data.len()));
                let recipe = match i < contrasted {
                    true => &contrasting,
                    false => &self.recipe,
                };
                Example::draw(scene, recipe, &mut stream)
            })
            .collect();
        let losses = self.student.loss(&Batch::new(examples)?, &mut stream)?;
        let value = |t: &Tensor| -> Result<f64> { Ok(t.to_scalar::<f32>()? as f64) };
        let mut whole = losses.velocity.clone();
        let settings = &self.settings;
        for (part, weight) in [
            (&losses.surprise, settings.contrast),
            (&losses.naming, settings.naming),
        ] {
            if let Some(part) = part {
                whole = (whole + (part * weight)?)?;
            }
        }
        let asked = |part: &Option<Tensor>| part.as_ref().map_or(Ok(f64::NAN), value);
        Ok(Shard {
            gradients: self.optimizer.collect(&whole.backward()?)?,
            loss: value(&losses.velocity)?,
            surprise: asked(&losses.surprise)?,
            naming: asked(&losses.naming)?,
        })
    }

    /// Trains to the end; `report` sees every update and may stop.
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

    /// Writes everything that a resumed run needs.
    pub fn save(&self, path: &Path) -> Result<()> {
        let mut tensors = self.optimizer.state();
        for (name, tensor) in &self.average {
            tensors.insert(format!("average.{name}"), tensor.clone());
        }
        let metadata = BTreeMap::from([
            ("steps".to_owned(), self.optimizer.steps().to_string()),
            ("layers".to_owned(), self.blueprint.layers.to_string()),
            (
                "settings".to_owned(),
                serde_json::json!(self.settings).to_string(),
            ),
        ]);
        Ok(write_safetensors(path, &tensors, &metadata)?)
    }

    /// Starts from the weights of the model in `folder`, of the same blueprint or one with fewer layers: then the others
    /// pass on what they are given, so that this model says what that one says.
    pub fn start_from(&mut self, folder: &Path) -> Result<()> {
        let config = ConfigFile::read(&folder.join("unet/config.json"))?;
        let before = UNetConfig::from_file(&config)?.layers_per_block;
        let now = self.blueprint.layers;
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
            for (name, variable) in self.student.variables() {
                let Some(inner) = name.strip_prefix(prefix) else {
                    continue;
                };
                let inner = match prefix {
                    "unet." => self.blueprint.name_before(inner, before),
                    _ => Some(inner.to_owned()),
                };
                let Some(inner) = inner else {
                    if name.ends_with(".conv_shortcut.weight") {
                        variable.set(&first_channels(variable.dims())?)?;
                    } else if name.ends_with(".conv_shortcut.bias") {
                        variable.set(&variable.zeros_like()?)?;
                    }
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

    /// Goes on from what [`Trainer::save`] wrote.
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
        // A run may be made longer or shorter on the way, and learn to tell lights apart late.
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
        // Blocks of the same name are others in a UNet of another depth. Checkpoints from before had one a level.
        let layers = weights.metadata().get("layers");
        let layers = layers.map_or("1", String::as_str);
        if layers != self.blueprint.layers.to_string() {
            return Err(fail(format!(
                "the checkpoint has {layers} residual blocks a level, this run {}; use as many (--layers {layers}), or delete it",
                self.blueprint.layers
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
mod tests {
    use super::*;
    use crate::dataset::{DatasetSettings, Places};
    use crate::studio::Kinds;

    fn scenes(folder: &Path) -> Dataset {
        let settings = DatasetSettings {
            seed: 5,
            scenes: 1,
            places: Places::Objects,
            kinds: Kinds::Trained,
        };
        Dataset::make(folder, &settings, &mut |_| ControlFlow::Continue(()))
            .unwrap()
            .unwrap()
    }

    fn small(folder: &Path, samples: usize) -> Trainer {
        let blueprint = Blueprint {
            channels: vec![8, 16],
            layers: 1,
            text_width: 16,
        };
        blueprint.write_configs(folder).unwrap();
        let settings = TrainerSettings {
            samples,
            batch: 4,
            learning_rate: 1e-3,
            seed: 2,
            contrast: 0.0,
            naming: 0.0,
        };
        Trainer::new(&blueprint, folder, settings, Recipe::default()).unwrap()
    }

    fn train(trainer: &mut Trainer, data: &Dataset, until: usize) {
        let mut watch = |_: &Trainer, update: &Update| {
            Ok(match update.seen < until {
                true => ControlFlow::Continue(()),
                false => ControlFlow::Break(()),
            })
        };
        trainer.run(data, &mut watch).unwrap();
    }

    #[test]
    fn a_training_that_was_stopped_ends_in_the_same_weights() {
        let folder = tempfile::tempdir().unwrap();
        let data = scenes(&folder.path().join("scenes"));
        let checkpoint = folder.path().join("checkpoint.safetensors");
        let mut whole = small(folder.path(), 24);
        train(&mut whole, &data, 24);
        let mut first = small(folder.path(), 24);
        train(&mut first, &data, 12);
        first.save(&checkpoint).unwrap();
        let mut second = small(folder.path(), 24);
        second.resume(&checkpoint).unwrap();
        assert_eq!(second.seen(), 12);
        train(&mut second, &data, 24);
        let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let mut moved = 0.0f32;
        for (name, tensor) in whole.average() {
            assert!(values(tensor) == values(&second.average()[name]), "{name}");
            let before = values(&first.average()[name]);
            let change = values(tensor)
                .into_iter()
                .zip(before)
                .map(|(a, b)| (a - b).abs());
            moved = change.fold(moved, f32::max);
        }
        assert!(moved > 1e-6, "the second half did something: {moved}");

        // A checkpoint of another run is not taken for this one's.
        let mut other = small(folder.path(), 24);
        other.settings.seed = 3;
        let error = other.resume(&checkpoint).unwrap_err().to_string();
        assert!(error.contains("\"seed\":3"), "{error}");
    }

    #[test]
    fn lights_can_be_contrasted_from_the_middle_of_a_run_on() {
        let folder = tempfile::tempdir().unwrap();
        let data = scenes(&folder.path().join("scenes"));
        let checkpoint = folder.path().join("checkpoint.safetensors");
        let batch = |trainer: &mut Trainer, contrast: f64| {
            trainer.settings = TrainerSettings {
                batch: 12,
                contrast,
                ..trainer.settings
            };
        };
        let mut plain = small(folder.path(), 48);
        batch(&mut plain, 0.0);
        assert!(plain.step(&data).unwrap().surprise.is_nan());
        plain.save(&checkpoint).unwrap();
        let mut later = small(folder.path(), 48);
        batch(&mut later, 0.5);
        later.resume(&checkpoint).unwrap();
        assert_eq!(later.seen(), 12);
        // After one step at a rising rate it knows next to nothing.
        let surprise = later.step(&data).unwrap().surprise;
        assert!((surprise - 1.0).abs() < 0.05, "{surprise}");

        let blueprint = Blueprint {
            channels: vec![8, 16],
            layers: 1,
            text_width: 16,
        };
        let settings = TrainerSettings {
            batch: 10,
            ..later.settings
        };
        let refused = Trainer::new(&blueprint, folder.path(), settings, Recipe::default());
        let error = refused.err().unwrap().to_string();
        assert!(error.contains("even numbers from 12"), "{error}");
    }

    #[test]
    fn what_names_the_light_is_trained_and_left_out_of_the_model() {
        let folder = tempfile::tempdir().unwrap();
        let data = scenes(&folder.path().join("scenes"));
        let checkpoint = folder.path().join("checkpoint.safetensors");
        let plain = small(folder.path(), 1200);
        let settings = TrainerSettings {
            batch: 12,
            contrast: 0.5,
            naming: 1.0,
            ..plain.settings
        };
        let new = |settings: TrainerSettings| {
            Trainer::new(&plain.blueprint, folder.path(), settings, Recipe::default()).unwrap()
        };
        let mut naming = new(settings);
        let errors: Vec<f64> = (0..40)
            .map(|_| naming.step(&data).unwrap().naming)
            .collect();
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        // Suns are all around, so that nothing is an answer to begin with; then it is worth something.
        let (early, late) = (mean(&errors[..10]), mean(&errors[30..]));
        assert!(late < early, "{early} {late}");

        naming.save(&checkpoint).unwrap();
        new(settings).resume(&checkpoint).unwrap();
        let other = TrainerSettings {
            naming: 0.0,
            ..settings
        };
        let error = new(other).resume(&checkpoint).unwrap_err().to_string();
        assert!(error.contains("\"naming\":1.0"), "{error}");

        naming
            .blueprint
            .write_weights(folder.path(), naming.average())
            .unwrap();
        let unet = Weights::open_file(&folder.path().join(WEIGHT_FILES[0].1)).unwrap();
        let inner = |name: &str| name.strip_prefix("unet.").map(str::to_owned);
        let wanted: Vec<String> = plain
            .student
            .variables()
            .keys()
            .filter_map(|n| inner(n))
            .collect();
        assert!(unet.names().eq(wanted.iter().map(String::as_str)));
        assert!(
            plain
                .student
                .variables()
                .keys()
                .all(|n| !n.starts_with("naming."))
        );
        new(other).start_from(folder.path()).unwrap();
    }

    #[test]
    fn a_run_starts_from_the_weights_of_a_model_of_its_shape() {
        let folder = tempfile::tempdir().unwrap();
        let blueprint = Blueprint {
            channels: vec![8, 16],
            layers: 1,
            text_width: 16,
        };
        let first = small(folder.path(), 24);
        blueprint
            .write_weights(folder.path(), first.average())
            .unwrap();
        let settings = TrainerSettings {
            seed: 9,
            ..first.settings
        };
        let mut second =
            Trainer::new(&blueprint, folder.path(), settings, Recipe::default()).unwrap();
        second.start_from(folder.path()).unwrap();
        let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (name, variable) in second.student.variables() {
            let wanted = values(&first.average()[name]);
            // Stored in half precision.
            for (found, wanted) in values(variable).into_iter().zip(wanted) {
                assert!(
                    (found - wanted).abs() <= 1e-3 * wanted.abs() + 1e-6,
                    "{name}"
                );
            }
            assert_eq!(values(variable), values(&second.average()[name]));
        }

        let other = tempfile::tempdir().unwrap();
        let wider = Blueprint {
            channels: vec![8, 24],
            ..blueprint
        };
        wider.write_configs(other.path()).unwrap();
        let mut third = Trainer::new(&wider, other.path(), settings, Recipe::default()).unwrap();
        let error = third.start_from(folder.path()).unwrap_err().to_string();
        assert!(error.contains("has the shape"), "{error}");
        let error = third.start_from(other.path()).unwrap_err().to_string();
        assert!(error.contains("diffusion_pytorch_model"), "{error}");
    }

    #[test]
    fn a_deeper_model_begins_as_the_one_that_it_is_grown_from() {
        let folder = tempfile::tempdir().unwrap();
        let data = scenes(&folder.path().join("scenes"));
        let first = small(folder.path(), 24);
        // What begins at nothing says something.
        for (name, variable) in first.student.variables() {
            let ends = [".conv2.weight", ".proj_out.weight", "unet.conv_out.weight"];
            if ends.iter().any(|e| name.ends_with(e)) {
                let mut noise = NoiseStream::new(9, variable.elem_count() as u64);
                let values = noise.normal_tensor(variable.dims(), DType::F32, &Device::Cpu);
                variable.set(&(values.unwrap() * 0.05).unwrap()).unwrap();
            }
        }
        let weights = first.student.variables().iter();
        let weights: BTreeMap<_, _> = weights
            .map(|(n, v)| (n.clone(), v.as_detached_tensor()))
            .collect();
        first
            .blueprint
            .write_weights(folder.path(), &weights)
            .unwrap();
        let deeper = Blueprint {
            layers: 3,
            ..first.blueprint.clone()
        };
        let grown = tempfile::tempdir().unwrap();
        deeper.write_configs(grown.path()).unwrap();
        let begin = || Trainer::new(&deeper, grown.path(), first.settings, Recipe::default());
        let loss = |trainer: &Trainer| {
            let mut stream = NoiseStream::new(1, 2);
            let example = Example::draw(data.scene(0), &trainer.recipe, &mut stream);
            let batch = Batch::new(vec![example]).unwrap();
            let losses = trainer.student.loss(&batch, &mut stream).unwrap();
            losses.velocity.to_scalar::<f32>().unwrap()
        };
        let mut second = begin().unwrap();
        let fresh = loss(&second);
        second.start_from(folder.path()).unwrap();
        let (found, wanted) = (loss(&second), loss(&first));
        // Stored in half precision.
        assert!((found - wanted).abs() < 1e-3 * wanted, "{found} {wanted}");
        assert!((fresh - wanted).abs() > 1e-2 * wanted, "{fresh} {wanted}");
        // Every block learns.
        let before: BTreeMap<_, _> = second
            .student
            .variables()
            .iter()
            .map(|(n, v)| (n.clone(), v.as_detached_tensor().copy().unwrap()))
            .collect();
        second.step(&data).unwrap();
        for (name, variable) in second.student.variables() {
            if name.ends_with("conv2.weight") {
                let moved = (variable.as_tensor() - &before[name]).unwrap();
                let moved = moved.abs().unwrap().max_all().unwrap();
                assert!(moved.to_scalar::<f32>().unwrap() > 0.0, "{name}");
            }
        }

        let mut shallow = small(folder.path(), 24);
        second
            .blueprint
            .write_weights(grown.path(), second.average())
            .unwrap();
        let error = shallow.start_from(grown.path()).unwrap_err().to_string();
        assert!(error.contains("layers_per_block is 3"), "{error}");
        let checkpoint = grown.path().join("checkpoint.safetensors");
        second.save(&checkpoint).unwrap();
        begin().unwrap().resume(&checkpoint).unwrap();
        let error = shallow.resume(&checkpoint).unwrap_err().to_string();
        assert!(error.contains("--layers 3"), "{error}");
    }

    #[test]
    fn scenes_that_were_cut_off_are_refused_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let data = scenes(folder.path());
        assert_eq!(data.len(), crate::dataset::BLOCK);
        let path = folder.path().join("scenes-00000.safetensors");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = Dataset::open(folder.path(), Places::Objects, 1)
            .unwrap_err()
            .to_string();
        assert!(error.contains("scenes-00000.safetensors"), "{error}");
    }
}
