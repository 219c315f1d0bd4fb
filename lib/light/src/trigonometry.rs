//! Fast elementary functions, in turns (1 turn = 2 pi) where they take or give angles.
//!
//! The coefficients are minimax fits of relative error by iteratively reweighted least squares
//! over 4001 Chebyshev nodes; each function states the error measured by its test.

/// `atan(x) / (2 pi x)` as a polynomial in `x^2` on `[0, 1]`, relative error 2.4e-9 before rounding.
const ATAN_TURNS: [f32; 10] = [
    0.159154943,
    -0.0530515686,
    0.031828229,
    -0.0226985717,
    0.0174147831,
    -0.0133329121,
    0.00915970149,
    -0.00490270323,
    0.00170724552,
    -0.000279146454,
];
/// `sin(pi x / 2) / x` in `x^2`, `|x| <= 1/2`.
const SIN_QUARTER_TURNS: [f32; 4] = [
    std::f32::consts::FRAC_PI_2,
    -0.64596346,
    0.0796800328,
    -0.00460165789,
];
/// `cos(pi x / 2)` in `x^2`, `|x| <= 1/2`.
const COS_QUARTER_TURNS: [f32; 5] = [1.0, -1.23370054, 0.253669183, -0.020859936, 0.000903362976];
/// `2^x`, `|x| <= 1/2`.
const EXP2: [f32; 7] = [
    1.0,
    0.693147206,
    0.240226469,
    0.0555032878,
    0.00961848896,
    0.00133999314,
    0.000153458118,
];

/// `a * b + c`, fused where the processor does that in one instruction.
#[inline(always)]
fn multiply_add(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(target_feature = "fma") {
        a.mul_add(b, c)
    } else {
        a * b + c
    }
}

/// Estrin's scheme: neighbouring terms in pairs, a chain of `log2 N` steps and not `N`. Each size is
/// written out: a loop over the terms, whose indices are checked where overflow is, keeps the compiler
/// from evaluating eight polynomials at once.
#[inline(always)]
fn polynomial4(&[a, b, c, d]: &[f32; 4], x: f32) -> f32 {
    let square = x * x;
    multiply_add(multiply_add(d, x, c), square, multiply_add(b, x, a))
}

/// As [`polynomial4`].
#[inline(always)]
fn polynomial5(&[a, b, c, d, e]: &[f32; 5], x: f32) -> f32 {
    let square = x * x;
    let low = polynomial4(&[a, b, c, d], x);
    multiply_add(e, square * square, low)
}

/// As [`polynomial4`].
#[inline(always)]
fn polynomial7(&[a, b, c, d, e, f, g]: &[f32; 7], x: f32) -> f32 {
    let square = x * x;
    let low = polynomial4(&[a, b, c, d], x);
    let high = multiply_add(g, square, multiply_add(f, x, e));
    multiply_add(high, square * square, low)
}

/// As [`polynomial4`].
#[inline(always)]
fn polynomial10(&[a, b, c, d, e, f, g, h, i, j]: &[f32; 10], x: f32) -> f32 {
    let square = x * x;
    let fourth = square * square;
    let low = polynomial4(&[a, b, c, d], x);
    let middle = polynomial4(&[e, f, g, h], x);
    let high = multiply_add(j, x, i);
    multiply_add(high, fourth * fourth, multiply_add(middle, fourth, low))
}

/// Angle of `(x, y)` in turns, in `[0, 1)`, counted from +x towards +y; 0 at the origin.
/// Absolute error below 7e-8 turns (4e-7 rad).
#[inline(always)]
pub(crate) fn atan2_turns(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (long, short) = (ax.max(ay), ax.min(ay));
    // At the origin 0 / tiny is 0.
    let slope = short / long.max(f32::MIN_POSITIVE);
    let turns = slope * polynomial10(&ATAN_TURNS, slope * slope);
    // Reflections, as a sign and an offset each: no jumps that random directions would miss.
    let (offset, sign) = if ay > ax { (0.25, -1.0) } else { (0.0, 1.0) };
    let turns = offset + sign * turns;
    let (offset, sign) = if x < 0.0 { (0.5, -1.0) } else { (0.0, 1.0) };
    let turns = offset + sign * turns;
    let (offset, sign) = if y < 0.0 { (1.0, -1.0) } else { (0.0, 1.0) };
    let turns: f32 = offset + sign * turns;
    // Just below the positive x axis rounding gives 1: that still is the end of the turn.
    turns.min(1.0 - 0.5 * f32::EPSILON)
}

