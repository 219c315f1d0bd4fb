//! Sums of spherical Gaussians that light a scene.
use dipir_numerics::warp::Frame;
use glam::{DVec3, Vec2, Vec3};

use crate::error::LightError;
use crate::gaussian::SphericalGaussian;
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance_f64;
use crate::trigonometry::{exp_nonpositive, sin_cos_turns};

/// Lobes evaluated together: one AVX register of f32.
const LANES: usize = 8;

/// Eight lobes, component by component. Unused places are black.
#[derive(Clone, Copy, Debug, Default)]
struct Block {
    x: [f32; LANES],
    y: [f32; LANES],
    z: [f32; LANES],
    /// `-1 / (2 sigma^2)`.
    falloff: [f32; LANES],
    red: [f32; LANES],
    green: [f32; LANES],
    blue: [f32; LANES],
    /// Probability of the lobe over its solid angle.
    pdf: [f32; LANES],
}

/// What sampling one lobe needs.
#[derive(Clone, Copy, Debug)]
struct LobeSampler {
    frame: Frame,
    sigma2: f32,
    /// `exp(-2 / sigma^2) - 1`.
    expm1: f32,
}

/// A sum of lobes.
///
/// A lobe is chosen by its luminance integral, then sampled exactly (it is a von Mises-Fisher
/// distribution); `pdf` is that of the mixture, so it is positive wherever `eval` is.
#[derive(Clone, Debug)]
pub struct SgMixture {
    lobes: Vec<SphericalGaussian>,
    blocks: Vec<Block>,
    samplers: Vec<LobeSampler>,
    /// Cumulative probability after each lobe; empty for a black mixture.
    cumulative: Vec<f32>,
}

impl SgMixture {
    /// The sum of `lobes`, their directions normalised. Errors name the first lobe whose
    /// radiance is negative or not finite, whose direction is zero, or whose sigma is too small.
    pub fn new(lobes: Vec<SphericalGaussian>) -> Result<Self, LightError> {
        let checked = |(k, g): (usize, SphericalGaussian)| g.checked(k);
        let lobes: Vec<_> = lobes
            .into_iter()
            .enumerate()
            .map(checked)
            .collect::<Result<_, _>>()?;
        let masses: Vec<f64> = lobes.iter().map(|g| luminance_f64(g.integral())).collect();
        let total: f64 = masses.iter().sum();
        let mut blocks = vec![Block::default(); lobes.len().div_ceil(LANES)];
        let mut samplers = Vec::with_capacity(lobes.len());
        let mut cumulative = Vec::with_capacity(lobes.len());
        let mut sum = 0.0;
        for (k, (g, mass)) in lobes.iter().zip(&masses).enumerate() {
            let probability = if total > 0.0 { mass / total } else { 0.0 };
            let sigma2 = f64::from(g.sigma) * f64::from(g.sigma);
            let (b, lane) = (&mut blocks[k / LANES], k % LANES);
            [b.x[lane], b.y[lane], b.z[lane]] = g.direction.to_array();
            [b.red[lane], b.green[lane], b.blue[lane]] = g.radiance.to_array();
            b.falloff[lane] = (-0.5 / sigma2) as f32;
            b.pdf[lane] = (probability / g.solid_angle()) as f32;
            samplers.push(LobeSampler {
                frame: Frame::from_normal(g.direction),
                sigma2: sigma2 as f32,
                expm1: (-2.0 / sigma2).exp_m1() as f32,
            });
            sum += probability;
            cumulative.push(sum as f32);
        }
        if let Some(last) = masses.iter().rposition(|&m| m > 0.0) {
            // Rounding must not leave a gap above the last lobe that has any light.
            cumulative[last..].fill(1.0);
        } else {
            cumulative.clear();
        }
        Ok(Self {
            lobes,
            blocks,
            samplers,
            cumulative,
        })
    }

    /// The lobes, directions normalised.
    pub fn lobes(&self) -> &[SphericalGaussian] {
        &self.lobes
    }

    /// Radiance integrated over the sphere, per channel.
    pub fn integral(&self) -> DVec3 {
        self.lobes.iter().map(|g| g.integral()).sum()
    }

