//! A plane through points, most of which may lie on no plane.
use dipir_numerics::sampler::Sampler;
use glam::{DMat3, DVec3};

use crate::cloud::POINTS;

/// A plane: `normal . p = offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Plane {
    pub(crate) normal: DVec3,
    pub(crate) offset: f64,
}

impl Plane {
    pub(crate) fn height(&self, p: DVec3) -> f64 {
        self.normal.dot(p) - self.offset
    }
}

/// Draws of three points. With 30% of the points on the plane no draw hits it with a probability of
/// (1 - .027)^2000 = 1e-24.
const DRAWS: u32 = 2000;
/// Points on which draws are judged.
const JUDGES: usize = 4000;
/// Cost of a point below the plane by more than three thresholds, where one off the plane costs 1: there
/// is nothing under the ground, but much on it.
const BELOW: f64 = 2.0;
/// Tukey's constant: 95% efficient where errors are normal.
pub(crate) const TUKEY: f64 = 4.685;
/// Standard deviations in a median absolute deviation of normal errors.
pub(crate) const MAD: f64 = 1.4826;

/// The plane that most of `points` lie on within `threshold`, with a normal within `most_tilt_rad` of
/// `up` (RANSAC, judged as MSAC).
pub(crate) fn ransac(
    points: &[DVec3],
    threshold: f64,
    up: DVec3,
    most_tilt_rad: f64,
    seed: u64,
) -> Option<Plane> {
    let every = points.len().div_ceil(JUDGES).max(1);
    let judges: Vec<DVec3> = points.iter().step_by(every).copied().collect();
    let least = most_tilt_rad.cos();
    let mut best: Option<(f64, Plane)> = None;
    for draw in 0..DRAWS {
        let mut numbers = Sampler::new(seed, POINTS, 0, draw);
        let mut pick = || judges[(numbers.next_u64() % judges.len() as u64) as usize];
        let (a, b, c) = (pick(), pick(), pick());
        let Some(normal) = (b - a).cross(c - a).try_normalize() else {
            continue;
        };
        let normal = normal * normal.dot(up).signum();
        if normal.dot(up) < least {
            continue;
        }
        let plane = Plane {
            normal,
            offset: normal.dot(a),
        };
        let cost: f64 = judges
            .iter()
            .map(|p| cost(plane.height(*p) / threshold))
            .sum();
        if best.is_none_or(|(least, _)| cost < least) {
            best = Some((cost, plane));
        }
    }
    best.map(|b| b.1)
}

/// Of a point so many thresholds above the plane.
fn cost(height: f64) -> f64 {
    match height {
        h if h < -3.0 => BELOW,
        h if h.abs() > 1.0 => 1.0,
        h => h * h,
    }
}

/// The plane of least squares near `plane`, points weighted by Tukey's function of their height, and the
/// standard deviation of heights on it.
pub(crate) fn refine(points: &[DVec3], plane: Plane, threshold: f64) -> (Plane, f64) {
    let (mut plane, mut sigma) = (plane, threshold);
    for _ in 0..12 {
        let reach = TUKEY * sigma;
        let near: Vec<(DVec3, f64)> = points
            .iter()
            .map(|p| (*p, plane.height(*p)))
            .filter(|(_, h)| h.abs() < reach)
            .collect();
        let Some(next) = weighted(&near, plane, reach) else {
            break;
        };
        plane = next;
        let mut off: Vec<f64> = near.iter().map(|(p, _)| plane.height(*p).abs()).collect();
        let middle = off.len() / 2;
        let median = *off.select_nth_unstable_by(middle, f64::total_cmp).1;
        // Flat ground in a file of few digits has no deviation at all.
        sigma = (MAD * median).clamp(1e-3 * threshold, threshold);
    }
    (plane, sigma)
}

/// Heights over `plane` as a linear function along it.
fn weighted(near: &[(DVec3, f64)], plane: Plane, reach: f64) -> Option<Plane> {
    let right = plane.normal.any_orthonormal_vector();
    let ahead = plane.normal.cross(right);
    let weight = |h: f64| (1.0 - (h / reach).powi(2)).max(0.0).powi(2);
    let total: f64 = near.iter().map(|(_, h)| weight(*h)).sum();
    if !(total > 3.0) {
        return None;
    }
    let middle = near.iter().map(|(p, h)| *p * weight(*h)).sum::<DVec3>() / total;
    let (mut normal, mut rhs) = (DMat3::ZERO, DVec3::ZERO);
    for (p, h) in near {
        let from = *p - middle;
        let row = DVec3::new(right.dot(from), ahead.dot(from), 1.0);
        let w = weight(*h);
        normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * w;
        rhs += row * (w * h);
    }
    // Points along a line leave the tilt about it open.
    let flat = normal.x_axis.x * normal.y_axis.y - normal.x_axis.y * normal.y_axis.x;
    if !(flat > 1e-9 * (normal.x_axis.x + normal.y_axis.y).powi(2)) {
        return None;
    }
    let fit = normal.inverse() * rhs;
    let turned = (plane.normal - fit.x * right - fit.y * ahead).normalize();
    let on = middle + (fit.z - plane.height(middle)) * plane.normal;
    Some(Plane {
        normal: turned,
        offset: turned.dot(on),
    })
}
