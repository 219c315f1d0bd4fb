//! Gaussian noise that is the same for any number of threads and any device.

use candle_core::{DType, Device, Tensor};
use dipir_numerics::hashing::{GOLDEN, mix64};

use crate::error::Result;

/// A counter-based stream of random numbers: the n-th draw is a hash of
/// (key, n).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NoiseStream {
    key: u64,
    counter: u64,
}

impl NoiseStream {
    /// The stream number `stream` under `seed`.
    pub fn new(seed: u64, stream: u64) -> Self {
        Self {
            key: mix64(mix64(seed.wrapping_add(GOLDEN)) ^ stream.wrapping_mul(GOLDEN)),
            counter: 0,
        }
    }

    /// The stream of a name under `seed` (FNV-1a of its bytes).
    pub fn named(seed: u64, name: &str) -> Self {
        let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| {
            (hash ^ byte as u64).wrapping_mul(0x0100_0000_01b3)
        });
        Self::new(seed, hash)
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.counter = self.counter.wrapping_add(1);
        mix64(self.key.wrapping_add(self.counter.wrapping_mul(GOLDEN)))
    }

    /// Uniform in [0, 1), 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (-53f64).exp2()
    }

    /// Uniform integer in [0, bound); bias below bound / 2^64.
    pub fn below(&mut self, bound: usize) -> usize {
        ((self.next_u64() as u128 * bound as u128) >> 64) as usize
    }

    /// Standard normal by Box and Muller, one value for two words, in f64 so
    /// that the tail is not cut before 8.5 standard deviations.
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let angle = std::f64::consts::TAU * self.uniform();
        (radius * angle.cos()) as f32
    }

    /// A tensor of standard normal values.
    pub fn normal_tensor(
        &mut self,
        shape: &[usize],
        dtype: DType,
        device: &Device,
    ) -> Result<Tensor> {
        let count: usize = shape.iter().product();
        let values: Vec<f32> = (0..count).map(|_| self.normal()).collect();
        Ok(Tensor::from_vec(values, shape, device)?.to_dtype(dtype)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_noise_has_the_moments_of_a_standard_normal() {
        let mut stream = NoiseStream::new(3, 4);
        let n = 200_000;
        let (mut m1, mut m2, mut m4) = (0f64, 0f64, 0f64);
        for _ in 0..n {
            let x = stream.normal() as f64;
            m1 += x;
            m2 += x * x;
            m4 += x * x * x * x;
        }
        let n = n as f64;
        // Five standard errors: sd of x, x^2 and x^4 are 1, sqrt 2, sqrt 96.
        assert!((m1 / n).abs() < 5.0 / n.sqrt());
        assert!((m2 / n - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        assert!((m4 / n - 3.0).abs() < 5.0 * (96.0 / n).sqrt());
    }

    #[test]
    fn locks_the_first_word_that_every_run_hangs_on() {
        assert_eq!(NoiseStream::new(1, 2).next_u64(), 0x8c64_7d4b_c9d6_b599);
    }

    #[test]
    fn streams_of_different_keys_differ() {
        let a = NoiseStream::new(1, 2).next_u64();
        assert_ne!(a, NoiseStream::new(1, 3).next_u64());
        assert_ne!(a, NoiseStream::new(2, 2).next_u64());
        assert_ne!(
            NoiseStream::named(0, "a").next_u64(),
            NoiseStream::named(0, "b").next_u64()
        );
    }
}
