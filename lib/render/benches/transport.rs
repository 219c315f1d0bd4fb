//! Recorded light transport: error of picture and gradient, bytes and milliseconds, against
//! samples per pixel, size of the environment and precision of the weights, and against the time
//! that memory needs to deliver the bytes.
//!
//! Run with `cargo bench -p dipir-render --bench transport [-- FILE.csv]`: a table on the terminal,
//! the same numbers in `FILE.csv`. Errors of pictures come from a small picture of the scene,
//! against a record with many more samples and texels and other random numbers. Times, bytes and
//! the gradient's noise come from 384 x 256 pixels; the noise is half the squared difference of
//! two records, so it lacks what a coarse map leaves out. Without `--bench`, as tests run it, one
//! small row proves that it works.
//!
//! `export DIR` and `iteration` serve `benches/iteration.py`, which times an iteration of Mitsuba 3
//! beside ours.
use std::fmt::Write as _;
use std::io::Write as _;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::rasterize::rasterize;
use dipir_render::features::{SPECULAR, TEXTURES};
use dipir_render::render::{Renderer, Simulation};
use dipir_render::shapes::torus_knot;
use dipir_render::transport::{Precision, RecordSettings, Transport};
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::material::Material;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Columns and rows of the picture that is timed, and of the one whose error is measured.
const TIMED: [u32; 2] = [384, 256];
const JUDGED: [u32; 2] = [72, 48];
/// Columns and rows of the environment, unless swept.
const ENVIRONMENT: [usize; 2] = [128, 64];
/// The reference's.
const FINE: [usize; 2] = [512, 256];
/// The reference's samples per pixel: 16 times the most that is judged.
const CONVERGED: u32 = 8192;

