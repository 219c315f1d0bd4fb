//! The reflectance of a thin film over a surface (`KHR_materials_iridescence`) [Belcour and Barla
//! 2017]: Airy's sum over bounces within the film, two terms of it, integrated over the wavelengths
//! of each channel in closed form.
use std::f32::consts::{PI, TAU};

use glam::{Mat3, Vec3};

use super::fresnel::{f0_from_ior, schlick_weight};
use crate::surface::FilmPoint;

/// Terms of Airy's sum: further ones are blurred away by the width of a channel.
const TERMS: usize = 2;

/// Films thinner than this fade out, nanometres: without thickness there is no film.
const FADING_NM: f32 = 30.0;

/// From CIE XYZ to linear Rec.709.
const XYZ_TO_REC709: Mat3 = Mat3::from_cols(
    Vec3::new(3.240_454, -0.969_266, 0.055_643_4),
    Vec3::new(-1.537_138_5, 1.876_010_8, -0.204_025_9),
    Vec3::new(-0.498_531_4, 0.041_556, 1.057_225_2),
);

/// A film over a surface that reflects `f0` without it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Film {
    /// Share of the surface that has it.
    pub factor: f32,
    ior: f32,
    thickness_nm: f32,
    /// Index of refraction below it, a channel at a time.
    base_ior: Vec3,
}

/// Sums over wavelengths of `cos(m phase)`, for a path that is longer by `opd_nm` nanometres and
/// shifted by `shift` radians, a channel at a time.
fn sensitivity(opd_nm: f32, shift: Vec3) -> Vec3 {
    // Gaussians fitted to the CIE functions in frequency [Belcour and Barla 2017].
    let phase = TAU * opd_nm * 1e-9;
    let value = Vec3::new(5.4856e-13, 4.4201e-13, 5.2481e-13);
    let position = Vec3::new(1.681e6, 1.7953e6, 2.2084e6);
    let variance = Vec3::new(4.3278e9, 9.3046e9, 6.6121e9);
    let wave = |c: usize, value: f32, position: f32, variance: f32| {
        let width = (TAU * variance).sqrt();
        let damped = (-phase * phase * variance).exp();
        value * width * (position * phase + shift[c]).cos() * damped
    };
    let mut xyz = Vec3::ZERO;
    for c in 0..3 {
        xyz[c] = wave(c, value[c], position[c], variance[c]);
    }
    // The second hump of X.
    xyz.x += wave(0, 9.747e-14, 2.2399e6, 4.5282e9);
    XYZ_TO_REC709 * (xyz / 1.0685e-7)
}

/// Index of refraction whose reflectance at normal incidence is `f0`, against air.
fn ior_from_f0(f0: f32) -> f32 {
    let root = f0.clamp(0.0, 0.9999).sqrt();
    (1.0 + root) / (1.0 - root)
}

fn from_f0(f0: f32, cosine: f32) -> f32 {
    f0 + (1.0 - f0) * schlick_weight(cosine)
}

impl Film {
    /// `None` without a film.
    pub fn new(point: &FilmPoint, f0: Vec3) -> Option<Self> {
        (point.factor > 0.0 && point.thickness_nm > 0.0).then(|| {
            let t = (point.thickness_nm / FADING_NM).clamp(0.0, 1.0);
            let fading = t * t * (3.0 - 2.0 * t);
            Self {
                factor: point.factor * fading,
                ior: point.ior,
                thickness_nm: point.thickness_nm,
                base_ior: Vec3::from(f0.to_array().map(ior_from_f0)),
            }
        })
    }

    /// Reflectance of a facet, in `[0, 1]`, at the cosine of either direction to it.
    pub fn reflectance(&self, cosine: f32) -> Vec3 {
        let sum = self.airy(cosine, TERMS, sensitivity);
        sum.clamp(Vec3::ZERO, Vec3::ONE)
    }

