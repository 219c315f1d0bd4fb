//! The light that was recovered: `lighting.json`.
use std::path::Path;

use dipir_light::environment::EnvironmentMap;
use dipir_light::fusion::fuse;
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::luminance::{luminance, luminance_f64};
use dipir_light::rasterize::{Rasterizer, rasterize};
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use crate::error::OptimizeError;
use crate::parameters::Parameters;

/// Recovered light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lighting {
    /// Radiance times this is on the photograph's linear scale, where 1 is display white; 1 where a
    /// file does not say.
    #[serde(default = "one")]
    pub exposure: f32,
    /// The lobes, whose sum is the light.
    pub lobes: Vec<SphericalGaussian>,
    /// How far the lobes are from the fused map that they stand for: the integral of the
    /// difference in luminance over that of the map.
    #[serde(default)]
    pub fusion_residual: f64,
    /// Lobes at the start of the list that the map of the surroundings lacks, where there is one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub sources: usize,
}

fn one() -> f32 {
    1.0
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

impl Lighting {
    /// Lobes on the photograph's scale.
    pub fn of_lobes(lobes: Vec<SphericalGaussian>) -> Self {
        Self {
            exposure: 1.0,
            lobes,
            fusion_residual: 0.0,
            sources: 0,
        }
    }

    /// The fused light of `parameters`, on maps of `width` x `height` texels.
    ///
    /// Fusion multiplies the foreground's map by a gain, texel by texel; a product of a lobe and a
    /// gain is no lobe. So every lobe of the foreground takes on the mean gain over itself, which
    /// keeps the energy of each and thereby of the map, and
    /// [`fusion_residual`](Self::fusion_residual) says what that changes. Where both light sets
    /// agree, the gain is 1 and nothing is lost.
    pub fn of(parameters: &Parameters, width: usize, height: usize) -> Self {
        let raster = Rasterizer::new(width, height);
        let mut lobes = parameters.foreground_lobes();
        let before = raster.rasterize(&lobes);
        let shadow = raster.rasterize(&parameters.shadow_lobes());
        let fused = fuse(before.texels(), shadow.texels(), 1.0).foreground;
        let gains: Vec<f64> = fused
            .iter()
            .zip(before.texels())
            .map(|(after, before)| match luminance(*before) {
                b if b > 0.0 => f64::from(luminance(*after) / b),
                _ => 1.0,
            })
            .collect();
        let area = |k: usize| before.solid_angle(k / width);
        for lobe in &mut lobes {
            let unit = SphericalGaussian {
                radiance: Vec3::ONE,
                ..*lobe
            };
            let (mut gained, mut total) = (0.0, 0.0);
            for (k, t) in raster.rasterize(&[unit]).texels().iter().enumerate() {
                let weight = f64::from(t.x) * area(k);
                gained += weight * gains[k];
                total += weight;
            }
            if total > 0.0 {
                lobe.radiance *= (gained / total) as f32;
            }
        }
        let after = raster.rasterize(&lobes);
        let (mut apart, mut total) = (0.0, 0.0);
        for (k, (a, b)) in after.texels().iter().zip(&fused).enumerate() {
            let (a, b) = (luminance_f64(a.as_dvec3()), luminance_f64(b.as_dvec3()));
            apart += (a - b).abs() * area(k);
            total += b * area(k);
        }
        Self {
            exposure: 1.0,
            lobes,
            fusion_residual: if total > 0.0 { apart / total } else { 0.0 },
            sources: 0,
        }
    }

    /// The lobes on the photograph's scale.
    pub fn exposed_lobes(&self) -> Vec<SphericalGaussian> {
        let exposed = |lobe: &SphericalGaussian| SphericalGaussian {
            radiance: lobe.radiance * self.exposure,
            ..*lobe
        };
        self.lobes.iter().map(exposed).collect()
    }

    /// The light as a map on the photograph's scale.
    pub fn map(&self, width: usize, height: usize) -> EnvironmentMap {
        rasterize(&self.exposed_lobes(), width, height)
    }

    /// The direction from which most radiance comes; `None` without light.
    ///
    /// At a maximum of a sum of lobes the gradient `sum of c exp(...) mu / sigma^2` is parallel to
    /// the direction; iterating that from every lobe climbs to a maximum each time, and the
    /// highest is returned.
    pub fn peak_direction(&self) -> Option<Vec3> {
        let at = |d: DVec3, g: &SphericalGaussian| {
            let t = 0.5 * (d - g.direction.as_dvec3()).length_squared();
            let s2 = f64::from(g.sigma) * f64::from(g.sigma);
            luminance_f64(g.radiance.as_dvec3()) * (-t / s2).exp()
        };
        let climb = |start: &SphericalGaussian| {
            let mut d = start.direction.as_dvec3();
            for _ in 0..CLIMB_STEPS {
                let pull = |g: &SphericalGaussian| {
                    let s2 = f64::from(g.sigma) * f64::from(g.sigma);
                    g.direction.as_dvec3() * (at(d, g) / s2)
                };
                let next: DVec3 = self.lobes.iter().map(pull).sum();
                d = next.try_normalize().unwrap_or(d);
            }
            let height: f64 = self.lobes.iter().map(|g| at(d, g)).sum();
            (d, height)
        };
        let tops = self.lobes.iter().map(climb);
        let best = tops.max_by(|a, b| a.1.total_cmp(&b.1));
        best.filter(|b| b.1 > 0.0).map(|b| b.0.as_vec3())
    }

    /// Reads `lighting.json` and checks every lobe.
    pub fn read(path: &Path) -> Result<Self, OptimizeError> {
        let text = std::fs::read(path).map_err(|e| OptimizeError::io("read", path, e))?;
        let bad = |detail: String| OptimizeError::BadFile {
            path: path.into(),
            detail,
            remedy: "correct it, or run dipir-light again",
        };
        let mut light: Self = serde_json::from_slice(&text)
            .map_err(|e| bad(format!("is no recovered light: {e}")))?;
        if !(light.exposure > 0.0 && light.exposure.is_finite()) {
            return Err(bad(format!(
                "has an exposure of {}, which must be above 0",
                light.exposure
            )));
        }
        for (k, lobe) in light.lobes.iter_mut().enumerate() {
            *lobe = lobe
                .checked(k)
                .map_err(|e| bad(format!("has a bad lobe: {e}")))?;
        }
        Ok(light)
    }
}

/// Steps of the climb to a maximum: each gains a constant factor, 1 minus the ratio of the
/// neighbours' pull to the lobe's own.
const CLIMB_STEPS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn lobe(direction: Vec3, radiance: f32, sigma: f32) -> SphericalGaussian {
        SphericalGaussian {
            direction: direction.normalize(),
            radiance: Vec3::splat(radiance),
            sigma,
        }
    }

    fn light(lobes: Vec<SphericalGaussian>) -> Lighting {
        Lighting {
            sources: 0,
            exposure: 1.0,
            lobes,
            fusion_residual: 0.0,
        }
    }

    #[test]
    fn the_peak_is_the_brightest_point_of_the_sum_not_the_brightest_lobe() {
        // Two overlapping lobes outshine a single one that is brighter than either.
        let (a, b) = (Vec3::new(0.05, 1.0, 0.0), Vec3::new(-0.05, 1.0, 0.0));
        let sum = light(vec![
            lobe(Vec3::X, 1.5, 0.3),
            lobe(a, 1.0, 0.3),
            lobe(b, 1.0, 0.3),
        ]);
        let peak = sum.peak_direction().unwrap();
        assert!(peak.distance(Vec3::Y) < 1e-4, "{peak}");
        assert_eq!(light(vec![]).peak_direction(), None);
        assert_eq!(light(vec![lobe(Vec3::X, 0.0, 0.3)]).peak_direction(), None);
    }

    #[test]
    fn sets_that_agree_are_delivered_as_they_are() {
        let parameters = Parameters::neutral(8, 0.5);
        let light = Lighting::of(&parameters, 32, 16);
        for (a, b) in light.lobes.iter().zip(parameters.foreground_lobes()) {
            assert_eq!(a.direction, b.direction);
            assert!((a.radiance / b.radiance - 1.0).abs().max_element() < 1e-6);
        }
        assert!(light.fusion_residual < 1e-6);
    }

    #[test]
    fn lobes_carry_the_energy_of_the_fused_map() {
        let mut parameters = Parameters::neutral(8, 0.5);
        parameters.shadow[5].log_radiance += 2.0;
        let light = Lighting::of(&parameters, 64, 32);
        let map = |lobes: &[SphericalGaussian]| rasterize(lobes, 64, 32);
        let [f, s] = [parameters.foreground_lobes(), parameters.shadow_lobes()];
        let fused = fuse(map(&f).texels(), map(&s).texels(), 1.0).foreground;
        let fused = EnvironmentMap::new(64, 32, fused).unwrap();
        let ratio = luminance_f64(light.map(64, 32).integral()) / luminance_f64(fused.integral());
        // Texels are f32.
        assert!((ratio - 1.0).abs() < 1e-5, "{ratio}");
        assert!(
            light.fusion_residual > 1e-3,
            "and the map is not a sum of these lobes"
        );
    }

    #[test]
    fn files_come_back_and_bad_ones_are_refused_with_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lighting.json");
        let good = light(vec![lobe(Vec3::new(1.0, 2.0, 3.0), 0.1, 0.2)]);
        std::fs::write(&path, serde_json::to_string(&good).unwrap()).unwrap();
        let back = Lighting::read(&path).unwrap();
        assert!(back.lobes[0].direction.distance(good.lobes[0].direction) < 1e-6);
        let mut bad = good.clone();
        bad.lobes[0].sigma = -1.0;
        std::fs::write(&path, serde_json::to_string(&bad).unwrap()).unwrap();
        let error = Lighting::read(&path).unwrap_err().to_string();
        assert!(error.contains("lobe 0: sigma is -1"), "{error}");
        std::fs::write(&path, "{\"exposure\": 1}").unwrap();
        let error = Lighting::read(&path).unwrap_err().to_string();
        assert!(error.contains("missing field `lobes`"), "{error}");
    }
}
