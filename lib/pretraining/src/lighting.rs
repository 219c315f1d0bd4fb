//! Light of generated scenes: a sun, a sky with a gradient from horizon to zenith, and light that the ground reflects.

use dipir_diffusion::noise::NoiseStream;
use dipir_light::environment::EnvironmentMap;
use dipir_light::error::LightError;
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::rasterize::rasterize;
use dipir_prior::caption::LightDescription;
use glam::Vec3;

use crate::random::between;

/// Direction to a sun at `azimuth`, from -z towards +x, and `elevation`, radians. The camera looks along -z.
pub fn sun_direction(azimuth: f32, elevation: f32) -> Vec3 {
    let (s, c) = azimuth.sin_cos();
    let (up, out) = elevation.sin_cos();
    Vec3::new(s * out, up, -c * out)
}

/// Azimuth and elevation of a direction, the inverse of [`sun_direction`].
pub fn sun_angles(direction: Vec3) -> (f32, f32) {
    let d = direction.normalize_or(Vec3::Y);
    (d.x.atan2(-d.z), d.y.clamp(-1.0, 1.0).asin())
}

/// Direction and size of a sun.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sun {
    /// Angle on the ground from the camera's forward direction, positive to the right, radians.
    pub azimuth: f32,
    /// Angle above the horizon, radians.
    pub elevation: f32,
    /// Its radiance is proportional to exp(sharpness (cos - 1)).
    pub sharpness: f32,
}

/// The light of a scene, linear RGB.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SunSkyLight {
    /// Index of its sun among those of the scene.
    pub sun: usize,
    /// Irradiance by the sun of a surface that faces it.
    pub sun_color: Vec3,
    /// Radiance at the horizon.
    pub horizon: Vec3,
    /// Radiance at the zenith.
    pub zenith: Vec3,
    /// Radiance from below.
    pub bounce: Vec3,
    /// The sun's share of the irradiance of the ground.
    pub share: f32,
}

/// Albedo of the ground that reflects light from below.
const BOUNCE_ALBEDO: f32 = 0.35;

impl SunSkyLight {
    /// The light that irradiates the ground by `total`, `share` of it from a sun at `elevation`. `warm` and `blue`, from 0
    /// to 1, tint sun and sky; `graded` is the horizon's radiance over the mean.
    pub fn new(
        sun: usize,
        elevation: f32,
        (total, share): (f32, f32),
        (warm, blue): (f32, f32),
        graded: f32,
    ) -> Self {
        let tint = |v: Vec3| v / v.element_sum() * 3.0;
        let sun_tint = tint(Vec3::new(1.0, 1.0 - 0.35 * warm, 1.0 - 0.75 * warm));
        let sky_tint = tint(Vec3::new(1.0 - 0.6 * blue, 1.0 - 0.2 * blue, 1.0));
        let sun_color = sun_tint * (share * total / elevation.sin().max(0.1));
        let mean = (1.0 - share) * total / std::f32::consts::PI;
        // Irradiance of h (1 - y) + z y is pi (h / 3 + 2 z / 3).
        let horizon = mean * graded;
        let zenith = ((mean - horizon / 3.0) * 1.5).max(0.05 * mean);
        let ground = sun_color * elevation.sin() + std::f32::consts::PI * mean * sky_tint;
        Self {
            sun,
            sun_color,
            horizon: horizon * sky_tint,
            zenith: zenith * sky_tint,
            bounce: ground * (BOUNCE_ALBEDO / std::f32::consts::PI),
            share,
        }
    }

    /// A random light with one of `suns`. One in ten has no sun.
    pub fn draw(suns: &[Sun], stream: &mut NoiseStream) -> Self {
        let mut range = |low, high| between(stream, low, high);
        let sun = (range(0.0, suns.len() as f64) as usize).min(suns.len().saturating_sub(1));
        let overcast = range(0.0, 1.0) < 0.1;
        let share = if overcast { 0.0 } else { range(0.45, 0.93) };
        let total = std::f32::consts::PI * range(0.5, 1.05);
        let tints = (range(0.0, 0.5), range(0.0, 0.5));
        let elevation = suns.get(sun).map_or(0.7, |s| s.elevation);
        Self::new(sun, elevation, (total, share), tints, range(0.6, 1.5))
    }

