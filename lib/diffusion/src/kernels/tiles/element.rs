//! Numbers on their way into and out of tiles.

use half::bf16;

use super::micro::{DEPTH, ROWS, SIDE};
use super::with_halves;
use crate::kernels::SharedMut;
use crate::kernels::simd::vectorized;

/// A number that is multiplied in bf16.
pub(crate) trait Element: Copy + Send + Sync {
    /// The bits of the nearest bf16, ties to even.
    fn bits(self) -> u16;

    /// [`Element::bits`] of all of `source`; both are equally long.
    fn round_to(source: &[Self], target: &mut [u16]);

    /// Fills `steps` tiles, one behind the other, with `count` rows of `source`, `stride` apart, as deep as they are.
    fn fill_tiles(source: &[Self], stride: usize, count: usize, steps: usize, target: &mut [u16]);

    /// Pairs of two rows, as long as `target`.
    fn pair(low: &[Self], high: &[Self], target: &mut [u32]);
}

impl Element for bf16 {
    fn bits(self) -> u16 {
        self.to_bits()
    }

    fn round_to(source: &[Self], target: &mut [u16]) {
        target.copy_from_slice(bits_of(source));
    }

    fn fill_tiles(source: &[Self], stride: usize, count: usize, steps: usize, target: &mut [u16]) {
        fill_tiles_of_halves(bits_of(source), stride, count, steps, target);
    }

    fn pair(low: &[Self], high: &[Self], target: &mut [u32]) {
        pair_of_halves(bits_of(low), bits_of(high), target);
    }
}

impl Element for f32 {
    fn bits(self) -> u16 {
        round(self)
    }

    fn round_to(source: &[Self], target: &mut [u16]) {
        round_all(source, target);
    }

    fn fill_tiles(source: &[Self], stride: usize, count: usize, steps: usize, target: &mut [u16]) {
        fill_tiles_of_floats(source, stride, count, steps, target);
    }

    fn pair(low: &[Self], high: &[Self], target: &mut [u32]) {
        pair_of_floats(low, high, target);
    }
}

pub(super) fn bits_of(values: &[bf16]) -> &[u16] {
    // SAFETY: a bf16 is its bits.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), values.len()) }
}

vectorized! {
    fn fill_tiles_of_halves(source: &[u16], stride: usize, count: usize, steps: usize, target: &mut [u16]) {
        for row in 0..count {
            let source = source[row * stride..][..steps * DEPTH].chunks_exact(DEPTH);
            for (source, tile) in source.zip(target.chunks_exact_mut(ROWS * DEPTH)) {
                tile[row * DEPTH..][..DEPTH].copy_from_slice(&source[..DEPTH]);
            }
        }
    }
}

vectorized! {
    fn fill_tiles_of_floats(source: &[f32], stride: usize, count: usize, steps: usize, target: &mut [u16]) {
        for row in 0..count {
            let source = source[row * stride..][..steps * DEPTH].chunks_exact(DEPTH);
            for (source, tile) in source.zip(target.chunks_exact_mut(ROWS * DEPTH)) {
                let tile = &mut tile[row * DEPTH..][..DEPTH];
                for i in 0..DEPTH {
                    tile[i] = round(source[i]);
                }
            }
        }
    }
}

vectorized! {
    fn pair_of_halves(low: &[u16], high: &[u16], target: &mut [u32]) {
        for (word, (&low, &high)) in target.iter_mut().zip(low.iter().zip(high)) {
            *word = low as u32 | (high as u32) << 16;
        }
    }
}

vectorized! {
    fn pair_of_floats(low: &[f32], high: &[f32], target: &mut [u32]) {
        for (word, (&low, &high)) in target.iter_mut().zip(low.iter().zip(high)) {
            *word = round(low) as u32 | (round(high) as u32) << 16;
        }
    }
}

/// The nearest bf16; NaN stays NaN.
#[inline(always)]
pub(crate) fn round(value: f32) -> u16 {
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

/// Rows of a block as columns.
pub(super) fn turn_floats(sums: &[f32; SIDE * SIDE]) -> [f32; SIDE * SIDE] {
    let mut turned = [0.0; SIDE * SIDE];
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let source = sums[i * ROWS * SIDE + j * ROWS..].as_ptr();
            let target = turned[j * ROWS * SIDE + i * ROWS..].as_mut_ptr();
            // SAFETY: the feature is there; both are quarters, 16 rows of 16 numbers, of a block.
            unsafe { crate::kernels::lanes::turn(source, SIDE, target, SIDE) };
        }
        return turned;
    }
    for (i, row) in sums.chunks_exact(SIDE).enumerate() {
        for (j, &value) in row.iter().enumerate() {
            turned[j * SIDE + i] = value;
        }
    }
    turned
}

/// Gets row and column of a block, and its sums.
pub(super) type Take<'a> = &'a mut dyn FnMut((usize, usize), &[f32; SIDE * SIDE]);

