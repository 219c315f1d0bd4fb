//! The kernels of a GPU against those of the CPU, results and gradients, in f32 and in bf16. Without a GPU there is nothing
//! to compare, and the test says so.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};

use super::*;
use crate::error::Result;
use crate::noise::NoiseStream;
use crate::optimizer::{AdamW, AdamWConfig};
use crate::parameters::Parameters;

/// Makes the layer of constants, and applies it to inputs that want gradients.
type Layer<'a> = &'a dyn Fn(&[Tensor], &[Tensor]) -> Result<Tensor>;

fn normal(stream: u64, shape: &[usize]) -> Tensor {
    NoiseStream::new(43, stream)
        .normal_tensor(shape, DType::F32, &Device::Cpu)
        .expect("tensor")
}

/// The result, and the gradients at the inputs.
fn run(
    (device, dtype): (&Device, DType),
    inputs: &[Tensor],
    constants: &[Tensor],
    layer: Layer,
) -> Result<Vec<Tensor>> {
    let there = |t: &Tensor| t.to_device(device)?.to_dtype(dtype);
    let variables = inputs.iter().map(|t| Var::from_tensor(&there(t)?));
    let variables = variables.collect::<Result<Vec<_>, _>>()?;
    let tensors: Vec<Tensor> = variables.iter().map(|v| v.as_tensor().clone()).collect();
    let constants = constants.iter().map(there).collect::<Result<Vec<_>, _>>()?;
    let y = layer(&tensors, &constants)?;
    let g = there(&normal(99, y.dims()))?;
    let store = (&y * g)?.sum_all()?.backward()?;
    let mut found = vec![y.detach()];
    found.extend(variables.iter().filter_map(|v| store.get(v).cloned()));
    assert_eq!(found.len(), 1 + inputs.len(), "an input got no gradient");
    Ok(found)
}

/// Largest difference over the largest value.
fn error(got: &Tensor, wanted: &Tensor) -> candle_core::Result<f64> {
    let plain = |t: &Tensor| t.to_device(&Device::Cpu)?.to_dtype(DType::F64);
    let largest = |t: Tensor| t.abs()?.flatten_all()?.max(0)?.to_scalar::<f64>();
    let (got, wanted) = (plain(got)?, plain(wanted)?);
    let error = largest((&got - &wanted)?)? / largest(wanted)?;
    // A maximum passes over what is no number.
    Ok(if got.sum_all()?.to_scalar::<f64>()?.is_finite() {
        error
    } else {
        f64::INFINITY
    })
}

/// f32: sums of up to millions of terms in another order. bf16 has 8 bits, and its inputs are rounded.
fn assert_agree(gpu: &Device, name: &str, inputs: &[Tensor], constants: &[Tensor], layer: Layer) {
    let wanted = run((&Device::Cpu, DType::F32), inputs, constants, layer).expect(name);
    for (dtype, bound) in [(DType::F32, 5e-5), (DType::BF16, 0.03)] {
        let got = run((gpu, dtype), inputs, constants, layer).expect(name);
        for (i, (got, wanted)) in got.iter().zip(&wanted).enumerate() {
            let what = if i == 0 {
                "result".to_owned()
            } else {
                format!("gradient {}", i - 1)
            };
            assert_eq!(got.dims(), wanted.dims(), "{name}: {what}");
            let error = error(got, wanted).expect(name);
            println!("{name} {dtype:?} {what}: {error:.1e}");
            assert!(
                error < bound,
                "{name} {dtype:?}: {what}: relative error {error:e}"
            );
        }
    }
}

fn gpu() -> Option<Device> {
    // Where the driver's library is missing, what looks for it panics.
    match std::panic::catch_unwind(|| Device::new_cuda(0)) {
        Ok(Ok(device)) => Some(device),
        _ => {
            println!("no GPU: nothing is compared");
            None
        }
    }
}

