//! Convolution without unfolding: the picture is packed once, with its border, in pairs of channels; what a tap of the
//! kernel meets is the same words at another offset.
//!
//! Columns are the positions of the bordered picture, row by row, so that sixteen neighbours are contiguous words for every
//! size; the sums of positions that belong to no output are dropped.

use half::bf16;
use rayon::prelude::*;

use super::element::{Element, SharedHalves, bits_of, place_row, transpose_words};
use super::micro::{DEPTH, ROWS, SIDE};
use super::taps::Taps;
use super::{Columns, JOB_COLUMNS, JOB_ROWS, TILE, blocks, with_halves, with_words};
use crate::kernels::conv::ConvShape;

/// Words of a cache line.
const LINE: usize = 16;

/// The kernel [outputs, inputs, taps] as one convolution reads it: element (output, input, tap) is at
/// `output * by_output + input * by_input + tap`, or at the opposite tap.
struct Kernel<'a> {
    data: &'a [bf16],
    by_output: usize,
    by_input: usize,
    turned: bool,
}

/// The convolution of x [batch, inputs, height, width] with w [outputs, inputs, kernel, kernel].
pub(crate) fn conv2d(shape: ConvShape, x: &[bf16], w: &[bf16], bias: Option<&[f32]>) -> Vec<bf16> {
    let taps = shape.kernel * shape.kernel;
    let kernel = Kernel {
        data: w,
        by_output: shape.inputs * taps,
        by_input: taps,
        turned: false,
    };
    run(shape, 1, (shape.height, shape.width), x, kernel, bias)
}

/// Gradient of [`conv2d`] with respect to x for the gradient `g` of its result: the convolution of `g`, its pixels as far
/// apart as the stride, with the kernel turned round and the channels exchanged.
pub(crate) fn conv2d_vjp_input(shape: ConvShape, g: &[bf16], w: &[bf16]) -> Vec<bf16> {
    let taps = shape.kernel * shape.kernel;
    let (height, width) = (shape.out_height(), shape.out_width());
    let before = shape.kernel - 1 - shape.pad_before;
    let adjoint = ConvShape {
        batch: shape.batch,
        inputs: shape.outputs,
        outputs: shape.inputs,
        kernel: shape.kernel,
        stride: 1,
        // As if the picture were as large as the result, the border is what the kernel needs.
        height: shape.height,
        width: shape.width,
        pad_before: before,
        pad_after: shape.kernel - 1 - before,
    };
    let kernel = Kernel {
        data: w,
        by_output: taps,
        by_input: shape.inputs * taps,
        turned: true,
    };
    run(adjoint, shape.stride, (height, width), g, kernel, None)
}

/// How the packed picture lies: [pairs of channels][phases][batch][height][width] words, where a phase holds the pixels
/// of one remainder of rows and columns by the stride.
struct Layout {
    /// Of one bordered picture of one phase.
    height: usize,
    width: usize,
    phases_per_side: usize,
    phase: usize,
    pair: usize,
    pairs: usize,
    /// Columns of the product.
    positions: usize,
}

impl Layout {
    fn new(shape: ConvShape) -> Self {
        let reach = (shape.kernel - 1) / shape.stride;
        let (height, width) = (shape.out_height() + reach, shape.out_width() + reach);
        let phases_per_side = shape.stride.min(shape.kernel);
        let positions = (shape.batch - 1) * height * width
            + (shape.out_height() - 1) * width
            + shape.out_width();
        // The last block of columns reads past the last picture.
        let slack = SIDE + reach * (width + 1);
        let phase = (shape.batch * height * width + slack).next_multiple_of(LINE);
        let phases = phases_per_side * phases_per_side;
        // An odd number of lines: rows of a tile do not fall onto the same few sets of the caches.
        let pair = ((phases * phase).div_ceil(LINE) | 1) * LINE;
        let pairs = shape.inputs.div_ceil(DEPTH) * DEPTH / 2;
        Self {
            height,
            width,
            phases_per_side,
            phase,
            pair,
            pairs,
            positions,
        }
    }

