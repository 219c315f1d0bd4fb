//! Elementary functions that vectorise, and dispatch on the processor.

/// Compiles a function for AVX-512, AVX2 and the baseline, and picks one at
/// run time. The body is plain Rust that the compiler vectorises.
macro_rules! vectorized {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident : $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$meta])*
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            #[inline(always)]
            fn body($($arg: $ty),*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn avx512($($arg: $ty),*) $(-> $ret)? {
                    body($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($arg: $ty),*) $(-> $ret)? {
                    body($($arg),*)
                }
                if is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("fma")
                {
                    // SAFETY: the features were just detected.
                    return unsafe { avx512($($arg),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features were just detected.
                    return unsafe { avx2($($arg),*) };
                }
            }
            body($($arg),*)
        }
    };
}
pub(crate) use vectorized;

/// e^x to 2 ulp for x in [-87.3, 88.3]; clamped outside, so that it neither
/// overflows nor returns a denormal. NaN stays NaN.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer
    let x = if x < -87.3 { -87.3 } else { x };
    let x = if x > 88.3 { 88.3 } else { x };
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts, the first exact in products with |n| < 256.
    let r = n.mul_add(2.121_944_4e-4, n.mul_add(-0.693_359_4, x));
    // Taylor to the seventh power, whose remainder (ln2/2)^8 / 8! is 5e-9;
    // fused, so that every step is one instruction and one rounding.
    let p = r.mul_add(1.984_127e-4, 1.388_888_9e-3);
    let p = r.mul_add(p, 8.333_333_5e-3);
    let p = r.mul_add(p, 4.166_666_8e-2);
    let p = r.mul_add(p, 0.166_666_67);
    let p = r.mul_add(p, 0.5);
    let p = r.mul_add(p, 1.0);
    let p = r.mul_add(p, 1.0);
    // `shifted` holds n in its low bits.
    p * f32::from_bits(shifted.to_bits().wrapping_add(127) << 23)
}

/// The error function [Abramowitz & Stegun 1964, 7.1.26], absolute error
/// below 5e-7 in f32.
#[inline(always)]
pub(crate) fn erf(x: f32) -> f32 {
    let a = x.abs();
    let t = 1.0 / a.mul_add(0.327_591_1, 1.0);
    let p = t.mul_add(1.061_405_4, -1.453_152);
    let p = t.mul_add(p, 1.421_413_7);
    let p = t.mul_add(p, -0.284_496_74);
    let p = t.mul_add(p, 0.254_829_6);
    (1.0 - t * p * exp(-a * a)).copysign(x)
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Lanes of the fixed-order partial sums.
const LANES: usize = 16;

/// Elements summed in f32 before they go into an f64.
pub(crate) const CHUNK: usize = 1024;

/// Sum in f64 of f32 partial sums over chunks: relative error below 1e-5 of
/// the sum of magnitudes for any length.
#[inline(always)]
pub(crate) fn sum_of(values: &[f32], term: impl Fn(f32) -> f32) -> f64 {
    let mut total = 0f64;
    for chunk in values.chunks(CHUNK) {
        let mut lanes = [0f32; LANES];
        let blocks = chunk.chunks_exact(LANES);
        let rest = blocks.remainder();
        for block in blocks {
            for (lane, &value) in lanes.iter_mut().zip(block) {
                *lane += term(value);
            }
        }
        total += lanes.iter().map(|&lane| lane as f64).sum::<f64>();
        total += rest.iter().map(|&value| term(value) as f64).sum::<f64>();
    }
    total
}

/// As [`sum_of`] over two slices of equal length.
#[inline(always)]
pub(crate) fn sum_of_2(a: &[f32], b: &[f32], term: impl Fn(f32, f32) -> f32) -> f64 {
    let mut total = 0f64;
    for (a, b) in a.chunks(CHUNK).zip(b.chunks(CHUNK)) {
        let mut lanes = [0f32; LANES];
        let (blocks_a, blocks_b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
        let (rest_a, rest_b) = (blocks_a.remainder(), blocks_b.remainder());
        for (x, y) in blocks_a.zip(blocks_b) {
            for i in 0..LANES {
                lanes[i] += term(x[i], y[i]);
            }
        }
        total += lanes.iter().map(|&lane| lane as f64).sum::<f64>();
        total += rest_a
            .iter()
            .zip(rest_b)
            .map(|(&x, &y)| term(x, y) as f64)
            .sum::<f64>();
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_within_a_few_ulp_over_its_domain() {
        for i in -8730..8830 {
            let x = i as f32 * 0.01;
            let exact = (x as f64).exp();
            let relative = (exp(x) as f64 - exact).abs() / exact;
            assert!(
                relative < 4.0 * f32::EPSILON as f64,
                "exp({x}): {relative:e}"
            );
        }
        assert!(exp(f32::NAN).is_nan());
        assert!(exp(f32::NEG_INFINITY) < 2e-38 && exp(f32::INFINITY).is_finite());
    }

    #[test]
    fn erf_matches_its_series() {
        for i in -600..=600 {
            let x = i as f64 * 0.01;
            // Maclaurin series; at |x| = 6 its terms reach 1e14, hence the
            // comparison stops at 3 and only the limit is checked beyond.
            let exact = if x.abs() <= 3.0 {
                let (mut term, mut sum) = (x, x);
                for n in 1..120 {
                    term *= -x * x / n as f64;
                    sum += term / (2 * n + 1) as f64;
                }
                sum * 2.0 / std::f64::consts::PI.sqrt()
            } else {
                x.signum()
            };
            let tolerance = if x.abs() <= 3.0 { 5e-7 } else { 2.3e-5 };
            assert!((erf(x as f32) as f64 - exact).abs() < tolerance, "erf({x})");
        }
    }

    #[test]
    fn chunked_sums_keep_small_terms_beside_large_ones() {
        let n = 1_000_003;
        let values: Vec<f32> = (0..n).map(|i| if i == 0 { 1e6 } else { 0.001 }).collect();
        let exact = 1e6 + (n - 1) as f64 * 0.001f32 as f64;
        // The first lane loses up to CHUNK/LANES ulp of 1e6, 64 * 0.03.
        assert!((sum_of(&values, |x| x) - exact).abs() < 2.0);
    }
}
