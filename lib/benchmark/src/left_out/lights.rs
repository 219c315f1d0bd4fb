//! The lights that scenes are rendered under: the truth, neutral light, the estimate, and the estimate with parts of
//! it replaced by the truth's.
use std::sync::Arc;

use dipir_estimator::grid::BASE_TEXELS;
use dipir_estimator::posterior::soft_bins;
use dipir_estimator::{BORDER_DEG, LightEstimate, PeakPosterior, Visible, merged};
use dipir_light::environment::EnvironmentMap;
use dipir_light::luminance::luminance_f64;
use dipir_places::examples::Truth;
use dipir_places::place::Place;
use dipir_places::probes::Probes;
use glam::{Quat, Vec3};

use super::picture::Curve;
use super::scene::DrawnScene;

/// Columns and rows of maps with what the photograph shows.
const MAP: [usize; 2] = [512, 256];
/// Columns and rows of maps with a sun: a texel has .35 degrees.
const SHARP: [usize; 2] = [1024, 512];

/// A light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Light {
    /// As bright as the photograph from everywhere, before the curve.
    Neutral,
    /// What a user gets.
    Estimate,
    /// The same without a curve on the object.
    Uncompressed,
    /// The same with a curve that is straight in the shadows.
    RollOff,
    /// The posterior to the power of 2.5.
    Narrow,
    /// A sun at the most probable direction where a sun is probable.
    Mode,
    /// Without what the photograph shows.
    Unseen,
    /// At the true mean radiance.
    Exposure,
    /// The strongest source where it is.
    Direction,
    /// The same, of the sun's size where there is a sun.
    Sharp,
    /// The strongest source as strong as it is.
    Energy,
    /// The rest as it is, on 16 x 8 texels.
    Base,
    /// Both, the posterior as estimated.
    BaseEnergy,
    /// All three.
    Parts,
    /// All three, the sun of its size.
    SharpParts,
}

/// Their names.
pub const LIGHTS: [(Light, &str); 15] = [
    (Light::Neutral, "neutral"),
    (Light::Estimate, "estimate"),
    (Light::Uncompressed, "no curve"),
    (Light::RollOff, "roll-off"),
    (Light::Narrow, "narrow posterior"),
    (Light::Mode, "sun at the mode"),
    (Light::Unseen, "without what is seen"),
    (Light::Exposure, "true exposure"),
    (Light::Direction, "true direction"),
    (Light::Sharp, "true direction, sharp"),
    (Light::Energy, "true source's energy"),
    (Light::Base, "true rest"),
    (Light::BaseEnergy, "true rest, energy"),
    (Light::Parts, "true rest, energy, direction"),
    (Light::SharpParts, "true rest, energy, direction, sharp"),
];

impl Light {
    /// The curve that is applied to the object.
    pub fn curve(self) -> Curve {
        match self {
            Self::Uncompressed => Curve::None,
            Self::RollOff => Curve::RollOff,
            _ => Curve::Reinhard,
        }
    }

    /// Whether it is rendered without `--parts`.
    pub fn is_always(self) -> bool {
        matches!(self, Self::Neutral | Self::Estimate)
    }

    /// The light as a map in the world.
    pub fn map(
        self,
        scene: &DrawnScene,
        place: &Place,
        estimate: &LightEstimate,
        probes: &Probes,
    ) -> Arc<EnvironmentMap> {
        let mut changed = estimate.clone();
        let reference = estimate.reference as f32;
        let truth = Truth::new(
            place,
            scene.heading,
            Vec3::splat(scene.exposure / reference),
            probes,
        );
        let base = || -> Vec<[f32; 3]> {
            let texel = |k: usize| truth.log_base[k].map(|v| (v.exp() - 1e-3).max(0.0) * reference);
            (0..BASE_TEXELS).map(texel).collect()
        };
        let energy = (truth.energy * reference).to_array();
        let there = PeakPosterior {
            weights: soft_bins(truth.peak).to_vec(),
        };
        match self {
            Self::Neutral => return Arc::new(neutral(scene)),
            Self::Unseen => return Arc::new(estimate.map()),
            Self::Estimate | Self::Uncompressed | Self::RollOff | Self::Exposure => {}
            Self::Direction | Self::Sharp => changed.posterior = there,
            Self::Narrow => {
                let powers = estimate
                    .posterior
                    .weights
                    .iter()
                    .map(|w| f64::from(*w).powf(2.5));
                changed.posterior = PeakPosterior::normalised(powers.collect());
            }
            Self::Mode => {}
            Self::Energy => changed.peak = energy,
            Self::Base => changed.base = base(),
            Self::BaseEnergy => (changed.base, changed.peak) = (base(), energy),
            Self::Parts | Self::SharpParts => {
                (changed.base, changed.peak, changed.posterior) = (base(), energy, there);
            }
        }
        let map = if self == Self::Mode && estimate.sun_probability > 0.5 {
            let mode = estimate.posterior.mode();
            let world = Quat::from_rotation_y(-estimate.heading_rad as f32) * mode;
            with_sun(
                &seen(scene, &changed.base_map()),
                world,
                Vec3::from(changed.peak),
            )
        } else if matches!(self, Self::Sharp | Self::SharpParts) && place.sun {
            let world = Quat::from_rotation_y(-estimate.heading_rad as f32) * truth.peak;
            with_sun(
                &seen(scene, &changed.base_map()),
                world,
                Vec3::from(changed.peak),
            )
        } else {
            seen(scene, &changed.map())
        };
        Arc::new(match self {
            Self::Exposure => {
                let wanted = luminance_f64(place.panorama.integral()) * f64::from(scene.exposure);
                map.scaled((wanted / luminance_f64(map.integral()).max(1e-9)) as f32)
            }
            _ => map,
        })
    }
}

/// A light with what the photograph shows.
pub fn seen(scene: &DrawnScene, light: &EnvironmentMap) -> EnvironmentMap {
    let camera = &scene.scene.camera;
    let visible = Visible::new(&scene.photo, camera, MAP[0], MAP[1], BORDER_DEG);
    merged(&visible, light)
}

/// Light before the photographs' curve.
fn before(p: Vec3) -> Vec3 {
    let v = p.clamp(Vec3::ZERO, Vec3::splat(0.95));
    v / (Vec3::ONE - v)
}

/// Adds a source of about the sun's size.
pub fn with_sun(map: &EnvironmentMap, towards: Vec3, energy: Vec3) -> EnvironmentMap {
    let map = map.resampled(SHARP[0], SHARP[1]);
    let (i, j) = map.texel_of(towards);
    let mut texels = map.texels().to_vec();
    texels[i * SHARP[0] + j] += energy / map.solid_angle(i) as f32;
    EnvironmentMap::new(SHARP[0], SHARP[1], texels).unwrap_or(map)
}

/// The photograph's mean before the curve, from everywhere.
fn neutral(scene: &DrawnScene) -> EnvironmentMap {
    let pixels = scene.photo.0.pixels();
    let mean = pixels
        .iter()
        .map(|p| before(*p).as_dvec3())
        .sum::<glam::DVec3>()
        / pixels.len() as f64;
    EnvironmentMap::constant(8, 4, mean.as_vec3())
}
