//! Light recovered from a picture: three objects under four lights, each from a neutral start.
//!
//! The reference is path traced under the true light, with random numbers that the optimiser does
//! not use; the optimiser sees recorded transport. What it finds is path traced again, its
//! lobes evaluated directly, and compared with the reference: peak direction, and the composite's
//! display-referred RMSE over the pixels that the object or its shadow touches, and over all.
//!
//! Run with `cargo test -p dipir-optimize --bench recovery -- --bench [OBJECT/LIGHT...] [key=value...]`:
//! prints the table of `docs/recovery.md`. Names pick scenes; keys are `iterations`, `lobes`,
//! `samples`, `columns` (of the environment), `width` (of the picture), `tone` (0 holds the tone
//! curves), `consistency`, `regularizer`, `fused` (the share of the iterations after which both light
//! sets are one), `radiance`, `direction`, `sigma` (learning rates); `show` prints how the loss fell and the brightest lobes.
//! Without `--bench`, as tests run it, one small scene proves that it works.
use std::ops::ControlFlow;
use std::time::Instant;

use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_optimize::crop::Framing;
use dipir_optimize::guidance::{Reference, rmse, touched};
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::Objective;
use dipir_optimize::optimization::{Event, Optimization, Outcome};
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::recorder::SceneRecorder;
use dipir_optimize::settings::{LightPreset, LightTable, Settings};
use dipir_render::adaptive::Stop;
use dipir_render::features::{SPECULAR, TEXTURES};
use dipir_render::light::SceneLight;
use dipir_render::render::{Renderer, Settings as RenderSettings, Simulation};
use dipir_render::shapes::{icosphere, torus_knot};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::material::Material;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::Vec3;

/// Seeds of the picture that is given, of the record, and of the picture that is judged.
const SEEDS: [u64; 3] = [11, 7, 12];
/// Display-referred RMSE at which path tracing stops; a fifth of what is asked of the recovery.
const CONVERGED: f32 = 0.002;

/// How a scene is recovered.
struct Knobs {
    table: LightTable,
    width: u32,
    target: f32,
    /// Print how the loss fell and the brightest lobes.
    show: bool,
}

/// What the light stage does by default.
fn standard_preset() -> LightPreset {
    let presets = include_str!("../../stages/src/presets.json");
    let mut presets: serde_json::Value = serde_json::from_str(presets).expect("JSON");
    serde_json::from_value(presets["presets"][1]["light"].take()).expect("a preset")
}

fn simulation() -> Simulation {
    Simulation {
        features: SPECULAR | TEXTURES,
        max_depth: 3,
        shadow: true,
        proxy_occlusion: false,
        light_on_proxy: None,
    }
}

const OBJECTS: [&str; 3] = ["matte knot", "glossy knot", "metal ball"];

fn scene(object: &str, resolution: [u32; 2]) -> Scene {
    let knot = || torus_knot(Vec3::Y * 0.75, 0.45, 0.17, 512, 32);
    let (mesh, base_color, roughness, metallic) = match object {
        "matte knot" => (knot(), Vec3::new(0.7, 0.65, 0.6), 1.0, 0.0),
        "glossy knot" => (knot(), Vec3::new(0.8, 0.4, 0.2), 0.3, 0.0),
        _ => (
            icosphere(Vec3::Y * 0.6, 0.6, 5),
            Vec3::new(0.9, 0.85, 0.75),
            0.2,
            1.0,
        ),
    };
    Scene {
        mesh,
        materials: vec![Material {
            base_color: base_color.extend(1.0),
            roughness,
            metallic,
            ..Material::default()
        }],
        textures: Vec::new(),
        camera: Camera::look_at(
            Vec3::new(0.0, 1.8, 4.0),
            Vec3::Y * 0.45,
            Vec3::Y,
            FieldOfView::Vertical(0.6),
            resolution,
        ),
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    }
}

/// A true light.
enum Truth {
    Lobes(SgMixture),
    /// Not a sum of a few lobes.
    Map(EnvironmentSampler),
}

const LIGHTS: [&str; 4] = ["overcast", "soft sun", "windows", "sun 1e5"];

