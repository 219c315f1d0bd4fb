//! What people and clocks know of the sun, as one more factor of the distribution.
use dipir_light::gaussian::SphericalGaussian;
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::estimate::{Interval, LightEstimate};
use crate::grid::{BINS, bin_direction, direction};
use crate::posterior::{PeakPosterior, words};

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
/// A sun is a source with at least this share of all light.
const LEAST_SHARE: f64 = 0.2;
/// Share of a sun that somebody saw, if the photograph says no more: the mean over those of the panoramas learned from that
/// have a fifth of their light within 4 degrees of the brightest texel (16 of 64, .22 to .95).
const MEAN_SHARE: f64 = 0.54;
/// A source that is there is at most this many times as strong as it is expected to be.
const MOST_ENERGY: f64 = 4.0;
/// Standard deviations to either side that hold 80% of a normal variable.
const NORMAL_80: f64 = 1.2816;
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

impl KnownAngle {
    /// The middle 80%, turned by `turn_deg`.
    fn interval(&self, turn_deg: f64) -> Interval {
        let (deg, half) = (self.deg + turn_deg, NORMAL_80 * self.sigma_deg);
        Interval::new(deg - half, deg, deg + half)
    }
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
    /// Whether it is known to shine: somebody saw it or a shadow that it casts. A clock does not know of clouds.
    pub shines: bool,
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
    /// The estimate, conditioned on what is known of the sun.
    pub fn knowing(&self, sun: &KnownSun) -> Self {
        let mut known = self.clone();
        if sun.elevation.is_some_and(|e| e.deg < SET_DEG) {
            known.peak = [0.0; 3];
            known.sun_probability = 0.0;
            return known.described();
        }
        let weight = |k: usize| {
            let (azimuth, elevation) = angles_deg(bin_direction(k));
            if sun.shines && elevation < SET_DEG {
                return 0.0;
            }
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
        if sun.shines {
            known = known.shining();
        }
        if let Some(share) = sun.share {
            known.set_share(share);
            known.share = Interval::new(share, share, share);
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
            known = known.described();
            // A bin is wider than what is known.
            known.words = words(seen);
            let turn = (azimuth.deg + 180.0).rem_euclid(360.0) - 180.0 - azimuth.deg;
            known.azimuth_deg = azimuth.interval(turn);
            known.elevation_deg = elevation.interval(0.0);
            return known;
        }
        known.described()
    }

    /// The estimate, if the strongest source is a sun.
    pub(crate) fn shining(&self) -> Self {
        let mut shining = self.clone();
        let energy = (1.0 / self.sun_probability.max(1e-3)).min(MOST_ENERGY) as f32;
        shining.peak = self.peak.map(|p| p * energy);
        shining.sun_probability = 1.0;
        // The smooth part holds the light of suns whose direction the photograph did not tell.
        if shining.source_share() < MEAN_SHARE {
            shining.set_share(MEAN_SHARE);
        }
        let Interval { low, middle, high } = self.share;
        let [low, middle, high] = [low, middle, high].map(|s| s.max(LEAST_SHARE));
        shining.share = Interval::new(low, middle, high);
        shining
    }

    /// The strongest source's share of all light.
    fn source_share(&self) -> f64 {
        let source = Vec3::from(self.peak).as_dvec3().element_sum();
        let total = source + self.base_map().integral().element_sum();
        if total > 0.0 { source / total } else { 0.0 }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{AZIMUTHS, BASE_TEXELS};

    /// Grey light with a reddish source that may stand anywhere, seen by a camera that looks 70 degrees to the right.
    fn open() -> LightEstimate {
        let unknown = Interval::new(0.0, 0.5, 1.0);
        LightEstimate {
            heading_rad: 70f64.to_radians(),
            reference: 0.3,
            base: vec![[0.4, 0.5, 0.6]; BASE_TEXELS],
            peak: [2.0, 1.5, 1.0],
            posterior: PeakPosterior::uniform(),
            sun_probability: 0.7,
            exposure_stops: unknown,
            share: unknown,
            azimuth_deg: unknown,
            elevation_deg: unknown,
            words: String::new(),
            source: None,
        }
        .described()
    }

    fn angle(deg: f64, sigma_deg: f64) -> Option<KnownAngle> {
        Some(KnownAngle { deg, sigma_deg })
    }

    #[test]
    fn a_known_direction_becomes_a_source_with_the_expected_energy() {
        let sun = KnownSun {
            azimuth: angle(-40.0, 5.0),
            elevation: angle(35.0, 1.0),
            ..KnownSun::default()
        };
        let known = open().knowing(&sun);
        let lobe = known.source_lobe().unwrap();
        let world = direction(30f32.to_radians(), 35f32.to_radians());
        assert!(lobe.direction.distance(world) < 1e-5, "{}", lobe.direction);
        let energy = lobe.radiance * lobe.solid_angle() as f32;
        assert!(energy.distance(Vec3::new(2.0, 1.5, 1.0)) < 1e-4, "{energy}");
        // The photograph looks sunny, so the lobe is as wide as the sun.
        assert!((lobe.sigma.to_degrees() - 0.135).abs() < 1e-3);
        let lobes = known.lobes(8);
        assert!(lobes[0] == lobe && lobes.len() <= 8);
    }

    #[test]
    fn a_sun_that_casts_a_shadow_is_not_below_the_horizon() {
        let sun = KnownSun {
            azimuth: angle(20.0, 3.0),
            shines: true,
            ..KnownSun::default()
        };
        let known = open().knowing(&sun);
        let low = &known.posterior.weights[..AZIMUTHS];
        assert!(low.iter().all(|w| *w == 0.0), "{low:?}");
        let all = known.candidates(8);
        let mut suns = all.iter().filter_map(|c| c.direction);
        assert!(suns.all(|d| d.y > 0.0));
        let seen = KnownSun {
            shines: false,
            ..sun
        };
        assert!(open().knowing(&seen).posterior.weights[1] > 0.0);
    }

    #[test]
    fn a_sun_that_somebody_saw_is_as_strong_and_as_sharp_as_a_sun() {
        let hazy = LightEstimate {
            sun_probability: 0.4,
            ..open()
        };
        let mut sun = KnownSun {
            azimuth: angle(-200.0, 3.0),
            elevation: angle(31.0, 3.0),
            ..KnownSun::default()
        };
        let energy = |e: &LightEstimate| {
            let lobe = e.source_lobe().unwrap();
            (lobe.radiance.x * lobe.solid_angle() as f32, lobe.sigma)
        };
        let by_clock = hazy.knowing(&sun);
        sun.shines = true;
        let seen = hazy.knowing(&sun);
        assert_eq!((by_clock.sun_probability, seen.sun_probability), (0.4, 1.0));
        let (expected, wide) = energy(&by_clock);
        let (there, narrow) = energy(&seen);
        assert!((seen.source_share() - MEAN_SHARE).abs() < 1e-4);
        // It is 2.5 times as strong as expected, 4.5 in all channels, before light moves to it.
        let all = |e: &LightEstimate| {
            let source = Vec3::from(e.peak).as_dvec3().element_sum();
            source + e.base_map().integral().element_sum()
        };
        // Maps are sums of some thousand f32 texels.
        assert!((all(&seen) - all(&by_clock) - 1.5 * 4.5).abs() < 1e-3 * all(&seen));
        assert!(there > 2.5 * expected);
        assert!((wide / narrow - 10.0 / 0.27).abs() < 1e-3);
        assert!(seen.share.low >= 0.2);
        // The words and the intervals are what is known, not what bins of 15 degrees hold.
        assert_eq!(seen.words, "from behind, 31 degrees high");
        assert!((seen.azimuth_deg.middle - 160.0).abs() < 1e-9);
        assert!(seen.elevation_deg.high - seen.elevation_deg.low < 7.7);
        // Other suns are not possible, nor is light without one.
        let [only] = &seen.candidates(8)[..] else {
            panic!("{:?}", seen.candidates(8).len())
        };
        let source = seen.source.unwrap();
        assert_eq!(
            (only.direction, only.probability),
            (Some(source.direction), 1.0)
        );
        assert_eq!(only.lobes[0], seen.source_lobe().unwrap());
        // A clock knows where the sun is, and not whether it shines.
        assert_eq!(by_clock.candidates(1).len(), 1);
        let [soft, sunny] = &by_clock.candidates(8)[..] else {
            panic!("{:?}", by_clock.candidates(8).len())
        };
        assert_eq!(
            (soft.direction, sunny.direction),
            (None, Some(source.direction))
        );
        assert!((sunny.probability - 0.4).abs() < 1e-9);
        // Who chooses the sun among the candidates sees it.
        let close = |a: Vec3, b: Vec3| a.distance(b) < 1e-3 * b.length();
        let lobe = |l: &SphericalGaussian| l.radiance * l.solid_angle() as f32;
        assert!(close(lobe(&sunny.lobes[0]), Vec3::from(seen.peak)));
        let bright = |c: &crate::Candidate| c.map.integral().as_vec3();
        assert!(close(bright(sunny), bright(only)));
    }

    #[test]
    fn a_direction_that_is_known_badly_is_no_source_of_its_own() {
        let sun = KnownSun {
            azimuth: angle(-40.0, 20.0),
            elevation: angle(35.0, 1.0),
            ..KnownSun::default()
        };
        let known = open().knowing(&sun);
        assert!(known.source.is_none());
        assert!(known.azimuth_deg.holds(-40.0), "{:?}", known.azimuth_deg);
    }

    #[test]
    fn an_elevation_alone_narrows_the_elevation() {
        let before = open();
        let sun = KnownSun {
            elevation: angle(42.0, 2.0),
            ..KnownSun::default()
        };
        let after = before.knowing(&sun);
        let length = |e: &LightEstimate| e.elevation_deg.high - e.elevation_deg.low;
        // The bin around 42 degrees spans 32 to 52, of which the middle 80% are 16.
        assert!(length(&before) > 60.0 && length(&after) < 17.0);
        assert!(after.elevation_deg.holds(42.0) && after.source.is_none());
        // Azimuths are as open as before.
        for p in after.posterior.azimuths() {
            assert!((p - 1.0 / 24.0).abs() < 1e-4, "{p}");
        }
    }

    #[test]
    fn a_sun_that_has_set_lights_nothing() {
        let sun = KnownSun {
            azimuth: angle(10.0, 1.0),
            elevation: angle(-3.0, 1.0),
            ..KnownSun::default()
        };
        let known = open().knowing(&sun);
        assert_eq!((known.peak, known.sun_probability), ([0.0; 3], 0.0));
        assert!(known.source_lobe().is_none());
        assert_eq!(known.map(), known.base_map());
    }

    #[test]
    fn a_known_share_is_reached_and_the_light_stays_as_bright() {
        let total = |e: &LightEstimate| e.map().integral().element_sum();
        let before = open();
        for share in [0.0, 0.3, 0.6, 0.95] {
            let sun = KnownSun {
                share: Some(share),
                ..KnownSun::default()
            };
            let after = before.knowing(&sun);
            let found = after.source_share();
            assert!((found - share).abs() < 1e-4, "{share}: {found}");
            // Maps are sums of some thousand f32 texels.
            assert!((total(&after) / total(&before) - 1.0).abs() < 1e-3);
            assert!(after.share.holds(share));
        }
    }

    #[test]
    fn what_is_known_never_makes_an_estimate_that_is_no_number() {
        let black = LightEstimate {
            base: vec![[0.0; 3]; BASE_TEXELS],
            peak: [0.0; 3],
            ..open()
        };
        for before in [open(), black] {
            for deg in [-1e6, -180.0, 0.0, 90.0, 180.0, 720.0] {
                for sigma in [0.0, 3.0, 1e9] {
                    for share in [0.0, 1.0] {
                        let sun = KnownSun {
                            azimuth: angle(deg, sigma),
                            elevation: angle(deg.clamp(-0.5, 90.0), sigma),
                            radius_deg: Some(0.27),
                            share: Some(share),
                            shines: share > 0.5,
                        };
                        let after = before.knowing(&sun);
                        let weights: f32 = after.posterior.weights.iter().sum();
                        assert!((weights - 1.0).abs() < 1e-4, "{sun:?}");
                        assert!(after.map().integral().is_finite(), "{sun:?}");
                        let lobes = after.lobes(4);
                        assert!(lobes.iter().all(|l| l.radiance.is_finite()), "{sun:?}");
                    }
                }
            }
        }
    }
}
