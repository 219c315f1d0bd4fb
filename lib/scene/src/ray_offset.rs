//! Where a ray that leaves a surface starts.
//!
//! A hit point is rounded, so it lies in front of or behind its triangle by chance; a ray
//! that starts behind meets the triangle that it leaves. The bound on that distance is known
//! where the point is computed, so it is carried along and the point is moved by just that
//! much, as in pbrt-4 section 6.8; every component is then rounded towards the side that the
//! ray leaves to, so that the move survives the rounding at any distance from the world's
//! origin. Offsets by a fixed count of integer steps [Wächter, Binder 2019] need no bound, but
//! their constants assume metres near the origin: they are too long for a millionth of a metre
//! and know nothing of the acceleration structure's own rounding.
use glam::{DVec3, Vec3};

/// The origin of a ray that leaves the surface at `point` towards `direction`: beyond the
/// plane with unit normal `geometric_normal`, on the side that `direction` points to.
///
/// `error` bounds the distance of `point` from that plane, metres
/// ([`HitPoint::error`](crate::bvh::HitPoint::error)).
#[inline]
pub fn spawn_origin(point: Vec3, geometric_normal: Vec3, direction: Vec3, error: f32) -> Vec3 {
    let side = if direction.dot(geometric_normal) < 0.0 {
        -1.0
    } else {
        1.0
    };
    let normal = geometric_normal.as_dvec3() * side;
    let exact = point.as_dvec3() + normal * error as f64;
    Vec3::new(
        round_towards(exact.x, normal.x),
        round_towards(exact.y, normal.y),
        round_towards(exact.z, normal.z),
    )
}

/// The nearest `f32` on the side of `x` that `sign` points to.
#[inline]
fn round_towards(x: f64, sign: f64) -> f32 {
    let r = x as f32;
    if sign > 0.0 && (r as f64) < x {
        r.next_up()
    } else if sign < 0.0 && (r as f64) > x {
        r.next_down()
    } else {
        r
    }
}

/// The unit normal of a triangle, counter-clockwise seen from the front; zero if its area is.
#[inline]
pub fn geometric_normal(vertices: [Vec3; 3]) -> Vec3 {
    // In f64: slivers lose all their digits in an f32 cross product.
    let [a, b, c] = vertices.map(|v| v.as_dvec3());
    (b - a).cross(c - a).normalize_or_zero().as_vec3()
}

/// The point with barycentric weights `u`, `v` of vertices 1 and 2, not rounded to `f32`.
#[inline]
pub fn interpolate(vertices: [Vec3; 3], u: f32, v: f32) -> DVec3 {
    let [a, b, c] = vertices.map(|p| p.as_dvec3());
    a + (b - a) * u as f64 + (c - a) * v as f64
}
