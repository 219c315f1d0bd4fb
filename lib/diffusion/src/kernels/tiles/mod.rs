//! Matrix products of numbers rounded to bf16, summed in f32, by the processor's tiles (AMX), or in plain Rust where it has
//! none. Layers use them where there are tiles.
//!
//! A is packed in tiles of 16 rows and 32 elements of depth, B in pairs of depth: word (p, j) holds the elements
//! (2 p, j) and (2 p + 1, j). Both read these layouts. Jobs are fixed by the shape; each element of a result
//! is summed in one order whatever the number of threads.

mod attention;
mod conv;
mod element;
mod micro;
mod taps;

use rayon::prelude::*;

pub(crate) use attention::{attention, attention_vjp};
pub(crate) use conv::{conv2d, conv2d_vjp_input};
pub(crate) use element::{Element, round};
pub use micro::bf16_products;

use super::matmul::{LinearShape, Matrix, Threads};
use super::{SharedMut, with_scratch};
use candle_core::DType;
use element::{Floats, Halves, SharedHalves, Sink, Take, transpose};
use half::bf16;
use micro::{DEPTH, Instructions, ROWS, SIDE};

/// Rows of a job.
const JOB_ROWS: usize = 4 * SIDE;
/// Columns of a job.
const JOB_COLUMNS: usize = 16 * SIDE;
/// Steps of depth of one pass: 32 columns of B, 36 KiB, stay in L1 while rows of A stream by.
const PASS: usize = 18;
/// Elements of a tile of A.
const TILE: usize = ROWS * DEPTH;
/// Products below this many multiplications run on one thread.
const SMALL: usize = 1 << 20;

/// Whether tensors of these types are multiplied here. Without tiles the kernels for f32 are faster.
pub(crate) fn suit<const N: usize>(types: [DType; N]) -> bool {
    types == [DType::BF16; N] && bf16_products().is_some()
}

/// Runs `f` on `len` words of unspecified content.
fn with_words<R>(len: usize, f: impl FnOnce(&mut [u32]) -> R) -> R {
    with_scratch(len, |floats| {
        // SAFETY: a word is as large and aligned as a float, and any bits are either.
        f(unsafe { std::slice::from_raw_parts_mut(floats.as_mut_ptr().cast(), len) })
    })
}

/// Runs `f` on `len` bf16 of unspecified content.
fn with_halves<R>(len: usize, f: impl FnOnce(&mut [u16]) -> R) -> R {
    with_words(len.div_ceil(2), |words| {
        // SAFETY: a word is two halves, and any bits are halves.
        f(unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), len) })
    })
}

/// A right-hand matrix of k x n elements in panels of [`SIDE`] columns, each of all pairs of depth.
pub(crate) struct PackedColumns {
    words: Vec<u32>,
    pub(super) n: usize,
    pub(super) k: usize,
}

impl PackedColumns {
    pub(super) fn new<T: Element>(b: Matrix<T>, (k, n): (usize, usize)) -> Self {
        let mut words = vec![0; n.div_ceil(SIDE) * panel_words(k)];
        for (panel, words) in words.chunks_exact_mut(panel_words(k).max(1)).enumerate() {
            pack_panel(b, (k, n), panel * SIDE, words);
        }
        Self { words, n, k }
    }
}

/// Words of a panel.
fn panel_words(k: usize) -> usize {
    k.div_ceil(DEPTH) * DEPTH / 2 * SIDE
}

