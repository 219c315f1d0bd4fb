//! The lights of the built-in scenes.
use dipir_light::environment::EnvironmentMap;
use glam::{Vec2, Vec3};

/// Columns and rows.
const MAP: [usize; 2] = [256, 128];

fn map_of(radiance: impl Fn(Vec3) -> Vec3) -> EnvironmentMap {
    let [width, height] = MAP;
    let empty = EnvironmentMap::constant(width, height, Vec3::ZERO);
    let texels = (0..width * height).map(|k| radiance(empty.direction_of(k / width, k % width)));
    EnvironmentMap::new(width, height, texels.collect()).unwrap_or(empty)
}

/// 1 within `radius_deg` of `towards`, falling smoothly to 0 at 1.3 times that angle.
fn disc(direction: Vec3, towards: Vec3, radius_deg: f32) -> f32 {
    let angle = direction.angle_between(towards.normalize()).to_degrees();
    ((1.3 - angle / radius_deg) / 0.3).clamp(0.0, 1.0)
}

fn ground(direction: Vec3, color: Vec3) -> Vec3 {
    // A pattern that a photograph of it shows: patches of half a metre, seen from eye level.
    let at = Vec2::new(direction.x, direction.z) * (-1.75 / direction.y.min(-0.02));
    let odd = ((at.x * 2.0).floor() + (at.y * 2.0).floor()).rem_euclid(2.0);
    color * (0.85 + 0.3 * odd)
}

/// A blue sky with a sun two degrees wide.
pub fn outdoors() -> EnvironmentMap {
    let sun = Vec3::new(-0.55, 0.75, 0.35);
    map_of(|d| {
        let sky = Vec3::new(0.5, 0.75, 1.2).lerp(Vec3::new(1.0, 1.1, 1.2), (1.0 - d.y).powi(4));
        match d.y < 0.0 {
            true => ground(d, Vec3::new(0.45, 0.4, 0.33)),
            false => sky + Vec3::new(1.0, 0.93, 0.8) * 2600.0 * disc(d, sun, 1.0),
        }
    })
}

/// A room: two windows, a lamp, walls.
pub fn indoors() -> EnvironmentMap {
    map_of(|d| {
        let azimuth = d.x.atan2(d.z);
        let elevation = d.y.asin();
        let window = |at: f32| (azimuth - at).abs() < 0.3 && (elevation - 0.35).abs() < 0.28;
        let wall = match d.y {
            y if y < -0.1 => ground(d, Vec3::new(0.3, 0.2, 0.13)),
            y if y > 0.8 => Vec3::splat(0.55),
            _ => Vec3::new(0.4, 0.36, 0.3),
        };
        let lamp = Vec3::new(1.0, 0.75, 0.45) * 60.0 * disc(d, Vec3::new(0.2, 0.8, 0.7), 5.0);
        wall + lamp
            + match (window(-1.2), window(2.0)) {
                (true, _) => Vec3::new(9.0, 10.0, 11.0),
                (_, true) => Vec3::new(4.0, 4.3, 4.6),
                _ => Vec3::ZERO,
            }
    })
}

/// A bright haze with a sun eight degrees wide, high up.
pub fn hazy() -> EnvironmentMap {
    map_of(|d| match d.y < 0.0 {
        true => ground(d, Vec3::new(0.5, 0.48, 0.45)),
        false => {
            Vec3::new(0.8, 0.85, 0.95) + Vec3::splat(180.0) * disc(d, Vec3::new(0.5, 0.9, 0.2), 4.0)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_built_in_light_is_finite_and_brighter_above() {
        for map in [outdoors(), indoors(), hazy()] {
            let (direction, radiance) = map.peak();
            assert!(direction.y > 0.0 && radiance.is_finite());
        }
    }
}