    /// Where the words of each step start: groups of 32 channels, and all taps of each.
    fn steps(&self, shape: ConvShape) -> Vec<usize> {
        let s = shape.stride;
        let taps = (0..shape.kernel).flat_map(|y| (0..shape.kernel).map(move |x| (y, x)));
        let taps: Vec<usize> = taps
            .map(|(y, x)| {
                let phase = y % s * self.phases_per_side + x % s;
                phase * self.phase + y / s * self.width + x / s
            })
            .collect();
        let groups = 0..self.pairs / (DEPTH / 2);
        groups
            .flat_map(|group| {
                taps.iter()
                    .map(move |tap| group * DEPTH / 2 * self.pair + tap)
            })
            .collect()
    }
}

/// The convolution of the pixels of x, `size`, that stand `spread` apart between zeros.
fn run(
    shape: ConvShape,
    spread: usize,
    size: (usize, usize),
    x: &[bf16],
    kernel: Kernel,
    bias: Option<&[f32]>,
) -> Vec<bf16> {
    let len = shape.batch * shape.outputs * shape.out_height() * shape.out_width();
    let mut out = Vec::with_capacity(len);
    if len == 0 {
        return out;
    }
    let layout = Layout::new(shape);
    let steps = layout.steps(shape);
    with_words(layout.pairs * layout.pair, |words| {
        words
            .par_chunks_exact_mut(layout.pair)
            .enumerate()
            .for_each(|(pair, words)| pack_pair(shape, &layout, spread, size, x, pair, words));
        let rows = shape.outputs.div_ceil(SIDE) * SIDE;
        with_halves(rows * steps.len() * DEPTH, |packed| {
            packed
                .par_chunks_exact_mut(steps.len() * TILE)
                .enumerate()
                .for_each(|(block, target)| pack_kernel(shape, &kernel, block * ROWS, target));
            let target = SharedHalves(out.as_mut_ptr());
            multiply(shape, &layout, &steps, packed, words, bias, target);
        });
    });
    // SAFETY: there is room for all outputs, and every one has been written.
    unsafe { out.set_len(len) };
    out
}

/// Packs two channels of all pictures.
fn pack_pair(
    shape: ConvShape,
    layout: &Layout,
    spread: usize,
    (height, width): (usize, usize),
    x: &[bf16],
    pair: usize,
    words: &mut [u32],
) {
    let (s, plane) = (shape.stride, height * width);
    let nothing = vec![bf16::ZERO; width];
    // The pixel that meets column `column` of a phase, if there is one.
    let pixel = |at: usize, phase: usize, size: usize| {
        let at = (at * s + phase).wrapping_sub(shape.pad_before);
        (at.is_multiple_of(spread) && at / spread < size).then_some(at / spread)
    };
    let pictures = shape.batch * layout.height * layout.width;
    for (phase, words) in words.chunks_mut(layout.phase).enumerate() {
        if phase >= layout.phases_per_side * layout.phases_per_side {
            words.fill(0);
            continue;
        }
        let (py, px) = (
            phase / layout.phases_per_side,
            phase % layout.phases_per_side,
        );
        let (lines, past) = words.split_at_mut(pictures);
        past.fill(0);
        for (line, target) in lines.chunks_exact_mut(layout.width).enumerate() {
            let (item, line) = (line / layout.height, line % layout.height);
            let Some(y) = pixel(line, py, height) else {
                target.fill(0);
                continue;
            };
            let [low, high] =
                [2 * pair, 2 * pair + 1].map(|channel| match channel < shape.inputs {
                    true => &x[(item * shape.inputs + channel) * plane + y * width..][..width],
                    false => &nothing,
                });
            if s == 1 && spread == 1 {
                // Pixel 0 is at column `pad_before`.
                let first = shape.pad_before.min(layout.width);
                let end = (first + width).min(layout.width);
                target[..first].fill(0);
                target[end..].fill(0);
                bf16::pair(low, high, &mut target[first..end]);
                continue;
            }
            for (column, word) in target.iter_mut().enumerate() {
                *word = pixel(column, px, width)
                    .map_or(0, |x| low[x].bits() as u32 | (high[x].bits() as u32) << 16);
            }
        }
    }
}

