//! Distributions of one number, as probabilities of equal bins.

/// Equal bins between two values. What lies outside belongs to the first or the last bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    /// Lower border of the first bin.
    pub low: f64,
    /// Upper border of the last bin.
    pub high: f64,
    /// How many bins.
    pub count: usize,
}

/// Mean radiance over the sphere, stops over the photograph's mean.
pub const STOPS: Scale = Scale {
    low: -3.0,
    high: 5.0,
    count: 16,
};

/// The strongest source's share of the light.
pub const SHARES: Scale = Scale {
    low: 0.0,
    high: 1.0,
    count: 10,
};

impl Scale {
    fn position(&self, value: f64) -> f64 {
        let at = (value - self.low) / (self.high - self.low) * self.count as f64;
        at.clamp(0.0, self.count as f64)
    }

    /// The share of `value` in each bin; shares sum to 1. The two bins whose middles enclose the value share it.
    pub fn soft(&self, value: f64) -> Vec<f32> {
        let at = (self.position(value) - 0.5).clamp(0.0, (self.count - 1) as f64);
        let near = |k: usize| (1.0 - (at - k as f64).abs()).max(0.0) as f32;
        (0..self.count).map(near).collect()
    }

    /// The value below which the share `q` of the probability lies, evenly spread within each bin.
    pub fn quantile(&self, weights: &[f64], q: f64) -> f64 {
        let total: f64 = weights.iter().sum();
        let mut left = q.clamp(0.0, 1.0) * total;
        for (k, w) in weights.iter().enumerate() {
            if left <= *w || k + 1 == self.count {
                let part = if *w > 0.0 { (left / w).min(1.0) } else { 0.5 };
                let step = (self.high - self.low) / self.count as f64;
                return self.low + (k as f64 + part) * step;
            }
            left -= w;
        }
        self.high
    }

    /// The share of the probability below a value: the inverse of [`quantile`](Self::quantile).
    pub fn rank(&self, weights: &[f64], value: f64) -> f64 {
        let at = self.position(value);
        let below = weights.iter().enumerate();
        let sum: f64 = below
            .map(|(k, w)| w * (at - k as f64).clamp(0.0, 1.0))
            .sum();
        sum / weights.iter().sum::<f64>().max(1e-300)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_even_bins_are_even() {
        let even = vec![0.1; SHARES.count];
        for q in [0.0, 0.1, 0.25, 0.5, 0.9, 1.0] {
            assert!((SHARES.quantile(&even, q) - q).abs() < 1e-12);
            assert!((SHARES.rank(&even, q) - q).abs() < 1e-12);
        }
    }

    #[test]
    fn a_value_is_shared_by_the_bins_around_it() {
        // .3 is the border between two bins of a tenth.
        let soft = SHARES.soft(0.3);
        assert!((soft[2] - 0.5).abs() < 1e-6 && (soft[3] - 0.5).abs() < 1e-6);
        for value in [-9.0, -3.0, 0.2, 4.9, 9.0] {
            assert!((STOPS.soft(value).iter().sum::<f32>() - 1.0).abs() < 1e-6);
        }
    }
}
