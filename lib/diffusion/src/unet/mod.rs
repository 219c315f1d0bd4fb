//! The conditional UNet of Stable Diffusion 1 and 2, their inpainting
//! variants and smaller models of the same layout.

mod config;
mod pooled_text;
mod projection;
mod timestep;
mod transformer;

use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::{Tensor, Var};
use rayon::prelude::*;

pub(crate) use config::MAX_LEVELS;
pub use config::UNetConfig;
use pooled_text::PooledText;
use timestep::TimestepEmbedding;
pub use timestep::sinusoids;
use transformer::SpatialTransformer;

use crate::error::{Result, argument};
use crate::layers::{
    Conv2d, GroupNorm, NormActivation, Padding, concatenate_channels, upsample_nearest,
};
use crate::lora::AdapterTarget;
use crate::parameters::Parameters;
use crate::pass::Pass;
use crate::resnet::{ResnetBlock, ResnetShape};

/// Residual block, then a transformer where the level has attention: the
/// unit that is recomputed as a whole.
#[derive(Debug)]
struct Stage {
    resnet: ResnetBlock,
    attention: Option<SpatialTransformer>,
}

impl Stage {
    fn forward(&self, x: &Tensor, time: &Tensor, context: &Tensor, pass: &Pass) -> Result<Tensor> {
        let x = self.resnet.forward(x, Some(time))?;
        match &self.attention {
            Some(attention) => attention.forward(&x, context, pass),
            None => Ok(x),
        }
    }
}

/// Runs a stage, recomputed in the backward pass if `pass` says so.
fn run(
    stage: &Arc<Stage>,
    x: &Tensor,
    time: &Tensor,
    context: &Tensor,
    pass: &Pass,
) -> Result<Tensor> {
    let Some(recompute) = &pass.recompute else {
        return stage.forward(x, time, context, pass);
    };
    let (stage, time, inside) = (stage.clone(), time.detach(), pass.inside_segment());
    recompute.run(x, context, move |x, context| {
        stage.forward(x, &time, context, &inside)
    })
}

#[derive(Debug)]
struct DownLevel {
    stages: Vec<Arc<Stage>>,
    downsample: Option<Conv2d>,
}

#[derive(Debug)]
struct UpLevel {
    stages: Vec<Arc<Stage>>,
    upsample: Option<Conv2d>,
}

/// Predicts noise, velocity or sample from noisy latents, a timestep and text
/// states.
#[derive(Debug)]
pub struct UNet {
    config: UNetConfig,
    time: TimestepEmbedding,
    pooled_text: Option<PooledText>,
    conv_in: Conv2d,
    down: Vec<DownLevel>,
    middle: [Arc<Stage>; 2],
    up: Vec<UpLevel>,
    norm_out: GroupNorm,
    conv_out: Conv2d,
    variables: BTreeMap<String, Var>,
}

impl UNet {
    /// Builds the network; missing, superfluous and mis-shaped tensors are
    /// errors that name them.
    pub fn new(config: UNetConfig, parameters: Parameters) -> Result<Self> {
        config.check().map_err(crate::error::Error::Argument)?;
        let channels = &config.block_out_channels;
        let (first, levels) = (channels[0], config.levels());
        let p = &parameters;
        let same = Padding::Same(1);
        let conv_in = Conv2d::new(&p.sub("conv_in"), (config.in_channels, first), 3, 1, same)?;
        let down = (0..levels)
            .map(|level| down_level(p, &config, level))
            .collect::<Result<_>>()?;
        let middle = [
            stage(
                p,
                &config,
                ("mid_block", 0),
                (channels[levels - 1], levels - 1),
                Some(0),
            )?,
            stage(
                p,
                &config,
                ("mid_block", 1),
                (channels[levels - 1], levels - 1),
                None,
            )?,
        ];
        let up = (0..levels)
            .rev()
            .map(|level| up_level(p, &config, level))
            .collect::<Result<_>>()?;
        let norm = p.sub("conv_norm_out");
        let norm_out = GroupNorm::new(
            &norm,
            config.norm_num_groups,
            first,
            config.norm_eps,
            NormActivation::Silu,
        )?;
        let conv_out = Conv2d::new(&p.sub("conv_out"), (first, config.out_channels), 3, 1, same)?;
        let time = TimestepEmbedding::new(p, &config)?;
        let pooled_text = config
            .addition_embed_type
            .is_some()
            .then(|| PooledText::new(p, &config))
            .transpose()?;
        let variables = parameters.finish(|_| false)?;
        Ok(Self {
            config,
            time,
            pooled_text,
            conv_in,
            down,
            middle,
            up,
            norm_out,
            conv_out,
            variables,
        })
    }

