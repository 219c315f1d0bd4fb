use dipir_light::environment::EnvironmentSampler;
use dipir_scene::proxy::{Plane, Proxy};

use super::*;
use crate::render::{Rendered, Simulation};
use crate::shapes::{cuboid, icosphere, quad};
use crate::testing::{
    camera, everything, ground, lambertian, matte, render, scene, settings, sky, sun,
};

mod glass;

/// What may be left of a ratio of 0: rounding of a sum over samples.
const ALL_BLOCKED: f32 = 1e-4;

fn ball(center: Vec3, radius: f32) -> dipir_scene::mesh::TriangleMesh {
    icosphere(center, radius, 5)
}

fn shadow_of(
    mesh: dipir_scene::mesh::TriangleMesh,
    view: dipir_scene::camera::Camera,
    light: &EnvironmentSampler,
    samples: u32,
) -> Rendered {
    let s = scene(mesh, matte(Vec3::ONE), view, ground());
    render(&s, light, &lambertian(1), &settings(samples, 11))
}

fn assert_is_ratio(r: &Rendered) {
    for v in r.film.shadow.pixels() {
        assert!(
            v.is_finite() && v.min_element() >= 0.0 && v.max_element() <= 1.0 + 1e-5,
            "{v}"
        );
    }
}

/// Mean over a pixel of `f` at the points of the ground that it shows, on an 8 x 8 grid.
fn over_pixel(
    view: &dipir_scene::camera::Camera,
    x: usize,
    y: usize,
    f: impl Fn(glam::DVec3) -> f64,
) -> f64 {
    (0..64)
        .map(|k| {
            let offset = (Vec2::new((k % 8) as f32, (k / 8) as f32) + 0.5) / 8.0;
            let ray = view.ray(Vec2::new(x as f32, y as f32) + offset);
            let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
            f(o - d * (o.y / d.y)) / 64.0
        })
        .sum()
}

/// Checks every pixel against `expected` within `geometric + noise`, and the mean error against
/// `geometric` and its standard error.
fn compare(
    r: &Rendered,
    view: &dipir_scene::camera::Camera,
    expected: impl Fn(glam::DVec3) -> f64,
    geometric: f64,
    noise: f64,
) {
    let n = view.resolution[0] as usize;
    let (mut sum, mut variance) = (0.0, 0.0);
    for y in 0..n {
        for x in 0..n {
            let found = f64::from(r.film.shadow.get(x, y).x);
            let se = f64::from(r.film.shadow_variance(x, y).x).sqrt();
            let wanted = over_pixel(view, x, y, &expected);
            assert!(
                (found - wanted).abs() < geometric + noise,
                "({x}, {y}): {found} instead of {wanted}, se {se}"
            );
            sum += found - wanted;
            variance += se * se;
        }
    }
    let pixels = (n * n) as f64;
    let (mean, se) = (sum / pixels, variance.sqrt() / pixels);
    assert!(
        mean.abs() < geometric + 5.0 * se,
        "mean error {mean} +- {se}"
    );
    assert!(se < 3e-3, "the test must be able to fail: {se}");
}

#[test]
fn a_sphere_under_a_constant_sky_blocks_its_form_factor() {
    // beta = 1 - r^2 h / d^3 while the whole sphere is above the horizon of the plane.
    let (center, radius) = (glam::DVec3::new(0.0, 1.2, 0.0), 0.8);
    let view = camera(Vec3::new(0.0, 7.0, 3.0), Vec3::new(0.8, 0.0, 0.0), 40.0, 16);
    let r = shadow_of(ball(center.as_vec3(), 0.8), view, &sky(2.0), 256);
    // The polyhedron is smaller than the sphere by up to (edge / radius)^2 / 8 = 1.6e-4.
    compare(
        &r,
        &view,
        |p| {
            let d = (center - p).length();
            1.0 - radius * radius * center.y / (d * d * d)
        },
        3e-4,
        0.03,
    );
    assert_is_ratio(&r);
}

