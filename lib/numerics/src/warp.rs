//! Maps from the unit square to the distributions that a renderer samples.
use std::f32::consts::{FRAC_1_PI, FRAC_PI_4, PI, TAU};

use glam::{Vec2, Vec3};

/// An orthonormal basis whose third axis is a given normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// First tangent.
    pub tangent: Vec3,
    /// Second tangent, `normal x tangent`.
    pub bitangent: Vec3,
    /// The axis that was given.
    pub normal: Vec3,
}

impl Frame {
    /// A right-handed basis around the unit vector `normal`, continuous except across
    /// `normal.z = 0` [Duff et al. 2017, "Building an Orthonormal Basis, Revisited"].
    #[inline]
    pub fn from_normal(normal: Vec3) -> Self {
        let sign = 1f32.copysign(normal.z);
        let a = -1.0 / (sign + normal.z);
        let b = normal.x * normal.y * a;
        Self {
            tangent: Vec3::new(
                1.0 + sign * normal.x * normal.x * a,
                sign * b,
                -sign * normal.x,
            ),
            bitangent: Vec3::new(b, sign + normal.y * normal.y * a, -normal.y),
            normal,
        }
    }

    /// From coordinates in this basis to world space.
    #[inline]
    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.tangent * v.x + self.bitangent * v.y + self.normal * v.z
    }

    /// From world space to coordinates in this basis.
    #[inline]
    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(
            self.tangent.dot(v),
            self.bitangent.dot(v),
            self.normal.dot(v),
        )
    }
}

/// Uniform on the unit disk, by the concentric map [Shirley and Chiu 1997], which keeps
/// strata compact.
#[inline]
pub fn square_to_disk(u: Vec2) -> Vec2 {
    let p = 2.0 * u - Vec2::ONE;
    if p == Vec2::ZERO {
        return Vec2::ZERO;
    }
    let (radius, angle) = if p.x.abs() > p.y.abs() {
        (p.x, FRAC_PI_4 * (p.y / p.x))
    } else {
        (p.y, 2.0 * FRAC_PI_4 - FRAC_PI_4 * (p.x / p.y))
    };
    radius * Vec2::new(angle.cos(), angle.sin())
}

/// On the hemisphere z >= 0 with density `z / pi` per steradian.
#[inline]
pub fn square_to_cosine_hemisphere(u: Vec2) -> Vec3 {
    let d = square_to_disk(u);
    d.extend((1.0 - d.length_squared()).max(0.0).sqrt())
}

/// Density per steradian of [`square_to_cosine_hemisphere`].
#[inline]
pub fn cosine_hemisphere_pdf(cos_theta: f32) -> f32 {
    cos_theta.max(0.0) * FRAC_1_PI
}

/// Uniform on the unit sphere: density `1 / (4 pi)`.
#[inline]
pub fn square_to_sphere(u: Vec2) -> Vec3 {
    let z = 1.0 - 2.0 * u.x;
    // (1 - z)(1 + z) keeps its digits near the poles where 1 - z^2 does not.
    let r = (4.0 * u.x * (1.0 - u.x)).max(0.0).sqrt();
    let (s, c) = (TAU * u.y).sin_cos();
    Vec3::new(r * c, r * s, z)
}

/// Uniform on the spherical cap around +z with `cos(theta) >= cos_max`.
#[inline]
pub fn square_to_cone(u: Vec2, cos_max: f32) -> Vec3 {
    // h = 1 - cos(theta): narrow caps keep their digits.
    let h = (1.0 - u.x) * (1.0 - cos_max);
    let r = (h * (2.0 - h)).max(0.0).sqrt();
    let (s, c) = (TAU * u.y).sin_cos();
    Vec3::new(r * c, r * s, 1.0 - h)
}

/// Density per steradian of [`square_to_cone`]; infinite for a cap without extent.
#[inline]
pub fn cone_pdf(cos_max: f32) -> f32 {
    1.0 / (2.0 * PI * (1.0 - cos_max))
}

