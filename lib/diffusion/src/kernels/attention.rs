//! Scaled dot-product attention by blocks of queries: the scores of a block
//! stay in the cache, nothing quadratic is stored, and the adjoint computes
//! them again [Dao et al. 2022 for the idea, with whole rows of scores here].

pub(crate) mod panels;

use rayon::prelude::*;

use super::matmul::{Columns, Engine, Matrix, Threads, product_by, product_columns};
use super::simd::{exp, sum_of_2, vectorized};
use super::{SharedMut, with_scratch};

/// Shape of an attention: q [batch, queries, heads * head_dim] and k, v
/// [batch, keys, heads * head_dim].
#[derive(Debug, Clone, Copy)]
pub(crate) struct AttentionShape {
    pub batch: usize,
    pub heads: usize,
    pub queries: usize,
    pub keys: usize,
    pub head_dim: usize,
    /// Factor of the logits, usually head_dim^-1/2.
    pub scale: f32,
    /// Query i sees keys 0..=i only.
    pub causal: bool,
}

/// Scores of one block: 1 MiB, half of a usual L2.
const BLOCK_SCORES: usize = 256 * 1024;
/// Queries of a block are a multiple of it: rows of the register tile of a product.
const TILE_ROWS: usize = 14;
/// Floats of a cache line.
const LINE: usize = 16;

impl AttentionShape {
    fn width(&self) -> usize {
        self.heads * self.head_dim
    }

    /// Queries of one block, from the shape alone.
    fn block(&self) -> usize {
        let rows = (BLOCK_SCORES / self.keys.max(1)).min(9 * TILE_ROWS);
        (rows / TILE_ROWS * TILE_ROWS)
            .max(TILE_ROWS)
            .min(self.queries.max(1))
    }

    /// Floats from one row of scores to the next: an odd number of cache lines, so that rows do not
    /// fall onto the same few sets of the caches.
    fn stride(&self) -> usize {
        (self.keys.div_ceil(LINE) | 1) * LINE
    }

    /// Head `head` of batch item `item` in a tensor of `length` tokens.
    fn head<'a>(
        &self,
        data: &'a [f32],
        length: usize,
        item: usize,
        head: usize,
        first: usize,
    ) -> Matrix<'a> {
        let offset = (item * length + first) * self.width() + head * self.head_dim;
        Matrix {
            data: &data[offset..],
            row: self.width(),
            column: 1,
        }
    }
}

vectorized! {
    /// exp(score - largest of the row) in place, and 1 / the row's sum into
    /// `inverse`; entries past `visible(row)` become 0.
    fn exponentials(scores: &mut [f32], keys: usize, stride: usize, first_visible: usize, inverse: &mut [f32]) {
        const LANES: usize = 32;
        for (row, scores) in scores.chunks_exact_mut(stride).enumerate() {
            let scores = &mut scores[..keys];
            let visible = if first_visible == usize::MAX { keys } else { (first_visible + row).min(keys) };
            let (seen, hidden) = scores.split_at_mut(visible);
            let mut lanes = [f32::NEG_INFINITY; LANES];
            let mut blocks = seen.chunks_exact(LANES);
            for block in &mut blocks {
                for i in 0..LANES {
                    lanes[i] = if block[i] > lanes[i] { block[i] } else { lanes[i] };
                }
            }
            let mut max = f32::NEG_INFINITY;
            for &v in blocks.remainder().iter().chain(&lanes) {
                max = if v > max { v } else { max };
            }
            // Below -87 `exp` returns its clamp of 1e-38 instead of 0;
            // against a largest term of 1 neither is seen. Each lane sums at
            // most keys / 32 terms of at most 1.
            let mut sums = [0f32; LANES];
            let mut blocks = seen.chunks_exact_mut(LANES);
            for block in &mut blocks {
                for i in 0..LANES {
                    block[i] = exp(block[i] - max);
                    sums[i] += block[i];
                }
            }
            let mut total: f64 = sums.iter().map(|&v| v as f64).sum();
            // The rest as one more block, so that it is vectorised, too.
            let rest = blocks.into_remainder();
            let mut last = [max; LANES];
            last[..rest.len()].copy_from_slice(rest);
            for v in &mut last {
                *v = exp(*v - max);
            }
            rest.copy_from_slice(&last[..rest.len()]);
            total += rest.iter().map(|&v| v as f64).sum::<f64>();
            inverse[row] = (1.0 / total) as f32;
            hidden.fill(0.0);
        }
    }
}

