//! The grids on which light is estimated, all relative to the view: azimuth 0 is ahead, growing to the right.
use std::f32::consts::{PI, TAU};

use dipir_light::environment::{EnvironmentMap, solid_angle};
use dipir_scene::camera::Camera;
use glam::{Quat, Vec3};

/// Columns and rows of the smooth part of the light: 22.5 degrees, finer detail is not recovered.
pub const BASE: [usize; 2] = [16, 8];
/// Texels of the smooth part.
pub const BASE_TEXELS: usize = BASE[0] * BASE[1];
/// Azimuths of the strongest source, 15 degrees each, from 0.
pub const AZIMUTHS: usize = 24;
/// Borders between its elevations, degrees. The lowest bin holds lamps below the horizon, too.
pub const ELEVATION_EDGES_DEG: [f32; 6] = [-30.0, 0.0, 15.0, 32.0, 52.0, 90.0];
/// Elevations that stand for the bins, degrees.
pub const ELEVATIONS_DEG: [f32; ELEVATIONS] = [-10.0, 8.0, 23.0, 42.0, 65.0];
/// Elevations of the strongest source.
pub const ELEVATIONS: usize = 5;
/// Bins of the posterior: elevation after elevation, each around the horizon.
pub const BINS: usize = AZIMUTHS * ELEVATIONS;
/// Width of the lobe that a bin stands for, radians: about half the distance between bins.
pub const BIN_SIGMA: f32 = 0.21;

/// The unit vector at an azimuth and an elevation, radians.
pub fn direction(azimuth_rad: f32, elevation_rad: f32) -> Vec3 {
    let across = elevation_rad.cos();
    Vec3::new(
        azimuth_rad.sin() * across,
        elevation_rad.sin(),
        -azimuth_rad.cos() * across,
    )
}

/// The middle of bin `k`.
pub fn bin_direction(k: usize) -> Vec3 {
    let azimuth = (k % AZIMUTHS) as f32 + 0.5;
    direction(
        azimuth / AZIMUTHS as f32 * TAU,
        ELEVATIONS_DEG[k / AZIMUTHS].to_radians(),
    )
}

/// The middle of texel `k` of the smooth part and its solid angle.
pub fn base_texel(k: usize) -> (Vec3, f32) {
    let (row, column) = (k / BASE[0], k % BASE[0]);
    let azimuth = (column as f32 + 0.5) / BASE[0] as f32 * TAU;
    let polar = (row as f32 + 0.5) / BASE[1] as f32 * PI;
    (
        direction(azimuth, 0.5 * PI - polar),
        solid_angle(BASE[0], BASE[1], row) as f32,
    )
}

/// Where the same bin lies in a mirrored picture.
pub fn mirrored_bin(k: usize) -> usize {
    k / AZIMUTHS * AZIMUTHS + (AZIMUTHS - 1 - k % AZIMUTHS)
}

/// Where the same texel of the smooth part lies in a mirrored picture.
pub fn mirrored_texel(k: usize) -> usize {
    k / BASE[0] * BASE[0] + (BASE[0] - 1 - k % BASE[0])
}

/// The azimuth of the view in the world, radians: 0 looks to -z, a quarter turn to +x. A camera that looks straight
/// up or down has the azimuth of what is ahead when its head is lowered or raised to the horizon.
pub fn heading(camera: &Camera) -> f64 {
    let forward = -camera.rotation.z_axis.as_dvec3();
    let level = forward.x.hypot(forward.z);
    let ahead = if level > 1e-4 {
        forward
    } else {
        camera.rotation.y_axis.as_dvec3() * -forward.y.signum()
    };
    ahead.x.atan2(-ahead.z)
}

/// A direction in the world relative to the view: -z is ahead, +x to the right, elevation stays.
pub fn relative(towards: Vec3, camera: &Camera) -> Vec3 {
    Quat::from_rotation_y(heading(camera) as f32) * towards
}

/// The smooth part on `width` x `height` texels, relative to the view: interpolated between the middles of its
/// texels, so that no edges are reflected, then scaled to keep the light of the sphere.
pub fn smooth_map(base: &[[f32; 3]], width: usize, height: usize) -> Vec<Vec3> {
    let at = |row: usize, column: i64| {
        let column = column.rem_euclid(BASE[0] as i64) as usize;
        Vec3::from(base[row * BASE[0] + column])
    };
    let mut texels = Vec::with_capacity(width * height);
    for i in 0..height {
        let y = ((i as f32 + 0.5) / height as f32 * BASE[1] as f32 - 0.5)
            .clamp(0.0, (BASE[1] - 1) as f32);
        let (top, fy) = (
            (y as usize).min(BASE[1] - 2),
            y - (y as usize).min(BASE[1] - 2) as f32,
        );
        for j in 0..width {
            let x = (j as f32 + 0.5) / width as f32 * BASE[0] as f32 - 0.5;
            let (left, fx) = (x.floor() as i64, x - x.floor());
            let line = |row| at(row, left) * (1.0 - fx) + at(row, left + 1) * fx;
            texels.push(line(top) * (1.0 - fy) + line(top + 1) * fy);
        }
    }
    let (mut wanted, mut found) = (Vec3::ZERO, Vec3::ZERO);
    for k in 0..BASE_TEXELS {
        wanted += Vec3::from(base[k]) * base_texel(k).1;
    }
    for (k, t) in texels.iter().enumerate() {
        found += *t * solid_angle(width, height, k / width) as f32;
    }
    let scale = Vec3::from_array(std::array::from_fn(|c| {
        if found[c] > 0.0 {
            wanted[c] / found[c]
        } else {
            1.0
        }
    }));
    texels.iter().map(|t| *t * scale).collect()
}

/// A map relative to the view turned into the world.
pub(crate) fn to_world(map: &EnvironmentMap, heading_rad: f64) -> EnvironmentMap {
    // Azimuth grows clockwise seen from above; `rotated_y` turns the other way.
    map.rotated_y(-heading_rad)
}
