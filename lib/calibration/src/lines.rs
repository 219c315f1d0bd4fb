//! What straight lines tell of a camera.
//!
//! Under a pose every segment is upright, level in one of two pairs of orthogonal directions, or clutter: a mixture
//! over the angle between the segment and the line from its middle to each vanishing point. The first pair of
//! directions is what most segments agree on (a Manhattan world), the second the next best (an Atlanta world). A
//! segment's plane through the camera holds one level direction, so that all candidates come from one histogram.
use std::f64::consts::{FRAC_PI_2, PI};

use glam::{DVec2, DVec3};

use crate::pose::Pose;
use crate::segments::{Segment, block_side};

/// Shares of the mixture: upright, each direction of the first and of the second pair; the rest is clutter.
const UPRIGHT: f64 = 0.3;
const FIRST: f64 = 0.15;
const SECOND: f64 = 0.05;
const CLUTTER: f64 = 1.0 - UPRIGHT - 2.0 * FIRST - 2.0 * SECOND;
/// Standard deviation of a long edge's direction, radians: things are built no straighter, and lenses bend.
const LONG_RAD: f64 = 0.007;
/// Uncertainty across a segment's ends, pixels of the picture that edges are looked for in.
const ACROSS_PX: f64 = 0.35;
/// A segment of this length, of the picture's longer side, counts once; a shorter one less.
const WHOLE: f64 = 0.15;
/// Spreads of a pose under which it is looked at, degrees: by what it is found, and by what it is told apart.
const SPREADS_DEG: [f64; 2] = [1.5, 0.25];
/// How many numbers tell of the segments under a pose.
pub const LINES: usize = 5 * SPREADS_DEG.len() + 1;
/// Half squared deviations beyond which a density is nothing beside clutter.
const FAR: f64 = 12.0;
/// Bins of a quarter turn in which level directions are counted.
const BINS: usize = 45;

/// Segments as they are seen by a camera: relative to the picture's middle, +y up, in units of its longer side.
#[derive(Clone, Debug)]
pub struct Lines {
    edges: Vec<Edge>,
}

#[derive(Clone, Copy, Debug)]
struct Edge {
    middle: DVec2,
    direction: DVec2,
    /// How much it counts.
    weight: f64,
    /// Variance of its direction, square radians.
    variance: f64,
}

/// How many segments are explained by what.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Agreement {
    /// Upright ones.
    pub upright: f64,
    /// Level ones.
    pub level: f64,
}

impl Lines {
    /// Segments of a picture of `size` pixels.
    pub fn new(segments: &[Segment], size: [usize; 2]) -> Self {
        let factor = block_side(size) as f64;
        let size = size.map(|n| n as f64);
        let (longer, flip) = (size[0].max(size[1]), DVec2::new(1.0, -1.0));
        let edge = |s: &Segment| Edge {
            middle: (s.middle - 0.5 * DVec2::from_array(size)) * flip / longer,
            direction: s.direction * flip,
            weight: (s.length / longer / WHOLE).min(1.0),
            variance: LONG_RAD.powi(2) + (ACROSS_PX * factor / s.length.max(1e-9)).powi(2),
        };
        Self {
            edges: segments.iter().map(edge).collect(),
        }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.edges.len()
    }

    /// What the segments tell of a pose known to [`SPREADS_DEG`]: per spread the mean and the sum of the logarithm of how
    /// probable they are, and the shares of upright ones and of both pairs; and how many there are.
    pub fn features(&self, pose: &Pose) -> [f32; LINES] {
        let mut all = [0.0; LINES];
        let total: f64 = self.edges.iter().map(|e| e.weight).sum();
        let mean = 1.0 / (total + 1.0);
        for (n, spread) in SPREADS_DEG.iter().enumerate() {
            let mut sums = [0.0; 4];
            self.each(pose, spread.to_radians().powi(2), |edge, kinds| {
                let whole = CLUTTER + kinds.iter().sum::<f64>();
                sums[0] += edge.weight * whole.ln();
                for (s, k) in sums[1..].iter_mut().zip(kinds) {
                    *s += edge.weight * k / whole;
                }
            });
            let own = &mut all[5 * n..5 * n + 5];
            own[4] = (sums[0] / 4.0).asinh() as f32;
            for (o, s) in own.iter_mut().zip(sums) {
                *o = (s * mean) as f32;
            }
        }
        all[LINES - 1] = (1.0 + total).ln() as f32;
        all
    }

