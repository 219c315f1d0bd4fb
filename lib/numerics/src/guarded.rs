//! Functions that stay finite at the edge of their domain. Each says its domain, its value
//! at the limit, and what its derivative does there; call sites invent no epsilons.
use glam::Vec3;

/// Square root that takes rounding below zero for zero. Domain: any; negative gives 0.
/// The derivative is unbounded at 0.
#[inline]
pub fn safe_sqrt(x: f32) -> f32 {
    x.max(0.0).sqrt()
}

/// `v / |v|`, or `fallback` where `v` is zero or not finite. Scales first, so that vectors
/// from 1e-38 to 1e38 long keep their direction.
#[inline]
pub fn normalize_or(v: Vec3, fallback: Vec3) -> Vec3 {
    let m = v.abs().max_element();
    if m > 0.0 && v.is_finite() {
        let w = v / m;
        w / w.length()
    } else {
        fallback
    }
}

/// `1 - v . mu` of two unit vectors, as `|v - mu|^2 / 2`: exact to a few ulp where the dot
/// product has lost every digit (directions closer than 3e-4 rad in f32).
#[inline]
pub fn one_minus_cos(v: Vec3, mu: Vec3) -> f32 {
    0.5 * (v - mu).length_squared()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_root_of_less_than_nothing_is_nothing() {
        assert_eq!(safe_sqrt(-1e-9), 0.0);
    }

    #[test]
    fn tiny_and_huge_vectors_keep_their_direction() {
        for scale in [1e-38f32, 1e-20, 1.0, 1e20, 1e38] {
            let n = normalize_or(Vec3::new(1.0, -2.0, 2.0) * scale, Vec3::Y);
            assert!(
                n.abs_diff_eq(Vec3::new(1.0, -2.0, 2.0) / 3.0, 1e-6),
                "{scale}: {n}"
            );
        }
        assert_eq!(normalize_or(Vec3::ZERO, Vec3::Y), Vec3::Y);
        assert_eq!(
            normalize_or(Vec3::new(f32::NAN, 0.0, 1.0), Vec3::Y),
            Vec3::Y
        );
    }

    #[test]
    fn one_minus_cos_keeps_its_digits_for_a_milliradian_sun() {
        for angle in [1e-4f64, 1e-3, 0.1, 3.0] {
            let v = Vec3::new(angle.sin() as f32, 0.0, angle.cos() as f32);
            // The exact answer for the rounded vector, in f64.
            let d = v.as_dvec3() - glam::DVec3::Z;
            let exact = 0.5 * d.length_squared();
            let got = one_minus_cos(v, Vec3::Z) as f64;
            assert!(
                (got / exact - 1.0).abs() < 4.0 * f32::EPSILON as f64,
                "{angle}"
            );
        }
    }
}
