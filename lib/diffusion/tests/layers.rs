//! Gradients of every layer against central differences, half precision
//! against f32, extreme inputs, and the same bytes for any number of threads.

mod differences;

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};
use differences::{Outcome, assert_gradients_of, normal};
use dipir_diffusion::layers::{
    Activation, Attention, Causality, Conv2d, Embedding, GroupNorm, LayerNorm, Linear,
    NormActivation, Padding, activate, geglu, upsample_nearest,
};
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::vae::{pixel_shuffle, pixel_unshuffle};

/// A layer as a function of all its tensors.
type Layer<'a> = &'a dyn Fn(&[Tensor]) -> dipir_diffusion::Result<Tensor>;

/// Compares the gradients of a layer at all `inputs` with differences.
fn assert_gradients(name: &str, inputs: &[Tensor], layer: Layer) -> Outcome {
    let variable = |(i, x): (usize, &Tensor)| Ok((format!("input {i}"), Var::from_tensor(x)?));
    let variables = inputs.iter().enumerate().map(variable);
    let variables = variables.collect::<Result<Vec<_>, candle_core::Error>>()?;
    let tensors: Vec<Tensor> = variables.iter().map(|v| v.1.as_tensor().clone()).collect();
    assert_gradients_of(name, &variables, &|| layer(&tensors))
}

#[test]
fn linear_layers_pass_gradients() -> Outcome {
    let inputs = [normal(1, &[2, 5, 7]), normal(2, &[3, 7]), normal(3, &[3])];
    assert_gradients("linear", &inputs, &|t| {
        Linear::from_tensors(t[1].clone(), Some(t[2].clone()))?.forward(&t[0])
    })?;
    assert_gradients("no bias", &inputs[..2], &|t| {
        Linear::from_tensors(t[1].clone(), None)?.forward(&t[0])
    })
}

#[test]
fn convolutions_of_every_kind_pass_gradients() -> Outcome {
    for (kernel, stride, padding, size) in [
        (3, 1, Padding::Same(1), (6, 9)),
        (3, 1, Padding::Same(1), (1, 2)),
        (3, 1, Padding::Same(1), (13, 12)),
        (3, 2, Padding::Same(1), (7, 6)),
        (3, 2, Padding::After(1), (6, 8)),
        (1, 1, Padding::Same(0), (4, 5)),
        (3, 1, Padding::Same(0), (5, 4)),
        (2, 2, Padding::Same(0), (6, 6)),
    ] {
        let name = format!("conv {kernel} stride {stride} {padding:?} {size:?}");
        let inputs = [
            normal(4, &[2, 5, size.0, size.1]),
            normal(5, &[6, 5, kernel, kernel]),
            normal(6, &[6]),
        ];
        assert_gradients(&name, &inputs, &|t| {
            Conv2d::from_tensors(t[1].clone(), t[2].clone(), stride, padding)?.forward(&t[0])
        })?;
    }
    Ok(())
}

/// Checks `found` against sums of products in f64, each with the sum of its terms' squares. Transformed convolutions
/// weigh products of a tile by up to 64 and cancel them again, so that rounding is 8 to 14 ulp of the norm of the
/// terms in the mean and up to 230 ulp in the worst of ten thousand sums.
fn assert_sums(name: &str, found: &[f32], exact: &[(f64, f64)]) {
    assert_eq!(found.len(), exact.len(), "{name}");
    let norm = (exact.iter().map(|sum| sum.1).sum::<f64>() / exact.len() as f64).sqrt();
    let ulp = norm * f32::EPSILON as f64;
    let errors = || {
        found
            .iter()
            .zip(exact)
            .map(|(&found, exact)| (found as f64 - exact.0) / ulp)
    };
    let mean = (errors().map(|e| e * e).sum::<f64>() / found.len() as f64).sqrt();
    let worst = errors().fold(0f64, |worst, e| worst.max(e.abs()));
    assert!(
        mean < 20.0 && worst < 400.0,
        "{name}: {mean} ulp in the mean, {worst} at worst"
    );
}

