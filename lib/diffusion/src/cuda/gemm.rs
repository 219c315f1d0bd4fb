//! Products of matrices by cuBLAS.

use candle_core::cuda_backend::WrapErr;
use candle_core::cuda_backend::cudarc::cublas::{result, sys};
use candle_core::{DType, Result, bail};

use super::View;

/// A row of matrices, each stored row by row.
pub(super) struct Matrices<'a> {
    pub first: View<'a>,
    /// Elements from a stored row to the next.
    pub row: usize,
    /// Elements from a matrix to the next; 0 for one and the same.
    pub next: usize,
    /// Whether the product takes the transpose of what is stored.
    pub transposed: bool,
}

impl<'a> Matrices<'a> {
    pub(super) fn new(first: View<'a>, row: usize, next: usize) -> Self {
        Self {
            first,
            row,
            next,
            transposed: false,
        }
    }

    pub(super) fn transposed(self) -> Self {
        Self {
            transposed: !self.transposed,
            ..self
        }
    }
}

/// C [m, n] = A [m, k] B [k, n] for each of `count` matrices, summed in f32. A and B are of one precision, C is of that or f32.
pub(super) fn products(
    count: usize,
    (m, k, n): (usize, usize, usize),
    a: Matrices,
    b: Matrices,
    c: Matrices,
) -> Result<()> {
    let int = |value: usize| match i32::try_from(value) {
        Ok(value) => Ok(value),
        Err(_) => bail!("a matrix product of {m} x {k} x {n} is more than cuBLAS counts"),
    };
    let operation = |m: &Matrices| match m.transposed {
        true => sys::cublasOperation_t::CUBLAS_OP_T,
        false => sys::cublasOperation_t::CUBLAS_OP_N,
    };
    let precision = |dtype: DType| match dtype {
        DType::BF16 => sys::cudaDataType_t::CUDA_R_16BF,
        DType::F16 => sys::cudaDataType_t::CUDA_R_16F,
        _ => sys::cudaDataType_t::CUDA_R_32F,
    };
    let (one, zero) = (1f32, 0f32);
    let blas = a.first.device.cublas_handle();
    // Stored by columns, as cuBLAS reads it, a matrix is its transpose: C^T = B^T A^T.
    // SAFETY: the caller's matrices lie within their arrays.
    unsafe {
        result::gemm_strided_batched_ex(
            *blas.handle(),
            operation(&b),
            operation(&a),
            int(n)?,
            int(m)?,
            int(k)?,
            (&raw const one).cast(),
            b.first.address as *const _,
            precision(b.first.dtype),
            int(b.row)?,
            b.next as i64,
            a.first.address as *const _,
            precision(a.first.dtype),
            int(a.row)?,
            a.next as i64,
            (&raw const zero).cast(),
            c.first.address as *mut _,
            precision(c.first.dtype),
            int(c.row)?,
            c.next as i64,
            int(count)?,
            sys::cublasComputeType_t::CUBLAS_COMPUTE_32F,
            sys::cublasGemmAlgo_t::CUBLAS_GEMM_DEFAULT,
        )
    }
    .w()
}
