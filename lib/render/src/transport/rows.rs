//! Sparse rows of weights: which texels of the environment a pixel sees, and how much of each.
//!
//! Compressed rows (CSR): `offsets[r]..offsets[r + 1]` are the entries of row `r`, by ascending
//! texel. Every [`BAND`] pixels have their rows by ascending length, so that the processor predicts where
//! loops over rows end; `order` says which pixel of the band a row belongs to. In half precision every row has its own power of two, so that its largest weight lies
//! in `[2^14, 2^15)`: weights down to `2^-28` of the row's largest keep all eleven bits, and a
//! weight's relative rounding error is at most `2^-11`.
use std::fmt::Debug;
use std::ops::{Deref, Range};
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use dipir_light::luminance::luminance;
use glam::{Vec3, Vec4, Vec4Swizzles};
use half::f16;
use memmap2::Mmap;

/// A weight and the texel that it belongs to.
pub trait Entry: Pod + Send + Sync + Debug + PartialEq {
    /// Whether rows are scaled so that their weights fit the format.
    const SCALED: bool;
    /// Numbers in an entry, as files count them.
    const NUMBERS: usize;
    /// Packs `weight`, of which one-channel formats keep the first.
    fn new(texel: usize, weight: Vec3) -> Self;
    /// Index of the texel, row by row from the top of the map.
    fn texel(&self) -> usize;
    /// The weight of each channel; the fourth number means nothing and may be NaN.
    fn weight(&self) -> Vec4;
    /// [`weight`](Self::weight) of four entries at once.
    #[inline(always)]
    fn weights(four: &[Self; 4]) -> [Vec4; 4] {
        four.map(|entry| entry.weight())
    }
}

/// Three half-precision weights and one of at most 65536 texels: 8 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ColourHalf([u16; 4]);

/// Three single-precision weights and a texel: 16 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ColourSingle([u32; 4]);

/// One half-precision weight for all channels and one of at most 65536 texels: 4 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct GreyHalf([u16; 2]);

/// One single-precision weight for all channels and a texel: 8 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct GreySingle([u32; 2]);

impl Entry for ColourHalf {
    const SCALED: bool = true;
    const NUMBERS: usize = 4;

    fn new(texel: usize, weight: Vec3) -> Self {
        let [r, g, b] = weight.to_array().map(|w| f16::from_f32(w).to_bits());
        Self([r, g, b, texel as u16])
    }

    #[inline(always)]
    fn texel(&self) -> usize {
        self.0[3] as usize
    }

    #[inline(always)]
    fn weight(&self) -> Vec4 {
        widen(self.0)
    }
}

impl Entry for ColourSingle {
    const SCALED: bool = false;
    const NUMBERS: usize = 4;

    fn new(texel: usize, weight: Vec3) -> Self {
        let [r, g, b] = weight.to_array().map(f32::to_bits);
        Self([r, g, b, texel as u32])
    }

    #[inline(always)]
    fn texel(&self) -> usize {
        self.0[3] as usize
    }

    #[inline(always)]
    fn weight(&self) -> Vec4 {
        Vec4::from_array(self.0.map(f32::from_bits))
    }
}

impl Entry for GreyHalf {
    const SCALED: bool = true;
    const NUMBERS: usize = 2;

    fn new(texel: usize, weight: Vec3) -> Self {
        Self([f16::from_f32(weight.x).to_bits(), texel as u16])
    }

    #[inline(always)]
    fn texel(&self) -> usize {
        self.0[1] as usize
    }

    #[inline(always)]
    fn weight(&self) -> Vec4 {
        widen([self.0[0]; 4])
    }

    #[inline(always)]
    fn weights(four: &[Self; 4]) -> [Vec4; 4] {
        let w = widen(first_halves(four));
        [w.xxxx(), w.yyyy(), w.zzzz(), w.wwww()]
    }
}

