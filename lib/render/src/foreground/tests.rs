use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::stats::Running;
use dipir_scene::material::{AlphaMode, Clearcoat, Material};
use dipir_scene::proxy::Proxy;
use rayon::prelude::*;

use super::*;
use crate::counters::RayCounts;
use crate::features::{ALL, SPECULAR};
use crate::light::SceneLight;
use crate::render::{Renderer, Simulation};
use crate::shapes::{cuboid, icosphere, quad, torus_knot};
use crate::testing::{camera, everything, lambertian, matte, render, scene, settings, sky, sun};

/// Mean over covered pixels of radiance over coverage, first channel, with its standard error.
fn mean(film: &crate::film::Film) -> (f64, f64) {
    let (mut sum, mut variance, mut coverage) = (0.0, 0.0, 0.0);
    for (i, &a) in film.alpha.pixels().iter().enumerate() {
        if a == 1.0 {
            sum += f64::from(film.object.pixels()[i].x);
            variance += f64::from(
                film.object_variance(i % film.alpha.width(), i / film.alpha.width())
                    .x,
            );
            coverage += 1.0;
        }
    }
    (sum / coverage, variance.sqrt() / coverage)
}

/// Each of a few fixed seeds must lie within this many standard errors: one test in 3 million
/// would fail by chance if the seeds were free.
const Z: f64 = 5.0;

#[test]
fn a_white_convex_object_under_a_constant_sky_is_one_everywhere() {
    let mut ball = icosphere(Vec3::ZERO, 1.0, 3);
    // Flat: smooth normals lose light below the triangle's own horizon.
    ball.normals.clear();
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 40.0, 32);
    let s = scene(ball, matte(Vec3::ONE), view, Proxy::None);
    for depth in [1, 4] {
        let r = render(
            &s,
            &sky(1.0),
            &lambertian(depth),
            &settings(64, depth as u64),
        );
        let (mean, se) = mean(&r.film);
        // BSDF sampling of a constant sky has no noise at all, only rounding.
        assert!(
            (mean - 1.0).abs() < Z * se + 1e-5,
            "D {depth}: {mean} +- {se}"
        );
        assert!(se < 2e-3, "the test must be able to fail: {se}");
    }
}

#[test]
fn a_white_folded_object_reflects_ever_more_up_to_one() {
    let knot = torus_knot(Vec3::ZERO, 0.5, 0.22, 96, 12);
    let view = camera(Vec3::new(0.0, 3.0, 3.0), Vec3::ZERO, 35.0, 24);
    let flat = dipir_scene::mesh::TriangleMesh {
        normals: Vec::new(),
        ..knot
    };
    let s = scene(flat, matte(Vec3::ONE), view, Proxy::None);
    let mut last = 0.0;
    for depth in [1, 2, 4, 64] {
        let r = render(&s, &sky(1.0), &lambertian(depth), &settings(64, 1));
        let (mean, se) = mean(&r.film);
        assert!(mean <= 1.0 + Z * se, "D {depth}: {mean} +- {se}");
        assert!(mean > last - Z * se, "D {depth}: {mean} after {last}");
        last = mean;
    }
    // After 64 interactions less than a thousandth of the light is still inside.
    assert!((last - 1.0).abs() < 0.01, "{last}");
}

/// Radiance of a Lambertian sphere's pixel under light of irradiance `e` from `s`, averaged
/// over 8 x 8 positions in f64; `None` unless the whole pixel shows the lit or unlit inside.
fn sphere_pixel(view: &dipir_scene::camera::Camera, x: u32, y: u32, s: Vec3) -> Option<f64> {
    let mut sum = 0.0;
    for k in 0..64u32 {
        let p =
            Vec2::new(x as f32, y as f32) + (Vec2::new((k % 8) as f32, (k / 8) as f32) + 0.5) / 8.0;
        let ray = view.ray(p);
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let b = o.dot(d);
        let discriminant = b * b - (o.length_squared() - 1.0);
        // Stay off the silhouette, where the polyhedron differs from the sphere.
        if discriminant < 0.2 {
            return None;
        }
        let n = o + d * (-b - discriminant.sqrt());
        sum += n.dot(s.as_dvec3()).max(0.0) / 64.0;
    }
    Some(sum)
}

