//! A ray in the hierarchy's coordinates.
use glam::Vec3;

use crate::triangle::Shear;

/// A ray and what follows from it for all nodes and triangles.
pub struct LocalRay {
    /// Start, in the hierarchy's coordinates: the mesh lies within the unit cube.
    pub origin: Vec3,
    /// End of the range of distances.
    pub t_max: f32,
    /// Reciprocal of the direction, finite.
    pub inverse: Vec3,
    /// Bit `k` is set where the direction is negative along axis `k`.
    pub octant: usize,
    /// For the triangle test.
    pub shear: Shear,
}

impl LocalRay {
    /// The ray from `origin` in the unit `direction`, for `0 < t <= t_max`.
    #[inline(always)]
    pub fn new(origin: Vec3, direction: Vec3, t_max: f32) -> Self {
        // A component this small moves the ray by nothing that f32 could tell, and its
        // reciprocal stays finite.
        let safe = |d: f32| {
            if d.abs() < 1e-18 {
                1e-18f32.copysign(d)
            } else {
                d
            }
        };
        let safe = Vec3::new(safe(direction.x), safe(direction.y), safe(direction.z));
        let negative = |k: usize| (safe[k] < 0.0) as usize;
        Self {
            origin,
            t_max,
            inverse: safe.recip(),
            octant: negative(0) | negative(1) << 1 | negative(2) << 2,
            shear: Shear::new(direction),
        }
    }

    /// How much boxes are widened along every axis, to cover the rounding of the box test and
    /// of the triangle test.
    ///
    /// The largest distance in play is `1 + |origin|`. In units of 2^-24 of it, the box test
    /// errs by 4 (the reciprocal, its product with the origin, the product with the plane, the
    /// difference) and the shear of a vertex by 5 (the translation 1, the shear factor 2,
    /// product and difference 2) [Woop et al. 2013, section 3.2]: 9, or 4.5 of
    /// [`f32::EPSILON`].
    #[inline(always)]
    pub fn pad(&self) -> f32 {
        5.0 * f32::EPSILON * (1.0 + self.origin.abs().max_element())
    }
}
