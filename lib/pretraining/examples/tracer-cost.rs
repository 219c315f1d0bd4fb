//! Compares the tracer of training pictures with the renderer's recorder: time, and variance of the pictures of the main
//! object and of the objects around it under every sun of a scene. The recorder's work is understated: it makes neither
//! the ground's pictures nor those of the whole scene.
//!
//! `cargo run -p dipir-pretraining --example tracer-cost [scenes]`; one thread.
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::EnvironmentMap;
use dipir_numerics::stats::median;
use dipir_pretraining::direct_light::{DirectLightImages, Layer};
use dipir_pretraining::lighting::SunSkyLight;
use dipir_pretraining::scene::{Framing, GeneratedScene, ObjectSet, Paint, SceneKind, Setting};
use dipir_render::features::SPECULAR;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::Vec3;

const SIZE: usize = 40;
const MAP: [usize; 2] = [128, 64];

/// A map of all `lights` of one scene, which guides the recorder's samples.
fn guide(scene: &GeneratedScene, lights: &[SunSkyLight]) -> EnvironmentMap {
    let maps = lights.iter().map(|light| map(scene, light));
    let sum = maps.reduce(|sum, map| {
        let texels = sum.texels().iter().zip(map.texels()).map(|(a, b)| *a + *b);
        EnvironmentMap::new(MAP[0], MAP[1], texels.collect()).expect("a map")
    });
    sum.expect("a light")
}

fn map(scene: &GeneratedScene, light: &SunSkyLight) -> EnvironmentMap {
    let map = light.environment(&scene.suns, MAP[0], MAP[1]);
    map.expect("a map")
}

/// The renderer's scene of a mesh on the ground.
fn rendered(mesh: &TriangleMesh, paints: &[Paint], scene: &GeneratedScene) -> Scene {
    Scene {
        mesh: mesh.clone(),
        materials: paints.iter().map(Paint::material).collect(),
        textures: vec![],
        camera: scene.camera,
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    }
}

/// Records `scene` for lights like `light`; also the seconds that it takes.
fn record(
    scene: &Scene,
    light: &EnvironmentMap,
    samples: u32,
    shadow: bool,
    seed: u64,
) -> (Transport, f64) {
    let black = LinearImage(Raster::filled(SIZE, SIZE, Vec3::ZERO));
    let clock = Instant::now();
    let renderer = Renderer::new(scene);
    let settings = RecordSettings {
        environment: MAP,
        samples,
        shadow_samples: samples,
        light: Some(light),
        seed,
        background: Some(&black),
        ..RecordSettings::new(Simulation {
            features: SPECULAR,
            max_depth: 1,
            shadow,
            proxy_occlusion: false,
            light_on_proxy: None,
        })
    };
    let transport = Transport::record(&renderer, &settings, &mut |_| ControlFlow::Continue(()));
    (transport.expect("a record"), clock.elapsed().as_secs_f64())
}

/// Half the mean squared difference of two independent pictures over `pixels`: the variance of one.
fn variance(pictures: [&[Vec3]; 2], pixels: &[usize]) -> f64 {
    let squares = pixels
        .iter()
        .map(|&p| pictures[0][p].distance_squared(pictures[1][p]));
    f64::from(squares.sum::<f32>()) / (2 * pixels.len().max(1)) as f64
}

/// Time of the tracer, then time ratio and variance ratios (object, surroundings) of the recorder at `samples`.
fn compare(index: u64, samples: u32) -> [f64; 4] {
    let kind = SceneKind {
        objects: ObjectSet::Training,
        setting: [Setting::Open, Setting::Street, Setting::Courtyard][index as usize % 3],
        framing: Framing::Close,
    };
    let scene = GeneratedScene::draw(11, index, SIZE as u32, kind);
    let light =
        |k: usize| SunSkyLight::new(k, scene.suns[k].elevation, (3.0, 0.7), (0.3, 0.1), 1.0);
    let lights: Vec<SunSkyLight> = (0..scene.suns.len()).map(light).collect();
    let guide = guide(&scene, &lights);
    let clock = Instant::now();
    let images = [0, 1].map(|seed| DirectLightImages::trace(&scene, seed, index));
    let traced_s = 0.5 * clock.elapsed().as_secs_f64();
    let main = rendered(&scene.main, &[scene.main_paint], &scene);
    let around = rendered(&scene.others, &scene.paints, &scene);
    let has_others = !scene.others.indices.is_empty();
    let mut recorded_s = 0.0;
    let mut recorded = |scene: &Scene, shadow: bool| {
        [0, 1].map(|seed| {
            let (transport, seconds) = record(scene, &guide, samples, shadow, seed);
            recorded_s += 0.5 * seconds;
            transport
        })
    };
    let main = recorded(&main, true);
    let around = has_others.then(|| recorded(&around, false));
    let ratio = |records: &[Transport; 2], layer: Layer| {
        let coverage = records[0].coverage();
        let pixels: Vec<usize> = (0..SIZE * SIZE)
            .filter(|&p| coverage.pixels()[p] > 0.999)
            .collect();
        let (mut of_recorder, mut of_tracer) = (0.0, 0.0);
        for light in &lights {
            let map = map(&scene, light);
            let pictures = records.each_ref().map(|r| r.foreground(map.texels()));
            of_recorder += variance([pictures[0].pixels(), pictures[1].pixels()], &pixels);
            let pictures = images.each_ref().map(|i| i.layer(layer, light));
            of_tracer += variance([&pictures[0], &pictures[1]], &pixels);
        }
        of_recorder / of_tracer
    };
    let object = ratio(&main, Layer::Object);
    let surroundings = around.map_or(f64::NAN, |around| ratio(&around, Layer::Background));
    [traced_s, recorded_s / traced_s, object, surroundings]
}

fn main() {
    let scenes = std::env::args()
        .nth(1)
        .and_then(|a| a.parse().ok())
        .unwrap_or(24);
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a thread");
    println!(
        "samples  tracer, ms  recorder's time  its variance: object  surroundings  (medians over {scenes} scenes)"
    );
    for samples in [16, 64, 256] {
        let rows: Vec<[f64; 4]> =
            one_thread.install(|| (0..scenes).map(|i| compare(i, samples)).collect());
        let of = |k: usize| {
            let values: Vec<f64> = rows
                .iter()
                .map(|r| r[k])
                .filter(|v| v.is_finite())
                .collect();
            median(&values).unwrap_or(f64::NAN)
        };
        let (ms, time, object, around) = (1e3 * of(0), of(1), of(2), of(3));
        println!("{samples:>7}  {ms:>10.1}  {time:>14.2}x  {object:>19.2}x  {around:>11.2}x");
    }
}