/// Sine and cosine of `turns * 2 pi`, for `turns` in `[0, 1]`. Absolute error below 1.5e-7.
#[inline(always)]
pub(crate) fn sin_cos_turns(turns: f32) -> (f32, f32) {
    let quarters = 4.0 * turns;
    let nearest = (quarters + 0.5).floor();
    let x = quarters - nearest;
    let sin = x * polynomial4(&SIN_QUARTER_TURNS, x * x);
    let cos = polynomial5(&COS_QUARTER_TURNS, x * x);
    let quadrant = nearest as i32 as u32;
    let (s, c) = if quadrant & 1 == 0 {
        (sin, cos)
    } else {
        (cos, sin)
    };
    // The sine is negative in quadrants 2 and 3, the cosine in 1 and 2.
    let sign_s = (quadrant & 2) << 30;
    let sign_c = (quadrant.wrapping_add(1) & 2) << 30;
    (
        f32::from_bits(s.to_bits() ^ sign_s),
        f32::from_bits(c.to_bits() ^ sign_c),
    )
}

/// `exp(x)` for `x <= 0`; 0 below -87, where f32 has no normal numbers left. Relative error
/// below 2e-7 for `x >= -1`, growing with `|x|` as the rounding of its argument does. Free of
/// branches, checks and calls, so that loops over it use the whole vector unit.
#[inline(always)]
pub(crate) fn exp_nonpositive(x: f32) -> f32 {
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    // Adding 1.5 * 2^23 rounds to the nearest integer, and leaves it in the low bits.
    const ROUND: f32 = 12_582_912.0;
    const BIAS: u32 = ROUND.to_bits().wrapping_sub(127);
    let scaled = x.max(-87.0) * LOG2_E;
    let shifted = scaled + ROUND;
    let whole = shifted - ROUND;
    let power = f32::from_bits(shifted.to_bits().wrapping_sub(BIAS) << 23);
    let value = polynomial7(&EXP2, scaled - whole) * power;
    if x < -87.0 { 0.0 } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn angles_agree_with_f64_within_an_ulp_of_a_turn() {
        for k in 0..200_000 {
            let turns = k as f64 / 200_000.0;
            let (s, c) = (turns * TAU).sin_cos();
            let (s, c) = (s as f32, c as f32);
            let exact = (f64::from(s).atan2(f64::from(c)) / TAU).rem_euclid(1.0);
            let error = (f64::from(atan2_turns(s, c)) - exact).abs();
            assert!(error.min(1.0 - error) < 7e-8, "{turns}: {error}");
        }
    }

    #[test]
    fn angles_stay_below_one_turn_and_the_origin_has_angle_zero() {
        assert_eq!(atan2_turns(0.0, 0.0), 0.0);
        assert_eq!(atan2_turns(-0.0, 1.0), 0.0);
        let below = atan2_turns(-1e-30, 1.0);
        assert!(below < 1.0 && below > 0.999_999);
    }

    #[test]
    fn sines_agree_with_f64() {
        for k in 0..=100_000u32 {
            let turns = k as f32 / 100_000.0;
            let (s, c) = (f64::from(turns) * TAU).sin_cos();
            let (fs, fc) = sin_cos_turns(turns);
            assert!((f64::from(fs) - s).abs() < 1.5e-7, "sin {turns}");
            assert!((f64::from(fc) - c).abs() < 1.5e-7, "cos {turns}");
        }
    }

    #[test]
    fn exponentials_agree_with_f64_down_to_underflow() {
        for k in 0..=100_000 {
            let x = -(k as f32) * 1e-3;
            let exact = f64::from(x).exp();
            if x < -87.0 {
                assert_eq!(exp_nonpositive(x), 0.0);
            } else {
                // The roundings of log2(e) and of its product with x move the result by at most
                // |x| 2^-24 each; the rest is 2e-7.
                let tolerance = 2e-7 + f64::from(-x) * 1.2e-7;
                let error = (f64::from(exp_nonpositive(x)) / exact - 1.0).abs();
                assert!(error < tolerance, "{x}: {error}");
            }
        }
        assert_eq!(exp_nonpositive(f32::NEG_INFINITY), 0.0);
    }
}
