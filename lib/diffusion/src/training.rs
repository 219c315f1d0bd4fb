//! Fine-tuning a LoRA, and optionally the embedding of a new word, with the
//! denoising objective and prior preservation [Ruiz et al. 2023].

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Tensor, Var};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::distillation::InpaintCondition;
use crate::error::{Error, Result, argument};
use crate::lora::Lora;
use crate::model::Model;
use crate::noise::NoiseStream;
use crate::optimizer::{AdamW, AdamWConfig};
use crate::pass::Pass;
use crate::recompute::{Recompute, add_gradient};
use crate::text_encoder::LearnedTokens;
use crate::weights::{Weights, write_safetensors};

/// Settings of a fine-tuning run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingConfig {
    /// Rank of the adapters.
    pub rank: usize,
    /// alpha of the adapters; the product is scaled by alpha / rank.
    pub alpha: f64,
    /// Updates of the parameters.
    pub steps: usize,
    /// Learning rate of the adapters after the warm-up.
    pub learning_rate: f64,
    /// Learning rate of the learned embedding.
    pub token_learning_rate: f64,
    /// Updates over which the learning rates rise linearly from 0.
    pub warmup_steps: usize,
    /// Examples of each kind whose gradients are averaged for one update.
    pub accumulation: usize,
    /// Gradients longer than this together are shortened to it.
    pub max_gradient_norm: f64,
    /// Weight of the class images' loss beside the picture's.
    pub prior_weight: f64,
    /// Lowest and highest timestep as shares of the schedule.
    pub timesteps: (f64, f64),
    /// Recompute activations in the backward pass: a third more time for a
    /// fraction of the memory. None: on an NVIDIA GPU once its memory has run
    /// out, elsewhere always.
    pub recompute: Option<bool>,
    /// Key of all random numbers.
    pub seed: u64,
    /// Moments and decay.
    pub optimizer: AdamWConfig,
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            rank: 4,
            alpha: 4.0,
            steps: 500,
            // diffusers' default for LoRA of the UNet.
            learning_rate: 1e-4,
            // Embeddings have norms near 0.4 in 768 dimensions; this is what
            // textual inversion is trained with.
            token_learning_rate: 5e-4,
            warmup_steps: 20,
            accumulation: 1,
            max_gradient_norm: 1.0,
            prior_weight: 1.0,
            timesteps: (0.0, 1.0),
            recompute: None,
            seed: 0,
            optimizer: AdamWConfig::default(),
        }
    }
}

impl TrainingConfig {
    fn check(&self) -> Result<()> {
        let (low, high) = self.timesteps;
        let positive = |x: f64| x > 0.0 && x.is_finite();
        if self.accumulation == 0 || self.rank == 0 {
            return argument("training: accumulation and rank must be at least 1");
        }
        if !(0.0 <= low && low <= high && high <= 1.0) {
            return argument(format!(
                "training: timesteps = ({low}, {high}), accepted: 0 <= low <= high <= 1"
            ));
        }
        if !positive(self.learning_rate)
            || !positive(self.max_gradient_norm)
            || !positive(self.alpha)
        {
            return argument(
                "training: learning_rate, max_gradient_norm and alpha must be positive",
            );
        }
        if !(self.prior_weight >= 0.0 && self.token_learning_rate >= 0.0) {
            return argument("training: prior_weight and token_learning_rate must not be negative");
        }
        Ok(())
    }
}

/// One training example.
#[derive(Debug, Clone)]
pub struct Example {
    /// Scaled latents [1, c, h, w].
    pub latents: Tensor,
    /// Its caption.
    pub prompt: String,
    /// For 9-channel networks.
    pub inpaint: Option<InpaintCondition>,
}

/// Where examples come from. Each call gets a stream of its own, keyed by
/// the step, so that a resumed run sees the same examples.
pub trait TrainingData {
    /// A crop of the picture that is personalised to.
    fn instance(&self, stream: &mut NoiseStream) -> Result<Example>;
    /// An image of the class; `None` trains without prior preservation.
    fn prior(&self, stream: &mut NoiseStream) -> Result<Option<Example>>;
}

