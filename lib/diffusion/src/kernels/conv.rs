//! 2-D convolution over blocks of unfolded pixels and a matrix product, and
//! its adjoints.

use candle_core::Shape;
use rayon::prelude::*;

use super::matmul::{Matrix, Threads, product, product_at};
use super::winograd;
use super::{SharedMut, with_scratch};

/// Shape of a convolution of x [batch, inputs, height, width] with w
/// [outputs, inputs, kernel, kernel].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ConvShape {
    pub batch: usize,
    pub inputs: usize,
    pub height: usize,
    pub width: usize,
    pub outputs: usize,
    pub kernel: usize,
    pub stride: usize,
    /// Zeros before the first row and column.
    pub pad_before: usize,
    /// Zeros after the last row and column.
    pub pad_after: usize,
}

/// Floats of one block of unfolded pixels: 1 MiB, half of a usual L2.
const BLOCK: usize = 256 * 1024;
/// Floats that one thread fills at a time.
const FILL: usize = 64 * 1024;
/// Pixels of a block at least, if there are as many: every block reads all the
/// weights, which for hundreds of channels do not fit a cache.
const BLOCK_PIXELS: usize = 256;

impl ConvShape {
    /// Of the result.
    pub(crate) fn result(&self) -> Shape {
        let (height, width) = (self.out_height(), self.out_width());
        Shape::from((self.batch, self.outputs, height, width))
    }

    pub(crate) fn out_height(&self) -> usize {
        (self.height + self.pad_before + self.pad_after - self.kernel) / self.stride + 1
    }

    pub(crate) fn out_width(&self) -> usize {
        (self.width + self.pad_before + self.pad_after - self.kernel) / self.stride + 1
    }

    fn out_pixels(&self) -> usize {
        self.out_height() * self.out_width()
    }

    /// Terms of the sum of one output.
    fn depth(&self) -> usize {
        self.inputs * self.kernel * self.kernel
    }

    fn is_pointwise(&self) -> bool {
        self.kernel == 1 && self.stride == 1 && self.pad_before == 0 && self.pad_after == 0
    }

    /// Output rows of one block, from the shape alone.
    fn block_rows(&self) -> usize {
        let width = self.out_width().max(1);
        (BLOCK / (self.depth() * width).max(1))
            .max(BLOCK_PIXELS / width)
            .clamp(1, self.out_height())
    }

    fn blocks(&self) -> usize {
        self.out_height().div_ceil(self.block_rows())
    }
}

/// Unfolds the inputs of output rows `first..first + rows` of one image into
/// [depth, rows * out_width].
fn unfold(shape: ConvShape, image: &[f32], first: usize, rows: usize, columns: &mut [f32]) {
    let kernel = shape.kernel;
    for (row, target) in columns
        .chunks_exact_mut(rows * shape.out_width())
        .enumerate()
        .take(shape.depth())
    {
        let (channel, tap) = (
            row / (kernel * kernel),
            (row / kernel % kernel, row % kernel),
        );
        let plane = &image[channel * shape.height * shape.width..][..shape.height * shape.width];
        unfold_tap(shape, plane, first, tap, target);
    }
}

/// What tap (row, column) of the kernel meets in one channel, for output rows from `first`.
fn unfold_tap(
    shape: ConvShape,
    plane: &[f32],
    first: usize,
    (ky, kx): (usize, usize),
    target: &mut [f32],
) {
    let out_width = shape.out_width();
    for (i, target) in target.chunks_exact_mut(out_width).enumerate() {
        let y = ((first + i) * shape.stride + ky).wrapping_sub(shape.pad_before);
        if y >= shape.height {
            target.fill(0.0);
            continue;
        }
        let source = &plane[y * shape.width..][..shape.width];
        if shape.stride == 1 {
            // x = column + kx - pad_before must lie in 0..width.
            let start = shape.pad_before.saturating_sub(kx).min(out_width);
            let end = (shape.width + shape.pad_before)
                .saturating_sub(kx)
                .clamp(start, out_width);
            target[..start].fill(0.0);
            target[end..].fill(0.0);
            if end > start {
                target[start..end]
                    .copy_from_slice(&source[start + kx - shape.pad_before..][..end - start]);
            }
        } else {
            for (j, value) in target.iter_mut().enumerate() {
                let x = (j * shape.stride + kx).wrapping_sub(shape.pad_before);
                *value = if x < shape.width { source[x] } else { 0.0 };
            }
        }
    }
}