fn norm_parameters(t: &[Tensor]) -> Parameters {
    let named = ["weight", "bias"].iter().zip(t);
    Parameters::from_tensors(
        named
            .map(|(name, t)| ((*name).to_owned(), t.clone()))
            .collect(),
    )
}

#[test]
fn layers_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let gpu = &gpu;
    linear(gpu);
    convolutions(gpu);
    norms(gpu);
    attention(gpu);
    let x = normal(17, &[2, 3, 700]);
    assert_agree(gpu, "geglu", &[x], &[], &|t, _| geglu(&t[0]));
}

/// Scores up to a million, of which one key takes all the weight: the gradient at the values, summed over the keys, is that at
/// the result, summed over the queries. Weights and sums are each rounded to bf16, by 2^-9 of their value. Errors of single
/// queries may cancel.
#[test]
fn attention_of_huge_scores_has_weights_that_sum_to_one() -> Result<()> {
    let Some(gpu) = gpu() else { return Ok(()) };
    let there = |stream, size: f64| -> Result<Var> {
        let tensor = (normal(stream, &[1, 640, 64]) * size)?;
        Ok(Var::from_tensor(
            &tensor.to_device(&gpu)?.to_dtype(DType::BF16)?,
        )?)
    };
    let (q, k, v) = (there(31, 600.0)?, there(32, 600.0)?, there(33, 1.0)?);
    let attention = Attention {
        heads: 1,
        causality: Causality::Full,
    };
    let y = attention.forward(&q, &k, &v)?;
    let gradients = y.sum_all()?.backward()?;
    let read = |t: &Tensor| t.to_dtype(DType::F32)?.to_device(&Device::Cpu);
    for variable in [&q, &k] {
        let gradient = gradients.get(variable).expect("a gradient");
        let sum = read(gradient)?.sum_all()?.to_scalar::<f32>()?;
        assert!(sum.is_finite(), "{sum}");
    }
    let at_values = read(gradients.get(&v).expect("a gradient"))?.sum(1)?;
    for column in at_values.flatten_all()?.to_vec1::<f32>()? {
        assert!((column / 640.0 - 1.0).abs() < 2f32.powi(-8), "{column}");
    }
    Ok(())
}

#[test]
fn an_optimizer_agrees_with_the_cpu() -> Result<()> {
    let Some(gpu) = gpu() else { return Ok(()) };
    let steps = |device: &Device| -> Result<(Vec<f64>, Tensor)> {
        let start = normal(21, &[40, 30]).to_device(device)?;
        let variable = Var::from_tensor(&start)?;
        let named = BTreeMap::from([("w".to_owned(), variable.clone())]);
        let mut adam = AdamW::new(&named, AdamWConfig::default())?;
        let mut norms = vec![];
        for step in 0..5 {
            let gradient = normal(22 + step, &[40, 30]).to_device(device)?;
            let gradients = BTreeMap::from([("w".to_owned(), gradient)]);
            norms.push(adam.step(&gradients, 1.0, |_| 1e-2)?);
        }
        Ok((norms, variable.as_detached_tensor()))
    };
    let ((norms, got), (wanted_norms, wanted)) = (steps(&gpu)?, steps(&Device::Cpu)?);
    for (a, b) in norms.iter().zip(&wanted_norms) {
        assert!((a - b).abs() < 1e-6 * b, "{a} {b}");
    }
    let error = error(&got, &wanted)?;
    println!("optimizer: {error:.1e}");
    assert!(error < 1e-6, "{error:e}");
    Ok(())
}

fn linear(gpu: &Device) {
    let (x, w, b) = (
        normal(1, &[2, 500, 320]),
        normal(2, &[64, 320]),
        normal(3, &[64]),
    );
    let inputs = [x.clone(), w.clone(), b.clone()];
    assert_agree(gpu, "trained linear", &inputs, &[], &|t, _| {
        Linear::from_tensors(t[1].clone(), Some(t[2].clone()))?.forward(&t[0])
    });
    assert_agree(gpu, "frozen linear", &[x], &[w, b], &|t, c| {
        Linear::from_tensors(c[0].clone(), Some(c[1].clone()))?.forward(&t[0])
    });
}

