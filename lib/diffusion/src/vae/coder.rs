//! Encoder and decoder of the autoencoder.

use candle_core::Tensor;

use super::config::AutoencoderConfig;
use crate::error::Result;
use crate::layers::{
    Attention, Causality, Conv2d, GroupNorm, Linear, NormActivation, Padding, add_tokens,
    tokens_of, upsample_nearest,
};
use crate::parameters::Parameters;
use crate::recompute::gradient_through;
use crate::resnet::{ResnetBlock, ResnetShape};

/// Added to variances.
const EPS: f64 = 1e-6;

/// Self-attention over pixels with one head.
#[derive(Debug)]
struct PixelAttention {
    norm: GroupNorm,
    to_q: Linear,
    to_k: Linear,
    to_v: Linear,
    to_out: Linear,
}

impl PixelAttention {
    fn new(parameters: &Parameters, channels: usize, groups: usize) -> Result<Self> {
        // Files of before 2023 carry the older names.
        let linear = |name: &str, older: &str| {
            let layer = parameters.sub(name);
            let layer = if layer.contains("weight") {
                layer
            } else {
                or_older(parameters, name, older)
            };
            Linear::new(&layer, channels, channels)
        };
        Ok(Self {
            norm: GroupNorm::new(
                &parameters.sub("group_norm"),
                groups,
                channels,
                EPS,
                NormActivation::None,
            )?,
            to_q: linear("to_q", "query")?,
            to_k: linear("to_k", "key")?,
            to_v: linear("to_v", "value")?,
            to_out: linear("to_out.0", "proj_attn")?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let tokens = tokens_of(&self.norm.forward(x)?)?;
        let (q, k, v) = (
            self.to_q.forward(&tokens)?,
            self.to_k.forward(&tokens)?,
            self.to_v.forward(&tokens)?,
        );
        let attention = Attention {
            heads: 1,
            causality: Causality::Full,
        };
        add_tokens(x, &self.to_out.forward(&attention.forward(&q, &k, &v)?)?)
    }
}

/// The older name if the weights have it, else the newer one, so that the
/// error message speaks of today's.
fn or_older(parameters: &Parameters, newer: &str, older: &str) -> Parameters {
    let candidate = parameters.sub(older);
    if candidate.contains("weight") {
        candidate
    } else {
        parameters.sub(newer)
    }
}

/// One unit of recomputation.
#[derive(Debug)]
enum Unit {
    Resnet(ResnetBlock),
    Attention(PixelAttention),
    Conv(Conv2d),
    /// Doubles height and width, then convolves.
    Upsample(Conv2d),
    Out(GroupNorm, Conv2d),
}

impl Unit {
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Resnet(block) => block.forward(x, None),
            Self::Attention(attention) => attention.forward(x),
            Self::Conv(conv) => conv.forward(x),
            Self::Upsample(conv) => {
                let (_, _, height, width) = x.dims4()?;
                conv.forward(&upsample_nearest(x, 2 * height, 2 * width)?)
            }
            Self::Out(norm, conv) => conv.forward(&norm.forward(x)?),
        }
    }

    /// The gradient at x, where that at the value is `g`.
    fn gradient(&self, x: Tensor, g: &Tensor) -> Result<Tensor> {
        match self {
            Self::Resnet(block) => block.gradient(&x, g),
            Self::Conv(conv) => conv.input_gradient(x.shape(), g),
            unit => gradient_through(|x| unit.forward(x), x, g),
        }
    }
}

fn run(units: &[Unit], x: &Tensor) -> Result<Tensor> {
    let mut x = x.clone();
    for unit in units {
        x = unit.forward(&x)?;
    }
    Ok(x)
}

/// Collects the units of a coder.
struct Builder<'a> {
    parameters: &'a Parameters,
    config: &'a AutoencoderConfig,
    units: Vec<Unit>,
}

