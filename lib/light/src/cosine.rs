//! Light on a plane: environment maps weighted by the cosine to a fixed normal.
//!
//! The integral of `max(0, n . w)` over every texel is exact, so the irradiance of the plane is
//! a sum and not an estimate, and directions can be drawn in proportion to what they add to it,
//! also from only those texels that a cone touches (`crate::cone`).
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::cone::ConeSampler;
use crate::environment::{EnvironmentMap, solid_angle};
use crate::luminance::{luminance, luminance_f64};
use crate::quadrature::integrate_pieces;

/// Rows are grouped into at most this many bands for cone queries: a query costs one arc cosine
/// a band, and finer bands would no longer fit a cone of a few degrees better.
const MAX_BANDS: usize = 64;

/// Columns per slot of a row's guide table: few enough to share a cache line or two.
const PER_SLOT: usize = 4;

/// An environment map seen by a plane: texel weights `luminance * integral of max(0, n . w)`.
#[derive(Clone, Debug)]
pub struct CosineWeightedMap {
    pub(crate) map: Arc<EnvironmentMap>,
    pub(crate) normal: Vec3,
    /// Mean of `max(0, n . w)` over each texel.
    pub(crate) mean_cosine: Vec<f32>,
    /// Per row, running sums of the weight: `W + 1` entries, the first 0.
    pub(crate) row_prefix: Vec<f64>,
    /// Per row, guide tables into its running sums: per slot, the first column that ends above
    /// the slot's start; then the last column.
    guide: Vec<u32>,
    pub(crate) band_rows: usize,
    /// `cos` of the polar angle between rows, `H + 1` of them.
    pub(crate) row_cos: Vec<f64>,
    /// 1 or -1 for a normal of +y or -y.
    pub(crate) level: Option<f64>,
    irradiance: DVec3,
}

impl CosineWeightedMap {
    /// Weights `map` by the cosine to the unit vector `normal`.
    pub fn new(map: impl Into<Arc<EnvironmentMap>>, normal: Vec3) -> Self {
        let map = map.into();
        let (w, h) = (map.width(), map.height());
        let cells = CosineCells::new(w, h, normal);
        let mut mean_cosine = vec![0f32; w * h];
        let mut row_prefix = vec![0f64; (w + 1) * h];
        let row_irradiance: Vec<DVec3> = mean_cosine
            .par_chunks_mut(w)
            .zip(row_prefix.par_chunks_mut(w + 1))
            .enumerate()
            .map(|(i, (means, prefix))| {
                let area = map.solid_angle(i);
                let mut sum = DVec3::ZERO;
                for j in 0..w {
                    let integral = cells.integral(i, j);
                    let radiance = map.texel(i, j);
                    sum += radiance.as_dvec3() * integral;
                    means[j] = (integral / area) as f32;
                    let weight = f64::from(luminance(radiance)) * f64::from(means[j]) * area;
                    prefix[j + 1] = prefix[j] + weight;
                }
                sum
            })
            .collect();
        let slots = w.div_ceil(PER_SLOT);
        let mut guide = vec![0u32; (slots + 1) * h];
        guide
            .par_chunks_mut(slots + 1)
            .zip(row_prefix.par_chunks(w + 1))
            .for_each(|(guide, prefix)| fill_guide(prefix, guide));
        Self {
            row_cos: (0..=h).map(|i| (PI * i as f64 / h as f64).cos()).collect(),
            irradiance: row_irradiance.iter().sum(),
            level: (normal.x == 0.0 && normal.z == 0.0).then_some(f64::from(normal.y).signum()),
            map,
            normal,
            mean_cosine,
            row_prefix,
            guide,
            band_rows: h.div_ceil(MAX_BANDS),
        }
    }

    /// The map.
    pub fn map(&self) -> &Arc<EnvironmentMap> {
        &self.map
    }

    /// The plane's unit normal.
    pub fn normal(&self) -> Vec3 {
        self.normal
    }

