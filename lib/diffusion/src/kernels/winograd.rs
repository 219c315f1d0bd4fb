//! 3x3 convolutions of stride 1 by Winograd's minimal filtering F(4x4, 3x3)
//! [Lavin & Gray 2016]: 36 products for 16 outputs instead of 144, at rounding
//! errors of about 1e-6 of the largest output for hundreds of channels.

use rayon::prelude::*;

use super::conv::ConvShape;
use super::matmul::{Matrix, Threads, product_at};
use super::simd::vectorized;
use super::{SharedMut, with_scratch};

/// Outputs of a tile, along one side.
const TILE: usize = 4;
/// Inputs of a tile, along one side.
const PATCH: usize = 6;
/// Products of a tile and a channel pair.
const POINTS: usize = PATCH * PATCH;
/// Tiles, or channels, that are transformed together.
const LANES: usize = 16;
/// Floats of the transformed tiles of one block: 32 MiB.
const BLOCK: usize = 8 << 20;
/// Outputs of one job of the products at most.
const PART_OUTPUTS: usize = 640;
/// Fewer pixels do not pay for transforming the weights.
const MIN_PIXELS: usize = 512;
/// Fewer channels do not pay for transforming the tiles.
const MIN_CHANNELS: usize = 16;

type Lane = [f32; LANES];

/// Whether this is a convolution that gains from the transformation.
pub(super) fn suits(shape: ConvShape) -> bool {
    shape.kernel == 3
        && shape.stride == 1
        && shape.inputs >= MIN_CHANNELS
        && shape.outputs >= MIN_CHANNELS
        && shape.batch * shape.out_height() * shape.out_width() >= MIN_PIXELS
}

/// Which weights a convolution uses.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Weights {
    /// [outputs, inputs, 3, 3].
    AsStored,
    /// Weights of the adjoint: [inputs, outputs, 3, 3], each kernel rotated by 180 degrees.
    Adjoint,
}

/// Tiles of a convolution, counted over the batch, row by row.
#[derive(Clone, Copy)]
struct Tiles {
    shape: ConvShape,
    across: usize,
    each: usize,
    all: usize,
}

impl Tiles {
    fn new(shape: ConvShape) -> Self {
        let across = shape.out_width().div_ceil(TILE);
        let each = across * shape.out_height().div_ceil(TILE);
        Self {
            shape,
            across,
            each,
            all: each * shape.batch,
        }
    }

    /// (image, top, left) of a tile's outputs.
    fn place(&self, tile: usize) -> (usize, usize, usize) {
        let (image, rest) = (tile / self.each, tile % self.each);
        (image, rest / self.across * TILE, rest % self.across * TILE)
    }

    /// Tiles of one block, a multiple of the lanes, from the shape alone.
    fn block(&self) -> usize {
        let per_tile = POINTS * (self.shape.inputs + self.shape.outputs);
        let wanted = (BLOCK / per_tile).min(self.all).max(LANES);
        wanted.next_multiple_of(LANES)
    }
}

/// The convolution, added to what `out` holds (its bias).
pub(super) fn conv2d(shape: ConvShape, x: &[f32], w: &[f32], order: Weights, out: &mut [f32]) {
    let tiles = Tiles::new(shape);
    let block = tiles.block();
    let (inputs, outputs) = (shape.inputs, shape.outputs);
    with_scratch(POINTS * inputs * outputs, |u| {
        transform_weights(shape, w, order, u);
        with_scratch(POINTS * inputs * block, |v| {
            with_scratch(POINTS * outputs * block, |m| {
                for first in (0..tiles.all).step_by(block) {
                    let count = block.min((tiles.all - first).next_multiple_of(LANES));
                    transform_tiles(tiles, first, count, x, v);
                    multiply((outputs, count, inputs), u, v, m);
                    transform_back(tiles, first, count, m, out);
                }
            });
        });
    });
}

/// m[p] = u[p] v[p] for each of the points.
fn multiply((outputs, count, inputs): (usize, usize, usize), u: &[f32], v: &[f32], m: &mut [f32]) {
    // Each part packs the tiles again, so few outputs stay together.
    let parts = outputs.div_ceil(PART_OUTPUTS);
    let part = outputs.div_ceil(parts);
    let target = SharedMut::new(m);
    (0..parts * POINTS).into_par_iter().for_each(|job| {
        let (point, first) = (job / parts, job % parts * part);
        let rows = part.min(outputs - first);
        let u = Matrix::rows(&u[(point * outputs + first) * inputs..], inputs);
        let v = Matrix::rows(&v[point * inputs * count..], count);
        // SAFETY: each job owns its rows of its point.
        unsafe {
            let out = target.at((point * outputs + first) * count);
            product_at(
                (rows, count, inputs),
                out,
                count,
                0.0,
                1.0,
                u,
                v,
                Threads::One,
            );
        }
    });
}

