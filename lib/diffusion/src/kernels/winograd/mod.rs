//! 3x3 convolutions of stride 1 by Winograd's minimal filtering F(4x4, 3x3)
//! [Lavin & Gray 2016]: 36 products for 16 outputs instead of 144, at rounding
//! errors of about 1e-6 of the largest output for hundreds of channels.
//!
//! Everything works on sixteen channels at once. The tiles of the batch are
//! cut into chunks, whose transformed inputs stay in L2; a job is one chunk
//! and [`GROUPS`] groups of outputs, for which it transforms the weights,
//! multiplies, and transforms back.

mod gradient;
mod product;
mod transform;

use rayon::prelude::*;

pub(super) use gradient::gradient_of_weights;
use product::{Left, ROWS, multiply};
use transform::{Input, Lift};

use super::SharedMut;
use super::conv::ConvShape;
use super::lanes::{LANES, Lane, gather, scatter, with_lanes};
use super::simd::vectorized;

/// Outputs of a tile, along one side.
const TILE: usize = 4;
/// Inputs of a tile, along one side.
const PATCH: usize = 6;
/// Products of a tile and a channel pair.
const POINTS: usize = PATCH * PATCH;
/// Taps of a kernel.
const TAPS: usize = 9;
/// Tiles of a chunk at most, a multiple of the lanes.
const CHUNK: usize = 64;
/// Groups of outputs of a job, an even number.
const GROUPS: usize = 2;
/// Groups of inputs whose weights are transformed at a time.
const DEPTH: usize = 8;
/// Lanes of one point of these weights: one more, as in [`Tiles::pitch`].
const KERNELS: usize = DEPTH * LANES + 1;
/// Lanes of the chunks that are transformed at a time, 32 MiB, if one is not more.
const BLOCK: usize = 512 << 10;
/// Fewer tiles do not pay for transforming the weights.
const MIN_TILES: usize = 16;
/// Fewer channels do not pay for transforming the tiles.
const MIN_CHANNELS: usize = 16;

/// Whether this is a convolution that gains from the transformation.
pub(super) fn suits(shape: ConvShape) -> bool {
    shape.kernel == 3
        && shape.stride == 1
        && shape.inputs >= MIN_CHANNELS
        && shape.outputs >= MIN_CHANNELS
        && Tiles::new(shape).all >= MIN_TILES
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

/// Tiles side by side.
struct Run {
    image: usize,
    /// The first tile's outputs.
    top: usize,
    left: usize,
    count: usize,
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

    /// The tiles beside `first`, itself included, below `end`.
    fn run(&self, first: usize, end: usize) -> Run {
        let (image, rest) = (first / self.each, first % self.each);
        let column = rest % self.across;
        Run {
            image,
            top: rest / self.across * TILE,
            left: column * TILE,
            count: (self.across - column).min(end.min(self.all) - first),
        }
    }

    /// Tiles of a chunk.
    fn chunk(&self) -> usize {
        CHUNK.min(self.all.next_multiple_of(LANES))
    }

    /// Lanes of one point of a chunk: one more, so that a tile's points do not all fall into one set of L1.
    fn pitch(&self) -> usize {
        self.chunk() + 1
    }

    /// Lanes that one row of tiles needs.
    fn strip(&self) -> usize {
        PATCH * (TILE * self.across + PATCH - TILE)
    }
}

/// Planes [batch, channels, height, width] with zeros around them.
#[derive(Clone, Copy)]
struct Planes<'a> {
    data: &'a [f32],
    channels: usize,
    height: usize,
    width: usize,
    pad: usize,
}

impl Planes<'_> {
    fn groups(&self) -> usize {
        self.channels.div_ceil(LANES)
    }

    /// One row of a group of channels, from column `left` on; both count the zeros before.
    #[inline(always)]
    fn row(&self, image: usize, group: usize, (y, left): (usize, usize), target: &mut [Lane]) {
        let y = y.wrapping_sub(self.pad);
        let before = self.pad.saturating_sub(left).min(target.len());
        let first = (left + before).wrapping_sub(self.pad);
        if y >= self.height || first >= self.width {
            return target.fill(Lane::ZERO);
        }
        let count = (self.width - first).min(target.len() - before);
        target[..before].fill(Lane::ZERO);
        target[before + count..].fill(Lane::ZERO);
        let plane = self.height * self.width;
        let start = (image * self.channels + group * LANES) * plane + y * self.width + first;
        let rows = LANES.min(self.channels - group * LANES);
        gather(
            &self.data[start..],
            plane,
            rows,
            &mut target[before..][..count],
        );
    }
}

