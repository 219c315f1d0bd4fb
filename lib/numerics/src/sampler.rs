//! Counter-based, low-discrepancy sample numbers.
//!
//! A [`Sampler`] is a pure function of (seed, stream, pixel, sample, dimension): nothing is
//! stored between samples, so any thread may draw any sample and the bytes stay the same.
//! Dimensions come in pairs; each pair is the first two dimensions of the Sobol' sequence,
//! a (0,2)-sequence in base 2, with its index shuffled and its digits Owen-scrambled by a
//! hash of the pair [Burley 2020, "Practical Hash-based Owen Scrambling", JCGT 9(4)].
//! Every power-of-two run of samples is therefore stratified in every elementary interval,
//! while pairs are independent of each other and of other pixels.
use glam::Vec2;

use crate::hashing::{GOLDEN, hash_u64s, mix64};

/// Names an independent family of random numbers, so that two stages never share one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream(pub u32);

impl Stream {
    /// Paths through the object.
    pub const FOREGROUND: Stream = Stream(1);
    /// Light blocked from the proxy.
    pub const SHADOW: Stream = Stream(2);
    /// Scenes that the evaluation draws.
    pub const PILOT: Stream = Stream(3);
    /// Recording of light transport.
    pub const RECORD: Stream = Stream(4);
    /// Initial values and random crops of the optimisation.
    pub const OPTIMIZE: Stream = Stream(5);
    /// Generated content: the pictures that models are trained on.
    pub const CONTENT: Stream = Stream(7);
    /// Bootstrap resampling.
    pub const BOOTSTRAP: Stream = Stream(8);
    /// Tests.
    pub const TEST: Stream = Stream(9);
    /// The search for highlights.
    pub const HIGHLIGHTS: Stream = Stream(10);
    /// Particles that guide paths.
    pub const GUIDE: Stream = Stream(11);
}

/// Draws the numbers of one sample of one pixel, dimension after dimension.
#[derive(Clone, Debug)]
pub struct Sampler {
    key: u64,
    sample: u32,
    dimension: u32,
}

impl Sampler {
    /// The sequence for one `sample` of one `pixel`.
    #[inline]
    pub fn new(seed: u64, stream: Stream, pixel: u32, sample: u32) -> Self {
        let key = hash_u64s(&[seed, ((stream.0 as u64) << 32) | pixel as u64]);
        Self {
            key,
            sample,
            dimension: 0,
        }
    }

    /// Continues the same pixel with another sample, from dimension 0.
    #[inline]
    pub fn with_sample(&self, sample: u32) -> Self {
        Self {
            key: self.key,
            sample,
            dimension: 0,
        }
    }

    /// Jumps to dimension pair `dimension`, so that a decision may use a fixed number of
    /// dimensions whatever was drawn before.
    #[inline]
    pub fn set_dimension(&mut self, dimension: u32) {
        self.dimension = dimension;
    }

    /// The next dimension pair's number.
    #[inline]
    pub fn dimension(&self) -> u32 {
        self.dimension
    }

    /// A stratified number in `[0, 1)`.
    #[inline]
    pub fn next_1d(&mut self) -> f32 {
        let h = self.next_hash();
        let index = nested_uniform_scramble(self.sample, h as u32);
        to_unit(nested_uniform_scramble(
            index.reverse_bits(),
            (h >> 32) as u32,
        ))
    }

    /// A point of a scrambled (0,2)-sequence in `[0, 1)^2`.
    #[inline]
    pub fn next_2d(&mut self) -> Vec2 {
        let h = self.next_hash();
        let h2 = mix64(h);
        let index = nested_uniform_scramble(self.sample, h as u32);
        let x = index.reverse_bits();
        let y = sobol_second_dimension(index);
        Vec2::new(
            to_unit(nested_uniform_scramble(x, (h >> 32) as u32)),
            to_unit(nested_uniform_scramble(y, h2 as u32)),
        )
    }

    /// 64 hashed bits of the next dimension, not stratified: for choices with many outcomes.
    #[inline]
    pub fn next_u64(&mut self) -> u64 {
        let h = self.next_hash();
        hash_u64s(&[h, self.sample as u64])
    }

    #[inline]
    fn next_hash(&mut self) -> u64 {
        let d = self.dimension as u64;
        self.dimension += 1;
        mix64(self.key ^ (d + 1).wrapping_mul(GOLDEN))
    }
}

