//! Heights of ground that is not flat, on a grid over its plane.
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::ground::Ground;
use crate::plane::MAD;

/// Heights over a plane at the corners of square cells, bilinear between them, drawn out beyond them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Relief {
    /// The corner of the grid, a point of the plane, metres.
    pub origin: DVec3,
    /// Unit direction of columns.
    pub right: DVec3,
    /// Unit direction of rows.
    pub ahead: DVec3,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Cells in the direction of columns.
    pub columns: u32,
    /// Cells in the direction of rows.
    pub rows: u32,
    /// Metres over the plane, row by row, one more than cells each way.
    pub heights_m: Vec<f32>,
}

/// Cells along the longer side.
const CELLS: f64 = 48.0;
/// Fewest points of ground near the camera that show a relief.
pub(crate) const FEWEST: usize = 100;
/// Share of the nearest ground points that the grid covers.
const COVERED: f64 = 0.9;
/// Farthest cell, in heights of the camera over the ground: 40 m for a person.
const REACH: f64 = 25.0;
/// Weight of the curvature beside one point a node: noise is averaged over a few cells.
const SMOOTHING: f64 = 4.0;
/// Weight of the plane where there are no points.
const TO_PLANE: f64 = 1e-3;
/// A slope beyond which what rises is no ground.
const MOST_SLOPE: f64 = 0.12;
/// Passes of weighing points by their distance from the ground.
const PASSES: usize = 8;
/// Steps of conjugate gradients in a pass.
const STEPS: usize = 120;

/// The relief of the ground that `points` show, off the plane by `sigma`, and how far they are off the
/// relief (a standard deviation); `None` if they are too few.
pub(crate) fn relief(
    points: &[DVec3],
    ground: &Ground,
    view: DVec3,
    sigma: f64,
) -> Option<(Relief, f64)> {
    let up = ground.normal;
    // A camera that looks straight down has no direction along the ground.
    let right = view.cross(up).normalize_or(up.any_orthonormal_vector());
    let ahead = up.cross(right);
    let eye = ground.point;
    let camera_m = REACH * reach_unit(points, eye);
    let mut near: Vec<(DVec2, f64)> = points
        .iter()
        .map(|p| {
            let from = *p - eye;
            (DVec2::new(right.dot(from), ahead.dot(from)), up.dot(from))
        })
        .filter(|(at, h)| {
            at.length() < camera_m && h.abs() < 3.0 * sigma + MOST_SLOPE * at.length()
        })
        .collect();
    if near.len() < FEWEST {
        return None;
    }
    near.sort_by(|a, b| a.0.length().total_cmp(&b.0.length()));
    near.truncate((COVERED * near.len() as f64) as usize);
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for (at, _) in &near {
        (low, high) = (low.min(*at), high.max(*at));
    }
    let cell = (high - low).max_element() / CELLS;
    if !(cell > 0.0) {
        return None;
    }
    let cells = ((high - low) / cell).ceil().max(DVec2::ONE);
    let grid = Grid {
        columns: cells.x as usize,
        rows: cells.y as usize,
    };
    let data: Vec<(DVec2, f64)> = near
        .iter()
        .map(|(at, h)| ((*at - low) / cell, *h))
        .collect();
    let heights = grid.surface(&data, 3.0 * sigma);
    let off = data.iter().map(|(at, h)| {
        let on: f64 = grid.taps(*at).iter().map(|(i, w)| w * heights[*i]).sum();
        (h - on).abs()
    });
    let mut off: Vec<f64> = off.filter(|off| *off < 3.0 * sigma).collect();
    let middle = off.len() / 2;
    if off.is_empty() {
        return None;
    }
    let noise = MAD * *off.select_nth_unstable_by(middle, f64::total_cmp).1;
    let relief = Relief {
        origin: eye + low.x * right + low.y * ahead,
        right,
        ahead,
        cell_m: cell,
        columns: grid.columns as u32,
        rows: grid.rows as u32,
        heights_m: heights.into_iter().map(|h| h as f32).collect(),
    };
    Some((relief, noise))
}

/// A height of the camera, or what stands for it: the distance of the nearest tenth of the points.
fn reach_unit(points: &[DVec3], eye: DVec3) -> f64 {
    let mut away: Vec<f64> = points.iter().map(|p| p.distance(eye)).collect();
    let tenth = away.len() / 10;
    *away.select_nth_unstable_by(tenth, f64::total_cmp).1
}

impl Relief {
    /// Height over the plane below or above `point`, metres.
    pub fn height(&self, point: DVec3) -> f64 {
        let from = point - self.origin;
        let at = DVec2::new(self.right.dot(from), self.ahead.dot(from)) / self.cell_m;
        let grid = self.grid();
        let taps = grid.taps(at);
        taps.iter()
            .map(|(i, w)| w * f64::from(self.heights_m[*i]))
            .sum()
    }

    /// Whether nine tenths of it are lower than `height`, up or down.
    pub fn is_flat(&self, height: f64) -> bool {
        let mut off: Vec<f32> = self.heights_m.iter().map(|h| h.abs()).collect();
        let most = off.len() * 9 / 10;
        f64::from(*off.select_nth_unstable_by(most, f32::total_cmp).1) < height
    }

    /// Whether all its numbers make a grid.
    pub fn is_whole(&self) -> bool {
        let nodes = (u64::from(self.columns) + 1) * (u64::from(self.rows) + 1);
        let flat = self.right.is_finite() && self.ahead.is_finite() && self.origin.is_finite();
        nodes == self.heights_m.len() as u64
            && self.columns > 0
            && self.rows > 0
            && flat
            && self.cell_m > 0.0
            && self.heights_m.iter().all(|h| h.is_finite())
    }