/// Packs the panel whose first column is `left`; what lies past the matrix is 0.
fn pack_panel<T: Element>(b: Matrix<T>, (k, n): (usize, usize), left: usize, words: &mut [u32]) {
    let count = SIDE.min(n - left);
    if b.row == 1 {
        // Columns lie along the depth: sixteen of them, 32 deep, are turned at once.
        let (whole, rest) = (k / DEPTH, k % DEPTH);
        let steps = k.div_ceil(DEPTH);
        with_halves(steps * TILE, |tiles| {
            for half in 0..SIDE / ROWS {
                let columns = count.saturating_sub(half * ROWS).min(ROWS);
                if columns < ROWS {
                    tiles.fill(0);
                }
                if columns > 0 {
                    let data = &b.data[(left + half * ROWS) * b.column..];
                    T::fill_tiles(data, b.column, columns, whole, tiles);
                    fill_last(data, b.column, (columns, rest), whole * DEPTH, tiles);
                }
                for (step, tile) in tiles.chunks_exact(TILE).enumerate() {
                    let words = &mut words[step * DEPTH / 2 * SIDE + half * ROWS..];
                    transpose(tile.try_into().expect("a tile"), words, SIDE);
                }
            }
        });
        return;
    }
    for (pair, words) in words.chunks_exact_mut(SIDE).enumerate() {
        let row = |p: usize| {
            let start = p * b.row + left;
            &b.data[start..start + count]
        };
        words[count..].fill(0);
        let words = &mut words[..count];
        match k.saturating_sub(2 * pair) {
            0 => words.fill(0),
            _ if b.column != 1 => {
                for (j, word) in words.iter_mut().enumerate() {
                    let bits = |p: usize| match p < k {
                        true => b.data[p * b.row + (left + j) * b.column].bits() as u32,
                        false => 0,
                    };
                    *word = bits(2 * pair) | bits(2 * pair + 1) << 16;
                }
            }
            1 => {
                let row = row(2 * pair).iter();
                (words.iter_mut().zip(row)).for_each(|(word, value)| *word = value.bits() as u32);
            }
            _ => T::pair(row(2 * pair), row(2 * pair + 1), words),
        }
    }
}

/// Packs `rows` rows of A from `first`: blocks of 16 rows, each of all steps; what lies past the matrix is 0.
fn pack_rows<T: Element>(a: Matrix<T>, first: usize, rows: usize, k: usize, target: &mut [u16]) {
    let steps = k.div_ceil(DEPTH);
    for (block, target) in target.chunks_exact_mut((steps * TILE).max(1)).enumerate() {
        let top = first + block * ROWS;
        let count = (first + rows).saturating_sub(top).min(ROWS);
        if count < ROWS || !k.is_multiple_of(DEPTH) {
            target.fill(0);
        }
        if a.column == 1 {
            if count > 0 {
                let data = &a.data[top * a.row..];
                T::fill_tiles(data, a.row, count, k / DEPTH, target);
                fill_last(data, a.row, (count, k % DEPTH), k / DEPTH * DEPTH, target);
            }
            continue;
        }
        for (step, tile) in target.chunks_exact_mut(TILE).enumerate() {
            let start = step * DEPTH;
            let depth = DEPTH.min(k - start);
            if a.row == 1 && count > 0 {
                let mut words = [0u32; TILE / 2];
                for (pair, words) in words.chunks_exact_mut(ROWS).enumerate() {
                    let mut sides = [[0u16; ROWS]; 2];
                    for (i, side) in sides.iter_mut().enumerate() {
                        let p = start + 2 * pair + i;
                        if p < k {
                            let start = p * a.column + top;
                            T::round_to(&a.data[start..start + count], &mut side[..count]);
                        }
                    }
                    for (word, (&low, &high)) in
                        words.iter_mut().zip(sides[0].iter().zip(&sides[1]))
                    {
                        *word = low as u32 | (high as u32) << 16;
                    }
                }
                element::transpose_words(&words, tile);
            } else {
                for (i, row) in tile.chunks_exact_mut(DEPTH).enumerate().take(count) {
                    for (p, value) in row.iter_mut().enumerate().take(depth) {
                        *value = a.data[(top + i) * a.row + (start + p) * a.column].bits();
                    }
                }
            }
        }
    }
}

/// The last tile of a block, which is not filled to its depth: `rest` elements from `first` of each row, then 0.
fn fill_last<T: Element>(
    data: &[T],
    stride: usize,
    (rows, rest): (usize, usize),
    first: usize,
    tiles: &mut [u16],
) {
    if rest == 0 {
        return;
    }
    let tile = &mut tiles[first / DEPTH * TILE..][..TILE];
    for (row, tile) in tile.chunks_exact_mut(DEPTH).enumerate().take(rows) {
        T::round_to(&data[row * stride + first..][..rest], &mut tile[..rest]);
        tile[rest..].fill(0);
    }
}