/// The light and the direction from which most radiance comes.
fn truth(name: &str) -> (Truth, Vec3) {
    let lobe = |direction: Vec3, radiance, sigma| SphericalGaussian {
        direction: direction.normalize(),
        radiance,
        sigma,
    };
    let ground = lobe(Vec3::NEG_Y, Vec3::new(0.22, 0.2, 0.16), 0.8);
    let sky = lobe(Vec3::Y, Vec3::new(0.3, 0.42, 0.6), 0.9);
    let mixture = |peak: SphericalGaussian, others: &[SphericalGaussian]| {
        let lobes = [&[peak], others].concat();
        // Not the first lobe's own direction: where it is wide, the others move the sum's peak.
        let light = Lighting {
            sources: 0,
            exposure: 1.0,
            lobes: lobes.clone(),
            fusion_residual: 0.0,
        };
        let brightest = light.peak_direction().expect("light");
        (
            Truth::Lobes(SgMixture::new(lobes).expect("lobes")),
            brightest,
        )
    };
    match name {
        // A cover of clouds that is brightest where the sun stands behind it.
        "overcast" => mixture(
            lobe(Vec3::new(0.5, 0.9, 0.4), Vec3::new(1.0, 1.0, 1.05), 0.5),
            &[ground, lobe(Vec3::Y, Vec3::splat(0.35), 1.0)],
        ),
        "soft sun" => mixture(
            lobe(Vec3::new(-0.7, 0.6, 0.4), Vec3::new(40.0, 34.0, 26.0), 0.12),
            &[ground, sky],
        ),
        // Half a degree across: irradiance 7 at 1e5.
        "sun 1e5" => mixture(
            lobe(
                Vec3::new(0.6, 0.75, -0.15),
                Vec3::new(1.05e5, 1e5, 9e4),
                0.0033,
            ),
            &[ground, sky],
        ),
        _ => windows(),
    }
}

/// A room: two windows with sharp edges in a wall, a lamp, dim walls, a floor.
fn windows() -> (Truth, Vec3) {
    let (width, height) = (256, 128);
    let grid = EnvironmentMap::constant(width, height, Vec3::ZERO);
    let texels = (0..width * height).map(|k| {
        let (i, j) = (k / width, k % width);
        // Degrees from the left edge and from the top.
        let (phi, theta) = (
            360.0 * (j as f32 + 0.5) / width as f32,
            180.0 * (i as f32 + 0.5) / height as f32,
        );
        let inside = |a: f32, b: f32| (a..b).contains(&phi) && (42.0..56.0).contains(&theta);
        let wall = 0.12 + 0.05 * (phi.to_radians() * 3.0).sin();
        let lamp = grid
            .direction_of(i, j)
            .distance(Vec3::new(0.6, 0.7, 0.4).normalize())
            < 0.08;
        if inside(230.0, 242.0) {
            Vec3::new(38.0, 42.0, 49.0)
        } else if inside(262.0, 270.0) {
            Vec3::new(24.0, 26.0, 30.0)
        } else if lamp {
            Vec3::new(9.0, 7.0, 4.0)
        } else if theta > 110.0 {
            Vec3::new(0.15, 0.1, 0.06)
        } else {
            Vec3::new(1.0, 0.95, 0.9) * wall
        }
    });
    let map = EnvironmentMap::new(width, height, texels.collect()).expect("a map");
    // The middle of the brighter window.
    let middle = grid.direction_of(
        (49.0 / 180.0 * height as f32) as usize,
        (236.0 / 360.0 * width as f32) as usize,
    );
    (Truth::Map(EnvironmentSampler::new(map)), middle)
}

/// A photograph: a bright far end, a darker near one, texture.
fn background(width: u32, height: u32) -> LinearImage {
    let pixel = |k: u32| {
        let (x, y) = (k % width, k / width);
        let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
        let wave = (40.0 * u + 9.0 * v).sin() * (31.0 * v).cos();
        Vec3::new(0.42, 0.38, 0.33) * (1.0 - 0.5 * v) * (1.0 + 0.15 * wave) + 0.03 * u
    };
    LinearImage(Raster::from_pixels(
        width as usize,
        height as usize,
        (0..width * height).map(pixel).collect(),
    ))
}

