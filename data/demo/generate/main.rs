//! Makes everything in `data/demo`: the car, the place, the photograph and the light.
//!
//! `cargo run --release --example make-demo [-- FOLDER [SAMPLES]]`
mod camera;
mod car;
mod glb;
mod mesher;
mod noise;
mod place;
mod seams;
mod simplify;
mod sky;
mod solids;

use std::path::PathBuf;

use dipir_imaging::file::write_png;
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::transfer::Transfer;
use glam::{Mat3, Vec3};
use place::Place;
use sky::Sky;

/// The demo's camera; `pipeline.toml` says the same.
const POSITION: Vec3 = Vec3::new(0.0, 1.45, 7.4);
const LOOK_AT: Vec3 = Vec3::new(0.0, 0.72, 0.0);
const FOV_DEG: f32 = 36.0;
const SIZE: [u32; 2] = [960, 640];

/// Where the light is captured: in the middle of where the car will stand.
const PROBE: Vec3 = Vec3::new(0.0, 0.7, 0.0);

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let folder = PathBuf::from(args.next().unwrap_or_else(|| "data/demo".into()));
    let samples: u32 = args.next().map_or(Ok(256), |s| s.parse())?;
    std::fs::create_dir_all(&folder)?;

    let car = glb::encode(&car::body(0.015), &car::wheel(0.009), [0.62, 0.06, 0.02]);
    std::fs::write(folder.join("car.glb"), &car)?;
    println!("car.glb: {} bytes", car.len());

    let textures = tempfile::tempdir()?;
    let place = Place::new(textures.path())?;
    println!("the place: {} triangles", place.mesh.indices.len());
    let sky = Sky::default();
    let backward = (POSITION - LOOK_AT).normalize();
    let right = Vec3::Y.cross(backward).normalize();
    let rotation = Mat3::from_cols(right, backward.cross(right), backward);
    let camera = camera::camera(POSITION, rotation, FOV_DEG, SIZE);
    let photograph = camera::photograph(&place, &sky, camera, samples)?;
    write_png(
        folder.join("background.png"),
        &Transfer::Srgb.encode(&photograph),
    )?;
    println!("background.png");
    let light = camera::panorama(&place, &sky, PROBE, 512, samples.div_ceil(4))?;
    // Half precision: the noise of a rendered map is above its rounding.
    let mut layers = Layers::new(light.width(), light.height());
    layers.latlong = true;
    layers.insert_rgb("", Precision::Half, &light.to_image().0)?;
    layers.write_exr(folder.join("environment.exr"))?;
    println!("environment.exr");
    Ok(())
}
