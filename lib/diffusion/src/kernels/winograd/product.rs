//! Products of lanes: what the points of all tiles are multiplied with.

use super::super::lanes::{LANES, Lane};

/// Rows of sums that are held in registers.
pub(super) const ROWS: usize = 8;

/// Left-hand elements: number k of row r lies at `k / 16 * jump + r * ROW + k % 16 * NEXT`, in floats.
#[derive(Clone, Copy)]
pub(super) struct Left<const ROW: usize, const NEXT: usize> {
    pub data: *const f32,
    pub jump: usize,
}

/// `out[r * out_row + h * out_half] = keep * itself + sum over k of left(r, k) right[h * half + k]` for 8 rows, H lanes
/// and k below `16 * groups`; strides in lanes.
///
/// # Safety
/// All elements above lie inside their slices; nobody else uses those of `out` meanwhile.
#[inline(always)]
pub(super) unsafe fn multiply<const H: usize, const ROW: usize, const NEXT: usize>(
    groups: usize,
    left: Left<ROW, NEXT>,
    (right, half): (*const Lane, usize),
    (out, out_row, out_half): (*mut Lane, usize, usize),
    keep: bool,
) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature is there; the rest is the caller's contract.
        return unsafe {
            multiply_avx512::<H, ROW, NEXT>(
                groups,
                left,
                (right, half),
                (out, out_row, out_half),
                keep,
            )
        };
    }
    // SAFETY: by the caller's contract.
    unsafe {
        multiply_plain::<H, ROW, NEXT>(groups, left, (right, half), (out, out_row, out_half), keep)
    }
}

/// # Safety
/// As [`multiply`].
#[inline(always)]
unsafe fn multiply_plain<const H: usize, const ROW: usize, const NEXT: usize>(
    groups: usize,
    left: Left<ROW, NEXT>,
    (right, half): (*const Lane, usize),
    (out, out_row, out_half): (*mut Lane, usize, usize),
    keep: bool,
) {
    // Few enough sums for the sixteen registers of AVX2.
    const FEW: usize = 4;
    for (first, h) in (0..ROWS)
        .step_by(FEW)
        .flat_map(|first| (0..H).map(move |h| (first, h)))
    {
        let mut sums = [Lane::ZERO; FEW];
        for k in 0..groups * LANES {
            // SAFETY: by the caller's contract.
            unsafe {
                let right = *right.add(h * half + k);
                let left = left.data.add(k / LANES * left.jump + k % LANES * NEXT);
                for (r, sum) in sums.iter_mut().enumerate() {
                    *sum = *sum + *left.add((first + r) * ROW) * right;
                }
            }
        }
        for (r, &sum) in sums.iter().enumerate() {
            // SAFETY: by the caller's contract.
            unsafe {
                let out = out.add((first + r) * out_row + h * out_half);
                *out = if keep { *out + sum } else { sum };
            }
        }
    }
}

/// # Safety
/// As [`multiply`]; the processor has AVX-512.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn multiply_avx512<const H: usize, const ROW: usize, const NEXT: usize>(
    groups: usize,
    left: Left<ROW, NEXT>,
    (right, half): (*const Lane, usize),
    (out, out_row, out_half): (*mut Lane, usize, usize),
    keep: bool,
) {
    use std::arch::x86_64::*;
    let mut sums = [[_mm512_setzero_ps(); H]; ROWS];
    for group in 0..groups {
        let (left, right) = (
            left.data.wrapping_add(group * left.jump),
            right.wrapping_add(group * LANES),
        );
        for k in 0..LANES {
            // SAFETY: by the caller's contract.
            unsafe {
                let right: [__m512; H] =
                    std::array::from_fn(|h| _mm512_load_ps(right.add(h * half + k).cast::<f32>()));
                for r in 0..ROWS {
                    let element = _mm512_set1_ps(*left.add(r * ROW + k * NEXT));
                    for h in 0..H {
                        sums[r][h] = _mm512_fmadd_ps(element, right[h], sums[r][h]);
                    }
                }
            }
        }
    }
    for r in 0..ROWS {
        for h in 0..H {
            // SAFETY: by the caller's contract.
            unsafe {
                let out = out.add(r * out_row + h * out_half).cast::<f32>();
                let sum = sums[r][h];
                let sum = if keep {
                    _mm512_add_ps(_mm512_load_ps(out), sum)
                } else {
                    sum
                };
                _mm512_store_ps(out, sum);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Multiply =
        unsafe fn(usize, Left<LANES, 1>, (*const Lane, usize), (*mut Lane, usize, usize), bool);

    /// Both halves of 8 rows over 3 groups, added to what is there.
    fn assert_products(multiply: Multiply) {
        let lanes = |count: usize, seed: f32| -> Vec<Lane> {
            let number = |i: usize| ((i as f32 + seed) * 0.37).sin();
            (0..count)
                .map(|k| Lane(std::array::from_fn(|i| number(k * LANES + i))))
                .collect()
        };
        let (left, right, mut out) = (
            lanes(3 * ROWS, 1.0),
            lanes(2 * 3 * LANES, 2.0),
            lanes(2 * ROWS, 3.0),
        );
        let elements = Left {
            data: left.as_ptr().cast(),
            jump: ROWS * LANES,
        };
        // SAFETY: 3 groups of 8 rows of 16 elements, two halves of 48 lanes, two of 8 rows of sums.
        unsafe {
            multiply(
                3,
                elements,
                (right.as_ptr(), 3 * LANES),
                (out.as_mut_ptr(), 1, ROWS),
                true,
            )
        };
        let before = lanes(2 * ROWS, 3.0);
        for (place, (out, before)) in out.iter().zip(before).enumerate() {
            let (half, row) = (place / ROWS, place % ROWS);
            for i in 0..LANES {
                let term = |k: usize| {
                    let element = left[k / LANES * ROWS + row].0[k % LANES] as f64;
                    element * right[half * 3 * LANES + k].0[i] as f64
                };
                let exact = before.0[i] as f64 + (0..3 * LANES).map(term).sum::<f64>();
                // 49 additions of terms below 1.
                assert!(
                    (out.0[i] as f64 - exact).abs() < 49.0 * 49.0 * f32::EPSILON as f64,
                    "{place}: {i}"
                );
            }
        }
    }

    #[test]
    fn products_are_sums_with_and_without_wide_registers() {
        assert_products(multiply::<2, LANES, 1>);
        assert_products(multiply_plain::<2, LANES, 1>);
    }
}
