//! Attention for AVX-512 with the queries in the lanes: scores of a block of keys for a panel of queries, transposed, lie as
//! `packed` wants the right side of a product, never leave the fastest cache, and their softmax sums across no lanes. The
//! largest score so far is corrected from block to block [Milakov & Gimelshein 2018].

use std::hint::black_box;

use rayon::prelude::*;

use super::AttentionShape;
use crate::kernels::lanes::{LANES, Lane, gather, with_lanes};
use crate::kernels::matmul::Matrix;
use crate::kernels::packed::{Left, NR, Right, available};
use crate::kernels::simd::{exp, sum_of_2, vectorized};
use crate::kernels::{SharedMut, with_scratch};

/// Keys of a block, whole rows of register tiles: 14 KiB of scores for a panel.
const KEYS: usize = 8 * 14;
/// Panels of queries that one job takes through the keys together.
const PANELS: usize = 4;
/// Channels of a head at most: beyond, a block's keys and values leave the second cache.
const MOST_CHANNELS: usize = 160;
/// Channels of a head at least in the adjoint: its products with fewer waste too many rows and lanes.
const ADJOINT_CHANNELS: usize = 32;

/// One number for each query of a panel.
type Row<T = f32> = [T; NR];

/// Of each query of each head: its largest score, and 1 / the sum of its exponentials. What the adjoint needs beside the result.
pub(crate) struct Softmax(Vec<(f32, f32)>);

/// Whether [`attention`] is for this shape and processor.
pub(crate) fn suit(shape: AttentionShape) -> bool {
    available() && shape.head_dim <= MOST_CHANNELS
}

/// Whether [`attention_vjp`] is, too. One head is one job.
pub(crate) fn suit_vjp(shape: AttentionShape) -> bool {
    suit(shape) && shape.head_dim >= ADJOINT_CHANNELS && shape.batch * shape.heads > 1
}

vectorized! {
    /// exp(score - largest so far) of a block of keys, in place. What was computed with the largest before has to be
    /// multiplied by `factors`, if the result is true.
    fn exponentials(scores: &mut [f32], largest: &mut Row, sums: &mut Row<f64>, factors: &mut Row) -> bool {
        let mut max = *largest;
        for row in scores.chunks_exact(NR) {
            for i in 0..NR {
                max[i] = if row[i] > max[i] { row[i] } else { max[i] };
            }
        }
        let moved = max != *largest;
        for i in 0..NR {
            factors[i] = exp(largest[i] - max[i]);
        }
        // At most KEYS terms of at most 1.
        let mut block = [0f32; NR];
        for row in scores.chunks_exact_mut(NR) {
            for i in 0..NR {
                row[i] = exp(row[i] - max[i]);
                block[i] += row[i];
            }
        }
        for i in 0..NR {
            sums[i] = sums[i] * f64::from(factors[i]) + f64::from(block[i]);
        }
        *largest = max;
        moved
    }
}

// Below a panel's width is a length that the compiler must not know: it would take several rows apart.
vectorized! {
    fn scale_rows(values: &mut [f32], factors: &[f32]) {
        for row in values.chunks_exact_mut(factors.len()) {
            for (value, factor) in row.iter_mut().zip(factors) {
                *value *= factor;
            }
        }
    }
}

vectorized! {
    /// Scores to probabilities, in place.
    fn probabilities(scores: &mut [f32], largest: &[f32], inverse: &[f32]) {
        for row in scores.chunks_exact_mut(largest.len()) {
            for ((score, largest), inverse) in row.iter_mut().zip(largest).zip(inverse) {
                *score = exp(*score - largest) * inverse;
            }
        }
    }
}

vectorized! {
    /// p (dp - mean) in place of dp.
    fn softmax_vjp(p: &[f32], dp: &mut [f32], means: &[f32]) {
        let rows = p.chunks_exact(means.len()).zip(dp.chunks_exact_mut(means.len()));
        for (p, dp) in rows {
            for ((dp, p), mean) in dp.iter_mut().zip(p).zip(means) {
                *dp = p * (*dp - mean);
            }
        }
    }
}

