//! AdamW with gradient clipping and a state that can be saved.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{DType, Tensor, Var};
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, argument};

/// Settings of [`AdamW`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AdamWConfig {
    /// Decay of the mean of gradients, in [0, 1).
    pub beta1: f64,
    /// Decay of the mean of squared gradients, in [0, 1).
    pub beta2: f64,
    /// Added to the root of the mean square.
    pub eps: f64,
    /// Share of a parameter that a unit of learning rate removes.
    pub weight_decay: f64,
}

impl Default for AdamWConfig {
    /// PyTorch's defaults, which diffusers trains LoRA with.
    fn default() -> Self {
        Self {
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-8,
            weight_decay: 1e-2,
        }
    }
}

#[derive(Debug)]
struct Slot {
    variable: Var,
    first: Tensor,
    second: Tensor,
}

/// Adam with decoupled weight decay [Loshchilov & Hutter 2019]. Parameters
/// and moments are f32 masters.
#[derive(Debug)]
pub struct AdamW {
    config: AdamWConfig,
    slots: BTreeMap<String, Slot>,
    steps: u64,
}

impl AdamW {
    /// For these parameters, all of which have to be f32.
    pub fn new(variables: &BTreeMap<String, Var>, config: AdamWConfig) -> Result<Self> {
        let mut slots = BTreeMap::new();
        for (name, variable) in variables {
            if variable.dtype() != DType::F32 {
                return argument(format!(
                    "parameter {name}: trained parameters are f32, not {:?}",
                    variable.dtype()
                ));
            }
            let (first, second) = (variable.zeros_like()?, variable.zeros_like()?);
            slots.insert(
                name.clone(),
                Slot {
                    variable: variable.clone(),
                    first,
                    second,
                },
            );
        }
        Ok(Self {
            config,
            slots,
            steps: 0,
        })
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Picks each parameter's gradient, in f32. One without a gradient is an
    /// error: some layer cut the graph.
    pub fn collect(&self, gradients: &GradStore) -> Result<BTreeMap<String, Tensor>> {
        self.slots
            .iter()
            .map(|(name, slot)| match gradients.get(&slot.variable) {
                Some(gradient) => Ok((name.clone(), gradient.to_dtype(DType::F32)?)),
                None => Err(Error::Gradient {
                    name: name.clone(),
                    message: "got no gradient: a layer between it and the loss cuts the graph"
                        .into(),
                }),
            })
            .collect()
    }

    /// One update with `learning_rate` as a function of the name. Gradients
    /// longer than `max_norm` together are shortened to it. Returns their
    /// norm before; if it is not finite, nothing is changed and the first
    /// bad parameter is named in the error.
    pub fn step(
        &mut self,
        gradients: &BTreeMap<String, Tensor>,
        max_norm: f64,
        learning_rate: impl Fn(&str) -> f64,
    ) -> Result<f64> {
        let norm = gradient_norm(gradients)?;
        let scale = if norm > max_norm {
            max_norm / norm
        } else {
            1.0
        };
        self.steps += 1;
        let AdamWConfig {
            beta1,
            beta2,
            eps,
            weight_decay,
        } = self.config;
        let correction1 = 1.0 - beta1.powf(self.steps as f64);
        let correction2 = 1.0 - beta2.powf(self.steps as f64);
        for (name, slot) in &mut self.slots {
            let Some(gradient) = gradients.get(name) else {
                return Err(Error::Gradient {
                    name: name.clone(),
                    message: "is missing from the gradients".into(),
                });
            };
            let rate = learning_rate(name);
            let gradient = (gradient.detach() * scale)?;
            slot.first = ((&slot.first * beta1)? + (&gradient * (1.0 - beta1))?)?;
            slot.second = ((&slot.second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
            let spread = ((&slot.second / correction2)?.sqrt()? + eps)?;
            let update = ((&slot.first / correction1)? / spread)?;
            let kept = (slot.variable.as_detached_tensor() * (1.0 - rate * weight_decay))?;
            slot.variable.set(&(kept - (update * rate)?)?)?;
        }
        Ok(norm)
    }

    /// Parameters and moments as named tensors, for a checkpoint.
    pub fn state(&self) -> BTreeMap<String, Tensor> {
        let mut state = BTreeMap::new();
        for (name, slot) in &self.slots {
            state.insert(
                format!("parameter.{name}"),
                slot.variable.as_detached_tensor(),
            );
            state.insert(format!("first.{name}"), slot.first.clone());
            state.insert(format!("second.{name}"), slot.second.clone());
        }
        state
    }

    /// Restores what [`AdamW::state`] gave after `steps` steps. `get` returns
    /// the tensor of a name; the error is a missing or mis-shaped name.
    pub fn restore(
        &mut self,
        steps: u64,
        get: impl Fn(&str) -> Result<Option<Tensor>>,
    ) -> Result<(), String> {
        let fetch = |name: String, like: &Tensor| -> Result<Tensor, String> {
            match get(&name).map_err(|e| e.to_string())? {
                Some(tensor) if tensor.dims() == like.dims() => Ok(tensor),
                Some(tensor) => Err(format!(
                    "tensor {name:?} has shape {:?}, not {:?}",
                    tensor.dims(),
                    like.dims()
                )),
                None => Err(format!("tensor {name:?} is missing")),
            }
        };
        for (name, slot) in &mut self.slots {
            let parameter = fetch(format!("parameter.{name}"), &slot.variable)?;
            slot.first = fetch(format!("first.{name}"), &slot.variable)?;
            slot.second = fetch(format!("second.{name}"), &slot.variable)?;
            slot.variable.set(&parameter).map_err(|e| e.to_string())?;
        }
        self.steps = steps;
        Ok(())
    }
}

/// Euclidean norm of all gradients together, summed in f64; an error names
/// the first that is not finite.
pub fn gradient_norm(gradients: &BTreeMap<String, Tensor>) -> Result<f64> {
    let mut total = 0f64;
    for (name, gradient) in gradients {
        let squares = gradient
            .to_dtype(DType::F64)?
            .sqr()?
            .sum_all()?
            .to_scalar::<f64>()?;
        if !squares.is_finite() {
            return Err(Error::Gradient {
                name: name.clone(),
                message: "its gradient is not finite".into(),
            });
        }
        total += squares;
    }
    Ok(total.sqrt())
}