fn convolutions(gpu: &Device) {
    for (x, outputs, kernel, stride, padding) in [
        ([3, 20, 17, 30], 24, 3, 1, Padding::Same(1)),
        ([2, 20, 17, 30], 24, 3, 2, Padding::Same(1)),
        ([2, 20, 16, 30], 24, 3, 2, Padding::After(1)),
        ([2, 20, 9, 7], 24, 1, 1, Padding::Same(0)),
        ([2, 20, 17, 40], 24, 3, 1, Padding::Same(1)),
        ([2, 20, 16, 40], 24, 3, 1, Padding::After(2)),
        // Columns of more than the scratch memory: worked through in parts.
        ([2, 64, 1024, 512], 3, 3, 1, Padding::Same(1)),
        ([1, 64, 2048, 1024], 3, 3, 2, Padding::After(1)),
    ] {
        let fan_in = (x[1] * kernel * kernel) as f64;
        let w = (normal(5, &[outputs, x[1], kernel, kernel]) / fan_in.sqrt()).expect("weights");
        let name = format!("convolution {x:?} {kernel} stride {stride}");
        let constants = [w, normal(6, &[outputs])];
        assert_agree(gpu, &name, &[normal(4, &x)], &constants, &|t, c| {
            Conv2d::from_tensors(c[0].clone(), c[1].clone(), stride, padding)?.forward(&t[0])
        });
    }
}

fn norms(gpu: &Device) {
    for (shape, activation) in [
        ([2, 32, 24, 40], NormActivation::Silu),
        ([1, 64, 5, 7], NormActivation::None),
        // Several chunks, and more of them than one.
        ([1, 64, 300, 500], NormActivation::Silu),
    ] {
        let x = ((normal(7, &shape) * 2.0).expect("x") + 3.0).expect("x");
        let constants = [normal(8, &[shape[1]]), normal(9, &[shape[1]])];
        let name = format!("group norm {shape:?} {activation:?}");
        assert_agree(gpu, &name, &[x], &constants, &|t, c| {
            GroupNorm::new(&norm_parameters(c), 16, shape[1], 1e-5, activation)?.forward(&t[0])
        });
    }
    let constants = [normal(11, &[320]), normal(12, &[320])];
    let x = (normal(10, &[2, 500, 320]) + 1.0).expect("x");
    assert_agree(gpu, "layer norm", &[x], &constants, &|t, c| {
        LayerNorm::new(&norm_parameters(c), 320, 1e-5)?.forward(&t[0])
    });
}

fn attention(gpu: &Device) {
    for (heads, width, queries, keys, causality) in [
        (5, 320, 1000, 77, Causality::Full),
        (16, 1024, 77, 77, Causality::Causal),
        (1, 512, 400, 400, Causality::Full),
        // Scores of more than the scratch memory: one head after the other.
        (2, 32, 9216, 9216, Causality::Full),
        // The kernel that stores no scores: queries and keys that fill their blocks, and that do not.
        (5, 320, 512, 512, Causality::Full),
        (2, 128, 1000, 1001, Causality::Full),
        (3, 192, 5, 63, Causality::Full),
        // Rows of scores that registers do not hold.
        (1, 16, 40, 13_001, Causality::Full),
        (1, 16, 40, 13_004, Causality::Full),
    ] {
        let [q, k, v] = [(13, queries), (14, keys), (15, keys)]
            .map(|(stream, length)| normal(stream, &[2, length, width]));
        let name = format!("attention {heads} x {queries} x {keys} {causality:?}");
        assert_agree(gpu, &name, &[q, k, v], &[], &|t, _| {
            Attention { heads, causality }.forward(&t[0], &t[1], &t[2])
        });
    }
}
