//! Importance sampling of environment maps.
use std::sync::Arc;

use glam::{Vec2, Vec3};

use crate::environment::{EnvironmentMap, direction_in_texel};
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance;

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
        let w = self.map.width();
        let (i, v) = invert(&self.rows, u.y);
        let (j, u) = invert(&self.columns[i * w..(i + 1) * w], u.x);
        let radiance = self.map.texel(i, j);
        let direction = direction_in_texel(&self.map, &self.row_cos, i, j, Vec2::new(u, v));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{chi_squared, speckled, uniform};

    /// Eleven chi-squared tests in the crate at a familywise level of 1e-3, with fixed seeds: a
    /// pass is reproducible, and a wrong density fails by many orders of magnitude.
    const LEVEL: f64 = 1e-4;

    #[test]
    fn samples_follow_the_density_of_the_map() {
        for (w, h) in [(2, 1), (1, 1), (16, 8), (24, 12)] {
            let s = EnvironmentSampler::new(speckled(w, h));
            let p = chi_squared(
                (w * 2, h * 2),
                2,
                100_000,
                |u| s.sample(u).direction,
                |d| s.pdf(d),
                1e-5,
            );
            assert!(p > LEVEL, "{w} x {h}: p = {p}");
        }
    }

    #[test]
    fn a_sample_carries_what_eval_and_pdf_say_of_its_direction() {
        for (w, h) in [(2, 1), (1, 1), (2, 2), (128, 64), (4096, 2048)] {
            let s = EnvironmentSampler::new(speckled(w, h));
            let corners = [0.0, 1.0 - f32::EPSILON / 2.0, 0.5];
            let corners = (0..9).map(|k| Vec2::new(corners[k / 3], corners[k % 3]));
            for u in corners.chain((0..20_000).map(uniform)) {
                let drawn = s.sample(u);
                assert!(drawn.pdf > 0.0);
                assert!((drawn.direction.length() - 1.0).abs() < 1e-6);
                assert_eq!(
                    s.eval_pdf(drawn.direction),
                    (drawn.radiance, drawn.pdf),
                    "{w} x {h} {u}"
                );
            }
        }
    }

    #[test]
    fn one_texel_at_1e6_takes_nearly_every_sample_and_the_estimate_is_exact() {
        let mut texels = vec![Vec3::splat(1e-3); 64 * 128];
        texels[20 * 128 + 7] = Vec3::splat(1e6);
        let map = EnvironmentMap::new(128, 64, texels).unwrap();
        let exact = map.integral().x;
        let s = EnvironmentSampler::new(map);
        // Achromatic light: radiance / pdf is the integral, whatever was drawn.
        for k in 0..1000 {
            let drawn = s.sample(uniform(k));
            let estimate = f64::from(drawn.radiance.x) / f64::from(drawn.pdf);
            assert!((estimate / exact - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn a_black_map_gives_no_sample_and_density_zero() {
        let s = EnvironmentSampler::new(EnvironmentMap::constant(4, 2, Vec3::ZERO));
        let drawn = s.sample(Vec2::new(0.3, 0.6));
        assert_eq!((drawn.pdf, drawn.radiance), (0.0, Vec3::ZERO));
        assert_eq!(s.pdf(Vec3::X), 0.0);
    }

    #[test]
    fn black_texels_are_never_drawn() {
        let texels = (0..8 * 4).map(|k| if k % 3 == 0 { Vec3::ONE } else { Vec3::ZERO });
        let map = EnvironmentMap::new(8, 4, texels.collect()).unwrap();
        let s = EnvironmentSampler::new(map);
        let edges = [0.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.0 - f32::EPSILON / 2.0];
        for &x in &edges {
            for &y in &edges {
                assert_eq!(s.sample(Vec2::new(x, y)).radiance, Vec3::ONE);
            }
        }
    }
}
