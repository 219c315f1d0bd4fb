//! Non-local means in a block of pixels.
use glam::{Vec3, Vec4};

use super::auxiliary::Seen;
use crate::job::REPLICATES;

/// Pixels to each side that a pixel may be averaged with.
const REACH: usize = 3;
/// Most pixels to each side that are compared.
const MOST_COMPARED: usize = 2;
/// Pixels to each side over which variances are averaged: a pixel's own has one degree of freedom.
const POOL: usize = 2;
/// Differences, in standard deviations, that are taken for noise: less keeps more of both noise and detail.
const STRENGTH: f32 = 0.7;
/// Added to variances, squared units of what is filtered: its rounding.
const LEAST_VARIANCE: f32 = 1e-10;
/// Weights below exp(-this) are 0.
const LARGEST_DISTANCE: f32 = 16.0;
/// Differences of unit normals, and of base colours, whose weight is exp(-1).
const NORMALS: f32 = 0.3;
const COLOURS: f32 = 0.1;

/// Side of a block of pixels.
pub(super) const BLOCK: usize = 8;
/// Pixels around a block that decide about it.
const MARGIN: usize = REACH + MOST_COMPARED + POOL;
/// Side of a block with its margin.
const SIDE: usize = BLOCK + 2 * MARGIN;
/// Side of a block with what is compared around its pixels.
const COMPARED: usize = BLOCK + 2 * MOST_COMPARED;

/// What the halves of the samples say of a pixel.
#[derive(Clone, Copy)]
pub(super) struct Halves {
    /// A colour, and how much of the pixel the object covers where that differs.
    pub(super) values: [Vec4; REPLICATES],
    /// Whether it may be averaged with others.
    pub(super) is_inside: bool,
    /// The surface there.
    pub(super) seen: Seen,
}

/// How pixels are compared: by `CHANNELS` numbers of them and of the `PATCH` pixels to each side, at most
/// [`MOST_COMPARED`].
#[derive(Clone, Copy)]
pub(super) struct Comparison<const CHANNELS: usize, const PATCH: usize> {
    /// Whether the two pixels themselves are compared, beside those around them. Weights that leave them out do not depend
    /// on the noise of a pixel, so that the error that the halves measure is true.
    pub(super) with_own: bool,
    /// What of the values is compared.
    pub(super) channels: fn(Vec4) -> [f32; CHANNELS],
}

/// A block with its margin.
pub(super) struct Window<const CHANNELS: usize, const PATCH: usize> {
    comparison: Comparison<CHANNELS, PATCH>,
    halves: [[Vec4; SIDE * SIDE]; REPLICATES],
    inside: [bool; SIDE * SIDE],
    seen: [(Vec3, Vec3); SIDE * SIDE],
    /// What is compared.
    guides: [[[f32; SIDE * SIDE]; CHANNELS]; REPLICATES],
    /// Variance of one half of the guides, averaged over neighbours.
    variance: [[f32; SIDE * SIDE]; CHANNELS],
}

impl<const CHANNELS: usize, const PATCH: usize> Window<CHANNELS, PATCH> {
    /// Around the block whose upper left corner is `first`, in a frame of `size`; pixels beyond it repeat its edge.
    /// `None` if all values are 0.
    pub(super) fn new(
        comparison: Comparison<CHANNELS, PATCH>,
        first: [usize; 2],
        size: [usize; 2],
        halves: impl Fn(usize, usize) -> Halves,
    ) -> Option<Self> {
        let mut window = Self {
            comparison,
            halves: [[Vec4::ZERO; SIDE * SIDE]; REPLICATES],
            inside: [false; SIDE * SIDE],
            seen: [(Vec3::ZERO, Vec3::ZERO); SIDE * SIDE],
            guides: [[[0.0; SIDE * SIDE]; CHANNELS]; REPLICATES],
            variance: [[0.0; SIDE * SIDE]; CHANNELS],
        };
        let along =
            |axis: usize, i: usize| (first[axis] + i).saturating_sub(MARGIN).min(size[axis] - 1);
        let mut is_empty = true;
        for j in 0..SIDE {
            for i in 0..SIDE {
                let at = j * SIDE + i;
                let pixel = halves(along(0, i), along(1, j));
                window.inside[at] = pixel.is_inside;
                window.seen[at] = pixel.seen.decoded();
                for (k, half) in pixel.values.into_iter().enumerate() {
                    is_empty &= half == Vec4::ZERO;
                    window.halves[k][at] = half;
                    for (c, guide) in (comparison.channels)(half).into_iter().enumerate() {
                        window.guides[k][c][at] = guide;
                    }
                }
            }
        }
        window.pool_variance();
        (!is_empty).then_some(window)
    }

    fn pool_variance(&mut self) {
        for j in POOL..SIDE - POOL {
            for i in POOL..SIDE - POOL {
                let mut sums = [0.0; CHANNELS];
                let mut count = 0.0f32;
                for y in j - POOL..=j + POOL {
                    for at in y * SIDE + i - POOL..=y * SIDE + i + POOL {
                        if self.inside[at] {
                            count += 1.0;
                            for (c, sum) in sums.iter_mut().enumerate() {
                                let difference = self.guides[0][c][at] - self.guides[1][c][at];
                                *sum += difference * difference;
                            }
                        }
                    }
                }
                for (c, sum) in sums.into_iter().enumerate() {
                    self.variance[c][j * SIDE + i] = sum * 0.5 / count.max(1.0);
                }
            }
        }
    }

