//! Attention in tiles: scores of 32 queries and 32 keys never leave the cache [Dao et al. 2022].
//!
//! The value takes the keys in chunks and keeps the largest score and the sum so far of each query. The adjoint computes
//! each query's largest score and sum first, and then every block of scores once more.

mod adjoint;

use half::bf16;
use rayon::prelude::*;

use super::element::{SharedHalves, round};
use super::micro::{DEPTH, Instructions, ROWS, SIDE};
use super::{PackedColumns, TILE, pack_rows, panel_words, with_halves};
use crate::kernels::attention::AttentionShape;
use crate::kernels::matmul::Matrix;
use crate::kernels::simd::vectorized;
use crate::kernels::with_scratch;

pub(crate) use adjoint::attention_vjp;

/// Elements of a block of scores.
const BLOCK: usize = SIDE * SIDE;
/// Blocks of keys of a chunk: scores of 32 queries take 64 KiB.
const CHUNK: usize = 16;
/// Words of a step of columns.
const STEP: usize = DEPTH / 2 * SIDE;

type Sums = [f32; BLOCK];

/// 2^x to 4e-5, for x below 128. Everything below -60 counts as -60: that is nothing beside the largest weight, and no product
/// with it is a denormal number, which would be slow.
#[inline(always)]
fn exp2(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer
    let x = if x < -60.0 { -60.0 } else { x };
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    // Taylor to the fourth power of f ln 2.
    let p = f.mul_add(9.618_129e-3, 5.550_411e-2);
    let p = f.mul_add(p, 0.240_226_5);
    let p = f.mul_add(p, std::f32::consts::LN_2);
    let p = f.mul_add(p, 1.0);
    p * f32::from_bits(shifted.to_bits().wrapping_add(127) << 23)
}

/// Largest score, and sum of the exponentials below it, of 32 queries; scores are times log2 e.
#[derive(Clone, Copy)]
struct Running {
    largest: [f32; SIDE],
    sum: [f32; SIDE],
}

impl Running {
    const NONE: Self = Self {
        largest: [f32::NEG_INFINITY; SIDE],
        sum: [0.0; SIDE],
    };
}

vectorized! {
    /// Takes a chunk of scores, `keys` of them real, into `running`; what sums so far are to be multiplied with goes into
    /// `factors`, and exp(score - largest) into `tiles`.
    fn take_chunk(scores: &mut [f32], keys: usize, factor: f32, running: &mut Running, factors: &mut [f32; SIDE], tiles: &mut [u16]) {
        let blocks = scores.len() / BLOCK;
        for row in 0..SIDE {
            let mut lanes = [f32::NEG_INFINITY; SIDE];
            for block in 0..blocks {
                let scores = &mut scores[block * BLOCK + row * SIDE..][..SIDE];
                if (block + 1) * SIDE > keys {
                    scores[keys - block * SIDE..].fill(f32::NEG_INFINITY);
                }
                for j in 0..SIDE {
                    lanes[j] = if scores[j] > lanes[j] { scores[j] } else { lanes[j] };
                }
            }
            let mut largest = running.largest[row];
            for lane in lanes {
                let scaled = lane * factor;
                largest = if scaled > largest { scaled } else { largest };
            }
            factors[row] = exp2(running.largest[row] - largest);
            running.largest[row] = largest;
            let mut sums = [0f32; SIDE];
            for block in 0..blocks {
                let scores = &mut scores[block * BLOCK + row * SIDE..][..SIDE];
                let mut weights = [0f32; SIDE];
                for j in 0..SIDE {
                    weights[j] = exp2(scores[j].mul_add(factor, -largest));
                }
                if (block + 1) * SIDE > keys {
                    weights[keys - block * SIDE..].fill(0.0);
                }
                let start = (row / ROWS * CHUNK + block) * TILE + row % ROWS * DEPTH;
                let tile = &mut tiles[start..start + DEPTH];
                for j in 0..SIDE {
                    sums[j] += weights[j];
                    tile[j] = round(weights[j]);
                }
            }
            running.sum[row] = running.sum[row] * factors[row] + sums.iter().sum::<f32>();
        }
    }
}

vectorized! {
    /// Multiplies every row with its own factor.
    fn scale_rows(sums: &mut Sums, factors: &[f32; SIDE]) {
        for (row, &factor) in sums.chunks_exact_mut(SIDE).zip(factors) {
            for value in row {
                *value *= factor;
            }
        }
    }
}

vectorized! {
    /// Rows times their factors into `count` rows of `target`, `stride` apart, of `width` elements. They can be written.
    fn store_rows(sums: &Sums, factors: &[f32; SIDE], count: usize, width: usize, target: *mut u16, stride: usize) {
        for (i, row) in sums.chunks_exact(SIDE).enumerate().take(count) {
            let mut bits = [0u16; SIDE];
            for j in 0..SIDE {
                bits[j] = round(row[j] * factors[i]);
            }
            // SAFETY: these elements can be written.
            unsafe { target.wrapping_add(i * stride).copy_from_nonoverlapping(bits.as_ptr(), width) };
        }
    }
}

/// What a head's products read: its first element in tensors of `width` a token, and the packed keys and values.
struct Head {
    offset: usize,
    keys: PackedColumns,
    values: PackedColumns,
}

