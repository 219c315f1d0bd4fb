//! Fully connected layer.

#[cfg(feature = "cuda")]
use candle_core::CudaStorage;
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Shape, Tensor};

use super::backend::has_kernels_anywhere;
use crate::backward::{apply2, apply3};
#[cfg(feature = "cuda")]
use crate::cuda::{self, View};
use crate::error::{Result, argument};
use crate::kernels::matmul::{self, LinearShape};
use crate::kernels::tensor::{floats, from_floats, halves, read, store, with_halves};
use crate::kernels::tiles;
use crate::parameters::{Init, Parameters};

/// y = x W^T + b over the last dimension.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: Tensor,
    bias: Option<Tensor>,
}

impl Linear {
    /// Weight [outputs, inputs] and bias [outputs] below `parameters`.
    pub fn new(parameters: &Parameters, inputs: usize, outputs: usize) -> Result<Self> {
        let weight = parameters.get("weight", &[outputs, inputs], Init::FanIn(inputs))?;
        let bias = parameters.get("bias", &[outputs], Init::FanIn(inputs))?;
        Ok(Self {
            weight,
            bias: Some(bias),
        })
    }

    /// As [`Linear::new`] without a bias.
    pub fn without_bias(parameters: &Parameters, inputs: usize, outputs: usize) -> Result<Self> {
        let weight = parameters.get("weight", &[outputs, inputs], Init::FanIn(inputs))?;
        Ok(Self { weight, bias: None })
    }

    /// From tensors; refuses a weight that is neither a matrix nor a 1x1 convolution's [outputs, inputs, 1, 1], or a bias
    /// that does not fit it.
    pub fn from_tensors(weight: Tensor, bias: Option<Tensor>) -> Result<Self> {
        let (outputs, _) = matrix(weight.shape())?;
        if let Some(bias) = &bias
            && bias.dims() != [outputs]
        {
            return argument(format!(
                "linear layer: weight {:?} and bias {:?} disagree",
                weight.dims(),
                bias.dims()
            ));
        }
        Ok(Self { weight, bias })
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.weight.dims()[1]
    }

    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.weight.dims()[0]
    }

    /// The weight matrix [outputs, inputs], or [outputs, inputs, 1, 1].
    pub fn weight(&self) -> &Tensor {
        &self.weight
    }

    /// Applies the layer to x [..., inputs].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        if !has_kernels_anywhere(&x, &[]) {
            return self.forward_composed(&x);
        }
        Ok(match &self.bias {
            Some(bias) => apply3(&x, &self.weight, bias, LinearOp)?,
            None => apply2(&x, &self.weight, LinearOp)?,
        })
    }

    /// [`Linear::forward`] composed of candle's operations, for devices without kernels.
    pub(super) fn forward_composed(&self, x: &Tensor) -> Result<Tensor> {
        let mut shape = x.dims().to_vec();
        let inputs = shape.pop().unwrap_or(1);
        let weight = self.weight.reshape((self.outputs(), inputs))?;
        let y = x.reshape(((), inputs))?.matmul(&weight.t()?)?;
        shape.push(self.outputs());
        let y = y.reshape(shape)?;
        Ok(match &self.bias {
            Some(bias) => y.broadcast_add(bias)?,
            None => y,
        })
    }
}

/// Outputs and inputs of a weight. A 1x1 convolution's is taken as it is: reshaped, it would be another tensor of the graph.
fn matrix(weight: &Shape) -> candle_core::Result<(usize, usize)> {
    match *weight.dims() {
        [outputs, inputs] | [outputs, inputs, 1, 1] => Ok((outputs, inputs)),
        _ => candle_core::bail!("linear layer: the weight {weight:?} is no matrix"),
    }
}

struct LinearOp;

impl LinearOp {
    /// Of the product, and of its result.
    fn sizes(x: &Shape, w: &Shape) -> candle_core::Result<(LinearShape, Shape)> {
        let (outputs, inputs) = matrix(w)?;
        let mut shape = x.dims().to_vec();
        if shape.pop() != Some(inputs) {
            candle_core::bail!("linear layer of {inputs} inputs got {x:?}");
        }
        let rows = shape.iter().product();
        shape.push(outputs);
        let sizes = LinearShape {
            rows,
            inputs,
            outputs,
        };
        Ok((sizes, Shape::from(shape)))
    }

