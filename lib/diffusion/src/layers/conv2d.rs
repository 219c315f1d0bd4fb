//! 2-D convolution.

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, Layout, Shape, Tensor};

use super::backend::has_kernels_anywhere;
use crate::backward::apply3;
#[cfg(feature = "cuda")]
use crate::cuda::{self, View};
use crate::error::{Result, argument};
use crate::kernels::conv::{self, ConvShape};
use crate::kernels::tensor::{floats, from_floats, halves, read, store, with_halves};
use crate::kernels::tiles;
use crate::parameters::{Init, Parameters};
use crate::recompute::gradient_through;

/// Zeros around the input of a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Padding {
    /// As many on each side.
    Same(usize),
    /// Only after the last row and column, as the autoencoder's downsampling.
    After(usize),
}

/// Convolution of [batch, inputs, height, width] with square kernels.
#[derive(Debug, Clone)]
pub struct Conv2d {
    weight: Tensor,
    bias: Tensor,
    stride: usize,
    padding: Padding,
}

impl Conv2d {
    /// Weight [outputs, inputs, kernel, kernel] and bias below `parameters`.
    pub fn new(
        parameters: &Parameters,
        (inputs, outputs): (usize, usize),
        kernel: usize,
        stride: usize,
        padding: Padding,
    ) -> Result<Self> {
        let fan_in = Init::FanIn(inputs * kernel * kernel);
        let weight = parameters.get("weight", &[outputs, inputs, kernel, kernel], fan_in)?;
        let bias = parameters.get("bias", &[outputs], fan_in)?;
        Ok(Self {
            weight,
            bias,
            stride,
            padding,
        })
    }

    /// From tensors; refuses shapes that do not fit each other.
    pub fn from_tensors(
        weight: Tensor,
        bias: Tensor,
        stride: usize,
        padding: Padding,
    ) -> Result<Self> {
        let (outputs, _, height, width) = weight.dims4()?;
        if bias.dims() != [outputs] || height != width || stride == 0 {
            return argument(format!(
                "convolution: weight {:?}, bias {:?}, stride {stride}: kernels are square, the bias has one value an output, the stride is at least 1",
                weight.dims(),
                bias.dims()
            ));
        }
        Ok(Self {
            weight,
            bias,
            stride,
            padding,
        })
    }

    /// Number of input channels.
    pub fn inputs(&self) -> usize {
        self.weight.dims()[1]
    }

    /// Applies the layer.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        let op = self.op();
        if has_kernels_anywhere(&x, &[&self.weight, &self.bias]) {
            return Ok(apply3(&x, &self.weight, &self.bias, op)?);
        }
        self.forward_composed(&x, op.before, op.after)
    }

    /// The gradient at an input of shape `x`, where that at the value is `g`. It does not depend on the input's values.
    pub(crate) fn input_gradient(&self, x: &Shape, g: &Tensor) -> Result<Tensor> {
        if has_kernels_anywhere(g, &[&self.weight]) {
            let (shape, g) = (self.op().shape(x, self.weight.shape())?, g.contiguous()?);
            #[cfg(feature = "cuda")]
            if g.device().is_cuda() {
                let dx = cuda::conv::vjp_input(shape, View::of(&g)?, View::of(&self.weight)?)?;
                return Ok(cuda::tensor(dx, x));
            }
            return Ok(vjp_input(shape, x, &g, &self.weight)?);
        }
        let nothing = Tensor::zeros(x, g.dtype(), g.device())?;
        gradient_through(|x| self.forward(x), nothing, g)
    }

    fn op(&self) -> ConvOp {
        let (before, after) = match self.padding {
            Padding::Same(n) => (n, n),
            Padding::After(n) => (0, n),
        };
        ConvOp {
            stride: self.stride,
            before,
            after,
        }
    }

    /// [`Conv2d::forward`] composed of candle's operations, for devices without kernels.
    pub(super) fn forward_composed(
        &self,
        x: &Tensor,
        before: usize,
        after: usize,
    ) -> Result<Tensor> {
        let y = if before == after {
            x.conv2d(&self.weight, before, self.stride, 1, 1)?
        } else {
            let padded = x
                .pad_with_zeros(2, before, after)?
                .pad_with_zeros(3, before, after)?;
            padded.conv2d(&self.weight, 0, self.stride, 1, 1)?
        };
        Ok(y.broadcast_add(&self.bias.reshape((1, (), 1, 1))?)?)
    }
}

