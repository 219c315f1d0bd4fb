//! Photographs of generated places whose light is known: several solids on open ground under a sun and a
//! sky, and one more, of a kind that training never showed, that is to be put among them.
use std::f32::consts::{PI, TAU};

use dipir_diffusion::noise::NoiseStream;
use dipir_light::environment::EnvironmentMap;
use dipir_light::error::LightError;
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::rasterize::rasterize;
use glam::Vec3;

use crate::examples::Tone;
use crate::lights::{Light, Sun, sun_direction};
use crate::record::{Layer, Record, first_plane, weights};
use crate::studio::{Brief, Kinds, Setting, Stage, View};

/// A place, its light, and what a camera sees of it.
#[derive(Debug, Clone)]
pub struct Place {
    /// What stands there, and what is to be inserted.
    pub stage: Stage,
    /// The true light, of the sun `stage.suns[0]`.
    pub light: Light,
    /// The camera's exposure and curve.
    pub tone: Tone,
    /// Linear radiance without the inserted solid, row by row, before exposure.
    pub radiance: Vec<Vec3>,
}

impl Place {
    /// The place number `index` under `seed`, seen on `size` x `size` pixels.
    pub fn draw(seed: u64, index: u64, size: u32, setting: Setting) -> Self {
        let brief = Brief {
            kinds: Kinds::HeldOut,
            setting,
            view: View::Wide,
        };
        let mut stage = Stage::draw(seed, index, size, brief);
        let mut stream = NoiseStream::new(seed ^ 1, index);
        let mut range = |low: f32, high: f32| low + (high - low) * stream.uniform() as f32;
        let sun = Sun {
            azimuth: range(0.0, TAU),
            elevation: range(18.0, 66.0).to_radians(),
            sharpness: range(110.0, 400.0),
        };
        stage.suns = vec![sun; stage.suns.len()];
        let share = range(0.55, 0.93);
        let total = PI * range(0.5, 1.05);
        let tints = (range(0.0, 0.5), range(0.0, 0.5));
        let light = Light::new(0, sun.elevation, (total, share), tints, range(0.6, 1.5));
        let tone = Tone {
            exposure: range(0.75, 1.35),
            shoulder: range(0.0, 1.0),
        };
        let record = Record::trace(&stage, seed, index);
        let count = record.size * record.size;
        let mut radiance = vec![Vec3::ZERO; count];
        for (b, weight) in weights(&light).iter().enumerate() {
            let plane = |c: usize| (first_plane(Layer::Background) + 3 * b + c) * count;
            for (p, pixel) in radiance.iter_mut().enumerate() {
                *pixel +=
                    *weight * Vec3::from_array([0, 1, 2].map(|c| record.planes[plane(c) + p]));
            }
        }
        Self {
            stage,
            light,
            tone,
            radiance,
        }
    }

    /// The sun.
    pub fn sun(&self) -> Sun {
        self.stage.suns[0]
    }

    /// The true light as a map: sun, graded sky, and what the ground throws back. An error if a side is 0.
    pub fn map(&self, width: usize, height: usize) -> Result<EnvironmentMap, LightError> {
        let sun = self.sun();
        let lobe = SphericalGaussian {
            direction: sun_direction(sun.azimuth, sun.elevation),
            radiance: Vec3::ONE,
            sigma: sun.sharpness.powf(-0.5),
        };
        let lobe = SphericalGaussian {
            radiance: self.light.sun_color / lobe.solid_angle() as f32,
            ..lobe
        };
        let sunlit = rasterize(&[lobe], width, height);
        let texels = sunlit.texels().iter().enumerate().map(|(k, sun)| {
            let y = sunlit.direction_of(k / width, k % width).y;
            *sun + match y > 0.0 {
                true => self.light.horizon * (1.0 - y) + self.light.zenith * y,
                false => self.light.bounce,
            }
        });
        EnvironmentMap::new(width, height, texels.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_map_lights_open_ground_as_the_light_says() {
        let place = Place::draw(5, 0, 8, Setting::Open);
        let map = place.map(256, 128).unwrap();
        let mut irradiance = Vec3::ZERO;
        for row in 0..128 {
            let theta = (row as f32 + 0.5) / 128.0 * PI;
            for column in 0..256 {
                let y = map.direction_of(row, column).y;
                let solid_angle = theta.sin() * (PI / 128.0) * (TAU / 256.0);
                irradiance += map.texels()[row * 256 + column] * y.max(0.0) * solid_angle;
            }
        }
        let light = &place.light;
        let sun = light.sun_color * place.sun().elevation.sin();
        // Over the upper half of the sphere, of (1 - y) y and of y y: pi/3 and 2 pi/3.
        let sky = light.horizon * (PI / 3.0) + light.zenith * (2.0 * PI / 3.0);
        let error = (irradiance - sun - sky).length() / irradiance.length();
        // The sun's lobe is rasterised: a part of it lies under texel centres, none under the horizon.
        assert!(error < 0.01, "{irradiance} instead of {}", sun + sky);
        assert!(place.radiance.iter().any(|p| p.max_element() > 0.01));
    }
}