/// B^T d for one column of a patch.
#[inline(always)]
fn tile_column(d: [Lane; PATCH]) -> [Lane; PATCH] {
    let mut t = [[0f32; LANES]; PATCH];
    for i in 0..LANES {
        let (d0, d1, d2, d3, d4, d5) = (d[0][i], d[1][i], d[2][i], d[3][i], d[4][i], d[5][i]);
        t[0][i] = 4.0 * d0 - 5.0 * d2 + d4;
        let (even, odd) = (d4 - 4.0 * d2, d3 - 4.0 * d1);
        t[1][i] = even + odd;
        t[2][i] = even - odd;
        let (even, odd) = (d4 - d2, 2.0 * (d3 - d1));
        t[3][i] = even + odd;
        t[4][i] = even - odd;
        t[5][i] = 4.0 * d1 - 5.0 * d3 + d5;
    }
    t
}

/// A^T m for one column of products.
#[inline(always)]
fn output_column(m: [Lane; PATCH]) -> [Lane; TILE] {
    let mut y = [[0f32; LANES]; TILE];
    for i in 0..LANES {
        let (sum1, difference1) = (m[1][i] + m[2][i], m[1][i] - m[2][i]);
        let (sum2, difference2) = (m[3][i] + m[4][i], m[3][i] - m[4][i]);
        y[0][i] = m[0][i] + sum1 + sum2;
        y[1][i] = difference1 + 2.0 * difference2;
        y[2][i] = sum1 + 4.0 * sum2;
        y[3][i] = difference1 + 8.0 * difference2 + m[5][i];
    }
    y
}

/// G g for one column of a kernel.
#[inline(always)]
fn weight_column(g: [Lane; 3]) -> [Lane; PATCH] {
    let mut u = [[0f32; LANES]; PATCH];
    for i in 0..LANES {
        let (g0, g1, g2) = (g[0][i], g[1][i], g[2][i]);
        u[0][i] = 0.25 * g0;
        let even = -(g0 + g2) * (1.0 / 6.0);
        u[1][i] = even - g1 * (1.0 / 6.0);
        u[2][i] = even + g1 * (1.0 / 6.0);
        let even = g0 * (1.0 / 24.0) + g2 * (1.0 / 6.0);
        u[3][i] = even + g1 * (1.0 / 12.0);
        u[4][i] = even - g1 * (1.0 / 12.0);
        u[5][i] = g2;
    }
    u
}

/// Both passes of a square transformation: columns, then rows.
#[inline(always)]
fn both_ways<const FROM: usize, const TO: usize>(
    d: &[[Lane; FROM]; FROM],
    pass: impl Fn([Lane; FROM]) -> [Lane; TO],
) -> [[Lane; TO]; TO] {
    let mut half = [[[0f32; LANES]; FROM]; TO];
    for j in 0..FROM {
        let mut column = [[0f32; LANES]; FROM];
        for i in 0..FROM {
            column[i] = d[i][j];
        }
        let column = pass(column);
        for i in 0..TO {
            half[i][j] = column[i];
        }
    }
    let mut full = [[[0f32; LANES]; TO]; TO];
    for i in 0..TO {
        full[i] = pass(half[i]);
    }
    full
}

/// One channel of tiles `first..first + count`, into `v[point][channel]`.
fn transform_tiles(tiles: Tiles, first: usize, count: usize, x: &[f32], v: &mut [f32]) {
    let target = SharedMut::new(v);
    (0..tiles.shape.inputs)
        .into_par_iter()
        .with_min_len(4)
        .for_each(|channel| {
            transform_channel(tiles, first, count, channel, x, target);
        });
}

