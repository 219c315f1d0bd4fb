//! Activation functions.

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, D, Layout, Shape, Tensor};

use super::backend::{has_kernels, has_kernels_anywhere};
use crate::backward::apply1;
#[cfg(feature = "cuda")]
use crate::cuda::{self, View};
use crate::error::{Result, argument};
use crate::kernels::pointwise;
use crate::kernels::tensor::{floats, from_floats, read, store};

/// Activation functions that model configurations name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// x / (1 + e^-x), "silu" or "swish".
    Silu,
    /// x Phi(x) with the exact normal distribution, "gelu".
    Gelu,
    /// x / (1 + e^(-1.702 x)), "quick_gelu".
    QuickGelu,
}

impl Activation {
    /// The function that a configuration calls `name`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "silu" | "swish" => Some(Self::Silu),
            "gelu" => Some(Self::Gelu),
            "quick_gelu" => Some(Self::QuickGelu),
            _ => None,
        }
    }

    fn kernel(self) -> pointwise::Activation {
        match self {
            Self::Silu => pointwise::Activation::Silu,
            Self::Gelu => pointwise::Activation::Gelu,
            Self::QuickGelu => pointwise::Activation::QuickGelu,
        }
    }
}

/// f(x), elementwise.
pub fn activate(f: Activation, x: &Tensor) -> Result<Tensor> {
    let x = x.contiguous()?;
    if has_kernels(&x) {
        return Ok(apply1(&x, ActivationOp(f))?);
    }
    activate_composed(f, &x)
}

/// [`activate`] composed of candle's operations, for devices without kernels.
pub(super) fn activate_composed(f: Activation, x: &Tensor) -> Result<Tensor> {
    Ok(match f {
        Activation::Silu => x.silu()?,
        Activation::Gelu => x.gelu_erf()?,
        // x sigmoid(a x) = silu(a x) / a
        Activation::QuickGelu => ((x * 1.702)?.silu()? / 1.702)?,
    })
}

/// The gated unit of the transformer blocks: x = (value, gate) in the last
/// dimension to value * gelu(gate) [Shazeer 2020].
pub fn geglu(x: &Tensor) -> Result<Tensor> {
    let x = x.contiguous()?;
    let width = x.dim(D::Minus1)?;
    if width % 2 != 0 {
        return argument(format!(
            "geglu needs an even last dimension, got {:?}",
            x.dims()
        ));
    }
    if has_kernels_anywhere(&x, &[]) {
        return Ok(apply1(&x, GegluOp)?);
    }
    geglu_composed(&x)
}

/// [`geglu`] composed of candle's operations, for devices without kernels.
pub(super) fn geglu_composed(x: &Tensor) -> Result<Tensor> {
    let halves = x.chunk(2, D::Minus1)?;
    Ok((&halves[0] * halves[1].gelu_erf()?)?)
}

struct ActivationOp(Activation);

impl CustomOp1 for ActivationOp {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let y = pointwise::eval(self.0.kernel(), &floats(x, lx)?);
        Ok((store(y, x.dtype()), lx.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let g = g.contiguous()?;
        let dx = pointwise::eval_vjp(self.0.kernel(), &read(x)?, &read(&g)?);
        Ok(Some(from_floats(dx, x.shape(), x.dtype())?))
    }
}

struct GegluOp;

impl GegluOp {
    /// Values of a row of the result, and its shape.
    fn half(x: &Layout) -> (usize, Shape) {
        let mut shape = x.dims().to_vec();
        let width = shape.pop().unwrap_or(0) / 2;
        shape.push(width);
        (width, Shape::from(shape))
    }
}

impl CustomOp1 for GegluOp {
    fn name(&self) -> &'static str {
        "geglu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (width, shape) = Self::half(lx);
        let y = pointwise::geglu(&floats(x, lx)?, width);
        Ok((store(y, x.dtype()), shape))
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(&self, x: &CudaStorage, lx: &Layout) -> candle_core::Result<(CudaStorage, Shape)> {
        let (width, shape) = Self::half(lx);
        let rows = shape.elem_count() / width.max(1);
        let y = cuda::pointwise::geglu((rows, width), View::new(x, lx)?)?;
        Ok((y, shape))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, g: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let g = g.contiguous()?;
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            let width = g.dim(D::Minus1)?;
            let size = (g.elem_count() / width.max(1), width);
            let dx = cuda::pointwise::geglu_vjp(size, View::of(x)?, View::of(&g)?)?;
            return Ok(Some(cuda::tensor(dx, x.shape())));
        }
        let dx = pointwise::geglu_vjp(&read(x)?, g.dim(D::Minus1)?, &read(&g)?);
        Ok(Some(from_floats(dx, x.shape(), x.dtype())?))
    }
}
