//! Gradients of the autoencoder's parts, also by the way that computes inner values again.

use candle_core::{Device, Var};

use super::*;
use crate::differences::{Outcome, assert_gradient, assert_gradients_of, normal, probe};

/// Of one level, and groups of two channels.
fn config() -> AutoencoderConfig {
    AutoencoderConfig {
        block_out_channels: vec![8],
        norm_num_groups: 4,
        ..AutoencoderConfig::default()
    }
}

/// Builds a unit and checks its gradients at an input of 8 channels and at its weights.
fn assert_unit(name: &str, build: impl Fn(&mut Builder) -> Result<()>) -> Outcome {
    let (parameters, config) = (Parameters::random(5, &Device::Cpu), config());
    let mut builder = Builder {
        parameters: &parameters,
        config: &config,
        units: vec![],
    };
    build(&mut builder)?;
    let units = builder.units;
    let x = Var::from_tensor(&normal(60, &[2, 8, 4, 6]))?;
    let mut all = vec![("input".to_owned(), x.clone())];
    all.extend(parameters.finish(|_| true)?);
    assert_gradients_of(name, &all, &|| run(&units, &x))?;
    let encoder = Encoder { units };
    let (inputs, y) = encoder.trace(&x)?;
    let gradient = encoder.gradient(inputs, probe(&y))?;
    let name = format!("{name}, computed again");
    assert_gradient(&name, &x, &gradient, &|| encoder.forward(&x))
}

#[test]
fn every_unit_passes_gradients_both_ways() -> Outcome {
    assert_unit("residual block", |b| b.resnet("block", 8, 8))?;
    assert_unit("residual block that widens", |b| b.resnet("block", 8, 12))?;
    assert_unit("attention", |b| {
        let layer = PixelAttention::new(b.parameters, 8, 4)?;
        b.push(Unit::Attention(layer));
        Ok(())
    })?;
    assert_unit("convolution that shrinks", |b| {
        let conv = b.conv("conv", (8, 6), 2, Padding::After(1))?;
        b.push(Unit::Conv(conv));
        Ok(())
    })?;
    assert_unit("convolution that enlarges", |b| {
        let conv = b.conv("conv", (8, 6), 1, Padding::Same(1))?;
        b.push(Unit::Upsample(conv));
        Ok(())
    })?;
    assert_unit("end", |b| b.out(8, 3))?;
    assert_unit("middle", |b| b.middle(8))
}