/// What one update did.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StepReport {
    /// Updates so far, this one included.
    pub step: usize,
    /// Weighted sum of both losses.
    pub loss: f64,
    /// Mean squared error on the picture.
    pub instance_loss: f64,
    /// Mean squared error on class images, 0 without them.
    pub prior_loss: f64,
    /// Norm of all gradients before clipping.
    pub gradient_norm: f64,
    /// Learning rate of the adapters.
    pub learning_rate: f64,
}

/// The name under which the learned embedding is optimised and saved.
const TOKEN: &str = "token";

/// A fine-tuning run; [`LoraTrainer::step`] is one update.
#[derive(Debug)]
pub struct LoraTrainer<'a> {
    pub(crate) model: &'a Model,
    pub(crate) config: TrainingConfig,
    lora: Arc<Lora>,
    token: Option<Var>,
    initial_token: Option<Tensor>,
    optimizer: AdamW,
    recompute: Option<Recompute>,
    /// States of prompts, where no embedding is learned: they stay the same.
    text: Mutex<HashMap<String, Tensor>>,
}

impl<'a> LoraTrainer<'a> {
    /// Starts from a fresh adapter. `initial_token` is the start of a learned
    /// embedding [hidden size]: the tokenizer's placeholder token is then
    /// `vocab_size`, see [`crate::tokenizer::Tokenizer::add_placeholder`].
    pub fn new(
        model: &'a Model,
        config: TrainingConfig,
        initial_token: Option<&Tensor>,
    ) -> Result<Self> {
        config.check()?;
        let lora = Lora::new(
            &model.unet.adapter_targets(),
            config.rank,
            config.alpha,
            config.seed,
            model.device(),
        )?;
        let token = initial_token
            .map(|t| -> Result<Var> {
                Ok(Var::from_tensor(
                    &t.detach().to_dtype(DType::F32)?.reshape((1, ()))?,
                )?)
            })
            .transpose()?;
        let mut variables = lora.variables().clone();
        if let Some(token) = &token {
            variables.insert(TOKEN.into(), token.clone());
        }
        if variables.is_empty() {
            return argument("training: this UNet has no attention projection to adapt");
        }
        let optimizer = AdamW::new(&variables, config.optimizer)?;
        let recompute = config
            .recompute
            .unwrap_or(!model.device().is_cuda())
            .then(|| Recompute::new(variables.into_values().collect()));
        Ok(Self {
            model,
            config,
            lora: Arc::new(lora),
            token,
            initial_token: initial_token.cloned(),
            optimizer,
            recompute,
            text: Mutex::default(),
        })
    }

    /// The adapter as it is now.
    pub fn lora(&self) -> &Arc<Lora> {
        &self.lora
    }

    fn text_states(&self, prompts: &[&str]) -> Result<Tensor> {
        if let Some(learned) = self.learned() {
            return self.model.encode_prompts(prompts, Some(&learned));
        }
        let known = |prompt: &str| {
            let known = self.text.lock().unwrap_or_else(PoisonError::into_inner);
            known.get(prompt).cloned()
        };
        let states = prompts.iter().map(|&prompt| {
            if let Some(states) = known(prompt) {
                return Ok(states);
            }
            let states = self.model.encode_prompts(&[prompt], None)?.detach();
            let mut known = self.text.lock().unwrap_or_else(PoisonError::into_inner);
            Ok(known.entry(prompt.to_owned()).or_insert(states).clone())
        });
        Ok(Tensor::cat(&states.collect::<Result<Vec<_>>>()?, 0)?)
    }

    /// The learned embedding as it is now, [1, hidden size].
    pub fn learned(&self) -> Option<LearnedTokens> {
        self.token.as_ref().map(|t| LearnedTokens {
            embeddings: t.as_tensor().clone(),
        })
    }

    /// Updates taken.
    pub fn steps(&self) -> usize {
        self.optimizer.steps() as usize
    }

