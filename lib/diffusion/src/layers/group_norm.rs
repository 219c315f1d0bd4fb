//! Group normalisation, optionally followed by SiLU.

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, DType, Layout, Shape, Tensor};

use super::backend::has_kernels_anywhere;
use crate::backward::apply3;
#[cfg(feature = "cuda")]
use crate::cuda::{self, View, norm::NormShape};
use crate::error::{Result, argument};
use crate::kernels::norm::{self, GroupShape};
use crate::kernels::tensor::{floats, from_floats, read, store};
use crate::parameters::{Init, Parameters};
use crate::recompute::gradient_through;

/// What follows the normalisation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NormActivation {
    /// Nothing.
    None,
    /// x / (1 + e^-x)
    Silu,
}

/// Normalises groups of channels of [batch, channels, ...] to mean 0 and
/// variance 1 [Wu & He 2018]; statistics in f32 or better for every storage.
#[derive(Debug, Clone)]
pub struct GroupNorm {
    gamma: Tensor,
    beta: Tensor,
    groups: usize,
    eps: f64,
    activation: NormActivation,
}

impl GroupNorm {
    /// Scale and shift [channels] below `parameters`.
    pub fn new(
        parameters: &Parameters,
        groups: usize,
        channels: usize,
        eps: f64,
        activation: NormActivation,
    ) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            return argument(format!(
                "group norm {:?}: {channels} channels do not divide into {groups} groups",
                parameters.path()
            ));
        }
        let gamma = parameters.get("weight", &[channels], Init::Constant(1.0))?;
        let beta = parameters.get("bias", &[channels], Init::Constant(0.0))?;
        Ok(Self {
            gamma,
            beta,
            groups,
            eps,
            activation,
        })
    }

    /// Applies the layer.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        if has_kernels_anywhere(&x, &[&self.gamma, &self.beta]) {
            return Ok(apply3(&x, &self.gamma, &self.beta, self.op())?);
        }
        self.forward_composed(&x)
    }

    /// The gradient at `x`, where that at the value is `g`.
    pub(crate) fn input_gradient(&self, x: &Tensor, g: &Tensor) -> Result<Tensor> {
        if !has_kernels_anywhere(x, &[&self.gamma, &self.beta]) {
            return gradient_through(|x| self.forward(x), x.clone(), g);
        }
        let (x, g) = (x.contiguous()?, g.contiguous()?);
        let shape = self.op().shape(x.shape(), self.gamma.shape())?;
        #[cfg(feature = "cuda")]
        if x.device().is_cuda() {
            return Ok(on_gpu_vjp(shape, &x, &self.gamma, &self.beta, &g)?);
        }
        let (gamma, beta) = (read(&self.gamma)?, read(&self.beta)?);
        let (dx, _, _) = norm::group_norm_vjp(shape, &read(&x)?, &gamma, &beta, &read(&g)?);
        Ok(from_floats(dx, x.shape(), x.dtype())?)
    }

    fn op(&self) -> GroupNormOp {
        GroupNormOp {
            groups: self.groups,
            eps: self.eps as f32,
            silu: self.activation == NormActivation::Silu,
        }
    }

    /// [`GroupNorm::forward`] composed of candle's operations, for devices without kernels.
    pub(super) fn forward_composed(&self, x: &Tensor) -> Result<Tensor> {
        let (batch, channels) = (x.dims()[0], x.dims()[1]);
        let grouped = x.to_dtype(DType::F32)?.reshape((batch, self.groups, ()))?;
        let centred = grouped.broadcast_sub(&grouped.mean_keepdim(2)?)?;
        let variance = centred.sqr()?.mean_keepdim(2)?;
        let normalised = centred
            .broadcast_div(&(variance + self.eps)?.sqrt()?)?
            .reshape(x.shape())?;
        let mut shape = vec![1; x.rank()];
        shape[1] = channels;
        let gamma = self.gamma.to_dtype(DType::F32)?.reshape(shape.as_slice())?;
        let beta = self.beta.to_dtype(DType::F32)?.reshape(shape)?;
        let y = normalised.broadcast_mul(&gamma)?.broadcast_add(&beta)?;
        let y = if self.activation == NormActivation::Silu {
            y.silu()?
        } else {
            y
        };
        Ok(y.to_dtype(x.dtype())?)
    }
}

/// Each group of a sample is a row.
#[cfg(feature = "cuda")]
fn rows(s: &GroupShape, elements: usize) -> NormShape {
    let n = s.channels / s.groups * s.pixels;
    NormShape {
        rows: elements / n.max(1),
        n,
        groups: s.groups,
        pixels: s.pixels,
        eps: s.eps,
        silu: s.silu,
    }
}

/// The gradient at x.
#[cfg(feature = "cuda")]
fn on_gpu_vjp(
    s: GroupShape,
    x: &Tensor,
    gamma: &Tensor,
    beta: &Tensor,
    g: &Tensor,
) -> candle_core::Result<Tensor> {
    let rows = rows(&s, x.elem_count());
    let (gamma, beta) = (View::of(gamma)?, View::of(beta)?);
    let dx = cuda::norm::vjp_input(rows, View::of(x)?, gamma, beta, View::of(g)?)?;
    Ok(cuda::tensor(dx, x.shape()))
}

struct GroupNormOp {
    groups: usize,
    eps: f32,
    silu: bool,
}

impl GroupNormOp {
    fn shape(&self, x: &Shape, gamma: &Shape) -> candle_core::Result<GroupShape> {
        let channels = gamma.elem_count();
        if x.rank() < 2 || x.dims()[1] != channels {
            candle_core::bail!("group norm of {channels} channels got {x:?}");
        }
        let pixels = x.dims()[2..].iter().product();
        Ok(GroupShape {
            channels,
            pixels,
            groups: self.groups,
            eps: self.eps,
            silu: self.silu,
        })
    }
}

impl CustomOp3 for GroupNormOp {
    fn name(&self) -> &'static str {
        "group norm"
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
        let shape = self.shape(lx.shape(), lg.shape())?;
        let y = norm::group_norm(
            shape,
            &floats(x, lx)?,
            &floats(gamma, lg)?,
            &floats(beta, lb)?,
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
        let rows = rows(
            &self.shape(lx.shape(), lg.shape())?,
            lx.shape().elem_count(),
        );
        let (gamma, beta) = (View::new(gamma, lg)?, View::new(beta, lb)?);
        let y = cuda::norm::norm(rows, View::new(x, lx)?, gamma, beta)?;
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
        let shape = self.shape(x.shape(), gamma.shape())?;
        let g = g.contiguous()?;
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            return Ok((Some(on_gpu_vjp(shape, x, gamma, beta, &g)?), None, None));
        }
        let (dx, dgamma, dbeta) =
            norm::group_norm_vjp(shape, &read(x)?, &read(gamma)?, &read(beta)?, &read(&g)?);
        let wanted = |like: &Tensor, values: Vec<f32>| {
            like.track_op()
                .then(|| from_floats(values, like.shape(), like.dtype()))
                .transpose()
        };
        Ok((wanted(x, dx)?, wanted(gamma, dgamma)?, wanted(beta, dbeta)?))
    }
}
