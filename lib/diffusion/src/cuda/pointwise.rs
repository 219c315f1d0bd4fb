//! What works on values one by one.

use candle_core::{CudaStorage, Result};

use super::{View, alike, empty, launch, whole};

/// Threads of a block.
const THREADS: usize = 256;

fn grid((rows, n): (usize, usize)) -> (usize, usize, usize) {
    (rows, n.div_ceil(THREADS), 1)
}

/// Adds to y [rows, n] a value for each row, in turn over `channels` of them, or one for each place in a row.
pub(super) fn add_bias(
    y: View,
    b: View,
    size: (usize, usize),
    channels: Option<usize>,
) -> Result<()> {
    let dtype = alike(&[y, b])?;
    let arguments = [
        y.into(),
        b.into(),
        size.1.try_into()?,
        channels.unwrap_or(0).try_into()?,
    ];
    let (rows, n) = size;
    let (name, places) = match n.is_multiple_of(8) && y.is_aligned() {
        true => ("add_bias_8", n / 8),
        false => ("add_bias_1", n),
    };
    let threads = places.next_multiple_of(32).clamp(32, THREADS);
    let grid = (rows, places.div_ceil(threads), 1);
    launch(y.device, (name, dtype), grid, threads as u32, &arguments)
}

/// value * gelu(gate) of x = rows of (value, gate), `n` each.
pub(crate) fn geglu((rows, n): (usize, usize), x: View) -> Result<CudaStorage> {
    let y = empty(x.device, x.dtype, rows * n)?;
    let arguments = [x.into(), whole(&y, rows * n)?.into(), n.try_into()?];
    launch(
        x.device,
        ("geglu", x.dtype),
        grid((rows, n)),
        THREADS as u32,
        &arguments,
    )?;
    Ok(y)
}

/// The gradient at x.
pub(crate) fn geglu_vjp((rows, n): (usize, usize), x: View, g: View) -> Result<CudaStorage> {
    let dx = empty(x.device, alike(&[x, g])?, 2 * rows * n)?;
    let arguments = [
        x.into(),
        g.into(),
        whole(&dx, 2 * rows * n)?.into(),
        n.try_into()?,
    ];
    launch(
        x.device,
        ("geglu_vjp", x.dtype),
        grid((rows, n)),
        THREADS as u32,
        &arguments,
    )?;
    Ok(dx)
}