#[test]
fn convolutions_and_their_gradients_are_sums_of_their_definition() -> Outcome {
    // Sizes that take the blocked and the transformed paths, full and partial tiles, lanes, chunks and groups.
    for (batch, inputs, outputs, height, width, pad) in [
        (1, 3, 4, 5, 7, 1),
        (1, 16, 24, 33, 17, 1),
        (1, 40, 24, 16, 16, 1),
        (3, 33, 17, 9, 14, 0),
        (5, 70, 36, 20, 18, 2),
    ] {
        let name = format!("{inputs} to {outputs} channels");
        let (x, w, b) = (
            Var::from_tensor(&normal(7, &[batch, inputs, height, width]))?,
            Var::from_tensor(&normal(8, &[outputs, inputs, 3, 3]))?,
            Var::from_tensor(&normal(9, &[outputs]))?,
        );
        let conv = Conv2d::from_tensors(
            w.as_tensor().clone(),
            b.as_tensor().clone(),
            1,
            Padding::Same(pad),
        )?;
        let y = conv.forward(&x)?;
        let (down, across) = (height + 2 * pad - 2, width + 2 * pad - 2);
        assert_eq!(y.dims(), [batch, outputs, down, across], "{name}");
        let g = normal(10, y.dims());
        let gradients = (&y * &g)?.sum_all()?.backward()?;
        let values = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let (xs, ws, bs, gs) = (values(&x)?, values(&w)?, values(&b)?, values(&g)?);

        let mut y_exact: Vec<(f64, f64)> = (0..gs.len())
            .map(|i| bs[i / (down * across) % outputs] as f64)
            .map(|bias| (bias, bias * bias))
            .collect();
        let mut dx_exact = vec![(0f64, 0f64); xs.len()];
        let mut dw_exact = vec![(0f64, 0f64); ws.len()];
        let add = |sum: &mut (f64, f64), a: f32, b: f32| {
            let term = a as f64 * b as f64;
            *sum = (sum.0 + term, sum.1 + term * term);
        };
        for (index, y) in y_exact.iter_mut().enumerate() {
            let (image, i, j) = (
                index / (outputs * down * across),
                index / across % down,
                index % across,
            );
            let output = index / (down * across) % outputs;
            for (c, tap) in (0..inputs).flat_map(|c| (0..9).map(move |tap| (c, tap))) {
                let (row, column) = (
                    (i + tap / 3).wrapping_sub(pad),
                    (j + tap % 3).wrapping_sub(pad),
                );
                if row < height && column < width {
                    let x = ((image * inputs + c) * height + row) * width + column;
                    let w = (output * inputs + c) * 9 + tap;
                    add(y, xs[x], ws[w]);
                    add(&mut dx_exact[x], gs[index], ws[w]);
                    add(&mut dw_exact[w], gs[index], xs[x]);
                }
            }
        }
        let gradient = |t: &Tensor| gradients.get(t).ok_or("no gradient").map(values);
        assert_sums(&format!("{name}: result"), &values(&y)?, &y_exact);
        assert_sums(
            &format!("{name}: gradient of the input"),
            &gradient(&x)??,
            &dx_exact,
        );
        assert_sums(
            &format!("{name}: gradient of the weights"),
            &gradient(&w)??,
            &dw_exact,
        );
    }
    Ok(())
}

/// More tiles than are transformed at a time: 2048 of 64 channels on either side.
#[test]
fn a_batch_is_convolved_image_by_image() -> Outcome {
    let (x, g) = (normal(7, &[8, 64, 64, 64]), normal(10, &[8, 64, 64, 64]));
    let w = Var::from_tensor(&normal(8, &[64, 64, 3, 3]))?;
    let conv = Conv2d::from_tensors(w.as_tensor().clone(), normal(9, &[64]), 1, Padding::Same(1))?;
    let run = |x: &Tensor, g: &Tensor| -> Result<(Tensor, Tensor), Box<dyn std::error::Error>> {
        let y = conv.forward(x)?;
        let gradients = (&y * g)?.sum_all()?.backward()?;
        Ok((y, gradients.get(&w).ok_or("no gradient")?.clone()))
    };
    let (y, dw) = run(&x, &g)?;
    let mut sum = w.zeros_like()?;
    for image in 0..8 {
        let (one, gradient) = run(&x.narrow(0, image, 1)?, &g.narrow(0, image, 1)?)?;
        let here = y.narrow(0, image, 1)?;
        assert_eq!(
            here.flatten_all()?.to_vec1::<f32>()?,
            one.flatten_all()?.to_vec1::<f32>()?
        );
        sum = (sum + gradient)?;
    }
    // Both round sums of 32,768 terms: 14 ulp of their norm each in the mean, 400 at most.
    let error = (dw - sum)?.abs()?.max_all()?.to_scalar::<f32>()?;
    assert!(
        error < 2.0 * 400.0 * f32::EPSILON * 32768f32.sqrt(),
        "{error}"
    );
    Ok(())
}

/// A norm built on tensors that the test varies.
fn with_parameters<T>(
    tensors: &[Tensor],
    build: impl Fn(&Parameters) -> dipir_diffusion::Result<T>,
) -> dipir_diffusion::Result<T> {
    build(&Parameters::from_tensors(BTreeMap::from([
        ("weight".to_owned(), tensors[0].clone()),
        ("bias".to_owned(), tensors[1].clone()),
    ])))
}

