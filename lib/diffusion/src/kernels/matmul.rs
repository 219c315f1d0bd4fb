//! Matrix products with the strides spelled out: packed panels where the
//! processor has AVX-512, the `gemm` crate elsewhere.

use gemm::{Parallelism, gemm};

use super::packed::{self, PackedColumns};
use super::{tiles, written};

/// A row-major view: element (i, j) at `i * row + j * column`.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a, T = f32> {
    pub data: &'a [T],
    pub row: usize,
    pub column: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// Rows of `width` contiguous elements.
    pub(crate) fn rows(data: &'a [T], width: usize) -> Self {
        Self {
            data,
            row: width,
            column: 1,
        }
    }

    /// The same elements with rows and columns exchanged.
    pub(crate) fn transposed(self) -> Self {
        Self {
            data: self.data,
            row: self.column,
            column: self.row,
        }
    }

    pub(super) fn check(&self, rows: usize, columns: usize) {
        if rows > 0 && columns > 0 {
            assert!(
                (rows - 1) * self.row + (columns - 1) * self.column < self.data.len(),
                "matrix view out of range"
            );
        }
    }
}

/// Threads for one product.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Threads {
    One,
    All,
}

/// What multiplies. docs/diffusion.md has the times of both by shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Engine {
    /// `packed.rs`; needs AVX-512.
    Panels,
    /// The `gemm` crate; runs everywhere.
    Gemm,
    /// `tiles`: elements are rounded to bf16 first.
    Tiles,
}

impl Engine {
    /// Of numbers in f32: the faster one of those that this processor can run.
    pub(crate) fn best() -> Self {
        match packed::available() {
            true => Self::Panels,
            false => Self::Gemm,
        }
    }
}

/// What a product is added to.
#[derive(Clone, Copy)]
pub(crate) enum Onto<'a> {
    /// What is there, times a factor; for 0 that is not read.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
    Kept(f32),
    /// The same numbers in every row.
    Row(&'a [f32]),
}

/// `out[m x n] = keep * out + scale * a[m x k] b[k x n]`, where `out` has rows
/// of stride `out_row` and contiguous columns.
///
/// # Safety
/// `out` is valid for writes of m rows of n elements at stride `out_row`, and
/// for reads if `keep` is not 0, and nobody else uses them meanwhile.
pub(crate) unsafe fn product_at(
    size: (usize, usize, usize),
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix,
    b: Matrix,
    threads: Threads,
) {
    let engine = Engine::best();
    // SAFETY: the caller's contract.
    unsafe { product_by(engine, size, out, out_row, keep, scale, a, b, threads) }
}