#[test]
fn a_disk_in_a_small_sun_has_the_penumbra_of_the_suns_texel() {
    // A square sheet facing the ground, and the sun's texel integrated on a 48 x 48 grid.
    let direction = Vec3::new(0.3, 0.9, 0.2).normalize();
    let map = sun(direction, 100.0, 0.0, 30);
    let (i, j) = map.texel_of(direction);
    let (w, h) = (map.width(), map.height());
    let directions: Vec<glam::DVec3> = (0..48 * 48)
        .map(|k| {
            let u = (f64::from(k % 48) + 0.5) / 48.0;
            // Uniform in solid angle: uniform in cos theta.
            let cos = |row: usize| (std::f64::consts::PI * row as f64 / h as f64).cos();
            let v = (f64::from(k / 48) + 0.5) / 48.0;
            let y = cos(i) + (cos(i + 1) - cos(i)) * v;
            let phi = std::f64::consts::TAU * (j as f64 + u) / w as f64;
            let s = (1.0 - y * y).sqrt();
            glam::DVec3::new(phi.sin() * s, y, -phi.cos() * s)
        })
        .collect();
    let sheet = quad(Vec3::new(-0.5, 1.0, -0.5), Vec3::X, Vec3::Z);
    let view = camera(
        Vec3::new(0.0, 6.0, 0.1),
        Vec3::new(-0.3, 0.0, -0.2),
        18.0,
        20,
    );
    let r = shadow_of(sheet, view, &EnvironmentSampler::new(map), 256);
    let total: f64 = directions.iter().map(|d| d.y).sum();
    compare(
        &r,
        &view,
        |p| {
            let blocked: f64 = directions
                .iter()
                .filter(|d| {
                    let q = p + **d / d.y;
                    q.x.abs() <= 0.5 && q.z.abs() <= 0.5
                })
                .map(|d| d.y)
                .sum();
            1.0 - blocked / total
        },
        // Two 48-point grids over an edge: 1/48 of a pixel's penumbra, averaged out.
        1e-3,
        0.05,
    );
    let shadow = r.film.shadow.pixels();
    assert!(shadow.iter().any(|v| v.x < 0.01) && shadow.iter().any(|v| v.x == 1.0));
}

#[test]
fn no_light_above_the_horizon_means_no_shadow() {
    let below = EnvironmentSampler::new(sun(-Vec3::Y, 10.0, 0.0, 16));
    let view = camera(Vec3::new(0.0, 2.0, 4.0), Vec3::ZERO, 40.0, 16);
    for light in [below, sky(0.0)] {
        let r = shadow_of(ball(Vec3::Y * 0.5, 0.5), view, &light, 16);
        assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
        assert_eq!(r.counts.get(RayKind::Shadow), 0);
    }
}

#[test]
fn a_channel_without_light_keeps_the_photograph() {
    let map = dipir_light::environment::EnvironmentMap::constant(8, 4, Vec3::new(1.0, 0.0, 2.0));
    let view = camera(Vec3::new(0.0, 2.0, 4.0), Vec3::ZERO, 40.0, 16);
    let r = shadow_of(
        ball(Vec3::Y * 0.5, 0.5),
        view,
        &EnvironmentSampler::new(map),
        16,
    );
    assert!(
        r.film
            .shadow
            .pixels()
            .iter()
            .all(|v| v.y == 1.0 && v.x == v.z)
    );
    assert!(r.film.shadow.pixels().iter().any(|v| v.x < 0.9));
}

#[test]
fn objects_that_touch_or_pierce_the_plane_shade_it_down_to_black() {
    let view = camera(Vec3::new(0.0, 2.0, 4.0), Vec3::ZERO, 30.0, 24);
    for height in [0.5, 0.2, 0.0] {
        let r = shadow_of(ball(Vec3::Y * height, 0.5), view, &sky(1.0), 64);
        assert_is_ratio(&r);
    }
    // Below a box that stands in the plane no light arrives.
    let pierced = cuboid(Vec3::new(-0.5, -0.3, -0.5), Vec3::new(0.5, 0.4, 0.5));
    let above = camera(Vec3::new(0.0, 5.0, 0.1), Vec3::ZERO, 4.0, 8);
    let r = shadow_of(pierced, above, &sky(1.0), 64);
    assert_is_ratio(&r);
    assert!(
        r.film
            .shadow
            .pixels()
            .iter()
            .all(|v| v.max_element() < ALL_BLOCKED)
    );
    // An object below the plane blocks nothing, and that is known without a ray.
    let r = shadow_of(ball(-Vec3::Y, 0.5), view, &sky(1.0), 16);
    assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
    assert_eq!(r.counts.get(RayKind::Shadow), 0);
}

