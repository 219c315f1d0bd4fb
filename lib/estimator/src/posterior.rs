//! Where the strongest source stands, as a histogram over azimuth and elevation relative to the view.
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::estimate::Interval;
use crate::grid::{AZIMUTHS, BINS, ELEVATION_EDGES_DEG, ELEVATIONS, bin_direction};

/// Degrees of azimuth of one bin.
const STEP_DEG: f64 = 360.0 / AZIMUTHS as f64;

/// Width of the lobe whose support makes a direction the most probable one, radians: narrower ones follow chance.
const MODE: f32 = 0.8;

/// Probabilities of the bins of [`crate::grid`], summing to 1. Azimuth 0 is ahead and grows to the right.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PeakPosterior {
    /// Rows of one elevation from the lowest up, each once around the horizon.
    pub weights: Vec<f32>,
}

impl PeakPosterior {
    /// Nothing is known.
    pub fn uniform() -> Self {
        Self {
            weights: vec![1.0 / BINS as f32; BINS],
        }
    }

    /// Weights of any sum; uniform if it is no positive number.
    pub fn normalised(weights: Vec<f64>) -> Self {
        let total: f64 = weights.iter().sum();
        if !(total.is_finite() && total > 0.0) {
            return Self::uniform();
        }
        Self {
            weights: weights.iter().map(|w| (w / total) as f32).collect(),
        }
    }

    /// Probability of each azimuth.
    pub fn azimuths(&self) -> [f64; AZIMUTHS] {
        std::array::from_fn(|a| {
            (0..ELEVATIONS)
                .map(|e| f64::from(self.weights[e * AZIMUTHS + a]))
                .sum()
        })
    }

    /// Probability of each elevation.
    pub fn elevations(&self) -> [f64; ELEVATIONS] {
        std::array::from_fn(|e| {
            (0..AZIMUTHS)
                .map(|a| f64::from(self.weights[e * AZIMUTHS + a]))
                .sum()
        })
    }

    /// The shortest arc that holds `level` of the azimuths, degrees. `middle` is the arc's median in `(-180, 180]`;
    /// `low` and `high` go on beyond +-180 where the arc does.
    pub fn azimuth_interval(&self, level: f64) -> Interval {
        let azimuths = self.azimuths();
        let mass: f64 = azimuths.iter().sum();
        // Probability between 0 and an angle, over two turns.
        let cumulative = |deg: f64| {
            let turns = (deg / 360.0).floor();
            let at = (deg - 360.0 * turns) / STEP_DEG;
            let whole = (at as usize).min(AZIMUTHS - 1);
            let part = azimuths[whole] * (at - whole as f64);
            (turns * mass + azimuths[..whole].iter().sum::<f64>() + part) / mass
        };
        let end = |start: f64, share: f64| {
            let (mut low, mut high) = (start, start + 360.0);
            for _ in 0..40 {
                let middle = 0.5 * (low + high);
                if cumulative(middle) - cumulative(start) < share {
                    low = middle
                } else {
                    high = middle
                }
            }
            high
        };
        let start = (0..360)
            .map(f64::from)
            .min_by(|a, b| (end(*a, level) - a).total_cmp(&(end(*b, level) - b)))
            .unwrap_or(0.0);
        let (middle, high) = (end(start, 0.5 * level), end(start, level));
        let turn = 360.0 * ((middle + 180.0) / 360.0 - 1e-9).floor();
        Interval::new(start - turn, middle - turn, high - turn)
    }

    /// The middle `level` of the elevations, degrees, and their median.
    pub fn elevation_interval(&self, level: f64) -> Interval {
        let elevations = self.elevations();
        let total: f64 = elevations.iter().sum();
        let quantile = |q: f64| {
            let mut left = q * total;
            for (e, p) in elevations.iter().enumerate() {
                let [low, high] =
                    [ELEVATION_EDGES_DEG[e], ELEVATION_EDGES_DEG[e + 1]].map(f64::from);
                if left <= *p || e + 1 == ELEVATIONS {
                    let share = if *p > 0.0 { (left / p).min(1.0) } else { 0.5 };
                    return low + share * (high - low);
                }
                left -= p;
            }
            90.0
        };
        Interval::new(
            quantile(0.5 - 0.5 * level),
            quantile(0.5),
            quantile(0.5 + 0.5 * level),
        )
    }