    /// Irradiance of the unoccluded plane, per channel: the sum over all texels of radiance
    /// times the exact integral of `max(0, n . w)`.
    pub fn irradiance(&self) -> DVec3 {
        self.irradiance
    }

    /// Luminance of [`irradiance`](Self::irradiance).
    pub fn luminance_irradiance(&self) -> f64 {
        luminance_f64(self.irradiance)
    }

    #[inline]
    pub(crate) fn row_prefix(&self, i: usize) -> &[f64] {
        let n = self.map.width() + 1;
        &self.row_prefix[i * n..(i + 1) * n]
    }

    /// The column of row `i` where the running sum over `count` columns from `start`, wrapping
    /// around, passes `target`, and where in it, in `[0, 1]`. The interval must hold light.
    #[inline]
    pub(crate) fn pick_column(
        &self,
        i: usize,
        start: usize,
        count: usize,
        target: f64,
    ) -> (usize, f32) {
        let prefix = self.row_prefix(i);
        let w = prefix.len() - 1;
        let slots = w.div_ceil(PER_SLOT);
        let guide = &self.guide[i * (slots + 1)..(i + 1) * (slots + 1)];
        let mut target = prefix[start] + target;
        let (mut low, mut high) = (start, (start + count).min(w));
        if start + count > w && target >= prefix[w] {
            target -= prefix[w];
            (low, high) = (0, start + count - w);
        }
        let slot = ((target / prefix[w] * slots as f64) as usize).min(slots - 1);
        let from = (guide[slot] as usize).clamp(low, high - 1);
        let to = (guide[slot + 1] as usize).clamp(from, high - 1);
        let mut column = from + prefix[from + 1..=to].partition_point(|&p| p <= target);
        // Past the end by rounding: the last column that has any light.
        while column > low && prefix[column + 1] <= prefix[column] {
            column -= 1;
        }
        let fraction = (target - prefix[column]) / (prefix[column + 1] - prefix[column]);
        (column, fraction.clamp(0.0, 1.0) as f32)
    }

    /// A sampler over this map, to be restricted to one cone after another without allocating.
    pub fn cone(&self) -> ConeSampler<'_> {
        ConeSampler::new(self)
    }
}

/// Fills the guide table of one row's running sums.
fn fill_guide(prefix: &[f64], guide: &mut [u32]) {
    let (w, slots) = (prefix.len() - 1, guide.len() - 1);
    let mut column = 0;
    for (slot, first) in guide[..slots].iter_mut().enumerate() {
        let start = prefix[w] * slot as f64 / slots as f64;
        while column + 1 < w && prefix[column + 1] <= start {
            column += 1;
        }
        *first = column as u32;
    }
    let lit = prefix.partition_point(|&p| p < prefix[w]);
    guide[slots] = lit.saturating_sub(1) as u32;
}

/// Integrals of `max(0, n . w)` over the cells of a latitude-longitude grid.
///
/// With `theta`, `phi` as in [`crate::environment`], `n . w = n_y cos theta + rho sin theta
/// cos(phi - phi_n)`. A cell wholly above the horizon has a closed form; a cell that the horizon
/// crosses has a closed form in `phi` and is integrated in `theta` between the angles where the
/// horizon meets the cell's sides or turns.
pub struct CosineCells {
    width: usize,
    height: usize,
    normal: [f64; 2],
    phi_n: f64,
    /// `integral of cos theta sin theta` over a row, times the cell's width in azimuth.
    row_vertical: Vec<f64>,
    /// `integral of sin^2 theta` over a row, times the integral of `cos` at a cell's centre.
    row_horizontal: Vec<f64>,
    /// `cos(phi - phi_n)` at each column's centre.
    column_cos: Vec<f64>,
    /// `cos theta` and `sin theta` at each row's centre, and the sine of the largest angle
    /// between a cell's centre and its other points.
    row_centre: Vec<(f64, f64, f64)>,
}

