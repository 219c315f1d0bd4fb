//! What is optimised: two sets of lobes, the tone curves and an exposure.
use std::f64::consts::{PI, TAU};

use dipir_imaging::raster::LinearImage;
use dipir_imaging::tone::{TONE_PARAMETERS, ToneParameters};
use dipir_light::gaussian::{LobeGradient, LobeParameters, SphericalGaussian};
use dipir_light::luminance::luminance_f64;
use dipir_numerics::sum::Neumaier;
use glam::{DVec3, Vec3};

use crate::tensors::{Group, Tensor, Tensors};

/// Numbers in a [`SplineParameters`](dipir_imaging::spline::SplineParameters).
const SPLINE: usize = TONE_PARAMETERS / 4;

/// Everything that is optimised. Also the shape of its gradient.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// Lobes that light the object.
    pub foreground: Vec<LobeParameters>,
    /// Lobes that cast the shadow, fused with the others as the optimisation proceeds.
    pub shadow: Vec<LobeParameters>,
    /// The four tone curves.
    pub tone: ToneParameters,
    /// Natural logarithm of a factor on all lobes: one number in which the picture's brightness
    /// can change without every lobe having to.
    pub log_exposure: f64,
}

/// Where parameters are kept between steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterBounds {
    /// Natural logarithm of a lobe's radiance, exposure included.
    pub log_radiance: (f64, f64),
    /// Natural logarithm of a lobe's sigma.
    pub log_sigma: (f64, f64),
    /// Largest magnitude of a tone parameter.
    pub tone: f64,
}

impl ParameterBounds {
    /// Bounds for maps of `height` rows.
    ///
    /// Radiance from 1e-6, which no display shows, to 1e6, the sun's. Sigma from a quarter of a
    /// texel, since a texel seen from afar has a spread of .29 of its side and narrower lobes look
    /// the same, to 10, a constant to 2%. Tone parameters of 8 give a bin e^8 of another's share,
    /// beyond the least width that the curves allow.
    pub fn for_map(height: usize) -> Self {
        let narrowest = 0.25 * PI / height as f64;
        Self {
            log_radiance: (LEAST_RADIANCE.ln(), 1e6f64.ln()),
            log_sigma: (narrowest.ln(), 10f64.ln()),
            tone: 8.0,
        }
    }

    /// The same without bounds on lobes, for a light that is not to change.
    pub fn of_tone_alone(self) -> Self {
        let any = (f64::NEG_INFINITY, f64::INFINITY);
        Self {
            log_radiance: any,
            log_sigma: any,
            ..self
        }
    }
}

/// Radiance that no display shows.
const LEAST_RADIANCE: f64 = 1e-6;

/// Share of the neutral light's radiance that comes from everywhere alike; the candidates for a
/// sun hold the rest.
const AMBIENT_SHARE: f64 = 0.6;
/// Width of the lobe that stands for the ground.
const GROUND_SIGMA: f64 = 0.7;
/// Width of the lobe that comes from everywhere.
const AMBIENT_SIGMA: f64 = 10.0;

impl Parameters {
    /// Nearly uniform grey light of `radiance`, and no change of tone: a start that prefers no
    /// direction.
    ///
    /// The first lobe is wide and stays the ambient light, the second faces down and stands for
    /// the ground. The others are candidates for a sun, spread evenly over the upper
    /// hemisphere on a Fibonacci spiral and as wide as their spacing: wherever the sun is, one
    /// is near enough that brightening, turning and narrowing lead there downhill. With the
    /// default of 32 lobes they are 26 degrees apart.
    pub fn neutral(lobes: usize, radiance: f64) -> Self {
        let set = neutral_lobes(lobes.max(1), radiance);
        Self {
            foreground: set.clone(),
            shadow: set,
            tone: ToneParameters::default(),
            log_exposure: 0.0,
        }
    }

    /// A start for a light of which something is known: sky and ground of these radiances with
    /// candidates as in [`neutral`](Self::neutral), and `sun` beside them; the object's tone is
    /// [`ToneParameters::camera`], since the radiance is meant on the photograph's scale.
    pub fn from_light(
        lobes: usize,
        sky: DVec3,
        ground: DVec3,
        sun: Option<&SphericalGaussian>,
    ) -> Self {
        let mut set = neutral_lobes(lobes.max(2) - usize::from(sun.is_some()), 1.0);
        let common = sky.min(ground);
        let ambient = if set.len() > 2 { AMBIENT_SHARE } else { 1.0 };
        for lobe in &mut set {
            let factor = if lobe.log_sigma == AMBIENT_SIGMA.ln() {
                common
            } else {
                let all = if lobe.direction == DVec3::NEG_Y {
                    ground
                } else {
                    sky
                };
                (all - common * ambient) / (1.0 - ambient).max(0.1)
            };
            lobe.log_radiance += factor.max(DVec3::splat(1e-4)).map(f64::ln);
        }
        set.extend(sun.map(LobeParameters::of));
        Self {
            foreground: set.clone(),
            shadow: set,
            tone: ToneParameters::camera(),
            log_exposure: 0.0,
        }
    }