#[test]
fn norms_pass_gradients() -> Outcome {
    for activation in [NormActivation::None, NormActivation::Silu] {
        let inputs = [
            normal(10, &[2, 6, 3, 5]),
            normal(11, &[6]),
            normal(12, &[6]),
        ];
        assert_gradients("group norm", &inputs, &|t| {
            with_parameters(&t[1..], |p| GroupNorm::new(p, 3, 6, 1e-5, activation))?.forward(&t[0])
        })?;
    }
    let inputs = [normal(13, &[2, 5, 9]), normal(14, &[9]), normal(15, &[9])];
    assert_gradients("layer norm", &inputs, &|t| {
        with_parameters(&t[1..], |p| LayerNorm::new(p, 9, 1e-5))?.forward(&t[0])
    })
}

#[test]
fn attention_passes_gradients() -> Outcome {
    for (heads, queries, keys, causality) in [
        (1, 40, 7, Causality::Full),
        (2, 5, 9, Causality::Full),
        (4, 6, 6, Causality::Causal),
    ] {
        let inputs = [
            normal(16, &[2, queries, 8]),
            normal(17, &[2, keys, 8]),
            normal(18, &[2, keys, 8]),
        ];
        let attention = Attention { heads, causality };
        assert_gradients("attention", &inputs, &|t| {
            attention.forward(&t[0], &t[1], &t[2])
        })?;
    }
    Ok(())
}

#[test]
fn activations_and_enlargement_pass_gradients() -> Outcome {
    for f in [Activation::Silu, Activation::Gelu, Activation::QuickGelu] {
        assert_gradients("activation", &[normal(19, &[3, 11])], &|t| {
            activate(f, &t[0])
        })?;
    }
    assert_gradients("geglu", &[normal(20, &[2, 3, 10])], &|t| geglu(&t[0]))?;
    assert_gradients("enlargement", &[normal(21, &[2, 3, 4, 5])], &|t| {
        upsample_nearest(&t[0], 7, 10)
    })?;
    // A second consumer of the input must not lose its share.
    assert_gradients("two consumers", &[normal(22, &[1, 2, 3, 3])], &|t| {
        Ok((upsample_nearest(&t[0], 6, 6)? + upsample_nearest(&t[0].sqr()?, 6, 6)?)?)
    })
}

#[test]
fn tables_and_rearranged_pixels_pass_gradients() -> Outcome {
    // Row 2 is taken twice, row 1 never.
    let indices = Tensor::new(&[[2u32, 0], [3, 2]], &Device::Cpu)?;
    assert_gradients("table", &[normal(43, &[4, 3])], &|t| {
        let table = BTreeMap::from([("weight".to_owned(), t[0].clone())]);
        Embedding::new(&Parameters::from_tensors(table), 4, 3)?.forward(&indices)
    })?;
    assert_gradients("pixels to channels", &[normal(44, &[2, 3, 4, 6])], &|t| {
        pixel_unshuffle(&t[0], 2)
    })?;
    assert_gradients("channels to pixels", &[normal(45, &[2, 12, 2, 3])], &|t| {
        pixel_shuffle(&t[0], 2)
    })
}

#[test]
fn attention_survives_logits_of_3e5() -> Outcome {
    // The second has several blocks of keys: the largest so far is corrected from one to the next.
    survives_large_logits(12)?;
    survives_large_logits(300)
}

