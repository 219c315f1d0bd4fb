//! How two photographs of one place are exposed, from what both of them show.
use dipir_imaging::metrics::LUMA;
use dipir_imaging::raster::{LinearImage, Raster};
use glam::{DVec2, Vec2, Vec3};

use crate::camera::Camera;
use crate::pixels::ground_at;
use crate::proxy::Plane;

/// Cells along the longer side of a photograph.
const CELLS: usize = 192;
/// A cell is used if its mean is above this, and all its pixels stay below [`BRIGHTEST`]: cameras add noise to what is darker,
/// and each has its own curve for what is brighter.
const DARKEST: f32 = 0.01;
const BRIGHTEST: f32 = 0.6;
/// The cells that both show have to be more than one in so many of either.
const OVERLAP: usize = 5;
/// Ratios that agree, stops.
const ALIKE: f64 = 0.15;
/// Share of the cells, by weight, that have to agree. Where cameras moved far between photographs, half of them agree by chance
/// on a ratio that is wrong.
const SHARE: f64 = 0.6;
/// Distances of walls over the way between two cameras: nearer ones look otherwise from the other camera.
const AWAY: [f32; 5] = [4.0, 5.5, 8.0, 14.0, 30.0];
/// Width of a bin of ratios, stops.
const BIN: f64 = 0.02;
/// Largest ratio, stops.
const MOST: f64 = 12.0;
/// Deviation that a cell has without detail, stops.
const NOISE: f32 = 0.05;

/// A photograph in square cells of equal brightness, and its camera.
#[derive(Clone, Debug)]
pub struct Cells {
    camera: Camera,
    /// Pixels along a side of a cell.
    side: f32,
    /// Mean luminance of each cell, stops; NaN where it is too dark or too bright.
    stops: Raster<f32>,
    /// Variance among the cell and its neighbours, square stops: what a shift of a cell may change.
    detail: Raster<f32>,
}

impl Cells {
    /// The cells of what `camera` took. `rolled_off` undoes the curve `x / (1 + x)`: the exposure that objects need which go
    /// through it.
    pub fn new(image: &LinearImage, camera: Camera, rolled_off: bool) -> Self {
        let image = &image.0;
        let light = |shown: Vec3| match rolled_off {
            true => shown / (Vec3::ONE - shown).max(Vec3::splat(1.0 - BRIGHTEST)),
            false => shown,
        };
        let side = image.width().max(image.height()).div_ceil(CELLS);
        let (width, height) = (image.width() / side, image.height() / side);
        let mean = |n: usize| {
            let (x, y) = (n % width * side, n / width * side);
            let (mut sum, mut most) = (Vec3::ZERO, f32::NEG_INFINITY);
            for j in y..y + side {
                for pixel in &image.pixels()[j * image.width() + x..][..side] {
                    sum += light(*pixel);
                    most = most.max(pixel.max_element());
                }
            }
            let mean = (sum / (side * side) as f32).dot(LUMA);
            match mean > DARKEST && most < BRIGHTEST {
                true => mean.log2(),
                false => f32::NAN,
            }
        };
        let stops = Raster::from_pixels(width, height, (0..width * height).map(mean).collect());
        let detail = |n: usize| variance_around(&stops, n % width, n / width);
        let detail = (0..width * height).map(detail).collect();
        Self {
            camera,
            side: side as f32,
            detail: Raster::from_pixels(width, height, detail),
            stops,
        }
    }

    /// How much more `other` is exposed than this photograph, stops; `None` if they have too little in common.
    ///
    /// What they have in common is looked for on `ground`, on walls that this camera faces, at [`AWAY`] times the way between
    /// the cameras, and far away. That on which most agrees tells. Of a camera whose place is not known nothing near can be
    /// met: it is to have the place of the other.
    pub fn stops_to(&self, other: &Self, ground: Option<&Plane>) -> Option<f64> {
        let [from, to] = [self, other].map(|cells| cells.camera.position);
        let ahead = -self.camera.rotation.z_axis;
        let wall = |away: f32| Plane {
            point: from + away * from.distance(to) * ahead,
            normal: -ahead,
        };
        let walls = AWAY.map(wall).into_iter().filter(|_| from != to);
        let planes = ground.copied().into_iter().chain(walls).map(Some);
        let all = planes.chain([None]);
        let agreed = all.filter_map(|plane| self.agreement(other, plane.as_ref()));
        let best = agreed.max_by(|a, b| a.1.total_cmp(&b.1));
        let told = best.filter(|(_, share)| *share >= SHARE);
        told.map(|(stops, _)| stops)
    }

