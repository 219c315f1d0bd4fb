//! A linear layer that an adapter may extend.

use candle_core::Tensor;

use crate::error::Result;
use crate::layers::{Linear, add};
use crate::lora::AdapterTarget;
use crate::parameters::{Init, Parameters};
use crate::pass::Pass;

/// A linear layer that an adapter may extend, found by its name.
#[derive(Debug)]
pub(super) struct Projection {
    linear: Linear,
    name: String,
    pointwise_conv: bool,
}

impl Projection {
    pub(super) fn linear(parameters: &Parameters, inputs: usize, outputs: usize) -> Result<Self> {
        Ok(Self::named(
            parameters,
            Linear::new(parameters, inputs, outputs)?,
            false,
        ))
    }

    pub(super) fn without_bias(
        parameters: &Parameters,
        inputs: usize,
        outputs: usize,
    ) -> Result<Self> {
        Ok(Self::named(
            parameters,
            Linear::without_bias(parameters, inputs, outputs)?,
            false,
        ))
    }

    /// A matrix that is stored as a 1x1 convolution.
    pub(super) fn pointwise_conv(
        parameters: &Parameters,
        inputs: usize,
        outputs: usize,
    ) -> Result<Self> {
        let weight = parameters.get("weight", &[outputs, inputs, 1, 1], Init::FanIn(inputs))?;
        let bias = parameters.get("bias", &[outputs], Init::FanIn(inputs))?;
        let linear = Linear::from_tensors(weight, Some(bias))?;
        Ok(Self::named(parameters, linear, true))
    }

    fn named(parameters: &Parameters, linear: Linear, pointwise_conv: bool) -> Self {
        Self {
            linear,
            name: parameters.path().to_owned(),
            pointwise_conv,
        }
    }

    pub(super) fn target(&self) -> AdapterTarget {
        AdapterTarget {
            name: self.name.clone(),
            inputs: self.linear.inputs(),
            outputs: self.linear.outputs(),
            pointwise_conv: self.pointwise_conv,
        }
    }

    pub(super) fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let y = self.linear.forward(x)?;
        let Some(adapter) = pass.lora.as_ref().and_then(|lora| lora.adapter(&self.name)) else {
            return Ok(y);
        };
        let batch = x.dims()[0];
        match pass.lora_rows {
            Some(0) => Ok(y),
            Some(rows) if rows < batch => {
                let adapted = (y.narrow(0, 0, rows)? + adapter.forward(&x.narrow(0, 0, rows)?)?)?;
                Ok(Tensor::cat(
                    &[&adapted, &y.narrow(0, rows, batch - rows)?],
                    0,
                )?)
            }
            _ => add(&y, &adapter.forward(x)?),
        }
    }
}