    /// Irradiance of an unoccluded plane with unit vector `normal`, per channel.
    pub fn irradiance(&self, normal: Vec3) -> DVec3 {
        self.lobes.iter().map(|g| g.irradiance(normal)).sum()
    }

    /// Radiance from and density at the unit vector `direction`, for the price of one.
    #[inline]
    pub fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let mut sums = [[0f32; LANES]; 4];
        for b in &self.blocks {
            for k in 0..LANES {
                let (x, y, z) = (
                    direction.x - b.x[k],
                    direction.y - b.y[k],
                    direction.z - b.z[k],
                );
                let g = exp_nonpositive(b.falloff[k] * (x * x + y * y + z * z));
                sums[0][k] += b.red[k] * g;
                sums[1][k] += b.green[k] * g;
                sums[2][k] += b.blue[k] * g;
                sums[3][k] += b.pdf[k] * g;
            }
        }
        let [red, green, blue, pdf] = sums.map(|s| s.iter().sum::<f32>());
        (Vec3::new(red, green, blue), pdf)
    }

    /// Draws a direction from lobe `k` alone: `1 - cos` by inverting the lobe's cumulative
    /// distribution in `u.x`, the azimuth from `u.y`.
    #[inline]
    pub(crate) fn sample_lobe(&self, k: usize, u: Vec2) -> Vec3 {
        let lobe = &self.samplers[k];
        let t = (-lobe.sigma2 * (u.x * lobe.expm1).ln_1p()).clamp(0.0, 2.0);
        let sin = (t * (2.0 - t)).sqrt();
        let (s, c) = sin_cos_turns(u.y);
        let Frame {
            tangent,
            bitangent,
            normal,
        } = lobe.frame;
        (normal * (1.0 - t) + (tangent * c + bitangent * s) * sin).normalize()
    }
}

impl Illuminant for SgMixture {
    #[inline]
    fn eval(&self, direction: Vec3) -> Vec3 {
        self.eval_pdf(direction).0
    }

    #[inline]
    fn sample(&self, u: Vec2) -> LightSample {
        if self.cumulative.is_empty() {
            return LightSample {
                direction: Vec3::Y,
                radiance: Vec3::ZERO,
                pdf: 0.0,
            };
        }
        let k = self.cumulative.partition_point(|&c| c <= u.x);
        let k = k.min(self.lobes.len() - 1);
        let below = if k == 0 { 0.0 } else { self.cumulative[k - 1] };
        // What is left of the number that chose the lobe turns it; the whole other number
        // spreads it, where resolution matters.
        let azimuth = ((u.x - below) / (self.cumulative[k] - below)).clamp(0.0, 1.0);
        let direction = self.sample_lobe(k, Vec2::new(u.y, azimuth));
        let (radiance, pdf) = self.eval_pdf(direction);
        LightSample {
            direction,
            radiance,
            pdf,
        }
    }

    #[inline]
    fn pdf(&self, direction: Vec3) -> f32 {
        self.eval_pdf(direction).1
    }