    /// The first `terms` of Airy's sum, each with its phase averaged by `spectrum`.
    fn airy(&self, cosine: f32, terms: usize, spectrum: impl Fn(f32, Vec3) -> Vec3) -> Vec3 {
        let sin2 = (1.0 - cosine * cosine) / (self.ior * self.ior);
        let inner = (1.0 - sin2).max(0.0).sqrt();
        let outer = from_f0(f0_from_ior(self.ior), cosine);
        let below = |base: f32| from_f0(f0_from_ior(base / self.ior), inner);
        let base = Vec3::from(self.base_ior.to_array().map(below));
        // Half a wave is lost on reflection by what is denser, and by the film from within.
        let lost = |base: f32| if base < self.ior { PI } else { 0.0 };
        let shift = Vec3::splat(PI) + Vec3::from(self.base_ior.to_array().map(lost));
        let passing = (1.0 - outer) * (1.0 - outer);
        let both = (outer * base).clamp(Vec3::splat(1e-5), Vec3::splat(0.9999));
        let within = passing * base / (Vec3::ONE - both);
        let mut sum = outer + within;
        let mut term = within - Vec3::splat(1.0 - outer);
        let root = Vec3::from(both.to_array().map(f32::sqrt));
        let opd = 2.0 * self.ior * self.thickness_nm * inner;
        for m in 1..=terms {
            term *= root;
            sum += term * 2.0 * spectrum(m as f32 * opd, m as f32 * shift);
        }
        sum
    }