/// Transforms the tiles of a chunk from `first` on, of one group of channels, into `target[point][tile]`. Tiles past
/// the last one are 0.
#[inline(always)]
fn lift<L: Lift<R>, const R: usize>(
    tiles: Tiles,
    first: usize,
    (planes, group): (Planes, usize),
    strip: &mut [Lane],
    target: &mut [Lane],
) {
    let (chunk, pitch) = (tiles.chunk(), tiles.pitch());
    let mut done = 0;
    while done < chunk {
        if first + done >= tiles.all {
            target
                .chunks_exact_mut(pitch)
                .for_each(|point| point[done..].fill(Lane::ZERO));
            return;
        }
        let run = tiles.run(first + done, first + chunk);
        let width = TILE * run.count + R - TILE;
        for i in 0..R {
            let place = (run.top + i, run.left);
            planes.row(run.image, group, place, &mut strip[i * width..][..width]);
        }
        for j in 0..width {
            let column = L::lift(std::array::from_fn(|i| strip[i * width + j]));
            for i in 0..PATCH {
                strip[i * width + j] = column[i];
            }
        }
        for tile in 0..run.count {
            for i in 0..PATCH {
                let start = i * width + tile * TILE;
                let row = L::lift(std::array::from_fn(|j| strip[start + j]));
                for j in 0..PATCH {
                    target[(i * PATCH + j) * pitch + done + tile] = row[j];
                }
            }
        }
        done += run.count;
    }
}

vectorized! {
    fn lift_inputs(tiles: Tiles, first: usize, planes: (Planes, usize), strip: &mut [Lane], target: &mut [Lane]) {
        lift::<Input, PATCH>(tiles, first, planes, strip, target);
    }
}

/// Chunks of transformed tiles, `[chunk][group][point][tile]`, by one of the functions above.
fn lift_chunks(
    tiles: Tiles,
    first: usize,
    planes: Planes,
    by: impl Fn(Tiles, usize, (Planes, usize), &mut [Lane], &mut [Lane]) + Sync,
    target: &mut [Lane],
) {
    let (chunk, groups) = (tiles.chunk(), planes.groups());
    target
        .par_chunks_mut(POINTS * tiles.pitch())
        .enumerate()
        .for_each(|(job, target)| {
            let first = (first + job / groups) * chunk;
            with_lanes(tiles.strip(), |strip| {
                by(tiles, first, (planes, job % groups), strip, target)
            });
        });
}

/// The convolution, and `bias` to every output.
pub(super) fn conv2d(
    shape: ConvShape,
    x: &[f32],
    w: &[f32],
    order: Weights,
    bias: Option<&[f32]>,
    out: &mut [f32],
) {
    let tiles = Tiles::new(shape);
    let planes = Planes {
        data: x,
        channels: shape.inputs,
        height: shape.height,
        width: shape.width,
        pad: shape.pad_before,
    };
    let (chunk, groups) = (tiles.chunk(), planes.groups());
    let (each, chunks) = (groups * POINTS * tiles.pitch(), tiles.all.div_ceil(chunk));
    let blocks = shape.outputs.div_ceil(GROUPS * LANES);
    let together = (BLOCK / each).max(1);
    let target = SharedMut::new(out);
    for first in (0..chunks).step_by(together) {
        let count = together.min(chunks - first);
        with_lanes(count * each, |lifted| {
            lift_chunks(tiles, first, planes, lift_inputs, lifted);
            (0..count * blocks).into_par_iter().for_each(|job| {
                let (part, block) = (job / blocks, job % blocks);
                let inputs = &lifted[part * each..][..each];
                let chunk = (first + part) * chunk;
                multiply_chunk(
                    tiles,
                    chunk,
                    block * GROUPS,
                    inputs,
                    (w, order),
                    bias,
                    target,
                );
            });
        });
    }
}

/// [`GROUPS`] groups of outputs from `group` on, of the tiles of a chunk from `first` on.
fn multiply_chunk(
    tiles: Tiles,
    first: usize,
    group: usize,
    inputs: &[Lane],
    weights: (&[f32], Weights),
    bias: Option<&[f32]>,
    target: SharedMut,
) {
    let (shape, pitch, all) = (
        tiles.shape,
        tiles.pitch(),
        tiles.shape.inputs.div_ceil(LANES),
    );
    let groups = GROUPS.min(shape.outputs.div_ceil(LANES) - group);
    with_lanes(groups * POINTS * pitch, |products| {
        with_lanes(groups * POINTS * KERNELS + TAPS * KERNELS, |lifted| {
            let (lifted, taps) = lifted.split_at_mut(groups * POINTS * KERNELS);
            for k in (0..all).step_by(DEPTH) {
                let count = DEPTH.min(all - k);
                for (output, lifted) in lifted.chunks_exact_mut(POINTS * KERNELS).enumerate() {
                    lift_weights(
                        shape,
                        weights,
                        group + output,
                        (k * LANES, count * LANES),
                        taps,
                        lifted,
                    );
                }
                let inputs = &inputs[k * POINTS * pitch..][..count * POINTS * pitch];
                multiply_points((tiles, groups, count), inputs, lifted, k > 0, products);
            }
        });
        with_lanes(tiles.strip(), |strip| {
            for (output, products) in products.chunks_exact(POINTS * pitch).enumerate() {
                lower(tiles, first, group + output, products, bias, strip, target);
            }
        });
    });
}

