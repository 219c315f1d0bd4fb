//! Group and layer normalisation with their adjoints; statistics in f64 of
//! f32 partial sums, the deviation from the mean taken before squaring, so
//! that a large common offset costs no digits.

use super::filled;
use super::pointwise::{silu, silu_derivative};
use super::simd::{CHUNK, sum_of, sum_of_2, vectorized};

/// Shape of a group normalisation over [batch, channels, pixels].
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupShape {
    pub channels: usize,
    pub pixels: usize,
    pub groups: usize,
    pub eps: f32,
    /// Follow with x / (1 + e^-x).
    pub silu: bool,
}

impl GroupShape {
    fn group_len(&self) -> usize {
        self.channels / self.groups * self.pixels
    }
}

vectorized! {
    /// Mean and reciprocal standard deviation: those of pieces that stay in the cache, merged [Chan, Golub & LeVeque 1983].
    fn statistics(x: &[f32], eps: f32) -> (f32, f32) {
        let (mut n, mut mean, mut squares) = (0f64, 0f64, 0f64);
        for piece in x.chunks(CHUNK) {
            let count = piece.len() as f64;
            // The mean to f32, then by what the elements are off it: sums of large values round.
            let pivot = (sum_of(piece, |v| v) / count) as f32;
            let off = sum_of(piece, |v| v - pivot) / count;
            let apart = pivot as f64 + off - mean;
            squares += sum_of(piece, |v| (v - pivot) * (v - pivot)) - count * off * off;
            squares += apart * apart * (n * count / (n + count));
            n += count;
            mean += apart * count / n;
        }
        // Not `max`, which would turn NaN into 0.
        let variance = if squares < 0.0 { 0.0 } else { squares / n };
        (mean as f32, (1.0 / (variance + eps as f64).sqrt()) as f32)
    }
}

vectorized! {
    fn affine(x: &[f32], scale: f32, shift: f32, with_silu: bool, y: &mut [f32]) {
        let pairs = y.iter_mut().zip(x);
        if with_silu {
            pairs.for_each(|(y, &x)| *y = silu(x * scale + shift));
        } else {
            pairs.for_each(|(y, &x)| *y = x * scale + shift);
        }
    }
}

/// y = gamma (x - mean) / deviation + beta by group, then SiLU if asked.
pub(crate) fn group_norm(shape: GroupShape, x: &[f32], gamma: &[f32], beta: &[f32]) -> Vec<f32> {
    let len = shape.group_len();
    let per_group = shape.channels / shape.groups;
    let job = |job: usize, y: &mut [f32]| {
        let x = &x[job * len..][..len];
        let first = job % shape.groups * per_group;
        let (mean, rstd) = statistics(x, shape.eps);
        let channels = y.chunks_mut(shape.pixels).zip(x.chunks(shape.pixels));
        for (c, (y, x)) in channels.enumerate() {
            let scale = gamma[first + c] * rstd;
            affine(x, scale, beta[first + c] - mean * scale, shape.silu, y);
        }
    };
    filled(x.len(), len, 1, job).0
}

vectorized! {
    /// dz = g silu'(gamma xhat + beta) into `dz`; returns (sum dz, sum dz xhat).
    fn through_activation(
        x: &[f32], g: &[f32], mean: f32, rstd: f32, gamma: f32, beta: f32, with_silu: bool, dz: &mut [f32],
    ) -> (f64, f64) {
        let scale = gamma * rstd;
        let shift = beta - mean * scale;
        let (mut sum, mut sum_xhat) = (0f64, 0f64);
        for ((x, g), dz) in x.chunks(CHUNK).zip(g.chunks(CHUNK)).zip(dz.chunks_mut(CHUNK)) {
            if with_silu {
                for ((d, &x), &g) in dz.iter_mut().zip(x).zip(g) {
                    *d = g * silu_derivative(x * scale + shift);
                }
            } else {
                dz.copy_from_slice(g);
            }
            sum += sum_of(dz, |d| d);
            sum_xhat += sum_of_2(dz, x, |d, x| d * ((x - mean) * rstd));
        }
        (sum, sum_xhat)
    }
}

vectorized! {
    /// dx = scale dz - offset - slope (x - mean), in place of dz.
    fn recenter(x: &[f32], scale: f32, offset: f32, slope: f32, mean: f32, dz: &mut [f32]) {
        for (d, &x) in dz.iter_mut().zip(x) {
            *d = *d * scale - offset - slope * (x - mean);
        }
    }
}

/// Gradients of [`group_norm`]: (dx, dgamma, dbeta).
pub(crate) fn group_norm_vjp(
    shape: GroupShape,
    x: &[f32],
    gamma: &[f32],
    beta: &[f32],
    g: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let len = shape.group_len();
    let per_group = shape.channels / shape.groups;
    let pixels = shape.pixels;
    let job = |job: usize, dx: &mut [f32]| {
        let (x, g) = (&x[job * len..][..len], &g[job * len..][..len]);
        let first = job % shape.groups * per_group;
        let (mean, rstd) = statistics(x, shape.eps);
        let mut sums = Vec::with_capacity(per_group);
        let (mut total, mut total_xhat) = (0f64, 0f64);
        for c in 0..per_group {
            let range = c * pixels..(c + 1) * pixels;
            let (gamma, beta) = (gamma[first + c], beta[first + c]);
            let (s, sx) = through_activation(
                &x[range.clone()],
                &g[range.clone()],
                mean,
                rstd,
                gamma,
                beta,
                shape.silu,
                &mut dx[range],
            );
            total += s * gamma as f64;
            total_xhat += sx * gamma as f64;
            sums.push((s, sx));
        }
        let offset = (total / len as f64 * rstd as f64) as f32;
        let slope = (total_xhat / len as f64 * rstd as f64 * rstd as f64) as f32;
        for c in 0..per_group {
            let range = c * pixels..(c + 1) * pixels;
            recenter(
                &x[range.clone()],
                gamma[first + c] * rstd,
                offset,
                slope,
                mean,
                &mut dx[range],
            );
        }
        sums
    };
    let (dx, sums) = filled(x.len(), len, 1, job);
    let (mut dgamma, mut dbeta) = (vec![0f64; shape.channels], vec![0f64; shape.channels]);
    for (job, sums) in sums.iter().enumerate() {
        for (c, (s, sx)) in sums.iter().enumerate() {
            let channel = job % shape.groups * per_group + c;
            dbeta[channel] += s;
            dgamma[channel] += sx;
        }
    }
    let narrow = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect();
    (dx, narrow(dgamma), narrow(dbeta))
}

