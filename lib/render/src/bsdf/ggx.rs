//! The isotropic GGX microfacet distribution with Smith masking [Walter et al. 2007].
//!
//! All directions are in the frame of the surface (z along the normal), all cosines positive.
//! Nothing is computed from `1 - cos^2` or divided by a cosine: tangential components keep
//! their digits for the smoothest surface, and products of masking and `1 / (4 cos cos)` are
//! finite at grazing angles. So there are no thresholds below [`Ggx::MIN_ALPHA`].
use std::f32::consts::{FRAC_1_PI, TAU};

use glam::{Vec2, Vec3};

/// The distribution of normals on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ggx {
    /// Width: the square of the perceptual roughness.
    pub alpha: f32,
}

impl Ggx {
    /// Surfaces with a smaller alpha (perceptual roughness below 0.008) are mirrors. Their
    /// lobe, 64 microradians, is a seventieth of the sun's disk, and unit vectors in f32
    /// resolve only a thousandth of its width.
    pub const MIN_ALPHA: f32 = 6.4e-5;

    /// From perceptual roughness in `[0, 1]`; `None` for a mirror.
    #[inline]
    pub fn new(roughness: f32) -> Option<Self> {
        let alpha = roughness * roughness;
        (alpha >= Self::MIN_ALPHA).then_some(Self { alpha })
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
