//! AdamW with gradient clipping and a state that can be saved.

use std::collections::BTreeMap;

#[cfg(feature = "cuda")]
use candle_core::Device;
use candle_core::backprop::GradStore;
use candle_core::{DType, Tensor, Var};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

#[cfg(feature = "cuda")]
use crate::cuda;
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
    /// norm before; if it is not finite, or a gradient is missing, nothing is
    /// changed and the first bad parameter is named in the error.
    pub fn step(
        &mut self,
        gradients: &BTreeMap<String, Tensor>,
        max_norm: f64,
        learning_rate: impl Fn(&str) -> f64 + Sync,
    ) -> Result<f64> {
        if let Some(name) = self.slots.keys().find(|n| !gradients.contains_key(*n)) {
            return Err(Error::Gradient {
                name: name.clone(),
                message: "is missing from the gradients".into(),
            });
        }
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
        self.slots.par_iter_mut().try_for_each(|(name, slot)| {
            let rate = learning_rate(name);
            #[cfg(feature = "cuda")]
            if slot.variable.device().is_cuda() {
                let step = cuda::optimizer::AdamWStep {
                    scale,
                    beta1,
                    beta2,
                    correction1,
                    correction2,
                    eps,
                    keep: 1.0 - rate * weight_decay,
                    rate,
                };
                let gradient = gradients[name].detach().contiguous()?;
                let (first, second) = (&slot.first, &slot.second);
                return Ok(cuda::optimizer::adamw(
                    step,
                    &slot.variable,
                    first,
                    second,
                    &gradient,
                )?);
            }
            let gradient = (gradients[name].detach() * scale)?;
            slot.first = ((&slot.first * beta1)? + (&gradient * (1.0 - beta1))?)?;
            slot.second = ((&slot.second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
            let spread = ((&slot.second / correction2)?.sqrt()? + eps)?;
            let update = ((&slot.first / correction1)? / spread)?;
            let kept = (slot.variable.as_detached_tensor() * (1.0 - rate * weight_decay))?;
            Ok::<_, Error>(slot.variable.set(&(kept - (update * rate)?)?)?)
        })?;
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
    #[cfg(feature = "cuda")]
    if let Some(Device::Cuda(device)) = gradients.values().next().map(|g| g.device()) {
        let tensors = gradients
            .values()
            .map(|g| g.to_dtype(DType::F32)?.contiguous());
        let tensors = tensors.collect::<Result<Vec<Tensor>, _>>()?;
        let squares = cuda::optimizer::squares(device, &tensors)?;
        return norm_of(gradients.keys().zip(squares.into_iter().map(Ok)));
    }
    let squares = |gradient: &Tensor| -> Result<f64> {
        let gradient = gradient.to_dtype(DType::F64)?;
        Ok(gradient.sqr()?.sum_all()?.to_scalar::<f64>()?)
    };
    let squares: Vec<(&String, Result<f64>)> = gradients
        .par_iter()
        .map(|(name, gradient)| (name, squares(gradient)))
        .collect();
    norm_of(squares)
}

fn norm_of<'a>(squares: impl IntoIterator<Item = (&'a String, Result<f64>)>) -> Result<f64> {
    let mut total = 0f64;
    for (name, squares) in squares {
        let squares = squares?;
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

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    type Outcome = Result<(), Box<dyn std::error::Error>>;

    const START: [f32; 4] = [0.0, 1.0, -3.0, 1e-4];
    const RATE: f64 = 1e-2;

    fn optimizer(names: &[&str]) -> (BTreeMap<String, Var>, AdamW) {
        let variables: BTreeMap<String, Var> = names
            .iter()
            .map(|n| {
                let start = Var::new(&START, &Device::Cpu).expect("variable");
                ((*n).to_owned(), start)
            })
            .collect();
        let adam = AdamW::new(&variables, AdamWConfig::default()).expect("f32");
        (variables, adam)
    }

    fn gradients(names: &[&str], values: [f32; 4]) -> BTreeMap<String, Tensor> {
        let tensor = Tensor::new(&values, &Device::Cpu).expect("tensor");
        names
            .iter()
            .map(|n| ((*n).into(), tensor.clone()))
            .collect()
    }

    fn values(variable: &Var) -> Vec<f32> {
        variable.to_vec1().expect("vector")
    }

    fn state(adam: &AdamW) -> Vec<Vec<f32>> {
        adam.state()
            .values()
            .map(|t| t.to_vec1().expect("vector"))
            .collect()
    }

    #[test]
    fn zero_gradients_leave_only_the_decay() -> Outcome {
        let (variables, mut adam) = optimizer(&["w"]);
        for _ in 0..500 {
            assert_eq!(adam.step(&gradients(&["w"], [0.0; 4]), 1.0, |_| RATE)?, 0.0);
        }
        let kept = (1.0 - RATE * adam.config.weight_decay).powi(500);
        for (found, start) in values(&variables["w"]).iter().zip(START) {
            let wanted = start as f64 * kept;
            assert!((*found as f64 - wanted).abs() <= 1e-5 * wanted.abs());
        }
        Ok(())
    }

    /// Gradients from 1e-12 to 1e30 in one run, beside the definition in f64.
    #[test]
    fn steps_follow_the_definition_whatever_the_size_of_the_gradient() -> Outcome {
        let (variables, mut adam) = optimizer(&["w"]);
        let AdamWConfig {
            beta1,
            beta2,
            eps,
            weight_decay,
        } = adam.config;
        let (mut w, mut m, mut v) = (START.map(f64::from), [0f64; 4], [0f64; 4]);
        for step in 1..=60 {
            let size = [1e-12, 1e-3, 1.0, 1e6, 1e30][step % 5];
            let g = [0.3 * size, -size, 0.7 * size, 0.0];
            let wanted = g.iter().map(|g| g * g).sum::<f64>().sqrt();
            let norm = adam.step(&gradients(&["w"], g.map(|g| g as f32)), 1.0, |_| RATE)?;
            assert!(
                (norm - wanted).abs() <= 1e-6 * wanted,
                "{norm}, not {wanted}"
            );
            let clip = (1.0 / wanted).min(1.0);
            for i in 0..4 {
                let g = g[i] * clip;
                m[i] = beta1 * m[i] + (1.0 - beta1) * g;
                v[i] = beta2 * v[i] + (1.0 - beta2) * g * g;
                let first = m[i] / (1.0 - beta1.powi(step as i32));
                let spread = (v[i] / (1.0 - beta2.powi(step as i32))).sqrt() + eps;
                w[i] += -RATE * weight_decay * w[i] - RATE * first / spread;
            }
        }
        for (found, wanted) in values(&variables["w"]).iter().zip(w) {
            assert!(
                (*found as f64 - wanted).abs() < 1e-5 * wanted.abs().max(RATE),
                "{found}, not {wanted}"
            );
        }
        Ok(())
    }

    #[test]
    fn a_gradient_that_is_no_number_or_missing_is_named_and_changes_nothing() -> Outcome {
        let (_, mut disturbed) = optimizer(&["a", "b"]);
        let (_, mut other) = optimizer(&["a", "b"]);
        for step in 0..10 {
            let good = gradients(&["a", "b"], [0.1, -0.2, 0.3, step as f32]);
            if step == 5 {
                let before = state(&disturbed);
                for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    let mut broken = good.clone();
                    broken.extend(gradients(&["b"], [0.0, 1.0, bad, 0.0]));
                    let error = disturbed.step(&broken, 1.0, |_| RATE);
                    let message = error.expect_err("refused").to_string();
                    assert!(
                        message.contains("b") && message.contains("not finite"),
                        "{message}"
                    );
                }
                let mut broken = good.clone();
                broken.remove("b");
                let error = disturbed.step(&broken, 1.0, |_| RATE);
                let message = error.expect_err("refused").to_string();
                assert!(message.contains("missing"), "{message}");
                assert_eq!(state(&disturbed), before);
                assert_eq!(disturbed.steps(), 5);
            }
            disturbed.step(&good, 1.0, |_| RATE)?;
            other.step(&good, 1.0, |_| RATE)?;
        }
        assert_eq!(state(&disturbed), state(&other));
        Ok(())
    }

    /// The minimum of a parabola is reached after some hundred steps; ten
    /// times as many leave it there.
    #[test]
    fn a_run_that_is_too_long_stays_where_it_ended() -> Outcome {
        let (variables, mut adam) = optimizer(&["w"]);
        let target = Tensor::new(&[0.5f32, -0.5, 2.0, 0.0], &Device::Cpu)?;
        for step in 0..4000 {
            let gradient = (variables["w"].as_detached_tensor() - &target)?;
            adam.step(&BTreeMap::from([("w".into(), gradient)]), 1.0, |_| RATE)?;
            if step % 500 == 499 && step > 1000 {
                let off = (variables["w"].as_detached_tensor() - &target)?;
                let off = off.abs()?.max_all()?.to_scalar::<f32>()?;
                // What the decay of 1e-2 pulls away, and the last oscillation.
                assert!(off < 5e-2, "step {step}: {off}");
            }
        }
        Ok(())
    }
}
