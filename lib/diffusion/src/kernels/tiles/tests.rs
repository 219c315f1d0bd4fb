use half::bf16;

use super::micro::{Instructions, Kind, kinds};
use super::*;
use crate::kernels::attention::{self, AttentionShape};
use crate::kernels::conv::{self, ConvShape};
use crate::kernels::matmul::Engine;

/// Numbers of both signs that bf16 holds as they are.
fn values(len: usize, seed: usize) -> Vec<f32> {
    let value = |i: usize| ((i + seed) * 2_654_435_761 % 1009) as f32 / 504.0 - 1.0;
    (0..len)
        .map(|i| bf16::from_f32(value(i)).to_f32())
        .collect()
}

fn halves(values: &[f32]) -> Vec<bf16> {
    values.iter().map(|&v| bf16::from_f32(v)).collect()
}

/// What any order of a sum of `terms` products may be off, of the sum of their magnitudes [Higham 2002, 4.4].
fn rounding(terms: usize) -> f64 {
    (terms + 3) as f64 * (-24f64).exp2()
}

#[test]
fn products_match_f64_for_odd_sizes_and_strides() {
    for (m, n, k) in [
        (1, 1, 1),
        (32, 32, 32),
        (33, 31, 65),
        (3, 700, 40),
        (350, 5, 7),
        (140, 900, 70),
        (40, 40, 1300),
        (2, 3, 0),
    ] {
        let (a, b) = (values(m * k, 0), values(n * k, 7));
        for (a_row, a_column, b_row, b_column) in
            [(k, 1, n, 1), (1, m, n, 1), (k, 1, 1, k), (1, m, 1, k)]
        {
            for keep in [0.0, 0.5] {
                let start = match keep {
                    0.0 => vec![f32::NAN; m * n],
                    _ => values(m * n, 3),
                };
                let a_view = Matrix {
                    data: &a[..],
                    row: a_row,
                    column: a_column,
                };
                let (halves_a, halves_b) = (halves(&a), halves(&b));
                let a_halves = Matrix {
                    data: &halves_a[..],
                    row: a_row,
                    column: a_column,
                };
                let b_view = Matrix {
                    data: &b[..],
                    row: b_row,
                    column: b_column,
                };
                let b_halves = Matrix {
                    data: &halves_b[..],
                    row: b_row,
                    column: b_column,
                };
                let mut results = vec![start.clone(); 4];
                for (run, out) in results.iter_mut().enumerate() {
                    let (size, out) = ((m, n, k), out.as_mut_ptr());
                    let packed = PackedColumns::new(b_halves, (k, n));
                    // SAFETY: `out` holds m rows of n elements.
                    unsafe {
                        match run {
                            0 => product(size, out, n, keep, 2.0, a_view, b_view, Threads::One),
                            1 => product(size, out, n, keep, 2.0, a_view, b_view, Threads::All),
                            2 => product(size, out, n, keep, 2.0, a_halves, b_halves, Threads::All),
                            _ => {
                                product_packed(m, out, n, keep, 2.0, a_view, &packed, Threads::All)
                            }
                        }
                    }
                }
                let same = |other: &Vec<f32>| {
                    let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                    bits(other) == bits(&results[0])
                };
                assert!(results.iter().all(same), "{m}x{n}x{k}: bytes differ");
                for i in 0..m {
                    for j in 0..n {
                        let kept = match keep {
                            0.0 => 0.0,
                            _ => keep as f64 * start[i * n + j] as f64,
                        };
                        let terms = (0..k).map(|p| {
                            a[i * a_row + p * a_column] as f64 * b[p * b_row + j * b_column] as f64
                        });
                        let sum = kept + 2.0 * terms.clone().sum::<f64>();
                        let size = kept.abs() + 2.0 * terms.map(f64::abs).sum::<f64>();
                        let error = (results[0][i * n + j] as f64 - sum).abs();
                        assert!(
                            error <= rounding(k) * size + 1e-30,
                            "{m}x{n}x{k} at {i},{j}: {} not {sum}",
                            results[0][i * n + j]
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn every_kind_of_instruction_gives_the_sums_of_its_operands() {
    let (steps, stride) = (3, SIDE + 5);
    let a = values(steps * 2 * TILE, 1);
    let columns = values(2 * steps * DEPTH * stride, 2);
    let mut packed = vec![0; a.len()];
    f32::round_to(&a, &mut packed);
    let mut rounded = vec![0; columns.len()];
    f32::round_to(&columns, &mut rounded);
    let words: Vec<u32> = (rounded.chunks_exact(2))
        .map(|pair| pair[0] as u32 | (pair[1] as u32) << 16)
        .collect();
    let starts: Vec<usize> = (0..steps).map(|s| s * DEPTH / 2 * stride).collect();
    for kind in kinds() {
        for anew in [true, false] {
            let before = values(SIDE * SIDE, 5);
            let mut sums: [f32; SIDE * SIDE] = before.clone().try_into().unwrap();
            let rows = [&packed[..], &packed[steps * TILE..]].map(<[u16]>::as_ptr);
            let instructions = Instructions::of(kind);
            // SAFETY: both blocks have `steps` tiles; the words reach to the last row of the last step.
            unsafe {
                instructions.multiply(rows, words.as_ptr(), &starts, stride, &mut sums, anew)
            };
            for i in 0..SIDE {
                for j in 0..SIDE {
                    let start = if anew {
                        0.0
                    } else {
                        before[i * SIDE + j] as f64
                    };
                    let terms = (0..steps * DEPTH).map(|p| {
                        let (step, within) = (p / DEPTH, p % DEPTH);
                        let row = (i / ROWS * steps + step) * TILE + i % ROWS * DEPTH + within;
                        let word = starts[step] + within / 2 * stride + j;
                        a[row] as f64 * columns[2 * word + within % 2] as f64
                    });
                    let sum = start + terms.clone().sum::<f64>();
                    let size = start.abs() + terms.map(f64::abs).sum::<f64>();
                    let error = (sums[i * SIDE + j] as f64 - sum).abs();
                    assert!(
                        error <= rounding(steps * DEPTH) * size,
                        "{kind:?} at {i},{j}: {error:e}"
                    );
                }
            }
        }
    }
    assert_eq!(bf16_products().is_some(), kinds() != [Kind::Plain]);
}

#[test]
fn convolutions_and_their_adjoints_match_those_in_f32() {
    // Batch, inputs, height, width, outputs, kernel, stride, zeros before and after.
    for (batch, inputs, height, width, outputs, kernel, stride, before, after) in [
        (1, 4, 8, 8, 5, 3, 1, 1, 1),
        (2, 33, 5, 7, 40, 3, 1, 1, 1),
        (1, 64, 40, 33, 130, 3, 1, 1, 1),
        (3, 70, 9, 6, 3, 1, 1, 0, 0),
        (2, 32, 8, 10, 33, 3, 2, 1, 1),
        (1, 20, 9, 12, 7, 3, 2, 0, 1),
        (1, 3, 16, 16, 8, 4, 4, 0, 0),
        (1, 5, 6, 6, 4, 5, 1, 2, 2),
        (1, 2, 6, 6, 4, 1, 2, 0, 0),
    ] {
        let shape = ConvShape {
            batch,
            inputs,
            height,
            width,
            outputs,
            kernel,
            stride,
            pad_before: before,
            pad_after: after,
        };
        let x = values(batch * inputs * height * width, 1);
        let w = values(outputs * inputs * kernel * kernel, 4);
        let bias = values(outputs, 9);
        let near = |found: &[bf16], wanted: &[f32], terms: usize| {
            assert_eq!(found.len(), wanted.len());
            for (i, (found, &wanted)) in found.iter().zip(wanted).enumerate() {
                // Both sums round, their magnitudes are at most 1; then the result is rounded.
                let error = (found.to_f32() - wanted).abs() as f64;
                let sums = 2.0 * rounding(terms) * (terms + 1) as f64;
                let bound = sums + (wanted.abs() as f64 + sums) * (-8f64).exp2();
                assert!(error <= bound, "{shape:?} at {i}: {found} not {wanted}");
            }
        };
        let wanted = conv::conv2d_unfolded(shape, &x, &w, Some(&bias));
        let terms = inputs * kernel * kernel;
        let w_halves = halves(&w);
        near(
            &conv2d(shape, &halves(&x), &w_halves, Some(&bias)),
            &wanted,
            terms,
        );
        let g = values(wanted.len(), 6);
        let wanted = conv::fold_product(shape, &g, &w);
        near(
            &conv2d_vjp_input(shape, &halves(&g), &w_halves),
            &wanted,
            outputs * kernel * kernel,
        );
    }
}

#[test]
fn rounding_is_to_nearest_even_and_keeps_what_is_no_number() {
    let odd = f32::from_bits(0x3f81_8000);
    let even = f32::from_bits(0x3f80_8000);
    for value in [
        0.0,
        -0.0,
        1.0,
        -3.5e-5,
        1e30,
        odd,
        even,
        f32::INFINITY,
        f32::MIN_POSITIVE,
    ] {
        let mut bits = [0];
        f32::round_to(&[value], &mut bits);
        assert_eq!(bits[0], bf16::from_f32(value).to_bits(), "{value}");
        assert_eq!(value.bits(), bits[0]);
    }
    assert!(bf16::from_bits(f32::NAN.bits()).is_nan());
    assert!(bf16::from_bits(f32::from_bits(0x7f80_0001).bits()).is_nan());
}

#[test]
fn attention_matches_that_in_f32() {
    for (batch, heads, queries, keys, head_dim) in [
        (1, 1, 1, 1, 1),
        (2, 3, 33, 77, 40),
        (1, 2, 64, 700, 64),
        (1, 1, 40, 513, 160),
    ] {
        let shape = AttentionShape {
            batch,
            heads,
            queries,
            keys,
            head_dim,
            // Sharp: one key takes nearly all of most queries.
            scale: 2.0,
            causal: false,
        };
        let q = values(batch * queries * heads * head_dim, 1);
        let k = values(batch * keys * heads * head_dim, 2);
        let v = values(k.len(), 3);
        let wanted = attention::attention(Engine::best(), shape, &q, &k, &v);
        let y = wanted.clone();
        let g = values(q.len(), 8);
        let by = |values: &Vec<f32>| halves(values);
        let (q_, k_, v_, y_, g_) = (by(&q), by(&k), by(&v), by(&y), by(&g));
        let found = super::attention(shape, &q_, &k_, &v_);
        for (i, (found, wanted)) in found.iter().zip(&wanted).enumerate() {
            // Weights and the result are rounded by 2^-8 at most; values are at most 1. Exponentials are off by 4e-5.
            let error = (found.to_f32() - wanted).abs();
            assert!(
                error <= 2.0 / 256.0 + 2e-4,
                "{shape:?} at {i}: {found} not {wanted}"
            );
        }
        // Both take the mean gradient of a query from the rounded value.
        let y: Vec<f32> = y_.iter().map(|y| y.to_f32()).collect();
        let wanted = attention::attention_vjp(Engine::best(), shape, &q, &k, &v, &y, &g);
        let found = super::attention_vjp(shape, [&q_, &k_, &v_], &y_, &g_);
        let pairs = [
            ("q", &found.0, &wanted.0),
            ("k", &found.1, &wanted.1),
            ("v", &found.2, &wanted.2),
        ];
        for (name, found, wanted) in pairs {
            // Weights and gradients at scores are rounded by 2^-8 each, then the result: of the size of the largest gradient.
            let size = wanted.iter().fold(0f32, |size, v| size.max(v.abs()));
            for (i, (found, wanted)) in found.iter().zip(wanted).enumerate() {
                let error = (found.to_f32() - wanted).abs();
                assert!(
                    error <= 4.0 / 256.0 * size,
                    "{shape:?}, d{name} at {i}: {found} not {wanted}"
                );
            }
        }
    }
}

/// Scores of 3e5: times log2 e, f32 holds them to .03 alone, which is 2% of a weight. Three equal keys share each query.
#[test]
fn weights_at_huge_scores_are_not_scaled_by_the_rounding_of_scores() {
    let (tokens, head_dim) = (39, 32);
    let shape = AttentionShape {
        batch: 1,
        heads: 1,
        queries: tokens,
        keys: tokens,
        head_dim,
        scale: 1.0,
        causal: false,
    };
    let mut q = vec![0.0; tokens * head_dim];
    for i in 0..tokens {
        // bf16 holds multiples of 4 here.
        q[i * head_dim + i / 3] = (544 + 4 * (i / 3)) as f32;
    }
    let (v, g) = (values(q.len(), 3), values(q.len(), 8));
    let [q, v, g] = [&q, &v, &g].map(|values| halves(values));
    let y = super::attention(shape, &q, &q, &v);
    let (_, _, dv) = super::attention_vjp(shape, [&q, &q, &v], &y, &g);
    let third = bf16::from_f32(1.0 / 3.0).to_f32();
    for (i, found) in dv.iter().enumerate() {
        let first = i / head_dim / 3 * 3;
        let shared = (first..first + 3).map(|query| g[query * head_dim + i % head_dim].to_f32());
        let wanted = third * shared.sum::<f32>();
        // The result is rounded, and sums of f32 are.
        let error = (found.to_f32() - wanted).abs();
        assert!(
            error <= wanted.abs() / 256.0 + 1e-6,
            "dv at {i}: {found} not {wanted}"
        );
    }
}