    /// How many segments agree with a pose.
    pub fn agreement(&self, pose: &Pose) -> Agreement {
        let mut found = Agreement::default();
        self.each(pose, 0.0, |_, [upright, first, second]| {
            let total = CLUTTER + upright + first + second;
            found.upright += upright / total;
            found.level += (first + second) / total;
        });
        found
    }

    /// Each edge with the densities, over that of clutter, of being upright and in the two pairs of directions.
    fn each(&self, pose: &Pose, spread: f64, mut found: impl FnMut(&Edge, [f64; 3])) {
        let focal = pose.focal();
        let [right, up, back] = pose.axes();
        let pairs = self.level_directions(focal, [right, up, back], spread);
        let level = pairs.map(|angle| {
            let (sin, cos) = angle.sin_cos();
            [cos * right + sin * back, cos * back - sin * right]
        });
        for edge in &self.edges {
            let middle = edge.middle / focal;
            let variance = edge.variance + spread;
            // A density of angles over that of clutter, which is even over half a turn.
            let peak = PI / (2.0 * PI * variance).sqrt();
            let density = |point: DVec3| match 0.5 * edge.off(middle, point) / variance {
                far if far > FAR => 0.0,
                off => peak * (-off).exp(),
            };
            let pair = |[a, b]: [DVec3; 2]| density(a) + density(b);
            let upright = UPRIGHT * density(up);
            found(
                edge,
                [upright, FIRST * pair(level[0]), SECOND * pair(level[1])],
            );
        }
    }

    /// The two quarter-turn angles about the vertical that most edges agree with, if they are level.
    fn level_directions(&self, focal: f64, [right, up, back]: [DVec3; 3], spread: f64) -> [f64; 2] {
        // By length, and the sum of the offsets from the bin's middle.
        let mut bins = [[0.0; 2]; BINS];
        for edge in &self.edges {
            let (p, d) = (edge.middle / focal, edge.direction);
            if edge.off(p, up) < 9.0 * (edge.variance + spread) {
                continue;
            }
            let normal = DVec3::new(d.y, -d.x, p.x * d.y - p.y * d.x).normalize();
            let along = normal.cross(up);
            let angle = along
                .dot(back)
                .atan2(along.dot(right))
                .rem_euclid(FRAC_PI_2);
            let at = angle / FRAC_PI_2 * BINS as f64;
            let bin = (at as usize).min(BINS - 1);
            // An edge on the horizon has no direction of its own.
            let weight = edge.weight * along.length();
            bins[bin][0] += weight;
            bins[bin][1] += weight * (at - bin as f64 - 0.5);
        }
        let near = |k: usize| [bins[(k + BINS - 1) % BINS], bins[k], bins[(k + 1) % BINS]];
        let score = |k: usize| {
            let [a, b, c] = near(k);
            0.5 * a[0] + b[0] + 0.5 * c[0]
        };
        let best = |allowed: &dyn Fn(usize) -> bool| {
            let all = (0..BINS).filter(|k| allowed(*k));
            all.max_by(|a, b| score(*a).total_cmp(&score(*b)).then(b.cmp(a)))
                .unwrap_or(0)
        };
        let first = best(&|_| true);
        let apart = |k: usize| {
            let d = k.abs_diff(first);
            d.min(BINS - d)
        };
        let second = best(&|k| apart(k) > 3);
        [first, second].map(|k| {
            let [a, b, c] = near(k);
            let total = a[0] + b[0] + c[0];
            let offset = a[1] + b[1] + c[1] - a[0] + c[0];
            let at = k as f64 + 0.5 + offset / total.max(1e-12);
            at / BINS as f64 * FRAC_PI_2
        })
    }
}

impl Edge {
    /// The squared sine of the angle between the edge and the line from its middle, in units of the focal length, to
    /// the vanishing point of a direction.
    #[inline]
    fn off(&self, middle: DVec2, direction: DVec3) -> f64 {
        let moves = DVec2::new(direction.x, direction.y) + middle * direction.z;
        let across = moves.perp_dot(self.direction);
        across * across / moves.length_squared().max(1e-12)
    }
}