/// A composite as it is displayed, path traced.
fn traced<L: SceneLight>(
    renderer: &Renderer,
    light: &L,
    tone: &ToneCurves,
    background: &LinearImage,
    (seed, target): (u64, f32),
) -> DisplayImage {
    let settings = RenderSettings {
        seed,
        stop: Stop::TargetError(target),
        background: Some(background),
        ..RenderSettings::default()
    };
    let film = renderer
        .render(light, &simulation(), &settings, &mut |_| {
            ControlFlow::Continue(())
        })
        .expect("renders")
        .film;
    let object = tone.apply_object(&LinearImage(film.object), &film.alpha);
    let shadow = tone.apply_shadow(&LinearImage(film.shadow));
    let picture = composite(background, &object, &film.alpha, &shadow).expect("one size");
    Transfer::Srgb.encode(&picture)
}

struct Row {
    degrees: f64,
    touched: f64,
    all: f64,
    iterations: usize,
    records: usize,
    seconds: [f64; 2],
    residual: f64,
    /// RMSE of the recorded picture against the reference.
    recorded: f64,
}

fn recover(object: &str, light: &str, knobs: &Knobs) -> Row {
    let resolution = [knobs.width, knobs.width * 2 / 3];
    let scene = scene(object, resolution);
    let renderer = Renderer::new(&scene);
    let background = background(resolution[0], resolution[1]);
    let (truth, peak) = truth(light);
    let reference = {
        let trace = (SEEDS[0], knobs.target);
        let tone = ToneCurves::identity();
        match &truth {
            Truth::Lobes(l) => traced(&renderer, l, &tone, &background, trace),
            Truth::Map(l) => traced(&renderer, l, &tone, &background, trace),
        }
    };
    let settings = knobs
        .table
        .settings(&standard_preset(), SEEDS[1])
        .expect("settings");
    let clock = Instant::now();
    let (outcome, mask, recorded_s) = optimize(&renderer, &background, &reference, &settings);
    let seconds = clock.elapsed().as_secs_f64();
    let lobes = SgMixture::new(outcome.lighting.exposed_lobes()).expect("lobes");
    let again = (SEEDS[2], knobs.target);
    let picture = traced(&renderer, &lobes, &outcome.tone, &background, again);
    if knobs.show {
        show(&outcome, peak);
    }
    let everything = Raster::filled(mask.width(), mask.height(), 1.0);
    Row {
        degrees: degrees_from(&outcome.lighting, peak),
        touched: rmse(&picture, &reference, &mask),
        all: rmse(&picture, &reference, &everything),
        iterations: outcome.history.len(),
        records: 1 + outcome.history.iter().filter(|r| r.recorded).count(),
        seconds: [recorded_s, seconds - recorded_s],
        residual: outcome.lighting.fusion_residual,
        recorded: rmse(&outcome.picture, &reference, &mask),
    }
}

/// Records and optimises; also says where the object or its shadow is, and the first record's
/// seconds.
fn optimize(
    renderer: &Renderer,
    background: &LinearImage,
    reference: &DisplayImage,
    settings: &Settings,
) -> (Outcome, Raster<f32>, f64) {
    let record = RecordSettings {
        environment: settings.environment,
        samples: settings.samples,
        shadow_samples: settings.samples,
        precision: settings.precision,
        seed: settings.seed,
        background: Some(background),
        ..RecordSettings::new(simulation())
    };
    let mut go_on = |_: f64| ControlFlow::Continue(());
    let clock = Instant::now();
    let transport = Transport::record(renderer, &record, &mut go_on).expect("records");
    let recorded_s = clock.elapsed().as_secs_f64();
    let objective = Objective::new(
        Box::new(transport),
        background.clone(),
        Transfer::Srgb,
        settings.weights(),
    )
    .expect("an objective");
    let mask = touched(&objective);
    let mut guidance =
        Reference::new(reference.clone(), &objective, Framing::Whole).expect("one size");
    let mut recorder = SceneRecorder {
        renderer,
        settings: record,
        progress: &mut go_on,
    };
    let optimization = Optimization {
        objective,
        guidance: &mut guidance,
        recorder: Some(&mut recorder),
        settings: settings.clone(),
        start: Parameters::neutral(settings.lobes, ambient_of(background)),
        checkpoint: None,
    };
    let outcome = optimization
        .run(&mut |_: Event| ControlFlow::Continue(()))
        .expect("optimises");
    (outcome, mask, recorded_s)
}