    /// Corners and triangles, counter-clockwise from above.
    pub fn triangles(&self) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let up = self.right.cross(self.ahead);
        let across = self.columns + 1;
        let node = |i: u32, j: u32| j * across + i;
        let mut corners = Vec::new();
        for j in 0..=self.rows {
            for i in 0..=self.columns {
                let at = f64::from(i) * self.right + f64::from(j) * self.ahead;
                let height = f64::from(self.heights_m[node(i, j) as usize]);
                corners.push(self.origin + self.cell_m * at + height * up);
            }
        }
        let mut triangles = Vec::new();
        for j in 0..self.rows {
            for i in 0..self.columns {
                let [a, b] = [node(i, j), node(i + 1, j)];
                let [c, d] = [node(i, j + 1), node(i + 1, j + 1)];
                triangles.extend([[a, b, d], [a, d, c]]);
            }
        }
        (corners, triangles)
    }

    fn grid(&self) -> Grid {
        Grid {
            columns: self.columns as usize,
            rows: self.rows as usize,
        }
    }
}

/// Cells of side 1.
#[derive(Clone, Copy)]
struct Grid {
    columns: usize,
    rows: usize,
}

impl Grid {
    fn nodes(self) -> usize {
        (self.columns + 1) * (self.rows + 1)
    }

    /// The four nodes around a position, and their weights.
    fn taps(self, at: DVec2) -> [(usize, f64); 4] {
        let most = DVec2::new(self.columns as f64, self.rows as f64);
        let at = at.clamp(DVec2::ZERO, most);
        let i = (at.x as usize).min(self.columns - 1);
        let j = (at.y as usize).min(self.rows - 1);
        let (u, v) = (at.x - i as f64, at.y - j as f64);
        let node = j * (self.columns + 1) + i;
        let above = node + self.columns + 1;
        [
            (node, (1.0 - u) * (1.0 - v)),
            (node + 1, u * (1.0 - v)),
            (above, (1.0 - u) * v),
            (above + 1, u * v),
        ]
    }

    /// The smooth surface through most of `data`; points farther from it than `reach` have no weight,
    /// which is widened at first, so that it is found from afar.
    fn surface(self, data: &[(DVec2, f64)], reach: f64) -> Vec<f64> {
        let taps: Vec<[(usize, f64); 4]> = data.iter().map(|(at, _)| self.taps(*at)).collect();
        let mut heights = vec![0.0; self.nodes()];
        for pass in 0..PASSES {
            let wide = reach * f64::from(1u32 << (PASSES - 1 - pass).min(4));
            let weights: Vec<f64> = data
                .iter()
                .zip(&taps)
                .map(|((_, h), taps)| {
                    let off = h - taps.iter().map(|(i, w)| w * heights[*i]).sum::<f64>();
                    // What stands on the ground is above it.
                    let off = if off > 0.0 { 1.5 * off } else { off };
                    (1.0 - (off / wide).powi(2)).max(0.0).powi(2)
                })
                .collect();
            heights = self.solve(data, &taps, &weights, heights);
        }
        heights
    }

    /// Least squares of the weighted points, the curvature and the distance from the plane, by
    /// conjugate gradients from `start`.
    fn solve(
        self,
        data: &[(DVec2, f64)],
        taps: &[[(usize, f64); 4]],
        weights: &[f64],
        start: Vec<f64>,
    ) -> Vec<f64> {
        let smoothing = SMOOTHING * (data.len() as f64 / self.nodes() as f64).max(1.0);
        let apply = |z: &[f64]| -> Vec<f64> {
            let mut out: Vec<f64> = z.iter().map(|z| TO_PLANE * z).collect();
            for (taps, weight) in taps.iter().zip(weights).filter(|(_, w)| **w > 0.0) {
                let here: f64 = taps.iter().map(|(i, w)| w * z[*i]).sum();
                taps.iter().for_each(|(i, w)| out[*i] += weight * w * here);
            }
            self.bend(z, &mut out, smoothing);
            out
        };
        let mut rhs = vec![0.0; self.nodes()];
        for (((_, h), taps), weight) in data.iter().zip(taps).zip(weights) {
            taps.iter().for_each(|(i, w)| rhs[*i] += weight * w * h);
        }
        let mut z = start;
        let mut residual: Vec<f64> = rhs.iter().zip(apply(&z)).map(|(b, a)| b - a).collect();
        let mut direction = residual.clone();
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let mut norm = dot(&residual, &residual);
        let end = 1e-16 * dot(&rhs, &rhs).max(1e-12);
        for _ in 0..STEPS {
            if norm <= end {
                break;
            }
            let image = apply(&direction);
            let step = norm / dot(&direction, &image);
            for i in 0..z.len() {
                z[i] += step * direction[i];
                residual[i] -= step * image[i];
            }
            let next = dot(&residual, &residual);
            let kept = next / norm;
            norm = next;
            for i in 0..z.len() {
                direction[i] = residual[i] + kept * direction[i];
            }
        }
        z
    }

    /// Adds the gradient of the squared second differences along rows and columns.
    fn bend(self, z: &[f64], out: &mut [f64], weight: f64) {
        let across = self.columns + 1;
        let mut line = |start: usize, step: usize, count: usize| {
            for k in 1..count.saturating_sub(1) {
                let i = start + k * step;
                let second = weight * (z[i - step] - 2.0 * z[i] + z[i + step]);
                out[i - step] += second;
                out[i] -= 2.0 * second;
                out[i + step] += second;
            }
        };
        for j in 0..=self.rows {
            line(j * across, 1, across);
        }
        for i in 0..across {
            line(i, across, self.rows + 1);
        }
    }
}
