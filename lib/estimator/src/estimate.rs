//! What is known of the light of a photograph.
use dipir_light::environment::EnvironmentMap;
use dipir_light::fit::fit;
use dipir_light::gaussian::SphericalGaussian;
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::grid::{BIN_SIGMA, BINS, bin_direction, smooth_map, to_world};
use crate::known::KnownSource;
use crate::posterior::{PeakPosterior, words};

/// Columns and rows of maps of the light.
pub const MAP: [usize; 2] = [64, 32];

/// A middle and the ends of an interval that holds the truth in 80% of photographs of places like those trained on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Median.
    pub middle: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// The three in order, whatever order they are given in.
    pub fn new(low: f64, middle: f64, high: f64) -> Self {
        let mut all = [low, middle, high];
        all.sort_by(f64::total_cmp);
        let [low, middle, high] = all;
        Self { low, middle, high }
    }

    /// Whether a value lies inside.
    pub fn holds(&self, value: f64) -> bool {
        self.low <= value && value <= self.high
    }
}

/// A distribution over the light of one place. Radiance is on the photograph's linear scale: 1 is its white, and an
/// object rendered under the light has the values that it takes in the decoded photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LightEstimate {
    /// Azimuth of the view in the world, radians: 0 looks to -z, a quarter turn to +x.
    pub heading_rad: f64,
    /// Mean linear luminance of the photograph.
    pub reference: f64,
    /// Radiance without the strongest source: 16 x 8 texels, rows from the top, columns from ahead to the right.
    pub base: Vec<[f32; 3]>,
    /// Expected radiance of the strongest source integrated over its solid angle.
    pub peak: [f32; 3],
    /// Where that source stands, relative to the view.
    pub posterior: PeakPosterior,
    /// Probability that it is like a sun: small, and at least a fifth of all light.
    pub sun_probability: f64,
    /// Mean radiance over the sphere, stops over the photograph's mean.
    pub exposure_stops: Interval,
    /// The strongest source's share of the light.
    pub share: Interval,
    /// The strongest source's azimuth relative to the view, degrees to the right.
    pub azimuth_deg: Interval,
    /// Its elevation, degrees.
    pub elevation_deg: Interval,
    /// Its most probable direction in words.
    pub words: String,
    /// The strongest source, where its direction is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<KnownSource>,
}

impl LightEstimate {
    /// Intervals and words of the posterior, after it changed.
    pub(crate) fn described(mut self) -> Self {
        self.azimuth_deg = self.posterior.azimuth_interval(0.8);
        self.elevation_deg = self.posterior.elevation_interval(0.8);
        self.words = words(self.posterior.mode());
        self
    }

    /// The same light with all radiance times a factor, for a photograph that is so much brighter.
    pub fn scaled(mut self, factor: f32) -> Self {
        self.reference *= f64::from(factor);
        self.base
            .as_flattened_mut()
            .iter_mut()
            .for_each(|v| *v *= factor);
        self.peak.iter_mut().for_each(|v| *v *= factor);
        self
    }

    /// The direction of the strongest source in the world: the one that is known, else the most probable.
    pub fn mode(&self) -> Vec3 {
        if let Some(source) = &self.source {
            return source.direction;
        }
        Quat::from_rotation_y(-self.heading_rad as f32) * self.posterior.mode()
    }

    /// The mean light in the world: the smooth part, and the strongest source spread over where it may stand.
    pub fn map(&self) -> EnvironmentMap {
        let weights: Vec<f32> = self.posterior.weights.clone();
        self.map_with(&weights)
    }

    /// The light without its strongest source, in the world.
    pub fn base_map(&self) -> EnvironmentMap {
        self.map_with(&[0.0; BINS])
    }

    /// The smooth part and the strongest source, spread by `weights`.
    pub(crate) fn map_with(&self, weights: &[f32]) -> EnvironmentMap {
        let [width, height] = MAP;
        let mut texels = smooth_map(&self.base, width, height);
        let grid = EnvironmentMap::constant(width, height, Vec3::ZERO);
        let peak = Vec3::from(self.peak);
        for (k, weight) in weights.iter().enumerate().filter(|w| *w.1 > 0.0) {
            let middle = bin_direction(k);
            let mut total = 0.0;
            let shape: Vec<f32> = (0..width * height)
                .map(|t| {
                    let d = grid.direction_of(t / width, t % width);
                    let value = ((d.dot(middle) - 1.0) / (BIN_SIGMA * BIN_SIGMA)).exp();
                    total += value * grid.solid_angle(t / width) as f32;
                    value
                })
                .collect();
            let scale = peak * (weight / total);
            texels
                .iter_mut()
                .zip(shape)
                .for_each(|(t, s)| *t += scale * s);
        }
        let finite = |t: Vec3| {
            if t.is_finite() {
                t.max(Vec3::ZERO)
            } else {
                Vec3::ZERO
            }
        };
        let texels = texels.into_iter().map(finite).collect();
        let map = EnvironmentMap::new(width, height, texels).unwrap_or(grid);
        to_world(&map, self.heading_rad)
    }

    /// At most `count` lobes whose sum fits the mean light, with its energy in every channel. A source whose
    /// direction is known comes first.
    pub fn lobes(&self, count: usize) -> Vec<SphericalGaussian> {
        match self.source_lobe() {
            Some(source) => {
                let rest = fit(&self.base_map(), count.saturating_sub(1)).lobes;
                std::iter::once(source).chain(rest).collect()
            }
            None => fit(&self.map(), count).lobes,
        }
    }
}