/// `out = keep * out + scale * a b`, with the elements of a and b rounded to bf16.
///
/// # Safety
/// `out` is valid for writes of m rows of n elements at stride `out_row` (and reads, if `keep` is not 0), used by nobody
/// else meanwhile.
pub(super) unsafe fn product<A: Element, B: Element>(
    size: (usize, usize, usize),
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix<A>,
    b: Matrix<B>,
    threads: Threads,
) {
    let sink = Floats {
        out: SharedMut(out),
        row: out_row,
        keep,
        scale,
    };
    // SAFETY: by the caller's contract.
    unsafe { product_into(size, sink, a, b, threads) };
}

/// The product's sums, into `sink`.
///
/// # Safety
/// The sink takes m x n elements.
unsafe fn product_into<A: Element, B: Element>(
    (m, n, k): (usize, usize, usize),
    sink: impl Sink,
    a: Matrix<A>,
    b: Matrix<B>,
    threads: Threads,
) {
    a.check(m, k);
    b.check(k, n);
    with_words(n.div_ceil(SIDE) * panel_words(k), |words| {
        let panel = panel_words(k).max(1);
        let pack = |(index, words): (usize, &mut [u32])| pack_panel(b, (k, n), index * SIDE, words);
        if threads == Threads::All && m * n * k >= SMALL {
            words.par_chunks_exact_mut(panel).enumerate().for_each(pack);
        } else {
            words.chunks_exact_mut(panel).enumerate().for_each(pack);
        }
        // SAFETY: by the caller's contract.
        unsafe { product_panels((m, n, k), sink, a, words, threads) };
    });
}

/// [`product`] with a right-hand matrix that is packed already.
///
/// # Safety
/// As [`product`], for the n and k of `b`.
pub(super) unsafe fn product_packed<A: Element>(
    m: usize,
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix<A>,
    b: &PackedColumns,
    threads: Threads,
) {
    a.check(m, b.k);
    let sink = Floats {
        out: SharedMut(out),
        row: out_row,
        keep,
        scale,
    };
    // SAFETY: by the caller's contract.
    unsafe { product_panels((m, b.n, b.k), sink, a, &b.words, threads) };
}

/// # Safety
/// As [`product_into`]; `words` are the panels of B, and the view of A covers m x k elements.
unsafe fn product_panels<A: Element>(
    (m, n, k): (usize, usize, usize),
    sink: impl Sink,
    a: Matrix<A>,
    words: &[u32],
    threads: Threads,
) {
    if m == 0 || n == 0 {
        return;
    }
    let steps: Vec<usize> = (0..k.div_ceil(DEPTH))
        .map(|step| step * DEPTH / 2 * SIDE)
        .collect();
    let columns_of_job = if n <= JOB_COLUMNS * 3 / 2 {
        n
    } else {
        JOB_COLUMNS
    };
    let (row_jobs, column_jobs) = (m.div_ceil(JOB_ROWS), n.div_ceil(columns_of_job));
    let job = |job: usize| {
        let (top, left) = (
            job / column_jobs * JOB_ROWS,
            job % column_jobs * columns_of_job,
        );
        let (rows, columns) = (JOB_ROWS.min(m - top), columns_of_job.min(n - left));
        with_halves(rows.div_ceil(SIDE) * 2 * steps.len() * TILE, |packed| {
            pack_rows(a, top, rows, k, packed);
            let b = Columns {
                words: &words[left / SIDE * panel_words(k)..],
                steps: &steps,
                stride: SIDE,
                block: panel_words(k),
            };
            // SAFETY: the rows and columns of this job are its own.
            unsafe {
                sink.job((top, left), (rows, columns), |take| {
                    blocks((rows, columns), packed, b, take)
                });
            }
        });
    };
    if threads == Threads::All && m * n * k.max(1) >= SMALL {
        (0..row_jobs * column_jobs).into_par_iter().for_each(job);
    } else {
        (0..row_jobs * column_jobs).for_each(job);
    }
}

