//! Scaled dot-product attention by blocks of queries: the scores of a block
//! stay in the cache, nothing quadratic is stored, and the adjoint computes
//! them again [Dao et al. 2022 for the idea, with whole rows of scores here].

use rayon::prelude::*;

use super::SharedMut;
use super::matmul::{Threads, View, product, product_at};
use super::simd::{exp, sum_of, sum_of_2, vectorized};

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
    ) -> View<'a> {
        let offset = (item * length + first) * self.width() + head * self.head_dim;
        View {
            data: &data[offset..],
            row: self.width(),
            column: 1,
        }
    }
}

vectorized! {
    /// Softmax of each row in place; entries past `visible(row)` become 0.
    fn softmax_rows(scores: &mut [f32], keys: usize, first_visible: usize) {
        for (row, scores) in scores.chunks_exact_mut(keys).enumerate() {
            let visible = if first_visible == usize::MAX { keys } else { (first_visible + row).min(keys) };
            let (seen, hidden) = scores.split_at_mut(visible);
            let mut lanes = [f32::NEG_INFINITY; 16];
            let mut blocks = seen.chunks_exact(16);
            for block in &mut blocks {
                for i in 0..16 {
                    lanes[i] = if block[i] > lanes[i] { block[i] } else { lanes[i] };
                }
            }
            let mut max = f32::NEG_INFINITY;
            for &v in blocks.remainder().iter().chain(&lanes) {
                max = if v > max { v } else { max };
            }
            // Below -87 `exp` would return its clamp of 1e-38 instead of 0;
            // against a largest term of 1 neither is seen.
            for v in seen.iter_mut() {
                *v = exp(*v - max);
            }
            let inverse = (1.0 / sum_of(seen, |v| v)) as f32;
            for v in seen.iter_mut() {
                *v *= inverse;
            }
            hidden.fill(0.0);
        }
    }
}

impl AttentionShape {
    /// Probabilities of `rows` queries from `first` into `scores`.
    fn probabilities(
        &self,
        scores: &mut [f32],
        (item, head, first, rows): (usize, usize, usize, usize),
        q: &[f32],
        k: &[f32],
        threads: Threads,
    ) {
        let q = self.head(q, self.queries, item, head, first);
        let k = self.head(k, self.keys, item, head, 0).transposed();
        // SAFETY: `scores` holds rows * keys elements and is borrowed exclusively.
        unsafe {
            let (shape, out) = ((rows, self.keys, self.head_dim), scores.as_mut_ptr());
            product_at(shape, out, self.keys, 0.0, self.scale, q, k, threads);
        }
        softmax_rows(
            scores,
            self.keys,
            if self.causal { first + 1 } else { usize::MAX },
        );
    }
}

/// softmax(scale q k^T) v, heads side by side in the last dimension.
pub(crate) fn attention(shape: AttentionShape, q: &[f32], k: &[f32], v: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; q.len()];
    let block = shape.block();
    let blocks = shape.queries.div_ceil(block);
    let target = SharedMut::new(&mut out);
    (0..shape.batch * shape.heads * blocks)
        .into_par_iter()
        .for_each_init(
            || vec![0f32; block * shape.keys],
            |scores, job| {
                let (first, rest) = (job % blocks * block, job / blocks);
                let (item, head) = (rest / shape.heads, rest % shape.heads);
                let rows = block.min(shape.queries - first);
                let scores = &mut scores[..rows * shape.keys];
                shape.probabilities(scores, (item, head, first, rows), q, k, Threads::One);
                let offset = (item * shape.queries + first) * shape.width() + head * shape.head_dim;
                let v = shape.head(v, shape.keys, item, head, 0);
                // SAFETY: each job writes its own rows and head columns of `out`.
                unsafe {
                    let size = (rows, shape.head_dim, shape.keys);
                    let p = View::rows(scores, shape.keys);
                    product_at(
                        size,
                        target.at(offset),
                        shape.width(),
                        0.0,
                        1.0,
                        p,
                        v,
                        Threads::One,
                    );
                }
            },
        );
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
    let block = shape.block();
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
    let run = |pair: usize| {
        let (item, head) = (pair / shape.heads, pair % shape.heads);
        let mut p = vec![0f32; block * shape.keys];
        let mut dp = vec![0f32; block * shape.keys];
        let width = shape.width();
        let key_offset = item * shape.keys * width + head * shape.head_dim;
        for first in (0..shape.queries).step_by(block) {
            let rows = block.min(shape.queries - first);
            let (p, dp) = (&mut p[..rows * shape.keys], &mut dp[..rows * shape.keys]);
            shape.probabilities(p, (item, head, first, rows), q, k, threads);
            let g = shape.head(g, shape.queries, item, head, first);
            product(
                (rows, shape.keys, shape.head_dim),
                dp,
                0.0,
                g,
                shape.head(v, shape.keys, item, head, 0).transposed(),
                threads,
            );
            let keep = if first == 0 { 0.0 } else { 1.0 };
            let query_offset = (item * shape.queries + first) * width + head * shape.head_dim;
            let (size_k, size_q) = (
                (shape.keys, shape.head_dim, rows),
                (rows, shape.head_dim, shape.keys),
            );
            // SAFETY: each job writes the columns of its own head and item.
            unsafe {
                let weights = View::rows(p, shape.keys).transposed();
                product_at(
                    size_k,
                    targets.2.at(key_offset),
                    width,
                    keep,
                    1.0,
                    weights,
                    g,
                    threads,
                );
                softmax_rows_vjp(p, dp, shape.keys);
                let ds = View::rows(dp, shape.keys);
                let k = shape.head(k, shape.keys, item, head, 0);
                product_at(
                    size_q,
                    targets.0.at(query_offset),
                    width,
                    0.0,
                    shape.scale,
                    ds,
                    k,
                    threads,
                );
                let q = shape.head(q, shape.queries, item, head, first);
                product_at(
                    size_k,
                    targets.1.at(key_offset),
                    width,
                    keep,
                    shape.scale,
                    ds.transposed(),
                    q,
                    threads,
                );
            }
        }
    };
    if pairs == 1 {
        run(0)
    } else {
        (0..pairs).into_par_iter().for_each(run)
    }
    (dq, dk, dv)
}
