//! What a light does to a picture, as a few numbers: the brightness of surfaces that face 26 ways, and of blurred
//! reflections in 26 directions.
use std::f32::consts::PI;

use dipir_estimator::grid::{BASE_TEXELS, BINS, base_texel, bin_direction};
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;

use crate::place::SMOOTH;

/// Directions of surfaces: the corners, edges and sides of a cube.
pub const NORMALS: usize = 26;
/// Numbers for each channel: irradiance over pi, then blurred radiance.
pub const PROBES: usize = 2 * NORMALS;
/// Width of the blur, radians.
const BLUR: f32 = 0.35;

/// Linear maps from light to probes.
pub struct Probes {
    /// The directions.
    pub normals: Vec<Vec3>,
    /// `PROBES x BASE_TEXELS`.
    pub base: Vec<f32>,
    /// `PROBES x BINS`, for a source of energy 1.
    pub bins: Vec<f32>,
    smooth: Vec<f32>,
    blur_area: f32,
    /// Probe of the mirrored light.
    pub mirrored: Vec<usize>,
    /// How much each probe counts; 1 in the mean.
    pub strength: Vec<f32>,
    /// Reflectance of the surfaces that are to look as the camera's curve shows them; light itself without it.
    pub albedo: Option<f32>,
}

impl Default for Probes {
    fn default() -> Self {
        let cube = (0..27).map(|k| {
            Vec3::new(
                (k % 3) as f32 - 1.0,
                (k / 3 % 3) as f32 - 1.0,
                (k / 9) as f32 - 1.0,
            )
        });
        let normals: Vec<Vec3> = cube
            .filter(|v| *v != Vec3::ZERO)
            .map(Vec3::normalize)
            .collect();
        let grid = EnvironmentMap::constant(SMOOTH[0], SMOOTH[1], Vec3::ZERO);
        let texels: Vec<(Vec3, f32)> = (0..SMOOTH[0] * SMOOTH[1])
            .map(|k| {
                let row = k / SMOOTH[0];
                (
                    grid.direction_of(row, k % SMOOTH[0]),
                    grid.solid_angle(row) as f32,
                )
            })
            .collect();
        let base: Vec<(Vec3, f32)> = (0..BASE_TEXELS).map(base_texel).collect();
        let blur_area = texels.iter().map(|(d, size)| blur(d.y) * size).sum();
        let mirror = |v: &Vec3| {
            let wanted = Vec3::new(-v.x, v.y, v.z);
            normals
                .iter()
                .position(|n| n.distance(wanted) < 1e-3)
                .unwrap_or(0)
        };
        let half: Vec<usize> = normals.iter().map(mirror).collect();
        let mut all = Self {
            base: Vec::new(),
            bins: Vec::new(),
            smooth: Vec::new(),
            blur_area,
            mirrored: half
                .iter()
                .copied()
                .chain(half.iter().map(|k| k + NORMALS))
                .collect(),
            normals: normals.clone(),
            strength: vec![1.0; PROBES],
            albedo: None,
        };
        all.base = all.matrix(&base);
        all.smooth = all.matrix(&texels);
        let bins: Vec<(Vec3, f32)> = (0..BINS).map(|k| (bin_direction(k), 1.0)).collect();
        all.bins = all.matrix(&bins);
        all
    }
}

/// The blur of a direction that lies at this cosine from the probe's.
fn blur(cos: f32) -> f32 {
    ((cos - 1.0) / (BLUR * BLUR)).exp()
}

impl Probes {
    /// Surfaces count by how much of them a camera sees, to the share `facing`; with `albedo` they are to look as the
    /// camera's curve shows surfaces of that reflectance.
    pub fn seen(facing: f32, albedo: Option<f32>) -> Self {
        let mut all = Self {
            albedo,
            ..Self::default()
        };
        // Cameras look down a little.
        let camera = Vec3::new(0.0, 0.25, 1.0).normalize();
        let face = |n: &Vec3| n.dot(camera).max(0.0);
        let total: f32 = all.normals.iter().map(face).sum();
        for (s, n) in all.strength.iter_mut().zip(&all.normals) {
            *s = facing * face(n) / total * NORMALS as f32 + 1.0 - facing;
        }
        all
    }

    fn matrix(&self, sources: &[(Vec3, f32)]) -> Vec<f32> {
        let row = |p: usize| {
            sources
                .iter()
                .map(move |(d, size)| self.weight(p, *d) * size)
        };
        (0..PROBES).flat_map(row).collect()
    }

    /// What a source of energy 1 in a direction adds to a probe.
    pub fn weight(&self, probe: usize, towards: Vec3) -> f32 {
        let cos = self.normals[probe % NORMALS].dot(towards);
        if probe < NORMALS {
            cos.max(0.0) / PI
        } else {
            blur(cos) / self.blur_area
        }
    }

    /// Probes of a smooth light seen towards column `heading`.
    pub fn of_smooth(&self, map: &EnvironmentMap, heading: usize) -> Vec<Vec3> {
        let (width, count) = (SMOOTH[0], SMOOTH[0] * SMOOTH[1]);
        let turned: Vec<Vec3> = (0..count)
            .map(|k| map.texel(k / width, (k % width + heading) % width))
            .collect();
        let probe = |p: usize| {
            let row = &self.smooth[p * count..(p + 1) * count];
            row.iter().zip(&turned).map(|(w, t)| *t * *w).sum()
        };
        (0..PROBES).map(probe).collect()
    }
}
