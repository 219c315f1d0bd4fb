//! Every layer exists twice: as kernels of our own, and composed of candle's
//! operations for devices that have none. Here both run on the CPU and have to
//! agree, results and gradients.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};

use super::activation::{activate_composed, geglu_composed};
use super::resample::upsample_composed;
use super::*;
use crate::error::Result;
use crate::noise::NoiseStream;
use crate::parameters::Parameters;

type Layer<'a> = &'a dyn Fn(&[Tensor]) -> Result<Tensor>;

fn normal(stream: u64, shape: &[usize]) -> Tensor {
    NoiseStream::new(41, stream)
        .normal_tensor(shape, DType::F32, &Device::Cpu)
        .expect("tensor")
}

fn largest(t: &Tensor) -> f64 {
    let value = t
        .to_dtype(DType::F64)
        .and_then(|t| t.abs()?.max_all()?.to_scalar::<f64>());
    value.expect("a number")
}

/// Both are sums of the same terms in f32 in another order; 2e-5 of the
/// largest value leaves room for a few hundred terms.
fn assert_agree(name: &str, inputs: &[Tensor], ours: Layer, composed: Layer) {
    let run = |layer: Layer| -> Result<(Tensor, Vec<Tensor>)> {
        let variables = inputs
            .iter()
            .map(Var::from_tensor)
            .collect::<Result<Vec<_>, _>>()?;
        let tensors: Vec<Tensor> = variables.iter().map(|v| v.as_tensor().clone()).collect();
        let y = layer(&tensors)?;
        let store = (&y * normal(99, y.dims()))?.sum_all()?.backward()?;
        let gradient = |v: &Var| {
            store
                .get(v)
                .cloned()
                .unwrap_or_else(|| panic!("{name}: cut"))
        };
        Ok((y.detach(), variables.iter().map(gradient).collect()))
    };
    let (y, gradients) = run(ours).expect(name);
    let (other, others) = run(composed).expect(name);
    let close = |what: &str, a: &Tensor, b: &Tensor| {
        assert_eq!(a.dims(), b.dims(), "{name}: {what}");
        let error = largest(&(a - b).expect("same shape")) / largest(b).max(1e-30);
        assert!(error < 2e-5, "{name}: {what}: relative error {error:e}");
    };
    close("result", &y, &other);
    for (i, (a, b)) in gradients.iter().zip(&others).enumerate() {
        close(&format!("gradient {i}"), a, b);
    }
}

fn norm_parameters(t: &[Tensor]) -> Parameters {
    Parameters::from_tensors(BTreeMap::from([
        ("weight".to_owned(), t[0].clone()),
        ("bias".to_owned(), t[1].clone()),
    ]))
}

#[test]
fn linear_layers_agree() {
    let inputs = [normal(1, &[2, 5, 7]), normal(2, &[3, 7]), normal(3, &[3])];
    let layer = |t: &[Tensor]| Linear::from_tensors(t[1].clone(), Some(t[2].clone()));
    assert_agree("linear", &inputs, &|t| layer(t)?.forward(&t[0]), &|t| {
        layer(t)?.forward_composed(&t[0])
    });
}

#[test]
fn convolutions_agree() {
    for (kernel, stride, padding, ends) in [
        (3, 1, Padding::Same(1), (1, 1)),
        (3, 2, Padding::Same(1), (1, 1)),
        (3, 2, Padding::After(1), (0, 1)),
        (1, 1, Padding::Same(0), (0, 0)),
    ] {
        // Gradients of weights take several small images together: of 24, 48 and 12 pixels, 13 are some groups
        // and a smaller one.
        for batch in [2, 13] {
            let inputs = [
                normal(4, &[batch, 5, 8, 6]),
                normal(5, &[6, 5, kernel, kernel]),
                normal(6, &[6]),
            ];
            let layer =
                |t: &[Tensor]| Conv2d::from_tensors(t[1].clone(), t[2].clone(), stride, padding);
            assert_agree(
                &format!("convolution {kernel} stride {stride} {padding:?} batch {batch}"),
                &inputs,
                &|t| layer(t)?.forward(&t[0]),
                &|t| layer(t)?.forward_composed(&t[0], ends.0, ends.1),
            );
        }
    }
}

