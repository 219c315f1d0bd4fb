//! Importance sampling of environment maps.
use std::sync::Arc;

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::environment::{EnvironmentMap, direction_in_texel};
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance;

/// Entries of a cumulative distribution per slot of its guide table. Four of them share a cache
/// line with their neighbours, and the table stays a quarter of the size.
const PER_SLOT: usize = 4;

/// An environment map that can be sampled in proportion to luminance times solid angle.
///
/// A row is drawn from the marginal distribution, a column from the row's conditional one, a
/// direction uniformly (in solid angle) from the texel. All are monotone maps of one random
/// number each, so that stratified points stay stratified. Guide tables [Chen and Asau 1974]
/// start the searches at most a few entries away from their end.
#[derive(Clone, Debug)]
pub struct EnvironmentSampler {
    map: Arc<EnvironmentMap>,
    /// `cos` of the polar angle between rows, `H + 1` of them.
    row_cos: Vec<f64>,
    rows: Cumulative,
    /// The conditional distributions, row by row.
    columns: Cumulative,
    /// One over the luminance integrated over the sphere; 0 for a black map.
    inverse_total: f64,
}

/// Cumulative distributions of equal length, one after another.
#[derive(Clone, Debug)]
struct Cumulative {
    length: usize,
    /// Running sums without the leading 0; from the last positive mass on exactly 1.
    sums: Vec<f32>,
    /// Per slot of `[0, 1)`, the first entry above the slot's start; then the last entry.
    guide: Vec<u32>,
}

impl Cumulative {
    /// `count` distributions over `length` entries, and their totals; `masses(k, into)` writes
    /// those of distribution `k`.
    fn new(
        count: usize,
        length: usize,
        masses: impl Fn(usize, &mut [f64]) + Sync,
    ) -> (Self, Vec<f64>) {
        let slots = length.div_ceil(PER_SLOT);
        let mut sums = vec![0f32; count * length];
        let mut guide = vec![0u32; count * (slots + 1)];
        let totals = sums
            .par_chunks_mut(length)
            .zip(guide.par_chunks_mut(slots + 1))
            .enumerate()
            .map_init(
                || vec![0f64; length],
                |row, (k, (sums, guide))| {
                    masses(k, row);
                    let total = cumulate(row, sums);
                    fill_guide(sums, guide);
                    total
                },
            )
            .collect();
        let tables = Self {
            length,
            sums,
            guide,
        };
        (tables, totals)
    }

    /// In distribution `k`, the first entry above `u` and where in it `u` falls, in `[0, 1)`.
    #[inline]
    fn invert(&self, k: usize, u: f32) -> (usize, f32) {
        let sums = &self.sums[k * self.length..(k + 1) * self.length];
        let slots = self.length.div_ceil(PER_SLOT);
        let guide = &self.guide[k * (slots + 1)..(k + 1) * (slots + 1)];
        let slot = ((u * slots as f32) as usize).min(slots - 1);
        let (low, high) = (guide[slot] as usize, guide[slot + 1] as usize);
        let entry = low + sums[low..high].partition_point(|&c| c <= u);
        let below = if entry == 0 { 0.0 } else { sums[entry - 1] };
        let fraction = (u - below) / (sums[entry] - below);
        (entry, fraction.clamp(0.0, 1.0 - f32::EPSILON))
    }
}

/// Writes the normalised running sum of `masses`; returns the total.
fn cumulate(masses: &[f64], sums: &mut [f32]) -> f64 {
    let total: f64 = masses.iter().sum();
    if total > 0.0 {
        let mut sum = 0.0;
        for (c, m) in sums.iter_mut().zip(masses) {
            sum += m;
            *c = (sum / total) as f32;
        }
        let last = masses.iter().rposition(|&m| m > 0.0).unwrap_or(0);
        sums[last..].fill(1.0);
    }
    total
}

fn fill_guide(sums: &[f32], guide: &mut [u32]) {
    let slots = guide.len() - 1;
    let mut entry = 0;
    for (slot, first) in guide[..slots].iter_mut().enumerate() {
        let start = slot as f32 / slots as f32;
        while entry + 1 < sums.len() && sums[entry] <= start {
            entry += 1;
        }
        *first = entry as u32;
    }
    // The last slot ends at the first entry that reaches 1, not among black ones behind it.
    guide[slots] = sums.partition_point(|&c| c < 1.0).min(sums.len() - 1) as u32;
}

impl EnvironmentSampler {
    /// Tabulates the distribution of `map`.
    pub fn new(map: impl Into<Arc<EnvironmentMap>>) -> Self {
        let map = map.into();
        let (w, h) = (map.width(), map.height());
        let (columns, totals) = Cumulative::new(h, w, |i, masses| {
            for (j, m) in masses.iter_mut().enumerate() {
                *m = luminance(map.texel(i, j)).into();
            }
        });
        let (rows, total) = Cumulative::new(1, h, |_, masses| {
            for (i, m) in masses.iter_mut().enumerate() {
                *m = totals[i] * map.solid_angle(i);
            }
        });
        let row_cos = (0..=h)
            .map(|i| (std::f64::consts::PI * i as f64 / h as f64).cos())
            .collect();
        Self {
            row_cos,
            rows,
            columns,
            inverse_total: if total[0] > 0.0 { 1.0 / total[0] } else { 0.0 },
            map,
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
        let (i, v) = self.rows.invert(0, u.y);
        let (j, u) = self.columns.invert(i, u.x);
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

    #[inline]
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        Self::eval_pdf(self, direction)
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
