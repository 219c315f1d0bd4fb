//! Gradients of attention in tiles.

use half::bf16;
use rayon::prelude::*;

use super::super::element::{SharedHalves, round, turn_floats};
use super::super::micro::{DEPTH, Instructions, ROWS, SIDE};
use super::super::{PackedColumns, TILE, pack_rows, panel_words, with_halves};
use super::{
    BLOCK, CHUNK, Running, STEP, Sums, block_of, exp2, score, store_rows, take_chunk, tokens,
};
use crate::kernels::attention::AttentionShape;
use crate::kernels::simd::vectorized;
use crate::kernels::with_scratch;

/// Blocks of queries and of keys that are worked on together.
const GROUP: usize = 4;

vectorized! {
    /// From 32 x 32 scores and gradients at the weights: weights and gradients at the scores, in pairs of queries and, of
    /// the latter, in tiles. `level` has the largest score and the sum of each query, `mean` its mean gradient; weights of
    /// keys from `keys` on are 0. The largest score is taken off as when the sum was made: where scores are so large that their
    /// rounding shows, it cancels.
    fn weigh(
        scores: &Sums,
        gradients: &Sums,
        factor: f32,
        level: &Running,
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
                let (largest, inverse) = (level.largest[row], 1.0 / level.sum[row]);
                let mut weights = [0f32; SIDE];
                for j in 0..SIDE {
                    weights[j] = exp2(scores[j].mul_add(factor, -largest)) * inverse;
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

/// Largest score and sum of every block of queries.
fn levels(shape: AttentionShape, packed: &Packed, factor: f32) -> Vec<Running> {
    let depth = shape.head_dim.div_ceil(DEPTH);
    let key_blocks = shape.keys.div_ceil(SIDE);
    let instructions = Instructions::start();
    let one = |block: usize, scores: &mut [f32], tiles: &mut [u16]| {
        let queries = rows(&packed.queries, block, depth, 0);
        let mut running = Running::NONE;
        for first in (0..key_blocks).step_by(CHUNK) {
            let count = CHUNK.min(key_blocks - first);
            let blocks = (first, count);
            score(&instructions, queries, &packed.keys_turned, blocks, scores);
            let left = (shape.keys - first * SIDE).min(count * SIDE);
            let scores = &mut scores[..count * BLOCK];
            take_chunk(scores, left, factor, &mut running, &mut [0.0; SIDE], tiles);
        }
        running
    };
    with_scratch(CHUNK * BLOCK, |scores| {
        with_halves(2 * CHUNK * TILE, |tiles| {
            let blocks = 0..shape.queries.div_ceil(SIDE);
            blocks.map(|block| one(block, scores, tiles)).collect()
        })
    })
}

/// Two blocks of 16 rows, `depth` steps each, from step `first`.
fn rows(packed: &[u16], block: usize, depth: usize, first: usize) -> [&[u16]; 2] {
    [0, 1].map(|half| &packed[((2 * block + half) * depth + first) * TILE..])
}

/// Blocks of up to [`GROUP`], the first one and how many.
type Blocks = (usize, usize);

/// The sums of one head, and what they are made of.
struct Adjoint<'a> {
    shape: AttentionShape,
    packed: &'a Packed,
    means: &'a [f32],
    levels: Vec<Running>,
    /// Blocks of 32 elements of a token.
    panels: usize,
    query_blocks: usize,
    steps: Vec<usize>,
    instructions: Instructions,
    /// Weights, and gradients at scores, in pairs of queries: [keys of the group, queries of the group].
    weight_pairs: Vec<u32>,
    gradient_pairs: Vec<u32>,
    /// Gradients at scores in tiles: [queries of the group, halves, keys of the group].
    tiles: Vec<u16>,
    /// Sums of all queries, [block, panel], and of the keys of a group, [block, panel] turned.
    at_queries: Vec<f32>,
    at_values: Vec<f32>,
    at_keys: Vec<f32>,
}

/// The gradients of one head, into rows of tokens from each of `targets`.
fn one_head(shape: AttentionShape, packed: &Packed, means: &[f32], [dq, dk, dv]: [*mut u16; 3]) {
    let panels = shape.head_dim.div_ceil(SIDE);
    let (query_blocks, key_blocks) = (shape.queries.div_ceil(SIDE), shape.keys.div_ceil(SIDE));
    let steps = 0..shape.head_dim.div_ceil(DEPTH).max(GROUP);
    let mut adjoint = Adjoint {
        shape,
        packed,
        means,
        levels: levels(shape, packed, shape.scale * std::f32::consts::LOG2_E),
        panels,
        query_blocks,
        steps: steps.map(|step| step * STEP).collect(),
        instructions: Instructions::start(),
        weight_pairs: vec![0; GROUP * GROUP * STEP],
        gradient_pairs: vec![0; GROUP * GROUP * STEP],
        tiles: vec![0; GROUP * 2 * GROUP * TILE],
        at_queries: vec![0.0; query_blocks * panels * BLOCK],
        at_values: vec![0.0; GROUP * panels * BLOCK],
        at_keys: vec![0.0; GROUP * panels * BLOCK],
    };
    let groups = |blocks: usize| {
        let firsts = (0..blocks).step_by(GROUP);
        firsts.map(move |first| (first, GROUP.min(blocks - first)))
    };
    for keys in groups(key_blocks) {
        for queries in groups(query_blocks) {
            adjoint.weigh(queries, keys);
            adjoint.add(queries, keys);
        }
        adjoint.store_keys(keys, dk, dv);
    }
    adjoint.store_queries(dq);
}

impl Adjoint<'_> {
    /// Adds products over `steps` of the first steps to `sums`, or starts them anew.
    fn multiply(&self, a: [&[u16]; 2], b: &[u32], steps: usize, sums: &mut Sums, anew: bool) {
        let tiles = a.map(|a| a[..steps * TILE].as_ptr());
        let words = b[..steps * STEP].as_ptr();
        let steps = &self.steps[..steps];
        // SAFETY: both were just measured.
        unsafe { (self.instructions).multiply(tiles, words, steps, SIDE, sums, anew) };
    }

    /// Weights and gradients at the scores of a group of queries and one of keys.
    fn weigh(&mut self, (first_query, queries): Blocks, (first_key, keys): Blocks) {
        let (shape, packed) = (self.shape, self.packed);
        let (depth, words) = (shape.head_dim.div_ceil(DEPTH), panel_words(shape.head_dim));
        let factor = shape.scale * std::f32::consts::LOG2_E;
        let (mut scores, mut gradients) = ([0.0; BLOCK], [0.0; BLOCK]);
        for i in 0..queries {
            let block = first_query + i;
            let mut mean = [0.0; SIDE];
            let means = &self.means[block * SIDE..];
            let count = SIDE.min(means.len());
            mean[..count].copy_from_slice(&means[..count]);
            for j in 0..keys {
                let at = (first_key + j) * words;
                let a = rows(&packed.queries, block, depth, 0);
                self.multiply(a, &packed.keys_turned.words[at..], depth, &mut scores, true);
                let (a, b) = (
                    rows(&packed.gradients, block, depth, 0),
                    &packed.values_turned,
                );
                self.multiply(a, &b.words[at..], depth, &mut gradients, true);
                let tiles = &mut self.tiles[i * 2 * GROUP * TILE..][..2 * GROUP * TILE];
                let (low, high) = tiles.split_at_mut(GROUP * TILE);
                let pairs = (j * GROUP + i) * STEP..(j * GROUP + i + 1) * STEP;
                weigh(
                    &scores,
                    &gradients,
                    factor,
                    &self.levels[block],
                    &mean,
                    (shape.keys - (first_key + j) * SIDE).min(SIDE),
                    &mut self.weight_pairs[pairs.clone()],
                    &mut self.gradient_pairs[pairs],
                    [low, high].map(|half| &mut half[j * TILE..][..TILE]),
                );
            }
        }
    }

    /// Adds what a group of queries and one of keys give to each other's sums.
    fn add(&mut self, (first_query, queries): Blocks, (first_key, keys): Blocks) {
        let (packed, panels, blocks) = (self.packed, self.panels, self.query_blocks);
        let take = |sums: &mut Vec<f32>| std::mem::take(sums);
        let (mut at_values, mut at_keys) = (take(&mut self.at_values), take(&mut self.at_keys));
        let mut at_queries = take(&mut self.at_queries);
        for panel in 0..panels {
            for j in 0..keys {
                let (at, anew) = (j * GROUP * STEP, first_query == 0);
                let a = rows(&packed.gradients_turned, panel, blocks, first_query);
                let sums = block_of(&mut at_values, j * panels + panel);
                self.multiply(a, &self.weight_pairs[at..], queries, sums, anew);
                let a = rows(&packed.queries_turned, panel, blocks, first_query);
                let sums = block_of(&mut at_keys, j * panels + panel);
                self.multiply(a, &self.gradient_pairs[at..], queries, sums, anew);
            }
            for i in 0..queries {
                let start = panel * panel_words(self.shape.keys) + first_key * STEP;
                let (a, b) = (rows(&self.tiles, i, GROUP, 0), &packed.keys.words[start..]);
                let sums = block_of(&mut at_queries, (first_query + i) * panels + panel);
                self.multiply(a, b, keys, sums, first_key == 0);
            }
        }
        (self.at_values, self.at_keys, self.at_queries) = (at_values, at_keys, at_queries);
    }

    /// Rows and columns of a token's block of 32 x 32 elements, and where it starts.
    fn place(&self, block: usize, panel: usize, length: usize) -> (usize, usize, usize) {
        let (d, width) = (self.shape.head_dim, self.shape.heads * self.shape.head_dim);
        let count = SIDE.min(length - block * SIDE);
        let columns = SIDE.min(d - panel * SIDE);
        (count, columns, block * SIDE * width + panel * SIDE)
    }

    fn store_keys(&mut self, (first, count): Blocks, dk: *mut u16, dv: *mut u16) {
        let (shape, panels) = (self.shape, self.panels);
        let width = shape.heads * shape.head_dim;
        for j in 0..count {
            for panel in 0..panels {
                let (rows, columns, at) = self.place(first + j, panel, shape.keys);
                for (sums, factor, target) in [
                    (&mut self.at_values, 1.0, dv),
                    (&mut self.at_keys, shape.scale, dk),
                ] {
                    let turned = turn_floats(block_of(sums, j * panels + panel));
                    let (factors, target) = ([factor; SIDE], target.wrapping_add(at));
                    store_rows(&turned, &factors, rows, columns, target, width);
                }
            }
        }
    }

    fn store_queries(&mut self, dq: *mut u16) {
        let (shape, panels) = (self.shape, self.panels);
        let factors = [shape.scale; SIDE];
        for block in 0..self.query_blocks {
            for panel in 0..panels {
                let (rows, columns, at) = self.place(block, panel, shape.queries);
                let sums = block_of(&mut self.at_queries, block * panels + panel);
                let (target, width) = (dq.wrapping_add(at), shape.heads * shape.head_dim);
                store_rows(sums, &factors, rows, columns, target, width);
            }
        }
    }
}
