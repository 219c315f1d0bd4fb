//! Spherical Gaussians as piecewise-constant environment maps, by integration.
//!
//! Every texel gets the mean of the lobes over its cell, so a sun far narrower than a texel
//! keeps its energy, wherever it stands. With polar angles and azimuths as in
//! [`crate::environment`] the exponent is
//!
//! `(1 - v . mu) / sigma^2 = A(theta) + B(theta) h(phi)`,
//! `A = 2 sin^2((theta - theta_mu) / 2) / sigma^2`, `B = 2 sin theta sin theta_mu / sigma^2`,
//! `h = sin^2((phi - phi_mu) / 2)`,
//!
//! a form without cancellation whose parts are tabulated per lobe. The cell is integrated by
//! Gauss-Legendre rules of one to three nodes an axis while it is no wider than
//! [`MAX_STEP`] lobe widths, beyond that by panels of three nodes over the part of the cell
//! that the lobe reaches: the work per lobe is bounded by the lobe, not by the map.
use std::f64::consts::{PI, TAU};

use dipir_numerics::sum::par_reduce;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::environment::EnvironmentMap;
use crate::gaussian::{LobeGradient, SphericalGaussian};
use crate::trigonometry::exp_nonpositive;

/// Exponents beyond this are not evaluated: `exp(-25)` of the peak, 1e-11.
const CUTOFF: f64 = 25.0;
/// The widest step, in lobe widths, that one panel of three nodes takes: its error is
/// `15 q^6 / 2016000` of the panel's peak, 7e-6.
const MAX_STEP: f64 = 1.0;
/// Up to this many lobe widths a single node will do: relative error `q^2 / 24`, 9e-4 of the
/// peak, which cancels in the energy.
const ONE_NODE: f64 = 0.15;
/// Up to this many lobe widths two nodes will do: `3 q^4 / 4320`, 2e-4 of the peak.
const TWO_NODES: f64 = 0.7;
/// Rows that one task works on. A constant, so that sums do not depend on the threads.
const ROWS_PER_TASK: usize = 8;

/// Gauss-Legendre nodes on `[0, 1]`, for one to three nodes.
const NODES: [&[(f64, f64)]; 3] = [
    &[(0.5, 1.0)],
    &[
        (0.211_324_865_405_187_1, 0.5),
        (0.788_675_134_594_812_9, 0.5),
    ],
    &[
        (0.112_701_665_379_258_3, 5.0 / 18.0),
        (0.5, 8.0 / 18.0),
        (0.887_298_334_620_741_7, 5.0 / 18.0),
    ],
];

/// Nodes for a step of `q` lobe widths, or `None` where it needs panels.
fn node_count(q: f64) -> Option<usize> {
    match q {
        q if q <= ONE_NODE => Some(1),
        q if q <= TWO_NODES => Some(2),
        q if q <= MAX_STEP => Some(3),
        _ => None,
    }
}

/// The map of `lobes` on `width` x `height` texels. Panics on an empty size.
pub fn rasterize(lobes: &[SphericalGaussian], width: usize, height: usize) -> EnvironmentMap {
    Rasterizer::new(width, height).rasterize(lobes)
}

/// The derivative of `sum over texels and channels of adjoint * rasterize(lobes)` with respect
/// to each lobe. Panics unless there is one `adjoint` per texel.
pub fn rasterize_vjp(
    lobes: &[SphericalGaussian],
    width: usize,
    height: usize,
    adjoint: &[Vec3],
) -> Vec<LobeGradient> {
    Rasterizer::new(width, height).rasterize_vjp(lobes, adjoint)
}

/// Rasterises lobes on one grid again and again; holds what depends on the grid alone.
#[derive(Clone, Debug)]
pub struct Rasterizer {
    width: usize,
    height: usize,
    /// `cos phi`, `sin phi` of the nodes: `[rule][node][column]`.
    columns: [Vec<Vec<(f64, f64)>>; 3],
}

/// A lobe's place on the grid, and `h` and `sin(phi - phi_mu)` of every node.
struct Placed {
    radiance: Vec3,
    sigma2: f64,
    /// Width that the integrand resolves: a lobe wider than a radian still turns with the sphere.
    scale: f64,
    theta: f64,
    phi: f64,
    sin_theta: f64,
    cos_theta: f64,
    /// `[rule][node][column]`.
    h: [Vec<Vec<f32>>; 3],
    sin: [Vec<Vec<f32>>; 3],
}