fn degrees_from(lighting: &Lighting, truth: Vec3) -> f64 {
    let found = lighting.peak_direction().unwrap_or(-truth);
    let half = 0.5 * f64::from(found.distance(truth.normalize()));
    (2.0 * half.min(1.0).asin()).to_degrees()
}

/// What is needed to see why a scene fails.
fn show(outcome: &Outcome, peak: Vec3) {
    let history = &outcome.history;
    for k in (0..history.len()).step_by((history.len() / 12).max(1)) {
        let r = &history[k];
        let v = |x: Option<f64>| x.unwrap_or(f64::NAN);
        println!(
            "  {:4} guidance {:.4} consistency {:.4} regularizer {:.4} recorded {}",
            r.iteration,
            v(r.guidance),
            v(r.consistency),
            v(r.regularizer),
            r.recorded
        );
    }
    let mut lobes = outcome.lighting.lobes.clone();
    lobes.sort_by(|a, b| b.radiance.y.total_cmp(&a.radiance.y));
    for g in lobes.iter().take(6) {
        let degrees = g
            .direction
            .dot(peak.normalize())
            .clamp(-1.0, 1.0)
            .acos()
            .to_degrees();
        println!(
            "  lobe {degrees:5.1} degrees from the truth, radiance {:.3}, sigma {:.4}, power {:.4}",
            g.radiance,
            g.sigma,
            g.integral().y
        );
    }
    println!("  tone {:?}", outcome.tone.foreground);
}

fn knobs(arguments: &[String], timing: bool) -> Knobs {
    let value = |key: &str| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        let last = pairs.rfind(|(k, _)| *k == key);
        last.map(|(_, v)| {
            v.parse::<f64>()
                .unwrap_or_else(|_| panic!("{key}={v} is no number"))
        })
    };
    let columns = value("columns").map(|c| [c as usize, c as usize / 2]);
    let mut table = LightTable {
        iterations: value("iterations").map(|v| v as usize),
        lobes: value("lobes").map(|v| v as usize),
        samples: value("samples").map(|v| v as u32),
        environment: columns,
        recover_tone: value("tone").map(|v| v != 0.0),
        consistency: value("consistency"),
        regularizer: value("regularizer"),
        preview_every: Some(0),
        ..LightTable::default()
    };
    table.fused_after = value("fused");
    let rates = &mut table.learning_rates;
    for (key, rate) in [
        ("radiance", &mut rates.radiance),
        ("direction", &mut rates.direction),
        ("sigma", &mut rates.sigma),
    ] {
        *rate = value(key).unwrap_or(*rate);
    }
    if !timing {
        table.iterations = Some(20);
        table.samples = Some(8);
        table.environment = Some([32, 16]);
    }
    Knobs {
        table,
        width: value("width").map_or(if timing { 192 } else { 36 }, |v| v as u32),
        target: if timing { CONVERGED } else { 0.02 },
        show: arguments.iter().any(|a| a == "show"),
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let timing = arguments.iter().any(|a| a == "--bench");
    let named: Vec<&String> = arguments.iter().filter(|a| a.contains('/')).collect();
    let knobs = knobs(&arguments, timing);
    println!(
        "| object | light | peak, degrees | RMSE touched | RMSE all | recorded RMSE | iterations | \
         records | record, s | optimise, s | lobes lose |"
    );
    println!("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|");
    for object in OBJECTS {
        for light in LIGHTS {
            let name = format!("{object}/{light}");
            let wanted = named.iter().any(|n| name.contains(n.trim_matches('/')));
            if !(wanted || named.is_empty()) || (!timing && name != "matte knot/soft sun") {
                continue;
            }
            let r = recover(object, light, &knobs);
            println!(
                "| {object} | {light} | {:.2} | {:.4} | {:.4} | {:.4} | {} | {} | {:.1} | {:.1} | {:.1}% |",
                r.degrees,
                r.touched,
                r.all,
                r.recorded,
                r.iterations,
                r.records,
                r.seconds[0],
                r.seconds[1],
                100.0 * r.residual
            );
        }
    }
}
