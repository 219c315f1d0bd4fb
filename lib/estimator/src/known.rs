//! What people and clocks know of the sun, as one more factor of the distribution.
use dipir_light::gaussian::SphericalGaussian;
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::estimate::LightEstimate;
use crate::grid::{BINS, bin_direction, direction};
use crate::posterior::PeakPosterior;

/// Standard deviation of a direction within a bin, degrees: a bin is 15 degrees wide.
const BIN_SIGMA_DEG: f64 = 4.4;
/// Every bin's probability before the factor is applied: what is known for sure can contradict the photograph.
const DOUBT: f64 = 1e-3 / BINS as f64;
/// A direction that is known this well, degrees, becomes a source of its own.
const SHARP_DEG: f64 = 6.0;
/// Angular radius of a source without a stated size: the sun's, where the photograph looks sunny.
const SUN_RADIUS_DEG: f64 = 0.27;
/// The same behind clouds or haze.
const HAZE_RADIUS_DEG: f64 = 10.0;
/// A sun this far below the horizon lights nothing, degrees.
const SET_DEG: f64 = -1.0;

/// An angle and how sure it is, degrees.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KnownAngle {
    /// The angle.
    pub deg: f64,
    /// Its standard deviation.
    pub sigma_deg: f64,
}

/// What is known of the strongest source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KnownSun {
    /// Azimuth relative to the view, to the right.
    pub azimuth: Option<KnownAngle>,
    /// Elevation above the horizon.
    pub elevation: Option<KnownAngle>,
    /// Angular radius, degrees.
    pub radius_deg: Option<f64>,
    /// Its share of all light.
    pub share: Option<f64>,
}

/// A source whose direction is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KnownSource {
    /// Unit vector in the world.
    pub direction: Vec3,
    /// Angular radius, degrees.
    pub radius_deg: f64,
}

impl LightEstimate {
    /// The estimate with what is known of the sun.
    pub fn knowing(&self, sun: &KnownSun) -> Self {
        let mut known = self.clone();
        if sun.elevation.is_some_and(|e| e.deg < SET_DEG) {
            known.peak = [0.0; 3];
            known.sun_probability = 0.0;
            return known.described();
        }
        let weight = |k: usize| {
            let (azimuth, elevation) = angles_deg(bin_direction(k));
            let prior = f64::from(self.posterior.weights[k]) + DOUBT;
            let apart = |known: Option<KnownAngle>, turn: f64, at: f64| {
                known.map_or(0.0, |a| {
                    let away = match turn > 0.0 {
                        true => (at - a.deg + 1.5 * turn).rem_euclid(turn) - 0.5 * turn,
                        false => at - a.deg,
                    };
                    away * away / (a.sigma_deg * a.sigma_deg + BIN_SIGMA_DEG * BIN_SIGMA_DEG)
                })
            };
            let far = apart(sun.azimuth, 360.0, azimuth) + apart(sun.elevation, 0.0, elevation);
            prior * (-0.5 * far).exp()
        };
        known.posterior = PeakPosterior::normalised((0..BINS).map(weight).collect());
        if let Some(share) = sun.share {
            known.set_share(share);
        }
        if let (Some(azimuth), Some(elevation)) = (sun.azimuth, sun.elevation)
            && azimuth.sigma_deg.max(elevation.sigma_deg) <= SHARP_DEG
        {
            let seen = direction(
                azimuth.deg.to_radians() as f32,
                elevation.deg.to_radians() as f32,
            );
            let default = match known.sun_probability >= 0.5 {
                true => SUN_RADIUS_DEG,
                false => HAZE_RADIUS_DEG,
            };
            known.source = Some(KnownSource {
                direction: Quat::from_rotation_y(-self.heading_rad as f32) * seen,
                radius_deg: sun.radius_deg.unwrap_or(default),
            });
        }
        known.described()
    }

    /// Moves light between the strongest source and the rest, so that the source has `share` of it.
    fn set_share(&mut self, share: f64) {
        let base = self.base_map().integral();
        let peak = Vec3::from(self.peak).as_dvec3();
        let (rest, source) = (base.element_sum(), peak.element_sum());
        let total = rest + source;
        if !(total > 0.0 && rest > 0.0) {
            return;
        }
        let colour = match source > 0.0 {
            true => peak / source,
            false => base / rest,
        };
        self.peak = (colour * (share * total)).as_vec3().to_array();
        let scale = ((1.0 - share) * total / rest) as f32;
        for texel in &mut self.base {
            *texel = texel.map(|v| v * scale);
        }
    }

    /// The source whose direction is known, as a lobe with the expected energy.
    pub fn source_lobe(&self) -> Option<SphericalGaussian> {
        let source = self.source?;
        // A lobe has the mean square angle of a disc of radius r if its sigma is r / 2.
        let mut lobe = SphericalGaussian {
            direction: source.direction,
            radiance: Vec3::ONE,
            sigma: (0.5 * source.radius_deg.to_radians()) as f32,
        };
        lobe.radiance = Vec3::from(self.peak) / lobe.solid_angle() as f32;
        (lobe.radiance.max_element() > 0.0).then_some(lobe)
    }
}

/// Azimuth relative to the view and elevation of a direction in the frame of the view, degrees.
fn angles_deg(towards: Vec3) -> (f64, f64) {
    let towards = towards.as_dvec3();
    (
        towards.x.atan2(-towards.z).to_degrees(),
        towards.y.clamp(-1.0, 1.0).asin().to_degrees(),
    )
}