    /// A random light as photographs have it. Beyond [`draw`](Self::draw), one in six has no visible sun, one in six is
    /// hazy, low suns are redder, and the white balance is off by up to a fifth.
    pub fn draw_varied(suns: &[Sun], stream: &mut NoiseStream) -> Self {
        let drawn = Self::draw(suns, stream);
        let mut range = |low, high| between(stream, low, high);
        let balance = Vec3::new(range(-0.2, 0.2), 0.0, range(-0.2, 0.2)).exp();
        let elevation = suns[drawn.sun].elevation;
        let low = ((30f32.to_radians() - elevation) / 25f32.to_radians()).clamp(0.0, 1.0);
        let tints = (range(0.0, 0.5) + 0.5 * low, range(0.0, 0.6));
        let share = match range(0.0, 1.0) {
            x if x < 0.16 => range(0.0, 0.1),
            x if x < 0.32 => range(0.15, 0.45),
            _ => range(0.45, 0.93),
        };
        let total = std::f32::consts::PI * range(0.35, 1.2);
        Self::new(drawn.sun, elevation, (total, share), tints, range(0.5, 1.5)).scaled(balance)
    }

    /// The same light with another of `suns`. Tints, sky and irradiance of the ground stay.
    pub fn turned_to(&self, sun: usize, suns: &[Sun]) -> Self {
        let height = |sun: usize| suns[sun].elevation.sin().max(0.1);
        Self {
            sun,
            sun_color: self.sun_color * (height(self.sun) / height(sun)),
            ..*self
        }
    }

    /// Irradiance of the ground.
    pub fn irradiance(&self, suns: &[Sun]) -> Vec3 {
        self.sun_color * suns[self.sun].elevation.sin() + self.sky_irradiance()
    }

    /// Irradiance of the ground by the sky alone.
    pub fn sky_irradiance(&self) -> Vec3 {
        // Of radiance h (1 - y) + z y: pi (h / 3 + 2 z / 3).
        std::f32::consts::PI * (self.horizon / 3.0 + self.zenith * (2.0 / 3.0))
    }

    /// The same light with every colour scaled by its factor.
    pub fn scaled(&self, factors: Vec3) -> Self {
        Self {
            sun_color: self.sun_color * factors,
            horizon: self.horizon * factors,
            zenith: self.zenith * factors,
            bounce: self.bounce * factors,
            ..*self
        }
    }

    /// Its environment map. An error if a side is 0.
    pub fn environment(
        &self,
        suns: &[Sun],
        width: usize,
        height: usize,
    ) -> Result<EnvironmentMap, LightError> {
        let sun = suns[self.sun];
        let lobe = SphericalGaussian {
            direction: sun_direction(sun.azimuth, sun.elevation),
            radiance: Vec3::ONE,
            sigma: sun.sharpness.powf(-0.5),
        };
        let lobe = SphericalGaussian {
            radiance: self.sun_color / lobe.solid_angle() as f32,
            ..lobe
        };
        let sunlit = rasterize(&[lobe], width, height);
        let texels = sunlit.texels().iter().enumerate().map(|(k, sun)| {
            let y = sunlit.direction_of(k / width, k % width).y;
            *sun + match y > 0.0 {
                true => self.horizon * (1.0 - y) + self.zenith * y,
                false => self.bounce,
            }
        });
        EnvironmentMap::new(width, height, texels.collect())
    }

    /// Its description for a caption.
    pub fn describe(&self, suns: &[Sun]) -> LightDescription {
        let sun = suns[self.sun];
        LightDescription {
            azimuth: sun.azimuth,
            elevation: sun.elevation,
            sun_share: self.share,
        }
    }
}

/// Lowest and highest sun of all scenes but courtyards, degrees.
pub const SUN_HEIGHTS: [f32; 2] = [13.0, 73.0];

