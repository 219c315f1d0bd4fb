//! Sixteen numbers that are treated alike: a vector register of AVX-512, two of AVX2. Kernels that work on sixteen
//! channels at once bring them side by side first, and apart at the end.

use std::ops::{Add, Mul, Sub};

use super::with_scratch;

/// Numbers of a lane.
pub(super) const LANES: usize = 16;

/// Sixteen numbers, one of each channel.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Lane(pub [f32; LANES]);

impl Lane {
    pub(super) const ZERO: Self = Self([0.0; LANES]);
}

impl Add for Lane {
    type Output = Self;

    #[inline(always)]
    fn add(mut self, other: Self) -> Self {
        for i in 0..LANES {
            self.0[i] += other.0[i];
        }
        self
    }
}

impl Sub for Lane {
    type Output = Self;

    #[inline(always)]
    fn sub(mut self, other: Self) -> Self {
        for i in 0..LANES {
            self.0[i] -= other.0[i];
        }
        self
    }
}

impl Mul<Lane> for f32 {
    type Output = Lane;

    #[inline(always)]
    fn mul(self, mut lane: Lane) -> Lane {
        for i in 0..LANES {
            lane.0[i] *= self;
        }
        lane
    }
}

/// Runs `f` on `len` lanes of unspecified content.
pub(super) fn with_lanes<R>(len: usize, f: impl FnOnce(&mut [Lane]) -> R) -> R {
    with_scratch(len * LANES, |floats| {
        // SAFETY: a lane is sixteen floats, and any bits are floats.
        let (before, lanes, _) = unsafe { floats.align_to_mut::<Lane>() };
        assert!(
            before.is_empty() && lanes.len() == len,
            "scratch is aligned for lanes"
        );
        f(lanes)
    })
}

/// Rows of `source`, `stride` apart, side by side: number r of `target[c]` is element c of row r; those of lanes past
/// `rows` are 0.
#[inline(always)]
pub(super) fn gather(source: &[f32], stride: usize, rows: usize, target: &mut [Lane]) {
    if target.is_empty() || rows == 0 {
        return target.fill(Lane::ZERO);
    }
    assert!(
        (rows - 1) * stride + target.len() <= source.len() && rows <= LANES,
        "rows out of range"
    );
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature is there, and all rows lie in `source`.
        return unsafe { avx512::gather(source, stride, rows, target) };
    }
    plain::gather(source, stride, rows, target);
}

/// As [`gather`], of `len` elements a row, into `len` groups, `width` apart, of `width` numbers, but 16 at most; what lies
/// between them stays. False, and nothing is done, where there are none or the processor has no AVX-512.
#[cfg_attr(not(target_arch = "x86_64"), allow(unused_variables))]
pub(super) fn gather_narrow(
    source: &[f32],
    stride: usize,
    rows: usize,
    len: usize,
    target: &mut [f32],
    width: usize,
) -> bool {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        if len == 0 || rows == 0 {
            return false;
        }
        let group = width.min(LANES);
        assert!(rows <= group && target.len() >= (len - 1) * width + group);
        assert!((rows - 1) * stride + len <= source.len());
        // SAFETY: the processor was asked, and the sizes were checked.
        unsafe { avx512::columns(source, stride, rows, len, target.as_mut_ptr(), width) };
        return true;
    }
    false
}

/// The reverse of [`gather`]: element c of row r of `target` is number r of `source[c]`.
///
/// # Safety
/// `target` is valid for writes of `rows` rows, at most 16, of `source.len()` elements, `stride` apart.
#[inline(always)]
pub(super) unsafe fn scatter(source: &[Lane], rows: usize, target: *mut f32, stride: usize) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature is there; the rest is the caller's contract.
        return unsafe { avx512::scatter(source, rows, target, stride) };
    }
    // SAFETY: by the caller's contract.
    unsafe { plain::scatter(source, rows, target, stride) };
}

/// For other processors. Never inlined: single numbers of lanes would make the compiler take all lanes apart.
mod plain {
    use super::Lane;

    #[inline(never)]
    pub(super) fn gather(source: &[f32], stride: usize, rows: usize, target: &mut [Lane]) {
        for (column, lane) in target.iter_mut().enumerate() {
            *lane = Lane::ZERO;
            for row in 0..rows {
                lane.0[row] = source[row * stride + column];
            }
        }
    }

