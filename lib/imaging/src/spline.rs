//! A monotonic curve on [0, 1]: piecewise quotients of quadratics through knots, linear outside
//! [Gregory & Delbourgo 1982; as parametrised by Durkan et al. 2019, section 3.1].
//!
//! All arithmetic is f64: a bin may be a thousandth wide, where f32 knots would leave a position
//! inside the bin with three digits.
use serde::{Deserialize, Serialize};

/// Bins of a curve, K.
pub const BINS: usize = 5;
/// Knots of a curve.
pub const KNOTS: usize = BINS + 1;
/// Unconstrained parameters of a curve: K widths, K heights, K + 1 slopes.
pub const PARAMETERS: usize = 2 * BINS + KNOTS;
/// Least width of a bin, of the whole range of 1: the default of the method's authors, as are the
/// other two.
pub const MIN_BIN_WIDTH: f64 = 1e-3;
/// Least height of a bin, of the whole range of 1.
pub const MIN_BIN_HEIGHT: f64 = 1e-3;
/// Least slope at a knot: the curve never gets flat, so it can be inverted and keeps a gradient.
pub const MIN_SLOPE: f64 = 1e-3;

/// The points that a curve passes through and its slopes there. From (0, 0) to (1, 1), strictly
/// rising in both coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Knots {
    /// Inputs, from 0 to 1.
    pub x: [f64; KNOTS],
    /// Outputs, from 0 to 1.
    pub y: [f64; KNOTS],
    /// dy/dx at the knots, positive; the first and last go on as the linear tails.
    pub slopes: [f64; KNOTS],
}

/// Unconstrained numbers that describe a curve; zero everywhere is the identity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SplineParameters {
    /// Logits of the bin widths.
    pub widths: [f64; BINS],
    /// Logits of the bin heights.
    pub heights: [f64; BINS],
    /// Softplus arguments of the slopes, shifted so that 0 means a slope of 1.
    pub slopes: [f64; KNOTS],
}

/// Gradient of a scalar with respect to the knots' inputs, outputs and slopes, in that order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KnotGradient {
    /// With respect to [`Knots::x`].
    pub x: [f64; KNOTS],
    /// With respect to [`Knots::y`].
    pub y: [f64; KNOTS],
    /// With respect to [`Knots::slopes`].
    pub slopes: [f64; KNOTS],
}

impl KnotGradient {
    /// Adds another pixel's, or chunk's, gradient.
    pub fn merge(mut self, other: Self) -> Self {
        for k in 0..KNOTS {
            self.x[k] += other.x[k];
            self.y[k] += other.y[k];
            self.slopes[k] += other.slopes[k];
        }
        self
    }
}

impl SplineParameters {
    /// All parameters in one array: widths, heights, slopes.
    pub fn to_array(self) -> [f64; PARAMETERS] {
        let mut all = [0.0; PARAMETERS];
        all[..BINS].copy_from_slice(&self.widths);
        all[BINS..2 * BINS].copy_from_slice(&self.heights);
        all[2 * BINS..].copy_from_slice(&self.slopes);
        all
    }

    /// The reverse of [`to_array`](Self::to_array).
    pub fn from_array(all: [f64; PARAMETERS]) -> Self {
        let mut parameters = Self::default();
        parameters.widths.copy_from_slice(&all[..BINS]);
        parameters.heights.copy_from_slice(&all[BINS..2 * BINS]);
        parameters.slopes.copy_from_slice(&all[2 * BINS..]);
        parameters
    }

    /// The knots: widths and heights are a floor plus a share by softmax, slopes a floor plus a
    /// softplus. Finite parameters of any size give legal knots.
    pub fn knots(&self) -> Knots {
        Knots {
            x: edges(&self.widths, MIN_BIN_WIDTH),
            y: edges(&self.heights, MIN_BIN_HEIGHT),
            slopes: self.slopes.map(|p| MIN_SLOPE + softplus(p + slope_shift())),
        }
    }

    /// The parameters of `knots`, the inverse of [`knots`](Self::knots) as far as no width, height
    /// or slope is at its least value.
    pub fn of(knots: &Knots) -> Self {
        // Logits are free up to a constant: equal shares have 0.
        let logits = |edges: &[f64; KNOTS], least: f64| {
            std::array::from_fn(|k| {
                let share = (edges[k + 1] - edges[k] - least) / (1.0 - BINS as f64 * least);
                (share.max(1e-9) * BINS as f64).ln()
            })
        };
        Self {
            widths: logits(&knots.x, MIN_BIN_WIDTH),
            heights: logits(&knots.y, MIN_BIN_HEIGHT),
            slopes: knots
                .slopes
                .map(|d| (d - MIN_SLOPE).max(1e-9).exp_m1().ln() - slope_shift()),
        }
    }

    /// Gradient with respect to the parameters, given that with respect to [`knots`](Self::knots).
    pub fn knots_vjp(&self, gradient: &KnotGradient) -> Self {
        let mut slopes = [0.0; KNOTS];
        for k in 0..KNOTS {
            slopes[k] = gradient.slopes[k] * sigmoid(self.slopes[k] + slope_shift());
        }
        Self {
            widths: edges_vjp(&self.widths, MIN_BIN_WIDTH, &gradient.x),
            heights: edges_vjp(&self.heights, MIN_BIN_HEIGHT, &gradient.y),
            slopes,
        }
    }
}

