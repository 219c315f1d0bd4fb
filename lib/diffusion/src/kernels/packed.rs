//! Matrix product of packed panels for AVX-512 [Goto & van de Geijn 2008]:
//! panels of B stay in L1, blocks of A in L2, and 14 x 32 sums in registers.
//!
//! Jobs are blocks of rows and columns fixed by the shape; each element of the
//! result is summed in one order whatever the number of threads.

use rayon::prelude::*;

use super::lanes::{LANES, gather_narrow};
use super::matmul::{Matrix, Onto, Threads};
use super::{SharedMut, with_scratch};

/// Rows of the register tile: 14 x 2 registers of sums, 2 of B, of 32.
const MR: usize = 14;
/// Columns of the register tile, two registers.
pub(super) const NR: usize = 32;
/// Depth of a panel at most: a panel of B takes 40 KiB of L1, while A and the
/// result stream by; 320, 640 and 1280 channels divide evenly.
const KC: usize = 320;
/// Rows of a block of A: 420 KiB, a part of L2.
const MC: usize = 24 * MR;
/// Columns of a packed block of B: 5 MiB.
const NC: usize = 128 * NR;
/// Columns of one job, where there are few rows.
const JOB_COLUMNS: usize = 16 * NR;
/// Blocks of rows from which on these alone are the jobs, so that each block
/// of A is packed only once.
const MANY_BLOCKS: usize = 8;
/// Below this many columns A is used once or twice: packing it does not pay.
const UNPACKED_COLUMNS: usize = 128;
/// Products below this many multiplications run on one thread.
const SMALL: usize = 1 << 18;

/// Whether this processor can run [`product`].
pub(super) fn available() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        is_x86_feature_detected!("avx512f")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

/// Depth of each pass over a product of depth `k`: even parts of at most KC.
fn depth_of_pass(k: usize) -> usize {
    k.div_ceil(k.div_ceil(KC).max(1)).max(1)
}

/// A whole right-hand matrix of k x n elements in panels, for products that
/// share it: all panels of one pass, then all of the next.
pub(crate) struct PackedColumns {
    panels: Vec<f32>,
    n: usize,
    k: usize,
}

impl PackedColumns {
    pub(super) fn new(b: Matrix, (k, n): (usize, usize)) -> Self {
        let width = n.div_ceil(NR) * NR;
        let mut panels = vec![0.0; width * k];
        let pass = depth_of_pass(k);
        for (index, target) in panels.chunks_mut((width * pass).max(1)).enumerate() {
            let first_depth = index * pass;
            pack_pass(b, (first_depth, pass.min(k - first_depth)), (0, n), target);
        }
        Self { panels, n, k }
    }
}

/// Packs `count` columns from `first`, `depth` deep, panel by panel.
fn pack_pass(
    b: Matrix,
    (first_depth, depth): (usize, usize),
    (first, count): (usize, usize),
    target: &mut [f32],
) {
    for (panel, target) in target.chunks_mut(NR * depth.max(1)).enumerate() {
        let (left, end) = (first + panel * NR, first + count);
        pack_columns(b, first_depth, depth, left, NR.min(end - left), target);
    }
}

/// Where a product goes, and how.
#[derive(Clone, Copy)]
struct Output<'a> {
    target: SharedMut,
    row: usize,
    onto: Onto<'a>,
    scale: f32,
}

/// `out = onto + scale * a b`.
///
/// # Safety
/// [`available`] is true; `out` is valid for writes of m rows of n elements
/// at stride `out_row` (and reads, if some of it is kept), used by nobody else
/// meanwhile; the views cover m x k and k x n elements, and a row added to all n.
pub(super) unsafe fn product(
    (m, n, k): (usize, usize, usize),
    out: *mut f32,
    out_row: usize,
    onto: Onto,
    scale: f32,
    a: Matrix,
    b: Matrix,
    threads: Threads,
) {
    if m == 0 || n == 0 {
        return;
    }
    let parallel = threads == Threads::All && m * n * k >= SMALL;
    let pass = depth_of_pass(k);
    for first_column in (0..n).step_by(NC) {
        let columns = NC.min(n - first_column);
        // An empty sum still has to write keep * out.
        for first_depth in (0..k.max(1)).step_by(pass) {
            let depth = pass.min(k - first_depth);
            let panels = columns.div_ceil(NR);
            with_scratch(panels * NR * KC, |packed_b| {
                let packed_b = &mut packed_b[..panels * NR * depth];
                if parallel {
                    let panel = NR * depth.max(1);
                    packed_b
                        .par_chunks_mut(panel)
                        .with_min_len(4)
                        .enumerate()
                        .for_each(|(index, target)| {
                            let left = first_column + index * NR;
                            pack_columns(b, first_depth, depth, left, NR.min(n - left), target);
                        });
                } else {
                    pack_pass(b, (first_depth, depth), (first_column, columns), packed_b);
                }
                let output = Output {
                    target: SharedMut(out.wrapping_add(first_column)),
                    row: out_row,
                    onto: match (first_depth, onto) {
                        (0, Onto::Row(row)) => Onto::Row(&row[first_column..]),
                        (0, onto) => onto,
                        _ => Onto::Kept(1.0),
                    },
                    scale,
                };
                let size = (m, columns, depth);
                // SAFETY: by the caller's contract.
                unsafe { one_pass(size, n, output, a, first_depth, packed_b, parallel) };
            });
        }
    }
}