fn survives_large_logits(keys: usize) -> Outcome {
    // q k of 8 heads x 40 channels with entries of 90 gives |logits| to 3e5.
    let (q, k, v) = (
        normal(23, &[1, 12, 320]),
        normal(24, &[1, keys, 320]),
        normal(25, &[1, keys, 320]),
    );
    let (q, k) = ((q * 90.0)?, (k * 90.0)?);
    let attention = Attention {
        heads: 8,
        causality: Causality::Full,
    };
    let y = attention.forward(&q, &k, &v)?;
    // Softmax in f64 is one-hot here wherever the two largest logits differ
    // by more than 20: compare with the value of the largest key.
    let (qs, ks) = (q.to_dtype(DType::F64)?, k.to_dtype(DType::F64)?);
    let mut checked = 0;
    for head in 0..8 {
        let part = |t: &Tensor| t.narrow(2, head * 40, 40).and_then(|t| t.squeeze(0));
        let logits = (part(&qs)?.matmul(&part(&ks)?.t()?)? / 40f64.sqrt())?.to_vec2::<f64>()?;
        for (query, row) in logits.iter().enumerate() {
            let mut order: Vec<usize> = (0..row.len()).collect();
            order.sort_by(|&a, &b| row[b].total_cmp(&row[a]));
            if row[order[0]] - row[order[1]] < 20.0 {
                continue;
            }
            let found = part(&y)?.get(query)?.to_vec1::<f32>()?;
            let wanted = part(&v)?.get(order[0])?.to_vec1::<f32>()?;
            for (a, b) in found.iter().zip(&wanted) {
                assert!(
                    (a - b).abs() < 1e-5,
                    "head {head}, query {query}: {a} instead of {b}"
                );
            }
            checked += 1;
        }
    }
    assert!(checked > 50, "only {checked} rows were clear");
    // In half precision: products beyond 65504 must not overflow.
    for (dtype, tolerance) in [(DType::F16, 2e-3), (DType::BF16, 2e-2)] {
        let half = |t: &Tensor| t.to_dtype(dtype);
        let (q, k, v) = (half(&q)?, half(&k)?, half(&v)?);
        let found = attention.forward(&q, &k, &v)?.to_dtype(DType::F32)?;
        let exact = attention.forward(
            &q.to_dtype(DType::F32)?,
            &k.to_dtype(DType::F32)?,
            &v.to_dtype(DType::F32)?,
        )?;
        let error = (found - exact)?.abs()?.max_all()?.to_scalar::<f32>()?;
        // Rounding of the result alone: half an ulp of values up to 4.
        assert!(error < tolerance * 4.0, "{dtype:?}: {error}");
    }
    Ok(())
}

