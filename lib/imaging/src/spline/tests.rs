#[test]
fn parameters_of_knots_give_the_knots() {
    let mut all = [0.0; PARAMETERS];
    for (k, p) in all.iter_mut().enumerate() {
        *p = (k as f64 * 1.7).sin();
    }
    let knots = SplineParameters::from_array(all).knots();
    let again = SplineParameters::of(&knots).knots();
    for k in 0..KNOTS {
        assert!((knots.x[k] - again.x[k]).abs() < 1e-12);
        assert!((knots.y[k] - again.y[k]).abs() < 1e-12);
        assert!((knots.slopes[k] - again.slopes[k]).abs() < 1e-12);
    }
}

use super::*;
use dipir_numerics::gradcheck::{central_difference, relative_error};
use proptest::prelude::*;

/// Step of the central differences. In f64 their error is about `h^2 |f'''| / 6 + eps / h`.
/// In units of a bin the third derivative is of order one, so the step must be small against
/// the least bin of 1e-3: 1e-7 gives `(1e-7 / 1e-3)^2 = 1e-8` and `2e-16 / 1e-7 = 2e-9`.
const STEP: f64 = 1e-7;
/// Both errors of [`STEP`], with room for the slopes of up to 1e3 that stretch the second.
const TOLERANCE: f64 = 1e-5;

fn mild() -> SplineParameters {
    SplineParameters {
        widths: [0.3, -0.5, 0.8, 0.1, -1.0],
        heights: [-0.4, 0.9, 0.0, -0.7, 0.5],
        slopes: [0.5, -1.0, 1.5, 0.2, -0.3, 0.8],
    }
}

/// One bin takes nearly all, the others are at their least.
fn bins_at_their_minimum() -> SplineParameters {
    SplineParameters {
        widths: [0.0, 0.0, 40.0, 0.0, 0.0],
        heights: [0.0, 40.0, 0.0, 0.0, 0.0],
        slopes: [0.5, -1.0, 1.5, 0.2, -0.3, 0.8],
    }
}

fn slopes_at_their_minimum() -> SplineParameters {
    SplineParameters {
        slopes: [-60.0; KNOTS],
        ..mild()
    }
}