#[test]
fn a_diffuse_sphere_in_direct_sun_matches_the_closed_form() {
    let map = sun(Vec3::new(0.6, 0.7, 0.5).normalize(), 5000.0, 0.0, 180);
    let (i, j) = map.texel_of(Vec3::new(0.6, 0.7, 0.5).normalize());
    let s = map.direction_of(i, j);
    let irradiance = 5000.0 * map.solid_angle(i);
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 32.0, 24);
    let ball = icosphere(Vec3::ZERO, 1.0, 5);
    let world = scene(ball, matte(Vec3::splat(0.8)), view, Proxy::None);
    let light = EnvironmentSampler::new(map);
    let (mut errors, mut pixels) = (0.0, 0.0);
    let r = render(&world, &light, &lambertian(1), &settings(256, 5));
    for y in 0..24 {
        for x in 0..24 {
            let Some(cosine) = sphere_pixel(&view, x, y, s) else {
                continue;
            };
            let expected = 0.8 / std::f64::consts::PI * irradiance * cosine;
            let (x, y) = (x as usize, y as usize);
            let found = f64::from(r.film.object.get(x, y).x);
            let se = f64::from(r.film.object_variance(x, y).x).sqrt();
            // Facets of 2 degrees bend the normal's interpolation by up to 1e-4, the sun is
            // 1 degree wide, and 64 positions leave 1e-3 at the terminator.
            let tolerance = 2e-3 * irradiance;
            assert!(
                (found - expected).abs() < tolerance + 12.0 * se,
                "({x}, {y}): {found} instead of {expected}, se {se}"
            );
            errors += (found - expected) / irradiance;
            pixels += 1.0;
        }
    }
    // The mean is unbiased: noise averages out, what remains is the geometry's 1e-4.
    assert!(
        pixels > 100.0 && (errors / pixels).abs() < 5e-4,
        "{errors} {pixels}"
    );
}

#[test]
fn a_mirror_has_an_infinite_density_and_shows_the_sky_unweakened() {
    let mut material = matte(Vec3::ONE);
    (material.metallic, material.roughness) = (1.0, 0.0);
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 20.0, 16);
    let s = scene(icosphere(Vec3::ZERO, 1.0, 4), material, view, Proxy::None);
    let r = render(&s, &sky(1.0), &everything(4), &settings(16, 3));
    let (mean, _) = mean(&r.film);
    // White metal reflects everything at every angle; f32 rounding of weights.
    assert!((mean - 1.0).abs() < 1e-3, "{mean}");
}

#[test]
fn a_black_light_has_no_density_anywhere_and_lights_nothing() {
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 20.0, 8);
    let s = scene(
        icosphere(Vec3::ZERO, 1.0, 3),
        matte(Vec3::ONE),
        view,
        Proxy::None,
    );
    let r = render(&s, &sky(0.0), &everything(4), &settings(8, 3));
    assert!(r.film.object.pixels().iter().all(|c| *c == Vec3::ZERO));
    assert!(r.film.alpha.pixels().contains(&1.0));
}

#[test]
fn light_densities_that_underflow_leave_bsdf_sampling_in_charge() {
    // Next to a texel of 1e30 the density of all others, at 1, is about 1e-28 of it; at
    // 1e-20 it underflows to 0. The bright texel lies behind the visible side.
    for background in [1.0, 1e-20] {
        let map = sun(-Vec3::Z, 1e30, background, 8);
        let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 10.0, 8);
        let quad = quad(Vec3::new(-2.0, -2.0, 0.0), Vec3::X * 4.0, Vec3::Y * 4.0);
        let s = scene(quad, matte(Vec3::ONE), view, Proxy::None);
        let light = EnvironmentSampler::new(map);
        let r = render(&s, &light, &lambertian(1), &settings(64, 3));
        let (mean, _) = mean(&r.film);
        let relative = mean / f64::from(background);
        assert!((relative - 1.0).abs() < 1e-3, "{background}: {mean}");
    }
}

