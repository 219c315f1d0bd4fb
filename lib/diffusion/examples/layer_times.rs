//! Times layers and small networks for tests/references/time_layers.py, which
//! times the same in PyTorch. Prints "CASE MODE WALL PROCESSOR", milliseconds,
//! the smallest of several runs; the processor's only on Linux.
//!
//!     layer_times CASE MODE REPETITIONS
//!
//! MODE is `forward`, `frozen` (forward and the gradient of the input) or
//! `train` (the gradients of the parameters too).

use std::time::Instant;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::backward::gradients;
use dipir_diffusion::layers::{
    Attention, Causality, Conv2d, GroupNorm, Linear, NormActivation, Padding,
};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::unet::{UNet, UNetConfig};

type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

fn normal(shape: &[usize]) -> Outcome<Tensor> {
    Ok(
        NoiseStream::new(1, shape.iter().product::<usize>() as u64).normal_tensor(
            shape,
            DType::F32,
            &Device::Cpu,
        )?,
    )
}

/// A parameter: a variable when training.
fn parameter(shape: &[usize], train: bool) -> Outcome<Tensor> {
    let tensor = (normal(shape)? * 0.05)?;
    Ok(if train {
        Var::from_tensor(&tensor)?.as_tensor().clone()
    } else {
        tensor
    })
}

type Run = Box<dyn Fn(&Tensor) -> dipir_diffusion::Result<Tensor>>;

/// The input's shape and the layer.
fn case(name: &str, train: bool) -> Outcome<(Vec<usize>, Run)> {
    let conv = |batch, channels, side| -> Outcome<(Vec<usize>, Run)> {
        let w = parameter(&[channels, channels, 3, 3], train)?;
        let conv = Conv2d::from_tensors(w, parameter(&[channels], train)?, 1, Padding::Same(1))?;
        Ok((
            vec![batch, channels, side, side],
            Box::new(move |x| conv.forward(x)),
        ))
    };
    Ok(match name {
        "linear" => {
            let layer = Linear::from_tensors(
                parameter(&[1280, 320], train)?,
                Some(parameter(&[1280], train)?),
            )?;
            (vec![4096, 320], Box::new(move |x| layer.forward(x)))
        }
        "conv320" => conv(1, 320, 64)?,
        "conv64" => conv(8, 64, 32)?,
        "conv128" => conv(8, 128, 16)?,
        "conv1280" => conv(1, 1280, 16)?,
        "groupnorm" => {
            let p = if train {
                Parameters::random(1, &Device::Cpu)
            } else {
                Parameters::from_tensors(
                    [
                        (
                            "weight".to_owned(),
                            Tensor::ones(320, DType::F32, &Device::Cpu)?,
                        ),
                        (
                            "bias".to_owned(),
                            Tensor::zeros(320, DType::F32, &Device::Cpu)?,
                        ),
                    ]
                    .into(),
                )
            };
            let norm = GroupNorm::new(&p, 32, 320, 1e-5, NormActivation::Silu)?;
            (vec![1, 320, 64, 64], Box::new(move |x| norm.forward(x)))
        }
        "attention" => {
            let attention = Attention {
                heads: 8,
                causality: Causality::Full,
            };
            (
                vec![1, 4096, 320],
                Box::new(move |x| attention.forward(x, x, x)),
            )
        }
        "unet" => {
            let config = UNetConfig {
                block_out_channels: vec![64, 128, 128],
                down_block_types: [
                    "CrossAttnDownBlock2D",
                    "CrossAttnDownBlock2D",
                    "DownBlock2D",
                ]
                .map(String::from)
                .into(),
                up_block_types: ["UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"]
                    .map(String::from)
                    .into(),
                cross_attention_dim: 64,
                ..UNetConfig::default()
            };
            let parameters = Parameters::random(1, &Device::Cpu);
            let unet = UNet::new(config, parameters)?;
            let context = normal(&[8, 16, 64])?;
            (
                vec![8, 4, 32, 32],
                Box::new(move |x| unet.forward(x, &[500.0], &context, &Pass::default())),
            )
        }
        other => return Err(format!("unknown case {other}").into()),
    })
}

/// Milliseconds that all threads have spent on processors so far.
fn processor_ms() -> Option<f64> {
    let mut total = 0.0;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        let path = task.ok()?.path().join("schedstat");
        let text = std::fs::read_to_string(path).ok()?;
        total += text.split(' ').next()?.parse::<f64>().ok()? * 1e-6;
    }
    Some(total)
}

fn main() -> Outcome<()> {
    dipir_diffusion::memory::keep_freed();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [name, mode, repetitions] = arguments.as_slice() else {
        return Err("usage: layer_times CASE forward|frozen|train REPETITIONS".into());
    };
    let (shape, layer) = case(name, mode == "train")?;
    let x = normal(&shape)?;
    let variable = Var::from_tensor(&x)?;
    let gradient = normal(layer(&x)?.dims())?;
    let (mut best, mut best_processor) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..=repetitions.parse::<usize>()? {
        let (start, processor) = (Instant::now(), processor_ms());
        if mode == "forward" {
            layer(&x)?;
        } else {
            gradients(&layer(&variable)?, &gradient)?;
        }
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
        if let (Some(before), Some(after)) = (processor, processor_ms()) {
            best_processor = best_processor.min(after - before);
        }
    }
    println!("{name} {mode} {best:.3} {best_processor:.3}");
    Ok(())
}
