//! Materials recovered from a picture under a known light: three objects, each from a half-metallic
//! grey of roughness .5.
//!
//! Run with `cargo test -p dipir-optimize --bench materials -- --bench [key=value...]`: prints the table
//! of `docs/materials.md`. Keys: `iterations`, `picture` and `gradient` (paths per pixel of a step's
//! picture and of its derivatives), `rate`, `side` (of the picture, pixels), `seed`; `ball` puts a ball
//! in the knot's place. Without `--bench`, as tests run it, a few steps prove that it works.
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_optimize::materials::{MaterialOptimization, MaterialOutcome, MaterialSettings};
use dipir_render::adaptive::Stop;
use dipir_render::features::ALL;
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_render::shapes::{icosphere, torus_knot};
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::material::Material;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::Vec3;

/// Name, base colour, metalness, roughness.
const MATERIALS: [(&str, [f32; 3], f32, f32); 3] = [
    ("matte", [0.7, 0.4, 0.2], 0.0, 0.8),
    ("glossy", [0.2, 0.5, 0.7], 0.0, 0.3),
    ("metal", [0.9, 0.7, 0.4], 1.0, 0.35),
];

struct Knobs {
    settings: MaterialSettings,
    side: u32,
    ball: bool,
    /// Display-referred RMSE at which the reference stops.
    target: f32,
}

fn scene(knobs: &Knobs, color: [f32; 3], metallic: f32, roughness: f32) -> Scene {
    Scene {
        mesh: match knobs.ball {
            true => icosphere(Vec3::ZERO, 0.9, 4),
            false => torus_knot(Vec3::ZERO, 0.5, 0.2, 256, 24),
        },
        materials: vec![Material {
            name: "paint".into(),
            base_color: Vec3::from(color).extend(1.0),
            metallic,
            roughness,
            ..Material::default()
        }],
        textures: Vec::new(),
        camera: Camera::look_at(
            Vec3::new(0.0, 1.2, 3.6),
            Vec3::ZERO,
            Vec3::Y,
            FieldOfView::Vertical(0.6),
            [knobs.side; 2],
        ),
        proxy: Proxy::None,
    }
}

/// A sky with a wide window and a small lamp: highlights of two widths.
fn light() -> EnvironmentSampler {
    let (width, height) = (32, 16);
    let texels = (0..width * height).map(|k| match (k / width, k % width) {
        (3..=6, 10..=14) => Vec3::new(3.0, 2.8, 2.5),
        (5, 19) => Vec3::splat(25.0),
        (0..=7, _) => Vec3::new(0.3, 0.35, 0.45),
        _ => Vec3::splat(0.15),
    });
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels.collect()).expect("a map"))
}

fn simulation() -> Simulation {
    Simulation {
        features: ALL,
        max_depth: 3,
        shadow: false,
        proxy_occlusion: false,
        light_on_proxy: None,
    }
}

fn picture(scene: &Scene, background: &LinearImage, target: f32) -> DisplayImage {
    let settings = Settings {
        seed: 77,
        stop: Stop::TargetError(target),
        background: Some(background),
        ..Settings::default()
    };
    let film = Renderer::new(scene)
        .render(&light(), &simulation(), &settings, &mut |_| {
            ControlFlow::Continue(())
        })
        .expect("renders")
        .film;
    let object = ToneCurves::identity().apply_object(&LinearImage(film.object), &film.alpha);
    let picture = composite(background, &object, &film.alpha, &LinearImage(film.shadow));
    Transfer::Srgb.encode(&picture.expect("one size"))
}

fn recover(truth: &Scene, knobs: &Knobs) -> MaterialOutcome {
    let side = knobs.side as usize;
    let background = LinearImage(Raster::filled(side, side, Vec3::splat(0.2)));
    let reference = picture(truth, &background, knobs.target);
    let start = scene(knobs, [0.5; 3], 0.5, 0.5);
    MaterialOptimization {
        renderer: &Renderer::new(&start),
        light: &light(),
        simulation: simulation(),
        tone: Some(ToneCurves::identity()),
        background: &background,
        transfer: Transfer::Srgb,
        reference: &reference,
        materials: vec![0],
        settings: knobs.settings,
        checkpoint: None,
    }
    .run(&mut |_| ControlFlow::Continue(()))
    .expect("recovers")
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let timing = arguments.iter().any(|a| a == "--bench");
    let value = |key: &str, otherwise: f64| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        pairs.rfind(|(k, _)| *k == key).map_or(otherwise, |(_, v)| {
            v.parse()
                .unwrap_or_else(|_| panic!("{key}={v} is no number"))
        })
    };
    let usual = MaterialSettings::default();
    let iterations = if timing { usual.iterations } else { 5 };
    let knobs = Knobs {
        settings: MaterialSettings {
            iterations: value("iterations", iterations as f64) as usize,
            picture_samples: value("picture", usual.picture_samples.into()) as u32,
            gradient_samples: value("gradient", usual.gradient_samples.into()) as u32,
            rate: value("rate", usual.rate),
            seed: value("seed", 5.0) as u64,
            ..usual
        },
        side: value("side", if timing { 48.0 } else { 12.0 }) as u32,
        ball: arguments.iter().any(|a| a == "ball"),
        target: if timing { 0.001 } else { 0.02 },
    };
    println!("| material | base colour | metallic | roughness | largest error | seconds |");
    println!("|---|---|--:|--:|--:|--:|");
    for (name, color, metallic, roughness) in MATERIALS {
        let clock = Instant::now();
        let outcome = recover(&scene(&knobs, color, metallic, roughness), &knobs);
        let found = &outcome.materials[0];
        let apart = (Vec3::from(found.base_color) - Vec3::from(color)).abs();
        let error = apart
            .max_element()
            .max((found.metallic - metallic).abs())
            .max((found.roughness - roughness).abs());
        let [r, g, b] = found.base_color;
        println!(
            "| {name} {color:?}, {metallic}, {roughness} | {r:.3}, {g:.3}, {b:.3} | {:.3} | {:.3} | {error:.3} | {:.1} |",
            found.metallic,
            found.roughness,
            clock.elapsed().as_secs_f64()
        );
    }
}
