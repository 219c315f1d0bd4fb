use std::f32::consts::PI;

use dipir_light::environment::EnvironmentSampler;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;

use super::*;
use crate::job::REPLICATES;
use crate::optics::Optics;
use crate::render::{Rendered, Settings};
use crate::shapes::{icosphere, quad};
use crate::testing::{camera, everything, glowing, render, scene, settings, sky, street};

const SIDE: u32 = 64;
/// Paths a pixel and replicate.
const PATHS: u32 = 256;

fn numbers(n: u32) -> impl Iterator<Item = (Vec2, Vec2)> {
    (0..n).map(|i| {
        let mut sampler = Sampler::new(7, Stream::TEST, 0, i);
        (sampler.next_2d(), sampler.next_2d())
    })
}

fn view() -> Camera {
    street(SIDE)
}

fn through(lens: Option<ThinLens>) -> Optics {
    Optics {
        lens,
        ..Optics::default()
    }
}

fn rendered(scene: &Scene, light: &EnvironmentSampler, lens: Option<ThinLens>) -> Rendered {
    let settings = Settings {
        optics: through(lens),
        ..settings(PATHS, 5)
    };
    render(scene, light, &everything(1), &settings)
}

#[test]
fn rays_meet_where_it_is_sharp_and_lie_within_the_disc_elsewhere() {
    let camera = Camera {
        rotation: glam::Mat3::from_euler(glam::EulerRot::YXZ, 0.4, -0.3, 0.1),
        focal_px: Vec2::new(120.0, 110.0),
        ..view()
    };
    let lens = ThinLens {
        radius: 0.05,
        focus: 2.5,
    };
    for (place, u) in numbers(200) {
        let pixel = place * 64.0;
        let ray = lens.ray(&camera, pixel, u);
        let offset = ray.origin - camera.position;
        // Rounding of a position of some metres.
        assert!(camera.depth(ray.origin).abs() < 1e-5 && offset.length() < 0.05 + 1e-5);
        let seen_at = |depth: f32| {
            let along = ray.direction.dot(-camera.rotation.z_axis);
            camera.project(ray.origin + ray.direction * (depth / along))
        };
        assert!(seen_at(2.5).unwrap().distance(pixel) < 1e-2);
        for depth in [0.5, 1.5, 10.0, 1e4] {
            // The image of the place on the lens, from there: its share of the radius is that of the blur.
            let share = (camera.rotation.transpose() * offset).truncate() / lens.radius;
            let blur = lens.blur_px(&camera, depth);
            let sign = (depth - lens.focus).signum();
            let expected = pixel + sign * blur * share * Vec2::new(-1.0, 1.0);
            let found = seen_at(depth).unwrap();
            assert!(found.distance(expected) < 0.02, "{found} {expected}");
        }
    }
}