    /// # Safety
    /// As [`super::scatter`].
    #[inline(never)]
    pub(super) unsafe fn scatter(source: &[Lane], rows: usize, target: *mut f32, stride: usize) {
        for row in 0..rows {
            for (column, lane) in source.iter().enumerate() {
                // SAFETY: by the caller's contract.
                unsafe { *target.add(row * stride + column) = lane.0[row] };
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use avx512::turn;

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::*;

    use super::{LANES, Lane};

    /// A bit for each of the first `count` numbers.
    fn first(count: usize) -> __mmask16 {
        if count >= LANES {
            0xffff
        } else {
            (1 << count) - 1
        }
    }

    /// Rows become columns: pairs, quadruples, then blocks of four by four.
    #[target_feature(enable = "avx512f")]
    #[inline]
    fn transposed(r: [__m512; LANES]) -> [__m512; LANES] {
        let mut s = r;
        for i in 0..LANES / 2 {
            s[2 * i] = _mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]);
            s[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]);
        }
        // Element q of each quarter of t[4 i + q] is column 4 * quarter + q of rows 4 i .. 4 i + 4.
        let mut t = s;
        for i in 0..LANES / 4 {
            let pairs: [__m512d; 4] = std::array::from_fn(|j| _mm512_castps_pd(s[4 * i + j]));
            t[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(pairs[0], pairs[2]));
            t[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(pairs[0], pairs[2]));
            t[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(pairs[1], pairs[3]));
            t[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(pairs[1], pairs[3]));
        }
        let mut out = t;
        for q in 0..4 {
            let even_low = _mm512_shuffle_f32x4::<0x88>(t[q], t[4 + q]);
            let odd_low = _mm512_shuffle_f32x4::<0xdd>(t[q], t[4 + q]);
            let even_high = _mm512_shuffle_f32x4::<0x88>(t[8 + q], t[12 + q]);
            let odd_high = _mm512_shuffle_f32x4::<0xdd>(t[8 + q], t[12 + q]);
            out[q] = _mm512_shuffle_f32x4::<0x88>(even_low, even_high);
            out[4 + q] = _mm512_shuffle_f32x4::<0x88>(odd_low, odd_high);
            out[8 + q] = _mm512_shuffle_f32x4::<0xdd>(even_low, even_high);
            out[12 + q] = _mm512_shuffle_f32x4::<0xdd>(odd_low, odd_high);
        }
        out
    }

    /// Sixteen rows of sixteen words become columns. No arithmetic is done: any bits will do.
    ///
    /// # Safety
    /// The processor has AVX-512; both are valid for 16 rows of 16 words, `stride` and `target_stride` apart.
    #[target_feature(enable = "avx512f")]
    pub(in crate::kernels) unsafe fn turn(
        source: *const f32,
        stride: usize,
        target: *mut f32,
        target_stride: usize,
    ) {
        // SAFETY: by the caller's contract.
        unsafe {
            let rows = std::array::from_fn(|row| _mm512_loadu_ps(source.add(row * stride)));
            for (row, column) in transposed(rows).into_iter().enumerate() {
                _mm512_storeu_ps(target.add(row * target_stride), column);
            }
        }
    }

    /// # Safety
    /// `source` holds `rows` rows of `target.len()` elements, `stride` apart.
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn gather(source: &[f32], stride: usize, rows: usize, target: &mut [Lane]) {
        for (block, target) in target.chunks_mut(LANES).enumerate() {
            let start = source.as_ptr().wrapping_add(block * LANES);
            // SAFETY: the rows hold as many elements more as `target` has lanes.
            let columns = unsafe { block_of(start, stride, rows, target.len()) };
            for (lane, column) in target.iter_mut().zip(columns) {
                // SAFETY: a lane is sixteen floats.
                unsafe { _mm512_store_ps(lane.0.as_mut_ptr(), column) };
            }
        }
    }

    /// The first 16 columns of `rows` rows, at most 16, of `len` elements; 0 past them.
    ///
    /// # Safety
    /// The elements can be read.
    #[target_feature(enable = "avx512f")]
    #[inline]
    unsafe fn block_of(
        start: *const f32,
        stride: usize,
        rows: usize,
        len: usize,
    ) -> [__m512; LANES] {
        let mask = first(len);
        transposed(std::array::from_fn(|row| {
            let mask = if row < rows { mask } else { 0 };
            // SAFETY: reads the elements under the mask alone.
            unsafe { _mm512_maskz_loadu_ps(mask, start.wrapping_add(row * stride)) }
        }))
    }

