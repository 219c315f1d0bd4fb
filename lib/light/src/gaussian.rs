//! Spherical Gaussians: `G(v) = c exp(-(1 - v . mu) / sigma^2)`, a smooth lobe of light that
//! is a sun at sigma 1e-3 and a constant sky at sigma 10.
use std::f64::consts::{PI, TAU};

use dipir_numerics::guarded::{normalize_or, one_minus_cos};
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use crate::cosine::positive_part;
use crate::error::LightError;
use crate::quadrature::integrate_pieces;

pub use crate::mixture::SgMixture;

/// The narrowest lobe that is accepted, in radians: below it an f32 direction no longer
/// resolves the lobe's profile.
pub const MIN_SIGMA: f32 = 1e-4;

/// One lobe of light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SphericalGaussian {
    /// Unit vector towards the lobe's peak, world space.
    pub direction: Vec3,
    /// Radiance at the peak, linear Rec.709, not negative.
    pub radiance: Vec3,
    /// Width: for small values the lobe's standard deviation in radians. 1e-3 to 10.
    pub sigma: f32,
}

impl SphericalGaussian {
    /// Radiance arriving from the unit vector `v`. `1 - v . mu` is computed as
    /// `|v - mu|^2 / 2`, which keeps its digits inside narrow lobes.
    #[inline]
    pub fn eval(&self, v: Vec3) -> Vec3 {
        self.radiance * (-one_minus_cos(v, self.direction) / (self.sigma * self.sigma)).exp()
    }

    /// The integral of `exp(-(1 - v . mu) / sigma^2)` over the sphere, in steradians:
    /// `2 pi sigma^2 (1 - exp(-2 / sigma^2))`, through `expm1`, so that it keeps its digits
    /// from the narrowest lobe (`2 pi sigma^2`) to the widest (`4 pi`).
    #[inline]
    pub fn solid_angle(&self) -> f64 {
        let s2 = f64::from(self.sigma) * f64::from(self.sigma);
        -TAU * s2 * (-2.0 / s2).exp_m1()
    }

    /// Radiance integrated over the sphere, per channel.
    #[inline]
    pub fn integral(&self) -> DVec3 {
        self.radiance.as_dvec3() * self.solid_angle()
    }

    /// Irradiance of an unoccluded plane with unit vector `normal`: the integral of
    /// `eval(w) max(0, normal . w)`. Around the lobe's axis the integral over azimuth has a
    /// closed form; the one over the angle from the axis is Gauss-Legendre quadrature between
    /// the angles where that form changes, and converges to about 1e-9.
    pub fn irradiance(&self, normal: Vec3) -> DVec3 {
        let (n, mu) = (
            normal.as_dvec3().normalize(),
            self.direction.as_dvec3().normalize(),
        );
        let cos_axis = n.dot(mu);
        let sin_axis = n.cross(mu).length();
        let sigma = f64::from(self.sigma);
        let turn = cos_axis.abs().atan2(sin_axis);
        // Pieces that resolve the lobe: beyond 8 sigma it has fallen to exp(-32).
        let mut breaks = [turn, PI - turn, 0.0, 0.0, 0.0, 0.0, 0.0];
        for (k, b) in breaks[2..].iter_mut().enumerate() {
            *b = sigma * f64::from(1u32 << k) * 0.75;
        }
        let integral = integrate_pieces(0.0, PI, &mut breaks, |psi| {
            let (sin, cos) = psi.sin_cos();
            let half = (0.5 * psi).sin();
            let lobe = (-2.0 * half * half / (sigma * sigma)).exp();
            lobe * sin * positive_part(cos * cos_axis, sin * sin_axis, -PI, PI)
        });
        self.radiance.as_dvec3() * integral
    }

    /// The lobe with its direction normalised; an error names what describes no light, with
    /// the lobe's `index` in its list.
    pub fn checked(self, index: usize) -> Result<Self, LightError> {
        let refuse = |field, value: String, accepted| LightError::Lobe {
            index,
            field,
            value,
            accepted,
        };
        let direction = normalize_or(self.direction, Vec3::ZERO);
        if direction == Vec3::ZERO {
            let accepted = "a finite vector other than zero";
            return Err(refuse("direction", self.direction.to_string(), accepted));
        }
        if !self.radiance.is_finite() || self.radiance.min_element() < 0.0 {
            let accepted = "finite and not negative";
            return Err(refuse("radiance", self.radiance.to_string(), accepted));
        }
        if !(self.sigma.is_finite() && self.sigma >= MIN_SIGMA) {
            let accepted = "finite and at least 0.0001 rad";
            return Err(refuse("sigma", self.sigma.to_string(), accepted));
        }
        Ok(Self { direction, ..self })
    }
}

