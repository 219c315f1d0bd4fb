//! How transport is recorded, and the densities that follow from it.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::{EnvironmentMap, solid_angle};
use dipir_light::luminance::{luminance, luminance_f64};
use glam::Vec3;

use super::Precision;
use crate::render::Simulation;

/// How transport is recorded.
#[derive(Clone, Debug)]
pub struct RecordSettings<'a> {
    /// Columns and rows of the environments that the record takes.
    pub environment: [usize; 2],
    /// Paths per pixel of the object; powers of two are stratified best.
    pub samples: u32,
    /// Samples per pixel of the shadow.
    pub shadow_samples: u32,
    /// How weights are stored.
    pub precision: Precision,
    /// Seed of all random numbers.
    pub seed: u64,
    /// A light similar to those under which the record will be replayed, of any size.
    pub light: Option<&'a EnvironmentMap>,
    /// Share of a plane's shadow samples that are uniform over the sphere, in (0, 1]; the others
    /// follow `light`. 1 without a light.
    pub uniform_share: f32,
    /// Which phenomena are simulated.
    pub simulation: Simulation,
    /// The photograph, linear, of the camera's size: what the proxy looks like from the object.
    pub background: Option<&'a LinearImage>,
    /// 1 where the photograph's own foreground hides the object, 0 where it does not.
    pub occluders: Option<&'a Raster<f32>>,
    /// What the caller knows the scene by; kept in the file.
    pub scene_hash: String,
}

impl RecordSettings<'_> {
    /// Settings for a first record, before anything is known of the light.
    pub fn new(simulation: Simulation) -> Self {
        Self {
            // 2.8 degrees a texel: the lobes that guidance can recover are wider.
            environment: [128, 64],
            samples: 128,
            shadow_samples: 128,
            precision: Precision::Half,
            seed: 0,
            light: None,
            // With a light, half of the samples cover directions where it may go.
            uniform_share: 0.5,
            simulation,
            background: None,
            occluders: None,
            scene_hash: String::new(),
        }
    }

    pub(super) fn texels(&self) -> usize {
        self.environment[0] * self.environment[1]
    }

    /// `light` on the record's grid; black if there is none.
    pub(super) fn light_here(&self) -> EnvironmentMap {
        let [width, height] = self.environment;
        match self.light {
            Some(map) => map.resampled(width, height),
            None => EnvironmentMap::constant(width, height, Vec3::ZERO),
        }
    }

    /// Density per steradian of the light samples of paths, by texel: in proportion to what is
    /// brighter than the mean. The rest is dim and wide, and BSDF sampling finds it better.
    pub(super) fn bright_density(&self, light: &EnvironmentMap) -> Vec<f32> {
        let mean = luminance_f64(light.integral()) / SPHERE;
        let excess = |t: &Vec3| {
            let excess = f64::from(luminance(*t)) - mean;
            if excess > LEAST_EXCESS * mean {
                excess
            } else {
                0.0
            }
        };
        let [width, height] = self.environment;
        let texels = light.texels().iter().enumerate();
        let total: f64 = texels
            .map(|(k, t)| excess(t) * solid_angle(width, height, k / width))
            .sum();
        let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
        light
            .texels()
            .iter()
            .map(|t| (excess(t) * scale) as f32)
            .collect()
    }

    /// Density per steradian, up to a factor, before the cosine and the cone, of light samples
    /// of a plane: a mixture of `light` and uniform, because nothing else would sample elsewhere.
    pub(super) fn plane_density(&self, light: &EnvironmentMap) -> Vec<f32> {
        let total = luminance_f64(light.integral());
        if total <= 0.0 {
            return vec![1.0; self.texels()];
        }
        let uniform = f64::from(self.uniform_share.clamp(LEAST_UNIFORM_SHARE, 1.0));
        let density =
            |t: &Vec3| uniform + (1.0 - uniform) * SPHERE * f64::from(luminance(*t)) / total;
        light.texels().iter().map(|t| density(t) as f32).collect()
    }
}

const SPHERE: f64 = 4.0 * std::f64::consts::PI;

/// Luminance above the mean by less than this share counts as the mean itself: rounding.
const LEAST_EXCESS: f64 = 1e-3;

/// The record of a shadow must be able to see light wherever it appears.
pub(super) const LEAST_UNIFORM_SHARE: f32 = 0.01;