#[test]
fn norms_agree() {
    for activation in [NormActivation::None, NormActivation::Silu] {
        let inputs = [normal(7, &[2, 6, 3, 5]), normal(8, &[6]), normal(9, &[6])];
        let layer =
            |t: &[Tensor]| GroupNorm::new(&norm_parameters(&t[1..]), 3, 6, 1e-5, activation);
        assert_agree("group norm", &inputs, &|t| layer(t)?.forward(&t[0]), &|t| {
            layer(t)?.forward_composed(&t[0])
        });
    }
    let inputs = [normal(10, &[2, 5, 9]), normal(11, &[9]), normal(12, &[9])];
    let layer = |t: &[Tensor]| LayerNorm::new(&norm_parameters(&t[1..]), 9, 1e-5);
    assert_agree("layer norm", &inputs, &|t| layer(t)?.forward(&t[0]), &|t| {
        layer(t)?.forward_composed(&t[0])
    });
}

#[test]
fn attention_agrees() {
    // The last three have several blocks of keys, and panels of queries.
    for (heads, width, queries, keys, causality) in [
        (1, 8, 9, 7, Causality::Full),
        (4, 8, 5, 40, Causality::Full),
        (2, 8, 6, 6, Causality::Causal),
        (2, 80, 140, 230, Causality::Full),
        (2, 66, 150, 150, Causality::Causal),
        (2, 16, 70, 230, Causality::Full),
    ] {
        let inputs = [
            normal(13, &[2, queries, width]),
            normal(14, &[2, keys, width]),
            normal(15, &[2, keys, width]),
        ];
        let attention = Attention { heads, causality };
        assert_agree(
            &format!("attention {heads} {width} {causality:?}"),
            &inputs,
            &|t| attention.forward(&t[0], &t[1], &t[2]),
            &|t| {
                let shape = attention.shape(t[0].shape(), t[1].shape(), t[2].shape())?;
                attention.forward_composed(&t[0], &t[1], &t[2], shape)
            },
        );
    }
}

#[test]
fn activations_and_enlargement_agree() {
    for f in [Activation::Silu, Activation::Gelu, Activation::QuickGelu] {
        assert_agree(
            &format!("{f:?}"),
            &[normal(16, &[3, 11])],
            &|t| activate(f, &t[0]),
            &|t| activate_composed(f, &t[0]),
        );
    }
    assert_agree(
        "geglu",
        &[normal(17, &[2, 3, 10])],
        &|t| geglu(&t[0]),
        &|t| geglu_composed(&t[0]),
    );
    assert_agree(
        "enlargement",
        &[normal(18, &[2, 3, 4, 5])],
        &|t| upsample_nearest(&t[0], 7, 10),
        &|t| upsample_composed(&t[0], 7, 10),
    );
}

#[test]
fn what_joins_layers_agrees() {
    // Pixels by jobs of 64, and not.
    for (height, width) in [(8, 8), (3, 5)] {
        let x = normal(19, &[2, 19, height, width]);
        let y = normal(20, &[2, 19, height, width]);
        let agree = |name, inputs: &[Tensor], layer: Layer| {
            assert_agree(name, inputs, layer, &|t| composed(|| layer(t)));
        };
        agree("sum", &[x.clone(), y.clone()], &|t| add(&t[0], &t[1]));
        let shift = normal(21, &[2, 19]);
        agree("shift", &[x.clone(), shift], &|t| {
            add_to_channels(&t[0], &t[1])
        });
        let narrow = normal(22, &[2, 4, height, width]);
        agree("concatenation", &[x.clone(), narrow], &|t| {
            concatenate_channels(&t[0], &t[1])
        });
        agree("tokens", std::slice::from_ref(&x), &|t| tokens_of(&t[0]));
        let tokens = normal(23, &[2, height * width, 19]);
        agree("image of tokens", &[x.clone(), tokens], &|t| {
            add_tokens(&t[0], &t[1])
        });
    }
}
