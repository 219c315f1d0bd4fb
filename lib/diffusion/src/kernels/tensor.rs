//! Tensors of the CPU as f32 slices and back.

use std::borrow::Cow;
use std::ops::Deref;

use candle_core::{CpuStorage, DType, Device, Layout, Shape, Storage, Tensor};

/// The elements of a contiguous storage as f32, converted if stored in half
/// precision.
pub(crate) fn floats<'a>(
    storage: &'a CpuStorage,
    layout: &Layout,
) -> candle_core::Result<Cow<'a, [f32]>> {
    let Some((start, end)) = layout.contiguous_offsets() else {
        candle_core::bail!("kernel input is not contiguous: {:?}", layout.shape());
    };
    Ok(match storage {
        CpuStorage::F32(values) => Cow::Borrowed(&values[start..end]),
        CpuStorage::F16(values) => {
            Cow::Owned(values[start..end].iter().map(|v| v.to_f32()).collect())
        }
        CpuStorage::BF16(values) => {
            Cow::Owned(values[start..end].iter().map(|v| v.to_f32()).collect())
        }
        _ => candle_core::bail!("kernel input is neither f32, f16 nor bf16"),
    })
}

/// Stores f32 results in the precision `dtype`.
pub(crate) fn store(values: Vec<f32>, dtype: DType) -> CpuStorage {
    match dtype {
        DType::F16 => CpuStorage::F16(values.into_iter().map(half::f16::from_f32).collect()),
        DType::BF16 => CpuStorage::BF16(values.into_iter().map(half::bf16::from_f32).collect()),
        _ => CpuStorage::F32(values),
    }
}

/// A new CPU tensor in the precision `dtype`.
pub(crate) fn from_floats(
    values: Vec<f32>,
    shape: impl Into<Shape>,
    dtype: DType,
) -> candle_core::Result<Tensor> {
    Tensor::from_vec(values, shape, &Device::Cpu)?.to_dtype(dtype)
}

/// A tensor's elements, kept alive by its read lock.
pub(crate) struct Floats<G> {
    guard: G,
    layout: Layout,
    converted: Option<Vec<f32>>,
}

impl<G: Deref<Target = Storage>> Deref for Floats<G> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        if let Some(values) = &self.converted {
            return values;
        }
        match (&*self.guard, self.layout.contiguous_offsets()) {
            (Storage::Cpu(CpuStorage::F32(values)), Some((start, end))) => &values[start..end],
            _ => &[],
        }
    }
}

/// Reads a contiguous CPU tensor.
pub(crate) fn read(
    tensor: &Tensor,
) -> candle_core::Result<Floats<impl Deref<Target = Storage> + '_>> {
    let (guard, layout) = tensor.storage_and_layout();
    let Storage::Cpu(storage) = &*guard else {
        candle_core::bail!("kernel input is not on the CPU")
    };
    let converted = match floats(storage, layout)? {
        Cow::Borrowed(_) => None,
        Cow::Owned(values) => Some(values),
    };
    Ok(Floats {
        layout: layout.clone(),
        converted,
        guard,
    })
}
