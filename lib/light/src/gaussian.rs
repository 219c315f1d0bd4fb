//! Spherical Gaussians: `G(v) = c exp(-(1 - v . mu) / sigma^2)`, a smooth lobe of light that
//! is a sun at sigma 1e-3 and a constant sky at sigma 10.
use std::f64::consts::TAU;

use dipir_numerics::guarded::{normalize_or, one_minus_cos};
use dipir_numerics::warp::Frame;
use glam::{DVec3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::error::LightError;
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance_f64;

/// One lobe of light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SphericalGaussian {
    /// Unit vector towards the lobe's peak, world space.
    pub direction: Vec3,
    /// Radiance at the peak, linear Rec.709, not negative.
    pub radiance: Vec3,
    /// Sharpness: for small values the standard deviation of the lobe, in radians. 1e-3 to 10.
    pub sigma: f32,
}

impl SphericalGaussian {
    /// Radiance arriving from the unit vector `v`.
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

    /// Radiance integrated over the sphere.
    #[inline]
    pub fn integral(&self) -> DVec3 {
        self.radiance.as_dvec3() * self.solid_angle()
    }
}

/// A lobe with what sampling needs beside it.
#[derive(Clone, Copy, Debug)]
struct Lobe {
    gaussian: SphericalGaussian,
    frame: Frame,
    sigma2: f32,
    /// `exp(-2 / sigma^2) - 1`.
    expm1: f32,
    /// Probability of the lobe over its solid angle.
    pdf_scale: f32,
}

/// A sum of lobes that can light a scene.
///
/// A lobe is chosen by its luminance integral, then sampled exactly (a von Mises-Fisher
/// distribution); `pdf` is that of the mixture, so it is positive wherever `eval` is.
#[derive(Clone, Debug)]
pub struct SgMixture {
    lobes: Vec<Lobe>,
    gaussians: Vec<SphericalGaussian>,
    /// Cumulative probability after each lobe; empty for a black mixture.
    cumulative: Vec<f32>,
}

impl SgMixture {
    /// A mixture of `gaussians`, their directions normalised.
    ///
    /// Errors name the first lobe whose radiance is negative or not finite, whose direction is
    /// zero, or whose sigma is not positive.
    pub fn new(gaussians: Vec<SphericalGaussian>) -> Result<Self, LightError> {
        let mut checked = Vec::with_capacity(gaussians.len());
        for (index, g) in gaussians.into_iter().enumerate() {
            checked.push(check_lobe(index, g)?);
        }
        let masses: Vec<f64> = checked
            .iter()
            .map(|g| luminance_f64(g.integral()))
            .collect();
        let total: f64 = masses.iter().sum();
        let mut lobes = Vec::with_capacity(checked.len());
        let mut cumulative = Vec::new();
        let mut sum = 0.0;
        for (g, mass) in checked.iter().zip(&masses) {
            let probability = if total > 0.0 { mass / total } else { 0.0 };
            let sigma2 = f64::from(g.sigma) * f64::from(g.sigma);
            lobes.push(Lobe {
                gaussian: *g,
                frame: Frame::from_normal(g.direction),
                sigma2: sigma2 as f32,
                expm1: (-2.0 / sigma2).exp_m1() as f32,
                pdf_scale: (probability / g.solid_angle()) as f32,
            });
            sum += probability;
            cumulative.push(sum as f32);
        }
        if total > 0.0 {
            // Rounding must not leave a gap above the last lobe that has any light.
            let last = masses.iter().rposition(|&m| m > 0.0).unwrap_or(0);
            cumulative[last..].fill(1.0);
        } else {
            cumulative.clear();
        }
        Ok(Self {
            lobes,
            gaussians: checked,
            cumulative,
        })
    }

    /// The lobes, directions normalised.
    pub fn lobes(&self) -> &[SphericalGaussian] {
        &self.gaussians
    }

    /// Radiance integrated over the sphere.
    pub fn integral(&self) -> DVec3 {
        self.gaussians.iter().map(|g| g.integral()).sum()
    }

    /// Radiance from and density at `direction`, for the price of one.
    #[inline]
    pub fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let (mut radiance, mut pdf) = (Vec3::ZERO, 0.0);
        for lobe in &self.lobes {
            let g = (-one_minus_cos(direction, lobe.gaussian.direction) / lobe.sigma2).exp();
            radiance += lobe.gaussian.radiance * g;
            pdf += lobe.pdf_scale * g;
        }
        (radiance, pdf)
    }
}

fn check_lobe(index: usize, g: SphericalGaussian) -> Result<SphericalGaussian, LightError> {
    let refuse = |field, value: String, accepted| LightError::Lobe {
        index,
        field,
        value,
        accepted,
    };
    let direction = normalize_or(g.direction, Vec3::ZERO);
    if direction == Vec3::ZERO {
        let accepted = "a finite vector other than zero";
        return Err(refuse("direction", g.direction.to_string(), accepted));
    }
    if !g.radiance.is_finite() || g.radiance.min_element() < 0.0 {
        let accepted = "finite and not negative";
        return Err(refuse("radiance", g.radiance.to_string(), accepted));
    }
    if !(g.sigma.is_finite() && g.sigma >= 1e-4) {
        let accepted = "finite and at least 0.0001 rad";
        return Err(refuse("sigma", g.sigma.to_string(), accepted));
    }
    Ok(SphericalGaussian { direction, ..g })
}

impl Illuminant for SgMixture {
    fn eval(&self, direction: Vec3) -> Vec3 {
        self.eval_pdf(direction).0
    }

    fn sample(&self, u: Vec2) -> LightSample {
        if self.cumulative.is_empty() {
            return LightSample {
                direction: Vec3::Y,
                radiance: Vec3::ZERO,
                pdf: 0.0,
            };
        }
        let k = self.cumulative.partition_point(|&c| c <= u.x);
        let k = k.min(self.lobes.len() - 1);
        let below = if k == 0 { 0.0 } else { self.cumulative[k - 1] };
        let v = ((u.x - below) / (self.cumulative[k] - below)).clamp(0.0, 1.0);
        let direction = sample_lobe(&self.lobes[k], Vec2::new(u.y, v));
        let (radiance, pdf) = self.eval_pdf(direction);
        LightSample {
            direction,
            radiance,
            pdf,
        }
    }

    fn pdf(&self, direction: Vec3) -> f32 {
        self.eval_pdf(direction).1
    }
}

/// Draws `1 - cos` by inverting the lobe's cumulative distribution in `u.x`, and an azimuth
/// from `u.y`.
#[inline]
fn sample_lobe(lobe: &Lobe, u: Vec2) -> Vec3 {
    let t = (-lobe.sigma2 * (u.x * lobe.expm1).ln_1p()).clamp(0.0, 2.0);
    let sin = (t * (2.0 - t)).sqrt();
    let (s, c) = crate::trigonometry::sin_cos_turns(u.y);
    let axis = lobe.gaussian.direction;
    (axis * (1.0 - t) + (lobe.frame.tangent * c + lobe.frame.bitangent * s) * sin).normalize()
}
