//! Gradients of attention in tiles.

use half::bf16;
use rayon::prelude::*;

use super::super::element::{SharedHalves, round, turn_floats};
use super::super::micro::{DEPTH, Instructions, ROWS, SIDE};
use super::super::{PackedColumns, TILE, pack_rows, panel_words, with_halves, with_words};
use super::{BLOCK, CHUNK, Running, STEP, Sums, block_of, exp2, store_rows, take_chunk, tokens};
use crate::kernels::attention::AttentionShape;
use crate::kernels::simd::vectorized;
use crate::kernels::with_scratch;

/// Blocks of queries and of keys that are worked on together.
const GROUP: usize = 4;

vectorized! {
    /// From 32 x 32 scores and gradients at the weights: weights and gradients at the scores, in pairs of queries and, of
    /// the latter, in tiles. `level` is what to take off the scaled scores of a query, `mean` its mean gradient; weights of
    /// keys from `keys` on are 0.
    fn weigh(
        scores: &Sums,
        gradients: &Sums,
        factor: f32,
        level: &[f32; SIDE],
        mean: &[f32; SIDE],
        keys: usize,
        weight_pairs: &mut [u32],
        gradient_pairs: &mut [u32],
        tiles: [&mut [u16]; 2],
    ) {
        for pair in 0..SIDE / 2 {
            let mut bits = [[[0u16; SIDE]; 2]; 2];
            for side in 0..2 {
                let row = 2 * pair + side;
                let (scores, gradients) = (&scores[row * SIDE..][..SIDE], &gradients[row * SIDE..][..SIDE]);
                let mut weights = [0f32; SIDE];
                for j in 0..SIDE {
                    weights[j] = exp2(scores[j].mul_add(factor, -level[row]));
                }
                if keys < SIDE {
                    weights[keys..].fill(0.0);
                }
                for j in 0..SIDE {
                    bits[side][0][j] = round(weights[j]);
                    bits[side][1][j] = round(weights[j] * (gradients[j] - mean[row]));
                }
                tiles[row / ROWS][row % ROWS * DEPTH..][..DEPTH].copy_from_slice(&bits[side][1]);
            }
            for j in 0..SIDE {
                weight_pairs[pair * SIDE + j] = bits[0][0][j] as u32 | (bits[1][0][j] as u32) << 16;
                gradient_pairs[pair * SIDE + j] = bits[0][1][j] as u32 | (bits[1][1][j] as u32) << 16;
            }
        }
    }
}

/// A head's tokens, packed in every way that its products read them.
struct Packed {
    /// [queries, head_dim] and [head_dim, queries] in tiles of rows.
    queries: Vec<u16>,
    queries_turned: Vec<u16>,
    gradients: Vec<u16>,
    gradients_turned: Vec<u16>,
    /// [head_dim, keys] and [keys, head_dim] in columns.
    keys_turned: PackedColumns,
    values_turned: PackedColumns,
    keys: PackedColumns,
}

/// Gradients of [`super::attention`], whose value is `y`: (dq, dk, dv). One job owns a head.
pub(crate) fn attention_vjp(
    shape: AttentionShape,
    [q, k, v]: [&[bf16]; 3],
    y: &[bf16],
    g: &[bf16],
) -> (Vec<bf16>, Vec<bf16>, Vec<bf16>) {
    assert!(!shape.causal, "tiles see all keys");
    let mut results = [q, k, k].map(|like| Vec::with_capacity(like.len()));
    let targets = results
        .each_mut()
        .map(|result| SharedHalves(result.as_mut_ptr()));
    let width = shape.heads * shape.head_dim;
    (0..shape.batch * shape.heads)
        .into_par_iter()
        .for_each(|pair| {
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            let offset = |length: usize| item * length * width + head * shape.head_dim;
            let (at_queries, at_keys) = (offset(shape.queries), offset(shape.keys));
            let rows = |data, turned: bool| {
                let view = tokens(shape, data, at_queries);
                let (view, (m, k)) = match turned {
                    true => (view.transposed(), (shape.head_dim, shape.queries)),
                    false => (view, (shape.queries, shape.head_dim)),
                };
                let mut packed = vec![0; m.div_ceil(SIDE) * 2 * k.div_ceil(DEPTH) * TILE];
                pack_rows(view, 0, m, k, &mut packed);
                packed
            };
            let columns = |data| {
                let view = tokens(shape, data, at_keys).transposed();
                PackedColumns::new(view, (shape.head_dim, shape.keys))
            };
            let packed = Packed {
                queries: rows(q, false),
                queries_turned: rows(q, true),
                gradients: rows(g, false),
                gradients_turned: rows(g, true),
                keys_turned: columns(k),
                values_turned: columns(v),
                keys: PackedColumns::new(tokens(shape, k, at_keys), (shape.keys, shape.head_dim)),
            };
            let means: Vec<f32> = (0..shape.queries)
                .map(|query| {
                    let row =
                        at_queries + query * width..at_queries + query * width + shape.head_dim;
                    let terms = g[row.clone()].iter().zip(&y[row]);
                    terms.map(|(g, y)| g.to_f32() * y.to_f32()).sum()
                })
                .collect();
            // SAFETY: each job writes the elements of its own head.
            let targets = unsafe {
                let [dq, dk, dv] = targets;
                [dq.at(at_queries), dk.at(at_keys), dv.at(at_keys)]
            };
            one_head(shape, &packed, &means, targets);
        });
    let lengths = [q.len(), k.len(), k.len()];
    for (result, len) in results.iter_mut().zip(lengths) {
        // SAFETY: every token of every head has been written.
        unsafe { result.set_len(len) };
    }
    let [dq, dk, dv] = results;
    (dq, dk, dv)
}

