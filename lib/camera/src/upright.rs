//! Which axis of a file's world is up in its pictures.
use std::path::Path;

use glam::{DMat3, DVec3};

use crate::camera::WorldUp;
use crate::colmap;
use crate::file::pictures;

/// Fewest pictures whose mean is believed.
const FEWEST: usize = 5;
/// Least length of the mean of what is up in the pictures, unit vectors: of pictures that are turned each in its own way it
/// is short.
const LEAST_MEAN: f64 = 0.5;
/// Largest cosine of the mean to an axis that is doubted: 60 degrees, beyond which no hand tilts a camera.
const DOUBTED: f64 = 0.5;
/// Least cosine of the mean to an axis that is meant: 30 degrees.
const MEANT: f64 = 0.866;

/// A warning if the pictures of the file at `path` are upright by another axis than the one that points up where nobody
/// says which, of files whose programs differ in that: `transforms.json` and COLMAP's. Cameras are turned by `quarters`, clockwise,
/// as that of the photograph is.
pub fn doubt(path: &Path, quarters: u32) -> Option<String> {
    let own = match colmap::Files::at(path) {
        Some(_) => WorldUp::MinusY,
        None => WorldUp::Z,
    };
    let pictures = pictures(path, Some(WorldUp::Y));
    let rotations = pictures.iter().map(|p| p.1.pose.turned(quarters).rotation);
    let rotations: Vec<DMat3> = rotations.collect();
    let meant = meant(&rotations, own)?.word();
    let name = path.file_name().unwrap_or(path.as_os_str());
    let own = own.word();
    Some(format!(
        "the pictures of {name:?} are upright if {meant} of its world points up, and {own} is taken: write file_up = {meant:?} \
         (dipir init: --camera-up), or file_up = {own:?} if that is right"
    ))
}

/// The axis by which cameras with these rotations are upright, if they are not by `own`.
fn meant(rotations: &[DMat3], own: WorldUp) -> Option<WorldUp> {
    let sum: DVec3 = rotations.iter().map(|r| r.y_axis).sum();
    let mean = sum / rotations.len().max(1) as f64;
    if rotations.len() < FEWEST || mean.length() < LEAST_MEAN {
        return None;
    }
    let along = |up: WorldUp| (up.to_ours() * mean.normalize()).y;
    let other = WorldUp::ALL.into_iter().find(|up| along(*up) > MEANT);
    other.filter(|_| along(own) < DOUBTED)
}