    /// A light that is known or guessed, for both sets, and no change of tone. Light below 1e-6,
    /// which no display shows, becomes that: the logarithm of none would never come back.
    pub fn of_lobes(lobes: &[SphericalGaussian]) -> Self {
        let lobe = |lobe: &SphericalGaussian| {
            let least = LEAST_RADIANCE as f32;
            LobeParameters::of(&SphericalGaussian {
                radiance: lobe.radiance.max(Vec3::splat(least)),
                ..*lobe
            })
        };
        let set: Vec<_> = lobes.iter().map(lobe).collect();
        Self {
            foreground: set.clone(),
            shadow: set,
            tone: ToneParameters::default(),
            log_exposure: 0.0,
        }
    }

    /// The lobes that light the object, exposed.
    pub fn foreground_lobes(&self) -> Vec<SphericalGaussian> {
        lobes(&self.foreground, self.log_exposure)
    }

    /// The lobes that cast the shadow, exposed.
    pub fn shadow_lobes(&self) -> Vec<SphericalGaussian> {
        lobes(&self.shadow, self.log_exposure)
    }

    /// The gradient with respect to the parameters, from those with respect to the lobes of both
    /// sets and to the tone parameters.
    pub fn vjp(
        &self,
        foreground: &[LobeGradient],
        shadow: &[LobeGradient],
        tone: ToneParameters,
    ) -> Self {
        let foreground = lobes_vjp(&self.foreground, self.log_exposure, foreground);
        let shadow = lobes_vjp(&self.shadow, self.log_exposure, shadow);
        // The exposure adds to every logarithm.
        let all = foreground.iter().chain(&shadow);
        let log_exposure = all.map(|g| g.log_radiance.element_sum()).sum();
        Self {
            foreground,
            shadow,
            tone,
            log_exposure,
        }
    }

    /// Tensors of the foreground's lobes and of the shadow's, pair by pair.
    pub const TWINS: [[&str; 2]; 3] = [
        ["foreground.log_radiance", "shadow.log_radiance"],
        ["foreground.direction", "shadow.direction"],
        ["foreground.log_sigma", "shadow.log_sigma"],
    ];

    /// Brings parameters back to where they mean something, after a step: directions to unit
    /// length, the rest within `bounds`.
    pub fn retract(&mut self, bounds: &ParameterBounds) {
        let (low, high) = bounds.log_radiance;
        self.log_exposure = self.log_exposure.clamp(low, high);
        let exposure = DVec3::splat(self.log_exposure);
        for lobe in self.foreground.iter_mut().chain(&mut self.shadow) {
            let exposed = lobe.log_radiance + exposure;
            let inside = exposed.clamp(DVec3::splat(low), DVec3::splat(high));
            if inside != exposed {
                lobe.log_radiance = inside - exposure;
            }
            lobe.log_sigma = lobe.log_sigma.clamp(bounds.log_sigma.0, bounds.log_sigma.1);
            lobe.direction = lobe.unit_direction();
        }
        let tone = self
            .tone
            .to_array()
            .map(|p| p.clamp(-bounds.tone, bounds.tone));
        self.tone = ToneParameters::from_array(&tone);
    }

    /// All numbers, by name.
    pub fn to_tensors(&self) -> Tensors {
        let tensor = |name, group, values| Tensor {
            name,
            group,
            values,
        };
        let tone = self.tone.to_array();
        let (f, s) = (&self.foreground, &self.shadow);
        Tensors(vec![
            tensor(
                "foreground.log_radiance",
                Group::Radiance,
                flat(f, |l| l.log_radiance),
            ),
            tensor(
                "foreground.direction",
                Group::Direction,
                flat(f, |l| l.direction),
            ),
            tensor("foreground.log_sigma", Group::Sigma, sigmas(f)),
            tensor(
                "shadow.log_radiance",
                Group::Radiance,
                flat(s, |l| l.log_radiance),
            ),
            tensor(
                "shadow.direction",
                Group::Direction,
                flat(s, |l| l.direction),
            ),
            tensor("shadow.log_sigma", Group::Sigma, sigmas(s)),
            tensor("tone.foreground", Group::Tone, tone[..SPLINE].to_vec()),
            tensor("tone.shadow", Group::Tone, tone[SPLINE..].to_vec()),
            tensor("exposure", Group::Exposure, vec![self.log_exposure]),
        ])
    }