    #[inline]
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        Self::eval_pdf(self, direction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{cell_integral, chi_squared, directions, lobe, uniform};

    #[test]
    fn samples_follow_the_density_of_the_mixture() {
        let mixtures = [
            vec![lobe(Vec3::new(0.2, 0.5, -0.9), Vec3::ONE, 10.0)],
            vec![lobe(Vec3::Y, Vec3::new(1.0, 0.5, 0.2), 0.3)],
            vec![
                lobe(Vec3::new(0.0, 0.1, -1.0), Vec3::splat(100.0), 0.1),
                lobe(Vec3::Y, Vec3::new(0.0, 0.0, 1.0), 1.0),
                lobe(Vec3::X, Vec3::ZERO, 0.5),
                lobe(Vec3::new(1.0, -2.0, 0.3), Vec3::splat(2.0), 0.6),
            ],
        ];
        for lobes in mixtures {
            let m = SgMixture::new(lobes).unwrap();
            let p = chi_squared(
                (24, 12),
                24,
                100_000,
                |u| m.sample(u).direction,
                |d| m.pdf(d),
                2e-3,
            );
            assert!(p > 1e-4, "p = {p}");
        }
    }

    #[test]
    fn a_sun_of_a_milliradian_is_drawn_at_its_own_width() {
        let axis = Vec3::new(0.3, 0.8, -0.5).normalize();
        let m = SgMixture::new(vec![lobe(axis, Vec3::splat(1e6), 1e-3)]).unwrap();
        // 1 - cos is exponential with mean sigma^2 = 1e-6; the mean of n draws has a standard
        // error of 1e-6 / sqrt(n): five of them are 2.2%.
        let n = 50_000;
        let mut mean = 0.0;
        for k in 0..n {
            let s = m.sample(uniform(k));
            mean += 0.5 * (s.direction - axis).as_dvec3().length_squared() / f64::from(n);
            let estimate = f64::from(s.radiance.x) / f64::from(s.pdf);
            assert!((estimate / m.integral().x - 1.0).abs() < 1e-5);
        }
        assert!((mean / 1e-6 - 1.0).abs() < 0.022, "{mean}");
    }

    #[test]
    fn the_sum_of_many_lobes_equals_the_sum_of_each() {
        let lobes: Vec<_> = (0..19)
            .map(|k| {
                let d =
                    crate::environment::direction_at(k as f32 / 19.0, (k as f32 * 0.37).fract());
                lobe(d, Vec3::new(k as f32, 1.0, 0.5), 0.05 + 0.2 * k as f32)
            })
            .collect();
        let m = SgMixture::new(lobes.clone()).unwrap();
        for d in directions() {
            let sum: Vec3 = lobes.iter().map(|g| g.eval(d)).sum();
            assert!((m.eval(d) - sum).abs().max_element() < 1e-5 * sum.max_element());
        }
    }

    #[test]
    fn no_lobes_and_black_lobes_give_no_sample() {
        for lobes in [vec![], vec![lobe(Vec3::X, Vec3::ZERO, 0.3)]] {
            let m = SgMixture::new(lobes).unwrap();
            assert_eq!(m.sample(Vec2::new(0.2, 0.4)).pdf, 0.0);
            assert_eq!(m.eval(Vec3::X), Vec3::ZERO);
            assert_eq!(m.pdf(Vec3::X), 0.0);
        }
    }

    #[test]
    fn the_irradiance_of_a_plane_agrees_with_quadrature_over_the_sphere() {
        for (sigma, n) in [(0.1, 1200), (0.5, 300), (10.0, 300)] {
            for d in directions() {
                let g = lobe(d, Vec3::ONE, sigma);
                let normal = Vec3::new(0.3, 0.9, -0.2).normalize();
                let (mu, s2) = (g.direction.as_dvec3(), f64::from(g.sigma).powi(2));
                let reference = cell_integral((1, 1), (0, 0), n, |w| {
                    let lobe = (-0.5 * (w - mu).length_squared() / s2).exp();
                    lobe * w.dot(normal.as_dvec3()).max(0.0)
                });
                // Midpoints miss the kink at the horizon by about the square of their step.
                let error = (g.irradiance(normal).x - reference).abs();
                assert!(error < 2e-5 + 1e-4 * reference, "{sigma} {d}: {error}");
            }
        }
    }

    #[test]
    fn a_bad_lobe_is_refused_by_place_and_field() {
        let good = lobe(Vec3::X, Vec3::ONE, 0.3);
        let cases = [
            (
                SphericalGaussian { sigma: 0.0, ..good },
                "lobe 1: sigma is 0; it must be finite and at least 0.0001 rad",
            ),
            (
                SphericalGaussian {
                    radiance: Vec3::new(1.0, -1.0, 0.0),
                    ..good
                },
                "lobe 1: radiance is [1, -1, 0]; it must be finite and not negative",
            ),
            (
                SphericalGaussian {
                    direction: Vec3::ZERO,
                    ..good
                },
                "lobe 1: direction is [0, 0, 0]; it must be a finite vector other than zero",
            ),
        ];
        for (bad, text) in cases {
            let error = SgMixture::new(vec![good, bad]).unwrap_err();
            assert_eq!(error.to_string(), text);
        }
    }
}
