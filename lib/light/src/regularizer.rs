//! What keeps the two environment maps of the optimisation together and the shadow's sparse
//! [DiPIR, ECCV 2024, eqs. 10 and 11]. Sums run over texels weighted by solid angle, in f64.
use std::f64::consts::PI;

use dipir_numerics::sum::Neumaier;
use glam::{DVec3, Vec3};

use crate::environment::solid_angle;
use crate::luminance::{REC709, luminance_f64};

/// Share of a uniform density that [`consistency`] mixes into the foreground's, which bounds its
/// logarithm from below by -12 where the foreground is black.
pub const UNIFORM_SHARE: f64 = 1e-4;

fn texels_with_area(
    texels: &[Vec3],
    width: usize,
    height: usize,
) -> impl Iterator<Item = (&Vec3, f64)> {
    assert_eq!(texels.len(), width * height, "texels");
    let rows = texels.chunks(width).enumerate();
    rows.flat_map(move |(i, row)| {
        let area = solid_angle(width, height, i);
        row.iter().map(move |t| (t, area))
    })
}

/// The Cauchy regulariser: `sum over texels and channels of ln(1 + 2 L^2)` times solid angle.
/// Close to `2 L^2` for dim light and to `2 ln L` for bright light: it lowers ambient light
/// more than peaks. Panics unless there are `width * height` texels.
pub fn cauchy(texels: &[Vec3], width: usize, height: usize) -> f64 {
    let term = |l: f64| (2.0 * l * l).ln_1p();
    let terms = texels_with_area(texels, width, height).map(|(t, area)| {
        let l = t.as_dvec3();
        area * (term(l.x) + term(l.y) + term(l.z))
    });
    terms.collect::<Neumaier>().total()
}

/// The derivative of `adjoint * cauchy(...)` with respect to every texel.
pub fn cauchy_vjp(texels: &[Vec3], width: usize, height: usize, adjoint: f64) -> Vec<Vec3> {
    texels_with_area(texels, width, height)
        .map(|(t, area)| {
            let l = t.as_dvec3();
            (adjoint * area * 4.0 * l / (1.0 + 2.0 * l * l)).as_vec3()
        })
        .collect()
}

/// Luminance per texel with its solid angle, and the luminance integrated over the sphere.
fn luminances(texels: &[Vec3], width: usize, height: usize) -> (Vec<(f64, f64)>, f64) {
    let all: Vec<_> = texels_with_area(texels, width, height)
        .map(|(t, area)| (luminance_f64(t.as_dvec3()), area))
        .collect();
    let total = all.iter().map(|(l, area)| l * area).collect::<Neumaier>();
    (all, total.total())
}

/// Consistency of the two maps: `-sum of shadow ln(foreground)` times solid angle, of luminances
/// normalised to densities (each integrates to 1 over the sphere). As a cross entropy it is least
/// where both are equal.
///
/// The foreground's density is mixed with [`UNIFORM_SHARE`] of a uniform one, so that a black
/// texel costs a finite amount and has a finite derivative. A black shadow map asks for nothing:
/// the value is 0. A black foreground counts as uniform. Panics unless both maps have
/// `width * height` texels.
pub fn consistency(foreground: &[Vec3], shadow: &[Vec3], width: usize, height: usize) -> f64 {
    let (f, f_total) = luminances(foreground, width, height);
    let (s, s_total) = luminances(shadow, width, height);
    if s_total <= 0.0 {
        return 0.0;
    }
    let terms = f
        .iter()
        .zip(&s)
        .map(|(&(f, area), &(s, _))| -s * area / s_total * mixed_density(f, f_total).0.ln());
    terms.collect::<Neumaier>().total()
}

/// The mixed density of a texel, and the density before mixing.
fn mixed_density(luminance: f64, total: f64) -> (f64, f64) {
    let uniform = 1.0 / (4.0 * PI);
    let density = if total > 0.0 {
        luminance / total
    } else {
        uniform
    };
    (
        (1.0 - UNIFORM_SHARE) * density + UNIFORM_SHARE * uniform,
        density,
    )
}