/// The convolution, [batch, outputs, out_height, out_width].
pub(crate) fn conv2d(shape: ConvShape, x: &[f32], w: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
    if winograd::suits(shape) {
        let mut out = vec![0.0; shape.batch * shape.outputs * shape.out_pixels()];
        winograd::conv2d(shape, x, w, winograd::Weights::AsStored, bias, &mut out);
        return out;
    }
    conv2d_unfolded(shape, x, w, bias)
}

/// [`conv2d`] of unfolded pixels.
pub(super) fn conv2d_unfolded(
    shape: ConvShape,
    x: &[f32],
    w: &[f32],
    bias: Option<&[f32]>,
) -> Vec<f32> {
    let pixels = shape.out_pixels();
    let mut out = vec![0.0; shape.batch * shape.outputs * pixels];
    if let Some(bias) = bias {
        out.par_chunks_exact_mut(pixels)
            .with_min_len(FILL.div_ceil(pixels))
            .enumerate()
            .for_each(|(row, out)| out.fill(bias[row % shape.outputs]));
    }
    let keep = if bias.is_some() { 1.0 } else { 0.0 };
    let depth = shape.depth();
    let weights = Matrix::rows(w, depth);
    let image_len = shape.inputs * shape.height * shape.width;
    if shape.is_pointwise() {
        for (x, out) in x
            .chunks_exact(image_len)
            .zip(out.chunks_exact_mut(shape.outputs * pixels))
        {
            product(
                (shape.outputs, pixels, depth),
                out,
                keep,
                weights,
                Matrix::rows(x, pixels),
                Threads::All,
            );
        }
        return out;
    }
    let (blocks, block_rows, out_width) = (shape.blocks(), shape.block_rows(), shape.out_width());
    let jobs = shape.batch * blocks;
    let threads = if jobs == 1 {
        Threads::All
    } else {
        Threads::One
    };
    let target = SharedMut::new(&mut out);
    let run = |job: usize, columns: &mut [f32]| {
        let (item, first) = (job / blocks, job % blocks * block_rows);
        let rows = block_rows.min(shape.out_height() - first);
        let columns = &mut columns[..depth * rows * out_width];
        let image = &x[item * image_len..][..image_len];
        match threads {
            Threads::One => unfold(shape, image, first, rows, columns),
            Threads::All => unfold_parallel(shape, image, first, rows, columns),
        }
        let offset = item * shape.outputs * pixels + first * out_width;
        // SAFETY: each job writes its own pixels of its own image.
        unsafe {
            let size = (shape.outputs, rows * out_width, depth);
            let columns = Matrix::rows(columns, rows * out_width);
            product_at(
                size,
                target.at(offset),
                pixels,
                keep,
                1.0,
                weights,
                columns,
                threads,
            );
        }
    };
    let run = |job: usize| {
        let len = depth * block_rows * out_width;
        with_scratch(len, |columns| run(job, columns));
    };
    if jobs == 1 {
        run(0);
    } else {
        (0..jobs).into_par_iter().for_each(run);
    }
    out
}

/// Gradient of [`conv2d`] with respect to x for the gradient `g` of its
/// result.
pub(crate) fn conv2d_vjp_input(shape: ConvShape, g: &[f32], w: &[f32]) -> Vec<f32> {
    let pixels = shape.out_pixels();
    let image_len = shape.inputs * shape.height * shape.width;
    if shape.is_pointwise() {
        let mut dx = vec![0.0; shape.batch * image_len];
        let weights = Matrix::rows(w, shape.inputs).transposed();
        for (g, dx) in g
            .chunks_exact(shape.outputs * pixels)
            .zip(dx.chunks_exact_mut(image_len))
        {
            product(
                (shape.inputs, pixels, shape.outputs),
                dx,
                0.0,
                weights,
                Matrix::rows(g, pixels),
                Threads::All,
            );
        }
        return dx;
    }
    let fits = shape.pad_before < shape.kernel && shape.pad_after < shape.kernel;
    if shape.stride == 1 && fits {
        // The adjoint of a convolution is one with the kernel turned round
        // and the channels exchanged.
        let adjoint = ConvShape {
            inputs: shape.outputs,
            outputs: shape.inputs,
            height: shape.out_height(),
            width: shape.out_width(),
            pad_before: shape.kernel - 1 - shape.pad_before,
            pad_after: shape.kernel - 1 - shape.pad_after,
            ..shape
        };
        if winograd::suits(adjoint) {
            let mut dx = vec![0.0; shape.batch * image_len];
            winograd::conv2d(adjoint, g, w, winograd::Weights::Adjoint, None, &mut dx);
            return dx;
        }
        // Turning the weights costs as much as there are outputs, folding as much as there are pixels.
        if pixels >= shape.outputs {
            return conv2d(adjoint, g, &turned(shape, w), None);
        }
    }
    fold_product(shape, g, w)
}