/// The largest multiple of 2^-24 not above `x / 2^32`, so that the result is below 1.
#[inline]
fn to_unit(x: u32) -> f32 {
    (x >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Second dimension of the Sobol' sequence: the Pascal matrix mod 2 applied to the index,
/// by five shift-and-xor steps instead of 32 conditional ones.
#[inline]
fn sobol_second_dimension(index: u32) -> u32 {
    // Multiplying the bit vector by the upper-triangular Pascal matrix factors into steps
    // x ^= (x >> 2^k) & mask_k, one a bit of the position number (Lucas' theorem).
    let mut x = index;
    x ^= (x & 0xaaaa_aaaa) >> 1;
    x ^= (x & 0xcccc_cccc) >> 2;
    x ^= (x & 0xf0f0_f0f0) >> 4;
    x ^= (x & 0xff00_ff00) >> 8;
    x ^= (x & 0xffff_0000) >> 16;
    x.reverse_bits()
}

/// Owen scrambling of the bits of `x`, most significant first, by the hash of Laine and
/// Karras with the constants of Vegdahl (2021), which has no visible bias in its low bits.
#[inline]
fn nested_uniform_scramble(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits();
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^= x.wrapping_mul(0x53a2_2864);
    x.reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Direction numbers of the second Sobol' dimension, built from the recurrence of its
    /// primitive polynomial x + 1: v_k = v_{k-1} ^ (v_{k-1} >> 1).
    fn sobol_by_recurrence(mut index: u32) -> u32 {
        let (mut v, mut x) = (1u32 << 31, 0);
        while index != 0 {
            if index & 1 == 1 {
                x ^= v;
            }
            v ^= v >> 1;
            index >>= 1;
        }
        x
    }

    #[test]
    fn second_sobol_dimension_equals_the_recurrence() {
        for i in (0..100_000u32).chain([u32::MAX, 1 << 31, 0x1234_5678]) {
            assert_eq!(sobol_second_dimension(i), sobol_by_recurrence(i), "{i}");
        }
    }

    #[test]
    fn every_power_of_two_run_is_stratified_in_every_elementary_interval() {
        for pixel in 0..20 {
            for first in [0u32, 64, 128] {
                let points: Vec<Vec2> = (first..first + 64)
                    .map(|s| {
                        let mut r = Sampler::new(7, Stream::TEST, pixel, s);
                        r.next_1d();
                        r.next_2d()
                    })
                    .collect();
                for log_columns in 0..=6 {
                    let (columns, rows) = (1 << log_columns, 1 << (6 - log_columns));
                    let mut seen = [false; 64];
                    for p in &points {
                        let cell =
                            (p.x * columns as f32) as usize * rows + (p.y * rows as f32) as usize;
                        assert!(!seen[cell], "two points in one cell of {columns} x {rows}");
                        seen[cell] = true;
                    }
                }
            }
        }
    }

    #[test]
    fn dimensions_and_pixels_are_uncorrelated() {
        // 4096 products of independent uniforms: the correlation's standard error is 1/64.
        let n = 4096;
        let (mut xy, mut pixels) = (0.0f64, 0.0f64);
        for p in 0..n {
            let mut a = Sampler::new(1, Stream::TEST, p, 0);
            let (x, y) = (a.next_1d() as f64 - 0.5, a.next_1d() as f64 - 0.5);
            let z = Sampler::new(1, Stream::TEST, p + 1, 0).next_1d() as f64 - 0.5;
            xy += x * y;
            pixels += x * z;
        }
        let to_correlation = 12.0 / n as f64;
        assert!((xy * to_correlation).abs() < 4.5 / 64.0);
        assert!((pixels * to_correlation).abs() < 4.5 / 64.0);
    }

    #[test]
    fn stays_below_one() {
        assert!(to_unit(u32::MAX) < 1.0);
    }

    #[test]
    fn a_sample_is_a_function_of_its_key_alone() {
        let draw = |seed, pixel, sample| Sampler::new(seed, Stream::TEST, pixel, sample).next_2d();
        assert_eq!(draw(1, 2, 3), draw(1, 2, 3));
        assert_ne!(draw(1, 2, 3), draw(2, 2, 3));
        assert_ne!(draw(1, 2, 3), draw(1, 3, 3));
        assert_ne!(draw(1, 2, 3), draw(1, 2, 4));
        let other = Sampler::new(1, Stream::SHADOW, 2, 3).next_2d();
        assert_ne!(draw(1, 2, 3), other);
    }
}
