//! Pictures of streets and rooms that are made of straight lines, with a known camera: what estimates are checked on.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_numerics::hashing::hash_u64s;
use glam::{DMat3, DVec3, Vec3};

use crate::pose::Pose;

/// Rays along each side of a pixel.
const RAYS: usize = 3;
/// Height of the eyes, metres.
const EYE_M: f64 = 1.6;

/// What is built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Built {
    /// Two rows of houses with windows along a road with lanes, under the sky.
    Street,
    /// Four walls with doors and panels, a floor of tiles and a ceiling.
    Room,
}

/// A picture of `size` pixels. `seed` decides on sizes, colours and how the camera is turned about the vertical.
pub fn picture(built: Built, seed: u64, pose: &Pose, size: [usize; 2]) -> LinearImage {
    let [w, h] = size;
    let unit = |n: u64| hash_u64s(&[seed, n]) as f64 / u64::MAX as f64;
    // Along the street a level direction lies straight ahead, in a room the view is turned to a corner or a wall.
    let turn = match built {
        Built::Street => 50.0 * (unit(0) - 0.5),
        Built::Room => 90.0 * (unit(0) - 0.5),
    };
    let rotation = DMat3::from_rotation_y(turn.to_radians()) * pose.rotation();
    let focal = pose.focal() * w.max(h) as f64;
    let width = 4.0 + 4.0 * unit(1);
    let pixel = |k: usize| {
        let mut sum = 0.0;
        for r in 0..RAYS * RAYS {
            let [dx, dy] = [r % RAYS, r / RAYS].map(|n| (n as f64 + 0.5) / RAYS as f64);
            let x = ((k % w) as f64 + dx - 0.5 * w as f64) / focal;
            let y = (0.5 * h as f64 - (k / w) as f64 - dy) / focal;
            let towards = rotation * DVec3::new(x, y, -1.0).normalize();
            sum += match built {
                Built::Street => street(towards, width, seed),
                Built::Room => room(towards, 0.5 * width, seed),
            };
        }
        Vec3::splat((sum / (RAYS * RAYS) as f64) as f32)
    };
    LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()))
}

/// A shade in `[low, high)` of a cell of a surface.
fn shade(seed: u64, surface: u64, cell: [f64; 2], low: f64, high: f64) -> f64 {
    let [a, b] = cell.map(|v| v.floor() as i64 as u64);
    low + (high - low) * hash_u64s(&[seed, surface, a, b]) as f64 / u64::MAX as f64
}

/// Whether the point of a cell is inside its margins.
fn inside(value: f64, cell: f64, margin: f64) -> bool {
    let at = value.rem_euclid(cell) / cell;
    (margin..1.0 - margin).contains(&at)
}

fn street(towards: DVec3, half_width: f64, seed: u64) -> f64 {
    let reach = |from: f64, to: f64, d: f64| match (to - from) / d {
        t if t > 0.0 && t.is_finite() => t,
        _ => f64::INFINITY,
    };
    let ground = reach(EYE_M, 0.0, towards.y);
    let side = half_width.copysign(towards.x);
    let wall = reach(0.0, side, towards.x);
    if wall < ground {
        let (y, z) = (EYE_M + wall * towards.y, wall * towards.z);
        let house = (z / 9.0).floor();
        let height = shade(seed, 1, [house, side], 6.0, 13.0);
        if y < height {
            let face = shade(seed, 2, [house, side], 0.25, 0.7);
            let window = inside(z, 2.25, 0.25) && inside(y, 2.9, 0.2);
            return if window { 0.12 } else { face };
        }
        return 0.9;
    }
    if ground.is_finite() {
        let (x, z) = (ground * towards.x, ground * towards.z);
        return match x.abs() {
            x if x > half_width - 1.5 => 0.45,
            x if x < 0.08 && z.rem_euclid(6.0) < 3.0 => 0.8,
            x if (half_width - 1.75..half_width - 1.65).contains(&x) => 0.8,
            _ => 0.2,
        };
    }
    0.9
}

fn room(towards: DVec3, half: f64, seed: u64) -> f64 {
    let walls = [half, 2.7, half + 1.0];
    let eye = DVec3::new(0.3 * half, EYE_M, 0.6 * half);
    let (mut nearest, mut axis) = (f64::INFINITY, 0);
    for k in 0..3 {
        let (low, high) = if k == 1 {
            (0.0, walls[1])
        } else {
            (-walls[k], walls[k])
        };
        let end = if towards[k] > 0.0 { high } else { low };
        let t = (end - eye[k]) / towards[k];
        if t.is_finite() && t < nearest {
            (nearest, axis) = (t, k);
        }
    }
    let p = eye + nearest * towards;
    if axis == 1 {
        return match towards.y < 0.0 {
            true => shade(seed, 3, [p.x / 0.5, p.z / 0.5], 0.25, 0.45),
            false => 0.85,
        };
    }
    let (along, side) = if axis == 0 { (p.z, p.x) } else { (p.x, p.z) };
    let wall = shade(seed, 4 + axis as u64, [side, 0.0], 0.4, 0.65);
    if inside(along, 1.7, 0.22) && (0.0..2.05).contains(&p.y) {
        return shade(seed, 8 + axis as u64, [along / 1.7, side], 0.1, 0.9);
    }
    if p.y < 0.12 { 0.15 } else { wall }
}