#[test]
fn a_camera_in_the_plane_or_below_sees_no_shadow() {
    for height in [0.0, -1.0] {
        let position = Vec3::new(0.0, height, 4.0);
        let view = camera(position, Vec3::new(0.0, height, 0.0), 40.0, 16);
        let r = shadow_of(ball(Vec3::Y * 0.5, 0.5), view, &sky(1.0), 16);
        assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
        assert!(r.film.object.pixels().iter().all(|v| v.is_finite()));
    }
    // A millimetre above, with the horizon in the picture.
    let view = camera(
        Vec3::new(0.0, 1e-3, 4.0),
        Vec3::new(0.0, 0.2, 0.0),
        40.0,
        16,
    );
    let r = shadow_of(ball(Vec3::Y * 0.5, 0.5), view, &sky(1.0), 16);
    assert_is_ratio(&r);
    assert!(r.film.shadow.pixels().iter().any(|v| v.x < 1.0));
}

#[test]
fn an_object_that_encloses_the_camera_takes_all_light() {
    let view = camera(
        Vec3::new(0.0, 1.0, 0.0),
        Vec3::new(0.0, 0.0, -1.0),
        60.0,
        16,
    );
    let r = shadow_of(ball(Vec3::ZERO, 8.0), view, &sky(1.0), 16);
    assert_is_ratio(&r);
    let largest = r.film.shadow.pixels().iter().fold(0f32, |m, v| m.max(v.x));
    assert!(largest < ALL_BLOCKED, "{largest}");
    // Its inside is a back face: single-sided surfaces do not hide the photograph.
    assert!(r.film.alpha.pixels().iter().all(|&a| a == 0.0));
}

#[test]
fn far_pixels_are_known_without_rays_and_change_nothing() {
    let view = camera(Vec3::new(0.0, 2.0, 6.0), Vec3::ZERO, 60.0, 48);
    let s = scene(ball(Vec3::Y * 0.3, 0.3), matte(Vec3::ONE), view, ground());
    let with = |tolerance| {
        let settings = crate::render::Settings {
            shadow_tolerance: tolerance,
            ..settings(16, 7)
        };
        render(&s, &sky(1.0), &lambertian(1), &settings)
    };
    let (exact, skipped) = (with(0.0), with(0.01));
    assert!(
        skipped.counts.get(RayKind::Shadow) * 3 < exact.counts.get(RayKind::Shadow) * 2,
        "{:?} {:?}",
        skipped.counts,
        exact.counts
    );
    for (a, b) in exact
        .film
        .shadow
        .pixels()
        .iter()
        .zip(skipped.film.shadow.pixels())
    {
        // A skipped pixel could have lost at most the tolerance, plus the noise of 16 samples.
        assert!(a == b || (*b == Vec3::ONE && a.x > 0.98), "{a} {b}");
    }
}