    /// The ratio of brightness on which most cells agree, stops, and their share by weight.
    fn agreement(&self, other: &Self, plane: Option<&Plane>) -> Option<(f64, f64)> {
        let width = self.stops.width();
        let mut ratios = Vec::new();
        for (n, (&own, detail)) in self
            .stops
            .pixels()
            .iter()
            .zip(self.detail.pixels())
            .enumerate()
        {
            let at = Vec2::new((n % width) as f32 + 0.5, (n / width) as f32 + 0.5) * self.side;
            if own.is_nan() {
                continue;
            }
            let Some((theirs, of_theirs)) = other.cell_of(&self.camera, at, plane) else {
                continue;
            };
            let weight = (detail + of_theirs + NOISE * NOISE).recip();
            ratios.push((f64::from(theirs - own), f64::from(weight)));
        }
        let fewest = self.used().max(other.used()) / OVERLAP;
        (ratios.len() > fewest).then(|| peak(&ratios))
    }

    /// Number of cells that are neither too dark nor too bright.
    fn used(&self) -> usize {
        self.stops.pixels().iter().filter(|s| !s.is_nan()).count()
    }

    /// The cell that shows what `camera` sees at `pixel`: its brightness and detail.
    fn cell_of(&self, camera: &Camera, pixel: Vec2, plane: Option<&Plane>) -> Option<(f32, f32)> {
        let pixel64 = DVec2::new(f64::from(pixel.x), f64::from(pixel.y));
        let on_plane = plane.and_then(|plane| ground_at(camera, plane, pixel64));
        let (point, from) = match on_plane {
            Some(point) => (point.as_vec3(), self.camera),
            // Far away: where the cameras stand does not count.
            None => {
                let here = Camera {
                    position: Vec3::ZERO,
                    ..self.camera
                };
                (camera.ray(pixel).direction, here)
            }
        };
        let at = (from.project(point)? / self.side).floor();
        let (width, height) = (self.stops.width(), self.stops.height());
        if !(at.cmpge(Vec2::ZERO).all() && at.x < width as f32 && at.y < height as f32) {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let stops = *self.stops.get(x, y);
        (!stops.is_nan()).then(|| (stops, *self.detail.get(x, y)))
    }
}

/// The variance of the cells around a cell, itself among them; of those that are used.
fn variance_around(stops: &Raster<f32>, x: usize, y: usize) -> f32 {
    let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0);
    for j in y.saturating_sub(1)..=(y + 1).min(stops.height() - 1) {
        for i in x.saturating_sub(1)..=(x + 1).min(stops.width() - 1) {
            let s = *stops.get(i, j);
            if !s.is_nan() {
                (sum, squares, n) = (sum + s, squares + s * s, n + 1.0);
            }
        }
    }
    let n = f32::max(n, 1.0);
    (squares / n - (sum / n) * (sum / n)).max(0.0)
}

/// Where the weights of `ratios` are densest, and the share of them within [`ALIKE`] of it.
fn peak(ratios: &[(f64, f64)]) -> (f64, f64) {
    let bins = (2.0 * MOST / BIN) as usize;
    let reach = (ALIKE / BIN) as usize;
    let mut weights = vec![0.0; bins];
    for (ratio, weight) in ratios {
        let bin = ((ratio + MOST) / BIN).clamp(0.0, (bins - 1) as f64);
        weights[bin as usize] += weight;
    }
    // A triangle: in a window of equal weights neighbours would be as dense as a single ratio.
    let around = |k: usize| -> f64 {
        let near = k.saturating_sub(reach)..(k + reach + 1).min(bins);
        near.map(|j| weights[j] * (reach + 1 - j.abs_diff(k)) as f64)
            .sum()
    };
    let densest = (0..bins).max_by(|&a, &b| f64::total_cmp(&around(a), &around(b)));
    let mut at = (densest.unwrap_or_default() as f64 + 0.5) * BIN - MOST;
    let mut within = 0.0;
    for _ in 0..3 {
        let (mut sum, mut weight) = (0.0, 0.0);
        for (ratio, w) in ratios
            .iter()
            .filter(|(ratio, _)| (ratio - at).abs() <= ALIKE)
        {
            (sum, weight) = (sum + ratio * w, weight + w);
        }
        if weight > 0.0 {
            (at, within) = (sum / weight, weight);
        }
    }
    let total: f64 = ratios.iter().map(|(_, w)| w).sum();
    (at, within / total)
}

#[cfg(test)]
mod tests {
    use glam::Mat3;

    use super::*;

    fn camera(x_m: f32, heading_rad: f32) -> Camera {
        Camera {
            position: Vec3::new(x_m, 1.5, 0.0),
            rotation: Mat3::from_rotation_y(-heading_rad) * Mat3::from_rotation_x(-0.2),
            focal_px: Vec2::splat(300.0),
            principal_px: Vec2::new(160.0, 120.0),
            resolution: [320, 240],
        }
    }

