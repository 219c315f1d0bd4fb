//! What every scattering function must satisfy, checked against quadrature in f64.
//!
//! The sphere of `wi` is covered by half vectors: polar angle `theta = alpha sinh(k v)` from
//! the normal, `v` in [0, 1], so that the narrowest lobe and the widest share one grid;
//! `d wi = 4 (wo.h) d h`. Transmitted directions are mirrored into the upper half first.
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::stats::chi_squared_p_value;
use dipir_numerics::warp::Frame;
use glam::{DVec3, Vec2, Vec3};
use std::f64::consts::{FRAC_PI_2, TAU};

use super::{Bsdf, BsdfSample};
use crate::surface::SurfacePoint;

const RADIAL_BINS: usize = 16;
const ANGULAR_BINS: usize = 12;
const SAMPLES: u64 = 20_000;
const MIN_EXPECTED: f64 = 8.0;

/// A surface seen from one direction.
pub(super) trait Scatter {
    fn eval_pdf(&self, wi: Vec3) -> (Vec3, f32);
    fn sample(&self, u_lobe: f32, u: Vec2) -> Option<BsdfSample>;
    fn albedo(&self) -> Vec3;
}

impl<const F: u32> Scatter for Bsdf<F> {
    fn eval_pdf(&self, wi: Vec3) -> (Vec3, f32) {
        Bsdf::eval_pdf(self, wi)
    }
    fn sample(&self, u_lobe: f32, u: Vec2) -> Option<BsdfSample> {
        Bsdf::sample(self, u_lobe, u)
    }
    fn albedo(&self) -> Vec3 {
        Bsdf::albedo(self)
    }
}

/// A case of the harness: a surface whose normal is `Vec3::Z` turned into `normal`.
pub(super) struct Case<'a> {
    pub name: String,
    pub surface: SurfacePoint,
    pub prepare: &'a dyn Fn(&SurfacePoint, Vec3) -> Box<dyn Scatter>,
    /// Cosine of `wo`.
    pub cosine: f32,
    /// Width of the narrowest lobe, which the grid must resolve.
    pub alpha: f64,
    pub transmits: bool,
}

/// What quadrature and sampling say of one case.
#[derive(Debug)]
pub(super) struct Measured {
    /// Light returned under a white sky, delta lobes included.
    pub albedo: DVec3,
    /// p-value of the hypothesis that `sample` draws what `pdf` says.
    pub p_value: f64,
    /// Largest weight that `sample` gave.
    pub max_weight: f32,
    /// What the function says of itself.
    pub claimed_albedo: DVec3,
}

fn uniform(keys: &[u64]) -> f32 {
    (hash_u64s(keys) >> 40) as f32 / 16_777_216.0
}

/// Bins that expect at least [`MIN_EXPECTED`] of `n` samples, and one bin for all others and
/// for samples that have no density: lost below the horizon, or drawn from a delta lobe. What
/// this last one expects is what is missing to `n`, so a density that does not integrate to
/// the share of samples that have one is found out; where that is next to nothing, as many
/// counts as quadrature may have missed are let pass.
fn pool(observed: &[f64], mass: &[f64], n: f64) -> (Vec<f64>, Vec<f64>) {
    let (mut o, mut e): (Vec<f64>, Vec<f64>) = observed
        .iter()
        .zip(mass)
        .map(|(o, m)| (*o, m * n))
        .filter(|(_, e)| *e >= MIN_EXPECTED)
        .unzip();
    let (rest_o, rest_e) = (n - o.iter().sum::<f64>(), n - e.iter().sum::<f64>());
    if rest_e >= MIN_EXPECTED || rest_o > 4.0 * MIN_EXPECTED {
        o.push(rest_o);
        e.push(rest_e.max(MIN_EXPECTED));
    }
    (o, e)
}

