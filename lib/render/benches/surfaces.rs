//! How right shadows are on surfaces that are known by a depth map alone, and what they cost, as a table in Markdown.
//!
//! A room is drawn: floor, wall, a box and a post, 960 x 720 pixels. A block throws its shadow on all of them, under four suns.
//! The reference is the same room as a proxy mesh that keeps no light from itself. The error is the RMSE of the shadow ratio over
//! pixels without the block whose ratio is below .97 in either picture, both with 16 samples a pixel and denoised. The time is that
//! of a picture with an error of .004, over that of the picture without surfaces; medians of three.
//!
//! Run with `cargo test -p dipir-render --bench surfaces -- --bench`. Without `--bench`, as tests run it, a small picture under
//! one sun proves that it works.
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, PixelBox, resize};
use dipir_imaging::sharpness::blur;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_numerics::stats::median;
use dipir_render::adaptive::Stop;
use dipir_render::effects::EffectsPlan;
use dipir_render::render::{Rendered, Renderer, Settings, Simulation};
use dipir_render::shapes::{append, cuboid, quad};
use dipir_scene::bvh::Bvh;
use dipir_scene::camera::{Camera, FieldOfView};
use dipir_scene::foreground::{DepthSettings, Depths, Foreground};
use dipir_scene::material::Material;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use glam::{Vec2, Vec3};

/// Corners of what stands on the floor: wall, box, post.
const THINGS: [[Vec3; 2]; 3] = [
    [Vec3::new(-6.0, 0.0, -6.2), Vec3::new(6.0, 3.0, -6.0)],
    [Vec3::new(0.55, 0.0, -5.4), Vec3::new(1.7, 0.6, -4.3)],
    [Vec3::new(-1.35, 0.0, -5.2), Vec3::new(-1.25, 2.4, -5.1)],
];
const WALL: usize = 1;
const BOX: usize = 2;
/// Columns of the suns in a map of 128, which are 45 degrees apart.
const SUNS: [usize; 4] = [56, 72, 88, 104];

fn main() {
    let whole = std::env::args().any(|a| a == "--bench");
    let [width, height] = if whole { [960, 720] } else { [256, 192] };
    let (suns, samples, repeats) = match whole {
        true => (&SUNS[..], 16, 3),
        false => (&SUNS[..1], 4, 1),
    };
    let eye = Vec3::new(0.0, 1.6, 0.0);
    let ahead = Vec3::new(0.0, -(12f32.to_radians().tan()), -1.0);
    let view = FieldOfView::Vertical(45f32.to_radians());
    let camera = Camera::look_at(eye, eye + ahead, Vec3::Y, view, [width, height]);
    let (depths, seen) = drawn(&camera);
    let photo = photograph(&seen, width as usize);
    let block = cuboid(Vec3::new(-0.8, 0.0, -5.2), Vec3::new(-0.1, 1.1, -4.6));
    let scene = |proxy: Proxy| Scene {
        mesh: block.clone(),
        materials: vec![Material::default()],
        textures: Vec::new(),
        camera,
        proxy,
    };
    let (floor, room) = (scene(floor()), scene(Proxy::Mesh(room())));
    let folder = tempfile::tempdir().expect("a folder");
    let known =
        |map: &Raster<f32>, scale: Option<f32>| known(map, scale, folder.path(), &floor, &photo);
    let of_network = network(&depths);
    let maps = [
        ("true depths, their scale given", known(&depths, Some(1.0))),
        ("as a network gives them", known(&of_network, None)),
    ];
    println!("| depths | wall | box | whole picture | time |\n|---|--:|--:|--:|--:|");
    let lights: Vec<EnvironmentSampler> = suns.iter().map(|column| light(*column)).collect();
    let exact = Settings {
        stop: Stop::Samples(samples),
        denoise: true,
        ..Settings::default()
    };
    let references: Vec<Rendered> = lights.iter().map(|l| render(&room, l, &exact)).collect();
    let row = |name: &str, found: &Foreground, catches: bool| {
        let of_shadow = found.surfaces.as_ref().filter(|_| catches).map(|s| {
            let both = found.mask.pixels().iter().zip(s.share().pixels());
            let left = both.map(|(mask, share)| (mask - share).max(0.0)).collect();
            Raster::from_pixels(width as usize, height as usize, left)
        });
        let settings = Settings {
            seen_surfaces: found.surfaces.as_ref().filter(|_| catches),
            shadow_mask: of_shadow.as_ref(),
            ..Settings::of(&photo, Transfer::Srgb, Some(&found.mask))
        };
        let exact = Settings {
            stop: Stop::Samples(samples),
            denoise: true,
            ..settings
        };
        let mut sums = [[0.0; 2]; 3];
        for (light, reference) in lights.iter().zip(&references) {
            let rendered = render(&floor, light, &exact);
            for (i, what) in seen.iter().enumerate() {
                let [a, b] = [&rendered, reference].map(|r| r.film.shadow.pixels()[i].x);
                if reference.film.alpha.pixels()[i] > 0.01 || a.min(b) >= 0.97 {
                    continue;
                }
                let square = f64::from(a - b).powi(2);
                for (k, counts) in [*what == WALL, *what == BOX, true].into_iter().enumerate() {
                    sums[k][0] += if counts { square } else { 0.0 };
                    sums[k][1] += f64::from(u8::from(counts));
                }
            }
        }
        let errors = sums.map(|[squares, count]| (squares / count.max(1.0)).sqrt());
        assert!(errors.iter().all(|e| e.is_finite()), "{errors:?}");
        let timed = Settings {
            stop: Stop::TargetError(0.004),
            denoise: true,
            ..settings
        };
        let seconds = (0..repeats).map(|_| {
            let clock = Instant::now();
            render(&floor, &lights[lights.len() / 2], &timed);
            clock.elapsed().as_secs_f64()
        });
        let seconds = median(&seconds.collect::<Vec<_>>()).expect("some");
        (name.to_owned(), errors, seconds)
    };
    let mut rows: Vec<_> = maps
        .iter()
        .map(|(name, found)| row(name, found, true))
        .collect();
    rows.push(row("the same without surfaces", &maps[1].1, false));
    let without = rows[2].2;
    for (name, [wall, side, all], seconds) in rows {
        let time = seconds / without;
        println!("| {name} | {wall:.3} | {side:.3} | {all:.3} | {time:.2} |");
    }
}