#[test]
fn alpha_lets_through_its_share_and_masks_cut_holes() {
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 20.0, 16);
    let sheet = quad(Vec3::new(-3.0, -3.0, 0.0), Vec3::X * 6.0, Vec3::Y * 6.0);
    for (mode, expected) in [
        (AlphaMode::Blend, 0.25),
        (AlphaMode::Mask { cutoff: 0.3 }, 0.0),
        (AlphaMode::Mask { cutoff: 0.2 }, 1.0),
        (AlphaMode::Opaque, 1.0),
    ] {
        let mut material = matte(Vec3::ONE);
        material.base_color.w = 0.25;
        material.alpha_mode = mode;
        let s = scene(sheet.clone(), material, view, Proxy::None);
        let r = render(&s, &sky(1.0), &everything(2), &settings(64, 3));
        let n = r.film.alpha.pixels().len() as f64;
        let mean = r
            .film
            .alpha
            .pixels()
            .iter()
            .map(|&a| f64::from(a))
            .sum::<f64>()
            / n;
        // 16384 independent draws of a quarter: standard error 0.0034.
        assert!((mean - expected).abs() < 0.017, "{mode:?}: {mean}");
    }
}

#[test]
fn coverage_of_an_edge_is_the_covered_share_of_the_pixel() {
    // A sheet that ends 0.3 pixels into column 8: 16 pixels are 2 m x tan(10 deg) x 4 wide.
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 20.0, 16);
    let pixel = 2.0 * 4.0 * 10f32.to_radians().tan() / 16.0;
    let sheet = quad(
        Vec3::new(-3.0, -3.0, 0.0),
        Vec3::X * (3.0 + 0.3 * pixel),
        Vec3::Y * 6.0,
    );
    let s = scene(sheet, matte(Vec3::ONE), view, Proxy::None);
    let r = render(&s, &sky(1.0), &lambertian(1), &settings(256, 3));
    for y in 0..16 {
        // Two stratified sequences of 128: at most one sample of each strays.
        assert!((r.film.alpha.get(8, y) - 0.3).abs() < 0.02);
        assert_eq!(*r.film.alpha.get(7, y), 1.0);
        assert_eq!(*r.film.alpha.get(9, y), 0.0);
    }
}

#[test]
fn back_faces_of_single_sided_surfaces_are_not_there() {
    let view = camera(-Vec3::Z * 4.0, Vec3::ZERO, 20.0, 8);
    let sheet = quad(Vec3::new(-3.0, -3.0, 0.0), Vec3::X * 6.0, Vec3::Y * 6.0);
    let seen = |double_sided| {
        let mut material = matte(Vec3::ONE);
        material.double_sided = double_sided;
        let s = scene(sheet.clone(), material, view, Proxy::None);
        let r = render(&s, &sky(1.0), &lambertian(1), &settings(8, 3));
        *r.film.alpha.get(4, 4)
    };
    assert_eq!(seen(false), 0.0);
    assert_eq!(seen(true), 1.0);
}

#[test]
fn emission_and_unlit_colours_need_no_light() {
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 20.0, 8);
    let sheet = quad(Vec3::new(-3.0, -3.0, 0.0), Vec3::X * 6.0, Vec3::Y * 6.0);
    let mut glowing = matte(Vec3::ONE);
    glowing.emissive = Vec3::new(3.0, 2.0, 1.0);
    let s = scene(sheet.clone(), glowing, view, Proxy::None);
    let r = render(&s, &sky(0.0), &everything(0), &settings(8, 3));
    assert_eq!(*r.film.object.get(4, 4), Vec3::new(3.0, 2.0, 1.0));
    let mut unlit = matte(Vec3::new(0.25, 0.5, 0.75));
    unlit.unlit = true;
    let s = scene(sheet, unlit, view, Proxy::None);
    let r = render(&s, &sky(7.0), &everything(4), &settings(8, 3));
    assert_eq!(*r.film.object.get(4, 4), Vec3::new(0.25, 0.5, 0.75));
}

