//! Residual block of the UNet and the autoencoder.

use candle_core::Tensor;

use crate::error::Result;
use crate::layers::{Conv2d, GroupNorm, Linear, NormActivation, Padding, add, add_to_channels};
use crate::parameters::Parameters;

/// Sizes of a [`ResnetBlock`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct ResnetShape {
    pub inputs: usize,
    pub outputs: usize,
    /// Width of the timestep vector; `None` in the autoencoder.
    pub time: Option<usize>,
    pub groups: usize,
    pub eps: f64,
}

/// norm, SiLU, conv, + time, norm, SiLU, conv, + input [He et al. 2016].
#[derive(Debug)]
pub(crate) struct ResnetBlock {
    norm1: GroupNorm,
    conv1: Conv2d,
    time: Option<Linear>,
    norm2: GroupNorm,
    conv2: Conv2d,
    shortcut: Option<Conv2d>,
}

impl ResnetBlock {
    pub(crate) fn new(parameters: &Parameters, shape: ResnetShape) -> Result<Self> {
        let ResnetShape {
            inputs,
            outputs,
            time,
            groups,
            eps,
        } = shape;
        let norm = |name, channels| {
            GroupNorm::new(
                &parameters.sub(name),
                groups,
                channels,
                eps,
                NormActivation::Silu,
            )
        };
        let conv = |name, inputs| {
            Conv2d::new(
                &parameters.sub(name),
                (inputs, outputs),
                3,
                1,
                Padding::Same(1),
            )
        };
        let shortcut = (inputs != outputs).then(|| {
            Conv2d::new(
                &parameters.sub("conv_shortcut"),
                (inputs, outputs),
                1,
                1,
                Padding::Same(0),
            )
        });
        Ok(Self {
            norm1: norm("norm1", inputs)?,
            conv1: conv("conv1", inputs)?,
            time: time
                .map(|size| Linear::new(&parameters.sub("time_emb_proj"), size, outputs))
                .transpose()?,
            norm2: norm("norm2", outputs)?,
            conv2: conv("conv2", outputs)?,
            shortcut: shortcut.transpose()?,
        })
    }

    /// x [batch, inputs, h, w], time [batch, size] after its SiLU.
    pub(crate) fn forward(&self, x: &Tensor, time: Option<&Tensor>) -> Result<Tensor> {
        let h = self.first_half(x, time)?;
        let h = self.conv2.forward(&self.norm2.forward(&h)?)?;
        Ok(match &self.shortcut {
            Some(shortcut) => add(&shortcut.forward(x)?, &h)?,
            None => add(x, &h)?,
        })
    }

    /// The gradient at x, where that at the value is `g`; without a timestep. Of what [`ResnetBlock::forward`]
    /// computes, only the input of the second norm is needed again.
    pub(crate) fn gradient(&self, x: &Tensor, g: &Tensor) -> Result<Tensor> {
        let h = self.first_half(x, None)?;
        let at_h = {
            let normed = self.conv2.input_gradient(h.shape(), g)?;
            self.norm2.input_gradient(&h, &normed)?
        };
        drop(h);
        let through = {
            let normed = self.conv1.input_gradient(x.shape(), &at_h)?;
            self.norm1.input_gradient(x, &normed)?
        };
        Ok(match &self.shortcut {
            Some(shortcut) => add(&shortcut.input_gradient(x.shape(), g)?, &through)?,
            None => add(g, &through)?,
        })
    }

    fn first_half(&self, x: &Tensor, time: Option<&Tensor>) -> Result<Tensor> {
        let mut h = self.conv1.forward(&self.norm1.forward(x)?)?;
        if let (Some(layer), Some(time)) = (&self.time, time) {
            h = add_to_channels(&h, &layer.forward(time)?)?;
        }
        Ok(h)
    }
}