/// The derivative of `adjoint * consistency(...)` with respect to every texel of the foreground;
/// the shadow is held constant (its side is detached). All 0 where either map is black.
pub fn consistency_vjp(
    foreground: &[Vec3],
    shadow: &[Vec3],
    width: usize,
    height: usize,
    adjoint: f64,
) -> Vec<Vec3> {
    let (f, f_total) = luminances(foreground, width, height);
    let (s, s_total) = luminances(shadow, width, height);
    if s_total <= 0.0 || f_total <= 0.0 {
        return vec![Vec3::ZERO; foreground.len()];
    }
    let mut to_total = Neumaier::default();
    let to_density: Vec<f64> = f
        .iter()
        .zip(&s)
        .map(|(&(f, area), &(s, _))| {
            let (mixed, density) = mixed_density(f, f_total);
            let d = -adjoint * s * area / s_total * (1.0 - UNIFORM_SHARE) / mixed;
            to_total.add(d * density);
            d
        })
        .collect();
    let to_total = to_total.total();
    let weights: DVec3 = REC709.as_dvec3();
    let texel = |(d, &(_, area)): (&f64, &(f64, f64))| {
        (weights * ((d - area * to_total) / f_total)).as_vec3()
    };
    to_density.iter().zip(&f).map(texel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{speckled, uniform};
    use dipir_numerics::gradcheck::central_difference;

    const W: usize = 8;
    const H: usize = 4;

    /// Texels with one channel replaced, in f64: the losses again, by their definition.
    fn losses(f: &[DVec3], s: &[DVec3]) -> (f64, f64) {
        let area = |k: usize| solid_angle(W, H, k / W);
        let total =
            |x: &[DVec3]| -> f64 { (0..x.len()).map(|k| luminance_f64(x[k]) * area(k)).sum() };
        let (ft, st) = (total(f), total(s));
        let mut sums = (0.0, 0.0);
        for k in 0..f.len() {
            let density = luminance_f64(f[k]) / ft;
            let mixed = (1.0 - UNIFORM_SHARE) * density + UNIFORM_SHARE / (4.0 * PI);
            sums.0 -= luminance_f64(s[k]) / st * mixed.ln() * area(k);
            let l = f[k];
            sums.1 += area(k)
                * ((1.0 + 2.0 * l * l).x.ln()
                    + (1.0 + 2.0 * l * l).y.ln()
                    + (1.0 + 2.0 * l * l).z.ln());
        }
        sums
    }

    fn maps() -> (Vec<Vec3>, Vec<Vec3>) {
        let f = speckled(W, H).texels().to_vec();
        let s = (0..W * H).map(|k| Vec3::splat(uniform(k as u32 + 77).x));
        (f, s.collect())
    }

    #[test]
    fn values_and_gradients_agree_with_the_definitions_in_f64() {
        let (f, s) = maps();
        let wide = |x: &[Vec3]| x.iter().map(|t| t.as_dvec3()).collect::<Vec<_>>();
        let (fd, sd) = (wide(&f), wide(&s));
        let exact = losses(&fd, &sd);
        assert!((consistency(&f, &s, W, H) / exact.0 - 1.0).abs() < 1e-12);
        assert!((cauchy(&f, W, H) / exact.1 - 1.0).abs() < 1e-12);
        let by_consistency = consistency_vjp(&f, &s, W, H, 0.03);
        let by_cauchy = cauchy_vjp(&f, W, H, 0.01);
        for k in 0..f.len() {
            for c in 0..3 {
                let moved = |v: f64| {
                    let mut x = fd.clone();
                    x[k][c] = v;
                    losses(&x, &sd)
                };
                let h = 1e-5 * fd[k][c].max(1e-2);
                let pairs = [
                    (
                        by_consistency[k][c],
                        0.03 * central_difference(|v| moved(v).0, fd[k][c], h),
                    ),
                    (
                        by_cauchy[k][c],
                        0.01 * central_difference(|v| moved(v).1, fd[k][c], h),
                    ),
                ];
                for (ours, numeric) in pairs {
                    // Differences of sums near 1 and 100 are right to 1e-16 / h.
                    let close = (f64::from(ours) - numeric).abs() < 1e-5 * numeric.abs() + 1e-9;
                    assert!(close, "texel {k} channel {c}: {ours} against {numeric}");
                }
            }
        }
    }

    #[test]
    fn consistency_is_least_where_the_maps_agree() {
        let (f, s) = maps();
        let same = consistency(&s, &s, W, H);
        assert!(same < consistency(&f, &s, W, H));
        let brighter: Vec<_> = s.iter().map(|t| *t * 50.0).collect();
        assert!((consistency(&brighter, &s, W, H) - same).abs() < 1e-6);
        let gradient = consistency_vjp(&s, &s, W, H, 1.0);
        // The mixed-in uniform share moves the minimum by its size.
        assert!(gradient.iter().all(|g| g.abs().max_element() < 1e-3));
    }

    #[test]
    fn black_texels_and_maps_and_suns_stay_finite() {
        let black = vec![Vec3::ZERO; W * H];
        let mut sun = black.clone();
        sun[5] = Vec3::splat(1e6);
        let mut other = black.clone();
        other[20] = Vec3::splat(1e30);
        for f in [&black, &sun, &other] {
            assert!(cauchy(f, W, H).is_finite());
            assert!(cauchy_vjp(f, W, H, 1.0).iter().all(|g| g.is_finite()));
            for s in [&black, &sun, &other] {
                assert!(consistency(f, s, W, H).is_finite());
                let gradient = consistency_vjp(f, s, W, H, 1.0);
                assert!(gradient.iter().all(|g| g.is_finite()), "{gradient:?}");
            }
        }
        assert_eq!(consistency(&sun, &black, W, H), 0.0);
        assert_eq!(cauchy(&black, W, H), 0.0);
    }

    #[test]
    fn black_texels_and_maps_have_the_value_and_slope_of_the_definition() {
        let (mut f, mut s) = maps();
        for k in [0, 9, 31] {
            f[k] = Vec3::ZERO;
        }
        for k in [9, 17] {
            s[k] = Vec3::ZERO;
        }
        let wide = |x: &[Vec3]| x.iter().map(|t| t.as_dvec3()).collect::<Vec<_>>();
        let (fd, sd) = (wide(&f), wide(&s));
        assert!((consistency(&f, &s, W, H) / losses(&fd, &sd).0 - 1.0).abs() < 1e-12);
        let ours = consistency_vjp(&f, &s, W, H, 0.03);
        for k in [0, 9, 31] {
            for c in 0..3 {
                let moved = |v: f64| {
                    let mut x = fd.clone();
                    x[k][c] = v;
                    losses(&x, &sd).0
                };
                // The step moves a density of 8e-6 by up to 2e-8: a third of the squared quotient,
                // 2e-6, is truncated. Rounding is 1e-15 over the step, times the weight.
                let numeric = 0.03 * central_difference(moved, 0.0, 1e-7);
                let close = (f64::from(ours[k][c]) - numeric).abs() < 1e-5 * numeric.abs() + 1e-9;
                assert!(
                    close,
                    "texel {k} channel {c}: {} against {numeric}",
                    ours[k][c]
                );
            }
        }
        // A black foreground is uniform; where it is black, the uniform share is all there is.
        let black = vec![Vec3::ZERO; W * H];
        let (mut sun, mut other) = (black.clone(), black.clone());
        (sun[5], other[20]) = (Vec3::splat(1e6), Vec3::splat(1e6));
        let sphere = (4.0 * PI).ln();
        assert!((consistency(&black, &s, W, H) - sphere).abs() < 1e-12);
        let apart = sphere - UNIFORM_SHARE.ln();
        assert!((consistency(&sun, &other, W, H) - apart).abs() < 1e-12 * apart);
        assert!(
            cauchy_vjp(&black, W, H, 1.0)
                .iter()
                .all(|g| *g == Vec3::ZERO)
        );
    }
}