/// [`product`] with a right-hand matrix that is packed already.
///
/// # Safety
/// As [`product`], for the n and k of `b`.
pub(super) unsafe fn product_packed(
    m: usize,
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
    a: Matrix,
    b: &PackedColumns,
    threads: Threads,
) {
    if m == 0 || b.n == 0 {
        return;
    }
    let parallel = threads == Threads::All && m * b.n * b.k >= SMALL;
    let (pass, width) = (depth_of_pass(b.k), b.n.div_ceil(NR) * NR);
    for first_depth in (0..b.k.max(1)).step_by(pass) {
        let depth = pass.min(b.k - first_depth);
        let output = Output {
            target: SharedMut(out),
            row: out_row,
            onto: Onto::Kept(if first_depth == 0 { keep } else { 1.0 }),
            scale,
        };
        let panels = &b.panels[width * first_depth..][..width * depth];
        // SAFETY: by the caller's contract.
        unsafe {
            one_pass(
                (m, b.n, depth),
                b.n,
                output,
                a,
                first_depth,
                panels,
                parallel,
            )
        };
    }
}

/// One pass over `columns` of the `n` columns, whose panels are packed.
///
/// # Safety
/// As [`product`].
unsafe fn one_pass(
    (m, columns, depth): (usize, usize, usize),
    n: usize,
    output: Output,
    a: Matrix,
    first_depth: usize,
    packed_b: &[f32],
    parallel: bool,
) {
    let row_jobs = m.div_ceil(MC);
    let job_columns = if row_jobs >= MANY_BLOCKS || !parallel {
        columns.next_multiple_of(NR)
    } else {
        JOB_COLUMNS
    };
    let column_jobs = columns.div_ceil(job_columns);
    let job = |job: usize| {
        let (first_row, first) = (job / column_jobs * MC, job % column_jobs * job_columns);
        let rows = MC.min(m - first_row);
        let block = Block {
            rows,
            columns: job_columns.min(columns - first),
            depth,
            onto: match output.onto {
                Onto::Row(row) => Onto::Row(&row[first..]),
                kept => kept,
            },
            scale: output.scale,
            out_row: output.row,
        };
        let packed_b = &packed_b[first * depth..];
        // SAFETY: the rows and columns of this job are its own.
        let out = unsafe { output.target.at(first_row * output.row + first) };
        if n <= UNPACKED_COLUMNS {
            let start = first_row * a.row + first_depth * a.column;
            let rest = Rows::Strided {
                data: &a.data[start.min(a.data.len())..],
                row: a.row,
                column: a.column,
            };
            // SAFETY: as above.
            unsafe { block.run(rest, packed_b, out) };
            return;
        }
        with_scratch(rows.div_ceil(MR) * MR * KC, |packed_a| {
            pack_rows(a, first_row, rows, first_depth, depth, packed_a);
            // SAFETY: as above.
            unsafe { block.run(Rows::Packed(packed_a), packed_b, out) };
        });
    };
    if parallel {
        (0..row_jobs * column_jobs).into_par_iter().for_each(job);
    } else {
        (0..row_jobs * column_jobs).for_each(job);
    }
}

/// A left side that many products share: its rows in panels.
pub(super) struct Left {
    panels: Vec<f32>,
    rows: usize,
    depth: usize,
}

impl Left {
    pub(super) fn new(a: Matrix, (rows, depth): (usize, usize)) -> Self {
        a.check(rows, depth);
        let mut panels = vec![0.0; rows.next_multiple_of(MR) * depth];
        pack_rows(a, 0, rows, 0, depth, &mut panels);
        Self {
            panels,
            rows,
            depth,
        }
    }