/// Weights [inputs, outputs, kernel, kernel] of the adjoint convolution.
fn turned(shape: ConvShape, w: &[f32]) -> Vec<f32> {
    let taps = shape.kernel * shape.kernel;
    let mut turned = vec![0.0; w.len()];
    turned
        .par_chunks_mut(shape.outputs * taps)
        .enumerate()
        .for_each(|(input, target)| {
            for (output, target) in target.chunks_exact_mut(taps).enumerate() {
                let source = &w[(output * shape.inputs + input) * taps..][..taps];
                target
                    .iter_mut()
                    .zip(source.iter().rev())
                    .for_each(|(t, &s)| *t = s);
            }
        });
    turned
}

/// Strided convolutions and those of few pixels: unfolded gradients, summed back into the image.
pub(super) fn fold_product(shape: ConvShape, g: &[f32], w: &[f32]) -> Vec<f32> {
    let (pixels, taps, out_width) = (
        shape.out_pixels(),
        shape.kernel * shape.kernel,
        shape.out_width(),
    );
    let plane = shape.height * shape.width;
    let channels = (BLOCK / (taps * pixels).max(1)).clamp(1, shape.inputs);
    let blocks = shape.inputs.div_ceil(channels);
    let mut dx = vec![0.0; shape.batch * shape.inputs * plane];
    let target = SharedMut::new(&mut dx);
    (0..shape.batch * blocks).into_par_iter().for_each_init(
        || vec![0f32; channels * taps * pixels],
        |columns, job| {
            let (item, first) = (job / blocks, job % blocks * channels);
            let count = channels.min(shape.inputs - first);
            let columns = &mut columns[..count * taps * pixels];
            let weights = Matrix {
                data: &w[first * taps..],
                row: 1,
                column: shape.inputs * taps,
            };
            let g = Matrix::rows(&g[item * shape.outputs * pixels..], pixels);
            product(
                (count * taps, pixels, shape.outputs),
                columns,
                0.0,
                weights,
                g,
                Threads::One,
            );
            // SAFETY: each job owns the planes of its channels.
            let dx = unsafe {
                std::slice::from_raw_parts_mut(
                    target.at((item * shape.inputs + first) * plane),
                    count * plane,
                )
            };
            for (row, column) in columns.chunks_exact(pixels).enumerate() {
                let (ky, kx) = (row / shape.kernel % shape.kernel, row % shape.kernel);
                let dx = &mut dx[row / taps * plane..][..plane];
                for (i, column) in column.chunks_exact(out_width).enumerate() {
                    let y = (i * shape.stride + ky).wrapping_sub(shape.pad_before);
                    if y < shape.height {
                        let dx = &mut dx[y * shape.width..][..shape.width];
                        fold_row(column, dx, shape.stride, kx, shape.pad_before);
                    }
                }
            }
        },
    );
    dx
}

/// Adds what tap `kx` of each output of a row meets to the input's row.
fn fold_row(column: &[f32], dx: &mut [f32], stride: usize, kx: usize, pad: usize) {
    // The first output whose input lies inside.
    let skipped = pad.saturating_sub(kx).div_ceil(stride);
    let start = (skipped * stride + kx).saturating_sub(pad);
    let column = column.get(skipped..).unwrap_or_default();
    let dx = dx.get_mut(start..).unwrap_or_default();
    match stride {
        1 => dx.iter_mut().zip(column).for_each(|(d, c)| *d += c),
        _ => (dx.iter_mut().step_by(stride).zip(column)).for_each(|(d, c)| *d += c),
    }
}

