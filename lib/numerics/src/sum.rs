//! Compensated sums that do not depend on the number of threads.
use std::ops::Range;

use rayon::prelude::*;

/// A compensated f64 sum [Neumaier 1974]: relative error about one ulp plus
/// `n^2 eps^2` times the condition number, whatever the order of magnitudes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Neumaier {
    sum: f64,
    compensation: f64,
}

impl Neumaier {
    /// Adds one term.
    #[inline]
    pub fn add(&mut self, x: f64) {
        let t = self.sum + x;
        self.compensation += if self.sum.abs() >= x.abs() {
            (self.sum - t) + x
        } else {
            (x - t) + self.sum
        };
        self.sum = t;
    }

    /// The sum so far.
    #[inline]
    pub fn total(&self) -> f64 {
        self.sum + self.compensation
    }

    /// Adds another sum's terms.
    pub fn merge(mut self, other: Self) -> Self {
        self.add(other.sum);
        self.compensation += other.compensation;
        self
    }
}

impl FromIterator<f64> for Neumaier {
    fn from_iter<I: IntoIterator<Item = f64>>(terms: I) -> Self {
        let mut s = Self::default();
        for x in terms {
            s.add(x);
        }
        s
    }
}

/// Maps the chunks `[0, chunk)`, `[chunk, 2 chunk)`... of `0..n` in parallel and folds the
/// results from first to last, so that the answer does not depend on the number of threads.
/// `None` if `n` is 0.
pub fn par_reduce<T: Send>(
    n: usize,
    chunk: usize,
    map: impl Fn(Range<usize>) -> T + Sync,
    reduce: impl Fn(T, T) -> T,
) -> Option<T> {
    assert!(chunk > 0, "a chunk holds at least one item");
    let parts: Vec<T> = (0..n.div_ceil(chunk))
        .into_par_iter()
        .map(|i| map(i * chunk..((i + 1) * chunk).min(n)))
        .collect();
    parts.into_iter().reduce(reduce)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compensated sums of chunks, merged.
    fn sum_f32(terms: &[f32]) -> f64 {
        let chunk = |r: Range<usize>| terms[r].iter().map(|&x| x as f64).collect::<Neumaier>();
        let sum = par_reduce(terms.len(), 1 << 14, chunk, Neumaier::merge);
        sum.map_or(0.0, |s| s.total())
    }

    #[test]
    fn ten_million_terms_over_nine_decades_keep_six_digits() {
        // Terms 10^(-3 .. 6) in a scrambled order; the reference sums exact integers:
        // each term is k * 2^-24 with k < 2^54, accumulated in i128.
        let n = 10_000_000u64;
        let term = |i: u64| {
            let h = crate::hashing::mix64(i);
            let decade = (h % 10) as i32 - 3;
            (((h >> 40) as f32 / 16_777_216.0 + 0.5) * 10f32.powi(decade)).max(1e-3)
        };
        let terms: Vec<f32> = (0..n).map(term).collect();
        let scale = 2f64.powi(40);
        let exact: i128 = terms.iter().map(|&x| (x as f64 * scale) as i128).sum();
        let exact = exact as f64 / scale;
        let relative = (sum_f32(&terms) / exact - 1.0).abs();
        assert!(relative < 1e-12, "{relative:e}");
        let naive: f32 = terms.iter().sum();
        assert!(
            (naive as f64 / exact - 1.0).abs() > 1e-6,
            "the case is a hard one"
        );
    }

    #[test]
    fn cancellation_is_compensated() {
        let s: Neumaier = [1.0, 1e100, 1.0, -1e100].into_iter().collect();
        assert_eq!(s.total(), 2.0);
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bytes() {
        let terms: Vec<f32> = (0..100_000).map(|i| (i as f32 * 0.7).sin() * 1e3).collect();
        let with = |threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap()
                .install(|| sum_f32(&terms).to_bits())
        };
        assert_eq!(with(1), with(2));
        assert_eq!(with(1), with(7));
    }

    #[test]
    fn nothing_to_sum_is_zero() {
        assert_eq!(sum_f32(&[]), 0.0);
        assert_eq!(par_reduce(0, 4, |r| r.len(), |a, b| a + b), None);
    }
}
