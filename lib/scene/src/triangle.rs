//! The watertight ray-triangle test [Woop, Benthin, Wald 2013].
//!
//! Vertices are translated to the ray's origin and sheared so that the ray becomes the +z
//! axis. The three edge functions are then 2D cross products whose sign is decided exactly:
//! the two products of a cross product round monotonically, so their difference has the right
//! sign unless it is zero, and a zero is settled in `f64`, where products of two `f32` are
//! exact. A vertex is sheared by the same arithmetic whichever triangle it belongs to, hence
//! two triangles that share an edge agree on which side of it a ray passes: no ray slips
//! through between them.
use glam::Vec3;

/// What of a ray is the same for every triangle: the permutation that makes the direction's
/// largest component the last, and the shear along it.
#[derive(Clone, Copy, Debug)]
pub struct Shear {
    /// Axis indices; `axes[2]` is the direction's largest component.
    pub axes: [usize; 3],
    /// Shear of x and y, and the reciprocal of the largest component.
    pub shear: [f32; 3],
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
    /// Prepares `direction`, which must not be zero.
    #[inline]
    pub fn new(direction: Vec3) -> Self {
        let a = direction.abs();
        let kz = if a.x > a.y {
            if a.x > a.z { 0 } else { 2 }
        } else if a.y > a.z {
            1
        } else {
            2
        };
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        // The permutation must keep the winding.
        if direction[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let inverse = 1.0 / direction[kz];
        Self {
            axes: [kx, ky, kz],
            shear: [direction[kx] * inverse, direction[ky] * inverse, inverse],
        }
    }

    /// Intersects the triangle `vertices` with the ray from `origin`, for `0 < t <= t_max`.
    #[inline]
    pub fn intersect(&self, origin: Vec3, vertices: [Vec3; 3], t_max: f32) -> Option<TriangleHit> {
        let [kx, ky, kz] = self.axes;
        let [sx, sy, sz] = self.shear;
        let [a, b, c] = vertices.map(|v| v - origin);
        let (ax, ay) = (sheared(a[kx], sx, a[kz]), sheared(a[ky], sy, a[kz]));
        let (bx, by) = (sheared(b[kx], sx, b[kz]), sheared(b[ky], sy, b[kz]));
        let (cx, cy) = (sheared(c[kx], sx, c[kz]), sheared(c[ky], sy, c[kz]));
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
        let t = (w0 * a[kz] as f64 + w1 * b[kz] as f64 + w2 * c[kz] as f64) * sz as f64 / det;
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
