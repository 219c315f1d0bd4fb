//! Drawing light directions for a plane from inside a cone, such as the one around an object
//! that may cast a shadow there.
use std::f64::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use crate::cosine::CosineWeightedMap;
use crate::environment::{direction_in_column, direction_in_texel, inset};
use crate::luminance::luminance;

/// A direction drawn from a cone in proportion to what it adds to a plane's irradiance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConeSample {
    /// Unit vector towards the light, world space.
    pub direction: Vec3,
    /// Radiance arriving from `direction`, linear Rec.709.
    pub radiance: Vec3,
    /// `max(0, n . direction)`.
    pub cosine: f32,
    /// Density per steradian of the restricted distribution; positive for a drawn sample.
    pub pdf: f32,
    /// `radiance * cosine / pdf`: the mean of `weight * f` estimates the integral of
    /// `radiance * cosine * f` over the cone for every `f` that is zero outside it.
    pub weight: Vec3,
}

impl ConeSample {
    /// What is drawn where there is no light: adds nothing.
    pub const NONE: Self = Self {
        direction: Vec3::Y,
        radiance: Vec3::ZERO,
        cosine: 0.0,
        pdf: 0.0,
        weight: Vec3::ZERO,
    };
}

/// Columns of one band of rows that a cone touches.
#[derive(Clone, Copy, Debug, Default)]
struct Interval {
    start: usize,
    /// Columns from `start` on, wrapping around.
    count: usize,
}

/// Samples a [`CosineWeightedMap`] inside one cone after another.
///
/// A cone selects, per band of rows, the interval of columns that it touches, rounded outward
/// to whole texels; `sample` draws a texel of these by its weight (luminance times the integral
/// of the cosine) and a direction from it, uniformly in solid angle, or in proportion to the
/// cosine where the plane is level, which leaves achromatic light no variance of its own.
/// `restrict` costs one arc cosine per band and two look-ups per row inside the cone; `sample`
/// one binary search over these rows and a short one from a guide table over columns. Neither
/// allocates.
#[derive(Clone, Debug)]
pub struct ConeSampler<'a> {
    map: &'a CosineWeightedMap,
    first_band: usize,
    intervals: Vec<Interval>,
    /// Mass up to and with each row of these bands.
    rows: Vec<f64>,
    /// `cos`, `sin` of the polar angle between bands.
    band_edges: Vec<(f64, f64)>,
}

impl<'a> ConeSampler<'a> {
    /// A sampler over `map`, restricted to nothing yet.
    pub fn new(map: &'a CosineWeightedMap) -> Self {
        let h = map.map.height();
        let bands = h.div_ceil(map.band_rows);
        let edge = |b: usize| {
            let theta = PI * (b * map.band_rows).min(h) as f64 / h as f64;
            (theta.cos(), theta.sin())
        };
        Self {
            map,
            first_band: 0,
            intervals: Vec::with_capacity(bands),
            rows: Vec::with_capacity(h),
            band_edges: (0..=bands).map(edge).collect(),
        }
    }

    /// Restricts to directions within the angle `acos(cos_max)` of the unit vector `axis`.
    /// `cos_max` of -1 selects the whole sphere.
    pub fn restrict(&mut self, axis: Vec3, cos_max: f32) {
        // f32 keeps the cosine of a narrow cone to 6e-8 and an axis to 1e-7: widen by that.
        let cos_max = (f64::from(cos_max) - 2e-7).max(-1.0);
        let axis = axis.as_dvec3();
        let sin_a = axis.x.hypot(axis.z);
        let theta_a = sin_a.atan2(axis.y);
        let phi_a = axis.x.atan2(-axis.z);
        let (sin_a, cos_a) = theta_a.sin_cos();
        let alpha = cos_max.min(1.0).acos() + 1e-7;
        let cos_max = alpha.min(PI).cos();
        let bands = self.band_edges.len() - 1;
        let band_of = |theta: f64| {
            let row = theta.clamp(0.0, PI) / PI * self.map.map.height() as f64;
            (row as usize / self.map.band_rows).min(bands - 1)
        };
        self.first_band = band_of(theta_a - alpha);
        let last = band_of(theta_a + alpha);
        self.intervals.clear();
        self.rows.clear();
        let (w, h) = (self.map.map.width(), self.map.map.height());
        let mut mass = 0.0;
        for band in self.first_band..=last {
            let half = self.half_azimuth(band, cos_a, sin_a, cos_max);
            let (start, count) = column_interval(phi_a, half, w);
            self.intervals.push(Interval { start, count });
            let first = band * self.map.band_rows;
            for i in first..(first + self.map.band_rows).min(h) {
                mass += interval_mass(self.map.row_prefix(i), start, count);
                self.rows.push(mass);
            }
        }
    }

