//! A small project on disk.
use std::fs;
use std::path::Path;

use dipir_cli::session::Session;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;

#[path = "../../../preview/tests/opened/mod.rs"]
mod opened;
pub use opened::open;

/// A box of a metre on a grey photograph, seen from the height of the eyes, under neutral light.
pub const TEXT: &str = "# The street.\n[scene]\nbackground = \"photo.png\" # mine\n\n\
    [[scene.objects]]\npath = \"box.obj\"\nat_pixel = [150.0, 150.0] # at the kerb\n\n\
    [scene.camera]\nposition = [0.0, 1.6, 0.0]\npitch_deg = -10.0 # guessed\nfov_deg = 50.0\n\n\
    [scene.proxy]\nplane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }\n\n\
    [light]\nstart = \"neutral\"\n";

const BOX: &str = "v -.5 0 -.5\nv .5 0 -.5\nv .5 1 -.5\nv -.5 1 -.5\nv -.5 0 .5\nv .5 0 .5\nv .5 1 .5\nv -.5 1 .5\n\
    f 1 4 3 2\nf 5 6 7 8\nf 1 5 8 4\nf 2 3 7 6\nf 4 8 7 3\nf 1 2 6 5\n";

/// The project of [`TEXT`] with some keys changed, as `KEY=VALUE`.
pub fn project(folder: &Path, set: &[&str]) -> Session {
    let grey = Raster::filled(300, 200, Vec3::splat(0.5));
    write_png(folder.join("photo.png"), &DisplayImage(grey)).unwrap();
    fs::write(folder.join("box.obj"), BOX).unwrap();
    fs::write(folder.join("pipeline.toml"), TEXT).unwrap();
    open(folder, set)
}