/// `count` suns, spread evenly over azimuths and over elevations in `heights`, degrees.
pub fn draw_suns(count: usize, heights: [f32; 2], stream: &mut NoiseStream) -> Vec<Sun> {
    let mut range = |low, high| between(stream, low, high);
    let start = range(0.0, 1.0);
    let turn = range(0.0, 1.0);
    (0..count)
        .map(|k| {
            let at = (k as f32 + start + range(-0.4, 0.4)) / count as f32;
            // The golden-ratio sequence spreads elevations evenly.
            let height = (turn + k as f32 * 0.618_034).fract();
            Sun {
                azimuth: at * std::f32::consts::TAU,
                elevation: (heights[0] + (heights[1] - heights[0]) * height).to_radians(),
                sharpness: range(100f64.ln(), 500f64.ln()).exp(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_and_angles_are_inverse() {
        for (azimuth, elevation) in [(0.3, 0.2), (-2.0, 1.2), (3.0, 0.7)] {
            let (a, e) = sun_angles(sun_direction(azimuth, elevation));
            assert!((a - azimuth).abs() < 1e-5 && (e - elevation).abs() < 1e-5);
        }
        // Three o'clock is on the camera's right.
        assert!(sun_direction(std::f32::consts::FRAC_PI_2, 0.0).x > 0.99);
    }

    #[test]
    fn the_irradiance_of_the_ground_is_as_requested() {
        let light = SunSkyLight::new(0, 0.6, (2.0, 0.7), (0.3, 0.4), 1.1);
        let suns = [Sun {
            azimuth: 0.0,
            elevation: 0.6,
            sharpness: 200.0,
        }];
        let ground = light.irradiance(&suns);
        assert!((ground.element_sum() / 3.0 - 2.0).abs() < 1e-4);
        let brighter = light.scaled(Vec3::new(1.0, 2.0, 3.0)).irradiance(&suns);
        assert!((brighter - ground * Vec3::new(1.0, 2.0, 3.0)).length() < 1e-5);
        let sun = light.sun_color.element_sum() / 3.0 * 0.6f32.sin();
        assert!((sun / 2.0 - 0.7).abs() < 1e-4);
    }

    #[test]
    fn a_sun_that_moves_keeps_the_irradiance_of_the_ground() {
        let suns = draw_suns(8, SUN_HEIGHTS, &mut NoiseStream::new(1, 1));
        let light = SunSkyLight::new(2, suns[2].elevation, (2.0, 0.7), (0.3, 0.4), 1.1);
        let expected = SunSkyLight::new(5, suns[5].elevation, (2.0, 0.7), (0.3, 0.4), 1.1);
        let moved = light.turned_to(5, &suns);
        assert_eq!((moved.sun, moved.share), (5, 0.7));
        assert!((moved.sun_color - expected.sun_color).length() < 1e-5);
        assert!((moved.bounce - expected.bounce).length() < 1e-5);
    }

    #[test]
    fn varied_lights_have_hazy_skies_and_red_low_suns() {
        let suns = draw_suns(8, [5.0, 75.0], &mut NoiseStream::new(2, 1));
        let (mut overcast, mut hazy) = (0, 0);
        let mut warmth = [(0.0, 0); 2];
        for index in 0..1200 {
            let light = SunSkyLight::draw_varied(&suns, &mut NoiseStream::new(3, index));
            let ground = light.irradiance(&suns);
            assert!(
                ground.is_finite() && ground.min_element() > 0.0,
                "{light:?}"
            );
            overcast += usize::from(light.describe(&suns).is_overcast());
            hazy += usize::from((0.15..0.45).contains(&light.share));
            if light.share > 0.45 {
                let is_high = suns[light.sun].elevation > 0.6;
                let (sum, count) = &mut warmth[usize::from(is_high)];
                *sum += (light.sun_color.x / light.sun_color.z).ln();
                *count += 1;
            }
        }
        // 192 of each expected, with a standard deviation of 13.
        assert!((140..245).contains(&overcast), "{overcast}");
        assert!((140..245).contains(&hazy), "{hazy}");
        let [low, high] = warmth.map(|(sum, count)| sum / count as f32);
        assert!(low > high + 0.1, "{low} {high}");
    }
}