impl Builder<'_> {
    fn push(&mut self, unit: Unit) {
        self.units.push(unit);
    }

    fn conv(
        &self,
        name: &str,
        channels: (usize, usize),
        stride: usize,
        padding: Padding,
    ) -> Result<Conv2d> {
        Conv2d::new(&self.parameters.sub(name), channels, 3, stride, padding)
    }

    fn resnet(&mut self, name: &str, inputs: usize, outputs: usize) -> Result<()> {
        let shape = ResnetShape {
            inputs,
            outputs,
            time: None,
            groups: self.config.norm_num_groups,
            eps: EPS,
        };
        self.push(Unit::Resnet(ResnetBlock::new(
            &self.parameters.sub(name),
            shape,
        )?));
        Ok(())
    }

    fn middle(&mut self, channels: usize) -> Result<()> {
        self.resnet("mid_block.resnets.0", channels, channels)?;
        if self.config.mid_block_add_attention {
            let layer = self.parameters.sub("mid_block.attentions.0");
            self.push(Unit::Attention(PixelAttention::new(
                &layer,
                channels,
                self.config.norm_num_groups,
            )?));
        }
        self.resnet("mid_block.resnets.1", channels, channels)
    }

    fn out(&mut self, inputs: usize, outputs: usize) -> Result<()> {
        let layer = self.parameters.sub("conv_norm_out");
        let norm = GroupNorm::new(
            &layer,
            self.config.norm_num_groups,
            inputs,
            EPS,
            NormActivation::Silu,
        )?;
        let conv = self.conv("conv_out", (inputs, outputs), 1, Padding::Same(1))?;
        self.push(Unit::Out(norm, conv));
        Ok(())
    }
}

#[derive(Debug)]
pub(super) struct Encoder {
    units: Vec<Unit>,
}

impl Encoder {
    pub(super) fn new(parameters: &Parameters, config: &AutoencoderConfig) -> Result<Self> {
        let mut b = Builder {
            parameters,
            config,
            units: vec![],
        };
        let channels = &config.block_out_channels;
        let first = b.conv(
            "conv_in",
            (config.in_channels, channels[0]),
            1,
            Padding::Same(1),
        )?;
        b.push(Unit::Conv(first));
        let mut inputs = channels[0];
        for (level, &outputs) in channels.iter().enumerate() {
            for i in 0..config.layers_per_block {
                b.resnet(&format!("down_blocks.{level}.resnets.{i}"), inputs, outputs)?;
                inputs = outputs;
            }
            if level + 1 < channels.len() {
                let name = format!("down_blocks.{level}.downsamplers.0.conv");
                let conv = b.conv(&name, (outputs, outputs), 2, Padding::After(1))?;
                b.push(Unit::Conv(conv));
            }
        }
        b.middle(inputs)?;
        b.out(inputs, 2 * config.latent_channels)?;
        Ok(Self { units: b.units })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&self.units, x)
    }

    /// The input of every unit, and the value.
    pub(super) fn trace(&self, x: &Tensor) -> Result<(Vec<Tensor>, Tensor)> {
        let mut x = x.detach();
        let mut inputs = vec![];
        for unit in &self.units {
            let value = unit.forward(&x)?;
            inputs.push(std::mem::replace(&mut x, value));
        }
        Ok((inputs, x))
    }

    /// The gradient at the first of `inputs`, where that at the value is `g`.
    pub(super) fn gradient(&self, mut inputs: Vec<Tensor>, mut g: Tensor) -> Result<Tensor> {
        for unit in self.units.iter().rev() {
            let Some(x) = inputs.pop() else { break };
            g = unit.gradient(x, &g)?;
        }
        Ok(g)
    }
}

#[derive(Debug)]
pub(super) struct Decoder {
    units: Vec<Unit>,
}

impl Decoder {
    pub(super) fn new(parameters: &Parameters, config: &AutoencoderConfig) -> Result<Self> {
        let mut b = Builder {
            parameters,
            config,
            units: vec![],
        };
        let channels = &config.block_out_channels;
        let mut inputs = channels[channels.len() - 1];
        let first = b.conv(
            "conv_in",
            (config.latent_channels, inputs),
            1,
            Padding::Same(1),
        )?;
        b.push(Unit::Conv(first));
        b.middle(inputs)?;
        for (level, &outputs) in channels.iter().rev().enumerate() {
            for i in 0..=config.layers_per_block {
                b.resnet(&format!("up_blocks.{level}.resnets.{i}"), inputs, outputs)?;
                inputs = outputs;
            }
            if level + 1 < channels.len() {
                let name = format!("up_blocks.{level}.upsamplers.0.conv");
                let conv = b.conv(&name, (outputs, outputs), 1, Padding::Same(1))?;
                b.push(Unit::Upsample(conv));
            }
        }
        b.out(inputs, config.out_channels)?;
        Ok(Self { units: b.units })
    }

    pub(super) fn forward(&self, z: &Tensor) -> Result<Tensor> {
        run(&self.units, z)
    }
}

#[cfg(test)]
#[path = "gradient_tests.rs"]
mod gradient_tests;
