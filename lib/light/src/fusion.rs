//! Fusion of the foreground's and the shadow's environment maps [DiPIR, ECCV 2024, supplement,
//! eqs. 12 to 18].
//!
//! With `a`, `b` the luminance of a texel in the foreground's and the shadow's map and `M` the
//! largest `a`, the paper writes `r = (a / M) b / (a + b)`, `l = (1 - r) a + r b`, and
//! `fused = foreground l / a`. The two quotients are 0 / 0 for black texels; together they are
//!
//! `l / a = 1 + h / M`, `h = b (b - a) / (a + b)`,
//!
//! which has none by `a`. Where `a + b = 0`, `h` is 0, its limit; where `M = 0` nothing shines in
//! the foreground and `l / a` is 1. Both maps then go towards the fused one with `s` from 0 to 1.
use glam::{DVec3, Vec3};

use crate::luminance::{REC709, luminance_f64};

/// The two maps after fusion.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused {
    /// What lights the object.
    pub foreground: Vec<Vec3>,
    /// What casts the shadow.
    pub shadow: Vec<Vec3>,
}

/// The first brightest texel and its luminance.
fn brightest(texels: &[Vec3]) -> (usize, f64) {
    let mut best = (0, 0.0);
    for (k, t) in texels.iter().enumerate() {
        let l = luminance_f64(t.as_dvec3());
        if l > best.1 {
            best = (k, l);
        }
    }
    best
}

/// `h` and its derivatives by `a` and `b`; all 0 where both luminances are, where a derivative
/// does not exist and no light could use it.
fn excess(a: f64, b: f64) -> (f64, f64, f64) {
    let sum = a + b;
    if sum <= 0.0 {
        return (0.0, 0.0, 0.0);
    }
    // Shares, so that radiance up to the end of f32 squares without harm.
    let (a, b) = (a / sum, b / sum);
    (b * (b - a) * sum, -2.0 * b * b, b * b + 2.0 * a * b - a * a)
}

/// Fuses `foreground` and `shadow`, texels of two maps of the same size, by `s` in `[0, 1]`: 0
/// leaves them as they are, 1 makes both the fused map. Panics if their sizes differ.
pub fn fuse(foreground: &[Vec3], shadow: &[Vec3], s: f32) -> Fused {
    assert_eq!(foreground.len(), shadow.len(), "texels");
    let (_, largest) = brightest(foreground);
    let s = f64::from(s);
    let fused = foreground.iter().zip(shadow).map(|(f, h)| {
        let (f, h) = (f.as_dvec3(), h.as_dvec3());
        let (excess, _, _) = excess(luminance_f64(f), luminance_f64(h));
        let gain = if largest > 0.0 {
            1.0 + excess / largest
        } else {
            1.0
        };
        let fused = f * gain;
        (f.lerp(fused, s).as_vec3(), h.lerp(fused, s).as_vec3())
    });
    let (foreground, shadow) = fused.unzip();
    Fused { foreground, shadow }
}