/// One circle of latitude on which a lobe is evaluated.
struct Latitude {
    theta: f64,
    sin_theta: f64,
    /// Share of the cell's solid angle.
    weight: f64,
    a: f64,
    b: f64,
}

impl Rasterizer {
    /// A rasteriser for maps of `width` x `height` texels. Panics on an empty size.
    pub fn new(width: usize, height: usize) -> Self {
        assert!(width > 0 && height > 0, "{width} x {height} texels");
        let per_column = TAU / width as f64;
        let columns = NODES.map(|rule| {
            rule.iter()
                .map(|&(x, _)| {
                    let angle = |j: usize| (j as f64 + x) * per_column;
                    (0..width)
                        .map(|j| (angle(j).cos(), angle(j).sin()))
                        .collect()
                })
                .collect()
        });
        Self {
            width,
            height,
            columns,
        }
    }

    /// The map of `lobes`: each texel the mean of their sum over its cell.
    pub fn rasterize(&self, lobes: &[SphericalGaussian]) -> EnvironmentMap {
        let mut texels = vec![Vec3::ZERO; self.width * self.height];
        self.rasterize_into(lobes, &mut texels);
        EnvironmentMap::from_trusted(self.width, self.height, texels)
    }

    /// [`rasterize`](Self::rasterize) into existing memory, which it overwrites. Panics unless
    /// there is one entry per texel.
    pub fn rasterize_into(&self, lobes: &[SphericalGaussian], texels: &mut [Vec3]) {
        assert_eq!(texels.len(), self.width * self.height, "texels");
        let placed: Vec<Placed> = lobes.iter().map(|g| self.place_lobe(g)).collect();
        let rows = texels
            .par_chunks_mut(self.width * ROWS_PER_TASK)
            .enumerate();
        rows.for_each(|(task, chunk)| {
            let mut mean = vec![0f32; self.width];
            let mut planes = [(); 3].map(|()| vec![0f32; self.width]);
            for (k, row) in chunk.chunks_mut(self.width).enumerate() {
                planes.iter_mut().for_each(|p| p.fill(0.0));
                for lobe in &placed {
                    self.lobe_row(lobe, task * ROWS_PER_TASK + k, &mut planes, &mut mean);
                }
                for (j, texel) in row.iter_mut().enumerate() {
                    *texel = Vec3::new(planes[0][j], planes[1][j], planes[2][j]);
                }
            }
        });
    }

    /// The derivative of `sum over texels and channels of adjoint * rasterize(lobes)` with
    /// respect to each lobe, over the same nodes. Panics unless there is one entry per texel.
    pub fn rasterize_vjp(
        &self,
        lobes: &[SphericalGaussian],
        adjoint: &[Vec3],
    ) -> Vec<LobeGradient> {
        assert_eq!(adjoint.len(), self.width * self.height, "adjoints");
        let placed: Vec<Placed> = lobes.iter().map(|g| self.place_lobe(g)).collect();
        let gradient_of = |rows: std::ops::Range<usize>| {
            let mut gradients = vec![LobeGradient::default(); lobes.len()];
            let mut planes = Planes::new(self.width);
            for i in rows {
                planes.load(&adjoint[i * self.width..(i + 1) * self.width]);
                for (lobe, gradient) in placed.iter().zip(&mut gradients) {
                    self.lobe_row_vjp(lobe, i, &mut planes, gradient);
                }
            }
            gradients
        };
        let add = |mut a: Vec<LobeGradient>, b: Vec<LobeGradient>| {
            a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
            a
        };
        par_reduce(self.height, ROWS_PER_TASK, gradient_of, add).unwrap_or_default()
    }

    fn place_lobe(&self, lobe: &SphericalGaussian) -> Placed {
        let mu = lobe.direction.as_dvec3().normalize();
        self.place(mu, lobe.radiance, lobe.sigma.into())
    }

