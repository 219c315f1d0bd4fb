//! Balls around points.
use glam::{DVec3, Vec3};

use super::Sphere;

/// Directions whose extreme points seed a ball: the axes and the diagonals of a cube.
const DIRECTIONS: [Vec3; 7] = [
    Vec3::X,
    Vec3::Y,
    Vec3::Z,
    Vec3::new(1.0, 1.0, 1.0),
    Vec3::new(1.0, 1.0, -1.0),
    Vec3::new(1.0, -1.0, 1.0),
    Vec3::new(1.0, -1.0, -1.0),
];

/// A radius this close to the smallest is good enough.
const EXCESS: f64 = 0.01;

/// Passes over all points that look for one that the ball misses.
const MAX_PASSES: usize = 8;

/// A ball that holds `points`, its radius within a per cent or so of the smallest; `None`
/// without points.
///
/// The smallest ball of a few extreme points is approximated by steps towards the farthest,
/// the i-th by 1 / (i + 1) of the way [Bădoiu, Clarkson 2003]; the farthest of all points
/// joins the few until none lies outside. Costs at most ten passes over the points.
pub fn enclosing_sphere(points: impl Iterator<Item = Vec3> + Clone) -> Option<Sphere> {
    let first = points.clone().next()?;
    let mut extremes = [[first; 2]; 7];
    let mut reach = DIRECTIONS.map(|d| [d.dot(first); 2]);
    for p in points.clone() {
        for k in 0..7 {
            let s = DIRECTIONS[k].dot(p);
            if s < reach[k][0] {
                (reach[k][0], extremes[k][0]) = (s, p);
            }
            if s > reach[k][1] {
                (reach[k][1], extremes[k][1]) = (s, p);
            }
        }
    }
    let mut few: Vec<DVec3> = extremes
        .as_flattened()
        .iter()
        .map(|p| p.as_dvec3())
        .collect();
    let mut center = few[0];
    for _ in 0..MAX_PASSES {
        let radius = approach_center(&mut center, &few);
        let (distance, farthest) = farthest(center, points.clone());
        if distance <= radius * (1.0 + EXCESS) {
            break;
        }
        few.push(farthest);
    }
    let center = center.as_vec3();
    let (radius, _) = farthest(center.as_dvec3(), points);
    let rounded = radius as f32;
    let radius = if (rounded as f64) < radius {
        rounded.next_up()
    } else {
        rounded
    };
    Some(Sphere { center, radius })
}

/// Moves `center` close to the centre of the smallest ball around `points`; returns the radius.
fn approach_center(center: &mut DVec3, points: &[DVec3]) -> f64 {
    const STEPS: usize = 256;
    for step in 0..STEPS {
        let (_, target) = farthest_of(*center, points.iter().copied());
        *center += (target - *center) / (step as f64 + 2.0);
    }
    farthest_of(*center, points.iter().copied()).0
}

fn farthest(from: DVec3, points: impl Iterator<Item = Vec3>) -> (f64, DVec3) {
    farthest_of(from, points.map(|p| p.as_dvec3()))
}

fn farthest_of(from: DVec3, points: impl Iterator<Item = DVec3>) -> (f64, DVec3) {
    let (squared, point) =
        points
            .map(|p| (from.distance_squared(p), p))
            .fold(
                (-1.0, from),
                |best, next| if next.0 > best.0 { next } else { best },
            );
    (squared.max(0.0).sqrt(), point)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Slack of the bound on the radius: the tolerated excess twice, once for the few points'
    /// ball (256 steps end within 1/sqrt(256) = 6% in the worst case, far less in practice).
    const SLACK: f32 = 1.03;

    fn check(points: &[Vec3], smallest: f32) {
        let ball = enclosing_sphere(points.iter().copied()).unwrap();
        for p in points {
            let d = ball.center.as_dvec3().distance(p.as_dvec3());
            assert!(d <= ball.radius as f64, "{p} lies outside {ball:?}");
        }
        assert!(
            ball.radius <= smallest * SLACK,
            "{ball:?}, smallest {smallest}"
        );
    }

    #[test]
    fn the_ball_of_a_cube_is_that_of_its_diagonal() {
        let corners: Vec<Vec3> = (0..8)
            .map(|i| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32))
            .collect();
        check(&corners, 0.75f32.sqrt());
        let far: Vec<Vec3> = corners.iter().map(|c| *c + Vec3::splat(1e6)).collect();
        check(&far, 0.75f32.sqrt());
        let tiny: Vec<Vec3> = corners.iter().map(|c| *c * 1e-6).collect();
        check(&tiny, 0.75f32.sqrt() * 1e-6);
    }

    #[test]
    fn the_ball_of_points_on_a_sphere_is_that_sphere() {
        let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
        let points: Vec<Vec3> = (0..1000)
            .map(|i| {
                let y = 1.0 - (i as f32 + 0.5) / 500.0;
                let (s, c) = (golden * i as f32).sin_cos();
                let r = (1.0 - y * y).sqrt();
                Vec3::new(r * c, y, r * s) * 2.0 + Vec3::new(3.0, 4.0, 5.0)
            })
            .collect();
        check(&points, 2.0);
    }

    #[test]
    fn the_ball_of_one_point_has_no_radius_and_of_a_segment_half_its_length() {
        check(&[Vec3::new(1.0, 2.0, 3.0)], 0.0);
        check(&[Vec3::ZERO, Vec3::X, Vec3::X * 0.3], 0.5);
        // A right triangle's longest side is the diameter; an equilateral one's circumcircle.
        check(&[Vec3::ZERO, Vec3::X, Vec3::Y], 0.5f32.sqrt());
        check(
            &[
                Vec3::X,
                Vec3::new(-0.5, 0.75f32.sqrt(), 0.0),
                Vec3::new(-0.5, -(0.75f32.sqrt()), 0.0),
            ],
            1.0,
        );
        assert_eq!(enclosing_sphere(std::iter::empty()), None);
    }
}