/// The derivative of `sum of adjoint * fuse(...)` with respect to both maps, `adjoint` holding
/// one value per output. The largest luminance passes its derivative to the first texel that
/// has it. Panics if sizes differ.
pub fn fuse_vjp(foreground: &[Vec3], shadow: &[Vec3], s: f32, adjoint: &Fused) -> Fused {
    let n = foreground.len();
    let sizes = [shadow.len(), adjoint.foreground.len(), adjoint.shadow.len()];
    assert_eq!(sizes, [n; 3], "texels");
    let (peak, largest) = brightest(foreground);
    let s = f64::from(s);
    let weights = REC709.as_dvec3();
    let mut result = Fused {
        foreground: Vec::with_capacity(n),
        shadow: Vec::with_capacity(n),
    };
    let mut by_largest = 0.0;
    for k in 0..n {
        let (f, h) = (foreground[k].as_dvec3(), shadow[k].as_dvec3());
        let (to_f, to_h) = (
            adjoint.foreground[k].as_dvec3(),
            adjoint.shadow[k].as_dvec3(),
        );
        let to_fused = (to_f + to_h) * s;
        let (excess, by_a, by_b) = excess(luminance_f64(f), luminance_f64(h));
        let (mut gain, mut d_f, mut d_h) = (1.0, DVec3::ZERO, DVec3::ZERO);
        if largest > 0.0 {
            gain += excess / largest;
            let to_gain = to_fused.dot(f) / largest;
            d_f = weights * (to_gain * by_a);
            d_h = weights * (to_gain * by_b);
            by_largest -= to_gain * excess / largest;
        }
        result
            .foreground
            .push((d_f + to_f * (1.0 - s) + to_fused * gain).as_vec3());
        result.shadow.push((d_h + to_h * (1.0 - s)).as_vec3());
    }
    if let Some(texel) = result.foreground.get_mut(peak) {
        *texel = (texel.as_dvec3() + weights * by_largest).as_vec3();
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::uniform;
    use dipir_numerics::gradcheck::central_difference;

    fn texels(n: usize, stream: u32) -> Vec<Vec3> {
        (0..n as u32)
            .map(|k| {
                let (a, b) = (uniform(stream + 2 * k), uniform(stream + 2 * k + 1));
                Vec3::new(a.x, a.y, b.x) * (3.0 * b.y)
            })
            .collect()
    }

    /// The paper's equations as written, on six numbers a texel in f64.
    fn literal(x: &[f64], s: f64) -> Vec<f64> {
        let n = x.len() / 6;
        let colour = |k: usize| DVec3::from_slice(&x[3 * k..3 * k + 3]);
        let largest = (0..n).map(|k| luminance_f64(colour(k))).fold(0.0, f64::max);
        let mut out = vec![0.0; x.len()];
        for k in 0..n {
            let (f, h) = (colour(k), colour(n + k));
            let (a, b) = (luminance_f64(f), luminance_f64(h));
            let r = (a / largest) * b / (a + b);
            let fused = f * ((1.0 - r) * a + r * b) / a;
            (fused * s + f * (1.0 - s)).write_to_slice(&mut out[3 * k..]);
            (fused * s + h * (1.0 - s)).write_to_slice(&mut out[3 * (n + k)..]);
        }
        out
    }

    fn flat(f: &[Vec3], h: &[Vec3]) -> Vec<f64> {
        let all = f.iter().chain(h);
        all.flat_map(|t| t.as_dvec3().to_array()).collect()
    }

    #[test]
    fn fusion_is_the_papers_where_that_is_defined() {
        let (f, h) = (texels(40, 100), texels(40, 900));
        for s in [0.0, 0.3, 1.0] {
            let ours = fuse(&f, &h, s);
            let exact = literal(&flat(&f, &h), s.into());
            for (a, b) in flat(&ours.foreground, &ours.shadow).iter().zip(exact) {
                assert!((a - b).abs() < 1e-6 * b.abs().max(1.0));
            }
        }
        let both = fuse(&f, &h, 1.0);
        assert_eq!(both.foreground, both.shadow);
        let none = fuse(&f, &h, 0.0);
        assert_eq!((none.foreground, none.shadow), (f, h));
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let n = 12;
        let (f, h) = (texels(n, 100), texels(n, 900));
        let y = Fused {
            foreground: texels(n, 2000),
            shadow: texels(n, 3000),
        };
        let weights = flat(&y.foreground, &y.shadow);
        let x = flat(&f, &h);
        for s in [0.25f32, 1.0] {
            let ours = fuse_vjp(&f, &h, s, &y);
            let ours = flat(&ours.foreground, &ours.shadow);
            for k in 0..x.len() {
                let loss = |v: f64| {
                    let mut moved = x.clone();
                    moved[k] = v;
                    literal(&moved, s.into())
                        .iter()
                        .zip(&weights)
                        .map(|(a, b)| a * b)
                        .sum()
                };
                let numeric = central_difference(loss, x[k], 1e-6);
                assert!(
                    (ours[k] - numeric).abs() < 1e-5 * numeric.abs().max(1.0),
                    "{s} {k}"
                );
            }
        }
    }

    #[test]
    fn black_texels_black_maps_and_bright_suns_stay_finite() {
        let black = vec![Vec3::ZERO; 4];
        let light = vec![
            Vec3::ZERO,
            Vec3::new(0.0, 1e-30, 0.0),
            Vec3::splat(1e6),
            Vec3::splat(1e30),
        ];
        let y = Fused {
            foreground: vec![Vec3::ONE; 4],
            shadow: vec![Vec3::ONE; 4],
        };
        for f in [&black, &light] {
            for h in [&black, &light] {
                for s in [0.0, 0.5, 1.0] {
                    let fused = fuse(f, h, s);
                    let gradient = fuse_vjp(f, h, s, &y);
                    for t in [
                        fused.foreground,
                        fused.shadow,
                        gradient.foreground,
                        gradient.shadow,
                    ] {
                        assert!(t.iter().all(|t| t.is_finite()), "{f:?} {h:?} {s}: {t:?}");
                    }
                }
            }
        }
        // Where the foreground has no light, neither has the fused map.
        let fused = fuse(&black, &light, 1.0);
        assert_eq!(fused.foreground, black);
        assert_eq!(fused.shadow, black);
        assert_eq!(
            fuse(&[], &[], 0.5),
            Fused {
                foreground: vec![],
                shadow: vec![]
            }
        );
    }

    #[test]
    fn black_texels_have_the_limits_of_the_papers_formula() {
        // Black in the foreground, in the shadow, in neither, in both.
        let f = [
            Vec3::ZERO,
            Vec3::new(0.5, 1.0, 2.0),
            Vec3::splat(4.0),
            Vec3::ZERO,
        ];
        let h = [Vec3::new(1.0, 3.0, 2.0), Vec3::ZERO, Vec3::ONE, Vec3::ZERO];
        let y = Fused {
            foreground: texels(4, 2000),
            shadow: texels(4, 3000),
        };
        let weights = flat(&y.foreground, &y.shadow);
        // There the paper's formula is 0 / 0, so it is taken beside: 1e-6 of light for none, which
        // moves values, and derivatives of slopes of up to 6, by as many millionths.
        let beside: Vec<f64> = flat(&f, &h).iter().map(|v| v.max(1e-6)).collect();
        for s in [0.25f32, 1.0] {
            let ours = fuse(&f, &h, s);
            let limits = literal(&beside, s.into());
            for (a, b) in flat(&ours.foreground, &ours.shadow).iter().zip(limits) {
                assert!((a - b).abs() < 1e-5, "{s}: {a} for {b}");
            }
            let ours = fuse_vjp(&f, &h, s, &y);
            for (k, ours) in flat(&ours.foreground, &ours.shadow).iter().enumerate() {
                let loss = |v: f64| {
                    let mut moved = beside.clone();
                    moved[k] = v;
                    let terms = literal(&moved, s.into());
                    terms.iter().zip(&weights).map(|(a, b)| a * b).sum()
                };
                // The step is a hundredth of the least texel: truncation 1e-11, rounding of a sum
                // of about 100 over it 1e-6.
                let numeric = central_difference(loss, beside[k], 1e-8);
                assert!(
                    (ours - numeric).abs() < 2e-5 * numeric.abs().max(1.0),
                    "{s} {k}: {ours} for {numeric}"
                );
            }
        }
        // Nothing in the foreground: the shadow fades by s, and nothing is scaled.
        let (black, s) = ([Vec3::ZERO; 4], 0.25);
        let (fused, back) = (fuse(&black, &h, s), fuse_vjp(&black, &h, s, &y));
        assert_eq!(fused.foreground, black);
        // A few roundings of numbers up to 4.
        let close = |a: Vec3, b: Vec3| a.abs_diff_eq(b, 2e-6);
        for k in 0..4 {
            assert!(close(fused.shadow[k], h[k] * (1.0 - s)));
            assert!(close(back.foreground[k], y.foreground[k] + y.shadow[k] * s));
            assert!(close(back.shadow[k], y.shadow[k] * (1.0 - s)));
        }
    }
}