    fn place(&self, mu: DVec3, radiance: Vec3, sigma: f64) -> Placed {
        let sin_theta = mu.x.hypot(mu.z);
        let (sin_phi, cos_phi) = if sin_theta > 0.0 {
            (mu.x / sin_theta, -mu.z / sin_theta)
        } else {
            (0.0, 1.0)
        };
        let table = |f: &dyn Fn(f64, f64) -> f64| {
            [0, 1, 2].map(|rule| {
                let nodes = self.columns[rule].iter();
                nodes
                    .map(|n| n.iter().map(|&(c, s)| f(c, s) as f32).collect())
                    .collect()
            })
        };
        Placed {
            radiance,
            sigma2: sigma * sigma,
            scale: sigma.min(1.0),
            theta: sin_theta.atan2(mu.y),
            phi: sin_phi.atan2(cos_phi),
            sin_theta,
            cos_theta: mu.y,
            h: table(&|c, s| 0.5 * (1.0 - (c * cos_phi + s * sin_phi))),
            sin: table(&|c, s| s * cos_phi - c * sin_phi),
        }
    }

    /// The latitudes on which row `i` evaluates `lobe`; none where the lobe does not reach.
    fn latitudes(&self, lobe: &Placed, i: usize, mut visit: impl FnMut(Latitude)) {
        let step = PI / self.height as f64;
        let (low, high) = (i as f64 * step, (i + 1) as f64 * step);
        let area = 2.0 * (0.5 * (low + high)).sin() * (0.5 * step).sin();
        // 2 sin^2(reach / 2) = CUTOFF sigma^2
        let reach = 2.0 * (0.5 * CUTOFF * lobe.sigma2).min(1.0).sqrt().asin();
        let (rule, panels, low, high) = match node_count(step / lobe.scale) {
            Some(n) => (NODES[n - 1], 1, low, high),
            None => {
                let (low, high) = (low.max(lobe.theta - reach), high.min(lobe.theta + reach));
                let panels = ((high - low) / (MAX_STEP * lobe.scale)).ceil();
                (NODES[2], panels as usize, low, high)
            }
        };
        if high <= low || low > lobe.theta + reach || high < lobe.theta - reach {
            return;
        }
        let panel = (high - low) / panels as f64;
        let covered = 2.0 * (0.5 * (low + high)).sin() * (0.5 * (high - low)).sin();
        let nodes = (0..panels).flat_map(|p| rule.iter().map(move |&(x, w)| (p as f64 + x, w)));
        // Weights are scaled so that a constant is integrated exactly.
        let sum: f64 = nodes
            .clone()
            .map(|(x, w)| w * (low + x * panel).sin())
            .sum();
        for (x, w) in nodes {
            let theta = low + x * panel;
            let (sin_theta, half) = (theta.sin(), (0.5 * (theta - lobe.theta)).sin());
            let a = 2.0 * half * half / lobe.sigma2;
            if a < CUTOFF {
                visit(Latitude {
                    theta,
                    sin_theta,
                    weight: w * sin_theta / sum * covered / area,
                    a,
                    b: 2.0 * sin_theta * lobe.sin_theta / lobe.sigma2,
                });
            }
        }
    }

    /// Half the azimuth that `lobe` reaches on a latitude: all of it from pi on.
    fn reach(latitude: &Latitude) -> f64 {
        let h = (CUTOFF - latitude.a) / latitude.b;
        if h < 1.0 { 2.0 * h.sqrt().asin() } else { PI }
    }

    /// The width of a column in lobe widths. Close to a pole a lobe hardly depends on the azimuth
    /// but its derivative by the direction does, like a sine of it.
    fn column_step(&self, lobe: &Placed, latitude: &Latitude) -> f64 {
        let metric = (latitude.sin_theta * lobe.sin_theta).sqrt() / lobe.scale;
        let turning = (latitude.sin_theta / lobe.scale).min(1.0);
        TAU / self.width as f64 * metric.max(turning)
    }

    /// Contiguous columns that `half` either side of `phi` touches.
    fn column_runs(&self, phi: f64, half: f64) -> [std::ops::Range<usize>; 2] {
        let w = self.width;
        let per_column = TAU / w as f64;
        let low = ((phi - half) / per_column).floor();
        let count = ((phi + half) / per_column).floor() - low + 1.0;
        if half >= PI || count >= w as f64 {
            return [0..w, 0..0];
        }
        let start = (low as i64).rem_euclid(w as i64) as usize;
        let end = start + count as usize;
        [start..end.min(w), 0..end.saturating_sub(w)]
    }