    /// The least reflectance at normal incidence with which Schlick's factor lies nowhere below the
    /// film's, as far as a few angles tell, a channel at a time. Grazing angles are left out: a bound for
    /// them would darken all others.
    pub fn bound(&self) -> Vec3 {
        let at = |cosine: f32| {
            let weight = schlick_weight(cosine);
            (self.reflectance(cosine) - weight) / (1.0 - weight)
        };
        let nodes = [1.0, 0.85, 0.7, 0.55, 0.4, 0.25].map(at);
        nodes.into_iter().fold(Vec3::ZERO, Vec3::max).min(Vec3::ONE)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    fn film(ior: f32, thickness_nm: f32, f0: f32) -> Film {
        let point = FilmPoint {
            factor: 1.0,
            ior,
            thickness_nm,
        };
        Film::new(&point, Vec3::splat(f0)).unwrap()
    }

    #[test]
    fn one_wavelength_and_all_terms_give_airys_formula() {
        for (ior, nm, f0) in [(1.3, 400.0, 0.04), (1.8, 250.0, 0.04), (1.3, 620.0, 0.6)] {
            let film = film(ior, nm, f0);
            for cosine in [1.0f32, 0.8, 0.4] {
                let wave_nm = 550.0;
                let got = film.airy(cosine, 400, |opd, shift| {
                    Vec3::from(shift.to_array().map(|s| (TAU * opd / wave_nm + s).cos()))
                });
                // Amplitudes: half a wave lost is a sign.
                let sin2 = f64::from(1.0 - cosine * cosine) / f64::from(film.ior).powi(2);
                let inner = (1.0 - sin2).sqrt();
                let schlick = |ior: f64, c: f64| {
                    let f0 = ((ior - 1.0) / (ior + 1.0)).powi(2);
                    f0 + (1.0 - f0) * (1.0 - c).powi(5)
                };
                let base_ior = f64::from(film.base_ior.x) / f64::from(film.ior);
                let outer = schlick(film.ior.into(), cosine.into()).sqrt();
                let base = schlick(base_ior, inner).sqrt();
                // From outside the film is denser: a half wave; below it where the base is denser.
                let (r12, r23) = (-outer, if base_ior > 1.0 { -base } else { base });
                let phase = std::f64::consts::TAU * 2.0 * f64::from(film.ior * nm) * inner / 550.0;
                let (s, c) = phase.sin_cos();
                // |r12 + r23 e^(i phase)|^2 / |1 + r12 r23 e^(i phase)|^2
                let above = (r12 + r23 * c).powi(2) + (r23 * s).powi(2);
                let below = (1.0 + r12 * r23 * c).powi(2) + (r12 * r23 * s).powi(2);
                let exact = above / below;
                let error = (f64::from(got.x) - exact).abs();
                assert!(error < 1e-4, "{ior} {nm} {f0} {cosine}: {} {exact}", got.x);
            }
        }
    }

    /// The reflectance as the specification of `KHR_materials_iridescence` spells it out, one channel of the base.
    pub fn specified(film_ior: f64, nm: f64, f0: f64, cosine: f64) -> [f64; 3] {
        let to_f0 = |above: f64, below: f64| ((above - below) / (above + below)).powi(2);
        let schlick = |f0: f64, c: f64| f0 + (1.0 - f0) * (1.0 - c).powi(5);
        let inner = (1.0 - (1.0 - cosine * cosine) / film_ior.powi(2)).sqrt();
        let r12 = schlick(to_f0(film_ior, 1.0), cosine);
        let base_ior = (1.0 + f0.sqrt()) / (1.0 - f0.sqrt());
        let r23 = schlick(to_f0(base_ior, film_ior), inner);
        let pi = std::f64::consts::PI;
        let phi = pi + if base_ior < film_ior { pi } else { 0.0 };
        let r123 = (r12 * r23).clamp(1e-5, 0.9999);
        let rs = (1.0 - r12).powi(2) * r23 / (1.0 - r123);
        let mut sum = [r12 + rs; 3];
        let mut cm = rs - (1.0 - r12);
        for m in [1.0, 2.0] {
            cm *= r123.sqrt();
            let phase = 2.0 * pi * m * 2.0 * film_ior * nm * inner * 1e-9;
            let wave = |value: f64, position: f64, variance: f64| {
                value
                    * (2.0 * pi * variance).sqrt()
                    * (position * phase + m * phi).cos()
                    * (-variance * phase * phase).exp()
            };
            let x = wave(5.4856e-13, 1.681e6, 4.3278e9) + wave(9.747e-14, 2.2399e6, 4.5282e9);
            let y = wave(4.4201e-13, 1.7953e6, 9.3046e9);
            let z = wave(5.2481e-13, 2.2084e6, 6.6121e9);
            let rows = [
                [3.2404542, -1.5371385, -0.4985314],
                [-0.969266, 1.8760108, 0.041556],
                [0.0556434, -0.2040259, 1.0572252],
            ];
            for (c, row) in rows.iter().enumerate() {
                let s = (row[0] * x + row[1] * y + row[2] * z) / 1.0685e-7;
                sum[c] += 2.0 * cm * s;
            }
        }
        sum.map(|v| v.clamp(0.0, 1.0))
    }

    #[test]
    fn the_reflectance_is_the_specifications_in_f64() {
        for ior in [1.2, 1.3, 1.8] {
            for nm in [60.0, 180.0, 400.0, 900.0] {
                for f0 in [0.04, 0.3, 0.9] {
                    for cosine in [1.0, 0.7, 0.2] {
                        let got = film(ior, nm, f0).reflectance(cosine);
                        let exact = specified(ior.into(), nm.into(), f0.into(), cosine.into());
                        for c in 0..3 {
                            // Phases of up to 50 radians, known to 2^-24 of themselves, and two
                            // terms that weigh up to 4 together.
                            let error = (f64::from(got[c]) - exact[c]).abs();
                            assert!(error < 5e-5, "{ior} {nm} {f0} {cosine} {c}: {error}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn without_thickness_it_is_the_surface_itself() {
        for f0 in [0.04, 0.5] {
            let film = film(1.3, 0.01, f0);
            assert!(film.factor < 1e-6);
            // Two terms of the sum; and white of equal energy is (1.2, 0.95, 0.91) in Rec.709, which weighs
            // the terms of interference, a tenth of the whole.
            let error = film.reflectance(1.0) - Vec3::splat(f0);
            assert!(error.abs().max_element() < 0.03, "{f0}: {error}");
        }
    }

    #[test]
    fn thick_films_lose_their_colour() {
        // The terms of interference die out; what is left is the sum of intensities.
        let film = film(1.4, 20_000.0, 0.04);
        let reflected = film.reflectance(0.9);
        assert!(reflected.max_element() - reflected.min_element() < 1e-4);
    }
}