impl Case<'_> {
    fn frame(&self) -> Frame {
        Frame::from_normal(self.surface.normal)
    }

    pub fn wo(&self) -> Vec3 {
        let z = self.cosine as f64;
        let x = (1.0 - z * z).sqrt();
        let (s, c) = 0.7f64.sin_cos();
        let local = DVec3::new(x * c, x * s, z).as_vec3();
        self.frame().to_world(local).normalize()
    }

    /// Rate of the polar angle's growth over the grid.
    fn rate(&self) -> f64 {
        (FRAC_PI_2 / self.alpha).asinh()
    }

    /// The direction at `(v, angle)` of the grid and its measure `d wi / (d v d angle)`.
    fn direction(&self, wo: DVec3, v: f64, angle: f64, below: bool) -> Option<(Vec3, f64)> {
        let k = self.rate();
        let theta = self.alpha * (k * v).sinh();
        let growth = self.alpha * k * (k * v).cosh();
        let (s, c) = theta.sin_cos();
        let h = DVec3::new(s * angle.cos(), s * angle.sin(), c);
        let cosine = wo.dot(h);
        let mut wi = 2.0 * cosine * h - wo;
        if cosine <= 0.0 || wi.z <= 0.0 {
            return None;
        }
        if below {
            wi.z = -wi.z;
        }
        let f = self.frame();
        let world = f.tangent.as_dvec3() * wi.x
            + f.bitangent.as_dvec3() * wi.y
            + f.normal.as_dvec3() * wi.z;
        Some((world.as_vec3(), 4.0 * cosine * s * growth))
    }

    /// The bin of a drawn direction.
    fn bin(&self, wo: DVec3, wi: Vec3) -> usize {
        let f = self.frame();
        let to_local = |v: DVec3| {
            DVec3::new(
                f.tangent.as_dvec3().dot(v),
                f.bitangent.as_dvec3().dot(v),
                f.normal.as_dvec3().dot(v),
            )
        };
        let mut local = to_local(wi.as_dvec3());
        let below = local.z < 0.0;
        local.z = local.z.abs();
        let h = (local + wo).normalize();
        let theta = h.truncate().length().atan2(h.z);
        let v = (theta / self.alpha).asinh() / self.rate();
        let angle = h.y.atan2(h.x).rem_euclid(TAU) / TAU;
        let row = ((v * RADIAL_BINS as f64) as usize).min(RADIAL_BINS - 1);
        let column = ((angle * ANGULAR_BINS as f64) as usize).min(ANGULAR_BINS - 1);
        (usize::from(below) * RADIAL_BINS + row) * ANGULAR_BINS + column
    }

    /// Integrals of value and density over each bin, by `steps`^2 midpoints a bin.
    fn integrate(&self, bsdf: &dyn Scatter, wo: DVec3, steps: usize) -> (DVec3, Vec<f64>) {
        let sides = 1 + usize::from(self.transmits);
        let mut mass = vec![0.0; sides * RADIAL_BINS * ANGULAR_BINS];
        let mut albedo = DVec3::ZERO;
        let (rows, columns) = (RADIAL_BINS * steps, ANGULAR_BINS * steps);
        let area = TAU / (rows * columns) as f64;
        for side in 0..sides {
            for row in 0..rows {
                for column in 0..columns {
                    // Shifted from column to column, so that the horizon, a circle at normal
                    // incidence, does not cut all cells of a row in the same way.
                    let shift = (column as f64 * 0.618_033_988_75).fract();
                    let v = (row as f64 + shift) / rows as f64;
                    let angle = TAU * (column as f64 + 0.5) / columns as f64;
                    let Some((wi, measure)) = self.direction(wo, v, angle, side == 1) else {
                        continue;
                    };
                    let (value, pdf) = bsdf.eval_pdf(wi);
                    assert!(
                        value.is_finite() && pdf.is_finite() && value.min_element() >= 0.0,
                        "{}: value {value}, density {pdf} at {wi}",
                        self.name
                    );
                    albedo += value.as_dvec3() * (measure * area);
                    let bin = (side * RADIAL_BINS + row / steps) * ANGULAR_BINS + column / steps;
                    mass[bin] += pdf as f64 * measure * area;
                }
            }
        }
        (albedo, mass)
    }

    /// Whether unit vectors in f32 resolve the narrowest lobe: where light grazes, it is as
    /// narrow as `alpha * max(cosine, alpha)`, and the half vector's rounding must be small
    /// against that.
    fn is_resolved(&self) -> bool {
        self.alpha * self.alpha.max(self.cosine as f64) > 200.0 * 6e-8
    }

    /// Runs the sampling checks and returns what they measured.
    pub fn measure(&self) -> Measured {
        let wo = self.wo();
        let bsdf = (self.prepare)(&self.surface, wo);
        let f = self.frame();
        let local = DVec3::new(
            f.tangent.as_dvec3().dot(wo.as_dvec3()),
            f.bitangent.as_dvec3().dot(wo.as_dvec3()),
            f.normal.as_dvec3().dot(wo.as_dvec3()).max(1e-9),
        );
        let resolved = self.is_resolved();
        let (mut albedo, mass) = self.integrate(&*bsdf, local, 8);
        let mut observed = vec![0.0; mass.len() + 1];
        let (mut delta, mut sum, mut squares) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
        let mut max_weight = 0f32;
        for i in 0..SAMPLES {
            let key = |d: u64| uniform(&[7, i, d, self.cosine.to_bits() as u64]);
            let Some(s) = bsdf.sample(key(0), Vec2::new(key(1), key(2))) else {
                observed[mass.len()] += 1.0;
                continue;
            };
            assert!(s.weight.is_finite() && s.weight.min_element() >= 0.0);
            assert!(
                (s.wi.length() - 1.0).abs() < 1e-5,
                "{}: {}",
                self.name,
                s.wi
            );
            max_weight = max_weight.max(s.weight.max_element());
            let weight = s.weight.as_dvec3();
            sum += weight;
            squares += weight * weight;
            if s.delta {
                assert_eq!(s.pdf, f32::INFINITY);
                observed[mass.len()] += 1.0;
                delta += weight;
                continue;
            }
            let (value, pdf) = bsdf.eval_pdf(s.wi);
            assert_eq!((value / pdf, pdf), (s.weight, s.pdf), "{}", self.name);
            observed[self.bin(local, s.wi)] += 1.0;
        }
        let n = SAMPLES as f64;
        albedo += delta / n;
        let (observed, expected) = pool(&observed, &mass, n);
        let mean = sum / n;
        if !resolved {
            // Rounded directions are too coarse a grid for the lobe, but weights are right.
            return Measured {
                albedo: mean,
                p_value: 1.0,
                max_weight,
                claimed_albedo: bsdf.albedo().as_dvec3(),
            };
        }
        let error = ((squares / n - mean * mean).max(DVec3::ZERO) / n).map(f64::sqrt);
        // Five standard errors, and the quadrature's own error.
        assert!(
            (mean - albedo).abs().cmple(5.0 * error + 4e-3).all(),
            "{}: samples return {mean} +- {error}, quadrature {albedo}",
            self.name
        );
        Measured {
            albedo,
            p_value: chi_squared_p_value(&observed, &expected, MIN_EXPECTED),
            max_weight,
            claimed_albedo: bsdf.albedo().as_dvec3(),
        }
    }

    /// Largest relative difference of `f(wo, wi)` and `f(wi, wo)` over pairs of directions.
    pub fn asymmetry(&self) -> f32 {
        let frame = self.frame();
        let mut worst = 0f32;
        for i in 0..500 {
            let key = |d: u64| uniform(&[11, i, d]);
            let at = |z: f32, angle: f32| {
                let r = (1.0 - z * z).max(0.0).sqrt();
                Vec3::new(r * angle.cos(), r * angle.sin(), z)
            };
            // Cosines down to 1e-6, half of all pairs near each other's mirror direction.
            let z = key(0).powi(1 + (i % 4) as i32 * 2).max(1e-6);
            let wo = at(z, 6.3 * key(1));
            let mut wi = match i % 2 {
                0 => at(key(2).max(1e-6), 6.3 * key(3)),
                _ => {
                    let spread = self.alpha as f32;
                    let h = Vec3::new(spread * (key(2) - 0.5), spread * (key(3) - 0.5), 1.0);
                    super::ggx::reflect(wo, h.normalize()).0
                }
            };
            // Beyond that a half vector's rounding shows: see `is_resolved`.
            let width = self.alpha * self.alpha.max((wo.z + wi.z) as f64);
            if wi.z <= 0.0 || width < 200.0 * 6e-8 {
                continue;
            }
            if self.transmits && i % 3 == 0 {
                wi.z = -wi.z;
            }
            let (a, b) = (frame.to_world(wo), frame.to_world(wi));
            let turned = |to: Vec3| {
                // Seen from the other side, the surface shows its other side.
                let flip = if to.dot(self.surface.normal) < 0.0 {
                    -1.0
                } else {
                    1.0
                };
                let mut s = self.surface;
                s.normal *= flip;
                s.geometric_normal *= flip;
                s.coat.normal *= flip;
                (self.prepare)(&s, to)
            };
            let cosine = |w: Vec3| w.dot(self.surface.normal).abs();
            let (forth, pdf) = turned(a).eval_pdf(b);
            let (forth, pdf) = (forth / cosine(b), pdf / cosine(b));
            let back = turned(b).eval_pdf(a).0 / cosine(a);
            // Schlick's (1 - cos)^5 of a black metal has no digits where it is next to 0.
            let scale = forth.abs().max(back.abs()).max_element().max(1e-4 * pdf);
            if scale > 1e-6 {
                worst = worst.max((forth - back).abs().max_element() / scale);
            }
        }
        worst
    }
}