    /// Adds the mean of `lobe` over each cell of row `i` to the row's three channels.
    fn lobe_row(&self, lobe: &Placed, i: usize, planes: &mut [Vec<f32>; 3], mean: &mut [f32]) {
        let mut touched = false;
        self.latitudes(lobe, i, |latitude| {
            if !touched {
                mean.fill(0.0);
                touched = true;
            }
            let half = Self::reach(&latitude);
            let nodes = node_count(self.column_step(lobe, &latitude));
            for run in self.column_runs(lobe.phi, half) {
                match nodes {
                    Some(n) => add_nodes(lobe, &latitude, n, run, mean),
                    None => self.panel_nodes(lobe, &latitude, half, run, |j, _, _, value| {
                        mean[j] += value as f32;
                    }),
                }
            }
        });
        if touched {
            for (plane, c) in planes.iter_mut().zip(lobe.radiance.to_array()) {
                for (p, &m) in plane.iter_mut().zip(mean.iter()) {
                    *p += c * m;
                }
            }
        }
    }

    /// Visits `(column, h, sin(phi - phi_mu), weighted value)` of panels over the part of each
    /// column that lies within `half` of the lobe.
    fn panel_nodes(
        &self,
        lobe: &Placed,
        latitude: &Latitude,
        half: f64,
        run: std::ops::Range<usize>,
        mut visit: impl FnMut(usize, f64, f64, f64),
    ) {
        let per_column = TAU / self.width as f64;
        let widths = self.column_step(lobe, latitude) / per_column;
        for j in run {
            // Relative to the lobe, the left side in [-pi, pi): the lobe spans [-half, half]
            // and, a turn later, [2 pi - half, 2 pi + half].
            let left = (j as f64 * per_column - lobe.phi + PI).rem_euclid(TAU) - PI;
            let right = left + per_column;
            let spans = [
                (left.max(-half), right.min(half)),
                (left.max(TAU - half), right.min(TAU + half)),
            ];
            for (low, high) in spans {
                if high <= low {
                    continue;
                }
                let panels = ((high - low) * widths / MAX_STEP).ceil().max(1.0);
                let panel = (high - low) / panels;
                for p in 0..panels as usize {
                    for &(x, w) in NODES[2] {
                        let phi = low + (p as f64 + x) * panel;
                        let s = (0.5 * phi).sin();
                        let value = (-(latitude.a + latitude.b * s * s)).exp();
                        let share = latitude.weight * w * panel / per_column;
                        visit(j, s * s, phi.sin(), share * value);
                    }
                }
            }
        }
    }

    /// Adds the derivative of `sum of adjoint * row i` with respect to `lobe`.
    fn lobe_row_vjp(
        &self,
        lobe: &Placed,
        i: usize,
        planes: &mut Planes,
        gradient: &mut LobeGradient,
    ) {
        let mut toned = false;
        self.latitudes(lobe, i, |latitude| {
            if !toned {
                planes.tone(lobe.radiance);
                toned = true;
            }
            let half = Self::reach(&latitude);
            let nodes = node_count(self.column_step(lobe, &latitude));
            let mut sums = Sums::default();
            for run in self.column_runs(lobe.phi, half) {
                match nodes {
                    Some(n) => sum_nodes(lobe, &latitude, n, run, planes, &mut sums),
                    None => self.panel_nodes(lobe, &latitude, half, run, |j, h, sin, value| {
                        sums.add(planes, j, h, sin, value);
                    }),
                }
            }
            add_gradient(lobe, &latitude, &sums, gradient);
        });
    }
}

/// The adjoint of one row, channel by channel, and its product with a lobe's radiance.
struct Planes {
    channels: [Vec<f32>; 3],
    toned: Vec<f32>,
}

impl Planes {
    fn new(width: usize) -> Self {
        Self {
            channels: [(); 3].map(|()| vec![0.0; width]),
            toned: vec![0.0; width],
        }
    }

    fn load(&mut self, row: &[Vec3]) {
        for (j, a) in row.iter().enumerate() {
            for (c, plane) in self.channels.iter_mut().enumerate() {
                plane[j] = a[c];
            }
        }
    }

    fn tone(&mut self, radiance: Vec3) {
        let [r, g, b] = &self.channels;
        for (j, t) in self.toned.iter_mut().enumerate() {
            *t = radiance.x * r[j] + radiance.y * g[j] + radiance.z * b[j];
        }
    }
}

/// Over one latitude: the lobe's value times the adjoint of each channel, and times the toned
/// adjoint with `h` and with `sin(phi - phi_mu)`.
#[derive(Default)]
struct Sums {
    channels: DVec3,
    h: f64,
    sin: f64,
}