/// Where sums go.
pub(super) trait Sink: Copy + Send + Sync {
    /// Takes all blocks of a job, `size` from `first`, that `run` makes.
    ///
    /// # Safety
    /// The job lies in the result, and nobody else uses that part meanwhile.
    unsafe fn job(self, first: (usize, usize), size: (usize, usize), run: impl FnOnce(Take));
}

/// What a block has of `size`.
fn part((rows, columns): (usize, usize), (i, j): (usize, usize)) -> (usize, usize) {
    (SIDE.min(rows - i), SIDE.min(columns - j))
}

/// `out = keep * out + scale * sums`, rows `row` apart.
#[derive(Clone, Copy)]
pub(super) struct Floats {
    pub out: SharedMut,
    pub row: usize,
    pub keep: f32,
    pub scale: f32,
}

impl Sink for Floats {
    unsafe fn job(self, (top, left): (usize, usize), size: (usize, usize), run: impl FnOnce(Take)) {
        run(&mut |(i, j), sums| {
            // SAFETY: by the caller's contract.
            let out = unsafe { self.out.at((top + i) * self.row + left + j) };
            place(
                sums,
                out,
                self.row,
                part(size, (i, j)),
                self.keep,
                self.scale,
            );
        });
    }
}

/// `out = sums + bias` of each column, rounded to bf16; rows follow one another.
#[derive(Clone, Copy)]
pub(super) struct Halves<'a> {
    pub out: SharedHalves,
    pub row: usize,
    pub bias: Option<&'a [f32]>,
}

/// A pointer that may cross threads: every user writes disjoint elements.
#[derive(Clone, Copy)]
pub(super) struct SharedHalves(pub *mut bf16);

// SAFETY: jobs write disjoint ranges.
unsafe impl Send for SharedHalves {}
// SAFETY: as above.
unsafe impl Sync for SharedHalves {}

impl SharedHalves {
    /// The pointer to element `offset`.
    ///
    /// # Safety
    /// `offset` lies inside of what the pointer was made from.
    pub(super) unsafe fn at(self, offset: usize) -> *mut u16 {
        // SAFETY: by the caller's contract.
        unsafe { self.0.add(offset).cast() }
    }
}

impl Sink for Halves<'_> {
    unsafe fn job(
        self,
        (top, left): (usize, usize),
        (rows, columns): (usize, usize),
        run: impl FnOnce(Take),
    ) {
        // Blocks meet in the cache: whole rows of the job are then written at once, not 64 bytes in every page.
        with_halves(rows * columns, |all| {
            let first = all.as_mut_ptr();
            run(&mut |(i, j), sums| {
                let (_, count) = part((rows, columns), (i, j));
                let mut bias = [0.0; SIDE];
                if let Some(all) = self.bias {
                    bias[..count].copy_from_slice(&all[left + j..left + j + count]);
                }
                let out = first.wrapping_add(i * columns + j);
                place_halves(sums, &bias, out, columns, part((rows, columns), (i, j)));
            });
            for (i, row) in all.chunks_exact(columns).enumerate() {
                // SAFETY: by the caller's contract.
                unsafe {
                    let out = self.out.at((top + i) * self.row + left);
                    out.copy_from_nonoverlapping(row.as_ptr(), columns);
                }
            }
        });
    }
}

vectorized! {
    /// `out = keep * out + scale * sums`, of the first rows and columns. `out` can be written, and read unless `keep` is 0.
    fn place(sums: &[f32; SIDE * SIDE], out: *mut f32, stride: usize, size: (usize, usize), keep: f32, scale: f32) {
        for (i, sums) in sums.chunks_exact(SIDE).enumerate().take(size.0) {
            let out = out.wrapping_add(i * stride);
            for (j, &sum) in sums.iter().enumerate().take(size.1) {
                let out = out.wrapping_add(j);
                // SAFETY: the element is one of those that can be written; what is not kept is not read.
                unsafe {
                    let kept = if keep == 0.0 { 0.0 } else { keep * *out };
                    *out = kept + scale * sum;
                }
            }
        }
    }
}

vectorized! {
    /// The sums and a bias for each column, rounded, of the first rows and columns. `out` can be written.
    fn place_halves(sums: &[f32; SIDE * SIDE], bias: &[f32; SIDE], out: *mut u16, stride: usize, size: (usize, usize)) {
        for (i, sums) in sums.chunks_exact(SIDE).enumerate().take(size.0) {
            let out = out.wrapping_add(i * stride);
            let mut row = [0u16; SIDE];
            for j in 0..SIDE {
                row[j] = round(sums[j] + bias[j]);
            }
            // SAFETY: these elements can be written.
            unsafe { out.copy_from_nonoverlapping(row.as_ptr(), size.1) };
        }
    }
}

vectorized! {
    /// The sums of a row of outputs, up to 32, plus one number, rounded. As many elements of `out` can be written.
    pub(super) fn place_row(sums: &[f32], bias: f32, out: *mut u16) {
        let mut row = [0u16; SIDE];
        for (row, &sum) in row.iter_mut().zip(sums) {
            *row = round(sum + bias);
        }
        // SAFETY: these elements can be written.
        unsafe { out.copy_from_nonoverlapping(row.as_ptr(), sums.len()) };
    }
}