    /// The reverse of [`to_tensors`](Self::to_tensors). Panics on tensors of other parameters.
    pub fn from_tensors(tensors: &Tensors) -> Self {
        let values = |name| match tensors.get(name) {
            Some(t) => t.values.as_slice(),
            None => panic!("the tensors of parameters hold `{name}`"),
        };
        let mut tone = [0.0; TONE_PARAMETERS];
        tone[..SPLINE].copy_from_slice(values("tone.foreground"));
        tone[SPLINE..].copy_from_slice(values("tone.shadow"));
        let set = |radiance, direction, sigma| {
            let (c, d) = (values(radiance), values(direction));
            let lobe = |(k, &log_sigma): (usize, &f64)| LobeParameters {
                log_radiance: DVec3::from_slice(&c[3 * k..]),
                direction: DVec3::from_slice(&d[3 * k..]),
                log_sigma,
            };
            values(sigma).iter().enumerate().map(lobe).collect()
        };
        Self {
            foreground: set(
                "foreground.log_radiance",
                "foreground.direction",
                "foreground.log_sigma",
            ),
            shadow: set(
                "shadow.log_radiance",
                "shadow.direction",
                "shadow.log_sigma",
            ),
            tone: ToneParameters::from_array(&tone),
            log_exposure: values("exposure")[0],
        }
    }
}

fn flat(lobes: &[LobeParameters], of: impl Fn(&LobeParameters) -> DVec3) -> Vec<f64> {
    lobes.iter().flat_map(|l| of(l).to_array()).collect()
}

fn sigmas(lobes: &[LobeParameters]) -> Vec<f64> {
    lobes.iter().map(|l| l.log_sigma).collect()
}

fn exposed(lobe: &LobeParameters, log_exposure: f64) -> LobeParameters {
    LobeParameters {
        log_radiance: lobe.log_radiance + log_exposure,
        ..*lobe
    }
}

fn lobes(set: &[LobeParameters], log_exposure: f64) -> Vec<SphericalGaussian> {
    set.iter()
        .map(|l| exposed(l, log_exposure).lobe())
        .collect()
}

fn lobes_vjp(
    set: &[LobeParameters],
    log_exposure: f64,
    gradients: &[LobeGradient],
) -> Vec<LobeParameters> {
    let lobes = set.iter().zip(gradients);
    lobes
        .map(|(l, g)| exposed(l, log_exposure).lobe_vjp(g))
        .collect()
}

/// Share of light that surfaces of everyday scenes reflect, about: mid-grey is .18, white paper
/// .8, and more of a photograph is dark than white.
const USUAL_ALBEDO: f64 = 0.3;

/// The radiance of uniform light under which a scene like `background` would look as bright as
/// it does on average: what is known before anything is optimised.
pub fn ambient_of(background: &LinearImage) -> f64 {
    let pixels = background.0.pixels();
    let sum: Neumaier = pixels.iter().map(|p| luminance_f64(p.as_dvec3())).collect();
    (sum.total() / pixels.len().max(1) as f64 / USUAL_ALBEDO).max(LEAST_AMBIENT)
}

/// An all but black photograph still needs light to start from: gradients of logarithms vanish
/// with the light.
const LEAST_AMBIENT: f64 = 1e-3;

/// `integral of exp(-(1 - cos) / sigma^2)` over the sphere.
fn solid_angle(sigma: f64) -> f64 {
    let s2 = sigma * sigma;
    -TAU * s2 * (-2.0 / s2).exp_m1()
}