/// Packs the kernels of 16 outputs from `first`: groups of 32 inputs, and all taps of each.
fn pack_kernel(shape: ConvShape, kernel: &Kernel, first: usize, target: &mut [u16]) {
    let taps = shape.kernel * shape.kernel;
    let outputs = ROWS.min(shape.outputs.saturating_sub(first));
    if outputs < ROWS || !shape.inputs.is_multiple_of(DEPTH) {
        target.fill(0);
    }
    if outputs == 0 {
        return;
    }
    let split = Taps::new(taps);
    let mut rows = vec![[0u16; DEPTH]; taps];
    // Pairs of inputs of one tap: 16 words of 16 outputs.
    let mut words = vec![[0u32; ROWS * ROWS]; if kernel.turned { taps } else { 0 }];
    for (group, target) in target.chunks_exact_mut(taps * TILE).enumerate() {
        let inputs = DEPTH.min(shape.inputs - group * DEPTH);
        let start = first * kernel.by_output + group * DEPTH * kernel.by_input;
        if !kernel.turned {
            for i in 0..outputs {
                let source = &kernel.data[start + i * kernel.by_output..][..inputs * taps];
                split.split(bits_of(source), &mut rows);
                for (tap, tile) in target.chunks_exact_mut(TILE).enumerate() {
                    tile[i * DEPTH..][..inputs].copy_from_slice(&rows[tap][..inputs]);
                }
            }
            continue;
        }
        words.iter_mut().for_each(|words| words.fill(0));
        for input in 0..inputs {
            let source = &kernel.data[start + input * kernel.by_input..][..outputs * taps];
            split.split(bits_of(source), &mut rows);
            let shift = 16 * (input % 2);
            for (words, row) in words.iter_mut().zip(&rows) {
                let words = &mut words[input / 2 * ROWS..][..outputs];
                for (word, &value) in words.iter_mut().zip(row) {
                    *word |= (value as u32) << shift;
                }
            }
        }
        for (tap, words) in words.iter().enumerate() {
            transpose_words(words, &mut target[(taps - 1 - tap) * TILE..][..TILE]);
        }
    }
}

/// The product, and its sums where they belong: `target` has room for all outputs.
fn multiply(
    shape: ConvShape,
    layout: &Layout,
    steps: &[usize],
    packed: &[u16],
    words: &[u32],
    bias: Option<&[f32]>,
    target: SharedHalves,
) {
    let (out_height, out_width) = (shape.out_height(), shape.out_width());
    let column_jobs = layout.positions.div_ceil(JOB_COLUMNS);
    let row_jobs = shape.outputs.div_ceil(JOB_ROWS);
    (0..row_jobs * column_jobs).into_par_iter().for_each(|job| {
        // Neighbours in time share columns: rows of outputs are the faster index.
        let (top, left) = (job % row_jobs * JOB_ROWS, job / row_jobs * JOB_COLUMNS);
        let rows = JOB_ROWS.min(shape.outputs - top);
        let columns = JOB_COLUMNS.min(layout.positions - left);
        let b = Columns {
            words: &words[left..],
            steps,
            stride: layout.pair,
            block: SIDE,
        };
        let a = &packed[top * steps.len() * DEPTH..];
        blocks((rows, columns), a, b, &mut |(i, j), sums| {
            let end = SIDE.min(columns - j);
            let mut at = 0;
            while at < end {
                let position = left + j + at;
                let (line, x) = (position / layout.width, position % layout.width);
                let (item, y) = (line / layout.height, line % layout.height);
                let run = (layout.width - x).min(end - at);
                if y < out_height && x < out_width {
                    let count = run.min(out_width - x);
                    for (row, sums) in sums.chunks_exact(SIDE).enumerate().take(rows - i) {
                        let output = top + i + row;
                        let start =
                            ((item * shape.outputs + output) * out_height + y) * out_width + x;
                        let bias = bias.map_or(0.0, |bias| bias[output]);
                        // SAFETY: outputs and positions of this job are its own, and lie in `out`.
                        let out = unsafe { target.at(start) };
                        place_row(&sums[at..at + count], bias, out);
                    }
                }
                at += run;
            }
        });
    });
}
