//! The isotropic GGX microfacet distribution with Smith masking [Walter et al. 2007].
//!
//! All directions are in the frame of the surface (z along the normal), all cosines positive.
//! Nothing is computed from `1 - cos^2` or divided by a cosine: tangential components keep
//! their digits for the smoothest surface, and products of masking and `1 / (4 cos cos)` are
//! finite at grazing angles. So the only
//! threshold is [`Ggx::MIN_ROUGHNESS`].
use std::f32::consts::{FRAC_1_PI, TAU};

use glam::{Vec2, Vec3};

/// The distribution of normals on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ggx {
    /// Width: the square of the perceptual roughness.
    pub alpha: f32,
}

impl Ggx {
    /// Surfaces with less perceptual roughness are mirrors.
    ///
    /// Their lobe, 0.4 milliradians, is a twelfth of the sun's disk. Unit vectors in f32
    /// resolve a ten-thousandth of it where light does not graze; within a degree of grazing,
    /// where the lobe narrows with the cosine, they no longer would.
    pub const MIN_ROUGHNESS: f32 = 0.02;

    /// From perceptual roughness in `[0, 1]`; `None` for a mirror.
    #[inline]
    pub fn new(roughness: f32) -> Option<Self> {
        (roughness >= Self::MIN_ROUGHNESS).then_some(Self {
            alpha: roughness * roughness,
        })
    }

    /// Length of `w` with its tangential part scaled by alpha: `cos (1 + 2 Lambda(w))`.
    #[inline]
    pub fn stretched_length(&self, w: Vec3) -> f32 {
        let t = self.alpha * self.alpha * (w.x * w.x + w.y * w.y);
        (t + w.z * w.z).sqrt()
    }

    /// Density of normals D(h), per steradian [eq. 33].
    #[inline]
    pub fn d(&self, h: Vec3) -> f32 {
        let a2 = self.alpha * self.alpha;
        let e = (h.x * h.x + h.y * h.y) / a2 + h.z * h.z;
        FRAC_1_PI / (a2 * e * e)
    }

    /// Height-correlated masking and shadowing over `4 cos_o cos_i` [Heitz 2014, eq. 99], from
    /// the stretched lengths of both directions.
    #[inline]
    pub fn visibility(wo_z: f32, wo_length: f32, wi_z: f32, wi_length: f32) -> f32 {
        0.5 / (wi_z * wo_length + wo_z * wi_length)
    }

    /// The same with masking and shadowing taken as independent: `G1(wo) G1(wi) / (4 cos cos)`.
    #[inline]
    pub fn separable_visibility(wo_z: f32, wo_length: f32, wi_z: f32, wi_length: f32) -> f32 {
        1.0 / ((wo_z + wo_length) * (wi_z + wi_length))
    }

    /// Derivative of [`Self::stretched_length`] with respect to alpha, of a vector with that
    /// `length`.
    #[inline]
    pub fn stretched_length_slope(&self, w: Vec3, length: f32) -> f32 {
        self.alpha * (w.x * w.x + w.y * w.y) / length
    }

    /// Logarithmic derivative of [`Self::d`] with respect to alpha.
    #[inline]
    pub fn log_d_slope(&self, h: Vec3) -> f32 {
        let t = (h.x * h.x + h.y * h.y) / (self.alpha * self.alpha);
        // d ln(1 / (a^2 e^2)) with e = t + z^2 and dt/da = -2 t / a.
        (2.0 / self.alpha) * (2.0 * t / (t + h.z * h.z) - 1.0)
    }

    /// Logarithmic derivative of [`Self::visibility`] where the lengths have the slopes
    /// `wo_slope` and `wi_slope`.
    #[inline]
    pub fn log_visibility_slope(
        wo_z: f32,
        (wo_length, wo_slope): (f32, f32),
        wi_z: f32,
        (wi_length, wi_slope): (f32, f32),
    ) -> f32 {
        -(wi_z * wo_slope + wo_z * wi_slope) / (wi_z * wo_length + wo_z * wi_length)
    }

    /// Density per steradian of the direction that [`Self::sample`] reflects `wo` to, where
    /// `d` is [`Self::d`] of their half vector: `G1(wo) D(h) / (4 cos_o)`.
    #[inline]
    pub fn reflection_pdf(d: f32, wo_z: f32, wo_length: f32) -> f32 {
        0.5 * d / (wo_z + wo_length)
    }