/// Packed columns as a job reads them: the words of pair p of step s of block j start at
/// `steps[s] + p * stride + j * block`.
#[derive(Clone, Copy)]
struct Columns<'a> {
    words: &'a [u32],
    steps: &'a [usize],
    stride: usize,
    block: usize,
}

/// All blocks of 32 x 32 sums of `rows` x `columns`, into `done`.
fn blocks((rows, columns): (usize, usize), a: &[u16], b: Columns, done: Take) {
    let (row_blocks, column_blocks) = (rows.div_ceil(SIDE), columns.div_ceil(SIDE));
    let (steps, passes) = (b.steps.len(), b.steps.len().div_ceil(PASS).max(1));
    assert!(a.len() >= row_blocks * 2 * steps * TILE);
    if let Some(last) = b.steps.iter().max() {
        let end = last + (DEPTH / 2 - 1) * b.stride + (column_blocks - 1) * b.block + SIDE;
        assert!(end <= b.words.len(), "columns out of range");
    }
    let instructions = Instructions::start();
    let kept = if passes == 1 {
        1
    } else {
        row_blocks * column_blocks
    };
    with_scratch(kept * SIDE * SIDE, |sums| {
        for pass in 0..passes {
            let part = pass * PASS..steps.min((pass + 1) * PASS);
            for j in 0..column_blocks {
                for i in 0..row_blocks {
                    let rows =
                        |block: usize| a[((2 * i + block) * steps + part.start) * TILE..].as_ptr();
                    let at = if passes == 1 {
                        0
                    } else {
                        i * column_blocks + j
                    };
                    let sums = &mut sums[at * SIDE * SIDE..][..SIDE * SIDE];
                    let sums: &mut [f32; SIDE * SIDE] = sums.try_into().expect("32 x 32 sums");
                    // SAFETY: the ranges were checked above.
                    unsafe {
                        let words = b.words.as_ptr().add(j * b.block);
                        let tiles = if steps == 0 {
                            [a.as_ptr(); 2]
                        } else {
                            [rows(0), rows(1)]
                        };
                        let part = &b.steps[part.clone()];
                        instructions.multiply(tiles, words, part, b.stride, sums, pass == 0);
                    }
                    if pass + 1 == passes {
                        done((i * SIDE, j * SIDE), sums);
                    }
                }
            }
        }
    });
}

/// `y = x w^T + bias` for x [rows, inputs], w [outputs, inputs].
pub(crate) fn linear(
    LinearShape {
        rows,
        inputs,
        outputs,
    }: LinearShape,
    x: &[bf16],
    w: &[bf16],
    bias: Option<&[f32]>,
) -> Vec<bf16> {
    let (a, b) = (
        Matrix::rows(x, inputs),
        Matrix::rows(w, inputs).transposed(),
    );
    product_of_halves((rows, outputs, inputs), bias, a, b)
}

/// Gradient of [`linear`] with respect to x, for the gradient `g` of y.
pub(crate) fn linear_vjp_input(
    LinearShape {
        rows,
        inputs,
        outputs,
    }: LinearShape,
    g: &[bf16],
    w: &[bf16],
) -> Vec<bf16> {
    let (a, b) = (Matrix::rows(g, outputs), Matrix::rows(w, inputs));
    product_of_halves((rows, inputs, outputs), None, a, b)
}

/// `a b`, and a bias to every row.
fn product_of_halves(
    size: (usize, usize, usize),
    bias: Option<&[f32]>,
    a: Matrix<bf16>,
    b: Matrix<bf16>,
) -> Vec<bf16> {
    let mut out = Vec::with_capacity(size.0 * size.1);
    let sink = Halves {
        out: SharedHalves(out.as_mut_ptr()),
        row: size.1,
        bias,
    };
    // SAFETY: `out` has room for the rows and columns of the product, all of which are written.
    unsafe {
        product_into(size, sink, a, b, Threads::All);
        out.set_len(size.0 * size.1);
    }
    out
}

#[cfg(test)]
mod tests;