#[test]
fn a_coat_dims_what_shines_below_it_by_what_it_reflects() {
    let sheet = quad(Vec3::new(-9.0, -9.0, 0.0), Vec3::X * 18.0, Vec3::Y * 18.0);
    let mut lamp = coated(0.0, 0.0);
    lamp.emissive = Vec3::new(3.0, 2.0, 1.0);
    for cosine in [1.0f32, 0.5, 0.2] {
        let towards = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
        let view = camera(towards * 4.0, Vec3::ZERO, 0.1, 2);
        let s = scene(sheet.clone(), lamp.clone(), view, Proxy::None);
        let r = render(&s, &sky(0.0), &everything(1), &settings(8, 3));
        let passing = 0.96 * (1.0 - (1.0 - cosine).powi(5));
        let found = *r.film.object.get(0, 0) / lamp.emissive;
        // A picture of .1 degrees changes the cosine by 2e-3, and what passes by 5 times that at most.
        let off = (found - passing).abs().max_element();
        assert!(off < 0.01, "{cosine}: {found} instead of {passing}");
    }
}

#[test]
fn what_is_known_costs_no_rays() {
    let view = camera(Vec3::Z * 4.0, Vec3::ZERO, 30.0, 16);
    let rays = |mesh, simulation: &Simulation| {
        let s = scene(mesh, matte(Vec3::ONE), view, Proxy::None);
        render(&s, &sky(1.0), simulation, &settings(16, 3)).counts
    };
    let convex = rays(cuboid(-Vec3::ONE, Vec3::ONE), &lambertian(8));
    assert!(convex.get(RayKind::Camera) > 0);
    assert_eq!(convex.get(RayKind::Camera), convex.total());
    // D = 0: no light is looked for.
    let knot = torus_knot(Vec3::ZERO, 0.5, 0.22, 64, 8);
    let dark = rays(knot.clone(), &lambertian(0));
    assert_eq!(dark.get(RayKind::Camera), dark.total());
    // A constant sky is left to BSDF sampling.
    let soft = rays(knot.clone(), &lambertian(2));
    assert!(soft.get(RayKind::Light) == 0 && soft.get(RayKind::Bounce) > 0);
    let light = EnvironmentSampler::new(sun(Vec3::Y, 100.0, 1.0, 16));
    let s = scene(knot, matte(Vec3::ONE), view, Proxy::None);
    let lit = render(&s, &light, &lambertian(2), &settings(16, 3)).counts;
    assert!(lit.get(RayKind::Light) > 0 && lit.get(RayKind::Bounce) > 0);
    assert_eq!(lit.get(RayKind::Shadow), 0);
}

#[test]
fn convex_shortcuts_change_no_picture() {
    // The same box, once recognised as convex and once with a far speck that prevents it.
    let view = camera(Vec3::new(3.0, 2.0, 4.0), Vec3::ZERO, 30.0, 16);
    let mut specked = cuboid(-Vec3::ONE, Vec3::ONE);
    let speck = quad(Vec3::Y * -500.0, Vec3::X * 1e-3, Vec3::Z * 1e-3);
    crate::shapes::append(&mut specked, speck, 0);
    let simulation = Simulation {
        features: SPECULAR,
        ..everything(4)
    };
    let [a, b]: [Raster<Vec3>; 2] = [cuboid(-Vec3::ONE, Vec3::ONE), specked].map(|mesh| {
        let s = scene(mesh, matte(Vec3::splat(0.5)), view, Proxy::None);
        render(&s, &sky(1.0), &simulation, &settings(16, 3))
            .film
            .object
    });
    for (a, b) in a.pixels().iter().zip(b.pixels()) {
        assert!(a.abs_diff_eq(*b, 1e-4), "{a} {b}");
    }
}