/// Gradient of [`conv2d`] with respect to w.
///
/// Images of few pixels are worked on together, so that the sums over pixels are long, and the result is
/// made transposed, [depth, outputs]: the unfolded pixels are then read as they lie, and only the smaller `g` is
/// turned.
pub(crate) fn conv2d_vjp_weight(shape: ConvShape, g: &[f32], x: &[f32]) -> Vec<f32> {
    if winograd::suits(shape) {
        return winograd::gradient_of_weights(shape, g, x);
    }
    let (pixels, depth, outputs) = (shape.out_pixels(), shape.depth(), shape.outputs);
    let image_len = shape.inputs * shape.height * shape.width;
    let (block_rows, out_width) = (shape.block_rows(), shape.out_width());
    // A group is one block of one image, or several whole images.
    let together = (BLOCK_PIXELS / pixels.max(1)).clamp(1, shape.batch.max(1));
    let width = block_rows * out_width * together;
    let mut columns = vec![0f32; depth * width];
    let mut gathered = vec![0f32; outputs * width];
    let mut turned = vec![0.0; depth * outputs];
    let mut keep = 0.0;
    for item in (0..shape.batch).step_by(together) {
        let images = together.min(shape.batch - item);
        for first in (0..shape.out_height()).step_by(block_rows) {
            let rows = block_rows.min(shape.out_height() - first);
            let (each, count) = (rows * out_width, rows * out_width * images);
            let columns = &mut columns[..depth * count];
            unfold_images(shape, &x[item * image_len..], first, rows, images, columns);
            let offset = item * outputs * pixels + first * out_width;
            let g = if images == 1 {
                Matrix::rows(&g[offset..], pixels)
            } else {
                let gathered = &mut gathered[..outputs * count];
                for (output, target) in gathered.chunks_exact_mut(count).enumerate() {
                    for (image, target) in target.chunks_exact_mut(each).enumerate() {
                        let start = offset + (image * outputs + output) * pixels;
                        target.copy_from_slice(&g[start..start + each]);
                    }
                }
                Matrix::rows(gathered, count)
            };
            product(
                (depth, outputs, count),
                &mut turned,
                keep,
                Matrix::rows(columns, count),
                g.transposed(),
                Threads::All,
            );
            keep = 1.0;
        }
    }
    let mut dw = vec![0.0; outputs * depth];
    for (output, dw) in dw.chunks_exact_mut(depth.max(1)).enumerate() {
        let column = turned.iter().skip(output).step_by(outputs);
        dw.iter_mut().zip(column).for_each(|(d, &t)| *d = t);
    }
    dw
}

/// Unfolds output rows `first..first + rows` of `images` images into [depth, images * rows * out_width], with the
/// channels shared among threads.
fn unfold_images(
    shape: ConvShape,
    x: &[f32],
    first: usize,
    rows: usize,
    images: usize,
    columns: &mut [f32],
) {
    let plane = shape.height * shape.width;
    let taps = shape.kernel * shape.kernel;
    let each = rows * shape.out_width();
    columns
        .par_chunks_mut(taps * images * each)
        .with_min_len(8)
        .enumerate()
        .for_each(|(channel, columns)| {
            for (tap, target) in columns.chunks_exact_mut(images * each).enumerate() {
                let tap = (tap / shape.kernel, tap % shape.kernel);
                for (image, target) in target.chunks_exact_mut(each).enumerate() {
                    let start = (image * shape.inputs + channel) * plane;
                    unfold_tap(shape, &x[start..start + plane], first, tap, target);
                }
            }
        });
}

/// [`unfold`] with the channels shared among threads.
fn unfold_parallel(
    shape: ConvShape,
    image: &[f32],
    first: usize,
    rows: usize,
    columns: &mut [f32],
) {
    let taps = shape.kernel * shape.kernel;
    let plane = shape.height * shape.width;
    let one = ConvShape { inputs: 1, ..shape };
    columns
        .par_chunks_mut(taps * rows * shape.out_width())
        .zip(image.par_chunks(plane))
        .with_min_len(8)
        .for_each(|(columns, image)| unfold(one, image, first, rows, columns));
}

/// Sum over batch and pixels: the gradient of the bias.
pub(crate) fn conv2d_vjp_bias(shape: ConvShape, g: &[f32]) -> Vec<f32> {
    let mut sums = vec![0f64; shape.outputs];
    for (row, g) in g.chunks_exact(shape.out_pixels()).enumerate() {
        sums[row % shape.outputs] += super::simd::sum_of(g, |v| v);
    }
    sums.into_iter().map(|v| v as f32).collect()
}