    /// `out = keep out + scale self b`, where b [depth, NR] and out [rows, NR] lie without gaps.
    pub(super) fn times_panel(&self, b: &[f32], out: &mut [f32], keep: f32, scale: f32) {
        assert!(available() && b.len() == self.depth * NR && out.len() == self.rows * NR);
        let block = Block {
            rows: self.rows,
            columns: NR,
            depth: self.depth,
            onto: Onto::Kept(keep),
            scale,
            out_row: NR,
        };
        // SAFETY: all sizes were checked.
        unsafe { block.run(Rows::Packed(&self.panels), b, out.as_mut_ptr()) };
    }
}

/// A right side that many products share: its columns in panels, of a depth of NR at most.
pub(super) struct Right {
    panels: Vec<f32>,
    columns: usize,
    depth: usize,
}

impl Right {
    pub(super) fn new(b: Matrix, (depth, columns): (usize, usize)) -> Self {
        b.check(depth, columns);
        assert!(depth <= NR, "deeper than a panel is wide");
        let mut panels = vec![0.0; columns.next_multiple_of(NR) * depth];
        pack_pass(b, (0, depth), (0, columns), &mut panels);
        Self {
            panels,
            columns,
            depth,
        }
    }

    /// `out += scale a self`, where the first `depth` of NR columns of a [rows, NR] count.
    ///
    /// # Safety
    /// `out` is valid for reads and writes of `rows` rows of `columns` elements, `out_row` apart, used by nobody else meanwhile.
    pub(super) unsafe fn after_rows(
        &self,
        a: &[f32],
        (rows, depth): (usize, usize),
        out: *mut f32,
        out_row: usize,
        scale: f32,
    ) {
        assert!(available() && depth == self.depth && a.len() == rows * NR);
        let block = Block {
            rows,
            columns: self.columns,
            depth,
            onto: Onto::Kept(1.0),
            scale,
            out_row,
        };
        with_scratch(rows.next_multiple_of(MR) * depth, |packed| {
            pack_rows(Matrix::rows(a, NR), 0, rows, 0, depth, packed);
            // SAFETY: by the caller's contract; the other sizes were checked.
            unsafe { block.run(Rows::Packed(packed), &self.panels, out) };
        });
    }
}

/// Packs `count` columns of B, `depth` deep: depth rows of NR elements.
fn pack_columns(
    b: Matrix,
    first_depth: usize,
    depth: usize,
    first: usize,
    count: usize,
    target: &mut [f32],
) {
    if count < NR {
        target.fill(0.0);
    }
    if b.column == 1 {
        for (p, target) in target.chunks_exact_mut(NR).enumerate().take(depth) {
            let start = (first_depth + p) * b.row + first;
            target[..count].copy_from_slice(&b.data[start..start + count]);
        }
        return;
    }
    for left in (0..count).step_by(LANES) {
        let columns = LANES.min(count - left);
        let start = (first + left) * b.column + first_depth * b.row;
        let (source, target) = (&b.data[start..], &mut target[left..]);
        if b.row == 1 && gather_narrow(source, b.column, columns, depth, target, NR) {
            continue;
        }
        for j in 0..columns {
            for p in 0..depth {
                target[p * NR + j] = source[j * b.column + p * b.row];
            }
        }
    }
}

/// Packs rows of A in panels of MR: for each panel depth columns of MR.
fn pack_rows(
    a: Matrix,
    first: usize,
    rows: usize,
    first_depth: usize,
    depth: usize,
    target: &mut [f32],
) {
    for (panel, target) in target
        .chunks_mut(MR * depth.max(1))
        .enumerate()
        .take(rows.div_ceil(MR))
    {
        let top = panel * MR;
        let count = MR.min(rows - top);
        if count < MR {
            target.fill(0.0);
        }
        if a.row == 1 {
            for p in 0..depth {
                let start = first + top + (first_depth + p) * a.column;
                target[p * MR..p * MR + count].copy_from_slice(&a.data[start..start + count]);
            }
            continue;
        }
        let start = (first + top) * a.row + first_depth * a.column;
        if a.column == 1 && gather_narrow(&a.data[start..], a.row, count, depth, target, MR) {
            continue;
        }
        for i in 0..count {
            let start = start + i * a.row;
            for p in 0..depth {
                target[p * MR + i] = a.data[start + p * a.column];
            }
        }
    }
}

/// Rows of A as a job reads them.
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
#[derive(Clone, Copy)]
enum Rows<'a> {
    /// Panels of MR rows, depth by depth.
    Packed(&'a [f32]),
    /// As they lie.
    Strided {
        data: &'a [f32],
        row: usize,
        column: usize,
    },
}

/// One job: a block of rows and columns over one depth.
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
struct Block<'a> {
    rows: usize,
    columns: usize,
    depth: usize,
    onto: Onto<'a>,
    scale: f32,
    out_row: usize,
}