/// The balance heuristic's weight of a sample drawn with density `pdf` when another
/// technique could have drawn it with density `other` [Veach and Guibas 1995].
///
/// Defined for all non-negative densities, infinite ones included: a density that is
/// infinite (a mirror) takes all the weight, two of them or two zeros share it.
#[inline]
pub fn balance_heuristic(pdf: f32, other: f32) -> f32 {
    if pdf == other {
        return 0.5;
    }
    if pdf.is_infinite() {
        return 1.0;
    }
    // The ratio form neither overflows for large densities nor divides 0 by 0 for tiny ones.
    if pdf > other {
        1.0 / (1.0 + other / pdf)
    } else {
        let r = pdf / other;
        r / (1.0 + r)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::{Sampler, Stream};

    #[test]
    fn frames_are_orthonormal_and_right_handed_for_every_normal() {
        let mut normals = vec![
            Vec3::Z,
            -Vec3::Z,
            Vec3::X,
            Vec3::new(1e-4, 0.0, -1.0).normalize(),
        ];
        normals.extend(
            (0..1000).map(|i| {
                square_to_sphere(Sampler::new(0, Stream::TEST, i, 0).next_2d()).normalize()
            }),
        );
        for n in normals {
            let f = Frame::from_normal(n);
            // A few roundings of numbers near 1, and a division by 1 + |z| >= 1.
            let tolerance = 8.0 * f32::EPSILON;
            assert!((f.tangent.length() - 1.0).abs() < tolerance, "{n}");
            assert!((f.bitangent.length() - 1.0).abs() < tolerance, "{n}");
            assert!(f.tangent.dot(f.bitangent).abs() < tolerance, "{n}");
            assert!(
                f.tangent.cross(f.bitangent).abs_diff_eq(n, tolerance),
                "{n}"
            );
            let v = Vec3::new(0.3, -0.5, 0.8);
            assert!(f.to_local(f.to_world(v)).abs_diff_eq(v, tolerance), "{n}");
        }
    }

    #[test]
    fn cosine_hemisphere_has_the_moments_of_its_density() {
        // E[z] = 2/3 and E[z^2] = 1/2; stratified, so the error is far below 1/sqrt(n).
        let n = 4096;
        let (mut first, mut second) = (0.0f64, 0.0f64);
        for s in 0..n {
            let d = square_to_cosine_hemisphere(Sampler::new(0, Stream::TEST, 0, s).next_2d());
            assert!((d.length() - 1.0).abs() < 1e-6 && d.z >= 0.0);
            first += d.z as f64;
            second += (d.z * d.z) as f64;
        }
        assert!((first / n as f64 - 2.0 / 3.0).abs() < 1e-3);
        assert!((second / n as f64 - 0.5).abs() < 1e-3);
    }

    #[test]
    fn caps_stay_within_their_angle_and_are_uniform_in_height() {
        for cos_max in [-1.0f32, 0.0, 0.9, 0.99999, 1.0] {
            let (n, mut height) = (1024, 0.0f64);
            for s in 0..n {
                let d = square_to_cone(Sampler::new(0, Stream::TEST, 1, s).next_2d(), cos_max);
                assert!(d.z >= cos_max - 2e-7, "{d} {cos_max}");
                height += (1.0 - d.z) as f64 / n as f64;
            }
            // The mean height of a cap is half its height; f32 rounds 1 - z to 6e-8.
            let expected = 0.5 * (1.0 - cos_max as f64);
            assert!(
                (height - expected).abs() < 2e-3 * expected + 6e-8,
                "{cos_max}"
            );
        }
    }

    #[test]
    fn sphere_samples_are_unit_and_balanced() {
        let (n, mut sum) = (4096, Vec3::ZERO);
        for s in 0..n {
            let d = square_to_sphere(Sampler::new(0, Stream::TEST, 2, s).next_2d());
            assert!((d.length() - 1.0).abs() < 1e-6);
            sum += d;
        }
        assert!((sum / n as f32).length() < 1e-2);
    }

    #[test]
    fn mis_weights_add_up_for_zero_infinite_and_underflowing_densities() {
        let tiny = f32::from_bits(1);
        let values = [
            0.0,
            tiny,
            1e-38,
            1e-20,
            1.0,
            3.0,
            1e20,
            f32::MAX,
            f32::INFINITY,
        ];
        for a in values {
            for b in values {
                let (wa, wb) = (balance_heuristic(a, b), balance_heuristic(b, a));
                assert!(wa.is_finite() && (0.0..=1.0).contains(&wa), "{a} {b}: {wa}");
                assert!(
                    (wa + wb - 1.0).abs() < 2.0 * f32::EPSILON,
                    "{a} {b}: {wa} + {wb}"
                );
            }
        }
        assert_eq!(balance_heuristic(f32::INFINITY, 5.0), 1.0);
        assert_eq!(balance_heuristic(5.0, f32::INFINITY), 0.0);
        assert_eq!(balance_heuristic(0.0, 0.0), 0.5);
    }
}
