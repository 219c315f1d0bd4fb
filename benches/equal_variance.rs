//! Time times variance of an insertion at 512 x 512 under a sunny sky, for `equal_variance.py`,
//! which runs the same scene through Mitsuba 3.
//!
//! `export DIR` writes the scene's mesh, sky and texture for the other renderer; `render STOP SEEDS
//! MATERIAL DENOISE` prints one line of JSON: seconds of each render, by the clock and of all cores together,
//! mean and mean variance of the two layers; STOP is a number of samples per pixel or, as `error=.004`, an error; DENOISE is
//! `true` or `false`. Without arguments (plain `cargo bench`) it renders a few seeds.
use std::f32::consts::PI;
use std::io::Write;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use dipir_light::environment::{EnvironmentMap, EnvironmentSampler, direction_at};

use dipir_numerics::stats::median;
use dipir_render::adaptive::{Progress, Stop};
use dipir_render::bsdf::features::{SPECULAR, TEXTURES, TRANSMISSION};
use dipir_render::film::Film;
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_render::shapes;
use dipir_scene::camera::Camera;
use dipir_scene::material::{Material, TextureRef, Transmission};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use dipir_scene::texture::{Encoding, Filter, ImageSource, Texture, Wrap};
use glam::{Mat3, Vec2, Vec3, Vec4};

const SIZE: u32 = 512;
const FOV_DEG: f32 = 32.0;
const POSITION: Vec3 = Vec3::new(2.6, 2.0, 3.8);
const TARGET: Vec3 = Vec3::new(0.0, 0.6, 0.0);

/// Vertices of the trefoil along the knot and around its tube.
const GRID: [u32; 2] = [1000, 48];

/// A trefoil of 96,000 triangles that stands on the plane: concave, self-shadowing.
fn mesh() -> TriangleMesh {
    let [along, around] = GRID;
    let mut mesh = shapes::torus_knot(Vec3::ZERO, 0.4, 0.13, along, around);
    let lowest = mesh.positions.iter().fold(f32::INFINITY, |m, p| m.min(p.y));
    mesh.positions.iter_mut().for_each(|p| p.y -= lowest);
    mesh.materials = vec![0; mesh.indices.len()];
    let uv = |i: u32| {
        Vec2::new(
            12.0 * (i / around) as f32 / along as f32,
            (i % around) as f32 / around as f32,
        )
    };
    mesh.uvs[0] = (0..along * around).map(uv).collect();
    mesh
}

/// A PNG of 8 x 8 squares in two colours.
fn squares() -> Vec<u8> {
    let colours = [image::Rgb([230, 188, 124]), image::Rgb([60, 90, 160])];
    let picture =
        image::RgbImage::from_fn(256, 256, |x, y| colours[((x / 32 + y / 32) % 2) as usize]);
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .expect("a PNG");
    bytes.into_inner()
}

/// A blue sky over a brown ground, with a sun of half a degree at 6e4.
fn sky() -> EnvironmentMap {
    let (width, height) = (1024, 512);
    let sun = Vec3::new(0.55, 0.6, 0.35).normalize();
    let cos_radius = (0.265 * PI / 180.0).cos();
    let texels = (0..width * height)
        .map(|t| {
            let u = (t % width) as f32 + 0.5;
            let v = (t / width) as f32 + 0.5;
            let d = direction_at(u / width as f32, v / height as f32);
            if d.dot(sun) > cos_radius {
                return Vec3::new(6.0e4, 5.6e4, 5.0e4);
            }
            match d.y > 0.0 {
                true => Vec3::new(0.35, 0.55, 0.9) * (0.6 + 0.4 * d.y),
                false => Vec3::new(0.22, 0.19, 0.15),
            }
        })
        .collect();
    EnvironmentMap::new(width, height, texels).expect("a valid map")
}

/// The material of that name, and the features that it needs.
fn material(name: &str) -> (Material, u32) {
    let matte = Material {
        base_color: Vec4::new(0.8, 0.5, 0.2, 1.0),
        metallic: 0.0,
        ..Default::default()
    };
    let texture = TextureRef {
        texture: 0,
        uv_set: 0,
        transform: Mat3::IDENTITY,
    };
    match name {
        "diffuse" => (matte, 0),
        "metal" => (
            Material {
                metallic: 1.0,
                roughness: 0.3,
                ..matte
            },
            SPECULAR,
        ),
        "glossy" => (
            Material {
                roughness: 0.3,
                ..matte
            },
            SPECULAR,
        ),
        "glass" => (
            Material {
                base_color: Vec4::ONE,
                roughness: 0.0,
                double_sided: true,
                transmission: Some(Transmission {
                    factor: 1.0,
                    texture: None,
                }),
                ..matte
            },
            SPECULAR | TRANSMISSION,
        ),
        "textured" => (
            Material {
                base_color: Vec4::ONE,
                base_color_texture: Some(texture),
                ..matte
            },
            TEXTURES,
        ),
        _ => panic!("{name}: accepted: diffuse, metal, glossy, glass, textured"),
    }
}

fn scene(material: Material) -> Scene {
    let backward = (POSITION - TARGET).normalize();
    let right = Vec3::Y.cross(backward).normalize();
    Scene {
        mesh: mesh(),
        materials: vec![material],
        textures: vec![Texture {
            image: ImageSource::Bytes {
                name: "squares".into(),
                bytes: squares().into(),
            },
            encoding: Encoding::Srgb,
            wrap: [Wrap::Repeat; 2],
            filter: Filter::Linear,
        }],
        camera: Camera {
            position: POSITION,
            rotation: Mat3::from_cols(right, backward.cross(right), backward),
            focal_px: Vec2::splat(0.5 * SIZE as f32 / (0.5 * FOV_DEG).to_radians().tan()),
            principal_px: Vec2::splat(0.5 * SIZE as f32),
            resolution: [SIZE, SIZE],
        },
        proxy: Proxy::Plane(Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        }),
    }
}