/// Clear glass without reflection, filled with what turns white into `color` within 2 m.
fn filled(color: Vec3, thickness: f32) -> dipir_scene::material::Material {
    let mut glass = matte(Vec3::ONE);
    glass.roughness = 0.0;
    glass.ior = 1.0;
    glass.double_sided = true;
    glass.transmission = Some(dipir_scene::material::Transmission {
        factor: 1.0,
        texture: None,
    });
    glass.extensions.volume = Some(dipir_scene::material::Volume {
        thickness,
        thickness_texture: None,
        attenuation_color: color,
        attenuation_distance: 2.0,
    });
    glass
}

#[test]
fn a_volume_attenuates_by_the_length_of_the_way_through_it() {
    let color = Vec3::new(0.25, 0.5, 0.9);
    // Straight on; half a degree of view leaves Schlick's factor below 1e-12.
    let view = camera(Vec3::Z * 5.0, Vec3::ZERO, 0.5, 4);
    let cube = cuboid(Vec3::splat(-0.5), Vec3::splat(0.5));
    // Some paths are reflected, with a weight of 0: compared with the same paths in clear glass.
    let passing = |mesh: &dipir_scene::mesh::TriangleMesh, material| {
        let seen = |material| {
            let s = scene(mesh.clone(), material, view, Proxy::None);
            let r = render(&s, &sky(1.0), &everything(8), &settings(64, 1));
            assert!(r.film.alpha.pixels().iter().all(|&a| a == 1.0));
            r.film.object.pixels()[5]
        };
        seen(material) / seen(filled(Vec3::ONE, 1.0))
    };
    // 1 m of the cube, whatever its thickness is said to be.
    let through = passing(&cube, filled(color, 7.0));
    let exact = color.powf(0.5);
    assert!(through.abs_diff_eq(exact, 1e-4), "{through} {exact}");
    // A sheet has no inner side: its thickness counts, from either side.
    let sheet = quad(Vec3::new(-0.5, -0.5, 0.0), Vec3::X, Vec3::Y);
    let back = quad(Vec3::new(-0.5, -0.5, 0.0), Vec3::Y, Vec3::X);
    let exact = color.powf(1.5);
    for sheet in [&sheet, &back] {
        let through = passing(sheet, filled(color, 3.0));
        assert!(through.abs_diff_eq(exact, 1e-4), "{through} {exact}");
    }
    // The way to the next sheet leads through air.
    for second in [&sheet, &cube] {
        let mut both = sheet.clone();
        let mut behind = second.clone();
        behind.positions.iter_mut().for_each(|p| p.z -= 2.0);
        crate::shapes::append(&mut both, behind, 0);
        let through = passing(&both, filled(color, 3.0));
        let metres = if second.indices.len() == 2 { 6.0 } else { 4.0 };
        let exact = color.powf(metres / 2.0);
        assert!(through.abs_diff_eq(exact, 1e-4), "{through} {exact}");
    }
}

#[test]
fn what_stands_inside_a_volume_is_seen_through_the_way_to_it() {
    let color = Vec3::new(0.25, 0.5, 0.9);
    let view = camera(Vec3::Z * 5.0, Vec3::ZERO, 0.5, 4);
    let seen = |mesh: &dipir_scene::mesh::TriangleMesh, color| {
        let mut mesh = mesh.clone();
        let lamp = cuboid(Vec3::new(-0.1, -0.1, -0.3), Vec3::new(0.1, 0.1, -0.1));
        crate::shapes::append(&mut mesh, lamp, 1);
        let mut s = scene(mesh, filled(color, 2.0), view, Proxy::None);
        let mut lamp = matte(Vec3::ZERO);
        lamp.emissive = Vec3::ONE;
        s.materials.push(lamp);
        let r = render(&s, &sky(0.0), &everything(8), &settings(64, 1));
        r.film.object.pixels()[5]
    };
    // .6 m of a cube, and a sheet that is said to be 2 m thick.
    let cube = cuboid(Vec3::splat(-0.5), Vec3::splat(0.5));
    let sheet = quad(Vec3::new(-0.5, -0.5, 0.5), Vec3::X, Vec3::Y);
    for (mesh, metres) in [(cube, 0.6), (sheet, 2.0)] {
        let through = seen(&mesh, color) / seen(&mesh, Vec3::ONE);
        let exact = color.powf(metres / 2.0);
        assert!(through.abs_diff_eq(exact, 1e-4), "{through} {exact}");
    }
}

