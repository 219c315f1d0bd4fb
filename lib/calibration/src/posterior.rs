//! A distribution over pitch, roll and focal length on a grid.
use crate::pose::{Pose, fov_deg};

/// Equally spaced values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    /// The first value.
    pub low: f64,
    /// From value to value.
    pub step: f64,
    /// How many values.
    pub count: usize,
}

impl Axis {
    /// `count` values from `low` to `high`.
    pub fn between(low: f64, high: f64, count: usize) -> Self {
        let step = (high - low) / (count.max(2) - 1) as f64;
        Self { low, step, count }
    }

    /// Value `k`.
    pub fn value(&self, k: usize) -> f64 {
        self.low + k as f64 * self.step
    }

    /// The last value.
    pub fn last(&self) -> f64 {
        self.value(self.count - 1)
    }

    /// All values.
    pub fn values(&self) -> impl Iterator<Item = f64> {
        (0..self.count).map(|k| self.value(k))
    }
}

/// The middle value and the bounds that hold 90% of the probability.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// 5% lie below.
    pub low: f64,
    /// Half lie below.
    pub middle: f64,
    /// 5% lie above.
    pub high: f64,
}

impl Interval {
    /// Whether a value lies inside.
    pub fn holds(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Half of its length.
    pub fn half_width(&self) -> f64 {
        0.5 * (self.high - self.low)
    }
}

/// Probabilities of the points of a grid: pitch in degrees, roll in degrees, logarithm of the focal length.
#[derive(Clone, Debug, PartialEq)]
pub struct Posterior {
    /// Pitch, roll, logarithm of the focal length; the last is the fastest.
    pub axes: [Axis; 3],
    /// Sum to 1.
    pub weights: Vec<f64>,
}

impl Posterior {
    /// From logarithms of densities, in any scale.
    pub fn new(axes: [Axis; 3], logs: &[f64]) -> Self {
        assert_eq!(logs.len(), axes.iter().map(|a| a.count).product::<usize>());
        let best = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut weights: Vec<f64> = logs.iter().map(|l| (l - best).exp()).collect();
        let total: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= total);
        Self { axes, weights }
    }

    /// Probabilities of the values of one axis.
    pub fn marginal(&self, axis: usize) -> Vec<f64> {
        let [_, b, c] = self.axes.map(|a| a.count);
        let mut sums = vec![0.0; self.axes[axis].count];
        for (k, w) in self.weights.iter().enumerate() {
            sums[[k / (b * c), k / c % b, k % c][axis]] += w;
        }
        sums
    }

    /// The value of an axis below which the share `q` lies, evenly spread around each point of the grid.
    pub fn quantile(&self, axis: usize, q: f64) -> f64 {
        let (axis, marginal) = (self.axes[axis], self.marginal(axis));
        let mut left = q;
        for (k, w) in marginal.iter().enumerate() {
            if left <= *w || k + 1 == axis.count {
                let part = if *w > 0.0 { (left / w).min(1.0) } else { 0.5 };
                return axis.value(k) + (part - 0.5) * axis.step;
            }
            left -= w;
        }
        axis.value(axis.count - 1)
    }

    /// 90% of an axis.
    pub fn interval(&self, axis: usize) -> Interval {
        let [low, middle, high] = [0.05, 0.5, 0.95].map(|q| self.quantile(axis, q));
        Interval { low, middle, high }
    }

    /// 90% of the angle along the longer side, degrees.
    pub fn fov_deg(&self) -> Interval {
        let focal = self.interval(2);
        Interval {
            low: fov_deg(focal.high),
            middle: fov_deg(focal.middle),
            high: fov_deg(focal.low),
        }
    }

    /// The middles of all three.
    pub fn middle(&self) -> Pose {
        let [pitch_deg, roll_deg, log_focal] = [0, 1, 2].map(|axis| self.quantile(axis, 0.5));
        Pose {
            pitch_deg,
            roll_deg,
            log_focal,
        }
    }

    /// Axes of `counts` values around all but `left_out` of the probability of each, and a step more.
    pub(crate) fn closer(&self, counts: [usize; 3], left_out: f64) -> [Axis; 3] {
        [0, 1, 2].map(|k| {
            let step = self.axes[k].step;
            let low = self.quantile(k, 0.5 * left_out) - step;
            let high = self.quantile(k, 1.0 - 0.5 * left_out) + step;
            Axis::between(low, high, counts[k])
        })
    }
}
