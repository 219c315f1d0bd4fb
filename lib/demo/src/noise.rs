//! Smooth random functions.
use dipir_numerics::hashing::hash_u64s;
use glam::Vec3;

/// A number in `[0, 1)` that belongs to a point of the integer grid.
pub fn cell(x: i64, y: i64, z: i64, seed: u64) -> f32 {
    (hash_u64s(&[x as u64, y as u64, z as u64, seed]) >> 40) as f32 / (1u64 << 24) as f32
}

/// Value noise in `[0, 1]`, interpolated with continuous slope.
pub fn value_noise(p: Vec3, seed: u64) -> f32 {
    let base = p.floor();
    let f = p - base;
    let t = f * f * (3.0 - 2.0 * f);
    let (x, y, z) = (base.x as i64, base.y as i64, base.z as i64);
    let at = |i: i64, j: i64, k: i64| cell(x + i, y + j, z + k, seed);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let plane = |k: i64| {
        lerp(
            lerp(at(0, 0, k), at(1, 0, k), t.x),
            lerp(at(0, 1, k), at(1, 1, k), t.x),
            t.y,
        )
    };
    lerp(plane(0), plane(1), t.z)
}

/// Sum of octaves of [`value_noise`], in `[0, 1]`.
pub fn fbm(p: Vec3, octaves: u32, seed: u64) -> f32 {
    let (mut sum, mut weight, mut total) = (0.0, 1.0, 0.0);
    let mut q = p;
    for octave in 0..octaves {
        sum += weight * value_noise(q, seed + u64::from(octave));
        total += weight;
        weight *= 0.5;
        // Turned a little, so that the grids of the octaves do not line up.
        q = Vec3::new(1.6 * q.x + 1.2 * q.z, 2.0 * q.y, -1.2 * q.x + 1.6 * q.z) + 17.3;
    }
    sum / total
}
