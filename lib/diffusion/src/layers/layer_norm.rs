//! Layer normalisation.

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, DType, Layout, Shape, Tensor};

use super::backend::has_kernels_anywhere;
use crate::backward::apply3;
#[cfg(feature = "cuda")]
use crate::cuda::{self, View, norm::NormShape};
use crate::error::Result;
use crate::kernels::norm;
use crate::kernels::tensor::{floats, from_floats, read, store};
use crate::parameters::{Init, Parameters};

/// Normalises the last dimension to mean 0 and variance 1 [Ba et al. 2016].
#[derive(Debug, Clone)]
pub struct LayerNorm {
    gamma: Tensor,
    beta: Tensor,
    eps: f64,
}

impl LayerNorm {
    /// Scale and shift [size] below `parameters`.
    pub fn new(parameters: &Parameters, size: usize, eps: f64) -> Result<Self> {
        let gamma = parameters.get("weight", &[size], Init::Constant(1.0))?;
        let beta = parameters.get("bias", &[size], Init::Constant(0.0))?;
        Ok(Self { gamma, beta, eps })
    }

    /// Applies the layer to x [..., size].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        if has_kernels_anywhere(&x, &[&self.gamma, &self.beta]) {
            return Ok(apply3(
                &x,
                &self.gamma,
                &self.beta,
                LayerNormOp {
                    eps: self.eps as f32,
                },
            )?);
        }
        self.forward_composed(&x)
    }

    /// [`LayerNorm::forward`] composed of candle's operations, for devices without kernels.
    pub(super) fn forward_composed(&self, x: &Tensor) -> Result<Tensor> {
        let last = x.rank() - 1;
        let values = x.to_dtype(DType::F32)?;
        let centred = values.broadcast_sub(&values.mean_keepdim(last)?)?;
        let variance = centred.sqr()?.mean_keepdim(last)?;
        let normalised = centred.broadcast_div(&(variance + self.eps)?.sqrt()?)?;
        let y = normalised
            .broadcast_mul(&self.gamma.to_dtype(DType::F32)?)?
            .broadcast_add(&self.beta.to_dtype(DType::F32)?)?;
        Ok(y.to_dtype(x.dtype())?)
    }
}

fn check(x: &Shape, gamma: &Shape) -> candle_core::Result<()> {
    if x.dims().last() != Some(&gamma.elem_count()) {
        candle_core::bail!("layer norm of {gamma:?} got {x:?}");
    }
    Ok(())
}

struct LayerNormOp {
    eps: f32,
}

#[cfg(feature = "cuda")]
impl LayerNormOp {
    fn rows(&self, x: &Shape) -> NormShape {
        let n = x.dims().last().copied().unwrap_or(1);
        NormShape {
            rows: x.elem_count() / n.max(1),
            n,
            groups: 1,
            pixels: 1,
            eps: self.eps,
            silu: false,
        }
    }
}

impl CustomOp3 for LayerNormOp {
    fn name(&self) -> &'static str {
        "layer norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        gamma: &CpuStorage,
        lg: &Layout,
        beta: &CpuStorage,
        lb: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        check(lx.shape(), lg.shape())?;
        let y = norm::layer_norm(
            &floats(x, lx)?,
            &floats(gamma, lg)?,
            &floats(beta, lb)?,
            self.eps,
        );
        Ok((store(y, x.dtype()), lx.shape().clone()))
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        x: &CudaStorage,
        lx: &Layout,
        gamma: &CudaStorage,
        lg: &Layout,
        beta: &CudaStorage,
        lb: &Layout,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        check(lx.shape(), lg.shape())?;
        let (gamma, beta) = (View::new(gamma, lg)?, View::new(beta, lb)?);
        let y = cuda::norm::norm(self.rows(lx.shape()), View::new(x, lx)?, gamma, beta)?;
        Ok((y, lx.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        gamma: &Tensor,
        beta: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let g = g.contiguous()?;
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            let (gamma, beta) = (View::of(gamma)?, View::of(beta)?);
            let rows = self.rows(x.shape());
            let dx = cuda::norm::vjp_input(rows, View::of(x)?, gamma, beta, View::of(&g)?)?;
            return Ok((Some(cuda::tensor(dx, x.shape())), None, None));
        }
        let (dx, dgamma, dbeta) =
            norm::layer_norm_vjp(&read(x)?, &read(gamma)?, &read(&g)?, self.eps);
        let wanted = |like: &Tensor, values: Vec<f32>| {
            like.track_op()
                .then(|| from_floats(values, like.shape(), like.dtype()))
                .transpose()
        };
        Ok((wanted(x, dx)?, wanted(gamma, dgamma)?, wanted(beta, dbeta)?))
    }
}
