//! Specular, sheen, anisotropy, iridescence: each through the harness, and against what it is where
//! that is known in closed form.
use glam::{Vec2, Vec3};

use super::super::features::EXTENSIONS;
use super::super::fresnel::schlick_weight;
use super::*;
use crate::surface::{ExtensionPoint, FilmPoint};

const SOME: [f32; 4] = [0.0, 0.1, 0.4, 1.0];

fn extended(roughness: f32, metallic: f32, extension: ExtensionPoint) -> SurfacePoint {
    SurfacePoint {
        extension,
        ..white(roughness, metallic)
    }
}

fn direction(cosine: f32, angle: f32) -> Vec3 {
    let r = (1.0 - cosine * cosine).sqrt();
    Vec3::new(r * angle.cos(), r * angle.sin(), cosine)
}

#[test]
fn without_extensions_the_extended_kernel_returns_the_same() {
    const PLAIN: u32 = ALL;
    const EXTENDED: u32 = ALL | EXTENSIONS;
    for metallic in [0.0, 1.0] {
        for roughness in SOME {
            let mut surface = white(roughness, metallic);
            surface.base_color = Vec3::new(0.9, 0.5, 0.2);
            surface.transmission = 0.3;
            let wo = surface.normal.lerp(Vec3::X, 0.4).normalize();
            let plain = Bsdf::<PLAIN>::new(&surface, wo);
            let extended = Bsdf::<EXTENDED>::new(&surface, wo);
            for k in 0..200u64 {
                let u = |d| (hash_u64s(&[k, d]) >> 40) as f32 / 16_777_216.0;
                let (lobe, at) = (u(0), Vec2::new(u(1), u(2)));
                let (a, b) = (plain.sample(lobe, at), extended.sample(lobe, at));
                let (Some(a), Some(b)) = (a, b) else {
                    assert_eq!(a.is_some(), b.is_some());
                    continue;
                };
                // The same formulas, with factors of one multiplied in.
                assert!(a.wi.abs_diff_eq(b.wi, 1e-4), "{} {}", a.wi, b.wi);
                let error = (a.weight - b.weight).abs().max_element();
                assert!(error < 1e-4 * (1.0 + a.weight.max_element()), "{a:?} {b:?}");
            }
        }
    }
}

#[test]
fn a_tinted_or_weaker_dielectric_scatters_as_it_samples() {
    let tinted = ExtensionPoint {
        specular_color: Vec3::new(8.0, 2.0, 0.5),
        ..ExtensionPoint::NONE
    };
    let weak = ExtensionPoint {
        specular: 0.3,
        ..ExtensionPoint::NONE
    };
    for extension in [tinted, weak] {
        let surfaces = SOME.map(|r| extended(r, 0.0, extension));
        check::<{ ALL | EXTENSIONS }>("specular", &surfaces, |_, _| ());
    }
}

#[test]
fn a_dielectric_whose_reflection_is_off_is_lambertian_and_white() {
    let off = ExtensionPoint {
        specular: 0.0,
        ..ExtensionPoint::NONE
    };
    let surfaces = SOME.map(|r| extended(r, 0.0, off));
    check::<{ ALL | EXTENSIONS }>("no specular", &surfaces, stays_white);
    let surface = SurfacePoint {
        base_color: Vec3::new(0.8, 0.4, 0.1),
        ..extended(0.5, 0.0, off)
    };
    let surface = facing_z(surface);
    let bsdf = Bsdf::<{ ALL | EXTENSIONS }>::new(&surface, direction(0.7, 0.3));
    let wi = direction(0.4, 2.0);
    let lambert = surface.base_color * (wi.z / std::f32::consts::PI);
    assert!(bsdf.eval(wi).abs_diff_eq(lambert, 1e-6));
}

fn facing_z(surface: SurfacePoint) -> SurfacePoint {
    SurfacePoint {
        normal: Vec3::Z,
        geometric_normal: Vec3::Z,
        ..surface
    }
}

#[test]
fn a_mirror_reflects_what_factor_and_colour_say() {
    let extension = ExtensionPoint {
        specular: 0.6,
        specular_color: Vec3::new(2.0, 1.0, 0.5),
        ..ExtensionPoint::NONE
    };
    let surface = SurfacePoint {
        base_color: Vec3::ZERO,
        ..facing_z(extended(0.0, 0.0, extension))
    };
    let wo = direction(0.6, 0.2);
    let s = Bsdf::<{ ALL | EXTENSIONS }>::new(&surface, wo);
    let drawn = s.sample(0.5, Vec2::splat(0.5)).unwrap();
    // Index 1.5: 0.04 at normal incidence.
    let f0 = Vec3::new(0.08, 0.04, 0.02) * 0.6;
    let exact = f0 + (Vec3::splat(0.6) - f0) * schlick_weight(0.6);
    assert!(drawn.delta && drawn.weight.abs_diff_eq(exact, 1e-6));
}

