//! Which directions the object can block, seen from a point of the proxy.
use dipir_numerics::guarded::safe_sqrt;
use dipir_scene::bvh::Sphere;
use glam::Vec3;

/// Directions within an angle of an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// Unit vector.
    pub axis: Vec3,
    /// Cosine of the half angle; -1 for all directions.
    pub cos_half_angle: f32,
}

impl Cone {
    /// All directions.
    pub const EVERYTHING: Cone = Cone {
        axis: Vec3::Y,
        cos_half_angle: -1.0,
    };
}

/// Balls that together hold the object.
#[derive(Clone, Debug)]
pub struct Blocker {
    /// Holds the whole object.
    whole: Sphere,
    /// Hold its parts.
    parts: Vec<Sphere>,
}

impl Blocker {
    /// From a ball around the object and, optionally, balls around its parts.
    pub fn new(whole: Sphere, parts: &[Sphere]) -> Self {
        Self {
            whole,
            parts: parts.to_vec(),
        }
    }

    /// Smallest radius whose inflation is noticed: the ball's around the object.
    pub fn radius(&self) -> f32 {
        self.whole.radius
    }

    /// A cone that holds every direction from any point within `reach` of `point` to the object:
    /// the tighter of the cones around the whole and around the parts.
    ///
    /// A point that is `reach` away sees a ball no wider than `point` sees the ball inflated by
    /// `reach` (Minkowski sum).
    pub fn cone(&self, point: Vec3, reach: f32) -> Cone {
        let whole = cone_of_ball(self.whole, point, reach);
        let Some(axis) = (self.whole.center - point).try_normalize() else {
            return Cone::EVERYTHING;
        };
        match self.cone_of_parts(axis, point, reach) {
            Some(cos) if cos > whole.cos_half_angle => Cone {
                axis,
                cos_half_angle: cos,
            },
            _ => whole,
        }
    }

    /// Cosine of the angle around `axis` that holds all parts; `None` for all directions.
    fn cone_of_parts(&self, axis: Vec3, point: Vec3, reach: f32) -> Option<f32> {
        let mut widest = 1f32;
        for part in &self.parts {
            let cone = cone_of_ball(*part, point, reach);
            if cone.cos_half_angle <= -1.0 {
                return None;
            }
            // cos(a + b) from cosines, where a is the angle of the part's centre off the axis
            // and b its half angle; beyond a half turn it is everything.
            let (cos_a, cos_b) = (axis.dot(cone.axis).clamp(-1.0, 1.0), cone.cos_half_angle);
            if cos_a <= -cos_b {
                return None;
            }
            let sines = safe_sqrt((1.0 - cos_a * cos_a) * (1.0 - cos_b * cos_b));
            widest = widest.min(cos_a * cos_b - sines);
        }
        // Rounding of the cosines above: a few ulp of 1.
        Some((widest - 8.0 * f32::EPSILON).max(-1.0))
    }
}

/// The directions from `point` to `ball` inflated by `reach`.
fn cone_of_ball(ball: Sphere, point: Vec3, reach: f32) -> Cone {
    let to_center = ball.center - point;
    let distance_squared = to_center.length_squared();
    // Inflated by the rounding of the distance, relative to the coordinates in play.
    let radius = ball.radius + reach + 4.0 * f32::EPSILON * point.abs().max_element();
    let sin_squared = radius * radius / distance_squared;
    // Also refuses 0/0, NaN and infinities.
    if !(sin_squared < 1.0 && distance_squared > 0.0) {
        return Cone::EVERYTHING;
    }
    Cone {
        axis: to_center / distance_squared.sqrt(),
        cos_half_angle: (1.0 - sin_squared).sqrt() - 4.0 * f32::EPSILON,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_numerics::sampler::{Sampler, Stream};
    use dipir_numerics::warp::square_to_sphere;

    fn random_in_ball(r: &mut Sampler, ball: Sphere) -> Vec3 {
        let d = square_to_sphere(r.next_2d());
        ball.center + d * ball.radius * r.next_1d().cbrt()
    }

    #[test]
    fn cones_hold_every_part_from_every_point_within_reach() {
        for i in 0..2000 {
            let mut r = Sampler::new(3, Stream::TEST, i, 0);
            let whole = Sphere {
                center: Vec3::new(0.0, 1.0, 0.0),
                radius: 1.0,
            };
            let parts: Vec<Sphere> = (0..4)
                .map(|_| Sphere {
                    center: random_in_ball(&mut r, whole),
                    radius: 0.2 * r.next_1d(),
                })
                .collect();
            let blocker = Blocker::new(
                Sphere {
                    center: whole.center,
                    radius: 1.2,
                },
                &parts,
            );
            let point = 4.0 * square_to_sphere(r.next_2d());
            let reach = 0.5 * r.next_1d();
            let cone = blocker.cone(point, reach);
            for part in &parts {
                let from = point + reach * square_to_sphere(r.next_2d());
                let to = part.center + part.radius * square_to_sphere(r.next_2d());
                let cos = (to - from).normalize().dot(cone.axis);
                // The tolerance is the rounding of the cosine itself.
                assert!(cos >= cone.cos_half_angle - 1e-6, "{i}: {cos} {cone:?}");
            }
        }
    }

    #[test]
    fn inside_the_ball_at_its_centre_and_at_infinity_all_directions_count() {
        let ball = Sphere {
            center: Vec3::ZERO,
            radius: 1.0,
        };
        let b = Blocker::new(ball, &[ball]);
        for point in [Vec3::ZERO, Vec3::X * 0.5, Vec3::X, Vec3::splat(f32::MAX)] {
            assert_eq!(b.cone(point, 0.0).cos_half_angle, -1.0, "{point}");
        }
        assert!(b.cone(Vec3::X * 1.1, 0.0).cos_half_angle > 0.0);
        assert_eq!(b.cone(Vec3::X * 1.1, 0.2).cos_half_angle, -1.0);
    }
}