/// log2 of the sum of the exponentials of each query's scaled scores; far above every score where there is no query.
fn levels(shape: AttentionShape, packed: &Packed, factor: f32) -> Vec<[f32; SIDE]> {
    let depth = shape.head_dim.div_ceil(DEPTH);
    let key_blocks = shape.keys.div_ceil(SIDE);
    let steps: Vec<usize> = (0..depth).map(|step| step * STEP).collect();
    let instructions = Instructions::start();
    let one = |block: usize, scores: &mut [f32], tiles: &mut [u16]| {
        let rows = [0, 1].map(|half| packed.queries[(2 * block + half) * depth * TILE..].as_ptr());
        let mut running = Running::NONE;
        for first in (0..key_blocks).step_by(CHUNK) {
            let count = CHUNK.min(key_blocks - first);
            for key in 0..count {
                let words = panel_words(shape.head_dim);
                let keys = &packed.keys_turned.words[(first + key) * words..][..words];
                // SAFETY: queries and keys are packed as deep as the steps go.
                unsafe {
                    let scores = block_of(scores, key);
                    instructions.multiply(rows, keys.as_ptr(), &steps, SIDE, scores, true);
                }
            }
            let left = (shape.keys - first * SIDE).min(count * SIDE);
            let scores = &mut scores[..count * BLOCK];
            take_chunk(scores, left, factor, &mut running, &mut [0.0; SIDE], tiles);
        }
        std::array::from_fn(|row| match block * SIDE + row < shape.queries {
            true => running.largest[row] + running.sum[row].log2(),
            false => 1e30,
        })
    };
    with_scratch(CHUNK * BLOCK, |scores| {
        with_halves(2 * CHUNK * TILE, |tiles| {
            let blocks = 0..shape.queries.div_ceil(SIDE);
            blocks.map(|block| one(block, scores, tiles)).collect()
        })
    })
}