#[test]
fn a_flat_proxy_mesh_agrees_with_the_plane() {
    let view = camera(Vec3::new(0.0, 5.0, 3.0), Vec3::ZERO, 30.0, 16);
    let light = EnvironmentSampler::new(sun(Vec3::new(0.2, 0.9, 0.3).normalize(), 30.0, 1.0, 16));
    let sheet = quad(
        Vec3::new(-50.0, 0.0, 50.0),
        Vec3::X * 100.0,
        Vec3::NEG_Z * 100.0,
    );
    let [plane, mesh] = [ground(), Proxy::Mesh(sheet)].map(|proxy| {
        let s = scene(ball(Vec3::Y * 0.7, 0.5), matte(Vec3::ONE), view, proxy);
        render(&s, &light, &lambertian(1), &settings(512, 7))
    });
    let difference: f64 = plane
        .film
        .shadow
        .pixels()
        .iter()
        .zip(mesh.film.shadow.pixels())
        .map(|(a, b)| f64::from(a.x - b.x))
        .sum::<f64>()
        / 256.0;
    // Standard error: 0.02 a pixel over 256 pixels; the ratio's bias is of the order 1/512.
    assert!(difference.abs() < 5e-3, "{difference}");
    assert_is_ratio(&mesh);
    assert_eq!(plane.counts.get(RayKind::ProxyOcclusion), 0);
    assert!(mesh.counts.get(RayKind::ProxyOcclusion) > 0);
}

#[test]
fn ground_that_a_wall_of_the_proxy_shades_already_loses_nothing_to_the_object() {
    // A proxy roof over everything: no light arrives, so nothing can be taken.
    let mut proxy = quad(
        Vec3::new(-50.0, 0.0, 50.0),
        Vec3::X * 100.0,
        Vec3::NEG_Z * 100.0,
    );
    let roof = quad(
        Vec3::new(-500.0, 3.0, 500.0),
        Vec3::X * 1e3,
        Vec3::NEG_Z * 1e3,
    );
    crate::shapes::append(&mut proxy, roof, 0);
    let view = camera(Vec3::new(0.0, 2.0, 4.0), Vec3::new(0.0, 0.0, 1.0), 20.0, 8);
    let light = EnvironmentSampler::new(sun(Vec3::Y, 100.0, 0.0, 16));
    let s = scene(
        ball(Vec3::Y * 0.7, 0.5),
        matte(Vec3::ONE),
        view,
        Proxy::Mesh(proxy),
    );
    let r = render(&s, &light, &lambertian(1), &settings(16, 7));
    assert!(r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE));
    // Without self-occlusion it would.
    let simulation = Simulation {
        proxy_occlusion: false,
        ..lambertian(1)
    };
    let r = render(&s, &light, &simulation, &settings(16, 7));
    assert!(r.film.shadow.pixels().iter().any(|v| v.x < 0.5));
    assert_eq!(r.counts.get(RayKind::ProxyOcclusion), 0);
}

#[test]
fn light_that_the_object_emits_brightens_the_ground_by_its_form_factor() {
    // A sphere of radiance L adds pi L r^2 h / d^3 to the sky's pi, and takes r^2 h / d^3.
    let (center, radius) = (glam::DVec3::new(0.0, 1.2, 0.0), 0.8);
    let view = camera(Vec3::new(0.0, 7.0, 3.0), Vec3::new(0.8, 0.0, 0.0), 30.0, 12);
    let mut material = matte(Vec3::ZERO);
    material.emissive = Vec3::splat(3.0);
    let s = scene(ball(center.as_vec3(), 0.8), material, view, ground());
    let simulation = Simulation {
        light_on_proxy: Some(LightOnProxy {
            emission: true,
            bounce: false,
        }),
        ..everything(1)
    };
    let r = render(&s, &sky(1.0), &simulation, &settings(512, 7));
    compare(
        &r,
        &view,
        |p| {
            let d = (center - p).length();
            1.0 + 2.0 * radius * radius * center.y / (d * d * d)
        },
        2e-3,
        0.2,
    );
}