fn cases() -> [(&'static str, SplineParameters); 4] {
    [
        ("identity", SplineParameters::default()),
        ("mild", mild()),
        ("bins at their minimum", bins_at_their_minimum()),
        ("slopes at their minimum", slopes_at_their_minimum()),
    ]
}

/// Inside, outside, and inside each bin, away from knots, where the second derivative jumps.
fn inputs(knots: &Knots) -> Vec<f64> {
    let mut inputs = vec![-3.0, -1e-3, 1.001, 50.0];
    for k in 0..BINS {
        for t in [0.03, 0.31, 0.5, 0.77, 0.97] {
            inputs.push(knots.x[k] + t * (knots.x[k + 1] - knots.x[k]));
        }
    }
    inputs
}

#[test]
fn zero_parameters_are_the_identity_in_value_and_slope() {
    let knots = Knots::identity();
    for x in [
        -2.0, -0.1, 0.0, 1e-9, 0.1, 0.2, 0.333, 0.6, 0.99, 1.0, 1.5, 40.0,
    ] {
        assert!((knots.eval(x) - x).abs() <= 1e-14 * x.abs().max(1.0), "{x}");
        assert!((knots.slope(x) - 1.0).abs() < 1e-13, "{x}");
        assert!(
            (knots.inverse(x) - x).abs() <= 1e-14 * x.abs().max(1.0),
            "{x}"
        );
    }
}

#[test]
fn the_curve_passes_through_its_knots_with_their_slopes() {
    for (name, parameters) in cases() {
        let knots = parameters.knots();
        for k in 0..KNOTS {
            let y = knots.eval(knots.x[k]);
            assert!((y - knots.y[k]).abs() < 1e-15, "{name}, knot {k}: {y}");
            let slope = knots.slope(knots.x[k]);
            let error = relative_error(slope, knots.slopes[k], 1e-9);
            assert!(error < 1e-10, "{name}, knot {k}: {slope}");
        }
    }
}

#[test]
fn bins_and_slopes_keep_their_stated_floor() {
    // A rounding of a sum of five numbers up to 1 is under 1e-15.
    let knots = bins_at_their_minimum().knots();
    for k in [0, 1, 3, 4] {
        let width = knots.x[k + 1] - knots.x[k];
        assert!((width - MIN_BIN_WIDTH).abs() < 1e-15, "bin {k}: {width}");
    }
    let height = knots.y[1] - knots.y[0];
    assert!((height - MIN_BIN_HEIGHT).abs() < 1e-15, "{height}");
    let slopes = slopes_at_their_minimum().knots().slopes;
    assert!(
        slopes.iter().all(|s| (s - MIN_SLOPE).abs() < 1e-15),
        "{slopes:?}"
    );
}

#[test]
fn parameters_of_a_thousand_stay_legal() {
    for sign in [-1.0, 1.0] {
        let mut all = [0.0; PARAMETERS];
        for (i, p) in all.iter_mut().enumerate() {
            *p = sign * 1000.0 * (i as f64 * 1.7).sin();
        }
        let parameters = SplineParameters::from_array(all);
        let knots = parameters.knots();
        assert_eq!(knots.check(), Ok(()));
        let gradient = parameters.knots_vjp(&KnotGradient {
            x: [1.0; KNOTS],
            y: [-1.0; KNOTS],
            slopes: [1.0; KNOTS],
        });
        assert!(gradient.to_array().iter().all(|g| g.is_finite()));
    }
}

#[test]
fn tails_go_on_straight_from_both_ends() {
    let knots = mild().knots();
    assert_eq!(knots.eval(0.0), 0.0);
    assert_eq!(knots.eval(1.0), 1.0);
    assert_eq!(knots.eval(-2.0), -2.0 * knots.slopes[0]);
    assert_eq!(knots.eval(3.0), 1.0 + 2.0 * knots.slopes[BINS]);
    // From both sides of an end the values differ by the step times the slopes, 4 at most.
    for end in [0.0, 1.0] {
        let jump = knots.eval(end + 1e-12) - knots.eval(end - 1e-12);
        assert!(jump > 0.0 && jump < 2e-11, "{jump:e}");
        let bend = knots.slope(end + 1e-9) - knots.slope(end - 1e-9);
        assert!(bend.abs() < 1e-6, "{bend:e}");
    }
}

#[test]
fn inverse_undoes_the_curve_inside_and_beyond_both_ends() {
    for (name, parameters) in cases() {
        let knots = parameters.knots();
        let mut inputs = inputs(&knots);
        inputs.extend(knots.x);
        for x in inputs {
            let back = knots.inverse(knots.eval(x));
            // A rounding of y comes back divided by the slope, 1e-3 at knots of the flattest
            // case and far less between two flat knots of a wide bin with a low mean.
            let least = knots.slope(x).min(1.0);
            let tolerance = 1e-14 * (1.0 + x.abs()) / least;
            assert!(
                (back - x).abs() < tolerance,
                "{name}: {x} came back as {back}"
            );
        }
    }
}

#[test]
fn gradients_with_respect_to_the_input_follow_central_differences() {
    for (name, parameters) in cases() {
        let knots = parameters.knots();
        for x in inputs(&knots) {
            let got = knots.eval_vjp(x, 1.0, &mut KnotGradient::default());
            let want = central_difference(|x| knots.eval(x), x, STEP);
            let error = relative_error(got, want, 1e-2);
            assert!(
                error < TOLERANCE,
                "{name} at {x}: {got}, numerically {want}"
            );
            assert_eq!(got, knots.slope(x), "{name} at {x}");
        }
    }
}

#[test]
fn gradients_with_respect_to_every_knot_follow_central_differences() {
    for (name, parameters) in cases() {
        let knots = parameters.knots();
        for x in inputs(&knots) {
            let mut gradient = KnotGradient::default();
            knots.eval_vjp(x, 1.0, &mut gradient);
            for k in 0..KNOTS {
                let moved = |part: usize, v: f64| {
                    let mut knots = knots;
                    [&mut knots.x, &mut knots.y, &mut knots.slopes][part][k] = v;
                    knots.eval(x)
                };
                let parts = [
                    ("x", knots.x[k], gradient.x[k]),
                    ("y", knots.y[k], gradient.y[k]),
                    ("slope", knots.slopes[k], gradient.slopes[k]),
                ];
                for (part, (kind, at, got)) in parts.into_iter().enumerate() {
                    // The outer knots are constants of the parametrisation.
                    if part < 2 && (k == 0 || k == BINS) {
                        continue;
                    }
                    let want = central_difference(|v| moved(part, v), at, STEP);
                    let error = relative_error(got, want, 1e-2);
                    assert!(
                        error < TOLERANCE,
                        "{name} at {x}, {kind} {k}: {got}, numerically {want}"
                    );
                }
            }
        }
    }
}

#[test]
fn gradients_with_respect_to_every_parameter_follow_central_differences() {
    for (name, parameters) in cases() {
        let knots = parameters.knots();
        for x in inputs(&knots) {
            let mut gradient = KnotGradient::default();
            knots.eval_vjp(x, 1.0, &mut gradient);
            let got = parameters.knots_vjp(&gradient).to_array();
            for i in 0..PARAMETERS {
                let value = |v: f64| {
                    let mut all = parameters.to_array();
                    all[i] = v;
                    SplineParameters::from_array(all).knots().eval(x)
                };
                let want = central_difference(value, parameters.to_array()[i], STEP);
                let error = relative_error(got[i], want, 1e-2);
                assert!(
                    error < TOLERANCE,
                    "{name} at {x}, parameter {i}: {}, numerically {want}",
                    got[i]
                );
            }
        }
    }
}

#[test]
fn heights_in_a_bin_that_ends_steeply_are_inverted() {
    // Slopes of the last bin: 1 and 12, .03 on average; -2 c / (b + root) cancels.
    let mut logits = [0.0; PARAMETERS];
    let found = [
        5.502, 3.242, 1.365, -13.963, 16.776, 18.064, -0.416, 4.1, -7.124, 14.472,
    ];
    logits[..10].copy_from_slice(&found);
    logits[15] = 11.639;
    let knots = SplineParameters::from_array(logits).knots();
    for k in 0..=1000 {
        let y = f64::from(k) / 1000.0;
        let x = knots.inverse(y);
        let tolerance = 8.0 * f64::EPSILON * (1.0 + knots.slope(x) * (1.0 + x.abs()));
        assert!((knots.eval(x) - y).abs() < tolerance.max(1e-13), "{y}: {x}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn every_curve_rises_strictly(
        logits in proptest::array::uniform16(-20.0f64..20.0),
        a in -0.5f64..1.5,
        step in 1e-9f64..0.5,
    ) {
        let knots = SplineParameters::from_array(logits).knots();
        prop_assert_eq!(knots.check(), Ok(()));
        prop_assert!(knots.slope(a) > 0.0);
        // Where the slope is least, 1e-9 of a step still moves y by more than a rounding of it
        // only if the slope exceeds 1e-7: equality is allowed, falling is not.
        let (low, high) = (knots.eval(a), knots.eval(a + step));
        prop_assert!(high >= low - 4.0 * f64::EPSILON, "{} to {}", low, high);
        if step > 1e-3 {
            prop_assert!(high > low);
        }
    }

    #[test]
    fn inverse_lands_on_the_same_height(
        logits in proptest::array::uniform16(-20.0f64..20.0),
        y in -0.5f64..1.5,
    ) {
        // In y the error does not grow where the curve is flat; where it is steep, at most
        // 20 + 1/1e-3 plus a bin's overshoot, a rounding of x is stretched by the slope.
        let knots = SplineParameters::from_array(logits).knots();
        let x = knots.inverse(y);
        let tolerance = 8.0 * f64::EPSILON * (1.0 + knots.slope(x) * (1.0 + x.abs()));
        prop_assert!((knots.eval(x) - y).abs() < tolerance.max(1e-13), "{} to {}", y, x);
    }
}