vectorized! {
    fn product_of_rows(g: &[f32], y: &[f32]) -> f32 {
        sum_of_2(g, y, |g, y| g * y) as f32
    }
}

impl AttentionShape {
    /// What hides the keys from `first_key` on from the queries from `first_query` on becomes `value`.
    fn hide(&self, scores: &mut [f32], first_key: usize, first_query: usize, value: f32) {
        if !self.causal || first_key + scores.len() / NR <= first_query + 1 {
            return;
        }
        for (key, row) in scores.chunks_exact_mut(NR).enumerate() {
            let hidden = (first_key + key).saturating_sub(first_query).min(NR);
            row[..hidden].fill(value);
        }
    }

    /// The first keys of the blocks that queries before `last` see something of.
    fn blocks(&self, last: usize) -> impl Iterator<Item = usize> {
        let seen = if self.causal {
            last.min(self.keys)
        } else {
            self.keys
        };
        (0..seen).step_by(KEYS)
    }
}

/// NR rows of a matrix as columns: [columns, NR], zeros past `rows`.
fn turn(rows_of: Matrix, rows: usize, target: &mut [f32]) {
    with_lanes(target.len() / NR, |lanes| {
        for half in 0..NR / LANES {
            let first = half * LANES;
            let count = rows.saturating_sub(first).min(LANES);
            gather(
                &rows_of.data[(first * rows_of.row).min(rows_of.data.len())..],
                rows_of.row,
                count,
                lanes,
            );
            for (target, lane) in target.chunks_exact_mut(NR).zip(lanes.iter()) {
                target[first..first + LANES].copy_from_slice(&lane.0);
            }
        }
    });
}

/// The reverse of [`turn`], into rows of `row` elements from `target` on, query q times `factors[q]`.
///
/// # Safety
/// `target` is valid for writes of the first `source.len() / NR` elements of `rows` rows.
unsafe fn turn_back(source: &[f32], factors: &Row, rows: usize, target: *mut f32, row: usize) {
    let channels = source.len() / NR;
    let mut lanes = [Lane::ZERO; NR];
    for first in (0..channels).step_by(LANES) {
        let count = LANES.min(channels - first);
        gather(&source[first * NR..], NR, count, &mut lanes);
        for (query, lane) in lanes.iter().enumerate().take(rows) {
            for (i, value) in lane.0[..count].iter().enumerate() {
                // SAFETY: by the caller's contract.
                unsafe { *target.add(query * row + first + i) = value * factors[query] };
            }
        }
    }
}

/// A head's keys or values by blocks, as left sides of products: rows are keys, or channels.
struct Blocks {
    by_key: Vec<Left>,
    by_channel: Vec<Left>,
}

impl Blocks {
    fn new(
        shape: &AttentionShape,
        data: &[f32],
        (item, head): (usize, usize),
        which: [bool; 2],
    ) -> Self {
        let blocks = |wanted: bool, by_channel: bool| {
            let block = |first: usize| {
                let rows = KEYS.min(shape.keys - first);
                let view = shape.head(data, shape.keys, item, head, first);
                match by_channel {
                    true => Left::new(view.transposed(), (shape.head_dim, rows)),
                    false => Left::new(view, (rows, shape.head_dim)),
                }
            };
            let firsts = (0..shape.keys).step_by(KEYS).filter(|_| wanted);
            firsts.map(block).collect()
        };
        Self {
            by_key: blocks(which[0], false),
            by_channel: blocks(which[1], true),
        }
    }
}

