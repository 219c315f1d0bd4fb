//! Makes everything in `data/demo`: the car, the photograph of a square, and the light of that square.
mod camera;
mod car;
mod glb;
mod mesher;
mod noise;
mod seams;
mod simplify;
mod sky;
mod solids;
mod square;

use std::path::Path;

use dipir_imaging::file::write_png;
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::transfer::Transfer;
use glam::{Mat3, Vec3};
use sky::Sky;
use square::Square;

/// The demo's camera; `pipeline.toml` says the same.
const POSITION: Vec3 = Vec3::new(0.0, 1.45, 7.4);
const LOOK_AT: Vec3 = Vec3::new(0.0, 0.72, 0.0);
const FOV_DEG: f32 = 36.0;
const SIZE: [u32; 2] = [960, 640];

/// Where the light is captured: in the middle of where the car will stand.
const PROBE: Vec3 = Vec3::new(0.0, 0.7, 0.0);

/// Writes `car.glb`, `background.png` and `environment.exr` into `folder`, traced with `samples` paths a
/// pixel. `report` gets each file's name once it is written.
///
/// # Errors
/// If a file cannot be written.
pub fn make(folder: &Path, samples: u32, report: &mut dyn FnMut(&str)) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)?;
    let car = glb::encode(&car::body(0.015), &car::wheel(0.009), [0.62, 0.06, 0.02]);
    std::fs::write(folder.join("car.glb"), &car)?;
    report("car.glb");

    let textures = tempfile::tempdir()?;
    let square = Square::new(textures.path())?;
    let sky = Sky::default();
    let backward = (POSITION - LOOK_AT).normalize();
    let right = Vec3::Y.cross(backward).normalize();
    let rotation = Mat3::from_cols(right, backward.cross(right), backward);
    let camera = camera::camera(POSITION, rotation, FOV_DEG, SIZE);
    let photograph = camera::photograph(&square, &sky, camera, samples)?;
    write_png(
        folder.join("background.png"),
        &Transfer::Srgb.encode(&photograph),
    )?;
    report("background.png");
    let light = camera::panorama(&square, &sky, PROBE, 512, samples.div_ceil(4))?;
    // Half precision: the noise of a rendered map is above its rounding.
    let mut layers = Layers::new(light.width(), light.height());
    layers.latlong = true;
    layers.insert_rgb("", Precision::Half, &light.to_image().0)?;
    layers.write_exr(folder.join("environment.exr"))?;
    report("environment.exr");
    Ok(())
}
