//! Convolution without unfolding: the picture is packed once, with its border, in pairs of channels; what a tap of the
//! kernel meets is the same words at another offset.
//!
//! Columns are the positions of the bordered picture, row by row, so that sixteen neighbours are contiguous words for every
//! size; the sums of positions that belong to no output are dropped.

use rayon::prelude::*;

use super::element::Element;
use super::micro::{DEPTH, ROWS, SIDE};
use super::{Columns, JOB_COLUMNS, JOB_ROWS, TILE, blocks, with_halves, with_words};
use crate::kernels::SharedMut;
use crate::kernels::conv::ConvShape;

/// Words of a cache line.
const LINE: usize = 16;

/// The kernel [outputs, inputs, taps] as one convolution reads it: element (output, input, tap) is at
/// `output * by_output + input * by_input + tap`, or at the opposite tap.
struct Kernel<'a, W> {
    data: &'a [W],
    by_output: usize,
    by_input: usize,
    turned: bool,
}

/// The convolution of x [batch, inputs, height, width] with w [outputs, inputs, kernel, kernel].
pub(crate) fn conv2d<X: Element, W: Element>(
    shape: ConvShape,
    x: &[X],
    w: &[W],
    bias: Option<&[f32]>,
) -> Vec<f32> {
    let taps = shape.kernel * shape.kernel;
    let kernel = Kernel {
        data: w,
        by_output: shape.inputs * taps,
        by_input: taps,
        turned: false,
    };
    let mut out = vec![0.0; shape.batch * shape.outputs * shape.out_height() * shape.out_width()];
    run(
        shape,
        1,
        (shape.height, shape.width),
        x,
        kernel,
        bias,
        &mut out,
    );
    out
}

/// Gradient of [`conv2d`] with respect to x for the gradient `g` of its result: the convolution of `g`, its pixels as far
/// apart as the stride, with the kernel turned round and the channels exchanged.
pub(crate) fn conv2d_vjp_input<G: Element, W: Element>(
    shape: ConvShape,
    g: &[G],
    w: &[W],
) -> Vec<f32> {
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
    let mut dx = vec![0.0; shape.batch * shape.inputs * shape.height * shape.width];
    run(
        adjoint,
        shape.stride,
        (height, width),
        g,
        kernel,
        None,
        &mut dx,
    );
    dx
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
fn run<X: Element, W: Element>(
    shape: ConvShape,
    spread: usize,
    size: (usize, usize),
    x: &[X],
    kernel: Kernel<W>,
    bias: Option<&[f32]>,
    out: &mut [f32],
) {
    if out.is_empty() {
        return;
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
            multiply(shape, &layout, &steps, packed, words, bias, out);
        });
    });
}

/// Packs two channels of all pictures.
fn pack_pair<X: Element>(
    shape: ConvShape,
    layout: &Layout,
    spread: usize,
    (height, width): (usize, usize),
    x: &[X],
    pair: usize,
    words: &mut [u32],
) {
    words.fill(0);
    let (s, plane) = (shape.stride, height * width);
    let mut rows = [vec![0u16; width], vec![0u16; width]];
    // The pixel that meets column `column` of a phase, if there is one.
    let pixel = |at: usize, phase: usize, size: usize| {
        let at = (at * s + phase).wrapping_sub(shape.pad_before);
        (at % spread == 0 && at / spread < size).then_some(at / spread)
    };
    for phase in 0..layout.phases_per_side * layout.phases_per_side {
        let (py, px) = (
            phase / layout.phases_per_side,
            phase % layout.phases_per_side,
        );
        for item in 0..shape.batch {
            for line in 0..layout.height {
                let Some(y) = pixel(line, py, height) else {
                    continue;
                };
                for (side, row) in rows.iter_mut().enumerate() {
                    let channel = 2 * pair + side;
                    if channel < shape.inputs {
                        let start = (item * shape.inputs + channel) * plane + y * width;
                        X::round_to(&x[start..start + width], row);
                    } else {
                        row.fill(0);
                    }
                }
                let start = phase * layout.phase + (item * layout.height + line) * layout.width;
                let target = &mut words[start..start + layout.width];
                if s == 1 && spread == 1 {
                    // Pixel 0 is at column `pad_before`.
                    let first = shape.pad_before.min(layout.width);
                    for (word, (&low, &high)) in
                        target[first..].iter_mut().zip(rows[0].iter().zip(&rows[1]))
                    {
                        *word = low as u32 | (high as u32) << 16;
                    }
                    continue;
                }
                for (column, word) in target.iter_mut().enumerate() {
                    if let Some(x) = pixel(column, px, width) {
                        *word = rows[0][x] as u32 | (rows[1][x] as u32) << 16;
                    }
                }
            }
        }
    }
}

/// Packs the kernels of 16 outputs from `first`: groups of 32 inputs, and all taps of each.
fn pack_kernel<W: Element>(shape: ConvShape, kernel: &Kernel<W>, first: usize, target: &mut [u16]) {
    let taps = shape.kernel * shape.kernel;
    if first + ROWS > shape.outputs || shape.inputs % DEPTH != 0 {
        target.fill(0);
    }
    for (group, target) in target.chunks_exact_mut(taps * TILE).enumerate() {
        let inputs = DEPTH.min(shape.inputs - group * DEPTH);
        for i in 0..ROWS.min(shape.outputs.saturating_sub(first)) {
            let start = (first + i) * kernel.by_output + group * DEPTH * kernel.by_input;
            for input in 0..inputs {
                let source = &kernel.data[start + input * kernel.by_input..][..taps];
                let target = &mut target[i * DEPTH + input..];
                for (tap, value) in source.iter().enumerate() {
                    let tap = if kernel.turned { taps - 1 - tap } else { tap };
                    target[tap * TILE] = value.bits();
                }
            }
        }
    }
}

/// The product, and its sums where they belong.
fn multiply(
    shape: ConvShape,
    layout: &Layout,
    steps: &[usize],
    packed: &[u16],
    words: &[u32],
    bias: Option<&[f32]>,
    out: &mut [f32],
) {
    let (out_height, out_width) = (shape.out_height(), shape.out_width());
    let target = SharedMut::new(out);
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
        blocks((rows, columns), a, b, |(i, j), sums| {
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
                        let out =
                            unsafe { std::slice::from_raw_parts_mut(target.at(start), count) };
                        for (out, &sum) in out.iter_mut().zip(&sums[at..]) {
                            *out = sum + bias;
                        }
                    }
                }
                at += run;
            }
        });
    });
}