/// The argument at which `MIN_SLOPE + softplus` is 1.
fn slope_shift() -> f64 {
    (1.0 - MIN_SLOPE).exp_m1().ln()
}

/// `ln(1 + e^x)` without overflow.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// Derivative of softplus.
fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn softmax(logits: &[f64; BINS]) -> [f64; BINS] {
    let top = logits.iter().fold(f64::NEG_INFINITY, |a, &b| a.max(b));
    let powers = logits.map(|p| (p - top).exp());
    let total: f64 = powers.iter().sum();
    powers.map(|p| p / total)
}

/// Positions of the knots along one axis. Both ends are exact.
fn edges(logits: &[f64; BINS], floor: f64) -> [f64; KNOTS] {
    let shares = softmax(logits);
    let mut edges = [0.0; KNOTS];
    for k in 0..BINS {
        edges[k + 1] = edges[k] + floor + (1.0 - BINS as f64 * floor) * shares[k];
    }
    edges[BINS] = 1.0;
    edges
}

fn edges_vjp(logits: &[f64; BINS], floor: f64, gradient: &[f64; KNOTS]) -> [f64; BINS] {
    let shares = softmax(logits);
    // Inner edge k is the sum of the sizes before it; the outer edges are constants.
    let mut sizes = [0.0; BINS];
    let mut sum = 0.0;
    for k in (1..BINS).rev() {
        sum += gradient[k];
        sizes[k - 1] = sum;
    }
    let mean: f64 = (0..BINS).map(|k| shares[k] * sizes[k]).sum();
    let mut logits_gradient = [0.0; BINS];
    for k in 0..BINS {
        logits_gradient[k] = (1.0 - BINS as f64 * floor) * shares[k] * (sizes[k] - mean);
    }
    logits_gradient
}

impl Knots {
    /// `y = x`.
    pub fn identity() -> Self {
        SplineParameters::default().knots()
    }

    /// Says what is wrong with knots from a file, if anything is.
    pub fn check(&self) -> Result<(), String> {
        for (name, values) in [("x", &self.x), ("y", &self.y)] {
            if values[0] != 0.0 || values[BINS] != 1.0 {
                let (first, last) = (values[0], values[BINS]);
                return Err(format!(
                    "`{name}` goes from {first} to {last}, not from 0 to 1"
                ));
            }
            let rises = |k: &usize| values[k + 1] > values[*k];
            if let Some(k) = (0..BINS).find(|k| !rises(k)) {
                return Err(format!("`{name}` does not rise after knot {k}"));
            }
        }
        match self
            .slopes
            .iter()
            .position(|&s| !(s > 0.0 && s.is_finite()))
        {
            Some(k) => Err(format!(
                "`slopes` is {} at knot {k}, not positive",
                self.slopes[k]
            )),
            None => Ok(()),
        }
    }

    /// The curve, prepared for many inputs.
    pub fn curve(&self) -> Curve {
        Curve {
            knots: *self,
            bins: std::array::from_fn(|k| Bin::new(self, k)),
        }
    }

    /// [`Curve::eval`] at one input.
    pub fn eval(&self, x: f64) -> f64 {
        self.curve().eval(x)
    }

    /// [`Curve::slope`] at one input.
    pub fn slope(&self, x: f64) -> f64 {
        self.curve().slope(x)
    }

    /// [`Curve::eval_vjp`] at one input.
    pub fn eval_vjp(&self, x: f64, gradient: f64, knots: &mut KnotGradient) -> f64 {
        self.curve().eval_vjp(x, gradient, knots)
    }

    /// [`Curve::inverse`] at one height.
    pub fn inverse(&self, y: f64) -> f64 {
        self.curve().inverse(y)
    }
}

/// The curve through [`Knots`], with what each bin needs worked out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Curve {
    knots: Knots,
    bins: [Bin; BINS],
}

impl Curve {
    /// The curve at `x`. Strictly increasing, once continuously differentiable everywhere, exact
    /// at both ends.
    #[inline]
    pub fn eval(&self, x: f64) -> f64 {
        if x <= 0.0 {
            return self.knots.slopes[0] * x;
        }
        if x >= 1.0 {
            return 1.0 + self.knots.slopes[BINS] * (x - 1.0);
        }
        let bin = &self.bins[find(x, &self.knots.x)];
        let at = bin.at(x);
        bin.y + bin.h * at.ratio
    }

    /// Derivative of [`eval`](Self::eval), positive.
    #[inline]
    pub fn slope(&self, x: f64) -> f64 {
        if x <= 0.0 {
            return self.knots.slopes[0];
        }
        if x >= 1.0 {
            return self.knots.slopes[BINS];
        }
        let bin = &self.bins[find(x, &self.knots.x)];
        bin.slope(&bin.at(x))
    }

