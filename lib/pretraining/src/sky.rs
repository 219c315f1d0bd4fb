//! The visible sky of generated scenes.

use glam::{Vec2, Vec3};

use crate::ground::value_noise;
use crate::random::Draw;

/// How a visible sky differs from the smooth one that lights the scene: brighter around the sun, and clouds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SkyAppearance {
    /// Radiance next to the sun, per steradian, for an irradiance of 1.
    glow: f32,
    /// Rate of its exponential fall, per radian.
    fall: f32,
    /// Amplitude of clouds, as a share of the radiance.
    clouds: f32,
    seed: u32,
}

impl SkyAppearance {
    /// Radiance that the sun adds in `direction`, for an irradiance of 1 on a surface that faces it.
    pub fn around_sun(&self, direction: Vec3, sun: Vec3) -> f32 {
        let angle = direction.dot(sun).clamp(-1.0, 1.0).acos();
        self.glow * (-self.fall * angle).exp()
    }

    /// The factor on the sky's radiance in `direction`.
    pub fn cover(&self, direction: Vec3) -> f32 {
        if self.clouds == 0.0 {
            return 1.0;
        }
        // Clouds are a plane layer, so they are denser towards the horizon.
        let at = Vec2::new(direction.x, direction.z) * (3.0 / (direction.y + 0.15));
        let noise = 0.6 * value_noise(at, self.seed) + 0.4 * value_noise(at * 2.7, self.seed ^ 1);
        1.0 + self.clouds * (2.0 * noise - 1.0)
    }
}

impl Draw<'_> {
    /// The visible sky of a courtyard.
    pub(crate) fn sky_appearance(&mut self) -> SkyAppearance {
        SkyAppearance {
            glow: self.range(0.0, 0.4),
            fall: self.range(1.5, 4.0),
            clouds: self.range(0.0, 0.6),
            seed: self.below(1 << 20) as u32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{GeneratedScene, Setting};

    #[test]
    fn the_sky_is_brightest_around_the_sun_and_clouds_keep_its_mean() {
        let mut clouded = 0;
        for index in 0..20 {
            let look = GeneratedScene::close(index, Setting::Courtyard).sky;
            let sun = Vec3::new(0.6, 0.8, 0.0);
            let at = |degrees: f32| {
                let (s, c) = degrees.to_radians().sin_cos();
                look.around_sun(sun * c + Vec3::Z * s, sun)
            };
            assert!(at(0.0) > at(20.0) && at(20.0) > at(90.0) && at(90.0) >= 0.0);
            let cover = (0..4000).map(|i| {
                let (s, c) = (i as f32 * 2.4).sin_cos();
                let y = (i as f32 + 0.5) / 4000.0;
                let r = (1.0 - y * y).sqrt();
                look.cover(Vec3::new(r * c, y, r * s))
            });
            let mean = cover.sum::<f32>() / 4000.0;
            assert!((mean - 1.0).abs() < 0.15, "{index}: {mean}");
            clouded += usize::from(look.clouds > 0.2);
        }
        assert!(clouded > 8);
        let clear = GeneratedScene::close(0, Setting::Open).sky;
        assert_eq!(
            (clear.around_sun(Vec3::Y, Vec3::Y), clear.cover(Vec3::Y)),
            (0.0, 1.0)
        );
    }
}
