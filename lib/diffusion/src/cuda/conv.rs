//! Convolutions as matrix products over columns [inputs * kernel * kernel, pixels]; the result lies as the next layer reads it.

use candle_core::backend::BackendDevice;
use candle_core::{CudaStorage, Result, Shape};

use super::gemm::{Matrices, products};
use super::pointwise::add_bias;
use super::{Argument, SCRATCH, View, alike, empty, launch, whole};
use crate::kernels::conv::ConvShape;

/// Some images, and some rows of their results, whose columns are at hand at once.
struct Part {
    image: usize,
    images: usize,
    row: usize,
    rows: usize,
}

/// As many images as [`SCRATCH`] holds, or else parts of one.
fn parts(s: &ConvShape, depth: usize, size: usize) -> Vec<Part> {
    let row_bytes = depth * s.out_width() * size;
    let rows = (SCRATCH / row_bytes.max(1)).clamp(1, s.out_height());
    let images = match rows == s.out_height() {
        true => (SCRATCH / (row_bytes * rows).max(1)).clamp(1, s.batch),
        false => 1,
    };
    let starts = (0..s.batch).step_by(images);
    starts
        .flat_map(|image| {
            (0..s.out_height())
                .step_by(rows)
                .map(move |row| (image, row))
        })
        .map(|(image, row)| Part {
            image,
            images: images.min(s.batch - image),
            row,
            rows: rows.min(s.out_height() - row),
        })
        .collect()
}

/// Whether the columns are the input itself.
fn is_pointwise(s: &ConvShape) -> bool {
    (s.kernel, s.stride, s.pad_before, s.pad_after) == (1, 1, 0, 0)
}

/// Pixels of a row that a thread of the kernels for a stride of 1 and a kernel of 3 takes at once.
const PACK: usize = 8;

/// Whether these kernels serve. What they read and write at once lies in arrays of its own, which are aligned.
fn has_packs(s: &ConvShape) -> bool {
    let rows = [s.width, s.out_width()];
    (s.kernel, s.stride) == (3, 1) && rows.iter().all(|n| n.is_multiple_of(PACK))
}

fn window(s: &ConvShape, part: &Part) -> Result<[Argument; 8]> {
    let of = Argument::try_from;
    Ok([
        of(s.height)?,
        of(s.width)?,
        of(s.kernel)?,
        of(s.stride)?,
        of(s.pad_before)?,
        of(s.out_width())?,
        of(part.row)?,
        of(part.rows)?,
    ])
}

/// Threads of a block that works on `n` values.
fn threads(n: usize) -> usize {
    n.next_multiple_of(32).clamp(32, 256)
}

pub(crate) fn conv2d(s: ConvShape, x: View, w: View, b: View) -> Result<CudaStorage> {
    let (dtype, device) = (alike(&[x, w, b])?, x.device);
    let (depth, pixels) = (
        s.inputs * s.kernel * s.kernel,
        s.out_height() * s.out_width(),
    );
    let plane = s.height * s.width;
    let y = empty(device, dtype, s.batch * s.outputs * pixels)?;
    let to = whole(&y, s.batch * s.outputs * pixels)?;
    let product = |images, n, columns: Matrices, to: View| {
        let (weights, to) = (
            Matrices::new(w, depth, 0),
            Matrices::new(to, pixels, s.outputs * pixels),
        );
        products(images, (s.outputs, depth, n), weights, columns, to)
    };
    if is_pointwise(&s) {
        product(
            s.batch,
            pixels,
            Matrices::new(x, pixels, s.inputs * pixels),
            to,
        )?;
    } else {
        for part in parts(&s, depth, dtype.size_in_bytes()) {
            let n = part.rows * s.out_width();
            let columns = empty(device, dtype, part.images * depth * n)?;
            let columns = whole(&columns, part.images * depth * n)?;
            let mut arguments = vec![x.at(part.image * s.inputs * plane).into(), columns.into()];
            arguments.extend(window(&s, &part)?);
            let (name, places, rows) = match has_packs(&s) {
                true => ("im2col_3", n / PACK, s.inputs),
                false => ("im2col", n, depth),
            };
            let threads = threads(places);
            let grid = (places.div_ceil(threads), rows, part.images);
            launch(device, (name, dtype), grid, threads as u32, &arguments)?;
            let to = to.at(part.image * s.outputs * pixels + part.row * s.out_width());
            product(part.images, n, Matrices::new(columns, n, depth * n), to)?;
        }
    }
    add_bias(to, b, (s.batch * s.outputs, pixels), Some(s.outputs))?;
    Ok(y)
}

/// The gradient at x.
pub(crate) fn vjp_input(s: ConvShape, g: View, w: View) -> Result<CudaStorage> {
    let (dtype, device) = (alike(&[g, w])?, g.device);
    let (depth, pixels) = (
        s.inputs * s.kernel * s.kernel,
        s.out_height() * s.out_width(),
    );
    let (plane, elements) = (s.height * s.width, s.batch * s.inputs * s.height * s.width);
    let product = |images, n, g: View, to: Matrices| {
        let weights = Matrices::new(w, depth, 0).transposed();
        products(
            images,
            (depth, s.outputs, n),
            weights,
            Matrices::new(g, pixels, s.outputs * pixels),
            to,
        )
    };
    if is_pointwise(&s) {
        let dx = empty(device, dtype, elements)?;
        product(
            s.batch,
            pixels,
            g,
            Matrices::new(whole(&dx, elements)?, plane, s.inputs * plane),
        )?;
        return Ok(dx);
    }
    let dx = device.zeros_impl(&Shape::from(elements), dtype)?;
    let to = whole(&dx, elements)?;
    for part in parts(&s, depth, dtype.size_in_bytes()) {
        let n = part.rows * s.out_width();
        let columns = empty(device, dtype, part.images * depth * n)?;
        let columns = whole(&columns, part.images * depth * n)?;
        let from = g.at(part.image * s.outputs * pixels + part.row * s.out_width());
        product(part.images, n, from, Matrices::new(columns, n, depth * n))?;
        // The rows of x that these results see.
        let first = (part.row * s.stride).saturating_sub(s.pad_before);
        let end = ((part.row + part.rows - 1) * s.stride + s.kernel).saturating_sub(s.pad_before);
        let count = end.min(s.height).saturating_sub(first);
        let mut arguments = vec![columns.into(), to.at(part.image * s.inputs * plane).into()];
        arguments.extend(window(&s, &part)?);
        arguments.extend([Argument::try_from(first)?, Argument::try_from(count)?]);
        let (name, places) = match has_packs(&s) {
            true => ("col2im_3", count * s.width / PACK),
            false => ("col2im", count * s.width),
        };
        let threads = threads(places);
        let grid = (places.div_ceil(threads), s.inputs, part.images);
        launch(device, (name, dtype), grid, threads as u32, &arguments)?;
    }
    Ok(dx)
}