#[test]
fn sheen_scatters_as_it_samples_and_adds_no_light() {
    for sheen_roughness in [0.2, 0.5, 1.0] {
        let extension = ExtensionPoint {
            sheen_color: Vec3::new(1.0, 0.6, 0.3),
            sheen_roughness,
            ..ExtensionPoint::NONE
        };
        let surfaces = [0.3, 1.0].map(|r| extended(r, 0.0, extension));
        check::<{ ALL | EXTENSIONS }>("sheen", &surfaces, |case, m| {
            // The minimum of both ways keeps back what passes one alone.
            assert!(m.albedo.x > 0.7, "{}: returns {}", case.name, m.albedo);
        });
    }
}

#[test]
fn anisotropic_facets_scatter_as_they_sample() {
    for anisotropy in [0.4, 0.8] {
        let extension = ExtensionPoint {
            anisotropy,
            tangent: normal().cross(Vec3::X),
            ..ExtensionPoint::NONE
        };
        let surfaces = [0.3, 0.6, 1.0].map(|r| extended(r, 1.0, extension));
        check::<{ ALL | EXTENSIONS }>("anisotropy", &surfaces, |case, m| {
            // What a wider lobe loses beyond a narrower one stays lost.
            assert!(m.albedo.x > 0.5, "{}: returns {}", case.name, m.albedo);
        });
    }
}

#[test]
fn the_anisotropic_lobe_equals_the_textbook_in_f64() {
    let (roughness, strength) = (0.5f32, 0.8f32);
    let extension = ExtensionPoint {
        anisotropy: strength,
        tangent: Vec3::X,
        ..ExtensionPoint::NONE
    };
    let surface = facing_z(extended(roughness, 1.0, extension));
    let across = f64::from(roughness * roughness);
    let along = across + (1.0 - across) * f64::from(strength * strength);
    let single = SurfacePoint {
        base_color: Vec3::ZERO,
        ..surface
    };
    for (wo, wi) in [
        (direction(0.8, 0.1), direction(0.6, 2.9)),
        (direction(0.3, 1.5), direction(0.5, -1.4)),
    ] {
        // A black metal reflects Schlick's weight alone; a white one less further bounces.
        let got = Bsdf::<{ ALL | EXTENSIONS }>::new(&single, wo).eval(wi).x;
        let (o, i) = (wo.as_dvec3(), wi.as_dvec3());
        let h = (o + i).normalize();
        let e = (h.x / along).powi(2) + (h.y / across).powi(2) + h.z.powi(2);
        let d = 1.0 / (std::f64::consts::PI * along * across * e * e);
        let length =
            |w: glam::DVec3| ((along * w.x).powi(2) + (across * w.y).powi(2) + w.z.powi(2)).sqrt();
        let visibility = 0.5 / (i.z * length(o) + o.z * length(i));
        let weight = (1.0 - o.dot(h)).powi(5);
        let facets = weight * d * visibility * i.z;
        let energy = crate::bsdf::energy::LobeEnergy::new(roughness);
        let further = energy.further_fresnel(0.0)
            * energy.loss(wo.z)
            * energy.loss(wi.z)
            * energy.inverse_mean_loss()
            * std::f32::consts::FRAC_1_PI
            * wi.z;
        let exact = facets + f64::from(further);
        assert!((f64::from(got) / exact - 1.0).abs() < 1e-4, "{got} {exact}");
    }
}

#[test]
fn a_film_scatters_as_it_samples_and_adds_no_light() {
    for (ior, thickness_nm) in [(1.6, 250.0), (1.6, 520.0), (1.0, 250.0), (1.2, 700.0)] {
        let extension = ExtensionPoint {
            film: FilmPoint {
                factor: 1.0,
                ior,
                thickness_nm,
            },
            ..ExtensionPoint::NONE
        };
        for metallic in [0.0, 1.0] {
            let surfaces = [0.0, 0.3].map(|r| SurfacePoint {
                base_color: Vec3::ONE,
                ..extended(r, metallic, extension)
            });
            check::<{ ALL | EXTENSIONS }>("film", &surfaces, |_, _| ());
        }
    }
}

#[test]
fn sheen_is_a_number_where_the_cosine_of_a_rounded_direction_exceeds_one() {
    let surface = facing_z(extended(
        0.5,
        1.0,
        ExtensionPoint {
            sheen_color: Vec3::ONE,
            sheen_roughness: 0.5,
            ..ExtensionPoint::NONE
        },
    ));
    // One rounding step above 1, as the length of a direction that was rotated may be.
    let above = Vec3::new(0.0, 0.0, 1.0 + 2.0 * f32::EPSILON);
    let slanted = direction(0.6, 0.4);
    for (wo, wi) in [(above, slanted), (slanted, above)] {
        let value = Bsdf::<{ ALL | EXTENSIONS }>::new(&surface, wo).eval(wi);
        assert!(value.is_finite() && value.min_element() > 0.0, "{value}");
    }
}