/// Tokens of one head, [length, head_dim].
fn tokens(shape: AttentionShape, data: &[bf16], offset: usize) -> Matrix<'_, bf16> {
    Matrix {
        data: &data[offset..],
        row: shape.heads * shape.head_dim,
        column: 1,
    }
}

fn block_of(sums: &mut [f32], index: usize) -> &mut Sums {
    let block = &mut sums[index * BLOCK..][..BLOCK];
    block.try_into().expect("32 x 32 sums")
}

/// softmax(scale q k^T) v, heads side by side in the last dimension; every query sees every key.
pub(crate) fn attention(shape: AttentionShape, q: &[bf16], k: &[bf16], v: &[bf16]) -> Vec<bf16> {
    assert!(!shape.causal, "tiles see all keys");
    let (width, d) = (shape.heads * shape.head_dim, shape.head_dim);
    let heads: Vec<Head> = (0..shape.batch * shape.heads)
        .into_par_iter()
        .map(|pair| {
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            let offset = item * shape.keys * width + head * d;
            let keys = tokens(shape, k, offset).transposed();
            Head {
                offset: item * shape.queries * width + head * d,
                keys: PackedColumns::new(keys, (d, shape.keys)),
                values: PackedColumns::new(tokens(shape, v, offset), (shape.keys, d)),
            }
        })
        .collect();
    let mut out = Vec::with_capacity(q.len());
    let target = SharedHalves(out.as_mut_ptr());
    let blocks = shape.queries.div_ceil(SIDE);
    (0..heads.len() * blocks).into_par_iter().for_each(|job| {
        let (head, first) = (&heads[job / blocks], job % blocks * SIDE);
        let rows = SIDE.min(shape.queries - first);
        let depth = d.div_ceil(DEPTH);
        with_halves(2 * depth * TILE, |queries| {
            pack_rows(tokens(shape, q, head.offset), first, rows, d, queries);
            // SAFETY: each job writes its own queries of its own head, all within `out`.
            let out = unsafe { target.at(head.offset + first * width) };
            with_scratch((CHUNK + d.div_ceil(SIDE)) * BLOCK, |scratch| {
                one_block(shape, head, queries, rows, scratch, out);
            });
        });
    });
    // SAFETY: every query of every head has been written.
    unsafe { out.set_len(q.len()) };
    out
}

/// Scores of 32 queries, in two blocks of packed rows, and `count` blocks of keys from `first`.
fn score(
    instructions: &Instructions,
    queries: [&[u16]; 2],
    keys: &PackedColumns,
    (first, count): (usize, usize),
    scores: &mut [f32],
) {
    let (depth, words) = (keys.k.div_ceil(DEPTH), panel_words(keys.k));
    let steps: Vec<usize> = (0..depth).map(|step| step * STEP).collect();
    let queries = queries.map(|queries| queries[..depth * TILE].as_ptr());
    for block in 0..count {
        let keys = &keys.words[(first + block) * words..][..words];
        let scores = block_of(scores, block);
        // SAFETY: queries and keys were measured, and are as deep as the steps go.
        unsafe { instructions.multiply(queries, keys.as_ptr(), &steps, SIDE, scores, true) };
    }
}

/// The value of 32 queries of a head, of which `rows` are stored from `out`.
fn one_block(
    shape: AttentionShape,
    head: &Head,
    queries: &[u16],
    rows: usize,
    scratch: &mut [f32],
    out: *mut u16,
) {
    let (d, width) = (shape.head_dim, shape.heads * shape.head_dim);
    let (depth, key_blocks) = (d.div_ceil(DEPTH), shape.keys.div_ceil(SIDE));
    let (scores, sums) = scratch.split_at_mut(CHUNK * BLOCK);
    let factor = shape.scale * std::f32::consts::LOG2_E;
    let steps: Vec<usize> = (0..CHUNK).map(|step| step * STEP).collect();
    let instructions = Instructions::start();
    let mut running = Running::NONE;
    with_halves(2 * CHUNK * TILE, |tiles| {
        for first in (0..key_blocks).step_by(CHUNK) {
            let count = CHUNK.min(key_blocks - first);
            let halves = [queries, &queries[depth * TILE..]];
            score(&instructions, halves, &head.keys, (first, count), scores);
            let scores = &mut scores[..count * BLOCK];
            let mut factors = [0.0; SIDE];
            let left = (shape.keys - first * SIDE).min(count * SIDE);
            take_chunk(scores, left, factor, &mut running, &mut factors, tiles);
            let weights = [tiles.as_ptr(), tiles[CHUNK * TILE..].as_ptr()];
            for panel in 0..d.div_ceil(SIDE) {
                let sums = block_of(sums, panel);
                if first > 0 {
                    scale_rows(sums, &factors);
                }
                let start = panel * panel_words(shape.keys) + first * STEP;
                let values = &head.values.words[start..][..count * STEP];
                // SAFETY: weights and values have `count` steps.
                unsafe {
                    let steps = &steps[..count];
                    instructions.multiply(weights, values.as_ptr(), steps, SIDE, sums, first == 0);
                }
            }
        }
    });
    let inverse = running.sum.map(|sum| 1.0 / sum);
    for panel in 0..d.div_ceil(SIDE) {
        let columns = SIDE.min(d - panel * SIDE);
        let out = out.wrapping_add(panel * SIDE);
        store_rows(block_of(sums, panel), &inverse, rows, columns, out, width);
    }
}