#[test]
fn a_small_thing_is_seen_as_a_disc_of_the_blurs_radius() {
    let (near, far) = (Vec3::new(0.1, 0.8, 2.0), Vec3::new(-0.1, 0.5, -4.0));
    for (center, focus) in [(near, 6.0), (far, 2.0)] {
        let ball = icosphere(center, 0.02 * view().depth(center), 3);
        let scene = scene(ball, glowing(), view(), Proxy::None);
        let lens = ThinLens {
            radius: 0.12,
            focus,
        };
        let [sharp, soft] = [None, Some(lens)].map(|lens| rendered(&scene, &sky(0.0), lens).film);
        let moments = |alpha: &Raster<f32>| {
            let middle = view().project(center).unwrap();
            let pixels = alpha.pixels().iter().enumerate();
            pixels.fold((0.0, 0.0), |(sum, square), (i, a)| {
                let at = Vec2::new((i as u32 % SIDE) as f32, (i as u32 / SIDE) as f32) + 0.5;
                (sum + a, square + a * at.distance_squared(middle))
            })
        };
        let [(area, spread), (blurred_area, blurred_spread)] =
            [&sharp, &soft].map(|film| moments(&film.alpha));
        // Four deviations of the number of paths that meet the ball.
        let hits = area * (PATHS * REPLICATES as u32) as f32;
        assert!(
            (blurred_area / area - 1.0).abs() < 4.0 / hits.sqrt(),
            "{area} {blurred_area}"
        );
        // The mean squared radius of a disc is half of its squared radius, and that of both adds up. Over a disc it has a
        // deviation of 1 / sqrt(3) of its mean: four of them for so many hits.
        let found = blurred_spread / blurred_area - spread / area;
        let radius = lens.blur_px(&view(), view().depth(center)).x;
        assert!(
            radius > 3.0
                && (found / (0.5 * radius * radius) - 1.0).abs() < 4.0 / (3.0 * hits).sqrt(),
            "{found} {radius}"
        );
        // Light is spread as coverage is.
        let off = |(o, a): (&Vec3, &f32)| (o.x - a).abs();
        let pairs = soft.object.pixels().iter().zip(soft.alpha.pixels());
        assert!(pairs.map(off).fold(0f32, f32::max) < 1e-5);
        // In the middle of the disc, the share of it that the ball fills.
        let [x, y] = view()
            .project(center)
            .unwrap()
            .to_array()
            .map(|v| v as usize);
        let expected = area / (PI * radius * radius);
        let found = soft.alpha.get(x, y);
        let paths = (PATHS * REPLICATES as u32) as f32;
        let tolerance = 4.0 * (expected / paths).sqrt();
        assert!((found - expected).abs() < tolerance, "{found} {expected}");
    }
}

#[test]
fn what_is_in_focus_is_as_sharp_as_through_a_pinhole() {
    let camera = camera(Vec3::new(0.0, 0.0, 3.0), Vec3::ZERO, 40.0, SIDE);
    let square = quad(
        Vec3::new(-0.5, -0.4, 0.0),
        Vec3::X * 0.9,
        Vec3::new(0.1, 0.8, 0.0),
    );
    let scene = scene(square, glowing(), camera, Proxy::None);
    let lens = ThinLens {
        radius: 0.1,
        focus: 3.0,
    };
    let [sharp, soft] = [None, Some(lens)].map(|lens| rendered(&scene, &sky(0.0), lens).film);
    for (a, b) in sharp.alpha.pixels().iter().zip(soft.alpha.pixels()) {
        // The same places in the pixel, but for rounding at the edge.
        assert!((a - b).abs() < 0.02, "{a} {b}");
    }
}

#[test]
fn a_straight_edge_of_a_shadow_is_that_of_a_disc() {
    let lens = ThinLens {
        radius: 0.1,
        focus: 4.0,
    };
    let edge = 48;
    let values = (0..96 * 64).map(|i| Vec3::splat(if i % 96 < edge { 0.25 } else { 1.0 }));
    let shadow = Raster::from_pixels(96, 64, values.collect());
    let camera = Camera {
        resolution: [96, 64],
        ..view()
    };
    let blurred = lens.blurred(&camera, &shadow, &Raster::filled(96, 64, 1.0), |_, y| {
        (y < 60).then_some(2.0)
    });
    let radius = lens.blur_px(&camera, 2.0).x;
    assert!(radius > 2.0);
    for x in 0..96 {
        let t = ((x as f32 + 0.5 - edge as f32) / radius).clamp(-1.0, 1.0);
        let lit = 0.5 + (t.asin() + t * (1.0 - t * t).sqrt()) / PI;
        let found = blurred.get(x, 32).x;
        // A disc of 2.2 pixels is five rows: what they say of an edge is up to .014 off what the disc does.
        assert!((found - (0.25 + 0.75 * lit)).abs() < 0.02, "{x}: {found}");
        assert_eq!(blurred.get(x, 62), shadow.get(x, 62));
    }
}
