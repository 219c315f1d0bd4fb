//! Photographs of generated scenes whose light is known, for tests of insertion. The object that is inserted has a shape
//! that training does not contain.
use std::f32::consts::{PI, TAU};

use dipir_diffusion::noise::NoiseStream;
use dipir_light::environment::EnvironmentMap;
use dipir_light::error::LightError;
use glam::Vec3;

use crate::camera::CameraResponse;
use crate::direct_light::{DirectLightImages, Layer};
use crate::lighting::{Sun, SunSkyLight};
use crate::scene::{Framing, GeneratedScene, ObjectSet, SceneKind, Setting};

/// A generated scene, its light, and the photograph without the main object.
#[derive(Debug, Clone)]
pub struct GeneratedPhotograph {
    /// The scene; its main object is to be inserted.
    pub scene: GeneratedScene,
    /// The true light. Its sun is `scene.suns[0]`.
    pub light: SunSkyLight,
    /// Exposure and tone curve of the camera.
    pub response: CameraResponse,
    /// Linear radiance without the main object, row by row, before exposure.
    pub radiance: Vec<Vec3>,
}

impl GeneratedPhotograph {
    /// The photograph number `index` under `seed`, of `size` x `size` pixels.
    pub fn draw(seed: u64, index: u64, size: u32, setting: Setting) -> Self {
        let kind = SceneKind {
            objects: ObjectSet::HeldOut,
            setting,
            framing: Framing::Wide,
        };
        let mut scene = GeneratedScene::draw(seed, index, size, kind);
        let mut stream = NoiseStream::new(seed ^ 1, index);
        let mut range = |low: f32, high: f32| low + (high - low) * stream.uniform() as f32;
        let sun = Sun {
            azimuth: range(0.0, TAU),
            elevation: range(18.0, 66.0).to_radians(),
            sharpness: range(110.0, 400.0),
        };
        scene.suns = vec![sun; scene.suns.len()];
        let share = range(0.55, 0.93);
        let total = PI * range(0.5, 1.05);
        let tints = (range(0.0, 0.5), range(0.0, 0.5));
        let light = SunSkyLight::new(0, sun.elevation, (total, share), tints, range(0.6, 1.5));
        let response = CameraResponse {
            exposure: range(0.75, 1.35),
            shoulder: range(0.0, 1.0),
        };
        let images = DirectLightImages::trace(&scene, seed, index);
        let radiance = images.layer(Layer::Background, &light);
        Self {
            scene,
            light,
            response,
            radiance,
        }
    }

    /// The sun.
    pub fn sun(&self) -> Sun {
        self.scene.suns[0]
    }

    /// The true light as an environment map. An error if a side is 0.
    pub fn map(&self, width: usize, height: usize) -> Result<EnvironmentMap, LightError> {
        self.light.environment(&self.scene.suns, width, height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_map_has_the_lights_irradiance_of_the_ground() {
        let photograph = GeneratedPhotograph::draw(5, 0, 8, Setting::Open);
        let map = photograph.map(256, 128).unwrap();
        let mut irradiance = Vec3::ZERO;
        for row in 0..128 {
            let theta = (row as f32 + 0.5) / 128.0 * PI;
            for column in 0..256 {
                let y = map.direction_of(row, column).y;
                let solid_angle = theta.sin() * (PI / 128.0) * (TAU / 256.0);
                irradiance += map.texels()[row * 256 + column] * y.max(0.0) * solid_angle;
            }
        }
        let light = &photograph.light;
        let sun = light.sun_color * photograph.sun().elevation.sin();
        // Integrals over the upper hemisphere: pi/3 of (1 - y) y, 2 pi/3 of y y.
        let sky = light.horizon * (PI / 3.0) + light.zenith * (2.0 * PI / 3.0);
        let error = (irradiance - sun - sky).length() / irradiance.length();
        // The sun's lobe is rasterised, which moves parts of it by up to half a texel.
        assert!(error < 0.01, "{irradiance} instead of {}", sun + sky);
        assert!(photograph.radiance.iter().any(|p| p.max_element() > 0.01));
    }
}