#[test]
fn a_volume_that_attenuates_beyond_all_numbers_leaves_layers_finite() {
    let mut black = filled(Vec3::splat(1e-6), 1.0);
    let volume = black.extensions.volume.as_mut().expect("is filled");
    volume.attenuation_distance = 1e-40;
    // From outside, and from the side on which a sheet leads out of the object.
    let cube = cuboid(Vec3::splat(-0.5), Vec3::splat(0.5));
    let sheet = quad(Vec3::new(-0.5, -0.5, 0.0), Vec3::X, Vec3::Y);
    for (mesh, position) in [(cube, Vec3::Z * 5.0), (sheet, Vec3::Z * -5.0)] {
        let view = camera(position, Vec3::ZERO, 20.0, 8);
        let s = scene(mesh, black.clone(), view, crate::testing::ground());
        let film = render(&s, &sky(1.0), &everything(8), &settings(16, 1)).film;
        let mut layers = film.object.pixels().iter().chain(film.shadow.pixels());
        assert!(layers.all(|v| v.is_finite()), "{position}");
    }
}

#[test]
fn a_rough_sheet_attenuates_the_light_that_either_technique_finds() {
    let color = Vec3::new(0.25, 0.5, 0.9);
    let view = camera(Vec3::Z * 5.0, Vec3::ZERO, 0.5, 4);
    let mut material = filled(color, 2.0);
    material.roughness = 0.4;
    let sheet = quad(Vec3::new(-0.5, -0.5, 0.0), Vec3::X, Vec3::Y);
    let s = scene(sheet.clone(), material.clone(), view, Proxy::None);
    material.extensions.volume = None;
    let clear = scene(sheet, material, view, Proxy::None);
    // A source behind the sheet, drawn by light sampling, and a sky, found by BSDF sampling.
    let light = EnvironmentSampler::new(sun(Vec3::new(0.1, 0.2, -1.0).normalize(), 50.0, 0.5, 16));
    let mean = |s| {
        let r = render(s, &light, &everything(4), &settings(1024, 3));
        let sum: Vec3 = r.film.object.pixels().iter().sum();
        sum / 16.0
    };
    let (filled, clear) = (mean(&s), mean(&clear));
    // The same samples, all of them through the sheet once: an index of 1 reflects at grazing angles alone.
    assert!(
        (filled / clear).abs_diff_eq(color, 2e-3),
        "{}",
        filled / clear
    );
}

#[test]
fn emission_of_any_strength_leaves_layers_finite() {
    for strength in [1e5, 1e12] {
        let mut lamp = matte(Vec3::ONE);
        lamp.emissive = Vec3::splat(strength);
        let view = camera(Vec3::new(0.0, 3.0, 6.0), Vec3::ZERO, 40.0, 24);
        let ball = icosphere(Vec3::Y, 1.0, 2);
        let s = scene(ball, lamp, view, crate::testing::ground());
        let simulation = Simulation {
            light_on_proxy: Some(crate::shadow::LightOnProxy {
                emission: true,
                bounce: true,
            }),
            ..everything(4)
        };
        let r = render(&s, &sky(1.0), &simulation, &settings(16, 2));
        let film = &r.film;
        assert!(film.object.pixels().iter().all(|v| v.is_finite()));
        assert!(film.shadow.pixels().iter().all(|v| v.is_finite()));
        assert!(film.object.pixels().iter().any(|v| v.x >= 0.9 * strength));
        // Half precision ends at 65504: who stores such layers has to clamp them.
        assert!(film.shadow.pixels().iter().any(|v| v.x > 0.1 * strength));
        assert!(r.error.rmse.is_finite() && r.error.upper_95.is_finite());
    }
}