    /// One update: accumulate, clip, step. An error leaves the parameters as
    /// they were.
    pub fn step(&mut self, data: &dyn TrainingData) -> Result<StepReport> {
        let step = self.steps();
        let mut sum: Option<BTreeMap<String, Tensor>> = None;
        let (mut instance_loss, mut prior_loss) = (0f64, 0f64);
        let share = 1.0 / self.config.accumulation as f64;
        for micro in 0..self.config.accumulation {
            let index = (step * self.config.accumulation + micro) as u64;
            let (gradients, losses) = match self.gradients(data, index) {
                Err(e) if self.may_recompute() && e.is_out_of_memory() => {
                    self.recompute = Some(Recompute::new(self.variables().into_values().collect()));
                    self.gradients(data, index)?
                }
                found => found?,
            };
            instance_loss += losses.0 * share;
            prior_loss += losses.1 * share;
            sum = Some(match sum {
                None => gradients,
                Some(sum) => add(sum, &gradients)?,
            });
        }
        let mut gradients = sum.unwrap_or_default();
        for gradient in gradients.values_mut() {
            *gradient = (&*gradient * share)?;
        }
        let warmup = ((step + 1) as f64 / self.config.warmup_steps.max(1) as f64).min(1.0);
        let (rate, token_rate) = (
            self.config.learning_rate * warmup,
            self.config.token_learning_rate * warmup,
        );
        let gradient_norm =
            self.optimizer
                .step(&gradients, self.config.max_gradient_norm, |name| {
                    if name == TOKEN { token_rate } else { rate }
                })?;
        Ok(StepReport {
            step: step + 1,
            loss: instance_loss + self.config.prior_weight * prior_loss,
            instance_loss,
            prior_loss,
            gradient_norm,
            learning_rate: rate,
        })
    }

    /// Whether activations are recomputed: as configured, or because memory ran out.
    pub fn recomputes(&self) -> bool {
        self.recompute.is_some()
    }

    fn may_recompute(&self) -> bool {
        self.config.recompute.is_none() && self.recompute.is_none()
    }

    /// Gradients of one example of each kind, the `index`th of all, and both losses.
    fn gradients(
        &self,
        data: &dyn TrainingData,
        index: u64,
    ) -> Result<(BTreeMap<String, Tensor>, (f64, f64))> {
        let key = index.wrapping_mul(2).wrapping_add(1);
        let stream = &mut NoiseStream::new(self.config.seed, key);
        let mut examples = vec![data.instance(stream)?];
        if self.config.prior_weight > 0.0 {
            examples.extend(data.prior(stream)?);
        }
        let draws = self.draws(&examples, stream)?;
        // On the CPU each example takes a thread of its own, as in `UNet::predict`.
        let together = match self.model.device().is_cpu() {
            true => 1,
            false => examples.len(),
        };
        let parts = (0..examples.len()).into_par_iter().step_by(together);
        let parts = parts.map(|first| self.part(&examples[first..][..together], &draws, first));
        let mut parts = parts.collect::<Result<Vec<_>>>()?.into_iter();
        let Some((mut gradients, mut losses)) = parts.next() else {
            return argument("training: no example");
        };
        for (mut more, values) in parts {
            losses.extend(values);
            for variable in self.variables().values() {
                if let Some(found) = more.remove(variable) {
                    add_gradient(&mut gradients, variable, found)?;
                }
            }
        }
        let gradients = self.optimizer.collect(&gradients)?;
        Ok((
            gradients,
            (losses[0], losses.get(1).copied().unwrap_or(0.0)),
        ))
    }