fn floor() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

fn room() -> TriangleMesh {
    let mut room = quad(
        Vec3::new(-50.0, 0.0, 20.0),
        Vec3::X * 100.0,
        Vec3::NEG_Z * 120.0,
    );
    for [low, high] in THINGS {
        append(&mut room, cuboid(low, high), 0);
    }
    room
}

/// A bright sky over dimmer ground, with a sun 30 degrees high in four texels from `column` on.
fn light(column: usize) -> EnvironmentSampler {
    let (width, height) = (128, 64);
    let mut texels = vec![Vec3::splat(0.5); width * height];
    texels[width * height / 2..].fill(Vec3::splat(0.3));
    for row in [20, 21] {
        texels[row * width + column..][..2].fill(Vec3::splat(150.0));
    }
    EnvironmentSampler::new(EnvironmentMap::new(width, height, texels).expect("a valid map"))
}

/// Depths along the optical axis, infinite in the sky, and what is seen: 0 is the floor, things follow, then the sky.
fn drawn(camera: &Camera) -> (Raster<f32>, Vec<usize>) {
    let room = room();
    let bvh = Bvh::build(&room);
    let [width, height] = camera.resolution.map(|n| n as usize);
    let pixel = |i: usize| {
        let pixel = Vec2::new((i % width) as f32, (i / width) as f32) + 0.5;
        let ray = camera.ray(pixel);
        let Some(hit) = bvh.closest(&ray, f32::INFINITY, |_, _, _| true) else {
            return (f32::INFINITY, THINGS.len() + 1);
        };
        let ahead = -ray.direction.dot(camera.rotation.z_axis);
        // Two triangles of the floor, then twelve of each thing.
        let what = (hit.triangle as usize + 10) / 12;
        (hit.t * ahead, what)
    };
    let (depths, seen): (Vec<f32>, Vec<usize>) = (0..width * height).map(pixel).unzip();
    (Raster::from_pixels(width, height, depths), seen)
}

/// Each thing in a colour of its own.
fn photograph(seen: &[usize], width: usize) -> LinearImage {
    let colours = [
        [0.17, 0.15, 0.12],
        [0.07, 0.11, 0.05],
        [0.21, 0.07, 0.04],
        [0.26, 0.26, 0.32],
        [0.32, 0.48, 0.79],
    ];
    let pixels = seen.iter().map(|what| Vec3::from(colours[*what])).collect();
    LinearImage(Raster::from_pixels(width, seen.len() / width, pixels))
}

/// Disparities of 518 texels for 960 pixels, blurred, in waves of 1%, in 256 steps.
fn network(depths: &Raster<f32>) -> Raster<f32> {
    let size = [depths.width(), depths.height()].map(|n| n * 518 / 960);
    let [width, height] = size;
    let mut map = resize(&depths.map(|d| d.recip()), width, height, Filter::Area);
    for (i, value) in map.pixels_mut().iter_mut().enumerate() {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        *value *= 1.0 + 0.01 * (x / 31.0).sin() * (y / 23.0).cos();
    }
    let whole = PixelBox {
        x: 0,
        y: 0,
        width,
        height,
    };
    blur(&mut map, None, whole, 0.7);
    let most = map.pixels().iter().fold(0f32, |m, v| m.max(*v));
    map.map(|v| (255.0 * v / most).round() / 255.0)
}

/// What is known by a depth map.
fn known(
    map: &Raster<f32>,
    scale: Option<f32>,
    folder: &Path,
    scene: &Scene,
    photo: &LinearImage,
) -> Foreground {
    let mut layers = Layers::new(map.width(), map.height());
    layers
        .insert("Z", Precision::Full, map.clone())
        .expect("one layer");
    layers.write_exr(folder.join("depth.exr")).expect("a file");
    let settings = DepthSettings {
        path: "depth.exr".into(),
        measure: None,
        scale,
        catches: true,
    };
    let depths = Depths::read(&settings, folder, scene.camera.resolution, None);
    let depths = depths.expect("a map of depths");
    let found = depths.foreground(Some(&scene.mesh), &scene.proxy, &scene.camera, photo);
    let found = found.expect("depths that agree with the floor");
    assert!(found.surfaces.is_some(), "a map that is fine enough");
    found
}

fn render(scene: &Scene, light: &EnvironmentSampler, settings: &Settings) -> Rendered {
    let simulation = Simulation {
        proxy_occlusion: false,
        ..EffectsPlan::everything(scene, settings).simulation()
    };
    let go_on = &mut |_: &_| ControlFlow::Continue(());
    Renderer::new(scene)
        .render(light, &simulation, settings, go_on)
        .expect("renders")
}
