//! Kernels for NVIDIA GPUs: matrix products by cuBLAS, everything else by `kernels.cu`. They take contiguous arrays of f32,
//! f16 or bf16, all of one precision, and sum in f32. Nothing here waits for the GPU.

pub(crate) mod attention;
pub(crate) mod conv;
mod gemm;
pub(crate) mod linear;
pub(crate) mod norm;
pub(crate) mod optimizer;
pub(crate) mod pointwise;

use std::marker::PhantomData;

use candle_core::backend::{BackendDevice, BackendStorage};
use candle_core::cuda_backend::cudarc::driver::{
    CudaSlice, DevicePtr, LaunchConfig, PushKernelArg,
};
use candle_core::cuda_backend::{CudaStorageSlice, WrapErr};
use candle_core::op::BackpropOp;
use candle_core::{
    CudaDevice, CudaStorage, DType, Device, Layout, Result, Shape, Storage, Tensor, bail,
};

/// Kernels that are loaded together.
#[derive(Clone, Copy)]
struct Module {
    name: &'static str,
    ptx: &'static str,
}

const KERNELS: Module = Module {
    name: "dipir kernels",
    ptx: include_str!(concat!(env!("OUT_DIR"), "/kernels.ptx")),
};
const FLASH: Module = Module {
    name: "dipir flash",
    ptx: include_str!(concat!(env!("OUT_DIR"), "/flash.ptx")),
};

/// Bytes that an operation may take for values of its own; larger ones are worked through in parts.
const SCRATCH: usize = 512 << 20;

/// Where an array begins on the GPU, and what it holds.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    device: &'a CudaDevice,
    address: u64,
    dtype: DType,
    owner: PhantomData<&'a CudaStorage>,
}

impl<'a> View<'a> {
    pub(crate) fn new(storage: &'a CudaStorage, layout: &Layout) -> Result<Self> {
        let Some((start, _)) = layout.contiguous_offsets() else {
            bail!("kernel input is not contiguous: {:?}", layout.shape());
        };
        let dtype = storage.dtype();
        let first = match &storage.slice {
            CudaStorageSlice::F32(slice) => address(slice),
            CudaStorageSlice::F16(slice) => address(slice),
            CudaStorageSlice::BF16(slice) => address(slice),
            _ => bail!("kernel input is {dtype:?}; accepted: f32, f16, bf16"),
        };
        Ok(Self {
            device: storage.device(),
            address: first + (start * dtype.size_in_bytes()) as u64,
            dtype,
            owner: PhantomData,
        })
    }

    /// Of a tensor, whose memory stays where it is as long as the tensor lives.
    pub(crate) fn of(tensor: &'a Tensor) -> Result<Self> {
        let Device::Cuda(device) = tensor.device() else {
            bail!("kernel input is not on a GPU");
        };
        let (storage, layout) = tensor.storage_and_layout();
        let Storage::Cuda(storage) = &*storage else {
            bail!("kernel input is not on a GPU");
        };
        let View { address, dtype, .. } = View::new(storage, layout)?;
        Ok(Self {
            device,
            address,
            dtype,
            owner: PhantomData,
        })
    }

    /// Whether it begins where sixteen bytes can be read at once.
    fn is_aligned(self) -> bool {
        self.address.is_multiple_of(16)
    }

    /// `elements` further.
    fn at(self, elements: usize) -> Self {
        let address = self.address + (elements * self.dtype.size_in_bytes()) as u64;
        Self { address, ..self }
    }
}

fn address<T>(slice: &CudaSlice<T>) -> u64 {
    slice.device_ptr(slice.stream()).0
}

/// Values of this precision whose content is not set yet.
fn empty(device: &CudaDevice, dtype: DType, elements: usize) -> Result<CudaStorage> {
    // SAFETY: whoever asks for it writes every element before it is read.
    unsafe { device.alloc_uninit(&Shape::from(elements), dtype) }
}

fn whole(storage: &CudaStorage, elements: usize) -> Result<View<'_>> {
    View::new(storage, &Layout::contiguous(elements))
}

/// A tensor of what a kernel wrote.
pub(crate) fn tensor(storage: CudaStorage, shape: &Shape) -> Tensor {
    Tensor::from_storage(Storage::Cuda(storage), shape, BackpropOp::none(), false)
}

/// What a kernel is given.
#[derive(Clone, Copy)]
enum Argument {
    Address(u64),
    Int(i32),
    Float(f32),
}

impl From<View<'_>> for Argument {
    fn from(view: View) -> Self {
        Self::Address(view.address)
    }
}

impl From<f32> for Argument {
    fn from(value: f32) -> Self {
        Self::Float(value)
    }
}

impl TryFrom<usize> for Argument {
    type Error = candle_core::Error;

    fn try_from(value: usize) -> Result<Self> {
        match i32::try_from(value) {
            Ok(value) => Ok(Self::Int(value)),
            Err(_) => bail!("{value} is more than a kernel counts"),
        }
    }
}

/// As [`launch_of`], of the usual kernels.
fn launch(
    device: &CudaDevice,
    kernel: (&str, DType),
    grid: (usize, usize, usize),
    threads: u32,
    arguments: &[Argument],
) -> Result<()> {
    launch_of(KERNELS, device, kernel, grid, threads, arguments)
}

/// Starts the kernel `name` for the precision `dtype` on `grid` blocks.
fn launch_of(
    module: Module,
    device: &CudaDevice,
    (name, dtype): (&str, DType),
    grid: (usize, usize, usize),
    threads: u32,
    arguments: &[Argument],
) -> Result<()> {
    if grid.0 * grid.1 * grid.2 == 0 {
        return Ok(());
    }
    if grid.1 > 65_535 || grid.2 > 65_535 || i32::try_from(grid.0).is_err() {
        bail!("{name}: {grid:?} is more than a kernel's grid holds");
    }
    let name = format!("{name}_{}", dtype.as_str());
    let function = device.get_or_load_custom_func(&name, module.name, module.ptx)?;
    let mut builder = function.builder();
    for argument in arguments {
        match argument {
            Argument::Address(value) => builder.arg(value),
            Argument::Int(value) => builder.arg(value),
            Argument::Float(value) => builder.arg(value),
        };
    }
    let config = LaunchConfig {
        grid_dim: (grid.0 as u32, grid.1 as u32, grid.2 as u32),
        block_dim: (threads, 1, 1),
        shared_mem_bytes: 0,
    };
    // SAFETY: the arguments are those that kernels.cu declares, and their arrays as long as it says.
    unsafe { builder.launch(config) }.w()?;
    Ok(())
}

/// Refuses arrays of unlike precision.
fn alike(views: &[View]) -> Result<DType> {
    let dtype = views[0].dtype;
    match views.iter().find(|v| v.dtype != dtype) {
        Some(other) => bail!(
            "a layer got {dtype:?} and {:?}: its input and weights are of one precision",
            other.dtype
        ),
        None => Ok(dtype),
    }
}
