//! The watertight ray-triangle test [Woop, Benthin, Wald 2013].
//!
//! Vertices are translated to the ray's origin and sheared so that the ray becomes the +z
//! axis. The three edge functions are then 2D cross products whose sign is decided exactly:
//! the two products of a cross product round monotonically, so their difference has the right
//! sign unless it is zero, and a zero is settled in `f64`, where products of two `f32` are
//! exact. A vertex is sheared by the same arithmetic whichever triangle it belongs to, hence
//! two triangles that share an edge agree on which side of it a ray passes: no ray slips
//! through between them.
use glam::Vec3A;

/// What of a ray is the same for every triangle: the permutation that makes the direction's
/// largest component the last, and the shear along it.
#[derive(Clone, Copy, Debug)]
pub struct Shear {
    /// Axis indices; `axes[2]` is the direction's largest component.
    pub axes: [usize; 3],
    /// Shear of x and y, and the reciprocal of the largest component.
    pub factors: [f32; 3],
}

/// A hit of one triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriangleHit {
    /// Distance along the ray, in lengths of its direction.
    pub t: f32,
    /// Barycentric weight of vertex 1.
    pub u: f32,
    /// Barycentric weight of vertex 2.
    pub v: f32,
    /// Whether the vertices appear clockwise.
    pub back_face: bool,
}

/// `a - s b` by the arithmetic that every variant of the test shares.
#[inline(always)]
fn sheared(a: f32, s: f32, b: f32) -> f32 {
    if cfg!(target_feature = "fma") {
        (-s).mul_add(b, a)
    } else {
        a - s * b
    }
}

impl Shear {
    /// Prepares `direction`, given the size and the reciprocal of each component.
    #[inline(always)]
    pub fn new(direction: Vec3A, size: Vec3A, inverse: Vec3A) -> Self {
        /// Cyclic permutations with each axis last, and their mirror images: where the
        /// direction is negative along the last axis, swapping the others keeps the winding.
        const AXES: [[[usize; 3]; 2]; 3] = [
            [[1, 2, 0], [2, 1, 0]],
            [[2, 0, 1], [0, 2, 1]],
            [[0, 1, 2], [1, 0, 2]],
        ];
        let y_or_z = if size.z > size.y { 2 } else { 1 };
        let largest = if size.x > size.y.max(size.z) {
            0
        } else {
            y_or_z
        };
        let (direction, inverse) = (direction.to_array(), inverse.to_array());
        let axes = AXES[largest][(inverse[largest] < 0.0) as usize];
        let inverse = inverse[largest];
        Self {
            axes,
            factors: [
                direction[axes[0]] * inverse,
                direction[axes[1]] * inverse,
                inverse,
            ],
        }
    }

    /// Intersects a triangle, its vertices relative to the ray's origin and their coordinates
    /// in the order of `axes`, for `0 < t <= t_max`.
    #[inline]
    pub fn intersect(&self, vertices: [[f32; 3]; 3], t_max: f32) -> Option<TriangleHit> {
        let [sx, sy, sz] = self.factors;
        let [a, b, c] = vertices;
        let (ax, ay) = (sheared(a[0], sx, a[2]), sheared(a[1], sy, a[2]));
        let (bx, by) = (sheared(b[0], sx, b[2]), sheared(b[1], sy, b[2]));
        let (cx, cy) = (sheared(c[0], sx, c[2]), sheared(c[1], sy, c[2]));
        // Not fused: a fused product would break `U(a, b) = -U(b, a)`.
        let mut w0 = (cx * by - cy * bx) as f64;
        let mut w1 = (ax * cy - ay * cx) as f64;
        let mut w2 = (bx * ay - by * ax) as f64;
        if (w0 < 0.0 || w1 < 0.0 || w2 < 0.0) && (w0 > 0.0 || w1 > 0.0 || w2 > 0.0) {
            return None;
        }
        if w0 == 0.0 || w1 == 0.0 || w2 == 0.0 {
            let [ax, ay, bx, by, cx, cy] = [ax, ay, bx, by, cx, cy].map(f64::from);
            w0 = cx * by - cy * bx;
            w1 = ax * cy - ay * cx;
            w2 = bx * ay - by * ax;
            if (w0 < 0.0 || w1 < 0.0 || w2 < 0.0) && (w0 > 0.0 || w1 > 0.0 || w2 > 0.0) {
                return None;
            }
        }
        let det = w0 + w1 + w2;
        if det == 0.0 {
            return None;
        }
        let t = (w0 * a[2] as f64 + w1 * b[2] as f64 + w2 * c[2] as f64) * sz as f64 / det;
        let t32 = t as f32;
        // NaN fails the comparison.
        if !(t > 0.0 && t32 <= t_max) {
            return None;
        }
        Some(TriangleHit {
            t: t32,
            u: (w1 / det) as f32,
            v: (w2 / det) as f32,
            back_face: det < 0.0,
        })
    }
}