/// Matt grey paint under a coat of that roughness.
fn coated(grey: f32, roughness: f32) -> Material {
    Material {
        base_color: Vec3::splat(grey).extend(1.0),
        roughness: 1.0,
        clearcoat: Some(Clearcoat {
            factor: 1.0,
            roughness,
            factor_texture: None,
            roughness_texture: None,
            normal_texture: None,
        }),
        ..Material::default()
    }
}

/// By pixel of 16 x 16 that show a knot of `material`: the luminance of single paths that meet it once, and what further
/// interactions add.
fn of_paths(
    material: Material,
    light: &EnvironmentSampler,
    blur_caustics: bool,
) -> Vec<[Running; 2]> {
    let mesh = torus_knot(Vec3::ZERO, 0.4, 0.13, 200, 24);
    let view = camera(Vec3::new(2.0, 1.2, 3.0), Vec3::ZERO, 14.0, 16);
    let scene = scene(mesh, material, view, Proxy::None);
    let world = Renderer::new(&scene).world(ALL).expect("a world");
    let light = light.on_object();
    let to_depth = |depth: u32| PathContext {
        blur_caustics,
        ..PathContext::from_camera(&world, &light, &everything(depth), None)
    };
    let paths = [to_depth(1), to_depth(4)];
    let pixel = |p: u32| {
        let corner = Vec2::new((p % 16) as f32, (p / 16) as f32);
        let mut found = [Running::default(); 2];
        for sample in 0..1024 {
            let [once, all] = paths.map(|path| {
                let mut draws = Sampler::new(1, Stream::TEST, p, sample);
                let rays = &mut RayCounts::default();
                f64::from(luminance(
                    path.camera_sample::<ALL>(corner, &mut draws, rays).radiance,
                ))
            });
            found[0].push(once);
            found[1].push(all - once);
        }
        found
    };
    (0..256).into_par_iter().map(pixel).collect()
}

/// Mean over the pixels and its standard error.
fn mean_of(pixels: &[[Running; 2]], part: usize) -> (f64, f64) {
    let n = pixels.len() as f64;
    let mean = pixels.iter().map(|p| p[part].mean()).sum::<f64>() / n;
    let error = pixels
        .iter()
        .map(|p| p[part].std_error().powi(2))
        .sum::<f64>()
        .sqrt()
        / n;
    (mean, error)
}

#[test]
fn blurred_caustics_keep_the_light_of_a_white_sky() {
    for roughness in [0.0, 0.15] {
        let [sharp, blurred] =
            [false, true].map(|blur| of_paths(coated(1.0, roughness), &sky(1.0), blur));
        assert_eq!(mean_of(&sharp, 0), mean_of(&blurred, 0), "seen directly");
        let [(sharp, a), (blurred, b)] = [sharp, blurred].map(|pixels| mean_of(&pixels, 1));
        // One in 16,000 pairs differs by more: 7% of the mean.
        let bound = 4.0 * a.hypot(b);
        assert!((sharp - blurred).abs() < bound, "{sharp} {blurred} {bound}");
    }
}

#[test]
fn blurred_caustics_are_less_noisy() {
    let sun = sun(Vec3::new(0.55, 0.6, 0.35).normalize(), 6e4, 0.3, 256);
    let sunny = EnvironmentSampler::new(sun);
    let [sharp, blurred] = [false, true].map(|blur| {
        let pixels = of_paths(coated(0.5, 0.15), &sunny, blur);
        pixels.iter().map(|p| p[1].variance()).sum::<f64>()
    });
    // A thousandth of it is left; seeds are fixed, so the same each time.
    assert!(blurred < 0.1 * sharp, "{blurred} {sharp}");
}

#[test]
fn what_a_mirror_shows_is_not_blurred() {
    let mirror = Material {
        metallic: 1.0,
        roughness: 0.0,
        ..Material::default()
    };
    let [sharp, blurred] = [false, true].map(|blur| of_paths(mirror.clone(), &sky(1.0), blur));
    assert_eq!(mean_of(&sharp, 1), mean_of(&blurred, 1));
    assert!(mean_of(&sharp, 1).0 > 0.01, "the knot reflects itself");
}