    /// Half the range of azimuth, in radians, that the cone covers anywhere in `band`; negative
    /// if it covers none. On the circle of polar angle `theta` the cone's edge lies where
    /// `cos(phi - phi_a) = (cos_max - cos theta cos_a) / (sin theta sin_a)`, least at the ends
    /// of the band or where `cos theta = cos_a / cos_max`.
    fn half_azimuth(&self, band: usize, cos_a: f64, sin_a: f64, cos_max: f64) -> f64 {
        let edge = |cos: f64, sin: f64| {
            let (n, d) = (cos_max - cos * cos_a, sin * sin_a);
            if d > 1e-12 {
                n / d
            } else if n > 0.0 {
                f64::INFINITY
            } else {
                f64::NEG_INFINITY
            }
        };
        let (upper, lower) = (self.band_edges[band], self.band_edges[band + 1]);
        let mut least = edge(upper.0, upper.1).min(edge(lower.0, lower.1));
        let turn = cos_a / cos_max;
        if turn < upper.0 && turn > lower.0 {
            least = least.min(edge(turn, (1.0 - turn * turn).max(0.0).sqrt()));
        }
        if least >= 1.0 {
            -1.0
        } else {
            least.max(-1.0).acos()
        }
    }

    /// Luminance of the irradiance that the selected texels give; 0 for no light.
    pub fn mass(&self) -> f64 {
        self.rows.last().copied().unwrap_or(0.0)
    }

    /// Draws a direction from two uniform numbers in `[0, 1)`; [`ConeSample::NONE`] without light.
    pub fn sample(&self, u: Vec2) -> ConeSample {
        let mass = self.mass();
        if mass <= 0.0 {
            return ConeSample::NONE;
        }
        let (i, j, within) = self.draw_texel(u, mass);
        let map = &*self.map.map;
        let radiance = map.texel(i, j);
        if let Some(up) = self.map.level {
            let direction = self.direction_by_cosine(i, j, within, up);
            let cosine = (up as f32 * direction.y).max(0.0);
            let per_cosine = f64::from(luminance(radiance)) / mass;
            return ConeSample {
                direction,
                radiance,
                cosine,
                pdf: (f64::from(cosine) * per_cosine) as f32,
                weight: radiance * (1.0 / per_cosine) as f32,
            };
        }
        let direction = direction_in_texel(map, &self.map.row_cos, i, j, within);
        let cosine = self.map.normal.dot(direction).max(0.0);
        let pdf = self.density(i, j, mass);
        ConeSample {
            direction,
            radiance,
            cosine,
            pdf: pdf as f32,
            weight: radiance * (f64::from(cosine) / pdf) as f32,
        }
    }

    /// A direction from texel `(i, j)` in proportion to its cosine to a level plane's normal,
    /// `up` times +y: uniform in the square of its height.
    #[inline]
    fn direction_by_cosine(&self, i: usize, j: usize, u: Vec2, up: f64) -> Vec3 {
        let map = &*self.map.map;
        let inset = inset(map.width(), map.height());
        let within = inset + u * (Vec2::ONE - 2.0 * inset);
        let square = |y: f64| (y * up).max(0.0).powi(2);
        let (near, far) = (square(self.map.row_cos[i]), square(self.map.row_cos[i + 1]));
        let y = up * (near + (far - near) * f64::from(within.y)).sqrt();
        direction_in_column(map.width(), j, within.x, y)
    }

    /// Density per steradian of [`sample`](Self::sample) at `direction`.
    pub fn pdf(&self, direction: Vec3) -> f32 {
        let mass = self.mass();
        let (i, j) = self.map.map.texel_of(direction);
        let band = i / self.map.band_rows;
        let w = self.map.map.width();
        let Some(interval) = band
            .checked_sub(self.first_band)
            .and_then(|k| self.intervals.get(k))
        else {
            return 0.0;
        };
        if mass <= 0.0 || (j + w - interval.start) % w >= interval.count {
            return 0.0;
        }
        match self.map.level {
            Some(up) => {
                let cosine = (up as f32 * direction.y).max(0.0);
                let per_cosine = f64::from(luminance(self.map.map.texel(i, j))) / mass;
                (f64::from(cosine) * per_cosine) as f32
            }
            None => self.density(i, j, mass) as f32,
        }
    }