impl AttentionShape {
    /// Probabilities of `rows` queries from `first` into `scores`, up to the
    /// factor of each row that goes into `inverse`; `keys` are the head's
    /// transposed keys.
    fn probabilities(
        &self,
        scores: &mut [f32],
        (item, head, first, rows): (usize, usize, usize, usize),
        q: &[f32],
        keys: &Columns,
        inverse: &mut [f32],
        threads: Threads,
    ) {
        let q = self.head(q, self.queries, item, head, first);
        let stride = self.stride();
        // SAFETY: `scores` holds rows * stride elements and is borrowed exclusively.
        unsafe {
            let (shape, out) = ((rows, self.keys, self.head_dim), scores.as_mut_ptr());
            product_columns(shape, out, stride, 0.0, self.scale, q, keys, threads);
        }
        let visible = if self.causal { first + 1 } else { usize::MAX };
        exponentials(scores, self.keys, stride, visible, inverse);
    }

    /// One head's matrix of `data`, keys or values: as it is, [keys, head_dim].
    fn columns<'a>(
        &self,
        engine: Engine,
        data: &'a [f32],
        item: usize,
        head: usize,
    ) -> Columns<'a> {
        let view = self.head(data, self.keys, item, head, 0);
        Columns::new(engine, view, (self.keys, self.head_dim))
    }

    /// The same matrix transposed, [head_dim, keys].
    fn columns_transposed<'a>(
        &self,
        engine: Engine,
        data: &'a [f32],
        item: usize,
        head: usize,
    ) -> Columns<'a> {
        let view = self.head(data, self.keys, item, head, 0).transposed();
        Columns::new(engine, view, (self.head_dim, self.keys))
    }
}

/// softmax(scale q k^T) v, heads side by side in the last dimension, with products by `engine`.
pub(crate) fn attention(
    engine: Engine,
    shape: AttentionShape,
    q: &[f32],
    k: &[f32],
    v: &[f32],
) -> Vec<f32> {
    let mut out = vec![0.0; q.len()];
    let (block, width) = (shape.block(), shape.width());
    let blocks = shape.queries.div_ceil(block);
    let heads: Vec<(Columns, Columns)> = (0..shape.batch * shape.heads)
        .into_par_iter()
        .map(|pair| {
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            (
                shape.columns_transposed(engine, k, item, head),
                shape.columns(engine, v, item, head),
            )
        })
        .collect();
    let target = SharedMut::new(&mut out);
    (0..shape.batch * shape.heads * blocks)
        .into_par_iter()
        .for_each(|job| {
            let (first, pair) = (job % blocks * block, job / blocks);
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            let (keys, values) = &heads[pair];
            let rows = block.min(shape.queries - first);
            let mut inverse = vec![0f32; rows];
            with_scratch(rows * shape.stride(), |scores| {
                let place = (item, head, first, rows);
                shape.probabilities(scores, place, q, keys, &mut inverse, Threads::One);
                let offset = (item * shape.queries + first) * width + head * shape.head_dim;
                let size = (rows, shape.head_dim, shape.keys);
                let p = Matrix::rows(scores, shape.stride());
                // SAFETY: each job writes its own rows and head columns of `out`.
                unsafe {
                    let out = target.at(offset);
                    product_columns(size, out, width, 0.0, 1.0, p, values, Threads::One);
                    for (row, &factor) in inverse.iter().enumerate() {
                        let row = std::slice::from_raw_parts_mut(
                            target.at(offset + row * width),
                            shape.head_dim,
                        );
                        row.iter_mut().for_each(|v| *v *= factor);
                    }
                }
            });
        });
    out
}

vectorized! {
    /// ds = p (dp - mean) by rows, into `dp`, where p is up to the factor of each row.
    fn softmax_rows_vjp(p: &[f32], dp: &mut [f32], keys: usize, stride: usize, means: &[f32], factors: &[f32]) {
        let rows = p.chunks_exact(stride).zip(dp.chunks_exact_mut(stride));
        for ((p, dp), (&mean, &factor)) in rows.zip(means.iter().zip(factors)) {
            let (p, dp) = (&p[..keys], &mut dp[..keys]);
            for i in 0..keys {
                dp[i] = p[i] * factor * (dp[i] - mean);
            }
        }
    }
}

