//! What planning saves: ten kinds of scene with every effect simulated, whether the scene has it or
//! not, and as planned, as a table in Markdown. `cargo bench -p dipir-render --bench effects`
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_render::adaptive::Stop;
use dipir_render::effects::{EffectsPlan, plan};
use dipir_render::features::ALL;
use dipir_render::render::{Rendered, Renderer, Settings, Simulation};
use dipir_render::shadow::LightOnProxy;
use dipir_render::shapes::{append, icosphere, quad, torus_knot};
use dipir_scene::camera::Camera;
use dipir_scene::config::EffectsConfig;
use dipir_scene::material::{AlphaMode, Clearcoat, Material, Transmission};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{Mat3, Vec2, Vec3, Vec4};

const SIZE: u32 = 256;
const SAMPLES: u32 = 32;
const REPEATS: usize = 3;

fn camera() -> Camera {
    let position = Vec3::new(0.0, 2.0, 4.0);
    let back = (position - Vec3::Y * 0.5).normalize();
    let right = Vec3::Y.cross(back).normalize();
    Camera {
        position,
        rotation: Mat3::from_cols(right, back.cross(right), back),
        focal_px: Vec2::splat(1.4 * SIZE as f32),
        principal_px: Vec2::splat(0.5 * SIZE as f32),
        resolution: [SIZE, SIZE],
    }
}

/// A blue sky with a sun of one texel, over brown ground.
fn sky() -> EnvironmentSampler {
    let (width, height) = (1024, 512);
    let mut texels = vec![Vec3::new(0.35, 0.5, 0.8); width * height];
    texels[width * height / 2..].fill(Vec3::new(0.2, 0.18, 0.15));
    texels[130 * width + 400] = Vec3::splat(4e4);
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels).expect("a valid map"))
}

fn ball() -> TriangleMesh {
    icosphere(Vec3::Y * 0.6, 0.5, 5)
}

fn knot() -> TriangleMesh {
    torus_knot(Vec3::Y * 0.7, 0.4, 0.15, 512, 32)
}

fn ground() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

fn matte(grey: f32) -> Material {
    Material {
        base_color: Vec4::new(grey, grey, grey, 1.0),
        metallic: 0.0,
        roughness: 1.0,
        ..Material::default()
    }
}

fn scenes() -> Vec<(&'static str, Scene)> {
    let scene = |mesh, material, proxy| Scene {
        mesh,
        materials: vec![material],
        textures: Vec::new(),
        camera: camera(),
        proxy,
    };
    let mut coloured = ball();
    coloured.colors = coloured
        .normals
        .iter()
        .map(|n| n.abs().extend(1.0))
        .collect();
    let metal = Material {
        base_color: Vec4::new(0.9, 0.6, 0.2, 1.0),
        metallic: 1.0,
        roughness: 0.3,
        ..Material::default()
    };
    let emitter = Material {
        emissive: Vec3::new(0.5, 0.3, 0.1),
        ..matte(0.5)
    };
    let veil = Material {
        base_color: Vec4::new(0.7, 0.7, 0.7, 0.5),
        alpha_mode: AlphaMode::Blend,
        double_sided: true,
        ..matte(0.7)
    };
    let glass = Material {
        roughness: 0.05,
        transmission: Some(Transmission {
            factor: 1.0,
            texture: None,
        }),
        ..matte(0.9)
    };
    let faint = Material {
        emissive: Vec3::splat(1e-3),
        clearcoat: Some(Clearcoat {
            factor: 0.01,
            factor_texture: None,
            roughness: 0.1,
            roughness_texture: None,
            normal_texture: None,
        }),
        ..matte(0.2)
    };
    let sheet = quad(Vec3::new(-0.5, 0.2, 0.0), Vec3::X, Vec3::Y);
    let mut room = quad(
        Vec3::new(-9.0, 0.0, 9.0),
        Vec3::X * 18.0,
        Vec3::NEG_Z * 18.0,
    );
    let wall = quad(Vec3::new(-9.0, 0.0, -1.5), Vec3::X * 18.0, Vec3::Y * 4.0);
    append(&mut room, wall, 0);
    vec![
        ("matte, convex", scene(ball(), matte(0.6), ground())),
        ("matte, concave", scene(knot(), matte(0.8), ground())),
        ("metal", scene(knot(), metal, ground())),
        ("coloured", scene(coloured, matte(0.9), ground())),
        ("emitter", scene(ball(), emitter, ground())),
        ("half-transparent", scene(sheet, veil, ground())),
        ("glass", scene(ball(), glass, ground())),
        ("no proxy", scene(knot(), matte(0.5), Proxy::None)),
        ("faint coat and glow", scene(knot(), faint, ground())),
        ("proxy mesh", scene(ball(), matte(0.5), Proxy::Mesh(room))),
    ]
}

/// The best time of a few, in seconds, and the picture.
fn render(
    renderer: &Renderer,
    light: &EnvironmentSampler,
    simulation: &Simulation,
) -> (f64, Rendered) {
    let settings = Settings {
        stop: Stop::Samples(SAMPLES),
        ..Settings::default()
    };
    let mut best = (f64::INFINITY, None);
    for _ in 0..REPEATS {
        let start = Instant::now();
        let rendered = renderer
            .render(light, simulation, &settings, &mut |_| {
                ControlFlow::Continue(())
            })
            .expect("renders");
        best = (best.0.min(start.elapsed().as_secs_f64()), Some(rendered));
    }
    (best.0, best.1.expect("rendered at least once"))
}

fn main() {
    let light = sky();
    println!(
        "| scene | D | left out, RMSE | planning, s | everything, s | planned, s | saved | rays saved |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (name, scene) in scenes() {
        let renderer = Renderer::new(&scene);
        let settings = Settings::default();
        let start = Instant::now();
        let planned = plan(
            &renderer,
            &light,
            &EffectsConfig::default(),
            &settings,
            &mut |_| ControlFlow::Continue(()),
        )
        .expect("plans");
        let planning = start.elapsed().as_secs_f64();
        let everything = Simulation {
            features: ALL,
            shadow: true,
            proxy_occlusion: true,
            light_on_proxy: Some(LightOnProxy {
                emission: true,
                bounce: true,
            }),
            ..EffectsPlan::everything(&scene, &settings).simulation()
        };
        let (slow, all) = render(&renderer, &light, &everything);
        let (fast, few) = render(&renderer, &light, &planned.simulation());
        println!(
            "| {name} | {} | {:.5} | {planning:.2} | {slow:.3} | {fast:.3} | {:.0}% | {:.0}% |",
            planned.simulation().max_depth,
            planned.left_out.unwrap_or(0.0),
            100.0 * (1.0 - fast / slow),
            100.0 * (1.0 - few.counts.total() as f64 / all.counts.total() as f64),
        );
    }
}
