use dipir_light::environment::EnvironmentSampler;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::bvh::Bounds;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;

use super::*;
use crate::film::Film;
use crate::footprint::Footprint;
use crate::job::REPLICATES;
use crate::optics::Optics;
use crate::render::Settings;
use crate::shapes::icosphere;
use crate::testing::{everything, glowing, ground, matte, render, scene, settings, sky, street};

const SIDE: u32 = 64;
/// Paths a pixel and replicate.
const PATHS: u32 = 256;

fn view() -> Camera {
    street(SIDE)
}

/// The way of [`view`] that goes on by `by` metres of its right, up and back, and `turn` radians about these.
fn way(by: Vec3, turn: Vec3) -> Shutter {
    let middle = CameraPose::of(&view());
    let end = |share: f32| CameraPose {
        position: middle.position + middle.rotation * (by * share),
        rotation: middle.rotation * Quat::from_scaled_axis(turn * share),
    };
    Shutter {
        opens: end(-1.0),
        middle,
        closes: end(1.0),
    }
}

fn ways() -> [Shutter; 4] {
    [
        way(Vec3::X * 0.15, Vec3::ZERO),
        way(Vec3::Z * -0.3, Vec3::ZERO),
        way(Vec3::ZERO, Vec3::new(0.02, 0.04, 0.08)),
        way(Vec3::new(0.1, 0.04, 0.1), Vec3::new(-0.02, 0.05, 0.03)),
    ]
}

fn moving(shutter: Shutter) -> Optics {
    Optics {
        shutter: Some(shutter),
        ..Optics::default()
    }
}

fn rendered(scene: &Scene, light: &EnvironmentSampler, optics: Optics) -> Film {
    let settings = Settings {
        optics,
        ..settings(PATHS, 5)
    };
    render(scene, light, &everything(1), &settings).film
}

fn samplers(n: u32) -> impl Iterator<Item = Sampler> {
    (0..n).map(|i| Sampler::new(7, Stream::TEST, 0, i))
}

#[test]
fn the_ends_of_a_line_are_where_the_cameras_at_both_ends_see_the_point() {
    for shutter in ways() {
        for mut sampler in samplers(100) {
            let pixel = sampler.next_2d() * SIDE as f32;
            for depth in [0.7, 3.0, 1e3, f32::INFINITY] {
                let ray = view().ray(pixel);
                let along = ray.direction.dot(-view().rotation.z_axis);
                let far = if depth.is_finite() { depth } else { 1e6 };
                let point = ray.origin + ray.direction * (far / along);
                let ends = shutter.ends_px(&view(), pixel, depth);
                for (end, time) in ends.into_iter().zip([-1.0, 1.0]) {
                    let seen = shutter.camera(&view(), time).project(point);
                    let (Some(end), Some(seen)) = (end, seen) else {
                        assert_eq!(end, seen, "{depth}");
                        continue;
                    };
                    // Rounding of both, a hundredth of a pixel, grows as the point is far beside the picture.
                    let off = (pixel + end).distance(seen);
                    assert!(off < 1e-2 * (1.0 + seen.length() / 64.0), "{off} {depth}");
                }
            }
        }
    }
}

#[test]
fn a_camera_that_stands_still_sees_what_a_pinhole_sees() {
    let ball = icosphere(Vec3::new(0.0, 0.5, 0.0), 0.4, 4);
    let scene = scene(ball, matte(Vec3::splat(0.5)), view(), ground());
    let still = moving(way(Vec3::ZERO, Vec3::ZERO));
    let [sharp, same] = [Optics::default(), still].map(|o| rendered(&scene, &sky(1.0), o));
    for (a, b) in sharp.alpha.pixels().iter().zip(same.alpha.pixels()) {
        // The same places in the pixel, but for rounding at the edge.
        assert!((a - b).abs() < 0.02, "{a} {b}");
    }
    // Ground is sampled alike.
    assert_eq!(sharp.shadow, same.shadow);
}

#[test]
fn a_small_thing_is_seen_as_a_line() {
    let center = Vec3::new(0.1, 0.7, 1.0);
    let ball = icosphere(center, 0.03, 3);
    let scene = scene(ball, glowing(), view(), Proxy::None);
    let sharp = rendered(&scene, &sky(0.0), Optics::default());
    for shutter in [
        way(Vec3::X * 0.2, Vec3::ZERO),
        way(Vec3::ZERO, Vec3::new(0.0, 0.05, 0.06)),
    ] {
        let soft = rendered(&scene, &sky(0.0), moving(shutter));
        let [opens, closes] =
            [-1.0, 1.0].map(|time| shutter.camera(&view(), time).project(center).unwrap());
        let (middle, length) = (0.5 * (opens + closes), opens.distance(closes));
        let along = (closes - opens) / length;
        let moments = |film: &Film| {
            let pixels = film.alpha.pixels().iter().enumerate();
            pixels.fold((0.0, Vec2::ZERO), |(sum, square), (i, a)| {
                let at = Vec2::new((i as u32 % SIDE) as f32, (i as u32 / SIDE) as f32) + 0.5;
                let off = at - middle;
                let parts = Vec2::new(off.dot(along), off.perp_dot(along));
                (sum + a, square + *a * parts * parts)
            })
        };
        let ((area, own), (blurred_area, blurred)) = (moments(&sharp), moments(&soft));
        let hits = area * (PATHS * REPLICATES as u32) as f32;
        // A camera .2 metres aside is 1/450 farther from the ball three metres away, which looks 1/225 smaller. Four deviations.
        let change = (blurred_area / area - 1.0).abs();
        assert!(
            change < 1.0 / 225.0 + 4.0 / hits.sqrt(),
            "{area} {blurred_area}"
        );
        let [own, blurred] = [own / area, blurred / blurred_area];
        // A line has a twelfth of its squared length along it, and the deviation of that is 1 / sqrt(1.25) of it. Across there is
        // its bow, 20 pixels (1 - cos .06) at most, and that of squares of about a third of a pixel, of less than half of one.
        let expected = length * length / 12.0;
        let tolerance = 4.0 / (1.25 * hits).sqrt();
        assert!(length > 8.0, "{length}");
        let found = blurred - own;
        assert!(
            (found.x / expected - 1.0).abs() < tolerance,
            "{found} {expected}"
        );
        assert!(found.y.abs() < 4.0 * 0.5 / hits.sqrt(), "{found}");
        // Light is spread as coverage is.
        let off = |(o, a): (&Vec3, &f32)| (o.x - a).abs();
        let pairs = soft.object.pixels().iter().zip(soft.alpha.pixels());
        assert!(pairs.map(off).fold(0f32, f32::max) < 1e-5);
    }
}

