//! The weight that importance sampling, fusion and fitting give to a colour.
use glam::{DVec3, Vec3};

/// Luminance weights of linear Rec.709 [ITU-R BT.709-6].
pub const REC709: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);

/// Relative luminance of a linear Rec.709 colour. Positive wherever a channel is.
#[inline]
pub fn luminance(colour: Vec3) -> f32 {
    colour.dot(REC709)
}

/// [`luminance`] in f64, with the same weights.
#[inline]
pub fn luminance_f64(colour: DVec3) -> f64 {
    colour.dot(REC709.as_dvec3())
}
