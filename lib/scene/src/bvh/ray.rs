//! A ray in the hierarchy's coordinates.
use glam::Vec3A;

use crate::triangle::Shear;

/// A ray and what follows from it for all nodes and triangles.
pub struct LocalRay {
    /// Start, in the hierarchy's coordinates: the mesh lies within the unit cube.
    pub origin: Vec3A,
    /// Reciprocal of the direction, finite.
    pub inverse: Vec3A,
    /// Bit `k` is set where the direction is negative along axis `k`.
    pub octant: usize,
    /// How much boxes are widened along every axis, to cover the rounding of the box test and
    /// of the triangle test.
    ///
    /// The largest distance in play is `1 + |origin|`. In units of 2^-24 of it, the box test
    /// errs by 4 (the reciprocal, its product with the origin, the product with the plane, the
    /// difference) and the shear of a vertex by 5 (the translation 1, the shear factor 2,
    /// product and difference 2) [Woop et al. 2013, section 3.2]: 9, or 4.5 of
    /// [`f32::EPSILON`].
    pub pad: f32,
    /// For the triangle test.
    pub shear: Shear,
}

impl LocalRay {
    /// The ray from `origin` in the unit `direction`.
    #[inline(always)]
    pub fn new(origin: Vec3A, direction: Vec3A) -> Self {
        // A component this small moves the ray by nothing that f32 could tell, and its
        // reciprocal stays finite.
        let tiny = Vec3A::splat(1e-18);
        let size = direction.abs().max(tiny);
        let inverse = size.recip().copysign(direction);
        Self {
            origin,
            inverse,
            octant: direction.is_negative_bitmask() as usize,
            pad: 5.0 * f32::EPSILON * (1.0 + origin.abs().max_element()),
            shear: Shear::new(direction, size, inverse),
        }
    }
}
