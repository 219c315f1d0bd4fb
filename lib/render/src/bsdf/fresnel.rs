//! Schlick's Fresnel factor, as glTF 2.0 appendix B uses it.
use glam::Vec3;

/// Reflectance at normal incidence of the interface between air and a dielectric with index of
/// refraction `ior` > 0: 0.04 for 1.5.
#[inline]
pub fn f0_from_ior(ior: f32) -> f32 {
    let r = (ior - 1.0) / (ior + 1.0);
    r * r
}

/// `(1 - cos)^5`: the weight of reflectance 1 at grazing incidence against F0 [Schlick 1994].
#[inline]
pub fn schlick_weight(cos_theta: f32) -> f32 {
    let m = (1.0 - cos_theta).clamp(0.0, 1.0);
    let m2 = m * m;
    m2 * m2 * m
}

/// `f0 + (1 - f0) weight`, a channel at a time.
#[inline]
pub fn schlick(f0: Vec3, weight: f32) -> Vec3 {
    f0 + (Vec3::ONE - f0) * weight
}