    /// A normal visible from `wo`, by a uniform point of a spherical cap [Dupuy and Benyoub
    /// 2023].
    #[inline]
    pub fn sample(&self, wo: Vec3, u: Vec2) -> Vec3 {
        let v = Vec3::new(self.alpha * wo.x, self.alpha * wo.y, wo.z) / self.stretched_length(wo);
        // Height of the cap's point above its rim, z + v.z: a sum would cancel.
        let rise = (1.0 - u.y) * (1.0 + v.z);
        let z = rise - v.z;
        let r = ((1.0 - z) * (1.0 + z)).max(0.0).sqrt();
        let (s, c) = (TAU * u.x).sin_cos();
        let h = Vec3::new(self.alpha * (r * c + v.x), self.alpha * (r * s + v.y), rise);
        // u.y < 1, so the height is positive and the length is not zero.
        h.normalize()
    }
}

/// `wo` mirrored about the unit normal `h`, and their cosine.
#[inline]
pub fn reflect(wo: Vec3, h: Vec3) -> (Vec3, f32) {
    let c = wo.dot(h);
    (2.0 * c * h - wo, c)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// D G2 / (4 cos cos) by the textbook's formulas in f64 [Walter et al. 2007, eq. 33;
    /// Heitz 2014, eq. 72 and 99], and its separable variant.
    fn reference(alpha: f64, wo: DVec3, wi: DVec3) -> (f64, f64) {
        let h = (wo + wi).normalize();
        let tan2 = |w: DVec3| w.truncate().length_squared() / (w.z * w.z);
        let d = (std::f64::consts::PI
            * alpha.powi(2)
            * h.z.powi(4)
            * (1.0 + tan2(h) / alpha.powi(2)).powi(2))
        .recip();
        let lambda = |w: DVec3| 0.5 * ((1.0 + alpha * alpha * tan2(w)).sqrt() - 1.0);
        let (o, i) = (lambda(wo), lambda(wi));
        let scale = d / (4.0 * wo.z * wi.z);
        (scale / (1.0 + o + i), scale / ((1.0 + o) * (1.0 + i)))
    }

    fn towards(z: f64, angle: f64) -> Vec3 {
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * angle.cos(), r * angle.sin(), z).as_vec3()
    }

    #[test]
    fn lobe_equals_the_textbook_in_f64_from_the_smoothest_to_grazing() {
        for roughness in [0.02f32, 0.1, 0.5, 1.0] {
            let ggx = Ggx::new(roughness).unwrap();
            let alpha = ggx.alpha;
            for z in [1.0, 0.7, 0.05, 1e-3, 1e-7] {
                let wo = towards(z, 0.4);
                for offset in [0.0, 0.3, 1.0, 4.0] {
                    // A facet some widths away from the normal.
                    let h = Vec3::new(offset * alpha, 0.2 * offset * alpha, 1.0).normalize();
                    let wi = reflect(wo, h).0;
                    // Where the sum of both is short, f32 directions do not say what the
                    // half vector is: the error of D is four times that of its slope.
                    let slope_error = 2.0 * f32::EPSILON / (wo.z + wi.z) / alpha;
                    if wi.z <= 0.0 || slope_error > 0.02 {
                        continue;
                    }
                    let (lo, li) = (ggx.stretched_length(wo), ggx.stretched_length(wi));
                    let d = ggx.d((wo + wi).normalize());
                    let (height, separable) = reference(alpha as f64, wo.as_dvec3(), wi.as_dvec3());
                    let got = d * Ggx::visibility(wo.z, lo, wi.z, li);
                    let tolerance = 4.0 * slope_error as f64 + 1e-5;
                    let error = (got as f64 / height - 1.0).abs();
                    assert!(error < tolerance, "{roughness} {wo} {wi}: {got} {height}");
                    let got = d * Ggx::separable_visibility(wo.z, lo, wi.z, li);
                    let error = (got as f64 / separable - 1.0).abs();
                    assert!(
                        error < tolerance,
                        "{roughness} {wo} {wi}: {got} {separable}"
                    );
                }
            }
        }
    }

    #[test]
    fn density_of_normals_projects_to_one() {
        // D cos over the hemisphere, by the tangent of the angle in units of alpha.
        for roughness in [0.02f32, 0.1, 0.5, 1.0] {
            let ggx = Ggx::new(roughness).unwrap();
            let (n, mut sum) = (20_000, 0.0);
            for i in 0..n {
                // tan = alpha sqrt(u / (1 - u)) draws from D cos: the quotient is constant.
                let u = (i as f64 + 0.5) / n as f64;
                let tan = ggx.alpha as f64 * (u / (1.0 - u)).sqrt();
                let cos = (1.0 + tan * tan).sqrt().recip();
                let h = DVec3::new(tan * cos, 0.0, cos).as_vec3();
                let t = ggx.alpha as f64;
                let density = (1.0 + tan * tan / (t * t)).powi(-2)
                    / (std::f64::consts::PI * t * t * cos.powi(4));
                sum += ggx.d(h) as f64 / density / n as f64;
            }
            assert!((sum - 1.0).abs() < 1e-5, "{roughness}: {sum}");
        }
    }
}
