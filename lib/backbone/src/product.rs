//! Products of matrices.
use gemm::{Parallelism, gemm};

/// `out = keep * out + a b` on one thread, `a` of `m x k`, `b` of `k x n`; a matrix is its values, row stride and column
/// stride.
///
/// # Panics
/// If a matrix has fewer values than its size and its strides need.
pub fn product(
    (m, n, k): (usize, usize, usize),
    a: (&[f32], usize, usize),
    b: (&[f32], usize, usize),
    out: &mut [f32],
    keep: bool,
) {
    let holds = |(values, row, column): (&[f32], usize, usize), rows: usize, columns: usize| {
        rows == 0 || columns == 0 || (rows - 1) * row + (columns - 1) * column < values.len()
    };
    assert!(out.len() >= m * n && holds(a, m, k) && holds(b, k, n));
    // SAFETY: the last element of each matrix is one of its values, see above; `out` is borrowed alone.
    unsafe {
        gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            keep,
            a.0.as_ptr(),
            a.2 as isize,
            a.1 as isize,
            b.0.as_ptr(),
            b.2 as isize,
            b.1 as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::product;

    #[test]
    fn a_transposed_matrix_is_added_to_what_is_kept() {
        // [1 2; 3 4] times the transpose of [5 6; 7 8].
        let (a, b) = ([1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]);
        let mut out = [1.0; 4];
        product((2, 2, 2), (&a, 2, 1), (&b, 1, 2), &mut out, true);
        assert_eq!(out, [18.0, 24.0, 40.0, 54.0]);
    }

    #[test]
    #[should_panic]
    fn strides_beyond_the_values_are_refused() {
        product(
            (2, 2, 2),
            (&[0.0; 4], 3, 1),
            (&[0.0; 4], 2, 1),
            &mut [0.0; 4],
            false,
        );
    }
}