impl Entry for GreySingle {
    const SCALED: bool = false;
    const NUMBERS: usize = 2;

    fn new(texel: usize, weight: Vec3) -> Self {
        Self([weight.x.to_bits(), texel as u32])
    }

    #[inline(always)]
    fn texel(&self) -> usize {
        self.0[1] as usize
    }

    #[inline(always)]
    fn weight(&self) -> Vec4 {
        Vec4::splat(f32::from_bits(self.0[0]))
    }
}

/// The weights of four entries.
#[inline(always)]
fn first_halves(four: &[GreyHalf; 4]) -> [u16; 4] {
    #[cfg(all(target_arch = "x86_64", target_feature = "ssse3"))]
    {
        use std::arch::x86_64::{_mm_cvtsi128_si64, _mm_setr_epi8, _mm_shuffle_epi8};
        // SAFETY: the instruction sets are enabled at compile time.
        let packed = unsafe {
            let bytes = _mm_setr_epi8(0, 1, 4, 5, 8, 9, 12, 13, -1, -1, -1, -1, -1, -1, -1, -1);
            _mm_cvtsi128_si64(_mm_shuffle_epi8(bytemuck::cast(*four), bytes))
        };
        bytemuck::cast(packed)
    }
    #[cfg(not(all(target_arch = "x86_64", target_feature = "ssse3")))]
    four.map(|entry| entry.0[0])
}

/// Four halves as floats. Exact, so both versions give the same bits.
#[inline(always)]
fn widen(halves: [u16; 4]) -> Vec4 {
    #[cfg(all(target_arch = "x86_64", target_feature = "f16c"))]
    {
        use std::arch::x86_64::{_mm_cvtph_ps, _mm_cvtsi64_si128};
        let bits: u64 = bytemuck::cast(halves);
        // SAFETY: the instruction sets are enabled at compile time.
        unsafe { _mm_cvtph_ps(_mm_cvtsi64_si128(bits as i64)) }.into()
    }
    #[cfg(not(all(target_arch = "x86_64", target_feature = "f16c")))]
    Vec4::from_array(halves.map(|h| f16::from_bits(h).to_f32()))
}

/// Numbers in memory or in a mapped file.
#[derive(Clone, Debug)]
pub enum Store<T> {
    /// In memory.
    Owned(Vec<T>),
    /// In a file: its bytes `range`, which were checked to be whole, aligned `T`.
    Mapped {
        /// The file.
        file: Arc<Mmap>,
        /// Where in it.
        range: Range<usize>,
    },
}

impl<T: Pod> Deref for Store<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match self {
            Store::Owned(values) => values,
            Store::Mapped { file, range } => bytemuck::cast_slice(&file[range.clone()]),
        }
    }
}

/// Pixels whose rows are sorted together, at most 65536.
pub const BAND: usize = 1024;

/// The rows of all pixels.
#[derive(Clone, Debug)]
pub struct Rows<E> {
    /// Where each row's entries begin, and the end: one more than there are pixels.
    pub offsets: Store<u32>,
    /// The pixel of each row, counted from the first of its band.
    pub order: Store<u16>,
    /// Stored weights of a row are `2^exponent` times the true ones.
    pub exponents: Store<i8>,
    /// Texels and weights.
    pub entries: Store<E>,
    /// How many samples each entry is worth, see [`merged_count`].
    pub merged: Store<u8>,
}

/// The number of samples that a code of [`Rows::merged`] stands for, to 4%: the squared sum of
/// the weights that were merged over the sum of their squares.
pub fn merged_count(code: u8) -> f32 {
    (f32::from(code) / MERGED_STEPS).exp2()
}

/// Codes per doubling: 255 of them reach 3.9e9 samples.
const MERGED_STEPS: f32 = 8.0;

fn merged_code(count: f32) -> u8 {
    // A count below 1 is rounding, and NaN the underflow of squares.
    (count.max(1.0).log2() * MERGED_STEPS).round() as u8
}

