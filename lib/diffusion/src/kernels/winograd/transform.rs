//! The transformations of F(4x4, 3x3), along one side, of sixteen channels at a time.

use super::super::lanes::Lane;
use super::{PATCH, TILE};

/// What lifts R pixels of a tile to its points.
pub(super) trait Lift<const R: usize> {
    fn lift(pixels: [Lane; R]) -> [Lane; PATCH];
}

/// B^T d: inputs of a tile.
pub(super) struct Input;

/// A y, the adjoint of [`to_output`]: outputs of a tile.
pub(super) struct Output;

impl Lift<PATCH> for Input {
    #[inline(always)]
    fn lift(d: [Lane; PATCH]) -> [Lane; PATCH] {
        let (even1, odd1) = (d[4] - 4.0 * d[2], d[3] - 4.0 * d[1]);
        let (even2, odd2) = (d[4] - d[2], 2.0 * (d[3] - d[1]));
        [
            4.0 * d[0] - 5.0 * d[2] + d[4],
            even1 + odd1,
            even1 - odd1,
            even2 + odd2,
            even2 - odd2,
            4.0 * d[1] - 5.0 * d[3] + d[5],
        ]
    }
}

impl Lift<TILE> for Output {
    #[inline(always)]
    fn lift(y: [Lane; TILE]) -> [Lane; PATCH] {
        let (even1, odd1) = (y[0] + y[2], y[1] + y[3]);
        let (even2, odd2) = (y[0] + 4.0 * y[2], 2.0 * y[1] + 8.0 * y[3]);
        [
            y[0],
            even1 + odd1,
            even1 - odd1,
            even2 + odd2,
            even2 - odd2,
            y[3],
        ]
    }
}

/// A^T m: products of a tile to its outputs.
#[inline(always)]
pub(super) fn to_output(m: [Lane; PATCH]) -> [Lane; TILE] {
    let (sum1, difference1) = (m[1] + m[2], m[1] - m[2]);
    let (sum2, difference2) = (m[3] + m[4], m[3] - m[4]);
    [
        m[0] + sum1 + sum2,
        difference1 + 2.0 * difference2,
        sum1 + 4.0 * sum2,
        difference1 + 8.0 * difference2 + m[5],
    ]
}

/// G g: taps of a kernel.
#[inline(always)]
pub(super) fn of_weights(g: [Lane; 3]) -> [Lane; PATCH] {
    const SIXTH: f32 = 1.0 / 6.0;
    let even1 = -SIXTH * (g[0] + g[2]);
    let odd1 = SIXTH * g[1];
    let even2 = (1.0 / 24.0) * g[0] + SIXTH * g[2];
    let odd2 = (1.0 / 12.0) * g[1];
    [
        0.25 * g[0],
        even1 - odd1,
        even1 + odd1,
        even2 + odd2,
        even2 - odd2,
        g[2],
    ]
}

/// G^T u: the adjoint of [`of_weights`].
#[inline(always)]
pub(super) fn to_weights(u: [Lane; PATCH]) -> [Lane; 3] {
    const SIXTH: f32 = 1.0 / 6.0;
    let (sum1, difference1) = (SIXTH * (u[1] + u[2]), u[2] - u[1]);
    let (sum2, difference2) = (u[3] + u[4], u[3] - u[4]);
    [
        0.25 * u[0] - sum1 + (1.0 / 24.0) * sum2,
        SIXTH * difference1 + (1.0 / 12.0) * difference2,
        SIXTH * sum2 - sum1 + u[5],
    ]
}