    /// Density per steradian over texel `(i, j)`, where positions are uniform in solid angle.
    #[inline]
    fn density(&self, i: usize, j: usize, mass: f64) -> f64 {
        let k = i * self.map.map.width() + j;
        let weight = luminance(self.map.map.texels()[k]) as f64 * self.map.mean_cosine[k] as f64;
        weight / mass
    }

    /// Row, column and position inside the texel.
    #[inline]
    fn draw_texel(&self, u: Vec2, mass: f64) -> (usize, usize, Vec2) {
        let target = f64::from(u.y) * mass;
        let mut k = self.rows.partition_point(|&m| m <= target);
        // Past the end by rounding: the last row that has any light.
        k = k.min(self.rows.len() - 1);
        let below = |k: usize| if k == 0 { 0.0 } else { self.rows[k - 1] };
        while self.rows[k] <= below(k) {
            k -= 1;
        }
        let row_mass = self.rows[k] - below(k);
        let v = ((target - below(k)) / row_mass).clamp(0.0, 1.0);
        let i = self.first_band * self.map.band_rows + k;
        let Interval { start, count } = self.intervals[k / self.map.band_rows];
        let (j, x) = self
            .map
            .pick_column(i, start, count, f64::from(u.x) * row_mass);
        (i, j, Vec2::new(x, v as f32))
    }
}

/// The running sum `prefix` over `count` columns from `start`, wrapping around.
#[inline]
fn interval_mass(prefix: &[f64], start: usize, count: usize) -> f64 {
    let w = prefix.len() - 1;
    let end = start + count;
    if end <= w {
        prefix[end] - prefix[start]
    } else {
        (prefix[w] - prefix[start]) + prefix[end - w]
    }
}