/// The gradients of one head, into rows of tokens from each of `targets`.
fn one_head(shape: AttentionShape, packed: &Packed, means: &[f32], [dq, dk, dv]: [*mut u16; 3]) {
    let (d, width) = (shape.head_dim, shape.heads * shape.head_dim);
    let (depth, panels) = (d.div_ceil(DEPTH), d.div_ceil(SIDE));
    let (query_blocks, key_blocks) = (shape.queries.div_ceil(SIDE), shape.keys.div_ceil(SIDE));
    let factor = shape.scale * std::f32::consts::LOG2_E;
    let levels = levels(shape, packed, factor);
    let steps: Vec<usize> = (0..depth.max(GROUP)).map(|step| step * STEP).collect();
    let instructions = Instructions::start();
    let multiply = |a: [&[u16]; 2], b: &[u32], steps: &[usize], sums: &mut Sums, anew: bool| {
        let tiles = a.map(|a| a[..steps.len() * TILE].as_ptr());
        let words = b[..steps.len() * STEP].as_ptr();
        // SAFETY: both were just measured.
        unsafe { instructions.multiply(tiles, words, steps, SIDE, sums, anew) };
    };
    // Two blocks of 16 rows, `depth` steps each, from step `first`.
    fn rows(packed: &[u16], block: usize, depth: usize, first: usize) -> [&[u16]; 2] {
        [0, 1].map(|half| &packed[((2 * block + half) * depth + first) * TILE..])
    }
    let ones = [1.0; SIDE];
    let scaled = [shape.scale; SIDE];
    let group_words = GROUP * GROUP * STEP;
    with_scratch(query_blocks * panels * BLOCK, |at_queries| {
        with_scratch((2 * GROUP * panels + 2) * BLOCK, |scratch| {
            with_words(2 * group_words, |words| {
                with_halves(GROUP * 2 * GROUP * TILE, |tiles| {
                    let (pair, sums) = scratch.split_at_mut(2 * BLOCK);
                    let (scores, gradients) = pair.split_at_mut(BLOCK);
                    let (at_values, at_keys) = sums.split_at_mut(GROUP * panels * BLOCK);
                    let (weight_pairs, gradient_pairs) = words.split_at_mut(group_words);
                    for first_key in (0..key_blocks).step_by(GROUP) {
                        let keys = GROUP.min(key_blocks - first_key);
                        for first in (0..query_blocks).step_by(GROUP) {
                            let queries = GROUP.min(query_blocks - first);
                            for i in 0..queries {
                                let block = first + i;
                                let mut mean = [0.0; SIDE];
                                let of_block = &means[block * SIDE..];
                                let count = SIDE.min(of_block.len());
                                mean[..count].copy_from_slice(&of_block[..count]);
                                for j in 0..keys {
                                    let at = (first_key + j) * panel_words(d);
                                    let (scores, gradients) =
                                        (block_of(scores, 0), block_of(gradients, 0));
                                    let steps = &steps[..depth];
                                    let b = &packed.keys_turned.words[at..];
                                    multiply(
                                        rows(&packed.queries, block, depth, 0),
                                        b,
                                        steps,
                                        scores,
                                        true,
                                    );
                                    let b = &packed.values_turned.words[at..];
                                    multiply(
                                        rows(&packed.gradients, block, depth, 0),
                                        b,
                                        steps,
                                        gradients,
                                        true,
                                    );
                                    let (low, high) = tiles[i * 2 * GROUP * TILE..]
                                        [..2 * GROUP * TILE]
                                        .split_at_mut(GROUP * TILE);
                                    let tiles =
                                        [low, high].map(|half| &mut half[j * TILE..][..TILE]);
                                    let pairs = (j * GROUP + i) * STEP..(j * GROUP + i + 1) * STEP;
                                    let left = (shape.keys - (first_key + j) * SIDE).min(SIDE);
                                    weigh(
                                        scores,
                                        gradients,
                                        factor,
                                        &levels[block],
                                        &mean,
                                        left,
                                        &mut weight_pairs[pairs.clone()],
                                        &mut gradient_pairs[pairs],
                                        tiles,
                                    );
                                }
                            }
                            for panel in 0..panels {
                                for j in 0..keys {
                                    let (at, steps) = (j * GROUP * STEP, &steps[..queries]);
                                    let a =
                                        rows(&packed.gradients_turned, panel, query_blocks, first);
                                    let sums = block_of(at_values, j * panels + panel);
                                    multiply(a, &weight_pairs[at..], steps, sums, first == 0);
                                    let a =
                                        rows(&packed.queries_turned, panel, query_blocks, first);
                                    let sums = block_of(at_keys, j * panels + panel);
                                    multiply(a, &gradient_pairs[at..], steps, sums, first == 0);
                                }
                                for i in 0..queries {
                                    let start = panel * panel_words(shape.keys) + first_key * STEP;
                                    let b = &packed.keys.words[start..];
                                    let sums = block_of(at_queries, (first + i) * panels + panel);
                                    multiply(
                                        rows(tiles, i, GROUP, 0),
                                        b,
                                        &steps[..keys],
                                        sums,
                                        first_key == 0,
                                    );
                                }
                            }
                        }
                        for j in 0..keys {
                            let first = (first_key + j) * SIDE;
                            let count = SIDE.min(shape.keys - first);
                            for panel in 0..panels {
                                let columns = SIDE.min(d - panel * SIDE);
                                let at = first * width + panel * SIDE;
                                for (sums, factors, target) in
                                    [(&mut *at_values, &ones, dv), (&mut *at_keys, &scaled, dk)]
                                {
                                    let turned = turn_floats(block_of(sums, j * panels + panel));
                                    let target = target.wrapping_add(at);
                                    store_rows(&turned, factors, count, columns, target, width);
                                }
                            }
                        }
                    }
                });
            });
        });
        for block in 0..query_blocks {
            let count = SIDE.min(shape.queries - block * SIDE);
            for panel in 0..panels {
                let columns = SIDE.min(d - panel * SIDE);
                let target = dq.wrapping_add(block * SIDE * width + panel * SIDE);
                let sums = block_of(at_queries, block * panels + panel);
                store_rows(sums, &scaled, count, columns, target, width);
            }
        }
    });
}