#[test]
fn a_wall_of_the_proxy_hides_the_light_that_the_object_emits() {
    let mut proxy = quad(Vec3::new(-9.0, 0.0, 9.0), Vec3::X * 18.0, Vec3::Z * -18.0);
    let wall = quad(Vec3::new(1.0, 0.0, 9.0), Vec3::Y * 3.0, Vec3::Z * -18.0);
    crate::shapes::append(&mut proxy, wall, 0);
    let mut lamp = matte(Vec3::ZERO);
    lamp.emissive = Vec3::splat(50.0);
    let mesh = ball(Vec3::new(0.0, 1.0, 0.0), 0.3);
    // The picture shows the ground behind the wall.
    let view = camera(Vec3::new(2.0, 4.0, 0.1), Vec3::new(2.0, 0.0, 0.0), 20.0, 8);
    let s = scene(mesh, lamp, view, Proxy::Mesh(proxy));
    for hides in [true, false] {
        let simulation = Simulation {
            light_on_proxy: Some(LightOnProxy {
                emission: true,
                bounce: false,
            }),
            proxy_occlusion: hides,
            ..everything(1)
        };
        let r = render(&s, &sky(1.0), &simulation, &settings(64, 7));
        let brightest = r.film.shadow.pixels().iter().fold(0f32, |m, v| m.max(v.x));
        assert_eq!(brightest <= 1.0, hides, "{brightest}");
    }
}

#[test]
fn a_white_furnace_with_bounces_to_the_proxy_has_no_shadow() {
    // A white sphere under a constant sky sends as much to the ground as it takes.
    let view = camera(Vec3::new(0.0, 7.0, 3.0), Vec3::ZERO, 30.0, 12);
    let mut sphere = ball(Vec3::Y * 1.2, 0.8);
    sphere.normals.clear();
    let s = scene(sphere, matte(Vec3::ONE), view, ground());
    let simulation = Simulation {
        light_on_proxy: Some(LightOnProxy {
            emission: false,
            bounce: true,
        }),
        ..lambertian(4)
    };
    let r = render(&s, &sky(1.0), &simulation, &settings(512, 7));
    compare(&r, &view, |_| 1.0, 1e-3, 0.2);
}

#[test]
fn a_mirror_ball_in_the_sun_throws_its_light_onto_the_ground_without_specks() {
    // A mirror ball sends what it takes, E pi r^2, evenly into all directions: E r^2 / (4 d^2)
    // times the cosine arrives at the ground. Seen beside the shadow, twice the distance from it.
    let (center, radius) = (Vec3::new(0.0, 0.6, 0.0), 0.1);
    let direction = Vec3::new(0.6, 0.8, 0.0);
    let light = EnvironmentSampler::new(sun(direction, 6e4, 0.0, 256));
    let view = camera(Vec3::new(1.2, 5.0, 0.0), Vec3::new(1.2, 0.0, 0.0), 12.0, 12);
    let polished = dipir_scene::material::Material {
        metallic: 1.0,
        roughness: 0.0,
        ..matte(Vec3::ONE)
    };
    let s = scene(ball(center, radius), polished, view, ground());
    let simulation = Simulation {
        light_on_proxy: Some(LightOnProxy {
            emission: false,
            bounce: true,
        }),
        ..everything(3)
    };
    let r = render(&s, &light, &simulation, &settings(256, 5));
    let (mut found, mut wanted) = (0.0, 0.0);
    for y in 0..12 {
        for x in 0..12 {
            let ratio = f64::from(r.film.shadow.get(x, y).x);
            assert!(
                ratio > 1.0 && ratio < 1.01,
                "a speck of {ratio} at ({x}, {y})"
            );
            found += ratio - 1.0;
            wanted += over_pixel(&view, x, y, |p| {
                let to = center.as_dvec3() - p;
                let d = to.length();
                f64::from(radius * radius) / (4.0 * d * d) * (to.y / d) / 0.8
            });
        }
    }
    // The ball is not infinitely far away: it reflects from up to r / d = 7% nearer, which is 14%
    // more. A roughness of 0.6 moves light within the pattern, which is even only for a mirror.
    assert!((found / wanted - 1.14).abs() < 0.2, "{found} {wanted}");
}

#[test]
fn a_tilted_plane_is_a_plane() {
    let normal = Vec3::new(0.3, 0.8, 0.5).normalize();
    let plane = Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: normal * 3.0,
    });
    let view = camera(normal * 6.0, Vec3::ZERO, 1.0, 9);
    let s = scene(ball(normal * 1.2, 0.8), matte(Vec3::ONE), view, plane);
    let r = render(&s, &sky(1.0), &lambertian(1), &settings(256, 7));
    // Straight below the centre: beta = 1 - (r / d)^2.
    let found = r.film.shadow.get(4, 4).x;
    assert!((found - (1.0 - 0.8 * 0.8 / 1.44)).abs() < 0.02, "{found}");
}