/// [`product_at`] by a chosen engine, which this processor must be able to run.
///
/// # Safety
/// As [`product_at`].
pub(crate) unsafe fn product_by(
    engine: Engine,
    (m, n, k): (usize, usize, usize),
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix,
    b: Matrix,
    threads: Threads,
) {
    a.check(m, k);
    b.check(k, n);
    if engine == Engine::Panels {
        assert!(packed::available(), "panels need AVX-512");
        // SAFETY: both views were checked, `out` is the caller's contract.
        return unsafe {
            let onto = Onto::Kept(keep);
            packed::product((m, n, k), out, out_row, onto, scale, a, b, threads)
        };
    }
    if engine == Engine::Tiles {
        // SAFETY: as above.
        return unsafe { tiles::product((m, n, k), out, out_row, keep, scale, a, b, threads) };
    }
    let parallelism = match threads {
        Threads::One => Parallelism::None,
        Threads::All => Parallelism::Rayon(rayon::current_num_threads()),
    };
    // SAFETY: both views were checked, `out` is the caller's contract.
    unsafe {
        gemm(
            m,
            n,
            k,
            out,
            1,
            out_row as isize,
            keep != 0.0,
            a.data.as_ptr(),
            a.column as isize,
            a.row as isize,
            b.data.as_ptr(),
            b.column as isize,
            b.row as isize,
            keep,
            scale,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// A right-hand matrix that several products share, packed ahead where that
/// pays.
pub(crate) enum Columns<'a> {
    Packed(PackedColumns),
    Tiles(tiles::PackedColumns),
    Matrix(Matrix<'a>),
}

impl<'a> Columns<'a> {
    /// The k x n elements of `b`, for products by `engine`.
    pub(crate) fn new(engine: Engine, b: Matrix<'a>, (k, n): (usize, usize)) -> Self {
        b.check(k, n);
        match engine {
            Engine::Panels => Self::Packed(PackedColumns::new(b, (k, n))),
            Engine::Tiles => Self::Tiles(tiles::PackedColumns::new(b, (k, n))),
            Engine::Gemm => Self::Matrix(b),
        }
    }
}

/// [`product_at`] with shared columns; the same bytes.
///
/// # Safety
/// As [`product_at`]; `b` was made for this n and k.
pub(crate) unsafe fn product_columns(
    (m, n, k): (usize, usize, usize),
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix,
    b: &Columns,
    threads: Threads,
) {
    match b {
        Columns::Packed(b) => {
            a.check(m, k);
            // SAFETY: `a` was checked here and `b` when it was packed.
            unsafe { packed::product_packed(m, out, out_row, keep, scale, a, b, threads) }
        }
        // SAFETY: by the caller's contract.
        Columns::Tiles(b) => unsafe {
            tiles::product_packed(m, out, out_row, keep, scale, a, b, threads)
        },
        // SAFETY: by the caller's contract.
        Columns::Matrix(b) => unsafe {
            product_by(
                Engine::Gemm,
                (m, n, k),
                out,
                out_row,
                keep,
                scale,
                a,
                *b,
                threads,
            )
        },
    }
}

/// [`product_at`] into a contiguous slice.
pub(crate) fn product(
    (m, n, k): (usize, usize, usize),
    out: &mut [f32],
    keep: f32,
    a: Matrix,
    b: Matrix,
    threads: Threads,
) {
    assert!(out.len() >= m * n, "product: output too short");
    // SAFETY: the length was checked and the borrow is exclusive.
    unsafe { product_at((m, n, k), out.as_mut_ptr(), n, keep, 1.0, a, b, threads) }
}

/// `a[m x k] b[k x n]`.
fn product_of((m, n, k): (usize, usize, usize), a: Matrix, b: Matrix) -> Vec<f32> {
    // SAFETY: all m n elements are written.
    unsafe {
        written(m * n, |out| {
            product_at((m, n, k), out, n, 0.0, 1.0, a, b, Threads::All);
        })
    }
}

/// `row + a[m x k] b[k x n]` for every row.
pub(super) fn product_onto_rows(
    engine: Engine,
    (m, n, k): (usize, usize, usize),
    row: &[f32],
    a: Matrix,
    b: Matrix,
) -> Vec<f32> {
    assert_eq!(row.len(), n, "one number for each column");
    a.check(m, k);
    b.check(k, n);
    if engine == Engine::Panels {
        // SAFETY: the views and the row were checked, and all m n elements are written.
        return unsafe {
            written(m * n, |out| {
                let onto = Onto::Row(row);
                packed::product((m, n, k), out, n, onto, 1.0, a, b, Threads::All);
            })
        };
    }
    let (size, mut out) = ((m, n, k), row.repeat(m));
    // SAFETY: `out` holds m rows of n elements, and the views were checked.
    unsafe {
        product_by(
            engine,
            size,
            out.as_mut_ptr(),
            n,
            1.0,
            1.0,
            a,
            b,
            Threads::All,
        )
    };
    out
}

/// Sizes of x [rows, inputs] and y [rows, outputs] of a fully connected layer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinearShape {
    pub rows: usize,
    pub inputs: usize,
    pub outputs: usize,
}

/// `y = x w^T + bias` for x [rows, inputs], w [outputs, inputs].
pub(crate) fn linear(
    LinearShape {
        rows,
        inputs,
        outputs,
    }: LinearShape,
    x: &[f32],
    w: &[f32],
    bias: Option<&[f32]>,
) -> Vec<f32> {
    let (a, b) = (
        Matrix::rows(x, inputs),
        Matrix::rows(w, inputs).transposed(),
    );
    match bias {
        Some(bias) => product_onto_rows(Engine::best(), (rows, outputs, inputs), bias, a, b),
        None => product_of((rows, outputs, inputs), a, b),
    }
}

/// Gradient of [`linear`] with respect to x, for the gradient `g` of y.
pub(crate) fn linear_vjp_input(
    LinearShape {
        rows,
        inputs,
        outputs,
    }: LinearShape,
    g: &[f32],
    w: &[f32],
) -> Vec<f32> {
    let (a, b) = (Matrix::rows(g, outputs), Matrix::rows(w, inputs));
    product_of((rows, inputs, outputs), a, b)
}

/// Gradient of [`linear`] with respect to w.
pub(crate) fn linear_vjp_weight(
    LinearShape {
        rows,
        inputs,
        outputs,
    }: LinearShape,
    g: &[f32],
    x: &[f32],
) -> Vec<f32> {
    let (a, b) = (
        Matrix::rows(g, outputs).transposed(),
        Matrix::rows(x, inputs),
    );
    product_of((outputs, inputs, rows), a, b)
}

/// Sum over rows: the gradient of a bias.
pub(crate) fn column_sums(g: &[f32], columns: usize) -> Vec<f32> {
    let mut sums = vec![0f64; columns];
    for row in g.chunks_exact(columns) {
        for (sum, &value) in sums.iter_mut().zip(row) {
            *sum += value as f64;
        }
    }
    sums.into_iter().map(|sum| sum as f32).collect()
}