impl CosineCells {
    /// Prepares for cells of a `width` x `height` map and the unit vector `normal`.
    pub fn new(width: usize, height: usize, normal: Vec3) -> Self {
        let n = normal.as_dvec3().normalize();
        let rho = n.x.hypot(n.z);
        let phi_n = if rho > 0.0 { n.x.atan2(-n.z) } else { 0.0 };
        let (dphi, dtheta) = (TAU / width as f64, PI / height as f64);
        let middle = |i: usize| (i as f64 + 0.5) * dtheta;
        // sin^2 b - sin^2 a and its like, as products: no digits are lost in small cells.
        let row_vertical = (0..height)
            .map(|i| 0.5 * (2.0 * middle(i)).sin() * dtheta.sin() * dphi)
            .collect();
        let row_horizontal = (0..height)
            .map(|i| {
                let sin2 = 0.5 * (dtheta - (2.0 * middle(i)).cos() * dtheta.sin());
                sin2 * 2.0 * (0.5 * dphi).sin()
            })
            .collect();
        let column_cos = (0..width)
            .map(|j| ((j as f64 + 0.5) * dphi - phi_n).cos())
            .collect();
        let row_centre = (0..height)
            .map(|i| {
                // Along the meridian first, then along the parallel at most this long.
                let (low, high) = (i as f64 * dtheta, (i + 1) as f64 * dtheta);
                let widest = if low <= PI / 2.0 && high >= PI / 2.0 {
                    1.0
                } else {
                    low.sin().max(high.sin())
                };
                let radius = 0.5 * dtheta + 0.5 * dphi * widest;
                // A cell that spans more than a hemisphere always meets the horizon.
                let reach = if radius < PI / 2.0 { radius.sin() } else { 2.0 };
                (middle(i).cos(), middle(i).sin(), reach)
            })
            .collect();
        Self {
            width,
            height,
            normal: [n.y, rho],
            phi_n,
            row_vertical,
            row_horizontal,
            column_cos,
            row_centre,
        }
    }

    /// The integral of `max(0, n . w)` over texel `(i, j)`, in steradians.
    #[inline]
    pub fn integral(&self, i: usize, j: usize) -> f64 {
        let [n_y, rho] = self.normal;
        let (cos, sin, reach) = self.row_centre[i];
        let centre = n_y * cos + rho * sin * self.column_cos[j];
        if centre >= reach {
            n_y * self.row_vertical[i] + rho * self.row_horizontal[i] * self.column_cos[j]
        } else if centre <= -reach {
            0.0
        } else {
            self.crossed(i, j)
        }
    }

    /// A cell that the horizon may cross.
    #[cold]
    fn crossed(&self, i: usize, j: usize) -> f64 {
        let [n_y, rho] = self.normal;
        let (dphi, dtheta) = (TAU / self.width as f64, PI / self.height as f64);
        // Azimuths relative to the normal's, the left one in [-pi, pi).
        let left = (j as f64 * dphi - self.phi_n + PI).rem_euclid(TAU) - PI;
        let right = left + dphi;
        let crossing = |x: f64| (-n_y).atan2(rho * x.cos()).rem_euclid(PI);
        let turn = n_y.abs().atan2(rho);
        let mut breaks = [crossing(left), crossing(right), turn, PI - turn];
        let (low, high) = (i as f64 * dtheta, (i + 1) as f64 * dtheta);
        integrate_pieces(low, high, &mut breaks, |theta| {
            let (sin, cos) = theta.sin_cos();
            sin * positive_part(n_y * cos, rho * sin, left, right)
        })
        .max(0.0)
    }

    /// The integral over the whole texel grid must be pi; exposed for rows at a time.
    pub fn row(&self, i: usize) -> impl Iterator<Item = f64> + '_ {
        (0..self.width).map(move |j| self.integral(i, j))
    }

    /// Solid angle of a cell of row `i`.
    pub fn solid_angle(&self, i: usize) -> f64 {
        solid_angle(self.width, self.height, i)
    }
}

