//! What a picture costs: image samples per second of each layer, with shapes that trace no
//! secondary ray at all (convex) and many (a knot), and the plans that features select.
use std::ops::ControlFlow;

use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_render::adaptive::Stop;
use dipir_render::features::{ALL, SPECULAR};
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_render::shapes::{icosphere, torus_knot};
use dipir_scene::camera::Camera;
use dipir_scene::material::Material;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use divan::Bencher;
use divan::counter::ItemsCount;
use glam::{Mat3, Vec2, Vec3};

fn main() {
    divan::main();
}

const SIZE: u32 = 96;
const SAMPLES: u32 = 16;

/// An evenly lit sky with one bright texel.
fn sky() -> EnvironmentSampler {
    let (width, height) = (1024, 512);
    let mut texels = vec![Vec3::new(0.4, 0.5, 0.7); width * height];
    texels[130 * width + 400] = Vec3::splat(4e4);
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels).expect("a valid map"))
}

fn scene(mesh: TriangleMesh, proxy: bool) -> Scene {
    let position = Vec3::new(0.0, 2.0, 4.0);
    let back = (position - Vec3::Y * 0.6).normalize();
    let right = Vec3::Y.cross(back).normalize();
    Scene {
        mesh,
        materials: vec![Material::default()],
        textures: Vec::new(),
        camera: Camera {
            position,
            rotation: Mat3::from_cols(right, back.cross(right), back),
            focal_px: Vec2::splat(1.4 * SIZE as f32),
            principal_px: Vec2::splat(0.5 * SIZE as f32),
            resolution: [SIZE, SIZE],
        },
        proxy: match proxy {
            true => Proxy::Plane(Plane {
                point: Vec3::ZERO,
                normal: Vec3::Y,
            }),
            false => Proxy::None,
        },
    }
}

fn ball() -> TriangleMesh {
    icosphere(Vec3::Y * 0.6, 0.6, 5)
}

fn knot() -> TriangleMesh {
    torus_knot(Vec3::Y * 0.8, 0.45, 0.16, 512, 32)
}

fn run(bencher: Bencher, mesh: TriangleMesh, features: u32, max_depth: u32, shadow: bool) {
    let (scene, light) = (scene(mesh, shadow), sky());
    let renderer = Renderer::new(&scene);
    let simulation = Simulation {
        features,
        max_depth,
        shadow,
        proxy_occlusion: false,
        light_on_proxy: None,
    };
    let settings = Settings {
        stop: Stop::Samples(SAMPLES),
        ..Settings::default()
    };
    let render = || {
        renderer
            .render(&light, &simulation, &settings, &mut |_| {
                ControlFlow::Continue(())
            })
            .expect("renders")
    };
    bencher
        .counter(ItemsCount::new(render().samples))
        .bench(render);
}

/// Samples per second of a convex matte object: camera rays alone.
#[divan::bench(sample_count = 10)]
fn convex_matte(bencher: Bencher) {
    run(bencher, ball(), 0, 4, false);
}

/// Interreflection to depth D.
#[divan::bench(args = [1, 2, 4, 8], sample_count = 10)]
fn knot_matte(bencher: Bencher, max_depth: u32) {
    run(bencher, knot(), 0, max_depth, false);
}

/// The microfacet lobe in its own kernel, and in the one that can do everything.
#[divan::bench(args = [SPECULAR, ALL], sample_count = 10)]
fn knot_glossy(bencher: Bencher, features: u32) {
    run(bencher, knot(), features, 4, false);
}

/// Object and shadow ratio together.
#[divan::bench(sample_count = 10)]
fn knot_with_shadow(bencher: Bencher) {
    run(bencher, knot(), 0, 2, true);
}

/// A map of one texel row above the horizon, black: pixels that are known without a ray.
#[divan::bench(sample_count = 10)]
fn shadow_without_light(bencher: Bencher) {
    let scene = scene(ball(), true);
    let light = EnvironmentSampler::new(EnvironmentMap::constant(2, 1, Vec3::ZERO));
    let renderer = Renderer::new(&scene);
    let simulation = Simulation {
        features: 0,
        max_depth: 0,
        shadow: true,
        proxy_occlusion: false,
        light_on_proxy: None,
    };
    let settings = Settings {
        stop: Stop::Samples(SAMPLES),
        ..Settings::default()
    };
    bencher.bench(|| {
        renderer.render(&light, &simulation, &settings, &mut |_| {
            ControlFlow::Continue(())
        })
    });
}