#[test]
fn a_sphere_that_touches_the_plane_or_is_half_below_it_blocks_its_form_factor() {
    // Touching, it is above the horizon of every point: beta = 1 - r^3 / d^3, 0 at the contact.
    let view = camera(Vec3::new(0.0, 7.0, 3.0), Vec3::new(0.8, 0.0, 0.0), 20.0, 16);
    let r = shadow_of(ball(Vec3::Y * 0.8, 0.8), view, &sky(1.0), 256);
    let touching = |p: glam::DVec3| {
        let d = (glam::DVec3::Y * 0.8 - p).length();
        1.0 - (0.8 / d).powi(3)
    };
    // The polyhedron is smaller by up to 1.6e-4 of the radius, twice that in what it blocks, and
    // leaves a gap as high at the contact.
    compare(&r, &view, touching, 1e-3, 0.1);
    assert_is_ratio(&r);

    // Half below: of a cap around a direction in the plane the upper half is seen, which projects
    // onto the disk of directions as a circular segment: beta = 1 - (a - sin a cos a) / pi.
    let view = camera(
        Vec3::new(1.35, 6.0, 0.1),
        Vec3::new(1.35, 0.0, 0.0),
        6.0,
        16,
    );
    let r = shadow_of(ball(Vec3::ZERO, 0.8), view, &sky(1.0), 256);
    let half = |p: glam::DVec3| {
        let a = (0.8 / p.length()).asin();
        1.0 - (a - a.sin() * a.cos()) / std::f64::consts::PI
    };
    compare(&r, &view, half, 1e-3, 0.1);
    assert_is_ratio(&r);
}

#[test]
fn a_lobe_that_peaks_below_the_plane_casts_the_shadow_of_what_shines_above_it() {
    use crate::render::Renderer;
    use crate::testing::carry_on;
    use dipir_light::gaussian::{SgMixture, SphericalGaussian};
    let view = camera(
        Vec3::new(1.35, 6.0, 0.1),
        Vec3::new(1.35, 0.0, 0.0),
        6.0,
        16,
    );
    let under = |sigma: f32| {
        let down = SphericalGaussian {
            direction: Vec3::NEG_Y,
            radiance: Vec3::ONE,
            sigma,
        };
        let light = SgMixture::new(vec![down]).expect("a valid lobe");
        let s = scene(ball(Vec3::ZERO, 0.8), matte(Vec3::ONE), view, ground());
        Renderer::new(&s)
            .render(&light, &lambertian(1), &settings(256, 11), &mut carry_on)
            .expect("renders")
    };
    // What arrives, 2 pi sigma^4 exp(-1 / sigma^2), is less than half of the least f32: 0 / 0.
    for sigma in [1e-3, 0.03, 0.0999, 0.1] {
        let r = under(sigma);
        assert!(
            r.film.shadow.pixels().iter().all(|v| *v == Vec3::ONE),
            "{sigma}"
        );
    }
    // Here it is 8e-7 and 0.6: y exp(-y / sigma^2) of it from height y, of which the ball takes
    // the azimuths up to acos(cos a / sqrt(1 - y^2)) on either side. Midpoints: below 1e-4.
    for sigma in [0.3, 1.0] {
        let s2 = f64::from(sigma).powi(2);
        let expected = |p: glam::DVec3| {
            let edge = (0.8 / p.length()).asin().cos();
            let (mut blocked, mut all) = (0.0, 0.0);
            for k in 0..400 {
                let y = (f64::from(k) + 0.5) / 400.0;
                let light = y * (-y / s2).exp();
                let half_turn = (edge / (1.0 - y * y).sqrt()).min(1.0).acos();
                blocked += light * half_turn / std::f64::consts::PI;
                all += light;
            }
            1.0 - blocked / all
        };
        let r = under(sigma);
        compare(&r, &view, expected, 1e-3, 0.15);
        assert_is_ratio(&r);
    }
}