impl Block<'_> {
    /// # Safety
    /// `out` is the block's first element, valid as [`product`] demands; A
    /// and the packed B cover the block; AVX-512 is there.
    unsafe fn run(&self, a: Rows, packed_b: &[f32], out: *mut f32) {
        for first in (0..self.columns).step_by(NR) {
            let b = &packed_b[first * self.depth..][..NR * self.depth];
            let columns = NR.min(self.columns - first);
            for top in (0..self.rows).step_by(MR) {
                let rows = MR.min(self.rows - top);
                // SAFETY: by the caller's contract.
                #[cfg(target_arch = "x86_64")]
                unsafe {
                    let (a, a_row, a_column, is_packed) = match a {
                        Rows::Packed(a) => (&a[top * self.depth..], 1, MR, true),
                        Rows::Strided { data, row, column } => {
                            (&data[top * row..], row, column, false)
                        }
                    };
                    let tile = match (is_packed, columns > 16) {
                        (true, true) => tile::<2, true>,
                        (true, false) => tile::<1, true>,
                        (false, true) => tile::<2, false>,
                        (false, false) => tile::<1, false>,
                    };
                    let (size, out) = ((rows, columns), out.add(top * self.out_row + first));
                    tile(a, a_row, a_column, b, self, first, size, out);
                }
                #[cfg(not(target_arch = "x86_64"))]
                let _ = (a, b, rows, columns, out);
            }
        }
    }
}

/// MR x 16 HALVES sums over the depth, of which `rows` x `columns` are stored.
/// A's element (i, p) is at `i * a_row + p * a_column`; where it is PACKED
/// these are 1 and MR. `first` is the tile's first column in the block.
///
/// # Safety
/// As [`Block::run`]; `b` holds `depth` rows of NR elements, `a` reaches to
/// its last row and depth.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn tile<const HALVES: usize, const PACKED: bool>(
    a: &[f32],
    a_row: usize,
    a_column: usize,
    b: &[f32],
    block: &Block,
    first: usize,
    (rows, columns): (usize, usize),
    out: *mut f32,
) {
    use std::arch::x86_64::*;
    let mut sums = [[_mm512_setzero_ps(); HALVES]; MR];
    let (a, b) = (a.as_ptr(), b.as_ptr());
    // SAFETY: rows past the last read the last one again, and are not stored;
    // masked loads and stores touch `rows` x `columns` elements of `out` only.
    unsafe {
        let starts: [*const f32; MR] = std::array::from_fn(|i| a.add(i.min(rows - 1) * a_row));
        // The lines that are written come from memory meanwhile, those of a panel are near.
        if block.out_row != NR {
            for i in 0..rows {
                let line = out.wrapping_add(i * block.out_row).cast();
                _mm_prefetch::<_MM_HINT_T0>(line);
                _mm_prefetch::<_MM_HINT_T0>(line.wrapping_add(64));
            }
        }
        for p in 0..block.depth {
            let row = b.add(p * NR);
            let panel: [__m512; HALVES] =
                std::array::from_fn(|half| _mm512_loadu_ps(row.add(16 * half)));
            for i in 0..MR {
                let element = if PACKED {
                    *a.add(p * MR + i)
                } else {
                    *starts[i].add(p * a_column)
                };
                let element = _mm512_set1_ps(element);
                for half in 0..HALVES {
                    sums[i][half] = _mm512_fmadd_ps(element, panel[half], sums[i][half]);
                }
            }
        }
        let mask = |count: usize| -> __mmask16 {
            if count >= 16 {
                0xffff
            } else {
                (1u16 << count) - 1
            }
        };
        // What is not kept may be anything, NaN too.
        let (kept, added) = match block.onto {
            Onto::Kept(keep) => (keep, None),
            Onto::Row(row) => (0.0, Some(row.as_ptr().add(first))),
        };
        let (keep, scale) = (_mm512_set1_ps(kept), _mm512_set1_ps(block.scale));
        for i in 0..MR {
            if i >= rows {
                break;
            }
            for half in 0..HALVES {
                let mask = mask(columns.saturating_sub(16 * half));
                let at = out.add(i * block.out_row).wrapping_add(16 * half);
                let mut value = _mm512_mul_ps(sums[i][half], scale);
                if let Some(row) = added {
                    let row = _mm512_maskz_loadu_ps(mask, row.wrapping_add(16 * half));
                    value = _mm512_add_ps(value, row);
                } else if kept != 0.0 {
                    let old = _mm512_maskz_loadu_ps(mask, at);
                    value = _mm512_fmadd_ps(old, keep, value);
                }
                _mm512_mask_storeu_ps(at, mask, value);
            }
        }
    }
}

#[cfg(test)]
mod tests;