    /// Adjoint of [`eval`](Self::eval): adds to `knots` the gradient with respect to the knots, and
    /// returns that with respect to `x`, for a gradient with respect to the result. At an inner
    /// knot the bin above counts, at both ends the tail.
    #[inline]
    pub fn eval_vjp(&self, x: f64, gradient: f64, knots: &mut KnotGradient) -> f64 {
        if x <= 0.0 {
            knots.slopes[0] += gradient * x;
            return gradient * self.knots.slopes[0];
        }
        if x >= 1.0 {
            knots.slopes[BINS] += gradient * (x - 1.0);
            return gradient * self.knots.slopes[BINS];
        }
        let k = find(x, &self.knots.x);
        let bin = &self.bins[k];
        let at = bin.at(x);
        let (xi, q, ratio) = (at.xi, at.q, at.ratio);
        let input = gradient * bin.slope(&at);

        // y = y0 + h N / D with N = s xi^2 + d0 q and D = s + (d0 + d1 - 2 s) q.
        let to_ratio = gradient * bin.h * at.per_denominator;
        let to_d0 = to_ratio * q * (1.0 - ratio);
        let to_d1 = -to_ratio * q * ratio;
        let to_s = to_ratio * (xi * xi - ratio * (1.0 - 2.0 * q));
        // s = h / w and xi = (x - x0) / w, whose derivative was taken with the slope.
        let to_h = gradient * ratio + to_s * bin.per_w;
        let to_w = -(to_s * bin.s * bin.per_w + input * xi);

        knots.x[k] += -input - to_w;
        knots.x[k + 1] += to_w;
        knots.y[k] += gradient - to_h;
        knots.y[k + 1] += to_h;
        knots.slopes[k] += to_d0;
        knots.slopes[k + 1] += to_d1;
        input
    }

    /// The `x` at which the curve is `y`.
    pub fn inverse(&self, y: f64) -> f64 {
        if y <= 0.0 {
            return y / self.knots.slopes[0];
        }
        if y >= 1.0 {
            return 1.0 + (y - 1.0) / self.knots.slopes[BINS];
        }
        let k = find(y, &self.knots.y);
        let bin = &self.bins[k];
        // The root of a xi^2 + b xi + c that lies in [0, 1] [Durkan et al. 2019, appendix A], in that of its two
        // forms which does not cancel. The discriminant is not negative but for rounding; a is positive if b is not.
        let rise = (y - bin.y) / bin.h;
        let a = bin.s - bin.d0 + rise * bin.bend;
        let b = bin.d0 - rise * bin.bend;
        let c = -bin.s * rise;
        let root = (b * b - 4.0 * a * c).max(0.0).sqrt();
        let xi = match (c == 0.0, b < 0.0) {
            (true, _) => 0.0,
            (false, true) => (root - b) / (2.0 * a),
            (false, false) => -2.0 * c / (b + root),
        };
        bin.x + (self.knots.x[k + 1] - bin.x) * xi.clamp(0.0, 1.0)
    }
}

/// The bin that holds `value` in `[0, 1]` along the axis whose knots are `edges`.
#[inline]
fn find(value: f64, edges: &[f64; KNOTS]) -> usize {
    (1..BINS).map(|k| usize::from(value >= edges[k])).sum()
}

/// One bin: its lower left corner, height, `1 / w` of its width, slopes at its ends, mean slope
/// `s = h / w`, and `d0 + d1 - 2 s`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Bin {
    x: f64,
    per_w: f64,
    y: f64,
    h: f64,
    d0: f64,
    d1: f64,
    s: f64,
    bend: f64,
}

/// A position in a bin, with `q = xi (1 - xi)`, and the quotient of the two quadratics.
struct Position {
    xi: f64,
    q: f64,
    per_denominator: f64,
    ratio: f64,
}

impl Bin {
    fn new(knots: &Knots, k: usize) -> Self {
        let w = knots.x[k + 1] - knots.x[k];
        let h = knots.y[k + 1] - knots.y[k];
        let (d0, d1, s) = (knots.slopes[k], knots.slopes[k + 1], h / w);
        Self {
            x: knots.x[k],
            per_w: 1.0 / w,
            y: knots.y[k],
            h,
            d0,
            d1,
            s,
            bend: d0 + d1 - 2.0 * s,
        }
    }

    #[inline]
    fn at(&self, x: f64) -> Position {
        let xi = (x - self.x) * self.per_w;
        let q = xi * (1.0 - xi);
        // The denominator is s (1 - 2 q) + (d0 + d1) q, positive as q <= 1/4.
        let per_denominator = 1.0 / (self.s + self.bend * q);
        Position {
            xi,
            q,
            per_denominator,
            ratio: (self.s * xi * xi + self.d0 * q) * per_denominator,
        }
    }

    #[inline]
    fn slope(&self, at: &Position) -> f64 {
        let rest = 1.0 - at.xi;
        let quadratic = self.d1 * at.xi * at.xi + 2.0 * self.s * at.q + self.d0 * rest * rest;
        let ratio = self.s * at.per_denominator;
        ratio * ratio * quadratic
    }
}

#[cfg(test)]
mod tests {
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
}
