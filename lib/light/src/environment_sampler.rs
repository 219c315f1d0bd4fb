//! Importance sampling of environment maps.
use std::sync::Arc;

use glam::{Vec2, Vec3};

use crate::environment::{EnvironmentMap, texel_of};
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance;
use crate::trigonometry::sin_cos_turns;

/// An environment map that can be sampled in proportion to luminance times solid angle.
///
/// A row is drawn from the marginal distribution, a column from the row's conditional one, a
/// direction uniformly (in solid angle) from the texel. Both are monotone maps of one random
/// number each, so that stratified points stay stratified.
#[derive(Clone, Debug)]
pub struct EnvironmentSampler {
    map: Arc<EnvironmentMap>,
    /// `cos` of the polar angle between rows, `H + 1` of them.
    row_cos: Vec<f64>,
    /// Cumulative probability of rows, without the leading 0.
    rows: Vec<f32>,
    /// Cumulative probability of columns within each row, without the leading 0.
    columns: Vec<f32>,
    /// One over the luminance integrated over the sphere; 0 for a black map.
    inverse_total: f64,
}

impl EnvironmentSampler {
    /// Tabulates the distribution of `map`.
    pub fn new(map: impl Into<Arc<EnvironmentMap>>) -> Self {
        let map = map.into();
        let (w, h) = (map.width(), map.height());
        let mut columns = vec![0f32; w * h];
        let mut row_mass = vec![0f64; h];
        for i in 0..h {
            let row: Vec<f64> = (0..w)
                .map(|j| f64::from(luminance(map.texel(i, j))))
                .collect();
            row_mass[i] = cumulate(&row, &mut columns[i * w..(i + 1) * w]) * map.solid_angle(i);
        }
        let mut rows = vec![0f32; h];
        let total = cumulate(&row_mass, &mut rows);
        let row_cos = (0..=h)
            .map(|i| (std::f64::consts::PI * i as f64 / h as f64).cos())
            .collect();
        Self {
            map,
            row_cos,
            rows,
            columns,
            inverse_total: if total > 0.0 { 1.0 / total } else { 0.0 },
        }
    }

    /// The map.
    pub fn map(&self) -> &Arc<EnvironmentMap> {
        &self.map
    }

    /// Radiance from and density at `direction`, in one lookup.
    #[inline]
    pub fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let radiance = self.map.eval(direction);
        (radiance, self.density(radiance))
    }

    #[inline]
    fn density(&self, radiance: Vec3) -> f32 {
        (f64::from(luminance(radiance)) * self.inverse_total) as f32
    }
}

/// Writes the normalised running sum of `masses`; returns the total. The entries from the last
/// positive mass on are exactly 1.
fn cumulate(masses: &[f64], cumulative: &mut [f32]) -> f64 {
    let total: f64 = masses.iter().sum();
    if total > 0.0 {
        let mut sum = 0.0;
        for (c, m) in cumulative.iter_mut().zip(masses) {
            sum += m;
            *c = (sum / total) as f32;
        }
        let last = masses.iter().rposition(|&m| m > 0.0).unwrap_or(0);
        cumulative[last..].fill(1.0);
    }
    total
}

/// The first entry of `cumulative` above `u`, and where in it `u` falls, in `[0, 1)`.
#[inline]
fn invert(cumulative: &[f32], u: f32) -> (usize, f32) {
    let k = cumulative
        .partition_point(|&c| c <= u)
        .min(cumulative.len() - 1);
    let below = if k == 0 { 0.0 } else { cumulative[k - 1] };
    let fraction = (u - below) / (cumulative[k] - below);
    (k, fraction.clamp(0.0, 1.0 - f32::EPSILON))
}

impl Illuminant for EnvironmentSampler {
    fn eval(&self, direction: Vec3) -> Vec3 {
        self.map.eval(direction)
    }

    fn sample(&self, u: Vec2) -> LightSample {
        if self.inverse_total == 0.0 {
            return LightSample {
                direction: Vec3::Y,
                radiance: Vec3::ZERO,
                pdf: 0.0,
            };
        }
        let (w, h) = (self.map.width(), self.map.height());
        let (i, v) = invert(&self.rows, u.y);
        let (j, u) = invert(&self.columns[i * w..(i + 1) * w], u.x);
        let mut within = Vec2::new(u, v);
        let radiance = self.map.texel(i, j);
        let mut direction = self.direction_in(i, j, within);
        // Rounding can carry a direction over the texel's edge: pull it towards the middle
        // until it is inside, so that `eval` agrees with what was drawn.
        while texel_of(direction, w, h) != (i, j) {
            within = Vec2::splat(0.5) + (within - Vec2::splat(0.5)) * 0.99;
            direction = self.direction_in(i, j, within);
        }
        LightSample {
            direction,
            radiance,
            pdf: self.density(radiance),
        }
    }

    fn pdf(&self, direction: Vec3) -> f32 {
        self.eval_pdf(direction).1
    }
}

impl EnvironmentSampler {
    /// Uniform in solid angle over texel `(i, j)`.
    #[inline]
    fn direction_in(&self, i: usize, j: usize, u: Vec2) -> Vec3 {
        let (sin_phi, cos_phi) = sin_cos_turns((j as f32 + u.x) / self.map.width() as f32);
        let y = self.row_cos[i] + (self.row_cos[i + 1] - self.row_cos[i]) * f64::from(u.y);
        let s = ((1.0 - y) * (1.0 + y)).max(0.0).sqrt() as f32;
        Vec3::new(sin_phi * s, y as f32, -cos_phi * s)
    }
}
