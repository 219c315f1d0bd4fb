//! Fully connected layers: y [rows, outputs] = x [rows, inputs] W^T + b.

use candle_core::{CudaStorage, Result};

use super::gemm::{Matrices, products};
use super::pointwise::add_bias;
use super::{View, alike, empty, whole};
use crate::kernels::matmul::LinearShape;

pub(crate) fn linear(s: LinearShape, x: View, w: View, b: Option<View>) -> Result<CudaStorage> {
    let dtype = alike(&[x, w])?;
    let y = empty(x.device, dtype, s.rows * s.outputs)?;
    let to = whole(&y, s.rows * s.outputs)?;
    products(
        1,
        (s.rows, s.inputs, s.outputs),
        Matrices::new(x, s.inputs, 0),
        Matrices::new(w, s.inputs, 0).transposed(),
        Matrices::new(to, s.outputs, 0),
    )?;
    if let Some(b) = b {
        add_bias(to, b, (s.rows, s.outputs), None)?;
    }
    Ok(y)
}

/// The gradient at x.
pub(crate) fn vjp_input(s: LinearShape, g: View, w: View) -> Result<CudaStorage> {
    let dx = empty(g.device, alike(&[g, w])?, s.rows * s.inputs)?;
    products(
        1,
        (s.rows, s.outputs, s.inputs),
        Matrices::new(g, s.outputs, 0),
        Matrices::new(w, s.inputs, 0),
        Matrices::new(whole(&dx, s.rows * s.inputs)?, s.inputs, 0),
    )?;
    Ok(dx)
}

/// The gradient at W.
pub(crate) fn vjp_weight(s: LinearShape, g: View, x: View) -> Result<CudaStorage> {
    let dw = empty(g.device, alike(&[g, x])?, s.outputs * s.inputs)?;
    products(
        1,
        (s.outputs, s.rows, s.inputs),
        Matrices::new(g, s.outputs, 0).transposed(),
        Matrices::new(x, s.inputs, 0),
        Matrices::new(whole(&dw, s.outputs * s.inputs)?, s.inputs, 0),
    )?;
    Ok(dw)
}
