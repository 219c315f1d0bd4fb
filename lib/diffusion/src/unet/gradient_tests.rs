//! Gradients of the UNet's parts, at inputs and weights.

use candle_core::{DType, Device, Tensor, Var};

use super::*;
use crate::differences::{Outcome, assert_gradients_of, normal};

/// Sizes of a small UNet whose groups have two channels.
fn config() -> UNetConfig {
    UNetConfig {
        block_out_channels: vec![8],
        down_block_types: vec!["CrossAttnDownBlock2D".into()],
        up_block_types: vec!["CrossAttnUpBlock2D".into()],
        norm_num_groups: 4,
        attention_head_dim: crate::config::PerLevel::All(2),
        cross_attention_dim: 6,
        addition_embed_type: Some("text".into()),
        addition_embed_type_num_heads: 2,
        ..UNetConfig::default()
    }
}

/// The inputs by number, as variables, and the weights of `parameters`.
fn variables(
    parameters: Parameters,
    inputs: &[&Var],
) -> Result<Vec<(String, Var)>, crate::error::Error> {
    let named = |(i, x): (usize, &&Var)| (format!("input {i}"), (*x).clone());
    let inputs = inputs.iter().enumerate().map(named);
    Ok(inputs.chain(parameters.finish(|_| true)?).collect())
}

fn input(stream: u64, shape: &[usize]) -> candle_core::Result<Var> {
    Var::from_tensor(&normal(stream, shape))
}

#[test]
fn the_timestep_and_the_pooled_text_pass_gradients() -> Outcome {
    let parameters = Parameters::random(1, &Device::Cpu);
    let layer = TimestepEmbedding::new(&parameters, &config())?;
    let text = input(50, &[2, 32])?;
    let all = variables(parameters, &[&text])?;
    assert_eq!(all.len(), 1 + 4);
    assert_gradients_of("timestep", &all, &|| {
        layer.forward(&[3.0, 700.0], DType::F32, Some(&text))
    })?;
    let parameters = Parameters::random(2, &Device::Cpu);
    let layer = PooledText::new(&parameters, &config())?;
    let context = input(51, &[2, 5, 6])?;
    let all = variables(parameters, &[&context])?;
    assert_eq!(all.len(), 1 + 13);
    assert_gradients_of("pooled text", &all, &|| layer.forward(&context))
}

#[test]
fn residual_blocks_and_transformers_pass_gradients() -> Outcome {
    for outputs in [8, 12] {
        let shape = ResnetShape {
            inputs: 8,
            outputs,
            time: Some(6),
            groups: 4,
            eps: 1e-5,
        };
        let parameters = Parameters::random(3, &Device::Cpu);
        let block = ResnetBlock::new(&parameters, shape)?;
        let (x, time) = (input(52, &[2, 8, 4, 3])?, input(53, &[2, 6])?);
        let all = variables(parameters, &[&x, &time])?;
        assert_gradients_of("residual block", &all, &|| block.forward(&x, Some(&time)))?;
    }
    for use_linear_projection in [false, true] {
        let config = UNetConfig {
            use_linear_projection,
            ..config()
        };
        let parameters = Parameters::random(4, &Device::Cpu);
        let layer = SpatialTransformer::new(&parameters, &config, 0)?;
        let (x, context) = (input(54, &[2, 8, 3, 2])?, input(55, &[2, 5, 6])?);
        let all = variables(parameters, &[&x, &context])?;
        let forward = || -> Result<Tensor> { layer.forward(&x, &context, &Pass::default()) };
        assert_gradients_of("transformer", &all, &forward)?;
    }
    Ok(())
}

#[test]
fn no_operation_of_the_network_is_candles_own() -> Outcome {
    let parameters = Parameters::random(3, &Device::Cpu);
    let config = UNetConfig {
        addition_embed_type: None,
        ..config()
    };
    let unet = UNet::new(config, parameters)?;
    let (x, context) = (input(60, &[2, 4, 6, 6])?, normal(61, &[2, 5, 6]));
    let y = unet.forward(&x, &[3.0], &context, &Pass::default())?;
    // Weights and x lead to y: one addition of candle's would make all gradients go its slower way.
    assert!(crate::backward::knows_the_way(&y));
    Ok(())
}
