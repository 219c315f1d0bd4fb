//! Numbers on their way into and out of tiles.

use half::bf16;

use super::micro::{DEPTH, ROWS, SIDE};
use crate::kernels::simd::vectorized;

/// A number that is multiplied in bf16.
pub(crate) trait Element: Copy + Send + Sync {
    /// The bits of the nearest bf16, ties to even.
    fn bits(self) -> u16;

    /// [`Element::bits`] of all of `source`; both are equally long.
    fn round_to(source: &[Self], target: &mut [u16]);
}

impl Element for bf16 {
    fn bits(self) -> u16 {
        self.to_bits()
    }

    fn round_to(source: &[Self], target: &mut [u16]) {
        // SAFETY: a bf16 is its bits.
        let bits = unsafe { std::slice::from_raw_parts(source.as_ptr().cast(), source.len()) };
        target.copy_from_slice(bits);
    }
}

impl Element for f32 {
    fn bits(self) -> u16 {
        round(self)
    }

    fn round_to(source: &[Self], target: &mut [u16]) {
        round_all(source, target);
    }
}

/// The nearest bf16; NaN stays NaN.
#[inline(always)]
fn round(value: f32) -> u16 {
    let bits = value.to_bits();
    let nearest = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    let quiet = bits >> 16 | 0x40;
    (if value.is_nan() { quiet } else { nearest }) as u16
}

vectorized! {
    /// Of all of `source`, into as many of `target`.
    pub(crate) fn round_all(source: &[f32], target: &mut [u16]) {
        for (target, &value) in target.iter_mut().zip(source) {
            *target = round(value);
        }
    }
}

/// Turns 16 rows of 32 bf16 into 16 rows of 16 pairs, `stride` words apart: pair (p, j) is elements 2 p and 2 p + 1 of row j.
pub(super) fn transpose(tile: &[u16; ROWS * DEPTH], target: &mut [u32], stride: usize) {
    assert!(target.len() >= 15 * stride + 16);
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature is there, the tile is 16 rows of 16 words, and the target was measured.
        unsafe {
            let source = tile.as_ptr().cast();
            crate::kernels::lanes::turn(source, ROWS, target.as_mut_ptr().cast(), stride);
        }
        return;
    }
    for (j, row) in tile.chunks_exact(DEPTH).enumerate() {
        for (p, pair) in row.chunks_exact(2).enumerate() {
            target[p * stride + j] = pair[0] as u32 | (pair[1] as u32) << 16;
        }
    }
}

/// The reverse: 16 rows of 16 pairs into 16 rows of 32 bf16.
pub(super) fn transpose_words(words: &[u32; ROWS * ROWS], tile: &mut [u16]) {
    assert!(tile.len() == ROWS * DEPTH);
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature is there; both are 16 rows of 16 words.
        unsafe {
            let target = tile.as_mut_ptr().cast();
            crate::kernels::lanes::turn(words.as_ptr().cast(), ROWS, target, ROWS);
        }
        return;
    }
    for (j, row) in tile.chunks_exact_mut(DEPTH).enumerate() {
        for (p, pair) in row.chunks_exact_mut(2).enumerate() {
            let word = words[p * ROWS + j];
            pair.copy_from_slice(&[word as u16, (word >> 16) as u16]);
        }
    }
}

/// `out = keep * out + scale * sums` of the first rows and columns.
///
/// # Safety
/// `out` is valid for writes of `rows` rows of `columns` elements at stride `out_row`, and for reads if `keep` is not 0.
pub(super) unsafe fn deposit(
    sums: &[f32; SIDE * SIDE],
    (rows, columns): (usize, usize),
    out: *mut f32,
    out_row: usize,
    keep: f32,
    scale: f32,
) {
    for (i, sums) in sums.chunks_exact(SIDE).enumerate().take(rows) {
        // SAFETY: by the caller's contract; what is not kept is only written.
        let out = unsafe {
            let out = out.add(i * out_row);
            if keep == 0.0 {
                out.write_bytes(0, columns);
            }
            std::slice::from_raw_parts_mut(out, columns)
        };
        place(sums, out, keep, scale);
    }
}

vectorized! {
    fn place(sums: &[f32], out: &mut [f32], keep: f32, scale: f32) {
        for (out, &sum) in out.iter_mut().zip(sums) {
            *out = keep * *out + scale * sum;
        }
    }
}