fn export(folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let mesh = mesh();
    let mut out = std::io::BufWriter::new(std::fs::File::create(folder.join("mesh.obj"))?);
    for p in &mesh.positions {
        writeln!(out, "v {} {} {}", p.x, p.y, p.z)?;
    }
    for uv in &mesh.uvs[0] {
        // Texture coordinates of OBJ point up, those of the scene down.
        writeln!(out, "vt {} {}", uv.x, 1.0 - uv.y)?;
    }
    for n in &mesh.normals {
        writeln!(out, "vn {} {} {}", n.x, n.y, n.z)?;
    }
    for [a, b, c] in mesh.indices {
        let [a, b, c] = [a + 1, b + 1, c + 1];
        writeln!(out, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}")?;
    }
    out.flush()?;
    std::fs::write(folder.join("squares.png"), squares())?;
    sky()
        .write(folder.join("sky.exr"))
        .map_err(std::io::Error::other)
}

/// Mean over pixels and channels of the variance over renders, of display-clamped values.
fn variance(films: &[Film], layer: impl Fn(&Film, usize) -> Vec3) -> f64 {
    let pixels = (SIZE * SIZE) as usize;
    let n = films.len() as f64;
    let of_pixel = |p: usize| {
        let values: Vec<_> = films
            .iter()
            .map(|f| layer(f, p).clamp(Vec3::ZERO, Vec3::ONE).as_dvec3())
            .collect();
        let mean = values.iter().sum::<glam::DVec3>() / n;
        let m2: f64 = values.iter().map(|v| (*v - mean).length_squared()).sum();
        m2 / (n - 1.0) / 3.0
    };
    (0..pixels).map(of_pixel).sum::<f64>() / pixels as f64
}

/// Processor time of this process so far, of all threads, in seconds; other load on the machine
/// hardly shows in it. Linux only.
fn cpu_time() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Fields 14 and 15, user and system time in hundredths; field 2 is the name in parentheses.
    let fields = text.rsplit(')').next().unwrap_or("").split_whitespace();
    let ticks = fields
        .skip(11)
        .take(2)
        .map(|f| f.parse().unwrap_or(f64::NAN));
    ticks.sum::<f64>() / 100.0
}

fn render(stop: Stop, seeds: u64, name: &str, denoise: bool) {
    let (material, features) = material(name);
    let scene = scene(material);
    let renderer = Renderer::new(&scene);
    let light = EnvironmentSampler::new(Arc::new(sky()));
    let simulation = Simulation {
        features,
        max_depth: 4,
        shadow: true,
        proxy_occlusion: false,
        light_on_proxy: None,
    };
    let (mut films, mut seconds, mut cpu_seconds) = (Vec::new(), Vec::new(), Vec::new());
    for seed in 0..seeds {
        let settings = Settings {
            seed,
            stop,
            denoise,
            ..Default::default()
        };
        let (start, cpu_start) = (Instant::now(), cpu_time());
        let mut go_on = |_: &Progress| ControlFlow::Continue(());
        let rendered = renderer
            .render(&light, &simulation, &settings, &mut go_on)
            .expect("a valid scene renders");
        seconds.push(start.elapsed().as_secs_f64());
        cpu_seconds.push(cpu_time() - cpu_start);
        films.push(rendered.film);
    }
    let mean = |layer: &dyn Fn(&Film, usize) -> Vec3| {
        let values = films
            .iter()
            .flat_map(|f| (0..f.alpha.pixels().len()).map(move |p| (f, p)));
        let sum: f64 = values
            .map(|(f, p)| f64::from(layer(f, p).clamp(Vec3::ZERO, Vec3::ONE).element_sum()))
            .sum();
        sum / (3 * films.len()) as f64 / f64::from(SIZE * SIZE)
    };
    println!(
        "{{\"seconds\": {:.4}, \"cpu_seconds\": {:.4}, \"mean_foreground\": {:e}, \"mean_shadow\": {:e}, \"foreground\": {:e}, \"shadow\": {:e}}}",
        median(&seconds).unwrap_or(f64::NAN),
        cpu_seconds.iter().sum::<f64>() / seeds as f64,
        mean(&|f, p| f.object.pixels()[p]),
        mean(&|f, p| f.shadow.pixels()[p] * (1.0 - f.alpha.pixels()[p])),
        variance(&films, |f, p| f.object.pixels()[p]),
        variance(&films, |f, p| f.shadow.pixels()[p]
            * (1.0 - f.alpha.pixels()[p])),
    );
}

/// "16": samples per pixel; "error=.01": as many as that error takes, where they are needed.
fn stop(word: &str) -> Stop {
    match word.strip_prefix("error=") {
        Some(error) => Stop::TargetError(error.parse().expect("an error")),
        None => Stop::Samples(word.parse().expect("samples per pixel")),
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words.as_slice() {
        [] => render(Stop::Samples(16), 4, "diffuse", false),
        ["export", folder] => export(Path::new(folder)).expect("a writable folder"),
        ["render", until, seeds, material, denoise] => render(
            stop(until),
            seeds.parse().expect("number of seeds, at least 2"),
            material,
            denoise.parse().expect("true or false"),
        ),
        _ => eprintln!("usage: [export DIR | render STOP SEEDS MATERIAL DENOISE]"),
    }
}