fn neutral_lobes(count: usize, radiance: f64) -> Vec<LobeParameters> {
    let log = |c: f64| DVec3::splat(c.max(LEAST_RADIANCE).ln());
    let candidates = count.saturating_sub(2);
    let ambient = if candidates == 0 { 1.0 } else { AMBIENT_SHARE };
    let mut lobes = vec![LobeParameters {
        log_radiance: log(ambient * radiance),
        direction: DVec3::Y,
        log_sigma: AMBIENT_SIGMA.ln(),
    }];
    // What each hemisphere lacks is spread over its lobes: `share * 2 pi = lobes * solid angle`.
    let missing = (1.0 - ambient).max(0.1) * radiance * TAU;
    if count > 1 {
        lobes.push(LobeParameters {
            log_radiance: log(missing / solid_angle(GROUND_SIGMA)),
            direction: DVec3::NEG_Y,
            log_sigma: GROUND_SIGMA.ln(),
        });
    }
    let n = candidates as f64;
    // The side of a square of the hemisphere's share.
    let sigma = (TAU / n.max(1.0)).sqrt().min(1.0);
    let golden = PI * (3.0 - 5f64.sqrt());
    for k in 0..candidates {
        let y = 1.0 - (k as f64 + 0.5) / n;
        let (sin, angle) = ((1.0 - y * y).sqrt(), golden * k as f64);
        lobes.push(LobeParameters {
            log_radiance: log(missing / (n * solid_angle(sigma))),
            direction: DVec3::new(sin * angle.cos(), y, sin * angle.sin()),
            log_sigma: sigma.ln(),
        });
    }
    lobes
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_light::rasterize::rasterize;

    #[test]
    fn tensors_hold_every_number_once() {
        let mut p = Parameters::neutral(5, 0.7);
        p.log_exposure = 0.25;
        let mut tone = [0.0; TONE_PARAMETERS];
        for (k, t) in tone.iter_mut().enumerate() {
            *t = k as f64;
        }
        p.tone = ToneParameters::from_array(&tone);
        let tensors = p.to_tensors();
        assert_eq!(Parameters::from_tensors(&tensors), p);
        let count: usize = tensors.0.iter().map(|t| t.values.len()).sum();
        assert_eq!(count, 2 * 5 * 7 + TONE_PARAMETERS + 1);
    }

    #[test]
    fn the_neutral_light_has_the_asked_radiance_and_prefers_no_side() {
        for count in [1, 2, 3, 32] {
            let lobes = Parameters::neutral(count, 0.8).foreground_lobes();
            assert_eq!(lobes.len(), count);
            let map = rasterize(&lobes, 64, 32);
            let mean = map.integral().x / (4.0 * PI);
            // The wide lobe is 1% below its peak, and lobes at the horizon share their light.
            assert!((mean / 0.8 - 1.0).abs() < 0.06, "{count}: {mean}");
            if count == 32 {
                let mut sides = DVec3::ZERO;
                for (k, t) in map.texels().iter().enumerate() {
                    let d = map.direction_of(k / 64, k % 64).as_dvec3();
                    sides += d * f64::from(t.x) * map.solid_angle(k / 64);
                }
                // As a share of the light: a light from one direction alone has 1.
                let lean = sides / (map.integral().x);
                assert!(lean.abs().max_element() < 0.03, "{lean}");
            }
        }
    }

    #[test]
    fn a_known_light_comes_back_as_it_is_and_no_light_as_next_to_none() {
        let lobe = |direction, radiance, sigma| SphericalGaussian {
            direction,
            radiance,
            sigma,
        };
        let light = [
            lobe(Vec3::X, Vec3::new(1e5, 20.0, 0.3), 0.0033),
            lobe(Vec3::new(0.0, 0.6, -0.8), Vec3::ZERO, 0.5),
        ];
        let mut p = Parameters::of_lobes(&light);
        // A light that is not to change is not moved to where the optimiser would keep it.
        p.retract(&ParameterBounds::for_map(64).of_tone_alone());
        for lobes in [p.foreground_lobes(), p.shadow_lobes()] {
            assert_eq!(lobes.len(), 2);
            assert!(
                (lobes[0].radiance / light[0].radiance - 1.0)
                    .abs()
                    .max_element()
                    < 1e-6
            );
            assert!((lobes[0].sigma / 0.0033 - 1.0).abs() < 1e-6);
            assert!(lobes[1].direction.distance(light[1].direction) < 1e-6);
            assert!((lobes[1].radiance.x / 1e-6 - 1.0).abs() < 1e-5);
        }
        assert_eq!(p.to_tensors().first_not_finite(), None);
    }

    #[test]
    fn a_step_too_far_is_brought_back_and_one_inside_is_left_alone() {
        let bounds = ParameterBounds::for_map(64);
        let mut p = Parameters::neutral(3, 1.0);
        p.log_exposure = 0.5;
        p.retract(&bounds);
        let before = p.clone();
        p.retract(&bounds);
        assert_eq!(p, before);
        p.foreground[0].log_radiance = DVec3::new(1e9, -1e9, 0.0);
        p.foreground[1].direction = DVec3::new(0.0, 3.0, 4.0);
        p.shadow[2].log_sigma = -50.0;
        p.retract(&bounds);
        let exposed = p.foreground[0].log_radiance + p.log_exposure;
        assert!(
            (exposed - DVec3::new(1e6f64.ln(), 1e-6f64.ln(), 0.5))
                .abs()
                .max_element()
                < 1e-12
        );
        assert!(
            p.foreground[1]
                .direction
                .distance(DVec3::new(0.0, 0.6, 0.8))
                < 1e-15
        );
        assert_eq!(p.shadow[2].log_sigma, bounds.log_sigma.0);
    }
}
