//! Sinusoidal timestep embedding and the small network after it.

use candle_core::{DType, Tensor};

use super::config::UNetConfig;
use crate::error::Result;
use crate::layers::{Activation, Linear, activate};
use crate::parameters::Parameters;

/// Longest period of the sinusoids, in timesteps.
const MAX_PERIOD: f64 = 10_000.0;

/// Sinusoids of each timestep [Vaswani et al. 2017]: `size` / 2 frequencies
/// falling geometrically from 1, computed in f64.
pub fn sinusoids(
    timesteps: &[f64],
    size: usize,
    flip_sin_to_cos: bool,
    freq_shift: f64,
) -> Vec<f32> {
    let half = size / 2;
    let mut values = Vec::with_capacity(timesteps.len() * size);
    for &t in timesteps {
        let angle = |i: usize| t * (-MAX_PERIOD.ln() * i as f64 / (half as f64 - freq_shift)).exp();
        let sines = (0..half).map(|i| angle(i).sin() as f32);
        let cosines = (0..half).map(|i| angle(i).cos() as f32);
        if flip_sin_to_cos {
            values.extend(cosines.chain(sines));
        } else {
            values.extend(sines.chain(cosines));
        }
    }
    values
}

/// Timesteps to the vector that the residual blocks see, its final SiLU
/// included: every one of them would begin with it.
#[derive(Debug)]
pub(super) struct TimestepEmbedding {
    linear_1: Linear,
    linear_2: Linear,
    size: usize,
    flip: bool,
    shift: f64,
}

impl TimestepEmbedding {
    pub(super) fn new(parameters: &Parameters, config: &UNetConfig) -> Result<Self> {
        let size = config.block_out_channels[0];
        let parameters = parameters.sub("time_embedding");
        Ok(Self {
            linear_1: Linear::new(&parameters.sub("linear_1"), size, 4 * size)?,
            linear_2: Linear::new(&parameters.sub("linear_2"), 4 * size, 4 * size)?,
            size,
            flip: config.flip_sin_to_cos,
            shift: config.freq_shift,
        })
    }

    /// One row for each timestep; `text` [timesteps, 4 size] joins it.
    pub(super) fn forward(
        &self,
        timesteps: &[f64],
        dtype: DType,
        text: Option<&Tensor>,
    ) -> Result<Tensor> {
        let device = self.linear_1.weight().device();
        let values = sinusoids(timesteps, self.size, self.flip, self.shift);
        let x = Tensor::from_vec(values, (timesteps.len(), self.size), device)?.to_dtype(dtype)?;
        let x = self
            .linear_2
            .forward(&activate(Activation::Silu, &self.linear_1.forward(&x)?)?)?;
        match text {
            Some(text) => activate(Activation::Silu, &(x + text)?),
            None => activate(Activation::Silu, &x),
        }
    }
}
