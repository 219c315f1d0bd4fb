//! Activations and their derivatives, vectorised and in parallel.

use super::filled;
use super::simd::{erf, exp, sigmoid, vectorized};

/// Elements of one job: 64 KiB, small beside L2 and large beside a wake-up.
const JOB: usize = 16 * 1024;

/// Activation functions of the models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Activation {
    /// x / (1 + e^-x)
    Silu,
    /// x Phi(x), with the exact normal distribution function.
    Gelu,
    /// x / (1 + e^(-1.702 x)), of the first CLIP.
    QuickGelu,
}

const QUICK: f32 = 1.702;
const SQRT_HALF: f32 = std::f32::consts::FRAC_1_SQRT_2;

#[inline(always)]
pub(crate) fn silu(x: f32) -> f32 {
    x * sigmoid(x)
}

#[inline(always)]
pub(crate) fn silu_derivative(x: f32) -> f32 {
    let s = sigmoid(x);
    s * (1.0 + x * (1.0 - s))
}

#[inline(always)]
fn gelu(x: f32) -> f32 {
    0.5 * x * (1.0 + erf(x * SQRT_HALF))
}

#[inline(always)]
fn gelu_derivative(x: f32) -> f32 {
    const INV_SQRT_TAU: f32 = 0.398_942_3;
    0.5 * (1.0 + erf(x * SQRT_HALF)) + x * INV_SQRT_TAU * exp(-0.5 * x * x)
}

#[inline(always)]
fn quick_gelu(x: f32) -> f32 {
    x * sigmoid(QUICK * x)
}

#[inline(always)]
fn quick_gelu_derivative(x: f32) -> f32 {
    let s = sigmoid(QUICK * x);
    s * (1.0 + QUICK * x * (1.0 - s))
}

vectorized! {
    fn eval_job(f: Activation, x: &[f32], y: &mut [f32]) {
        let pairs = y.iter_mut().zip(x);
        match f {
            Activation::Silu => pairs.for_each(|(y, &x)| *y = silu(x)),
            Activation::Gelu => pairs.for_each(|(y, &x)| *y = gelu(x)),
            Activation::QuickGelu => pairs.for_each(|(y, &x)| *y = quick_gelu(x)),
        }
    }
}

vectorized! {
    /// g f'(x) into `dx`.
    fn vjp_job(f: Activation, x: &[f32], g: &[f32], dx: &mut [f32]) {
        let triples = dx.iter_mut().zip(x.iter().zip(g));
        match f {
            Activation::Silu => triples.for_each(|(d, (&x, &g))| *d = g * silu_derivative(x)),
            Activation::Gelu => triples.for_each(|(d, (&x, &g))| *d = g * gelu_derivative(x)),
            Activation::QuickGelu => triples.for_each(|(d, (&x, &g))| *d = g * quick_gelu_derivative(x)),
        }
    }
}

/// f(x), elementwise.
pub(crate) fn eval(f: Activation, x: &[f32]) -> Vec<f32> {
    let job = |job: usize, y: &mut [f32]| eval_job(f, &x[job * JOB..][..y.len()], y);
    filled(x.len(), JOB, 1, job).0
}

/// The gradient with respect to x: g f'(x).
pub(crate) fn eval_vjp(f: Activation, x: &[f32], g: &[f32]) -> Vec<f32> {
    let job = |job: usize, dx: &mut [f32]| {
        let [x, g] = [x, g].map(|values| &values[job * JOB..][..dx.len()]);
        vjp_job(f, x, g, dx)
    };
    filled(x.len(), JOB, 1, job).0
}

vectorized! {
    fn geglu_row(x: &[f32], y: &mut [f32]) {
        let (value, gate) = x.split_at(y.len());
        for i in 0..y.len() {
            y[i] = value[i] * gelu(gate[i]);
        }
    }
}

vectorized! {
    fn geglu_row_vjp(x: &[f32], g: &[f32], dx: &mut [f32]) {
        let n = g.len();
        let (value, gate) = x.split_at(n);
        let (dvalue, dgate) = dx.split_at_mut(n);
        for i in 0..n {
            dvalue[i] = g[i] * gelu(gate[i]);
            dgate[i] = g[i] * value[i] * gelu_derivative(gate[i]);
        }
    }
}

/// Rows of `2 width` inputs, (value, gate), to rows of value * gelu(gate).
pub(crate) fn geglu(x: &[f32], width: usize) -> Vec<f32> {
    let job = |row: usize, y: &mut [f32]| geglu_row(&x[2 * row * width..][..2 * width], y);
    filled(x.len() / 2, width, 8, job).0
}

/// Gradient of [`geglu`] with respect to its input.
pub(crate) fn geglu_vjp(x: &[f32], width: usize, g: &[f32]) -> Vec<f32> {
    let job = |row: usize, dx: &mut [f32]| {
        let (x, g) = (
            &x[2 * row * width..][..2 * width],
            &g[row * width..][..width],
        );
        geglu_row_vjp(x, g, dx)
    };
    filled(x.len(), 2 * width, 8, job).0
}