/// First column and number of columns that the azimuths within `half` of `phi` touch.
fn column_interval(phi: f64, half: f64, width: usize) -> (usize, usize) {
    if half < 0.0 {
        return (0, 0);
    }
    // Twice the rounding of an f32 axis, so that the cone's edge is never cut.
    let half = half + 3e-7;
    let per_column = TAU / width as f64;
    let low = ((phi - half) / per_column).floor();
    let high = ((phi + half) / per_column).floor();
    let count = (high - low) as usize + 1;
    if half >= PI || count >= width {
        return (0, width);
    }
    ((low as i64).rem_euclid(width as i64) as usize, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::EnvironmentMap;
    use crate::testing::{chi_squared, directions, speckled, uniform};

    #[test]
    fn every_direction_of_the_cone_has_its_density() {
        for (w, h) in [(2, 1), (1, 1), (7, 5), (64, 32), (256, 200)] {
            let map = CosineWeightedMap::new(EnvironmentMap::constant(w, h, Vec3::ONE), Vec3::Y);
            let mut cone = map.cone();
            for axis in directions() {
                for half_angle in [0.0f32, 1e-3, 0.05, 0.4, 1.2, 1.6, 3.0, 3.15] {
                    cone.restrict(axis, half_angle.min(std::f32::consts::PI).cos());
                    let frame = dipir_numerics::warp::Frame::from_normal(axis);
                    for k in 0..200 {
                        let u = uniform(k);
                        // Every other direction lies on the cone's very edge.
                        let angle = half_angle * if k % 2 == 0 { 1.0 } else { u.x };
                        let (s, c) = angle.sin_cos();
                        let (t, b) = (u.y * std::f32::consts::TAU).sin_cos();
                        let d = frame.to_world(Vec3::new(s * b, s * t, c)).normalize();
                        let inside =
                            axis.as_dvec3().dot(d.as_dvec3()) >= f64::from(half_angle.cos());
                        if inside && d.y > 1e-3 {
                            assert!(
                                cone.pdf(d) > 0.0,
                                "{w} x {h}, axis {axis}, {half_angle}, {d}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_cone_selects_few_texels_beyond_itself() {
        let map = EnvironmentMap::constant(512, 256, Vec3::ONE);
        let map = CosineWeightedMap::new(map, Vec3::Y);
        let mut cone = map.cone();
        let half_angle = 20f32.to_radians();
        for axis in [
            Vec3::new(0.3, 0.5, 0.8),
            Vec3::Y,
            Vec3::new(0.01, 0.6, -1.0),
        ] {
            let axis = axis.normalize();
            cone.restrict(axis, half_angle.cos());
            // The irradiance from a cone wholly above the horizon is pi sin^2 a cos(axis).
            let exact =
                std::f64::consts::PI * f64::from(half_angle.sin()).powi(2) * f64::from(axis.y);
            let ratio = cone.mass() / exact;
            // A band is 4 rows or 2.8 degrees: (22.8 / 20)^2 if it adds one all around.
            assert!((1.0..1.3).contains(&ratio), "{axis}: {ratio}");
        }
    }

    #[test]
    fn samples_follow_the_density_of_the_cone() {
        let tilted = Vec3::new(0.3, 0.9, 0.1).normalize();
        for (size, normal, axis, half_angle) in [
            ((16, 8), tilted, Vec3::Y, 0.6f32),
            ((16, 8), tilted, Vec3::new(0.1, 0.4, -1.0), 0.5),
            ((16, 8), Vec3::Y, Vec3::X, PI as f32),
            ((16, 7), Vec3::Y, Vec3::new(0.1, 0.4, -1.0), 1.0),
            ((16, 7), Vec3::NEG_Y, Vec3::new(-0.4, -0.2, 0.3), 0.7),
        ] {
            let map = CosineWeightedMap::new(speckled(size.0, size.1), normal);
            let mut cone = map.cone();
            cone.restrict(axis.normalize(), half_angle.cos());
            let draw = |u| cone.sample(u).direction;
            let grid = (2 * size.0, 2 * size.1);
            let p = chi_squared(grid, 8, 100_000, draw, |d| cone.pdf(d), 1e-3);
            assert!(p > 1e-4, "{size:?} {normal} {axis} {half_angle}: p = {p}");
        }
    }

    #[test]
    fn on_a_level_plane_achromatic_light_has_one_weight() {
        let sky = speckled(16, 8);
        let grey = sky.texels().iter().map(|t| Vec3::splat(t.x)).collect();
        let map = EnvironmentMap::new(16, 8, grey).unwrap();
        let map = CosineWeightedMap::new(map, Vec3::Y);
        let mut cone = map.cone();
        cone.restrict(Vec3::new(0.1, 0.9, 0.3).normalize(), 0.8);
        for k in 0..1000 {
            let s = cone.sample(uniform(k));
            assert!((f64::from(s.weight.x) / cone.mass() - 1.0).abs() < 1e-6);
            assert!(
                (s.weight - s.radiance * s.cosine / s.pdf)
                    .abs()
                    .max_element()
                    < 1e-5 * s.weight.x
            );
        }
    }

    #[test]
    fn a_sample_carries_the_density_of_its_direction() {
        for normal in [Vec3::Y, Vec3::new(0.0, 1.0, 0.1).normalize()] {
            let map = CosineWeightedMap::new(speckled(64, 33), normal);
            let mut cone = map.cone();
            cone.restrict(Vec3::new(-0.02, 0.5, -1.0).normalize(), 0.8);
            let corners = [0.0, 1.0 - f32::EPSILON / 2.0];
            let corners = (0..4).map(|k| Vec2::new(corners[k / 2], corners[k % 2]));
            for u in corners.chain((0..20_000).map(uniform)) {
                let s = cone.sample(u);
                assert!(s.pdf > 0.0 && s.weight.is_finite());
                assert_eq!(cone.pdf(s.direction), s.pdf, "{u}");
                assert_eq!(map.map().eval(s.direction), s.radiance);
            }
        }
    }

    #[test]
    fn the_mean_weight_is_the_irradiance_from_the_cone() {
        let map = CosineWeightedMap::new(speckled(32, 16), Vec3::new(0.2, 0.9, 0.1).normalize());
        let mut cone = map.cone();
        cone.restrict(Vec3::new(0.2, 0.7, 0.5).normalize(), 0.8);
        let mut mean = dipir_numerics::stats::Running::default();
        for k in 0..40_000 {
            mean.push(luminance(cone.sample(uniform(k)).weight).into());
        }
        let error = (mean.mean() - cone.mass()).abs();
        assert!(
            error < 5.0 * mean.std_error(),
            "{} against {}",
            mean.mean(),
            cone.mass()
        );
    }

    #[test]
    fn below_the_horizon_and_in_the_dark_there_is_no_sample() {
        let dark = EnvironmentMap::constant(8, 4, Vec3::ZERO);
        let bright = EnvironmentMap::constant(8, 4, Vec3::ONE);
        for (map, axis) in [(dark, Vec3::Y), (bright, Vec3::NEG_Y)] {
            let map = CosineWeightedMap::new(map, Vec3::Y);
            let mut cone = map.cone();
            assert_eq!(cone.sample(Vec2::splat(0.5)), ConeSample::NONE);
            cone.restrict(axis, 0.99);
            assert_eq!(cone.mass(), 0.0);
            assert_eq!(cone.sample(Vec2::splat(0.5)), ConeSample::NONE);
            assert_eq!(cone.pdf(axis), 0.0);
        }
    }
}