impl Sums {
    fn add(&mut self, planes: &Planes, j: usize, h: f64, sin: f64, value: f64) {
        let [r, g, b] = &planes.channels;
        self.channels += DVec3::new(r[j].into(), g[j].into(), b[j].into()) * value;
        let toned = f64::from(planes.toned[j]) * value;
        self.h += toned * h;
        self.sin += toned * sin;
    }
}

/// Adds the mean over each column of `run`, `n` nodes a column.
fn add_nodes(
    lobe: &Placed,
    latitude: &Latitude,
    n: usize,
    run: std::ops::Range<usize>,
    mean: &mut [f32],
) {
    let (a, b) = (latitude.a as f32, latitude.b as f32);
    for (h, &(_, w)) in lobe.h[n - 1].iter().zip(NODES[n - 1]) {
        let weight = (latitude.weight * w) as f32;
        for (m, &h) in mean[run.clone()].iter_mut().zip(&h[run.clone()]) {
            *m += weight * exp_nonpositive(-(a + b * h));
        }
    }
}

/// Columns that [`sum_nodes`] takes at once: one vector register.
const LANES: usize = 8;

/// The adjoint of [`add_nodes`]: adds to `sums`. Eight running sums each, for the vector unit.
fn sum_nodes(
    lobe: &Placed,
    latitude: &Latitude,
    n: usize,
    run: std::ops::Range<usize>,
    planes: &Planes,
    sums: &mut Sums,
) {
    let (a, b) = (latitude.a as f32, latitude.b as f32);
    let whole = run.start + run.len() / LANES * LANES;
    for (k, &(_, w)) in NODES[n - 1].iter().enumerate() {
        let weight = (latitude.weight * w) as f32;
        let columns: [&[f32]; 6] = [
            &lobe.h[n - 1][k],
            &lobe.sin[n - 1][k],
            &planes.toned,
            &planes.channels[0],
            &planes.channels[1],
            &planes.channels[2],
        ];
        let mut lanes = [[0f32; LANES]; 5];
        let mut step = |[h, sin, toned, red, green, blue]: [[f32; LANES]; 6]| {
            for l in 0..LANES {
                let value = weight * exp_nonpositive(-(a + b * h[l]));
                lanes[0][l] += value * red[l];
                lanes[1][l] += value * green[l];
                lanes[2][l] += value * blue[l];
                let toned = value * toned[l];
                lanes[3][l] += toned * h[l];
                lanes[4][l] += toned * sin[l];
            }
        };
        for start in (run.start..whole).step_by(LANES) {
            step(columns.map(|c| {
                let mut block = [0f32; LANES];
                block.copy_from_slice(&c[start..start + LANES]);
                block
            }));
        }
        if whole < run.end {
            // The adjoint of a missing column is 0.
            step(columns.map(|c| {
                let mut block = [0f32; LANES];
                block[..run.end - whole].copy_from_slice(&c[whole..run.end]);
                block
            }));
        }
        let [r, g, b, h, sin] = lanes.map(|l| l.iter().map(|&x| f64::from(x)).sum::<f64>());
        sums.channels += DVec3::new(r, g, b);
        sums.h += h;
        sums.sin += sin;
    }
}

/// From sums over one latitude to the derivative: with `e = A + B h`, `d/d ln sigma = 2 e`, and
/// `d/d mu = v / sigma^2`, whose tangent components are written without cancellation.
fn add_gradient(lobe: &Placed, latitude: &Latitude, sums: &Sums, gradient: &mut LobeGradient) {
    let c = lobe.radiance.as_dvec3();
    gradient.log_radiance += c * sums.channels;
    let total = c.dot(sums.channels);
    gradient.log_sigma += 2.0 * (latitude.a * total + latitude.b * sums.h);
    let south = (latitude.theta - lobe.theta).sin() * total
        - 2.0 * latitude.sin_theta * lobe.cos_theta * sums.h;
    let around = latitude.sin_theta * sums.sin;
    let (sin_phi, cos_phi) = lobe.phi.sin_cos();
    let south_axis = DVec3::new(
        sin_phi * lobe.cos_theta,
        -lobe.sin_theta,
        -cos_phi * lobe.cos_theta,
    );
    let around_axis = DVec3::new(cos_phi, 0.0, sin_phi);
    gradient.direction += (south_axis * south + around_axis * around) / lobe.sigma2;
}

#[cfg(test)]
mod tests;