/// softmax(scale q k^T) v, heads side by side in the last dimension, and what the adjoint needs.
pub(crate) fn attention(
    shape: AttentionShape,
    q: &[f32],
    k: &[f32],
    v: &[f32],
) -> (Vec<f32>, Softmax) {
    let (width, channels) = (shape.width(), shape.head_dim);
    let pairs = shape.batch * shape.heads;
    let mut out = vec![0.0; q.len()];
    let heads: Vec<(Blocks, Blocks)> = (0..pairs)
        .into_par_iter()
        .map(|pair| {
            let place = (pair / shape.heads, pair % shape.heads);
            (
                Blocks::new(&shape, k, place, [true, false]),
                Blocks::new(&shape, v, place, [false, true]),
            )
        })
        .collect();
    let target = SharedMut::new(&mut out);
    let jobs = shape.queries.div_ceil(PANELS * NR);
    let job = |job: usize| {
        let (pair, start) = (job / jobs, job % jobs * PANELS * NR);
        let (item, head) = (pair / shape.heads, pair % shape.heads);
        let (keys, values) = &heads[pair];
        let end = shape.queries.min(start + PANELS * NR);
        let mut largest = [[f32::NEG_INFINITY; NR]; PANELS];
        let mut sums = [[0f64; NR]; PANELS];
        let size = channels * NR;
        with_scratch((2 * PANELS + 1) * size.max(KEYS * NR), |scratch| {
            let (turned, scratch) = scratch.split_at_mut(PANELS * size);
            let (sum, scratch) = scratch.split_at_mut(PANELS * size);
            sum.fill(0.0);
            for (panel, turned) in turned.chunks_exact_mut(size).enumerate() {
                let first = start + panel * NR;
                if first < end {
                    turn(
                        shape.head(q, shape.queries, item, head, first),
                        end - first,
                        turned,
                    );
                }
            }
            for first_key in shape.blocks(end) {
                let block = first_key / KEYS;
                let rows = KEYS.min(shape.keys - first_key);
                let scores = &mut scratch[..rows * NR];
                for first in (start..end).step_by(NR) {
                    let panel = (first - start) / NR;
                    let (turned, sum) = (
                        &turned[panel * size..][..size],
                        &mut sum[panel * size..][..size],
                    );
                    keys.by_key[block].times_panel(turned, scores, 0.0, shape.scale);
                    shape.hide(scores, first_key, first, f32::NEG_INFINITY);
                    let mut factors = [0f32; NR];
                    if exponentials(scores, &mut largest[panel], &mut sums[panel], &mut factors) {
                        scale_rows(sum, black_box(&factors[..]));
                    }
                    shape.hide(scores, first_key, first, 0.0);
                    values.by_channel[block].times_panel(scores, sum, 1.0, 1.0);
                }
            }
            let mut statistics = Vec::with_capacity(end - start);
            for (panel, sum) in sum.chunks_exact(size).enumerate() {
                let first = start + panel * NR;
                let inverse = sums[panel].map(|sum| (1.0 / sum) as f32);
                let rows = end.saturating_sub(first).min(NR);
                let offset = (item * shape.queries + first) * width + head * channels;
                if rows > 0 {
                    // SAFETY: each job writes its own rows and head's columns.
                    unsafe { turn_back(sum, &inverse, rows, target.at(offset), width) };
                }
                statistics.extend(largest[panel].into_iter().zip(inverse).take(rows));
            }
            statistics
        })
    };
    let statistics: Vec<_> = (0..pairs * jobs).into_par_iter().map(job).collect();
    (out, Softmax(statistics.concat()))
}

/// A panel of queries as the adjoint reads it.
struct Panel {
    rows: usize,
    /// q and g turned, [channels, NR].
    turned: [Vec<f32>; 2],
    /// q and g as right sides of products.
    right: [Right; 2],
    largest: Row,
    inverse: Row,
    /// The mean of dp under p.
    means: Row,
    /// The gradient at q, turned.
    dq: Vec<f32>,
}