fn scene(resolution: [u32; 2]) -> Scene {
    Scene {
        mesh: torus_knot(Vec3::Y * 0.75, 0.45, 0.17, 512, 32),
        materials: vec![Material {
            base_color: Vec3::new(0.8, 0.4, 0.2).extend(1.0),
            roughness: 0.35,
            metallic: 0.5,
            ..Material::default()
        }],
        textures: Vec::new(),
        camera: Camera::look_at(
            Vec3::new(0.0, 2.0, 4.0),
            Vec3::Y * 0.5,
            Vec3::Y,
            FieldOfView::Vertical(0.7),
            resolution,
        ),
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    }
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

/// A blue sky and a low sun of 2 degrees that gives most of the light.
fn light([width, height]: [usize; 2]) -> EnvironmentMap {
    let lobe = |direction: Vec3, radiance, sigma| SphericalGaussian {
        direction: direction.normalize(),
        radiance,
        sigma,
    };
    let lobes = [
        lobe(Vec3::Y, Vec3::new(0.4, 0.6, 1.0), 0.8),
        lobe(
            Vec3::new(0.6, 0.7, 0.4),
            Vec3::new(900.0, 800.0, 600.0),
            0.035,
        ),
        lobe(Vec3::NEG_Y, Vec3::splat(0.1), 10.0),
    ];
    rasterize(&lobes, width, height)
}

struct Row {
    samples: u32,
    environment: [usize; 2],
    precision: Precision,
    /// Whether the light was in the mixture.
    foreseen: bool,
}

/// What one row of the table says.
struct Outcome {
    record_s: f64,
    entries: (usize, usize),
    bytes: (usize, usize),
    /// Object forward, object adjoint, shadow forward, shadow adjoint.
    milliseconds: [f64; 4],
    /// Relative error of object and shadow; of the gradient of texels, and of 16 x 8 regions.
    errors: [f64; 4],
}

fn record(scene: &Scene, row: &Row, seed: u64) -> Transport {
    record_with(scene, row, seed, simulation())
}

fn record_with(scene: &Scene, row: &Row, seed: u64, simulation: Simulation) -> Transport {
    let light = light(row.environment);
    let settings = RecordSettings {
        environment: row.environment,
        samples: row.samples,
        shadow_samples: row.samples,
        precision: row.precision,
        seed,
        light: row.foreseen.then_some(&light),
        ..RecordSettings::new(simulation)
    };
    Transport::record(&Renderer::new(scene), &settings, &mut |_| {
        ControlFlow::Continue(())
    })
    .expect("records")
}

/// Pictures and the gradient of a fixed loss over both.
struct Judged {
    object: Raster<Vec3>,
    shadow: Raster<Vec3>,
    gradient: Vec<Vec3>,
}

/// The loss is linear in the picture and has all signs: `sum (object - 0.2 + shadow) . pattern`.
fn pattern(p: usize) -> Vec3 {
    let wave = |k: f32| (p as f32 * 0.017 * k).sin();
    Vec3::new(wave(1.0), wave(1.3), wave(0.7)) + 0.5
}

fn judge(transport: &Transport) -> Judged {
    let [width, height] = transport.size();
    let y: Vec<Vec3> = (0..width * height).map(pattern).collect();
    judge_with(transport, &light(transport.environment_size()), &y)
}

fn judge_with(transport: &Transport, light: &EnvironmentMap, y: &[Vec3]) -> Judged {
    let object = transport.foreground(light.texels());
    let shadow = transport.shadow(light.texels());
    let mut gradient = transport.foreground_vjp(y);
    let others = transport.shadow_vjp(light.texels(), &shadow, y);
    gradient.iter_mut().zip(others).for_each(|(g, o)| *g += o);
    Judged {
        object,
        shadow,
        gradient,
    }
}

/// Root of the squared differences over the squares.
fn relative_error(found: &[Vec3], expected: &[Vec3]) -> f64 {
    let sum = |terms: &mut dyn Iterator<Item = Vec3>| -> f64 {
        terms.map(|t| t.as_dvec3().length_squared()).sum()
    };
    let differences = sum(&mut found.iter().zip(expected).map(|(a, b)| *a - *b));
    (differences / sum(&mut expected.iter().copied())).sqrt()
}

/// The gradient with respect to coarser texels, each the sum over the fine ones in it.
fn coarser(fine: &[Vec3], from: [usize; 2], to: [usize; 2]) -> Vec<Vec3> {
    let mut sums = vec![DVec3::ZERO; to[0] * to[1]];
    for (t, g) in fine.iter().enumerate() {
        let (i, j) = (t / from[0] * to[1] / from[1], t % from[0] * to[0] / from[0]);
        sums[i * to[0] + j] += g.as_dvec3();
    }
    sums.into_iter().map(|s| s.as_vec3()).collect()
}

/// Median of eleven, milliseconds.
fn time<T>(mut f: impl FnMut() -> T) -> f64 {
    let mut times: Vec<f64> = (0..11)
        .map(|_| {
            let start = Instant::now();
            std::hint::black_box(f());
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[5]
}

/// Bytes per millisecond that all threads together read from memory.
fn bandwidth() -> f64 {
    let block = vec![1u64; 1 << 25];
    let sum = || -> u64 {
        block
            .par_chunks(1 << 18)
            .map(|c| c.iter().fold(0u64, |s, x| s.wrapping_add(*x)))
            .sum()
    };
    size_of_val(&block[..]) as f64 / time(sum)
}

fn measure(row: &Row, timed: [u32; 2], reference: &Judged) -> Outcome {
    let found = judge(&record(&scene(JUDGED), row, 1));
    let scene = scene(timed);
    let start = Instant::now();
    let transport = record(&scene, row, 1);
    let record_s = start.elapsed().as_secs_f64();
    let one = judge(&transport).gradient;
    let other = judge(&record(&scene, row, 3)).gradient;
    let noise = |a: &[Vec3], b: &[Vec3]| relative_error(a, b) / 2f64.sqrt();
    let regions = |gradient: &[Vec3]| coarser(gradient, row.environment, [16, 8]);
    let errors = [
        relative_error(found.object.pixels(), reference.object.pixels()),
        relative_error(found.shadow.pixels(), reference.shadow.pixels()),
        noise(&one, &other),
        noise(&regions(&one), &regions(&other)),
    ];
    let light = light(row.environment);
    let shadow = transport.shadow(light.texels());
    let y: Vec<Vec3> = (0..shadow.pixels().len()).map(pattern).collect();
    let milliseconds = [
        time(|| transport.foreground(light.texels())),
        time(|| transport.foreground_vjp(&y)),
        time(|| transport.shadow(light.texels())),
        time(|| transport.shadow_vjp(light.texels(), &shadow, &y)),
    ];
    Outcome {
        record_s,
        entries: transport.entries(),
        bytes: transport.bytes(),
        milliseconds,
        errors,
    }
}

/// The scene of `iteration.py`: the same, but diffuse, which both renderers agree about.
fn diffuse_scene() -> Scene {
    let mut scene = scene(TIMED);
    scene.materials[0].metallic = 0.0;
    scene.materials[0].roughness = 1.0;
    scene
}

/// Writes the mesh and the light for the other renderer.
fn export(folder: &Path) -> std::io::Result<()> {
    let mesh = diffuse_scene().mesh;
    let mut out = std::io::BufWriter::new(std::fs::File::create(folder.join("mesh.obj"))?);
    for p in &mesh.positions {
        writeln!(out, "v {} {} {}", p.x, p.y, p.z)?;
    }
    for n in &mesh.normals {
        writeln!(out, "vn {} {} {}", n.x, n.y, n.z)?;
    }
    for [a, b, c] in mesh.indices {
        let [a, b, c] = [a + 1, b + 1, c + 1];
        writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
    }
    out.flush()?;
    light(ENVIRONMENT)
        .write(folder.join("light.exr"))
        .map_err(std::io::Error::other)
}

/// Prints as JSON what an iteration on the diffuse scene costs and how noisy its gradient is.
fn iteration(samples: u32) {
    let row = Row {
        samples,
        environment: ENVIRONMENT,
        precision: Precision::Half,
        foreseen: true,
    };
    let simulation = Simulation {
        features: 0,
        ..simulation()
    };
    let scene = diffuse_scene();
    let start = Instant::now();
    let transport = record_with(&scene, &row, 1, simulation);
    let record_s = start.elapsed().as_secs_f64();
    let one = judge(&transport).gradient;
    let other = judge(&record_with(&scene, &row, 3, simulation)).gradient;
    let noise = |a: &[Vec3], b: &[Vec3]| relative_error(a, b) / 2f64.sqrt();
    let regions = |gradient: &[Vec3]| coarser(gradient, ENVIRONMENT, [16, 8]);
    let light = light(ENVIRONMENT);
    let y: Vec<Vec3> = (0..transport.size().iter().product())
        .map(pattern)
        .collect();
    let milliseconds = time(|| judge_with(&transport, &light, &y));
    println!(
        "{{\"record_s\": {record_s:.3}, \"iteration_ms\": {milliseconds:.3}, \"bytes\": {}, \
         \"texel_noise\": {:e}, \"region_noise\": {:e}}}",
        transport.bytes().0 + transport.bytes().1,
        noise(&one, &other),
        noise(&regions(&one), &regions(&other)),
    );
}

fn rows() -> Vec<Row> {
    let row = |samples, environment, precision, foreseen| Row {
        samples,
        environment,
        precision,
        foreseen,
    };
    let mut rows = Vec::new();
    for foreseen in [true, false] {
        for samples in [8, 32, 128, 512] {
            rows.push(row(samples, ENVIRONMENT, Precision::Half, foreseen));
        }
    }
    for environment in [[32, 16], [64, 32], [256, 128]] {
        rows.push(row(128, environment, Precision::Half, true));
    }
    rows.push(row(128, ENVIRONMENT, Precision::Single, true));
    rows
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments
        .iter()
        .map(String::as_str)
        .filter(|a| *a != "--bench")
        .collect();
    match words.as_slice() {
        ["export", folder] => return export(Path::new(folder)).expect("a writable folder"),
        ["iteration", samples] => return iteration(samples.parse().expect("samples per pixel")),
        _ => (),
    }
    let timing = arguments.iter().any(|a| a == "--bench");
    let file = arguments.iter().find(|a| a.ends_with(".csv"));
    let (converged, fine, timed) = match timing {
        true => (CONVERGED, FINE, TIMED),
        false => (64, ENVIRONMENT, JUDGED),
    };
    let reference = Row {
        samples: converged,
        environment: fine,
        precision: Precision::Single,
        foreseen: true,
    };
    let reference = judge(&record(&scene(JUDGED), &reference, 2));
    let rate = bandwidth();
    println!(
        "memory: {:.1} GB/s on {} threads",
        rate * 1e-6,
        rayon::current_num_threads()
    );
    let mut csv = String::from(
        "samples,columns,rows,precision,light_in_mixture,record_s,object_entries,shadow_entries,\
         object_bytes,shadow_bytes,object_ms,object_vjp_ms,shadow_ms,shadow_vjp_ms,total_ms,\
         floor_ms,object_error,shadow_error,texel_gradient_error,\
         region_gradient_error\n",
    );
    println!("{}", csv.trim().replace(',', " "));
    let rows = rows();
    let rows = if timing { &rows[..] } else { &rows[..1] };
    for row in rows {
        let o = measure(row, timed, &reference);
        // Forward and adjoint read all weights once each.
        let floor = 2.0 * (o.bytes.0 + o.bytes.1) as f64 / rate;
        let [a, b, c, d] = o.milliseconds;
        let mut line = format!(
            "{},{},{},{:?},{},{:.3},{},{},{},{},{a:.3},{b:.3},{c:.3},{d:.3},{:.3},{floor:.3}",
            row.samples,
            row.environment[0],
            row.environment[1],
            row.precision,
            row.foreseen,
            o.record_s,
            o.entries.0,
            o.entries.1,
            o.bytes.0,
            o.bytes.1,
            a + b + c + d,
        );
        for error in o.errors {
            let _ = write!(line, ",{error:.2e}");
        }
        println!("{}", line.replace(',', " "));
        csv.push_str(&line);
        csv.push('\n');
    }
    if let Some(path) = file {
        std::fs::write(path, csv).expect("the table can be written");
    }
}