vectorized! {
    /// `products[output][point][tile] += sum of inputs[input][point][tile] lifted[output][point][input]`.
    fn multiply_points(size: (Tiles, usize, usize), inputs: &[Lane], lifted: &[Lane], keep: bool, products: &mut [Lane]) {
        let (tiles, groups, count) = size;
        let (chunk, pitch) = (tiles.chunk(), tiles.pitch());
        assert!(inputs.len() >= count * POINTS * pitch && lifted.len() >= groups * POINTS * KERNELS);
        assert!(products.len() >= groups * POINTS * pitch && chunk % ROWS == 0 && count <= DEPTH);
        for point in 0..POINTS {
            for output in (0..groups).step_by(2) {
                let right = (lifted[(output * POINTS + point) * KERNELS..].as_ptr(), POINTS * KERNELS);
                for tile in (0..chunk).step_by(ROWS) {
                    let data = inputs[point * pitch + tile..].as_ptr().cast::<f32>();
                    let left = Left::<LANES, 1> { data, jump: POINTS * pitch * LANES };
                    let out = (products[(output * POINTS + point) * pitch + tile..].as_mut_ptr(), 1, POINTS * pitch);
                    // SAFETY: the lengths were checked above.
                    unsafe {
                        match groups - output {
                            1 => multiply::<1, LANES, 1>(count, left, right, out, keep),
                            _ => multiply::<2, LANES, 1>(count, left, right, out, keep),
                        }
                    }
                }
            }
        }
    }
}

vectorized! {
    /// Weights of one group of outputs and `count` inputs from `first` on into `target[point][input]`; those of no
    /// channel are 0.
    fn lift_weights(
        shape: ConvShape, weights: (&[f32], Weights), group: usize, range: (usize, usize), taps: &mut [Lane], target: &mut [Lane],
    ) {
        let ((w, order), (first, count)) = (weights, range);
        let (inputs, outputs) = (shape.inputs, shape.outputs);
        let output = group * LANES;
        let (rows, real) = (LANES.min(outputs - output), count.min(inputs - first));
        let taps = &mut taps[..count * TAPS];
        taps[real * TAPS..].fill(Lane::ZERO);
        if order == Weights::AsStored {
            let start = (output * inputs + first) * TAPS;
            gather(&w[start..], inputs * TAPS, rows, &mut taps[..real * TAPS]);
        } else {
            for (input, taps) in taps.chunks_exact_mut(TAPS).enumerate().take(real) {
                gather(&w[((first + input) * outputs + output) * TAPS..], TAPS, rows, taps);
                taps.reverse();
            }
        }
        for (input, taps) in taps.chunks_exact(TAPS).enumerate() {
            let mut half = [[Lane::ZERO; 3]; PATCH];
            for j in 0..3 {
                let column = transform::of_weights([taps[j], taps[3 + j], taps[6 + j]]);
                for i in 0..PATCH {
                    half[i][j] = column[i];
                }
            }
            for i in 0..PATCH {
                let row = transform::of_weights(half[i]);
                for j in 0..PATCH {
                    target[(i * PATCH + j) * KERNELS + input] = row[j];
                }
            }
        }
    }
}

vectorized! {
    /// Products `[point][tile]` of one group of outputs, of the tiles of a chunk from `first` on, to pixels.
    fn lower(
        tiles: Tiles, first: usize, group: usize, products: &[Lane], bias: Option<&[f32]>, strip: &mut [Lane], target: SharedMut,
    ) {
        let (shape, chunk, pitch) = (tiles.shape, tiles.chunk(), tiles.pitch());
        let (height, width, output) = (shape.out_height(), shape.out_width(), group * LANES);
        let rows = LANES.min(shape.outputs - output);
        let mut shift = Lane::ZERO;
        if let Some(bias) = bias {
            shift.0[..rows].copy_from_slice(&bias[output..output + rows]);
        }
        let mut done = 0;
        while done < chunk && first + done < tiles.all {
            let run = tiles.run(first + done, first + chunk);
            let across = TILE * run.count;
            for tile in 0..run.count {
                let mut half = [[Lane::ZERO; PATCH]; TILE];
                for j in 0..PATCH {
                    let column = std::array::from_fn(|i| products[(i * PATCH + j) * pitch + done + tile]);
                    let column = transform::to_output(column);
                    for i in 0..TILE {
                        half[i][j] = column[i];
                    }
                }
                for i in 0..TILE {
                    let row = transform::to_output(half[i]);
                    for j in 0..TILE {
                        strip[i * across + tile * TILE + j] = row[j] + shift;
                    }
                }
            }
            let plane = height * width;
            let start = (run.image * shape.outputs + output) * plane + run.top * width + run.left;
            for i in 0..TILE.min(height - run.top) {
                let strip = &strip[i * across..][..across.min(width - run.left)];
                // SAFETY: each job owns the pixels of its tiles and outputs, and the row lies inside after clipping.
                unsafe { scatter(strip, rows, target.at(start + i * width), plane) };
            }
            done += run.count;
        }
    }
}