vectorized! {
    /// Of each row of `g`: its product with the same row of `y`, which is the mean of dp under p, into `means`, and
    /// the row times its factor into `scaled`.
    fn rows_of_gradient(g: Matrix, y: Matrix, factors: &[f32], means: &mut [f32], scaled: &mut [f32]) {
        let width = scaled.len() / means.len().max(1);
        for (row, scaled) in scaled.chunks_exact_mut(width).enumerate() {
            let (g, y) = (&g.data[row * g.row..][..width], &y.data[row * y.row..][..width]);
            means[row] = sum_of_2(g, y, |g, y| g * y) as f32;
            for i in 0..width {
                scaled[i] = g[i] * factors[row];
            }
        }
    }
}

/// Gradients of [`attention`], whose value is `y`: (dq, dk, dv).
pub(crate) fn attention_vjp(
    engine: Engine,
    shape: AttentionShape,
    q: &[f32],
    k: &[f32],
    v: &[f32],
    y: &[f32],
    g: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut dq, mut dk, mut dv) = (vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; v.len()]);
    let (block, width, stride) = (shape.block(), shape.width(), shape.stride());
    let targets = (
        SharedMut::new(&mut dq),
        SharedMut::new(&mut dk),
        SharedMut::new(&mut dv),
    );
    let pairs = shape.batch * shape.heads;
    // One job owns a head: its dk and dv sum over query blocks in order. With
    // a single head the products themselves go parallel.
    let threads = if pairs == 1 {
        Threads::All
    } else {
        Threads::One
    };
    // The head's keys and values transposed, and its keys.
    type Shared<'a> = (Columns<'a>, Columns<'a>, Columns<'a>);
    let step = |place: (usize, usize, usize), shared: &Shared, p: &mut [f32], dp: &mut [f32]| {
        let (item, head, first) = place;
        let (keys_t, values_t, keys) = shared;
        let rows = p.len() / stride;
        let (mut inverse, mut means) = (vec![0f32; rows], vec![0f32; rows]);
        let mut scaled = vec![0f32; rows * shape.head_dim];
        let place = (item, head, first, rows);
        shape.probabilities(p, place, q, keys_t, &mut inverse, threads);
        let g = shape.head(g, shape.queries, item, head, first);
        let y = shape.head(y, shape.queries, item, head, first);
        rows_of_gradient(g, y, &inverse, &mut means, &mut scaled);
        let scaled = Matrix::rows(&scaled, shape.head_dim);
        let q = shape.head(q, shape.queries, item, head, first);
        let keep = if first == 0 { 0.0 } else { 1.0 };
        let key_offset = item * shape.keys * width + head * shape.head_dim;
        let query_offset = (item * shape.queries + first) * width + head * shape.head_dim;
        let scores = (rows, shape.keys, shape.head_dim);
        let by_key = (shape.keys, shape.head_dim, rows);
        let by_query = (rows, shape.head_dim, shape.keys);
        // SAFETY: each job writes the columns of its own head and item, and
        // `dp` holds rows * stride elements.
        unsafe {
            let out = dp.as_mut_ptr();
            product_columns(scores, out, stride, 0.0, 1.0, g, values_t, threads);
            let weights = Matrix::rows(p, stride).transposed();
            let out = targets.2.at(key_offset);
            product_by(
                engine, by_key, out, width, keep, 1.0, weights, scaled, threads,
            );
            softmax_rows_vjp(p, dp, shape.keys, stride, &means, &inverse);
            let ds = Matrix::rows(dp, stride);
            let out = targets.0.at(query_offset);
            product_columns(by_query, out, width, 0.0, shape.scale, ds, keys, threads);
            let out = targets.1.at(key_offset);
            let ds = ds.transposed();
            product_by(
                engine,
                by_key,
                out,
                width,
                keep,
                shape.scale,
                ds,
                q,
                threads,
            );
        }
    };
    let run = |pair: usize| {
        let (item, head) = (pair / shape.heads, pair % shape.heads);
        let shared = (
            shape.columns_transposed(engine, k, item, head),
            shape.columns_transposed(engine, v, item, head),
            shape.columns(engine, k, item, head),
        );
        for first in (0..shape.queries).step_by(block) {
            let len = block.min(shape.queries - first) * stride;
            with_scratch(len, |p| {
                with_scratch(len, |dp| step((item, head, first), &shared, p, dp))
            });
        }
    };
    if pairs == 1 {
        run(0)
    } else {
        (0..pairs).into_par_iter().for_each(run)
    }
    (dq, dk, dv)
}