    fn run(
        (x, lx): (&CpuStorage, &Layout),
        (w, lw): (&CpuStorage, &Layout),
        bias: Option<(&CpuStorage, &Layout)>,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (sizes, shape) = Self::sizes(lx.shape(), lw.shape())?;
        let bias = bias.map(|(b, lb)| floats(b, lb)).transpose()?;
        if tiles::suit([x.dtype(), w.dtype()]) {
            let y = tiles::linear(sizes, halves(x, lx)?, halves(w, lw)?, bias.as_deref());
            return Ok((CpuStorage::BF16(y), shape));
        }
        let y = matmul::linear(sizes, &floats(x, lx)?, &floats(w, lw)?, bias.as_deref());
        Ok((store(y, x.dtype()), shape))
    }

    #[cfg(feature = "cuda")]
    fn run_on_gpu(
        (x, lx): (&CudaStorage, &Layout),
        (w, lw): (&CudaStorage, &Layout),
        bias: Option<(&CudaStorage, &Layout)>,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        let (sizes, shape) = Self::sizes(lx.shape(), lw.shape())?;
        let bias = bias.map(|(b, lb)| View::new(b, lb)).transpose()?;
        let y = cuda::linear::linear(sizes, View::new(x, lx)?, View::new(w, lw)?, bias)?;
        Ok((y, shape))
    }

    fn vjp(
        x: &Tensor,
        w: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let (outputs, inputs) = matrix(w.shape())?;
        let g = g.contiguous()?;
        let rows = g.elem_count() / outputs;
        let sizes = LinearShape {
            rows,
            inputs,
            outputs,
        };
        #[cfg(feature = "cuda")]
        if g.device().is_cuda() {
            let (x_, w_, g) = (View::of(x)?, View::of(w)?, View::of(&g)?);
            let dx = x
                .track_op()
                .then(|| cuda::linear::vjp_input(sizes, g, w_))
                .transpose()?;
            let dw = w
                .track_op()
                .then(|| cuda::linear::vjp_weight(sizes, g, x_))
                .transpose()?;
            return Ok((
                dx.map(|d| cuda::tensor(d, x.shape())),
                dw.map(|d| cuda::tensor(d, w.shape())),
            ));
        }
        let mut result = (None, None);
        if x.track_op() {
            result.0 = Some(if tiles::suit([g.dtype(), w.dtype()]) {
                let dx = with_halves([&g, w], |[g, w]| tiles::linear_vjp_input(sizes, g, w))?;
                Tensor::from_vec(dx, x.shape(), x.device())?
            } else {
                let dx = matmul::linear_vjp_input(sizes, &read(&g)?, &read(w)?);
                from_floats(dx, x.shape(), x.dtype())?
            });
        }
        if w.track_op() {
            let dw = matmul::linear_vjp_weight(sizes, &read(&g)?, &read(x)?);
            result.1 = Some(from_floats(dw, w.shape(), w.dtype())?);
        }
        Ok(result)
    }
}

use candle_core::backend::BackendStorage;

impl CustomOp2 for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        w: &CpuStorage,
        lw: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        Self::run((x, lx), (w, lw), None)
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        x: &CudaStorage,
        lx: &Layout,
        w: &CudaStorage,
        lw: &Layout,
    ) -> candle_core::Result<(CudaStorage, Shape)> {
        Self::run_on_gpu((x, lx), (w, lw), None)
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        Self::vjp(x, w, g)
    }
}

impl CustomOp3 for LinearOp {
    fn name(&self) -> &'static str {
        "linear with bias"
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
        Self::run((x, lx), (w, lw), Some((b, lb)))
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
        Self::run_on_gpu((x, lx), (w, lw), Some((b, lb)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        _: &Tensor,
        g: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (dx, dw) = Self::vjp(x, w, g)?;
        let db = if b.track_op() && g.device().is_cuda() {
            Some(g.reshape(((), b.elem_count()))?.sum(0)?)
        } else if b.track_op() {
            let sums = matmul::column_sums(&read(&g.contiguous()?)?, b.elem_count());
            Some(from_floats(sums, b.shape(), b.dtype())?)
        } else {
            None
        };
        Ok((dx, dw, db))
    }
}