    /// Gradients of the weighted sum of some examples' losses, and the losses; `first` counts among all.
    fn part(
        &self,
        examples: &[Example],
        draws: &Draws,
        first: usize,
    ) -> Result<(GradStore, Vec<f64>)> {
        let recompute = self.recompute.as_ref().map(Recompute::another);
        let losses = self.losses_of(examples, draws, first, recompute.as_ref())?;
        let weight = |index: usize| match first + index {
            0 => 1.0,
            _ => self.config.prior_weight,
        };
        let weighted = losses.iter().enumerate();
        let weighted = weighted.map(|(index, loss)| Ok((loss * weight(index))?));
        let total = Tensor::stack(&weighted.collect::<Result<Vec<_>>>()?, 0)?.sum_all()?;
        let gradients = backward(&total, recompute.as_ref())?;
        // Reading a loss waits for a GPU, so it comes after all that the GPU is to do.
        let values = losses
            .iter()
            .map(|loss| Ok(loss.to_scalar::<f32>()? as f64));
        Ok((gradients, values.collect::<Result<_>>()?))
    }

    /// Gradients of a scalar with respect to every trained parameter, by
    /// name; a parameter that gets none is an error.
    pub fn gradients_of(&self, loss: &Tensor) -> Result<BTreeMap<String, Tensor>> {
        self.optimizer
            .collect(&backward(loss, self.recompute.as_ref())?)
    }

    /// Every trained parameter by name.
    pub fn variables(&self) -> BTreeMap<String, Var> {
        let token = self.token.iter().map(|t| (TOKEN.to_owned(), t.clone()));
        self.lora
            .variables()
            .clone()
            .into_iter()
            .chain(token)
            .collect()
    }

    /// The denoising loss (eq. 1 with w = 1) of each example, as scalars in
    /// f32 that are part of the graph. All examples share one batch.
    pub fn losses(&self, examples: &[Example], stream: &mut NoiseStream) -> Result<Vec<Tensor>> {
        let draws = self.draws(examples, stream)?;
        self.losses_of(examples, &draws, 0, self.recompute.as_ref())
    }

    fn draws(&self, examples: &[Example], stream: &mut NoiseStream) -> Result<Draws> {
        let model = self.model;
        if examples
            .iter()
            .any(|e| e.latents.dims().first() != Some(&1))
        {
            return argument("training: every example has one image");
        }
        let (low, high) = self.config.timesteps;
        let (first, last) = (
            model.schedule.timestep_at(low),
            model.schedule.timestep_at(high),
        );
        let timesteps: Vec<usize> = examples
            .iter()
            .map(|_| first + stream.below(last - first + 1))
            .collect();
        let latents: Vec<&Tensor> = examples.iter().map(|e| &e.latents).collect();
        let latents = Tensor::cat(&latents, 0)?;
        let noise = stream
            .normal_tensor(latents.dims(), DType::F32, model.device())?
            .to_dtype(model.dtype())?;
        Ok(Draws { timesteps, noise })
    }

    /// The losses of `examples`, which are those from `first` on of the draws.
    fn losses_of(
        &self,
        examples: &[Example],
        draws: &Draws,
        first: usize,
        recompute: Option<&Recompute>,
    ) -> Result<Vec<Tensor>> {
        let model = self.model;
        let timesteps = &draws.timesteps[first..][..examples.len()];
        let noise = draws.noise.narrow(0, first, examples.len())?;
        let latents: Vec<&Tensor> = examples.iter().map(|e| &e.latents).collect();
        let latents = Tensor::cat(&latents, 0)?;
        let noisy = model.schedule.add_noise_each(&latents, &noise, timesteps)?;
        let input = self.join_conditions(examples, &noisy)?;
        let prompts: Vec<&str> = examples.iter().map(|e| e.prompt.as_str()).collect();
        let context = self.text_states(&prompts)?;
        let pass = Pass {
            recompute: recompute.cloned(),
            ..Pass::with_lora(&self.lora)
        };
        let t: Vec<f64> = timesteps.iter().map(|&t| t as f64).collect();
        let output = model
            .unet
            .forward(&input, &t, &context, &pass)?
            .to_dtype(DType::F32)?;
        let target = model
            .schedule
            .target(&latents, &noise, timesteps)?
            .to_dtype(DType::F32)?;
        let squares = (output - target)?.sqr()?;
        (0..examples.len())
            .map(|i| Ok(squares.get(i)?.mean_all()?))
            .collect()
    }

