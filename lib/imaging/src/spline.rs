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
mod tests;