/// A derivative with respect to one lobe, in the coordinates that are optimised.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LobeGradient {
    /// With respect to the logarithm of each channel of the radiance.
    pub log_radiance: DVec3,
    /// With respect to the unit direction, tangent to the sphere there.
    pub direction: DVec3,
    /// With respect to the logarithm of sigma.
    pub log_sigma: f64,
}

impl std::ops::AddAssign for LobeGradient {
    fn add_assign(&mut self, other: Self) {
        self.log_radiance += other.log_radiance;
        self.direction += other.direction;
        self.log_sigma += other.log_sigma;
    }
}

/// A lobe as it is optimised: every value of every parameter is a lobe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LobeParameters {
    /// Natural logarithm of the radiance.
    pub log_radiance: DVec3,
    /// Any vector; its length does not matter, +y stands in for zero.
    pub direction: DVec3,
    /// Natural logarithm of sigma in radians.
    pub log_sigma: f64,
}

impl LobeParameters {
    /// The logarithm that stands for a radiance of 0: `exp` of it is 1e-20.
    pub const LOG_BLACK: f64 = -46.0;

    /// The parameters of `lobe`; a black channel becomes [`LOG_BLACK`](Self::LOG_BLACK), from
    /// where a gradient, being relative, will not lift it.
    pub fn of(lobe: &SphericalGaussian) -> Self {
        let log = |c: f32| f64::from(c).ln().max(Self::LOG_BLACK);
        let c = lobe.radiance;
        Self {
            log_radiance: DVec3::new(log(c.x), log(c.y), log(c.z)),
            direction: lobe.direction.as_dvec3(),
            log_sigma: f64::from(lobe.sigma).ln(),
        }
    }

    /// The unit direction.
    pub fn unit_direction(&self) -> DVec3 {
        let largest = self.direction.abs().max_element();
        if largest > 0.0 && largest.is_finite() {
            (self.direction / largest).normalize()
        } else {
            DVec3::Y
        }
    }

    /// The lobe. Radiance below 1e30 and sigma above [`MIN_SIGMA`] are kept; beyond, they are
    /// clamped, and [`lobe_vjp`](Self::lobe_vjp) is 0 there.
    pub fn lobe(&self) -> SphericalGaussian {
        let radiance = self.log_radiance.min(DVec3::splat(Self::LOG_BRIGHTEST));
        SphericalGaussian {
            direction: self.unit_direction().as_vec3(),
            radiance: radiance.exp().as_vec3(),
            sigma: self
                .log_sigma
                .clamp(Self::log_min_sigma(), Self::LOG_WIDEST)
                .exp() as f32,
        }
    }

    /// The derivative with respect to the parameters, from the one with respect to the lobe.
    /// Where the direction is zero its derivative is 0.
    pub fn lobe_vjp(&self, gradient: &LobeGradient) -> LobeParameters {
        let mu = self.unit_direction();
        let length = self.direction.length();
        let direction = if length > 0.0 && length.is_finite() {
            (gradient.direction - mu * mu.dot(gradient.direction)) / length
        } else {
            DVec3::ZERO
        };
        let free = self.log_radiance.cmplt(DVec3::splat(Self::LOG_BRIGHTEST));
        let sigma_is_free = (Self::log_min_sigma()..=Self::LOG_WIDEST).contains(&self.log_sigma);
        LobeParameters {
            log_radiance: DVec3::select(free, gradient.log_radiance, DVec3::ZERO),
            direction,
            log_sigma: if sigma_is_free {
                gradient.log_sigma
            } else {
                0.0
            },
        }
    }

    /// `ln 1e30`.
    const LOG_BRIGHTEST: f64 = 69.0;
    /// `ln 1000`: a lobe of sigma 30 already is constant to 0.2%.
    const LOG_WIDEST: f64 = 6.9;