    /// What the network sees: noisy latents, for inpainting models with their conditions.
    pub(crate) fn join_conditions(&self, examples: &[Example], noisy: &Tensor) -> Result<Tensor> {
        if !self.model.is_inpainting() {
            return Ok(noisy.clone());
        }
        let rows = examples
            .iter()
            .enumerate()
            .map(|(i, example)| match &example.inpaint {
                Some(condition) => condition.join(&noisy.narrow(0, i, 1)?),
                None => argument("training: an inpainting model needs mask and masked latents with every example"),
            })
            .collect::<Result<Vec<_>>>()?;
        Ok(Tensor::cat(&rows, 0)?)
    }

    /// Writes parameters, moments, step and settings: a run resumed from it
    /// ends with the same bytes as one that was never stopped.
    pub fn save_checkpoint(&self, path: &Path) -> Result<()> {
        let metadata = BTreeMap::from([
            ("steps".to_owned(), self.steps().to_string()),
            ("config".to_owned(), self.settings()?),
        ]);
        write_safetensors(path, &self.optimizer.state(), &metadata)
    }

    /// Continues from a checkpoint of the same settings; only the number of
    /// steps may differ.
    pub fn resume(&mut self, path: &Path) -> Result<()> {
        let weights = Weights::open_file(path)?;
        let fail = |message: String| Error::Checkpoint {
            path: path.to_owned(),
            message,
        };
        let field = |key: &str| {
            weights
                .metadata()
                .get(key)
                .ok_or_else(|| fail(format!("its header lacks {key:?}; delete it to start anew")))
        };
        let steps: u64 = field("steps")?
            .parse()
            .map_err(|e| fail(format!("steps: {e}")))?;
        let (theirs, ours) = (field("config")?, self.settings()?);
        if *theirs != ours {
            return Err(fail(format!(
                "it was made with other settings; delete it or restore them: {theirs}, now {ours}"
            )));
        }
        let device = self.model.device().clone();
        self.optimizer
            .restore(steps, |name| weights.tensor(name, DType::F32, &device))
            .map_err(fail)
    }

    /// Starts anew, as after [`LoraTrainer::new`].
    pub fn reset(&mut self) -> Result<()> {
        let initial = self.initial_token.clone();
        *self = Self::new(self.model, self.config.clone(), initial.as_ref())?;
        Ok(())
    }

    /// Every setting that decides the course of a run.
    fn settings(&self) -> Result<String> {
        let config = TrainingConfig {
            steps: 0,
            ..self.config.clone()
        };
        serde_json::to_string(&config)
            .map_err(|e| Error::Argument(format!("training settings: {e}")))
    }

    /// Writes the learned embedding, under `word` as textual inversion files
    /// of diffusers have it; nothing if there is none.
    pub fn save_token(&self, path: &Path, word: &str) -> Result<()> {
        let Some(token) = &self.token else {
            return Ok(());
        };
        let row = token.as_detached_tensor().to_device(&Device::Cpu)?;
        write_safetensors(
            path,
            &BTreeMap::from([(word.to_owned(), row)]),
            &BTreeMap::new(),
        )
    }
}

/// What is drawn at random for examples: their timesteps, and noise [examples, c, h, w].
struct Draws {
    timesteps: Vec<usize>,
    noise: Tensor,
}

fn backward(loss: &Tensor, recompute: Option<&Recompute>) -> Result<GradStore> {
    let mut gradients = loss.backward()?;
    if let Some(recompute) = recompute {
        recompute.drain_into(&mut gradients)?;
    }
    Ok(gradients)
}

fn add(
    mut sum: BTreeMap<String, Tensor>,
    other: &BTreeMap<String, Tensor>,
) -> Result<BTreeMap<String, Tensor>> {
    for (name, gradient) in &mut sum {
        if let Some(more) = other.get(name) {
            *gradient = (&*gradient + more)?;
        }
    }
    Ok(sum)
}
