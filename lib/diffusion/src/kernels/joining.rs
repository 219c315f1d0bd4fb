//! Sums, and images to tokens and back.

use super::filled;
use super::lanes::{LANES, gather, with_lanes};
use super::simd::{sum_of, vectorized};

/// Elements of one job: 64 KiB, small beside L2 and large beside a wake-up.
const JOB: usize = 16 * 1024;
/// Rows of a result of [`transposed`] that one job writes.
const ROWS: usize = 64;

vectorized! {
    fn sums(x: &[f32], y: &[f32], z: &mut [f32]) {
        z.iter_mut().zip(x.iter().zip(y)).for_each(|(z, (x, y))| *z = x + y);
    }
}

vectorized! {
    fn shifted(x: &[f32], by: f32, y: &mut [f32]) {
        y.iter_mut().zip(x).for_each(|(y, x)| *y = x + by);
    }
}

vectorized! {
    fn sum(x: &[f32]) -> f64 {
        sum_of(x, |v| v)
    }
}

/// x + y, elementwise.
pub(crate) fn add(x: &[f32], y: &[f32]) -> Vec<f32> {
    assert_eq!(x.len(), y.len(), "as many numbers of both");
    let job = |job: usize, z: &mut [f32]| {
        let [x, y] = [x, y].map(|values| &values[job * JOB..][..z.len()]);
        sums(x, y, z);
    };
    filled(x.len(), JOB, 1, job).0
}

/// Each row of `width` numbers of `x` plus its number of `by`.
pub(crate) fn add_to_rows(x: &[f32], by: &[f32], width: usize) -> Vec<f32> {
    let job = |row: usize, y: &mut [f32]| shifted(&x[row * width..][..width], by[row], y);
    filled(x.len(), width, (JOB / width.max(1)).max(1), job).0
}

/// The sum of each row of `width` numbers.
pub(crate) fn row_sums(x: &[f32], width: usize) -> Vec<f32> {
    x.chunks_exact(width).map(|row| sum(row) as f32).collect()
}

/// Every matrix [rows, columns] of `x` transposed, plus `onto` of the result's shape.
pub(crate) fn transposed(
    x: &[f32],
    (rows, columns): (usize, usize),
    onto: Option<&[f32]>,
) -> Vec<f32> {
    // Rows of the result, all of one matrix.
    let step = match columns.is_multiple_of(ROWS) {
        true => ROWS,
        false => columns,
    };
    let job = |job: usize, y: &mut [f32]| {
        let (matrix, first) = (job * step / columns, job * step % columns);
        let onto = onto.map(|onto| &onto[job * step * rows..]);
        with_lanes(step, |lanes| {
            for top in (0..rows).step_by(LANES) {
                let count = LANES.min(rows - top);
                let start = (matrix * rows + top) * columns + first;
                gather(&x[start..], columns, count, lanes);
                for (row, lane) in lanes.iter().enumerate() {
                    let at = row * rows + top;
                    let (y, lane) = (&mut y[at..at + count], &lane.0[..count]);
                    match onto {
                        Some(onto) => sums(lane, &onto[at..at + count], y),
                        None => y.copy_from_slice(lane),
                    }
                }
            }
        });
    };
    filled(x.len(), step * rows, 1, job).0
}