/// Gradient at the input of a convolution, on the CPU.
fn vjp_input(shape: ConvShape, x: &Shape, g: &Tensor, w: &Tensor) -> candle_core::Result<Tensor> {
    if tiles::suit([g.dtype(), w.dtype()]) {
        let dx = with_halves([g, w], |[g, w]| tiles::conv2d_vjp_input(shape, g, w))?;
        return Tensor::from_vec(dx, x, g.device());
    }
    let dx = conv::conv2d_vjp_input(shape, &read(g)?, &read(w)?);
    from_floats(dx, x, g.dtype())
}

struct ConvOp {
    stride: usize,
    before: usize,
    after: usize,
}

impl ConvOp {
    fn shape(&self, x: &Shape, w: &Shape) -> candle_core::Result<ConvShape> {
        let (batch, inputs, height, width) = x.dims4()?;
        let (outputs, depth, kernel, _) = w.dims4()?;
        let (before, after) = (self.before, self.after);
        if depth != inputs {
            candle_core::bail!("convolution of {depth} channels got an input of {inputs} channels");
        }
        if height + before + after < kernel || width + before + after < kernel {
            candle_core::bail!(
                "convolution with a kernel of {kernel} got an input of only {height}x{width}"
            );
        }
        let stride = self.stride;
        Ok(ConvShape {
            batch,
            inputs,
            height,
            width,
            outputs,
            kernel,
            stride,
            pad_before: before,
            pad_after: after,
        })
    }
}

impl CustomOp3 for ConvOp {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        w: &CpuStorage,
        lw: &Layout,
        b: &CpuStorage,
        lb: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let shape = self.shape(lx.shape(), lw.shape())?;
        let bias = floats(b, lb)?;
        if tiles::suit([x.dtype(), w.dtype()]) {
            let y = tiles::conv2d(shape, halves(x, lx)?, halves(w, lw)?, Some(&bias));
            return Ok((CpuStorage::BF16(y), shape.result()));
        }
        let y = conv::conv2d(shape, &floats(x, lx)?, &floats(w, lw)?, Some(&bias));
        Ok((store(y, x.dtype()), shape.result()))
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        x: &CudaStorage,
        lx: &Layout,
        w: &CudaStorage,
        lw: &Layout,
        b: &CudaStorage,
        lb: &Layout,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        let shape = self.shape(lx.shape(), lw.shape())?;
        let (x, w, b) = (View::new(x, lx)?, View::new(w, lw)?, View::new(b, lb)?);
        let y = cuda::conv::conv2d(shape, x, w, b)?;
        Ok((y, shape.result()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let shape = self.shape(x.shape(), w.shape())?;
        let g = g.contiguous()?;
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            let dx = cuda::conv::vjp_input(shape, View::of(&g)?, View::of(w)?)?;
            return Ok((Some(cuda::tensor(dx, x.shape())), None, None));
        }
        let mut result = (None, None, None);
        if x.track_op() {
            result.0 = Some(vjp_input(shape, x.shape(), &g, w)?);
        }
        if !w.track_op() && !b.track_op() {
            return Ok(result);
        }
        let g_values = read(&g)?;
        if w.track_op() {
            let dw = conv::conv2d_vjp_weight(shape, &g_values, &read(x)?);
            result.1 = Some(from_floats(dw, w.shape(), w.dtype())?);
        }
        if b.track_op() {
            let db = conv::conv2d_vjp_bias(shape, &g_values);
            result.2 = Some(from_floats(db, b.shape(), b.dtype())?);
        }
        Ok(result)
    }
}