vectorized! {
    fn layer_norm_row(x: &[f32], gamma: &[f32], beta: &[f32], eps: f32, y: &mut [f32]) {
        let n = x.len() as f64;
        let mean = (sum_of(x, |v| v) / n) as f32;
        let variance = sum_of(x, |v| (v - mean) * (v - mean)) / n;
        let rstd = (1.0 / (variance + eps as f64).sqrt()) as f32;
        for i in 0..x.len() {
            y[i] = (x[i] - mean) * rstd * gamma[i] + beta[i];
        }
    }
}

/// Rows of `gamma.len()` elements, each normalised.
pub(crate) fn layer_norm(x: &[f32], gamma: &[f32], beta: &[f32], eps: f32) -> Vec<f32> {
    let n = gamma.len();
    let job = |row: usize, y: &mut [f32]| layer_norm_row(&x[row * n..][..n], gamma, beta, eps, y);
    filled(x.len(), n, 16, job).0
}

vectorized! {
    /// dx of one row; `xhat` receives the normalised row.
    fn layer_norm_row_vjp(x: &[f32], gamma: &[f32], g: &[f32], eps: f32, xhat: &mut [f32], dx: &mut [f32]) {
        let n = x.len() as f64;
        let mean = (sum_of(x, |v| v) / n) as f32;
        let variance = sum_of(x, |v| (v - mean) * (v - mean)) / n;
        let rstd = (1.0 / (variance + eps as f64).sqrt()) as f32;
        for i in 0..x.len() {
            xhat[i] = (x[i] - mean) * rstd;
            dx[i] = g[i] * gamma[i];
        }
        let offset = (sum_of(dx, |v| v) / n) as f32;
        let slope = (sum_of_2(dx, xhat, |d, x| d * x) / n) as f32;
        for i in 0..x.len() {
            dx[i] = rstd * (dx[i] - offset - slope * xhat[i]);
        }
    }
}

/// Rows of one job of the adjoint: its partial sums are reduced in order.
const ROWS: usize = 64;

/// Gradients of [`layer_norm`]: (dx, dgamma, dbeta).
pub(crate) fn layer_norm_vjp(
    x: &[f32],
    gamma: &[f32],
    g: &[f32],
    eps: f32,
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let n = gamma.len();
    let job = |job: usize, dx: &mut [f32]| {
        let [x, g] = [x, g].map(|values| &values[job * n * ROWS..][..dx.len()]);
        let (mut dgamma, mut dbeta, mut xhat) = (vec![0f32; n], vec![0f32; n], vec![0f32; n]);
        for ((dx, x), g) in dx.chunks_mut(n).zip(x.chunks(n)).zip(g.chunks(n)) {
            layer_norm_row_vjp(x, gamma, g, eps, &mut xhat, dx);
            for i in 0..n {
                dgamma[i] += g[i] * xhat[i];
                dbeta[i] += g[i];
            }
        }
        (dgamma, dbeta)
    };
    let (dx, partial) = filled(x.len(), n * ROWS, 1, job);
    let (mut dgamma, mut dbeta) = (vec![0f32; n], vec![0f32; n]);
    for (a, b) in &partial {
        for i in 0..n {
            dgamma[i] += a[i];
            dbeta[i] += b[i];
        }
    }
    (dx, dgamma, dbeta)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_of_pieces_are_those_of_the_whole_beside_a_large_mean() {
        // Two whole pieces and a part of one, whose means differ.
        let value = |i: usize| 1e4 + (i * 2_654_435_761 % 1000) as f32 * 1e-3 + i as f32 * 1e-3;
        let x: Vec<f32> = (0..2 * CHUNK + 300).map(value).collect();
        let n = x.len() as f64;
        let mean = x.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
        let squares = x.iter().map(|&v| (f64::from(v) - mean).powi(2));
        let exact = 1.0 / (squares.sum::<f64>() / n + 1e-5).sqrt();
        let (found, rstd) = statistics(&x, 1e-5);
        // Half a unit in the last place of 1e4.
        assert!((f64::from(found) - mean).abs() <= 4.9e-4, "{found}");
        // A lane sums 64 squares, each step to 2^-24: 4e-6 of the variance, half of it of the root.
        let error = (f64::from(rstd) / exact - 1.0).abs();
        assert!(error < 2.1e-6, "{error:e}");
        let (_, rstd) = statistics(&[1.0, f32::NAN, 2.0], 1e-5);
        assert!(rstd.is_nan());
        let (_, rstd) = statistics(&[1e4; 5000], 1e-6);
        assert!((rstd - 1e3).abs() < 0.1, "{rstd}");
    }
}