    /// The configuration.
    pub fn config(&self) -> &UNetConfig {
        &self.config
    }

    /// Trainable parameters by name; empty if the weights are frozen.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// Every layer that an adapter may extend, in a fixed order.
    pub fn adapter_targets(&self) -> Vec<AdapterTarget> {
        let levels = self
            .down
            .iter()
            .map(|l| &l.stages[..])
            .chain([&self.middle[..]]);
        let stages = levels
            .chain(self.up.iter().map(|l| &l.stages[..]))
            .flatten();
        stages
            .filter_map(|stage| stage.attention.as_ref())
            .flat_map(SpatialTransformer::targets)
            .collect()
    }

    /// The prediction [batch, out_channels, h, w] for `sample`
    /// [batch, in_channels, h, w], one timestep for each item or one for all,
    /// and `context` [batch, tokens, cross_attention_dim].
    pub fn forward(
        &self,
        sample: &Tensor,
        timesteps: &[f64],
        context: &Tensor,
        pass: &Pass,
    ) -> Result<Tensor> {
        let timesteps = self.check(sample, timesteps, context)?;
        // Recomputed segments take the timestep vector as a constant, which
        // it is not where text is part of it.
        let whole = pass.inside_segment();
        let pass = if self.pooled_text.is_some() {
            &whole
        } else {
            pass
        };
        let text = self
            .pooled_text
            .as_ref()
            .map(|pool| pool.forward(context))
            .transpose()?;
        let time = self
            .time
            .forward(&timesteps, sample.dtype(), text.as_ref())?;
        let mut x = self.conv_in.forward(sample)?;
        if pass.recompute.is_some() && !x.track_op() && !context.track_op() {
            // A segment is replayed only if one of its inputs asks for a gradient.
            x = Var::from_tensor(&x)?.as_tensor().clone();
        }
        let mut skips = vec![x.clone()];
        for level in &self.down {
            for stage in &level.stages {
                x = run(stage, &x, &time, context, pass)?;
                skips.push(x.clone());
            }
            if let Some(downsample) = &level.downsample {
                x = downsample.forward(&x)?;
                skips.push(x.clone());
            }
        }
        for stage in &self.middle {
            x = run(stage, &x, &time, context, pass)?;
        }
        for level in &self.up {
            for stage in &level.stages {
                let Some(skip) = skips.pop() else {
                    return argument("UNet: fewer skips than stages");
                };
                x = run(
                    stage,
                    &concatenate_channels(&x, &skip)?,
                    &time,
                    context,
                    pass,
                )?;
            }
            if let (Some(upsample), Some(skip)) = (&level.upsample, skips.last()) {
                let (_, _, height, width) = skip.dims4()?;
                x = upsample.forward(&upsample_nearest(&x, height, width)?)?;
            }
        }
        self.conv_out.forward(&self.norm_out.forward(&x)?)
    }

    /// As [`UNet::forward`], without a graph. On the CPU each row of the batch takes a thread of its own: the layers of a
    /// small network are too short to be shared among threads.
    pub fn predict(
        &self,
        sample: &Tensor,
        timesteps: &[f64],
        context: &Tensor,
        pass: &Pass,
    ) -> Result<Tensor> {
        let rows = sample.dim(0)?;
        if rows == 1 || !sample.device().is_cpu() {
            return Ok(self.forward(sample, timesteps, context, pass)?.detach());
        }
        let timesteps = self.check(sample, timesteps, context)?;
        let outputs = (0..rows).into_par_iter().map(|row| {
            let adapted = pass.lora_rows.is_none_or(|rows| row < rows);
            let pass = Pass {
                lora: pass.lora.clone().filter(|_| adapted),
                ..Pass::default()
            };
            let (sample, context) = (sample.narrow(0, row, 1)?, context.narrow(0, row, 1)?);
            let output = self.forward(&sample, &timesteps[row..=row], &context, &pass)?;
            Ok(output.detach())
        });
        let outputs = outputs.collect::<Result<Vec<Tensor>>>()?;
        Ok(Tensor::cat(&outputs, 0)?)
    }