impl Panel {
    fn new(
        shape: &AttentionShape,
        (item, head, first): (usize, usize, usize),
        softmax: &Softmax,
        [q, y, g]: [&[f32]; 3],
    ) -> Self {
        let rows = NR.min(shape.queries - first);
        let channels = shape.head_dim;
        let [q, y, g] = [q, y, g].map(|data| shape.head(data, shape.queries, item, head, first));
        let turned = [q, g].map(|matrix| {
            let mut turned = vec![0.0; channels * NR];
            turn(matrix, rows, &mut turned);
            turned
        });
        let statistics = &softmax.0[(item * shape.heads + head) * shape.queries + first..][..rows];
        let mut panel = Self {
            rows,
            turned,
            right: [q, g].map(|matrix| Right::new(matrix, (rows, channels))),
            largest: [0.0; NR],
            inverse: [0.0; NR],
            means: [0.0; NR],
            dq: vec![0.0; channels * NR],
        };
        for (i, &(largest, inverse)) in statistics.iter().enumerate() {
            (panel.largest[i], panel.inverse[i]) = (largest, inverse);
            let [g, y] = [g, y].map(|matrix| &matrix.data[i * matrix.row..][..channels]);
            panel.means[i] = product_of_rows(g, y);
        }
        panel
    }
}

/// Gradients of [`attention`], whose value is `y`: (dq, dk, dv).
pub(crate) fn attention_vjp(
    shape: AttentionShape,
    softmax: &Softmax,
    [q, k, v]: [&[f32]; 3],
    y: &[f32],
    g: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut dq, mut dk, mut dv) = (vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; v.len()]);
    let (width, channels) = (shape.width(), shape.head_dim);
    let targets = [&mut dq, &mut dk, &mut dv].map(|values| SharedMut::new(values));
    // One job owns a head: its dk and dv sum over panels of queries in order.
    (0..shape.batch * shape.heads)
        .into_par_iter()
        .for_each(|pair| {
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            let keys = Blocks::new(&shape, k, (item, head), [true, true]);
            let values = Blocks::new(&shape, v, (item, head), [true, false]);
            let panel = |first| Panel::new(&shape, (item, head, first), softmax, [q, y, g]);
            let mut panels: Vec<Panel> = (0..shape.queries).step_by(NR).map(panel).collect();
            with_scratch(2 * KEYS * NR, |scratch| {
                let (p, dp) = scratch.split_at_mut(KEYS * NR);
                for first_key in shape.blocks(shape.queries) {
                    let block = first_key / KEYS;
                    let rows = KEYS.min(shape.keys - first_key);
                    let (p, dp) = (&mut p[..rows * NR], &mut dp[..rows * NR]);
                    let offset = (item * shape.keys + first_key) * width + head * channels;
                    for (index, panel) in panels.iter_mut().enumerate() {
                        let first = index * NR;
                        if shape.causal && first + NR <= first_key {
                            continue;
                        }
                        keys.by_key[block].times_panel(&panel.turned[0], p, 0.0, shape.scale);
                        probabilities(p, black_box(&panel.largest[..]), &panel.inverse);
                        shape.hide(p, first_key, first, 0.0);
                        values.by_key[block].times_panel(&panel.turned[1], dp, 0.0, 1.0);
                        softmax_vjp(p, dp, black_box(&panel.means[..]));
                        keys.by_channel[block].times_panel(dp, &mut panel.dq, 1.0, shape.scale);
                        let size = (rows, panel.rows);
                        // SAFETY: each job writes the columns of its own head and item.
                        unsafe {
                            let [q, g] = &panel.right;
                            g.after_rows(p, size, targets[2].at(offset), width, 1.0);
                            q.after_rows(dp, size, targets[1].at(offset), width, shape.scale);
                        }
                    }
                }
            });
            for (index, panel) in panels.iter().enumerate() {
                let offset = (item * shape.queries + index * NR) * width + head * channels;
                // SAFETY: as above.
                unsafe {
                    turn_back(
                        &panel.dq,
                        &[1.0; NR],
                        panel.rows,
                        targets[0].at(offset),
                        width,
                    )
                };
            }
        });
    (dq, dk, dv)
}