#[test]
fn a_straight_edge_of_a_shadow_is_a_ramp() {
    let edge = 48;
    let values = (0..96 * 64).map(|i| Vec3::splat(if i % 96 < edge { 0.25 } else { 1.0 }));
    let shadow = Raster::from_pixels(96, 64, values.collect());
    let camera = Camera {
        resolution: [96, 64],
        ..view()
    };
    let shutter = way(Vec3::X * 0.1, Vec3::ZERO);
    let blurred = shutter.blurred(&camera, &shadow, &Raster::filled(96, 64, 1.0), |_, y| {
        (y < 60).then_some(2.0)
    });
    let [Some(opens), Some(closes)] = shutter.ends_px(&camera, camera.principal_px, 2.0) else {
        panic!("it is before the camera");
    };
    let length = opens.distance(closes);
    assert!(length > 8.0 && (opens + closes).length() < 1e-4);
    for x in 0..96 {
        let t = (x as f32 + 0.5 - edge as f32) / length;
        let lit = (0.5 + t).clamp(0.0, 1.0);
        let found = blurred.get(x, 32).x;
        // An edge between two pixels is one pixel wide, and samples are half a pixel apart.
        assert!(
            (found - (0.25 + 0.75 * lit)).abs() < 0.75 * 0.5 / length,
            "{x}: {found}"
        );
        assert_eq!(blurred.get(x, 62), shadow.get(x, 62));
    }
}

#[test]
fn every_pixel_that_sees_a_point_on_the_way_is_held() {
    let bounds = Bounds {
        min: Vec3::new(-0.6, 0.2, -0.5),
        max: Vec3::new(0.3, 0.9, 0.5),
    };
    let whirl = way(Vec3::new(0.3, -0.1, 0.4), Vec3::new(0.1, 0.2, 2.8));
    for shutter in ways().into_iter().chain([whirl]) {
        let held = Footprint::new(&view(), moving(shutter), Some(bounds), &[]);
        let mut seen = 0;
        for mut sampler in samplers(4000) {
            let (u, v) = (sampler.next_2d(), sampler.next_1d());
            let p = bounds.min + (bounds.max - bounds.min) * u.extend(v);
            let at = shutter.camera(&view(), 2.0 * sampler.next_1d() - 1.0);
            let Some(px) = at.project(p) else { continue };
            if px.min_element() >= 0.0 && px.max_element() < SIDE as f32 {
                seen += 1;
                assert!(held.holds(px.x as u32, px.y as u32), "{p}");
            }
        }
        assert!(seen > 1000);
        assert!(shutter == whirl || !held.holds(0, 0));
    }
}

#[test]
fn only_what_the_shadow_reaches_is_averaged() {
    let mut shadow = Raster::filled(64, 64, Vec3::ONE);
    assert_eq!(shaded(&shadow), None);
    for (x, y) in [(30, 20), (33, 41)] {
        *shadow.get_mut(x, y) = Vec3::splat(0.5);
    }
    let [low, high] = shaded(&shadow).unwrap();
    assert_eq!((low, high), (Vec2::new(29.0, 19.0), Vec2::new(35.0, 43.0)));
    // As where every pixel is averaged.
    let shutter = way(Vec3::X * 0.15, Vec3::Z * 0.05);
    let seen = Raster::filled(64, 64, 1.0);
    let blurred = shutter.blurred(&view(), &shadow, &seen, |_, _| Some(3.0));
    for y in 0..64 {
        for x in 0..64 {
            let at = Vec2::new(x as f32, y as f32) + 0.5;
            let [Some(opens), Some(closes)] = shutter.ends_px(&view(), at, 3.0) else {
                panic!("it is before the camera");
            };
            let ends = [-opens, -closes].map(|end| mean(&shadow, &seen, at, end).truncate());
            let want = 0.5 * (ends[0] + ends[1]);
            let found = *blurred.get(x, y);
            assert!(found.abs_diff_eq(want, 1e-6), "{x} {y}: {found} {want}");
        }
    }
}