    /// Element c of row r goes to `r + c width` of `target`; 0 where r is at least `rows`, up to 16 and below `width`.
    ///
    /// # Safety
    /// `source` holds `rows` rows of `len` elements, `stride` apart; `target` is valid for writes of `len` groups of `width`
    /// elements, but 16 at most, `width` apart.
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn columns(
        source: &[f32],
        stride: usize,
        rows: usize,
        len: usize,
        target: *mut f32,
        width: usize,
    ) {
        let end = (len - 1) * width + width.min(LANES);
        for left in (0..len).step_by(LANES) {
            let start = source.as_ptr().wrapping_add(left);
            // SAFETY: the rows hold `len - left` elements more.
            let columns = unsafe { block_of(start, stride, rows, len - left) };
            let to = target.wrapping_add(left * width);
            if (left + LANES - 1) * width + LANES <= end {
                for (number, column) in columns.into_iter().enumerate() {
                    // SAFETY: inside of the target; what lies past a column's width is written again by the next one.
                    unsafe { _mm512_storeu_ps(to.wrapping_add(number * width), column) };
                }
                continue;
            }
            for (number, column) in columns.into_iter().enumerate().take(len - left) {
                let mask = first(end - (left + number) * width);
                // SAFETY: as above; nothing is written past the last column.
                unsafe { _mm512_mask_storeu_ps(to.wrapping_add(number * width), mask, column) };
            }
        }
    }

    /// # Safety
    /// As [`super::scatter`].
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn scatter(source: &[Lane], rows: usize, target: *mut f32, stride: usize) {
        for (block, source) in source.chunks(LANES).enumerate() {
            let mask = first(source.len());
            let columns = std::array::from_fn(|column| {
                let lane = &source[column.min(source.len() - 1)];
                // SAFETY: a lane is sixteen floats.
                unsafe { _mm512_load_ps(lane.0.as_ptr()) }
            });
            let start = target.wrapping_add(block * LANES);
            for (row, values) in transposed(columns).into_iter().enumerate().take(rows) {
                // SAFETY: writes the elements under the mask alone, which the caller allows.
                unsafe { _mm512_mask_storeu_ps(start.wrapping_add(row * stride), mask, values) };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Gather = fn(&[f32], usize, usize, &mut [Lane]);
    type Scatter = unsafe fn(&[Lane], usize, *mut f32, usize);

    #[test]
    fn rows_come_side_by_side_and_go_back() {
        assert_rows(gather, scatter);
        assert_rows(plain::gather, plain::scatter);
    }

    #[test]
    fn narrow_groups_hold_what_lanes_do() {
        let source: Vec<f32> = (0..16 * 50).map(|i| i as f32 + 1.0).collect();
        for (rows, columns, width) in [
            (14, 50, 14),
            (14, 16, 14),
            (3, 1, 5),
            (16, 33, 16),
            (1, 17, 1),
            (16, 35, 32),
            (7, 18, 20),
        ] {
            let mut lanes = vec![Lane::ZERO; columns];
            gather(&source, 50, rows, &mut lanes);
            // One number more, which stays.
            let mut target = vec![-1.0; columns * width + 1];
            if !gather_narrow(&source, 50, rows, columns, &mut target, width) {
                assert_eq!(target[0], -1.0);
                continue;
            }
            let group = width.min(LANES);
            for (target, lane) in target.chunks_exact(width).zip(&lanes) {
                let (own, between) = target.split_at(group);
                assert_eq!(own, &lane.0[..group], "{rows} x {columns} in {width}");
                assert!(between.iter().all(|v| *v == -1.0));
            }
            assert_eq!(target[columns * width], -1.0);
        }
    }

    fn assert_rows(gather: Gather, scatter: Scatter) {
        let source: Vec<f32> = (0..16 * 50).map(|i| i as f32 + 1.0).collect();
        for (rows, columns) in [
            (16, 16),
            (16, 50),
            (1, 1),
            (5, 3),
            (16, 9),
            (11, 33),
            (3, 16),
        ] {
            let mut lanes = vec![Lane([f32::NAN; LANES]); columns];
            gather(&source, 50, rows, &mut lanes);
            for (column, lane) in lanes.iter().enumerate() {
                for row in 0..LANES {
                    let wanted = if row < rows {
                        source[row * 50 + column]
                    } else {
                        0.0
                    };
                    assert_eq!(lane.0[row], wanted, "{rows} x {columns}: {row}, {column}");
                }
            }
            let mut target = vec![0.0; 16 * 50];
            // SAFETY: 16 rows of 50.
            unsafe { scatter(&lanes, rows, target.as_mut_ptr(), 50) };
            for (i, value) in target.iter().enumerate() {
                let inside = i / 50 < rows && i % 50 < columns;
                assert_eq!(
                    *value,
                    if inside { source[i] } else { 0.0 },
                    "{rows} x {columns}: {i}"
                );
            }
        }
    }
}
