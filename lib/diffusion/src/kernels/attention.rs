//! Scaled dot-product attention by blocks of queries: the scores of a block
//! stay in the cache, nothing quadratic is stored, and the adjoint computes
//! them again [Dao et al. 2022 for the idea, with whole rows of scores here].

use rayon::prelude::*;

use super::matmul::{Columns, Matrix, Threads, product_at, product_columns};
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

impl AttentionShape {
    fn width(&self) -> usize {
        self.heads * self.head_dim
    }

    /// Queries of one block, from the shape alone.
    fn block(&self) -> usize {
        (BLOCK_SCORES / self.keys.max(1))
            .clamp(16, 128)
            .min(self.queries.max(1))
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
    fn exponentials(scores: &mut [f32], keys: usize, first_visible: usize, inverse: &mut [f32]) {
        const LANES: usize = 32;
        for (row, scores) in scores.chunks_exact_mut(keys).enumerate() {
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

vectorized! {
    fn scale_rows(rows: &mut [f32], width: usize, factors: &[f32]) {
        for (row, &factor) in rows.chunks_exact_mut(width).zip(factors) {
            for v in row {
                *v *= factor;
            }
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
        // SAFETY: `scores` holds rows * keys elements and is borrowed exclusively.
        unsafe {
            let (shape, out) = ((rows, self.keys, self.head_dim), scores.as_mut_ptr());
            product_columns(shape, out, self.keys, 0.0, self.scale, q, keys, threads);
        }
        let visible = if self.causal { first + 1 } else { usize::MAX };
        exponentials(scores, self.keys, visible, inverse);
    }

    /// One head's matrix of `data`, keys or values: as it is, [keys, head_dim].
    fn columns<'a>(&self, data: &'a [f32], item: usize, head: usize) -> Columns<'a> {
        let view = self.head(data, self.keys, item, head, 0);
        Columns::new(view, (self.keys, self.head_dim))
    }

    /// The same matrix transposed, [head_dim, keys].
    fn columns_transposed<'a>(&self, data: &'a [f32], item: usize, head: usize) -> Columns<'a> {
        let view = self.head(data, self.keys, item, head, 0).transposed();
        Columns::new(view, (self.head_dim, self.keys))
    }
}

/// softmax(scale q k^T) v, heads side by side in the last dimension.
pub(crate) fn attention(shape: AttentionShape, q: &[f32], k: &[f32], v: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; q.len()];
    let (block, width) = (shape.block(), shape.width());
    let blocks = shape.queries.div_ceil(block);
    let heads: Vec<(Columns, Columns)> = (0..shape.batch * shape.heads)
        .into_par_iter()
        .map(|pair| {
            let (item, head) = (pair / shape.heads, pair % shape.heads);
            (
                shape.columns_transposed(k, item, head),
                shape.columns(v, item, head),
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
            with_scratch(rows * shape.keys, |scores| {
                let place = (item, head, first, rows);
                shape.probabilities(scores, place, q, keys, &mut inverse, Threads::One);
                let offset = (item * shape.queries + first) * width + head * shape.head_dim;
                let size = (rows, shape.head_dim, shape.keys);
                let p = Matrix::rows(scores, shape.keys);
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
    /// ds = p (dp - sum(p dp)) by rows, into `dp`.
    fn softmax_rows_vjp(p: &[f32], dp: &mut [f32], keys: usize) {
        for (p, dp) in p.chunks_exact(keys).zip(dp.chunks_exact_mut(keys)) {
            let mean = sum_of_2(p, dp, |p, d| p * d) as f32;
            for i in 0..keys {
                dp[i] = p[i] * (dp[i] - mean);
            }
        }
    }
}

/// Gradients of [`attention`]: (dq, dk, dv).
pub(crate) fn attention_vjp(
    shape: AttentionShape,
    q: &[f32],
    k: &[f32],
    v: &[f32],
    g: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut dq, mut dk, mut dv) = (vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; v.len()]);
    let (block, width) = (shape.block(), shape.width());
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
        let rows = p.len() / shape.keys;
        let mut inverse = vec![0f32; rows];
        let place = (item, head, first, rows);
        shape.probabilities(p, place, q, keys_t, &mut inverse, threads);
        scale_rows(p, shape.keys, &inverse);
        let g = shape.head(g, shape.queries, item, head, first);
        let q = shape.head(q, shape.queries, item, head, first);
        let keep = if first == 0 { 0.0 } else { 1.0 };
        let key_offset = item * shape.keys * width + head * shape.head_dim;
        let query_offset = (item * shape.queries + first) * width + head * shape.head_dim;
        let scores = (rows, shape.keys, shape.head_dim);
        let by_key = (shape.keys, shape.head_dim, rows);
        let by_query = (rows, shape.head_dim, shape.keys);
        // SAFETY: each job writes the columns of its own head and item, and
        // `dp` holds rows * keys elements.
        unsafe {
            let out = dp.as_mut_ptr();
            product_columns(scores, out, shape.keys, 0.0, 1.0, g, values_t, threads);
            let weights = Matrix::rows(p, shape.keys).transposed();
            let out = targets.2.at(key_offset);
            product_at(by_key, out, width, keep, 1.0, weights, g, threads);
            softmax_rows_vjp(p, dp, shape.keys);
            let ds = Matrix::rows(dp, shape.keys);
            let out = targets.0.at(query_offset);
            product_columns(by_query, out, width, 0.0, shape.scale, ds, keys, threads);
            let out = targets.1.at(key_offset);
            let ds = ds.transposed();
            product_at(by_key, out, width, keep, shape.scale, ds, q, threads);
        }
    };
    let run = |pair: usize| {
        let (item, head) = (pair / shape.heads, pair % shape.heads);
        let shared = (
            shape.columns_transposed(k, item, head),
            shape.columns_transposed(v, item, head),
            shape.columns(k, item, head),
        );
        for first in (0..shape.queries).step_by(block) {
            let len = block.min(shape.queries - first) * shape.keys;
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
