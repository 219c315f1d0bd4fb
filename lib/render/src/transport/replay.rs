//! Products of recorded rows with an environment, and their transposes.
//!
//! `product` gathers: a pixel is the sum of weight times texel over its row. `product_vjp`
//! scatters: every entry adds weight times the pixel's gradient to its texel. Both read each entry
//! once, from memory, and hold the environment (16 bytes a texel) in cache.
//!
//! Texels and sums are four wide and multiplications are fused, one rounding each, on every
//! machine: with or without SIMD instructions the bytes are the same. They are also the same for
//! any number of threads: a row is summed by one thread in a fixed order, and the transposed
//! product scatters fixed runs of pixels, whose sums are added from first to last.
use std::ops::Range;

use dipir_light::luminance::luminance;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

use super::rows::{BAND, Entry, Rows, merged_count, power_of_two};

/// Most runs of rows with a gradient of their own: each costs a pass over the environment.
const SCATTER_PARTS: usize = 16;
/// A run of rows must have this many entries per texel, or adding its gradient up costs as
/// much as finding it.
const ENTRIES_PER_TEXEL: usize = 4;

/// A colour as the kernels read it: the fourth number is 0, so whatever an entry has there is
/// harmless.
#[inline(always)]
pub fn padded(colour: Vec3) -> Vec4 {
    colour.extend(0.0)
}

impl<E: Entry> Rows<E> {
    /// At most `parts` runs of rows with about the same number of entries; a function of the
    /// record alone.
    fn runs(&self, parts: usize) -> Vec<Range<usize>> {
        let offsets = &*self.offsets;
        let pixels = self.pixels();
        let total = offsets[pixels] as u64;
        let mut bounds: Vec<usize> = (0..=parts as u64)
            .map(|k| offsets.partition_point(|&o| u64::from(o) < total * k / parts as u64))
            .map(|p| p.min(pixels))
            .collect();
        bounds[0] = 0;
        bounds[parts] = pixels;
        bounds.windows(2).map(|w| w[0]..w[1]).collect()
    }

    /// What `finish` makes of each pixel and its `rows * light`.
    pub fn product(
        &self,
        light: &[Vec4],
        finish: &(impl Fn(usize, Vec4) -> Vec4 + Sync),
    ) -> Vec<Vec3> {
        let (offsets, exponents, entries) = (&*self.offsets, &*self.exponents, &*self.entries);
        let mut pixels = vec![Vec3::ZERO; self.pixels()];
        let bands = pixels.par_chunks_mut(BAND).zip(self.order.par_chunks(BAND));
        bands.enumerate().for_each(|(band, (pixels, order))| {
            let first = band * BAND;
            let (offsets, exponents) = (&offsets[first..], &exponents[first..]);
            let rows = offsets.windows(2).zip(exponents).zip(order);
            for ((row, &exponent), &p) in rows {
                let [start, end] = [row[0] as usize, row[1] as usize];
                let sum = match start < end {
                    true => row_sum(entries, start, end, light) * inverse_scale(exponent),
                    false => Vec4::ZERO,
                };
                let p = usize::from(p);
                pixels[p] = finish(first + p, sum).truncate();
            }
        });
        pixels
    }

    /// Adjoint of [`product`](Self::product): `rows^T * gradient` of each of `texels` texels,
    /// from each pixel's gradient.
    pub fn product_vjp(
        &self,
        texels: usize,
        gradient: &(impl Fn(usize) -> Vec4 + Sync),
    ) -> Vec<Vec3> {
        let (offsets, exponents, entries) = (&*self.offsets, &*self.exponents, &*self.entries);
        let parts = entries.len() / (ENTRIES_PER_TEXEL * texels.max(1));
        let runs = self.runs(parts.clamp(1, SCATTER_PARTS));
        let partial: Vec<Vec<Vec4>> = runs
            .into_par_iter()
            .map(|run| {
                let mut sums = vec![Vec4::ZERO; texels];
                for row in run {
                    let (start, end) = (offsets[row] as usize, offsets[row + 1] as usize);
                    if start == end {
                        continue;
                    }
                    let gradient = gradient(self.pixel(row));
                    if gradient != Vec4::ZERO {
                        let scaled = gradient * inverse_scale(exponents[row]);
                        row_scatter(entries, start, end, scaled, &mut sums);
                    }
                }
                sums
            })
            .collect();
        (0..texels)
            .into_par_iter()
            .with_min_len(1024)
            .map(|t| partial.iter().map(|sums| sums[t].truncate()).sum())
            .collect()
    }