    /// The halves of the pixel in column `i` and row `j` of the block, as drawn.
    pub(super) fn drawn(&self, i: usize, j: usize) -> [Vec4; REPLICATES] {
        let at = (j + MARGIN) * SIDE + i + MARGIN;
        [self.halves[0][at], self.halves[1][at]]
    }

    /// Whether that pixel is filtered.
    pub(super) fn is_inside(&self, i: usize, j: usize) -> bool {
        self.inside[(j + MARGIN) * SIDE + i + MARGIN]
    }

    /// Both halves of the block, filtered.
    pub(super) fn filtered(&self) -> [[Vec4; BLOCK * BLOCK]; REPLICATES] {
        let mut sums = [[Vec4::ZERO; BLOCK * BLOCK]; REPLICATES];
        let mut weights = [[0f32; BLOCK * BLOCK]; REPLICATES];
        for dy in 0..=2 * REACH {
            for dx in 0..=2 * REACH {
                let unlike = self.surfaces(dx, dy);
                for guide in 0..REPLICATES {
                    let other = 1 - guide;
                    let near = self.weights(guide, dx, dy, &unlike);
                    for (p, &weight) in near.iter().enumerate() {
                        let at = (p / BLOCK + MARGIN + dy - REACH) * SIDE + p % BLOCK + MARGIN + dx
                            - REACH;
                        sums[other][p] += self.halves[other][at] * weight;
                        weights[other][p] += weight;
                    }
                }
            }
        }
        std::array::from_fn(|k| {
            std::array::from_fn(|p| match weights[k][p] {
                weight if weight > 0.0 => sums[k][p] / weight,
                // Not inside and like no other, or so bright that its square is no number.
                _ => self.drawn(p % BLOCK, p / BLOCK)[k],
            })
        })
    }

    /// How much the surface of every pixel of the block differs from that of the pixel that lies `dx - REACH`,
    /// `dy - REACH` away: minus the logarithm of a weight.
    fn surfaces(&self, dx: usize, dy: usize) -> [f32; BLOCK * BLOCK] {
        std::array::from_fn(|p| {
            let at = (p / BLOCK + MARGIN) * SIDE + p % BLOCK + MARGIN;
            let to = at + dy * SIDE + dx - REACH * SIDE - REACH;
            if !self.inside[to] {
                return f32::INFINITY;
            }
            let (normal, colour) = self.seen[at];
            let (other_normal, other_colour) = self.seen[to];
            normal.distance_squared(other_normal) * (1.0 / (NORMALS * NORMALS))
                + colour.distance_squared(other_colour) * (1.0 / (COLOURS * COLOURS))
        })
    }

    /// How much every pixel of the block resembles the one that lies `dx - REACH`, `dy - REACH` away, in one half.
    fn weights(
        &self,
        half: usize,
        dx: usize,
        dy: usize,
        unlike: &[f32; BLOCK * BLOCK],
    ) -> [f32; BLOCK * BLOCK] {
        let (first, side) = (MARGIN - PATCH, BLOCK + 2 * PATCH);
        let mut distances = [0f32; COMPARED * COMPARED];
        for (guide, variance) in self.guides[half].iter().zip(&self.variance) {
            for j in 0..side {
                let p = (first + j) * SIDE + first;
                let q = p + dy * SIDE + dx - REACH * SIDE - REACH;
                let (guide_p, guide_q) = (&guide[p..p + side], &guide[q..q + side]);
                let (variance_p, variance_q) = (&variance[p..p + side], &variance[q..q + side]);
                let row = &mut distances[j * COMPARED..j * COMPARED + side];
                for i in 0..side {
                    let difference = guide_p[i] - guide_q[i];
                    let (v, w) = (variance_p[i], variance_q[i]);
                    let excess = difference * difference - (v + v.min(w));
                    row[i] += excess / (LEAST_VARIANCE + STRENGTH * STRENGTH * (v + w));
                }
            }
        }
        let with_own = self.comparison.with_own;
        let mut sums = [0f32; BLOCK * BLOCK];
        let mut compared = 0;
        for y in 0..=2 * PATCH {
            for x in 0..=2 * PATCH {
                if (x, y) == (PATCH, PATCH) && !with_own {
                    continue;
                }
                compared += 1;
                for j in 0..BLOCK {
                    let distances = &distances[(j + y) * COMPARED + x..][..BLOCK];
                    let row = &mut sums[j * BLOCK..][..BLOCK];
                    row.iter_mut().zip(distances).for_each(|(s, d)| *s += d);
                }
            }
        }
        let norm = 1.0 / (compared * CHANNELS) as f32;
        std::array::from_fn(|p| match sums[p] * norm {
            distance if distance + unlike[p] < LARGEST_DISTANCE => {
                (-distance.max(0.0) - unlike[p]).exp()
            }
            _ => 0.0,
        })
    }
}