/// The integral of `max(0, a + b cos x)` for `x` from `left` in `[-pi, pi)` to `right`, at most a
/// turn further; `b >= 0`.
pub(crate) fn positive_part(a: f64, b: f64, left: f64, right: f64) -> f64 {
    let between = |l: f64, r: f64| {
        if r > l {
            a * (r - l) + b * (r.sin() - l.sin())
        } else {
            0.0
        }
    };
    if a >= b {
        return between(left, right);
    }
    if a <= -b {
        return 0.0;
    }
    // Positive where cos x > -a / b: around 0, and around the next turn.
    let half = (-a / b).clamp(-1.0, 1.0).acos();
    between(left.max(-half), right.min(half)) + between(left.max(TAU - half), right.min(TAU + half))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{cell_integral, directions, speckled};

    #[test]
    fn the_cosine_integrates_to_pi_for_every_normal_and_grid() {
        for (w, h) in [(2, 1), (1, 1), (1, 2), (3, 5), (16, 8), (128, 64)] {
            for normal in directions() {
                let cells = CosineCells::new(w, h, normal);
                let sum: f64 = (0..h)
                    .flat_map(|i| (0..w).map(move |j| (i, j)))
                    .map(|(i, j)| cells.integral(i, j))
                    .sum();
                // Sixteen nodes leave 1e-7 where the horizon is tangent to a cell's row.
                assert!((sum / PI - 1.0).abs() < 1e-6, "{w} x {h}, {normal}: {sum}");
            }
        }
    }

    #[test]
    fn every_cell_agrees_with_midpoint_quadrature() {
        for (w, h) in [(2, 1), (3, 4), (16, 8)] {
            for normal in directions() {
                let cells = CosineCells::new(w, h, normal);
                let n = normal.as_dvec3().normalize();
                for (i, j) in (0..h).flat_map(|i| (0..w).map(move |j| (i, j))) {
                    let points = 640 / w;
                    let reference = cell_integral((w, h), (i, j), points, |d| d.dot(n).max(0.0));
                    let area = solid_angle(w, h, i);
                    // Midpoints 0.01 apart miss the kink by their squared step.
                    let error = (cells.integral(i, j) - reference).abs() / area;
                    assert!(error < 2e-4, "{w} x {h}, {normal}, cell {i} {j}: {error}");
                }
            }
        }
    }

    #[test]
    fn a_constant_sky_gives_pi_times_its_radiance() {
        for normal in directions() {
            let sky = EnvironmentMap::constant(32, 16, Vec3::new(1.0, 2.0, 0.5));
            let e = CosineWeightedMap::new(sky, normal).irradiance();
            assert!(
                (e - PI * DVec3::new(1.0, 2.0, 0.5)).abs().max_element() < 1e-5,
                "{normal}: {e}"
            );
        }
    }

    #[test]
    fn the_irradiance_is_the_sum_over_the_map_at_any_contrast() {
        let mut map = speckled(16, 8);
        let mut texels = map.texels().to_vec();
        texels[2 * 16 + 9] = Vec3::splat(1e6);
        map = EnvironmentMap::new(16, 8, texels).unwrap();
        let normal = Vec3::new(0.2, 0.9, -0.4).normalize();
        let n = normal.as_dvec3().normalize();
        let mut reference = DVec3::ZERO;
        for (i, j) in (0..8).flat_map(|i| (0..16).map(move |j| (i, j))) {
            let cosine = cell_integral((16, 8), (i, j), 64, |d| d.dot(n).max(0.0));
            reference += map.texel(i, j).as_dvec3() * cosine;
        }
        let ours = CosineWeightedMap::new(map, normal);
        assert!(
            ((ours.irradiance() - reference) / reference)
                .abs()
                .max_element()
                < 1e-4
        );
        let luminance = ours.luminance_irradiance();
        let mut cone = ours.cone();
        cone.restrict(Vec3::Y, -1.0);
        assert!((cone.mass() / luminance - 1.0).abs() < 1e-6);
    }
}