vectorized! {
    fn transform_channel(tiles: Tiles, first: usize, count: usize, channel: usize, x: &[f32], target: SharedMut) {
        let shape = tiles.shape;
        let (height, width, pad) = (shape.height, shape.width, shape.pad_before);
        for group in (0..count).step_by(LANES) {
            let mut d = [[[0f32; LANES]; PATCH]; PATCH];
            for lane in 0..LANES {
                let tile = first + group + lane;
                if tile >= tiles.all {
                    break;
                }
                let (image, top, left) = tiles.place(tile);
                let plane = &x[(image * shape.inputs + channel) * height * width..][..height * width];
                let inside = top >= pad && left >= pad && top + PATCH <= height + pad && left + PATCH <= width + pad;
                for i in 0..PATCH {
                    if inside {
                        let row = &plane[(top + i - pad) * width + left - pad..][..PATCH];
                        for j in 0..PATCH {
                            d[i][j][lane] = row[j];
                        }
                        continue;
                    }
                    let y = (top + i).wrapping_sub(pad);
                    for j in 0..PATCH {
                        let x = (left + j).wrapping_sub(pad);
                        d[i][j][lane] = if y < height && x < width { plane[y * width + x] } else { 0.0 };
                    }
                }
            }
            let t = both_ways(&d, tile_column);
            for point in 0..POINTS {
                let offset = (point * shape.inputs + channel) * count + group;
                // SAFETY: each channel owns its row of every point; `count`
                // is a multiple of the lanes.
                unsafe { std::ptr::copy_nonoverlapping(t[point / PATCH][point % PATCH].as_ptr(), target.at(offset), LANES) };
            }
        }
    }
}

/// Weights into `u[point][output][input]`.
fn transform_weights(shape: ConvShape, w: &[f32], order: Weights, u: &mut [f32]) {
    let target = SharedMut::new(u);
    (0..shape.outputs)
        .into_par_iter()
        .with_min_len(2)
        .for_each(|output| {
            transform_output_weights(shape, w, order, output, target);
        });
}

vectorized! {
    fn transform_output_weights(shape: ConvShape, w: &[f32], order: Weights, output: usize, target: SharedMut) {
        let (inputs, outputs) = (shape.inputs, shape.outputs);
        for first in (0..inputs).step_by(LANES) {
            let count = LANES.min(inputs - first);
            let mut g = [[[0f32; LANES]; 3]; 3];
            for lane in 0..count {
                let input = first + lane;
                let kernel = match order {
                    Weights::AsStored => &w[(output * inputs + input) * 9..][..9],
                    Weights::Adjoint => &w[(input * outputs + output) * 9..][..9],
                };
                for tap in 0..9 {
                    let from = if order == Weights::AsStored { tap } else { 8 - tap };
                    g[tap / 3][tap % 3][lane] = kernel[from];
                }
            }
            let t = both_ways(&g, weight_column);
            for point in 0..POINTS {
                let offset = (point * outputs + output) * inputs + first;
                // SAFETY: each output owns its row of every point.
                unsafe { std::ptr::copy_nonoverlapping(t[point / PATCH][point % PATCH].as_ptr(), target.at(offset), count) };
            }
        }
    }
}

/// Products back into pixels, added to `out`.
fn transform_back(tiles: Tiles, first: usize, count: usize, m: &[f32], out: &mut [f32]) {
    let target = SharedMut::new(out);
    (0..tiles.shape.outputs)
        .into_par_iter()
        .with_min_len(4)
        .for_each(|output| {
            transform_output(tiles, first, count, output, m, target);
        });
}

vectorized! {
    fn transform_output(tiles: Tiles, first: usize, count: usize, output: usize, m: &[f32], target: SharedMut) {
        let shape = tiles.shape;
        let (height, width) = (shape.out_height(), shape.out_width());
        for group in (0..count).step_by(LANES) {
            let mut d = [[[0f32; LANES]; PATCH]; PATCH];
            for point in 0..POINTS {
                let offset = (point * shape.outputs + output) * count + group;
                d[point / PATCH][point % PATCH].copy_from_slice(&m[offset..offset + LANES]);
            }
            let y = both_ways(&d, output_column);
            for lane in 0..LANES {
                let tile = first + group + lane;
                if tile >= tiles.all {
                    break;
                }
                let (image, top, left) = tiles.place(tile);
                let plane = (image * shape.outputs + output) * height * width;
                for i in 0..TILE.min(height - top) {
                    for j in 0..TILE.min(width - left) {
                        // SAFETY: each output channel owns its planes, and
                        // the tile lies inside after clipping.
                        unsafe { *target.at(plane + (top + i) * width + left + j) += y[i][j][lane] };
                    }
                }
            }
        }
    }
}
