//! Scattering of any combination of lobes, each at one of its bounds, between them, or left out.
use dipir_render::bsdf::Bsdf;
use dipir_render::bsdf::features::{ALL, EXTENSIONS};
use dipir_render::surface::{CoatPoint, ExtensionPoint, FilmPoint, SurfacePoint};
use glam::{DVec3, Vec3};

use crate::tracer::Rng;

const F: u32 = ALL | EXTENSIONS;

fn share(r: &mut Rng) -> f32 {
    match r.bits() % 3 {
        0 => 0.0,
        1 => 1.0,
        _ => r.next(),
    }
}

fn half(r: &mut Rng, x: f32) -> f32 {
    if r.bits().is_multiple_of(2) { x } else { 0.0 }
}

fn colour(r: &mut Rng) -> Vec3 {
    Vec3::new(share(r), share(r), share(r))
}

/// A surface that faces +z.
fn surface(r: &mut Rng) -> SurfacePoint {
    let (coat, sheen, anisotropy, film) = (share(r), colour(r), share(r), share(r));
    SurfacePoint {
        base_color: colour(r),
        metallic: share(r),
        roughness: share(r),
        ior: 1.0 + 2.0 * share(r),
        transmission: share(r),
        coat: CoatPoint {
            factor: half(r, coat),
            roughness: share(r),
            normal: Vec3::Z,
            own_normal: r.bits().is_multiple_of(2),
        },
        extension: ExtensionPoint {
            specular: share(r),
            specular_color: colour(r) * 2.0,
            sheen_color: sheen * half(r, 1.0),
            sheen_roughness: share(r),
            anisotropy: half(r, anisotropy),
            tangent: Vec3::X,
            film: FilmPoint {
                factor: half(r, film),
                ior: 1.0 + share(r),
                thickness_nm: 800.0 * share(r),
            },
            ..ExtensionPoint::NONE
        },
        ..SurfacePoint::facing(Vec3::Z)
    }
}

/// A direction at `cosine` from +z.
fn direction(r: &mut Rng, cosine: f32) -> Vec3 {
    let (s, c) = (std::f32::consts::TAU * r.next()).sin_cos();
    let across = (1.0 - cosine * cosine).max(0.0).sqrt();
    Vec3::new(across * c, across * s, cosine).normalize()
}

/// The same surface, seen from the side of `wo`.
fn seen_from(wo: Vec3, s: &SurfacePoint) -> SurfacePoint {
    let side = wo.z.signum();
    SurfacePoint {
        normal: s.normal * side,
        geometric_normal: s.geometric_normal * side,
        coat: CoatPoint {
            normal: s.coat.normal * side,
            ..s.coat
        },
        ..*s
    }
}

#[test]
fn no_combination_of_lobes_scatters_anything_but_numbers() {
    let is_fine = |v: Vec3| v.is_finite() && v.min_element() >= 0.0;
    for case in 0..200_000 {
        let r = &mut Rng::new(&[case, 5]);
        let s = surface(r);
        // Grazing, straight on with a length that rounding makes exceed 1, and between.
        let wo = match case % 3 {
            0 => Vec3::Z * (1.0 + 2.0 * f32::EPSILON),
            1 => {
                let cosine = (1e-3 * r.next()).max(1e-7);
                direction(r, cosine)
            }
            _ => {
                let cosine = r.next().max(1e-7);
                direction(r, cosine)
            }
        };
        let bsdf = Bsdf::<F>::new(&s, wo);
        let cosine = 2.0 * r.next() - 1.0;
        let (value, pdf) = bsdf.eval_pdf(direction(r, cosine));
        assert!(
            is_fine(value) && pdf.is_finite(),
            "{wo} {s:?}: {value} {pdf}"
        );
        assert!(
            is_fine(bsdf.albedo()) && is_fine(bsdf.passing()),
            "{wo} {s:?}"
        );
        if let Some(drawn) = bsdf.sample(r.next(), r.pair()) {
            assert!(
                is_fine(drawn.weight) && drawn.pdf > 0.0,
                "{wo} {s:?}: {drawn:?}"
            );
        }
    }
}

#[test]
fn no_combination_of_lobes_gains_light() {
    for case in 0..1500 {
        let r = &mut Rng::new(&[case, 9]);
        let s = surface(r);
        let cosine = 0.05 + 0.95 * r.next();
        let bsdf = Bsdf::<F>::new(&s, direction(r, cosine));
        let (mut sum, mut squares, n) = (DVec3::ZERO, DVec3::ZERO, 2048);
        for _ in 0..n {
            let drawn = bsdf.sample(r.next(), r.pair());
            let weight = drawn.map_or(Vec3::ZERO, |d| d.weight).as_dvec3();
            sum += weight;
            squares += weight * weight;
        }
        let mean = sum / f64::from(n);
        let variance = (squares / f64::from(n) - mean * mean).max(DVec3::ZERO) / f64::from(n);
        // 4500 means: 5 standard errors. At these cosines the interpolation of the energy table adds less than 4e-3
        // (`interpolation_of_the_energy_table_adds_less`), and the table of sheen is good to 3e-3.
        let tables = match s.extension.sheen_color == Vec3::ZERO {
            true => 4e-3,
            false => 7e-3,
        };
        let most = 1.0 + tables + 5.0 * variance.map(f64::sqrt);
        assert!(mean.cmple(most).all(), "cosine {cosine} {s:?}: {mean}");
    }
}

#[test]
fn every_combination_of_lobes_is_reciprocal() {
    for case in 0..100_000 {
        let r = &mut Rng::new(&[case, 11]);
        let s = surface(r);
        let cosines = (0.02 + 0.98 * r.next(), 2.0 * r.next() - 1.0);
        let (a, b) = (direction(r, cosines.0), direction(r, cosines.1));
        if b.z.abs() < 0.02 {
            continue;
        }
        let there = Bsdf::<F>::new(&seen_from(a, &s), a).eval(b) / b.z.abs();
        let back = Bsdf::<F>::new(&seen_from(b, &s), b).eval(a) / a.z.abs();
        // A thousandth of a lobe's value is far above the rounding of half vectors, whose square root of a sum of squares
        // narrow lobes magnify.
        let difference = (there - back).abs();
        let allowed = 2e-3 * there.max(back) + 1e-5;
        assert!(
            difference.cmple(allowed).all(),
            "{a} {b} {s:?}: {there} {back}"
        );
    }
}
