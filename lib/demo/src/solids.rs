//! Solids and how they combine: negative inside, roughly distances in metres.
use glam::{Vec2, Vec3};

/// Union with a fillet of about `k` metres [Quilez, polynomial smooth minimum].
pub fn smooth_union(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - 0.25 * h * h * k
}

/// Intersection with a round of about `k` metres.
pub fn smooth_intersection(a: f32, b: f32, k: f32) -> f32 {
    -smooth_union(-a, -b, k)
}

/// `a` without `b`, the edge rounded by about `k` metres.
pub fn smooth_difference(a: f32, b: f32, k: f32) -> f32 {
    smooth_intersection(a, -b, k)
}

/// Signed distance to a closed polygon.
pub fn polygon(p: Vec2, corners: &[Vec2]) -> f32 {
    let mut nearest = f32::INFINITY;
    let mut inside = false;
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let (edge, to_p) = (b - a, p - a);
        let t = (to_p.dot(edge) / edge.length_squared()).clamp(0.0, 1.0);
        nearest = nearest.min((to_p - t * edge).length_squared());
        if (a.y > p.y) != (b.y > p.y) && to_p.x < edge.x * to_p.y / edge.y {
            inside = !inside;
        }
    }
    if inside {
        -nearest.sqrt()
    } else {
        nearest.sqrt()
    }
}

/// A polygon whose corners are rounded by `radius` metres, its straight edges kept.
pub fn rounded_polygon(p: Vec2, corners: &[Vec2], radius: f32) -> f32 {
    // Corners move in along the bisector, so that the offset comes back to the edges.
    let n = corners.len();
    let area: f32 = (0..n)
        .map(|i| corners[i].perp_dot(corners[(i + 1) % n]))
        .sum();
    let moved: Vec<Vec2> = (0..n)
        .map(|i| {
            let normal = |a: Vec2, b: Vec2| (b - a).perp().normalize() * area.signum();
            let before = normal(corners[(i + n - 1) % n], corners[i]);
            let after = normal(corners[i], corners[(i + 1) % n]);
            let bisector = before + after;
            corners[i] + bisector * (2.0 * radius / bisector.length_squared().max(0.5))
        })
        .collect();
    polygon(p, &moved) - radius
}

/// A box of the given half extents with rounded edges.
pub fn rounded_box(p: Vec3, half: Vec3, radius: f32) -> f32 {
    let q = p.abs() - half + radius;
    q.max(Vec3::ZERO).length() + q.max_element().min(0.0) - radius
}

/// An ellipsoid, to first order.
pub fn ellipsoid(p: Vec3, radii: Vec3) -> f32 {
    let k0 = (p / radii).length();
    let k1 = (p / (radii * radii)).length();
    if k1 > 0.0 {
        k0 * (k0 - 1.0) / k1
    } else {
        -radii.min_element()
    }
}

/// A disc of radius `r` and half thickness `half` along x, its rim rounded by `round`.
pub fn wheel_disc(p: Vec3, r: f32, half: f32, round: f32) -> f32 {
    let q = Vec2::new(Vec2::new(p.y, p.z).length() - r, p.x.abs() - half) + round;
    q.max(Vec2::ZERO).length() + q.max_element().min(0.0) - round
}

/// 0 below `a`, 1 above `b`, smooth between.
pub fn smoothstep(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
