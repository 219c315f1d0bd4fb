//! Statistics of renders and experiments.
use statrs::distribution::{ChiSquared, ContinuousCDF, Normal, StudentsT};

use crate::sampler::{Sampler, Stream};

/// Mean and variance of a stream of numbers [Welford 1962; Chan et al. 1979 for merging].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Running {
    count: u64,
    mean: f64,
    m2: f64,
}

impl Running {
    /// Adds one observation.
    #[inline]
    pub fn push(&mut self, x: f64) {
        self.count += 1;
        let delta = x - self.mean;
        self.mean += delta / self.count as f64;
        self.m2 += delta * (x - self.mean);
    }

    /// Observations so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Their mean; 0 without any.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// The unbiased sample variance; 0 for fewer than two observations.
    pub fn variance(&self) -> f64 {
        if self.count < 2 {
            0.0
        } else {
            self.m2 / (self.count - 1) as f64
        }
    }

    /// Standard error of the mean; infinite for fewer than two observations.
    pub fn std_error(&self) -> f64 {
        if self.count < 2 {
            f64::INFINITY
        } else {
            (self.variance() / self.count as f64).sqrt()
        }
    }

    /// Both streams together.
    pub fn merge(self, other: Self) -> Self {
        let count = self.count + other.count;
        if count == 0 {
            return self;
        }
        let delta = other.mean - self.mean;
        let share = other.count as f64 / count as f64;
        Self {
            count,
            mean: self.mean + delta * share,
            m2: self.m2 + other.m2 + delta * delta * self.count as f64 * share,
        }
    }
}

impl FromIterator<f64> for Running {
    fn from_iter<I: IntoIterator<Item = f64>>(values: I) -> Self {
        let mut r = Self::default();
        for x in values {
            r.push(x);
        }
        r
    }
}

/// The value that a standard normal variable stays below with probability `p` in (0, 1).
pub fn normal_quantile(p: f64) -> f64 {
    Normal::standard().inverse_cdf(p)
}

/// Half-width of the two-sided confidence interval of a mean from `count` observations with
/// standard error `std_error`, at `level` such as 0.95. Infinite for fewer than two.
pub fn t_half_width(count: u64, std_error: f64, level: f64) -> f64 {
    if count < 2 {
        return f64::INFINITY;
    }
    match StudentsT::new(0.0, 1.0, (count - 1) as f64) {
        Ok(t) => t.inverse_cdf(0.5 + 0.5 * level) * std_error,
        Err(_) => f64::INFINITY,
    }
}

/// Significance a single test must use so that the chance of one false alarm among `tests`
/// independent ones is `alpha` [Sidak 1967].
pub fn sidak(alpha: f64, tests: usize) -> f64 {
    1.0 - (1.0 - alpha).powf(1.0 / tests.max(1) as f64)
}

/// Pearson's chi-squared test that counts follow expected frequencies: the p-value.
///
/// Bins that expect fewer than `min_expected` (5 is customary) are pooled into one, smallest
/// first. A count where nothing is expected at all gives 0. With a single bin left there is
/// nothing to test and the answer is 1.
pub fn chi_squared_p_value(observed: &[f64], expected: &[f64], min_expected: f64) -> f64 {
    assert_eq!(
        observed.len(),
        expected.len(),
        "a count for each expectation"
    );
    let mut order: Vec<usize> = (0..observed.len()).collect();
    order.sort_by(|&a, &b| expected[a].total_cmp(&expected[b]));
    let (mut statistic, mut bins) = (0.0, 0usize);
    let (mut pooled_observed, mut pooled_expected) = (0.0, 0.0);
    let mut add = |o: f64, e: f64| {
        statistic += (o - e) * (o - e) / e;
        bins += 1;
    };
    for i in order {
        if expected[i] <= 0.0 && observed[i] > 0.0 {
            return 0.0;
        }
        let pool_is_open = pooled_expected > 0.0 && pooled_expected < min_expected;
        if expected[i] < min_expected || pool_is_open {
            pooled_observed += observed[i];
            pooled_expected += expected[i];
        } else {
            add(observed[i], expected[i]);
        }
    }
    if pooled_expected > 0.0 {
        add(pooled_observed, pooled_expected);
    }
    if bins < 2 {
        return 1.0;
    }
    match ChiSquared::new((bins - 1) as f64) {
        Ok(d) => 1.0 - d.cdf(statistic),
        Err(_) => 1.0,
    }
}