    /// Probability of the bin that holds a direction relative to the view, shared among the bins around it.
    pub fn density(&self, towards: Vec3) -> f64 {
        let soft = soft_bins(towards);
        soft.iter()
            .zip(&self.weights)
            .map(|(s, w)| f64::from(s * w))
            .sum()
    }

    /// The most probable direction: the mean over the bins within 40 degrees of the one with the most probability
    /// around it, weighted by a lobe as wide as what photographs decide.
    pub fn mode(&self) -> Vec3 {
        let support = |towards: Vec3| -> f32 {
            let near = |k: usize| ((bin_direction(k).dot(towards) - 1.0) / (MODE * MODE)).exp();
            (0..BINS).map(|k| self.weights[k] * near(k)).sum()
        };
        let all: Vec<f32> = (0..BINS).map(|k| support(bin_direction(k))).collect();
        let best = (0..BINS)
            .max_by(|a, b| all[*a].total_cmp(&all[*b]))
            .unwrap_or(0);
        let near =
            |k: &usize| bin_direction(*k).dot(bin_direction(best)) > 40f32.to_radians().cos();
        let sum: Vec3 = (0..BINS)
            .filter(near)
            .map(|k| bin_direction(k) * self.weights[k])
            .sum();
        sum.normalize_or(bin_direction(best))
    }

    /// Probability of the bins within 20 degrees of bin `k`.
    pub(crate) fn around(&self, k: usize) -> f32 {
        let near = |j: &usize| bin_direction(*j).dot(bin_direction(k)) > 20f32.to_radians().cos();
        (0..BINS).filter(near).map(|j| self.weights[j]).sum()
    }

    /// The histogram seen by a camera whose azimuth is larger by `turn_deg`.
    pub fn turned(&self, turn_deg: f64) -> Self {
        let shift = (turn_deg / STEP_DEG).rem_euclid(AZIMUTHS as f64);
        let (whole, part) = (shift.floor() as usize, shift.fract());
        let weights = (0..BINS)
            .map(|k| {
                let (row, a) = (k / AZIMUTHS * AZIMUTHS, k % AZIMUTHS);
                let near = f64::from(self.weights[row + (a + whole) % AZIMUTHS]);
                let far = f64::from(self.weights[row + (a + whole + 1) % AZIMUTHS]);
                near * (1.0 - part) + far * part
            })
            .collect();
        Self::normalised(weights)
    }
}

/// How much of each bin a direction is, summing to 1: a lobe of 12 degrees around it, so that a source near a border
/// counts for both sides.
pub fn soft_bins(towards: Vec3) -> [f32; BINS] {
    let width = 12f32.to_radians().powi(2);
    let score: [f32; BINS] = std::array::from_fn(|k| (bin_direction(k).dot(towards) - 1.0) / width);
    let best = score.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut soft = score.map(|s| (s - best).exp());
    let total: f32 = soft.iter().sum();
    soft.iter_mut().for_each(|s| *s /= total);
    soft
}

/// A direction relative to the view in words: "from behind on the left, 35 degrees high".
pub fn words(towards: Vec3) -> String {
    let azimuth = towards.x.atan2(-towards.z).to_degrees();
    let elevation = towards.y.clamp(-1.0, 1.0).asin().to_degrees();
    let height = match elevation.round() as i32 {
        h if h < 0 => format!("{} degrees below the horizon", -h),
        h => format!("{h} degrees high"),
    };
    if elevation > 75.0 {
        return format!("from above, {height}");
    }
    format!("from {}, {height}", side(f64::from(azimuth)))
}

/// A side in words, from degrees to the right of the view: "behind on the left".
pub fn side(azimuth_deg: f64) -> String {
    let azimuth = (azimuth_deg + 180.0).rem_euclid(360.0) - 180.0;
    let side = if azimuth < 0.0 { "left" } else { "right" };
    match azimuth.abs() {
        a if a < 22.5 => "ahead".to_string(),
        a if a < 67.5 => format!("ahead on the {side}"),
        a if a < 112.5 => format!("the {side}"),
        a if a < 157.5 => format!("behind on the {side}"),
        _ => "behind".to_string(),
    }
}
