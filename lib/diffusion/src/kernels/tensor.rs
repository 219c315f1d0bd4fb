//! Tensors of the CPU as f32 slices and back.

use std::borrow::Cow;
use std::mem::MaybeUninit;
use std::ops::Deref;

use candle_core::{CpuStorage, DType, Device, Layout, Shape, Storage, Tensor};
use half::bf16;
use rayon::prelude::*;

use super::simd::vectorized;
use super::tiles::round;

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
        CpuStorage::BF16(values) => Cow::Owned(converted(&values[start..end], widen)),
        _ => candle_core::bail!("kernel input is neither f32, f16 nor bf16"),
    })
}

/// The elements of a contiguous storage of bf16.
pub(crate) fn halves<'a>(
    storage: &'a CpuStorage,
    layout: &Layout,
) -> candle_core::Result<&'a [bf16]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::BF16(values), Some((start, end))) => Ok(&values[start..end]),
        _ => candle_core::bail!("kernel input is not contiguous bf16: {:?}", layout.shape()),
    }
}

/// Runs `f` on the elements of contiguous CPU tensors of bf16.
pub(crate) fn with_halves<const N: usize, R>(
    tensors: [&Tensor; N],
    f: impl FnOnce([&[bf16]; N]) -> R,
) -> candle_core::Result<R> {
    let guards = tensors.map(Tensor::storage_and_layout);
    let mut elements: [&[bf16]; N] = [&[]; N];
    for (elements, (guard, layout)) in elements.iter_mut().zip(&guards) {
        let Storage::Cpu(storage) = &**guard else {
            candle_core::bail!("kernel input is not on the CPU")
        };
        *elements = halves(storage, layout)?;
    }
    Ok(f(elements))
}

/// Numbers that one thread converts at a time.
const CONVERT: usize = 64 * 1024;

/// All of `values`, converted by `convert` piece by piece, which fills the piece that it is given.
fn converted<A: Sync, B: Send>(
    values: &[A],
    convert: impl Fn(&[A], &mut [MaybeUninit<B>]) + Sync,
) -> Vec<B> {
    let mut all = Vec::with_capacity(values.len());
    all.spare_capacity_mut()[..values.len()]
        .par_chunks_mut(CONVERT)
        .zip(values.par_chunks(CONVERT))
        .for_each(|(target, values)| convert(values, target));
    // SAFETY: every piece has been filled.
    unsafe { all.set_len(values.len()) };
    all
}

vectorized! {
    fn widen(values: &[bf16], wide: &mut [MaybeUninit<f32>]) {
        for (wide, value) in wide.iter_mut().zip(values) {
            wide.write(f32::from_bits((value.to_bits() as u32) << 16));
        }
    }
}

vectorized! {
    fn narrow(values: &[f32], narrow: &mut [MaybeUninit<bf16>]) {
        for (narrow, value) in narrow.iter_mut().zip(values) {
            narrow.write(bf16::from_bits(round(*value)));
        }
    }
}

/// Stores f32 results in the precision `dtype`.
pub(crate) fn store(values: Vec<f32>, dtype: DType) -> CpuStorage {
    match dtype {
        DType::F16 => CpuStorage::F16(values.into_iter().map(half::f16::from_f32).collect()),
        DType::BF16 => CpuStorage::BF16(converted(&values, narrow)),
        _ => CpuStorage::F32(values),
    }
}

/// A new CPU tensor in the precision `dtype`.
pub(crate) fn from_floats(
    values: Vec<f32>,
    shape: impl Into<Shape>,
    dtype: DType,
) -> candle_core::Result<Tensor> {
    match dtype {
        DType::BF16 => Tensor::from_vec(converted(&values, narrow), shape, &Device::Cpu),
        _ => Tensor::from_vec(values, shape, &Device::Cpu)?.to_dtype(dtype),
    }
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