impl<E: Entry> Rows<E> {
    /// The number of pixels.
    pub fn pixels(&self) -> usize {
        self.exponents.len()
    }

    /// The pixel of row `row`.
    #[inline(always)]
    pub fn pixel(&self, row: usize) -> usize {
        row / BAND * BAND + usize::from(self.order[row])
    }

    /// Bytes that a product with these rows reads of them.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.offsets)
            + size_of_val(&*self.order)
            + size_of_val(&*self.exponents)
            + size_of_val(&*self.entries)
    }

    /// Puts rows in their order; `None` if they exceed 2^32 - 1 entries.
    pub fn assemble(pixels: usize, parts: &[Part<E>]) -> Option<Self> {
        let mut lengths = vec![0; pixels];
        for row in parts.iter().flat_map(|p| &p.rows) {
            lengths[row.pixel as usize] = row.length;
        }
        let (mut order, mut row_of) = (Vec::with_capacity(pixels), vec![0; pixels]);
        for (band, lengths) in lengths.chunks(BAND).enumerate() {
            let mut sorted: Vec<usize> = (0..lengths.len()).collect();
            sorted.sort_by_key(|&p| lengths[p]);
            for (k, &p) in sorted.iter().enumerate() {
                row_of[band * BAND + p] = band * BAND + k;
                order.push(p as u16);
            }
        }
        let mut exponents = vec![0i8; pixels];
        let mut offsets = vec![0; pixels + 1];
        for row in parts.iter().flat_map(|p| &p.rows) {
            exponents[row_of[row.pixel as usize]] = row.exponent;
            offsets[row_of[row.pixel as usize] + 1] = row.length as u32;
        }
        let mut total = 0u32;
        for end in &mut offsets {
            total = total.checked_add(*end)?;
            *end = total;
        }
        let mut entries = vec![E::zeroed(); total as usize];
        let mut merged = vec![0u8; total as usize];
        for part in parts {
            let mut first = 0;
            for row in &part.rows {
                let from = first..first + row.length;
                let to = offsets[row_of[row.pixel as usize]] as usize;
                entries[to..to + row.length].copy_from_slice(&part.entries[from.clone()]);
                merged[to..to + row.length].copy_from_slice(&part.merged[from]);
                first += row.length;
            }
        }
        Some(Self {
            offsets: Store::Owned(offsets),
            order: Store::Owned(order),
            exponents: Store::Owned(exponents),
            entries: Store::Owned(entries),
            merged: Store::Owned(merged),
        })
    }
}

/// Rows of some pixels, while they are recorded.
#[derive(Clone, Debug)]
pub struct Part<E> {
    rows: Vec<RowHead>,
    entries: Vec<E>,
    merged: Vec<u8>,
}

#[derive(Clone, Copy, Debug)]
struct RowHead {
    pixel: u32,
    length: usize,
    exponent: i8,
}

impl<E> Default for Part<E> {
    fn default() -> Self {
        Self {
            rows: Vec::new(),
            entries: Vec::new(),
            merged: Vec::new(),
        }
    }
}

impl<E: Entry> Part<E> {
    /// Adds the row of `pixel`, all weights times `scale`, and leaves `builder` empty.
    pub fn push(&mut self, pixel: u32, builder: &mut RowBuilder, scale: f32) {
        builder.touched.sort_unstable();
        let first = self.entries.len();
        let largest = builder
            .touched
            .iter()
            .map(|&t| builder.cells[t as usize].truncate().max_element())
            .fold(0f32, f32::max);
        let exponent = if E::SCALED {
            exponent_for(largest * scale)
        } else {
            0
        };
        let factor = scale * power_of_two(exponent);
        for &texel in &builder.touched {
            let cell = std::mem::take(&mut builder.cells[texel as usize]);
            let entry = E::new(texel as usize, cell.truncate() * factor);
            if entry.weight().truncate() != Vec3::ZERO {
                let sum = luminance(cell.truncate());
                self.entries.push(entry);
                self.merged.push(merged_code(sum * sum / cell.w));
            }
        }
        builder.touched.clear();
        self.rows.push(RowHead {
            pixel,
            length: self.entries.len() - first,
            exponent,
        });
    }
}