#[test]
fn half_precision_layers_reduce_in_f32() -> Outcome {
    // 1e4 + small: sums of 4096 such values overflow f16, and lose the small
    // part in bf16, unless they are taken in f32.
    let x = ((normal(26, &[1, 8, 64, 64]) * 100.0)? + 1e4)?;
    for dtype in [DType::F16, DType::BF16] {
        let stored = x.to_dtype(dtype)?;
        let layer = |t: &Tensor| -> dipir_diffusion::Result<Tensor> {
            let ones = [
                Tensor::ones(8, t.dtype(), &Device::Cpu)?,
                Tensor::zeros(8, t.dtype(), &Device::Cpu)?,
            ];
            with_parameters(&ones, |p| {
                GroupNorm::new(p, 2, 8, 1e-5, NormActivation::None)
            })?
            .forward(t)
        };
        let found = layer(&stored)?.to_dtype(DType::F32)?;
        let exact = layer(&stored.to_dtype(DType::F32)?)?;
        let error = (found - exact)?.abs()?.max_all()?.to_scalar::<f32>()?;
        // Half an ulp of normalised values up to 8: 2^-9 or 2^-6 relative.
        let ulp = if dtype == DType::F16 {
            8.0 / 2048.0
        } else {
            8.0 / 256.0
        };
        assert!(error <= ulp, "{dtype:?}: {error}");
    }
    Ok(())
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() -> Outcome {
    for dtype in [DType::F32, DType::BF16] {
        assert_same_bytes(dtype)?;
    }
    Ok(())
}

fn assert_same_bytes(dtype: DType) -> Outcome {
    let number = |stream, shape: &[usize]| normal(stream, shape).to_dtype(dtype);
    let x = number(27, &[2, 24, 19, 23])?;
    let (w, b) = (number(28, &[32, 24, 3, 3])?, number(29, &[32])?);
    let tokens = number(30, &[2, 300, 64])?;
    let matrix = number(31, &[64, 64])?;
    let plain = |t: &Tensor| t.to_dtype(DType::F32)?.flatten_all()?.to_vec1();
    let run = || -> dipir_diffusion::Result<Vec<Vec<f32>>> {
        let (x, w) = (Var::from_tensor(&x)?, Var::from_tensor(&w)?);
        let tokens = Var::from_tensor(&tokens)?;
        let y = Conv2d::from_tensors(w.as_tensor().clone(), b.clone(), 1, Padding::Same(1))?
            .forward(&x)?;
        let q = Linear::from_tensors(matrix.clone(), None)?.forward(&tokens)?;
        let a = Attention {
            heads: 4,
            causality: Causality::Full,
        }
        .forward(&q, &tokens, &tokens)?;
        let loss = (y.sqr()?.sum_all()? + a.sqr()?.sum_all()?)?;
        let gradients = loss.backward()?;
        let mut all = vec![plain(&y)?, plain(&a)?];
        for variable in [&x, &w, &tokens] {
            if let Some(gradient) = gradients.get(variable) {
                all.push(plain(gradient)?);
            }
        }
        Ok(all)
    };
    let with_threads = |n: usize| -> Result<Vec<Vec<f32>>, Box<dyn std::error::Error>> {
        Ok(rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()?
            .install(run)?)
    };
    let one = with_threads(1)?;
    assert_eq!(one.len(), 5);
    for threads in [2, 3, 7] {
        // Bit patterns, so that -0 and 0 differ too.
        let bits = |v: &[Vec<f32>]| {
            v.iter()
                .map(|v| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
                .collect::<Vec<_>>()
        };
        assert!(
            bits(&with_threads(threads)?) == bits(&one),
            "{dtype:?}: {threads} threads gave other bytes than one"
        );
    }
    Ok(())
}

#[test]
fn frozen_weights_get_no_gradient() -> Outcome {
    let x = Var::from_tensor(&normal(32, &[1, 4, 6, 6]))?;
    let (w, b) = (normal(33, &[4, 4, 3, 3]), normal(34, &[4]));
    let y = Conv2d::from_tensors(w.clone(), b.clone(), 1, Padding::Same(1))?.forward(&x)?;
    let gradients = y.sum_all()?.backward()?;
    assert!(
        gradients.get(&x).is_some() && gradients.get(&w).is_none() && gradients.get(&b).is_none()
    );
    Ok(())
}

#[test]
fn impossible_shapes_are_refused_with_both_numbers() {
    let attention = Attention {
        heads: 3,
        causality: Causality::Full,
    };
    let x = normal(35, &[1, 4, 8]);
    let message = attention
        .forward(&x, &x, &x)
        .expect_err("8 channels, 3 heads")
        .to_string();
    assert!(
        message.contains("3 heads") && message.contains('8'),
        "{message}"
    );
    let conv = Conv2d::from_tensors(
        normal(36, &[2, 3, 3, 3]),
        normal(37, &[2]),
        1,
        Padding::Same(1),
    )
    .expect("conv");
    let message = conv
        .forward(&normal(38, &[1, 5, 4, 4]))
        .expect_err("5 channels")
        .to_string();
    assert!(
        message.contains("3 channels") && message.contains("5 channels"),
        "{message}"
    );
}

/// <conv(x), g> = <x, conv^T(g)>, in f64, at sizes that take every path: the
/// transformed, the blocked, the strided, the pointwise one, and that of few pixels.
#[test]
fn adjoints_of_large_convolutions_are_adjoint() -> Outcome {
    for (channels, outputs, kernel, stride, padding, side) in [
        (32, 48, 3, 1, Padding::Same(1), 26),
        (17, 33, 3, 1, Padding::Same(1), 31),
        (24, 24, 3, 1, Padding::Same(0), 30),
        (8, 12, 3, 1, Padding::Same(1), 40),
        (24, 16, 3, 2, Padding::Same(1), 33),
        (24, 16, 3, 2, Padding::After(1), 32),
        (24, 40, 1, 1, Padding::Same(0), 27),
        (24, 70, 3, 1, Padding::Same(1), 6),
        (8, 30, 3, 1, Padding::Same(0), 5),
        (5, 40, 5, 1, Padding::After(2), 6),
    ] {
        let name = format!("{channels}->{outputs} kernel {kernel} stride {stride} {padding:?}");
        let x = Var::from_tensor(&normal(40, &[2, channels, side, side]))?;
        let w = Var::from_tensor(&normal(41, &[outputs, channels, kernel, kernel]))?;
        let b = Tensor::zeros(outputs, DType::F32, &Device::Cpu)?;
        let y = Conv2d::from_tensors(w.as_tensor().clone(), b, stride, padding)?.forward(&x)?;
        let g = normal(42, y.dims());
        let gradients = (&y * &g)?.sum_all()?.backward()?;
        let dot = |a: &Tensor, b: &Tensor| -> Result<f64, Box<dyn std::error::Error>> {
            let (a, b) = (a.to_dtype(DType::F64)?, b.to_dtype(DType::F64)?);
            Ok((a * b)?.sum_all()?.to_scalar::<f64>()?)
        };
        let wanted = dot(&y, &g)?;
        let norms = (dot(&y, &y)? * dot(&g, &g)?).sqrt();
        for (what, variable) in [("input", &x), ("weight", &w)] {
            let gradient = gradients.get(variable).ok_or("no gradient")?;
            let found = dot(variable, gradient)?;
            // Rounding of single elements, a few ulp, averages out over
            // thousands: 1e-6 of the product of the norms is far above.
            assert!(
                (found - wanted).abs() < 1e-6 * norms,
                "{name}: {what}: {found} instead of {wanted}"
            );
        }
    }
    Ok(())
}