/// The median; the mean of the middle two for an even count. `None` for no values.
pub fn median(values: &[f64]) -> Option<f64> {
    let mut v = values.to_vec();
    v.sort_by(f64::total_cmp);
    let n = v.len();
    match n {
        0 => None,
        _ if n % 2 == 1 => Some(v[n / 2]),
        _ => Some(0.5 * (v[n / 2 - 1] + v[n / 2])),
    }
}

/// Percentile bootstrap interval of the median at `level`, from `resamples` resamples drawn
/// deterministically from `seed`. `None` for no values.
pub fn bootstrap_median_interval(
    values: &[f64],
    level: f64,
    resamples: u32,
    seed: u64,
) -> Option<(f64, f64)> {
    let n = values.len();
    if n == 0 || resamples == 0 {
        return None;
    }
    let mut medians: Vec<f64> = (0..resamples)
        .map(|r| {
            let mut s = Sampler::new(seed, Stream::BOOTSTRAP, 0, r);
            let draw: Vec<f64> = (0..n)
                .map(|_| values[(s.next_u64() % n as u64) as usize])
                .collect();
            median(&draw).unwrap_or(f64::NAN)
        })
        .collect();
    medians.sort_by(f64::total_cmp);
    let at =
        |p: f64| medians[((p * (resamples - 1) as f64).round() as usize).min(medians.len() - 1)];
    Some((at(0.5 - 0.5 * level), at(0.5 + 0.5 * level)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merging_equals_one_stream() {
        let xs: Vec<f64> = (0..100)
            .map(|i| (i as f64 * 1.7).sin() * 1e3 + 1e6)
            .collect();
        let whole: Running = xs.iter().copied().collect();
        let (a, b) = xs.split_at(37);
        let merged = a
            .iter()
            .copied()
            .collect::<Running>()
            .merge(b.iter().copied().collect());
        assert_eq!(merged.count(), 100);
        assert!((merged.mean() - whole.mean()).abs() < 1e-9);
        assert!((merged.variance() / whole.variance() - 1.0).abs() < 1e-10);
        assert_eq!(Running::default().merge(whole), whole);
    }

    #[test]
    fn quantiles_and_intervals_equal_published_tables() {
        assert!((normal_quantile(0.975) - 1.959_963_985).abs() < 1e-6);
        assert!((t_half_width(5, 1.0, 0.95) - 2.776_445).abs() < 1e-4);
        assert_eq!(t_half_width(1, 1.0, 0.95), f64::INFINITY);
        assert!((sidak(0.05, 1) - 0.05).abs() < 1e-12);
        assert!((sidak(0.05, 10) - 0.005_116_2).abs() < 1e-6);
    }

    #[test]
    fn chi_squared_accepts_its_own_and_rejects_a_shifted_distribution() {
        let expected = vec![100.0; 20];
        let good: Vec<f64> = (0..20)
            .map(|i| 100.0 + 8.0 * ((i * 7 % 20) as f64 / 9.5 - 1.0))
            .collect();
        assert!(chi_squared_p_value(&good, &expected, 5.0) > 0.05);
        let bad: Vec<f64> = (0..20).map(|i| if i < 10 { 125.0 } else { 75.0 }).collect();
        assert!(chi_squared_p_value(&bad, &expected, 5.0) < 1e-6);
        assert_eq!(chi_squared_p_value(&[1.0, 10.0], &[0.0, 10.0], 5.0), 0.0);
        // Many bins of 1 pool into one of 10: no false alarm from their discreteness.
        let mut o = vec![0.0; 9];
        o.push(10.0);
        o.push(50.0);
        let mut e = vec![1.0; 10];
        e.push(50.0);
        assert!((chi_squared_p_value(&o, &e, 5.0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn medians_and_their_intervals() {
        assert_eq!(median(&[]), None);
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), Some(2.5));
        let xs: Vec<f64> = (0..101).map(f64::from).collect();
        let (lo, hi) = bootstrap_median_interval(&xs, 0.95, 500, 3).unwrap();
        // The exact interval of the median of 101 values by order statistics is [40, 60].
        assert!(
            (36.0..46.0).contains(&lo) && (54.0..64.0).contains(&hi),
            "{lo} {hi}"
        );
        assert_eq!(bootstrap_median_interval(&xs, 0.95, 500, 3), Some((lo, hi)));
    }
}
