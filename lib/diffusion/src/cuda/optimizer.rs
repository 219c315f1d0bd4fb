//! Steps of an optimiser: one kernel a parameter, where composed of operations it would be a dozen.

use candle_core::{CudaDevice, DType, Device, Result, Tensor, bail};

use super::{Argument, View, address, launch};

/// Threads of a block.
const THREADS: usize = 256;

/// The sum of squares of every gradient; waits for the GPU once.
pub(crate) fn squares(device: &CudaDevice, gradients: &[Tensor]) -> Result<Vec<f64>> {
    let sums = device.alloc_zeros::<f64>(gradients.len())?;
    for (i, gradient) in gradients.iter().enumerate() {
        let sum = address(&sums) + (i * size_of::<f64>()) as u64;
        let arguments = [
            View::of(gradient)?.into(),
            Argument::Address(sum),
            gradient.elem_count().try_into()?,
        ];
        let kernel = ("squares", DType::F32);
        launch(device, kernel, (1, 1, 1), THREADS as u32, &arguments)?;
    }
    device.clone_dtoh(&sums)
}

/// What a step does to every parameter.
#[derive(Clone, Copy)]
pub(crate) struct AdamWStep {
    /// Factor of the gradient.
    pub scale: f64,
    pub beta1: f64,
    pub beta2: f64,
    pub correction1: f64,
    pub correction2: f64,
    pub eps: f64,
    /// Factor of the parameter.
    pub keep: f64,
    pub rate: f64,
}

/// Changes `parameter`, `first` and `second`, all f32 and contiguous, in their place.
pub(crate) fn adamw(
    s: AdamWStep,
    parameter: &Tensor,
    first: &Tensor,
    second: &Tensor,
    gradient: &Tensor,
) -> Result<()> {
    let Device::Cuda(device) = parameter.device() else {
        bail!("the parameter is not on a GPU");
    };
    let n = parameter.elem_count();
    let mut arguments = vec![];
    for tensor in [parameter, first, second, gradient] {
        if tensor.dtype() != DType::F32 || tensor.elem_count() != n {
            bail!(
                "an optimiser's tensors are f32 of one size, not {:?}",
                tensor.dtype()
            );
        }
        arguments.push(View::of(tensor)?.into());
    }
    arguments.push(n.try_into()?);
    let numbers = [
        s.scale,
        s.beta1,
        s.beta2,
        s.correction1,
        s.correction2,
        s.eps,
        s.keep,
        s.rate,
    ];
    arguments.extend(numbers.map(|value| Argument::Float(value as f32)));
    let grid = (n.div_ceil(THREADS), 1, 1);
    launch(
        device,
        ("adamw", DType::F32),
        grid,
        THREADS as u32,
        &arguments,
    )
}