/// The exponent that brings `largest` into `[2^14, 2^15)`, the top of half precision but one, so
/// that rounding cannot overflow.
fn exponent_for(largest: f32) -> i8 {
    let biased = ((largest.to_bits() >> 23) & 0xff) as i32;
    (14 - (biased - 127)).clamp(-126, 126) as i8
}

/// `2^exponent`, exactly, for exponents from -126 to 127.
#[inline(always)]
pub fn power_of_two(exponent: i8) -> f32 {
    f32::from_bits(((i32::from(exponent) + 127) as u32) << 23)
}

/// Sums the weights of one row, texel by texel.
#[derive(Clone, Debug)]
pub struct RowBuilder {
    /// Per texel: sum of the weights, and sum of their squared luminance.
    cells: Vec<Vec4>,
    touched: Vec<u32>,
}

impl RowBuilder {
    /// For environments of `texels` texels.
    pub fn new(texels: usize) -> Self {
        Self {
            cells: vec![Vec4::ZERO; texels],
            touched: Vec::new(),
        }
    }

    /// Adds a sample's weight for one texel.
    #[inline]
    pub fn add(&mut self, texel: usize, weight: Vec3) {
        if weight == Vec3::ZERO {
            return;
        }
        let cell = &mut self.cells[texel];
        if cell.truncate() == Vec3::ZERO {
            self.touched.push(texel as u32);
        }
        let y = luminance(weight);
        *cell += weight.extend(y * y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row<E: Entry>(weights: &[(usize, Vec3)], scale: f32) -> Rows<E> {
        let mut builder = RowBuilder::new(1 << 16);
        for &(texel, weight) in weights {
            builder.add(texel, weight);
        }
        let mut part = Part::default();
        part.push(1, &mut builder, scale);
        assert!(builder.cells.iter().all(|c| *c == Vec4::ZERO) && builder.touched.is_empty());
        Rows::assemble(3, &[part]).expect("small")
    }

    #[test]
    fn entries_have_the_sizes_that_files_state() {
        assert_eq!(size_of::<ColourHalf>(), 2 * ColourHalf::NUMBERS);
        assert_eq!(size_of::<GreyHalf>(), 2 * GreyHalf::NUMBERS);
        assert_eq!(size_of::<ColourSingle>(), 4 * ColourSingle::NUMBERS);
        assert_eq!(size_of::<GreySingle>(), 4 * GreySingle::NUMBERS);
    }

    #[test]
    fn half_weights_over_eight_decades_keep_eleven_bits_at_any_scale() {
        for scale in [1e-30, 1e-6, 1.0, 1e6, 1e30] {
            let weights: Vec<(usize, Vec3)> = (0..65536)
                .step_by(977)
                .map(|t| {
                    let w = (-18.0 * t as f32 / 65536.0).exp();
                    (t, Vec3::new(w, 0.7 * w, 0.3 * w))
                })
                .collect();
            let rows = row::<ColourHalf>(&weights, scale);
            assert_eq!(&*rows.offsets, [0, 0, 0, 68]);
            assert_eq!([0, 1, 2].map(|row| rows.pixel(row)), [0, 2, 1]);
            let unit = 1.0 / f64::from(power_of_two(rows.exponents[2]));
            for (entry, (texel, weight)) in rows.entries.iter().zip(&weights) {
                assert_eq!(entry.texel(), *texel);
                let found = entry.weight().truncate().as_dvec3() * unit;
                let expected = weight.as_dvec3() * f64::from(scale);
                // Half a unit in the eleventh bit, and the product's own f32 rounding.
                let error = ((found - expected) / expected).abs().max_element();
                assert!(error <= 2f64.powi(-11) * 1.001, "{scale} {texel}: {error}");
            }
        }
    }

    #[test]
    fn single_precision_keeps_weights_as_they_are() {
        let weights = [(70, Vec3::new(0.1, 1e-20, 3e20)), (5, Vec3::X)];
        let rows = row::<ColourSingle>(&weights, 0.5);
        assert_eq!(rows.entries[0], ColourSingle::new(5, 0.5 * Vec3::X));
        assert_eq!(rows.entries[1].weight().truncate(), 0.5 * weights[0].1);
        assert_eq!(&*rows.exponents, [0; 3]);
    }

    #[test]
    fn equal_texels_merge_and_tell_how_many_samples_they_were() {
        let rows = row::<GreySingle>(
            &[(9, Vec3::ONE), (9, Vec3::ONE), (4, Vec3::splat(2.0))],
            1.0,
        );
        assert_eq!(rows.entries.len(), 2);
        assert_eq!(rows.entries[1].texel(), 9);
        assert_eq!(rows.entries[1].weight().x, 2.0);
        let counts: Vec<f32> = rows.merged.iter().map(|&c| merged_count(c)).collect();
        assert_eq!(counts, [1.0, 2.0]);
        // One large and one tiny sample are worth one.
        let rows = row::<GreySingle>(&[(9, Vec3::ONE), (9, Vec3::splat(1e-6))], 1.0);
        assert_eq!(merged_count(rows.merged[0]), 1.0);
    }

    #[test]
    fn counts_keep_four_per_cent_up_to_billions() {
        for n in [1.0f32, 1.5, 7.0, 1000.0, 1e6, 3e9] {
            let found = merged_count(merged_code(n));
            // Half a step of an eighth of a doubling.
            assert!(
                (found / n).log2().abs() <= 0.5 / MERGED_STEPS + 1e-5,
                "{n}: {found}"
            );
        }
        assert_eq!(merged_code(f32::NAN), 0);
    }

    #[test]
    fn rows_ascend_in_length_within_a_band_and_every_pixel_keeps_its_own() {
        let pixels = 2 * BAND + 77;
        let length = |p: usize| p * 7919 % 23;
        let mut builder = RowBuilder::new(32);
        let mut part = Part::<GreySingle>::default();
        // Tiles come in any order.
        for p in (0..pixels).rev() {
            for texel in 0..length(p) {
                builder.add(texel, Vec3::splat(p as f32 + 1.0));
            }
            part.push(p as u32, &mut builder, 1.0);
        }
        let rows = Rows::assemble(pixels, &[part]).expect("small");
        let lengths: Vec<u32> = rows.offsets.windows(2).map(|o| o[1] - o[0]).collect();
        assert!(lengths.chunks(BAND).all(<[u32]>::is_sorted));
        let one = [Vec4::ONE; 32];
        let sums = rows.product(&one, &|p, sum| sum + Vec4::splat(p as f32));
        for (p, sum) in sums.iter().enumerate() {
            let expected = (length(p) * (p + 1) + p) as f32;
            assert_eq!(*sum, Vec3::splat(expected), "{p}");
        }
        let ones = rows.product_vjp(32, &|p| Vec4::splat(1.0 / (p as f32 + 1.0)));
        for (texel, sum) in ones.iter().enumerate() {
            let expected = (0..pixels).filter(|&p| length(p) > texel).count();
            // 2,125 terms near 1; each, and each sum, is rounded by at most 6e-8 of itself.
            assert!(
                (sum.x - expected as f32).abs() <= 3e-4 * expected as f32,
                "{texel}"
            );
        }
    }

    #[test]
    fn rows_of_zeros_are_empty() {
        let rows = row::<ColourHalf>(&[(3, Vec3::ZERO)], 1.0);
        assert_eq!(rows.entries.len(), 0);
        assert_eq!(rows.pixels(), 3);
    }
}