    /// Ground with patches 40 cm long, and a sky that changes with the direction.
    fn seen(camera: Camera, gain: f32) -> Cells {
        let image = seen_image(camera).0.map(|p| *p * gain);
        Cells::new(&LinearImage(image), camera, false)
    }

    fn seen_image(camera: Camera) -> LinearImage {
        let ground = Plane {
            point: Vec3::ZERO,
            normal: Vec3::Y,
        };
        let patch = |a: f32, b: f32| {
            let n = ((a / 0.4).floor() as i64 * 7919 + (b / 0.4).floor() as i64 * 104729)
                .rem_euclid(97);
            0.05 + 0.3 * n as f32 / 97.0
        };
        let pixel = |n: usize| {
            let at = Vec2::new((n % 320) as f32 + 0.5, (n / 320) as f32 + 0.5);
            let value = match ground_at(&camera, &ground, DVec2::new(at.x.into(), at.y.into())) {
                Some(p) => patch(p.x as f32, p.z as f32),
                None => {
                    let d = camera.ray(at).direction;
                    0.2 + 0.1 * (9.0 * d.x).sin() * (7.0 * d.y).cos()
                }
            };
            Vec3::splat(value)
        };
        LinearImage(Raster::from_pixels(
            320,
            240,
            (0..320 * 240).map(pixel).collect(),
        ))
    }

    const GROUND: Plane = Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    };

    #[test]
    fn photographs_from_other_places_tell_their_exposure_by_the_ground() {
        let first = seen(camera(0.0, 0.0), 1.0);
        for (x_m, heading_rad, stops) in [
            (0.5, 0.1, 0.7),
            (-1.0, -0.2, -1.1),
            (0.0, 0.0, 0.0),
            (0.3, 0.0, -0.03),
        ] {
            let other = seen(camera(x_m, heading_rad), f32::exp2(stops));
            let told = first.stops_to(&other, Some(&GROUND)).unwrap();
            // Cells that straddle two patches have either's brightness; they weigh little.
            assert!((told - f64::from(stops)).abs() < 0.02, "{told} {stops}");
            let back = other.stops_to(&first, Some(&GROUND)).unwrap();
            assert!((back + told).abs() < 0.02, "{back} {told}");
        }
    }

    #[test]
    fn a_curve_is_undone() {
        let rolled = |gain: f32| {
            let rolled = |p: &Vec3| *p * gain / (Vec3::ONE + *p * gain);
            let image = seen_image(camera(0.0, 0.0)).0.map(rolled);
            Cells::new(&LinearImage(image), camera(0.0, 0.0), true)
        };
        let told = rolled(1.0).stops_to(&rolled(2.0), None).unwrap();
        assert!((told - 1.0).abs() < 1e-4, "{told}");
    }

    #[test]
    fn cameras_that_only_turn_need_no_ground() {
        let first = seen(camera(0.0, 0.0), 1.0);
        let other = seen(camera(0.0, 0.4), 0.5);
        let told = first.stops_to(&other, None).unwrap();
        assert!((told + 1.0).abs() < 0.02, "{told}");
    }

    #[test]
    fn what_passes_by_does_not_count() {
        let first = seen(camera(0.0, 0.0), 1.0);
        let mut other = seen(camera(0.2, 0.0), 0.8);
        // A dark bus over the left third.
        let width = other.stops.width();
        let cells = other.stops.pixels_mut().iter_mut().enumerate();
        cells
            .filter(|(n, _)| n % width < width / 3)
            .for_each(|(_, s)| *s = -5.0);
        let told = first.stops_to(&other, Some(&GROUND)).unwrap();
        assert!((told - 0.8f64.log2()).abs() < 0.02, "{told}");
    }

    #[test]
    fn photographs_without_anything_in_common_tell_nothing() {
        let first = seen(camera(0.0, 0.0), 1.0);
        // Turned away, and beside a place that looks otherwise.
        assert_eq!(
            first.stops_to(&seen(camera(0.0, 2.5), 1.0), Some(&GROUND)),
            None
        );
        assert_eq!(first.stops_to(&seen(camera(50.0, 1.0), 1.0), None), None);
        // White and black have no brightness.
        assert_eq!(
            first.stops_to(&seen(camera(0.0, 0.0), 40.0), Some(&GROUND)),
            None
        );
        assert_eq!(
            first.stops_to(&seen(camera(0.0, 0.0), 0.01), Some(&GROUND)),
            None
        );
    }
}