    /// Kish's effective number of the samples behind every pixel's sum under `light`, by
    /// luminance: `(sum w)^2 / sum w^2`. Samples merged into an entry are told apart by their
    /// recorded count; samples that reached several texels count once for each. 0 for pixels
    /// without light.
    pub fn effective_sample_size(&self, light: &[Vec4]) -> Vec<f32> {
        let mut sizes = vec![0.0; self.pixels()];
        let bands = sizes.par_chunks_mut(BAND).enumerate();
        bands.for_each(|(band, sizes)| {
            for row in band * BAND..band * BAND + sizes.len() {
                let entries = self.offsets[row] as usize..self.offsets[row + 1] as usize;
                let (mut sum, mut squares) = (0f32, 0f32);
                let merged = &self.merged[entries.clone()];
                for (entry, &count) in self.entries[entries].iter().zip(merged) {
                    let y = luminance((entry.weight() * light[entry.texel()]).truncate());
                    sum += y;
                    squares += y * y / merged_count(count);
                }
                if squares > 0.0 {
                    sizes[usize::from(self.order[row])] = sum * sum / squares;
                }
            }
        });
        sizes
    }
}

/// One over the scale of a row. It is exact, and so is a product with it that does not underflow.
#[inline(always)]
fn inverse_scale(exponent: i8) -> f32 {
    power_of_two(-exponent)
}

/// Calls `each` with the weights and the entries of a row `[start, end)`, four at a time. The last
/// may belong to other rows, or to none: their weights are 0, so that no row's length costs a branch.
#[inline(always)]
fn by_four<E: Entry>(
    entries: &[E],
    start: usize,
    end: usize,
    mut each: impl FnMut([Vec4; 4], &[E; 4]),
) {
    const KEPT: [[f32; 4]; 4] = [
        [0.0; 4],
        [1.0, 0.0, 0.0, 0.0],
        [1.0, 1.0, 0.0, 0.0],
        [1.0, 1.0, 1.0, 0.0],
    ];
    let (fours, rest) = entries[start..end].as_chunks::<4>();
    for four in fours {
        each(E::weights(four), four);
    }
    if !rest.is_empty() {
        let mut copy = [E::zeroed(); 4];
        let four = match entries[end - rest.len()..].first_chunk() {
            Some(four) => four,
            None => {
                copy[..rest.len()].copy_from_slice(rest);
                &copy
            }
        };
        let mut weights = E::weights(four);
        for (weight, kept) in weights.iter_mut().zip(KEPT[rest.len()]) {
            *weight *= kept;
        }
        each(weights, four);
    }
}

/// Sum of weight times texel over a row: four running sums hide the latency of additions.
#[inline(always)]
fn row_sum<E: Entry>(entries: &[E], start: usize, end: usize, light: &[Vec4]) -> Vec4 {
    let mut sums = [Vec4::ZERO; 4];
    by_four(entries, start, end, |weights, four| {
        for k in 0..4 {
            sums[k] = weights[k].mul_add(light[four[k].texel()], sums[k]);
        }
    });
    (sums[0] + sums[1]) + (sums[2] + sums[3])
}

/// Adds weight times `gradient` to every texel of a row.
#[inline(always)]
fn row_scatter<E: Entry>(
    entries: &[E],
    start: usize,
    end: usize,
    gradient: Vec4,
    sums: &mut [Vec4],
) {
    by_four(entries, start, end, |weights, four| {
        for k in 0..4 {
            let sum = &mut sums[four[k].texel()];
            *sum = weights[k].mul_add(gradient, *sum);
        }
    });
}

/// The ratio `1 - share missing / arriving` of each channel, clamped at 0; 1 where nothing arrives.
/// Sampling noise alone can bring it below 0; above 1, where `missing` is negative, the object sends
/// more than it blocks.
#[inline(always)]
pub fn ratio(missing: Vec4, arriving: Vec4, share: f32) -> Vec4 {
    let ratio = 1.0 - share * (missing / arriving);
    let clamped = Vec4::select(ratio.cmplt(Vec4::ZERO), Vec4::ZERO, ratio);
    Vec4::select(arriving.cmpgt(Vec4::ZERO), clamped, Vec4::ONE)
}

/// Adjoint of [`ratio`]: the gradients of `missing` and `arriving`, from the ratio and its
/// gradient. 0 where it is clamped and where nothing arrives.
#[inline(always)]
pub fn ratio_vjp(ratio: Vec4, arriving: Vec4, share: f32, gradient: Vec4) -> (Vec4, Vec4) {
    let moves = arriving.cmpgt(Vec4::ZERO) & !ratio.cmple(Vec4::ZERO);
    // d(1 - s m / a) = -s / a dm + s m / a^2 da, and s m / a is 1 - ratio.
    let slope = Vec4::select(moves, gradient / arriving, Vec4::ZERO);
    (-slope * share, slope * (1.0 - ratio))
}