    fn check(&self, sample: &Tensor, timesteps: &[f64], context: &Tensor) -> Result<Vec<f64>> {
        let (batch, channels, _, _) = sample.dims4()?;
        let (context_batch, _, width) = context.dims3()?;
        if channels != self.config.in_channels {
            return argument(format!(
                "UNet: sample {:?} has {channels} channels, the model takes {}; an inpainting model takes latents, mask and masked latents together",
                sample.dims(),
                self.config.in_channels
            ));
        }
        if context_batch != batch || width != self.config.cross_attention_dim {
            return argument(format!(
                "UNet: context {:?} does not fit a batch of {batch} and width {}",
                context.dims(),
                self.config.cross_attention_dim
            ));
        }
        match timesteps {
            [one] => Ok(vec![*one; batch]),
            many if many.len() == batch => Ok(many.to_vec()),
            many => argument(format!(
                "UNet: {} timesteps for a batch of {batch}",
                many.len()
            )),
        }
    }
}

/// Stage `index` of the block at `prefix`: `inputs` channels into those of
/// `level`; `attention` is the index of its transformer, if it has one.
fn stage(
    parameters: &Parameters,
    config: &UNetConfig,
    (prefix, index): (&str, usize),
    (inputs, level): (usize, usize),
    attention: Option<usize>,
) -> Result<Arc<Stage>> {
    let block = parameters.sub(prefix);
    let shape = ResnetShape {
        inputs,
        outputs: config.block_out_channels[level],
        time: Some(4 * config.block_out_channels[0]),
        groups: config.norm_num_groups,
        eps: config.norm_eps,
    };
    let attention = attention
        .map(|i| SpatialTransformer::new(&block.sub(format!("attentions.{i}")), config, level))
        .transpose()?;
    Ok(Arc::new(Stage {
        resnet: ResnetBlock::new(&block.sub(format!("resnets.{index}")), shape)?,
        attention,
    }))
}

fn down_level(parameters: &Parameters, config: &UNetConfig, level: usize) -> Result<DownLevel> {
    let channels = &config.block_out_channels;
    let prefix = format!("down_blocks.{level}");
    let outputs = channels[level];
    let stages = (0..config.layers_per_block)
        .map(|i| {
            let inputs = if i > 0 {
                outputs
            } else {
                channels[level.saturating_sub(1)]
            };
            stage(
                parameters,
                config,
                (&prefix, i),
                (inputs, level),
                config.attends_down(level).then_some(i),
            )
        })
        .collect::<Result<_>>()?;
    let downsample = (level + 1 < channels.len()).then(|| {
        let layer = parameters.sub(format!("{prefix}.downsamplers.0.conv"));
        // Without padding of its own diffusers pads after the last row and column.
        let padding = match config.downsample_padding {
            0 => Padding::After(1),
            n => Padding::Same(n),
        };
        Conv2d::new(&layer, (outputs, outputs), 3, 2, padding)
    });
    Ok(DownLevel {
        stages,
        downsample: downsample.transpose()?,
    })
}

fn up_level(parameters: &Parameters, config: &UNetConfig, level: usize) -> Result<UpLevel> {
    let channels = &config.block_out_channels;
    let coarsest = channels.len() - 1;
    let prefix = format!("up_blocks.{}", coarsest - level);
    let outputs = channels[level];
    let last = config.layers_per_block;
    let stages = (0..=last)
        .map(|i| {
            // What comes from below and what comes across.
            let below = if i > 0 {
                outputs
            } else {
                channels[(level + 1).min(coarsest)]
            };
            let across = if i < last {
                outputs
            } else {
                channels[level.saturating_sub(1)]
            };
            let attention = config.attends_up(level).then_some(i);
            stage(
                parameters,
                config,
                (&prefix, i),
                (below + across, level),
                attention,
            )
        })
        .collect::<Result<_>>()?;
    let upsample = (level > 0).then(|| {
        let layer = parameters.sub(format!("{prefix}.upsamplers.0.conv"));
        Conv2d::new(&layer, (outputs, outputs), 3, 1, Padding::Same(1))
    });
    Ok(UpLevel {
        stages,
        upsample: upsample.transpose()?,
    })
}

#[cfg(test)]
mod gradient_tests;