    fn log_min_sigma() -> f64 {
        f64::from(MIN_SIGMA).ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{directions, lobe};
    use dipir_numerics::gradcheck::{central_difference, relative_error};

    #[test]
    fn the_integral_agrees_with_quadrature_from_a_sun_to_a_constant_sky() {
        for sigma in [1e-3f32, 1e-2, 0.1, 0.5, 1.0, 3.0, 10.0] {
            for radiance in [0.0f32, 1e-3, 1.0, 1e6] {
                let s = f64::from(sigma);
                // 2 pi times the integral over t = 1 - cos of exp(-t / sigma^2), by Simpson.
                let (end, n) = ((40.0 * s * s).min(2.0), 2000);
                let h = end / n as f64;
                let f = |k: usize| (-(k as f64) * h / (s * s)).exp();
                let odd: f64 = (1..n).step_by(2).map(f).sum();
                let even: f64 = (2..n).step_by(2).map(f).sum();
                let simpson = h / 3.0 * (f(0) + 4.0 * odd + 2.0 * even + f(n));
                let exact = TAU * f64::from(radiance) * simpson;
                let ours = lobe(Vec3::X, Vec3::splat(radiance), sigma).integral().x;
                assert!(
                    relative_error(ours, exact, 1e-30) < 1e-8,
                    "{sigma} {radiance}"
                );
            }
        }
        let constant = lobe(Vec3::X, Vec3::ONE, 1000.0).integral().x;
        assert!((constant / (4.0 * PI) - 1.0).abs() < 2e-6);
    }

    #[test]
    fn evaluation_keeps_its_digits_inside_a_narrow_lobe_and_vanishes_opposite_to_it() {
        for d in directions() {
            for sigma in [1e-3f32, 1e-2, 1.0, 10.0] {
                let g = lobe(d, Vec3::splat(1e6), sigma);
                for offset in [0.0, 0.5, 1.0, 2.0] {
                    let v = (d + d.any_orthonormal_vector() * sigma.min(0.5) * offset).normalize();
                    let (a, b) = (v.as_dvec3().normalize(), d.as_dvec3().normalize());
                    let t = 0.5 * (a - b).length_squared();
                    let exact = 1e6 * (-t / f64::from(sigma).powi(2)).exp();
                    // Rounding a direction by 6e-8 moves a lobe of 1e-3 by 6e-5 of its width.
                    assert!(relative_error(g.eval(v).x.into(), exact, 1e-6) < 4e-4);
                }
            }
            let opposite = lobe(d, Vec3::splat(1e6), 1e-3).eval(-d);
            assert_eq!(opposite, Vec3::ZERO);
        }
    }

    #[test]
    fn the_irradiance_under_a_sun_is_its_energy_times_the_cosine() {
        let d = Vec3::new(0.4, 0.6, -0.2).normalize();
        let g = lobe(d, Vec3::new(6e4, 1.0, 0.0), 1e-3);
        // The mean cosine over a lobe is the axis's to sigma^2.
        let exact = g.integral() * f64::from(d.y);
        assert!(relative_error(g.irradiance(Vec3::Y).x, exact.x, 0.0) < 2e-6);
        assert!(g.irradiance(-Vec3::Y).x < 1e-20);
    }

    #[test]
    fn the_irradiance_under_a_constant_is_pi() {
        for d in directions() {
            let e = lobe(d, Vec3::ONE, 1000.0).irradiance(Vec3::Y).x;
            // Off by cos / sigma^2, 1e-6.
            assert!((e / PI - 1.0).abs() < 3e-6, "{d}: {e}");
        }
    }

    /// A function of the lobe whose gradient is known: `a . ln c + b . mu + ln sigma`.
    fn probe(p: &LobeParameters) -> f64 {
        let mu = p.unit_direction();
        DVec3::new(0.3, -0.2, 0.9).dot(p.log_radiance)
            + DVec3::new(1.0, 2.0, -0.5).dot(mu)
            + p.log_sigma
    }

    #[test]
    fn parameters_pass_gradients_on_to_an_unnormalised_direction() {
        let p = LobeParameters {
            log_radiance: DVec3::new(-3.0, 0.0, 13.0),
            direction: DVec3::new(0.3, -4.0, 1.5),
            log_sigma: -2.0,
        };
        let gradient = LobeGradient {
            log_radiance: DVec3::new(0.3, -0.2, 0.9),
            direction: DVec3::new(1.0, 2.0, -0.5),
            log_sigma: 1.0,
        };
        let ours = p.lobe_vjp(&gradient);
        for axis in 0..3 {
            let moved = |x: f64| {
                let mut q = p;
                q.direction[axis] = x;
                probe(&q)
            };
            let numeric = central_difference(moved, p.direction[axis], 1e-5);
            assert!(relative_error(ours.direction[axis], numeric, 1e-6) < 1e-6);
        }
        assert_eq!(ours.log_radiance, gradient.log_radiance);
        assert_eq!(ours.log_sigma, 1.0);
    }

    #[test]
    fn parameters_round_trip_and_stay_lobes_at_every_extreme() {
        let g = lobe(Vec3::new(1.0, 2.0, 3.0), Vec3::new(1e6, 1.0, 0.0), 0.02);
        let back = LobeParameters::of(&g).lobe();
        assert!((back.radiance.x / 1e6 - 1.0).abs() < 1e-6 && back.radiance.z < 1e-19);
        assert!(back.direction.distance(g.direction) < 1e-6);
        for extreme in [-1e9, -100.0, 0.0, 100.0, 1e9] {
            let p = LobeParameters {
                log_radiance: DVec3::splat(extreme),
                direction: DVec3::ZERO,
                log_sigma: extreme,
            };
            assert!(p.lobe().checked(0).is_ok(), "{extreme}");
            let zero = p.lobe_vjp(&LobeGradient {
                direction: DVec3::ONE,
                ..Default::default()
            });
            assert_eq!(zero.direction, DVec3::ZERO);
        }
    }
}
