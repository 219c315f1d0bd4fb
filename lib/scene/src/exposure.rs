//! How two photographs of one place are exposed and tinted beside each other, from what both of them show.
use dipir_imaging::metrics::LUMA;
use dipir_imaging::raster::{LinearImage, Raster};
use glam::{DVec2, DVec3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::pixels::ground_at;
use crate::proxy::Plane;

/// Cells along the longer side of a photograph.
const CELLS: usize = 192;
/// A cell is used if its mean is above this, and all its pixels stay below [`BRIGHTEST`]: cameras add noise to what is darker,
/// and each has its own curve for what is brighter.
const DARKEST: f32 = 0.01;
const BRIGHTEST: f32 = 0.6;
/// A cell tells of tints if its channels are between [`DARKEST`] and this: curves bleach what is brighter, by how much depends on
/// the exposure.
const BLEACHED: f32 = 0.25;
/// Of the cells that agree more than one in so many have to tell of tints.
const COLOURED: usize = 20;
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

/// Exposures that differ by less are one, stops: neighbours agree to this.
const UNCERTAIN: f64 = 0.05;
/// Tints below this are none, stops: with one white balance 1 in 50 pairs of photographs tells more.
const UNTINTED: f64 = 0.05;

/// How much more a photograph is exposed than another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Stops.
    pub stops: f64,
    /// Stops of red, green and blue beside that, which leave grey as bright as it is; `None` where nothing tells them.
    pub tint: Option<[f64; 3]>,
}

impl Exposure {
    /// Exposed alike.
    pub const SAME: Self = Self {
        stops: 0.0,
        tint: Some([0.0; 3]),
    };

    /// How much more the third of three photographs is exposed than the first: this is the second over the first, `more` the
    /// third over the second.
    pub fn and(self, more: Self) -> Self {
        let tints = self.tint.zip(more.tint);
        Self {
            stops: self.stops + more.stops,
            tint: tints.map(|(a, b)| (DVec3::from(a) + DVec3::from(b)).to_array()),
        }
    }

    /// Without what measuring leaves uncertain. Values are shrunk, not cut off: what drifts away from the same does not jump.
    pub fn certain(self) -> Self {
        let shrunk = |tint: [f64; 3]| {
            let tint = DVec3::from(tint);
            let part = (UNTINTED / tint.abs().max_element()).min(1.0);
            (tint * (1.0 - part * part)).to_array()
        };
        Self {
            stops: self.stops.signum() * (self.stops.abs() - UNCERTAIN).max(0.0),
            tint: self.tint.map(shrunk),
        }
    }
}

/// A photograph in square cells of equal brightness, and its camera.
#[derive(Clone, Debug)]
pub struct Cells {
    camera: Camera,
    /// Pixels along a side of a cell.
    side: f32,
    /// Mean luminance of each cell, stops; NaN where it is too dark or too bright.
    stops: Raster<f32>,
    /// Mean of each channel, stops; NaN where it tells nothing of tints.
    channels: Raster<Vec3>,
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
            let mean = sum / (side * side) as f32;
            let luminance = mean.dot(LUMA);
            if !(luminance > DARKEST && most < BRIGHTEST) {
                return (f32::NAN, Vec3::NAN);
            }
            let is_told = mean.min_element() > DARKEST && mean.max_element() < BLEACHED;
            let channels = if is_told {
                mean.map(f32::log2)
            } else {
                Vec3::NAN
            };
            (luminance.log2(), channels)
        };
        let (stops, channels) = (0..width * height).map(mean).unzip();
        let stops = Raster::from_pixels(width, height, stops);
        let detail = |n: usize| variance_around(&stops, n % width, n / width);
        let detail = (0..width * height).map(detail).collect();
        Self {
            camera,
            side: side as f32,
            detail: Raster::from_pixels(width, height, detail),
            channels: Raster::from_pixels(width, height, channels),
            stops,
        }
    }

    /// As [`exposure_to`](Self::exposure_to), the stops alone.
    pub fn stops_to(&self, other: &Self, ground: Option<&Plane>) -> Option<f64> {
        self.exposure_to(other, ground).map(|told| told.stops)
    }

    /// How much more `other` is exposed than this photograph; `None` if they have too little in common.
    ///
    /// What they have in common is looked for on `ground`, on walls that this camera faces, at [`AWAY`] times the way between
    /// the cameras, and far away. That on which most agrees tells. Of a camera whose place is not known nothing near can be
    /// met: it is to have the place of the other.
    pub fn exposure_to(&self, other: &Self, ground: Option<&Plane>) -> Option<Exposure> {
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
        let (stops, _, cells) = best.filter(|(_, share, _)| *share >= SHARE)?;
        let tint = tint(&cells, stops);
        Some(Exposure { stops, tint })
    }

    /// The ratio of brightness on which most cells agree, stops, their share by weight, and all that both show.
    fn agreement(&self, other: &Self, plane: Option<&Plane>) -> Option<(f64, f64, Vec<Ratio>)> {
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
            let Some(theirs) = other.cell_of(&self.camera, at, plane) else {
                continue;
            };
            let weight = (detail + other.detail.pixels()[theirs] + NOISE * NOISE).recip();
            ratios.push(Ratio {
                stops: f64::from(other.stops.pixels()[theirs] - own),
                channels: (other.channels.pixels()[theirs] - self.channels.pixels()[n]).as_dvec3(),
                weight: f64::from(weight),
            });
        }
        let fewest = self.used().max(other.used()) / OVERLAP;
        if ratios.len() <= fewest {
            return None;
        }
        let stops: Vec<_> = ratios.iter().map(|r| (r.stops, r.weight)).collect();
        let (stops, share) = peak(&stops);
        Some((stops, share, ratios))
    }

    /// Number of cells that are neither too dark nor too bright.
    fn used(&self) -> usize {
        self.stops.pixels().iter().filter(|s| !s.is_nan()).count()
    }

    /// The cell that shows what `camera` sees at `pixel`, if it is neither too dark nor too bright.
    fn cell_of(&self, camera: &Camera, pixel: Vec2, plane: Option<&Plane>) -> Option<usize> {
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
        let n = at.y as usize * width + at.x as usize;
        (!self.stops.pixels()[n].is_nan()).then_some(n)
    }
}

/// A cell beside that of the other photograph.
struct Ratio {
    /// Of luminance, stops.
    stops: f64,
    /// Of each channel, stops; NaN where one of the cells tells nothing of tints.
    channels: DVec3,
    weight: f64,
}

/// The tint on which most of those cells agree that differ by `stops`, in stops as [`Exposure`] has it. What has another colour
/// than it had, such as a car that came, is not among the most.
fn tint(cells: &[Ratio], stops: f64) -> Option<[f64; 3]> {
    let alike = cells.iter().filter(|r| (r.stops - stops).abs() <= ALIKE);
    let count = alike.clone().count();
    let coloured: Vec<_> = alike.filter(|r| !r.channels.is_nan()).collect();
    if coloured.len() <= count / COLOURED {
        return None;
    }
    let mut tint = [0.0; 3];
    for (channel, tint) in tint.iter_mut().enumerate() {
        let ratios = coloured.iter().map(|r| (r.channels[channel], r.weight));
        let (stops, share) = peak(&ratios.collect::<Vec<_>>());
        if share < SHARE {
            return None;
        }
        *tint = stops;
    }
    let grey = DVec3::from(tint).exp2().dot(LUMA.as_dvec3()).log2();
    Some(tint.map(|stops| stops - grey))
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
    fn a_white_balance_that_differs_is_told_and_one_that_does_not_is_none() {
        let ground = Some(&GROUND);
        let balanced = |x_m: f32, heading_rad: f32, gain: Vec3| {
            // Red, yellow and blue patches beside grey ones.
            let coloured = |p: &Vec3| {
                let n = (p.x * 97.0) as usize % 4;
                let colour = [
                    Vec3::ONE,
                    Vec3::new(1.0, 0.5, 0.4),
                    Vec3::new(1.0, 0.9, 0.5),
                ];
                0.5 * *p * gain * colour.get(n).copied().unwrap_or(Vec3::new(0.5, 0.7, 1.0))
            };
            let camera = camera(x_m, heading_rad);
            Cells::new(
                &LinearImage(seen_image(camera).0.map(coloured)),
                camera,
                false,
            )
        };
        let first = balanced(0.0, 0.0, Vec3::ONE);
        for stops in [
            Vec3::new(0.2, 0.0, -0.2),
            Vec3::new(0.5, 0.7, 0.6),
            Vec3::new(-0.3, -0.2, -0.1),
            Vec3::splat(0.3),
            Vec3::ZERO,
        ] {
            let other = balanced(0.3, 0.1, stops.map(f32::exp2));
            let told = first.exposure_to(&other, ground).unwrap();
            let grey = stops.map(f32::exp2).dot(LUMA).log2();
            let wanted = (stops - grey).as_dvec3();
            // As exposures are told, twice: that of the channel and that of grey.
            let off = (DVec3::from(told.tint.unwrap()) - wanted)
                .abs()
                .max_element();
            assert!(off < 0.04, "{told:?} {stops}");
            // Rounding is told apart from a tint by the same threshold.
            let none = wanted.abs().max_element() < 1e-6;
            assert_eq!(told.certain().tint == Some([0.0; 3]), none, "{told:?}");
        }
    }

    #[test]
    fn what_passes_by_tints_nothing() {
        let first = seen(camera(0.0, 0.0), 0.5);
        let mut image = seen_image(camera(0.2, 0.0)).0.map(|p| *p * 0.5);
        // A red bus over the left third, as bright as the place.
        let red = Vec3::new(2.0, 0.75, 0.6);
        let red = red / red.dot(LUMA);
        let pixels = image.pixels_mut().iter_mut().enumerate();
        pixels
            .filter(|(n, _)| n % 320 < 107)
            .for_each(|(_, p)| *p *= red);
        let other = Cells::new(&LinearImage(image), camera(0.2, 0.0), false);
        let told = first.exposure_to(&other, Some(&GROUND)).unwrap();
        // Its blue is .6 stops off, beyond what agrees; of cells beside it that are partly red the weights are low.
        let tint = DVec3::from(told.tint.unwrap()).abs().max_element();
        assert!(tint < 0.02, "{told:?}");
        assert_eq!(told.certain().tint, Some([0.0; 3]));
    }

    #[test]
    fn tints_of_the_bright_and_the_dark_are_not_told() {
        let bright = seen(camera(0.0, 0.0), 1.0).channels;
        let told = bright.pixels().iter().filter(|c| !c.is_nan());
        let most = told.map(|c| c.max_element()).fold(f32::MIN, f32::max);
        assert!(most < BLEACHED.log2(), "{most}");
        // Blue is nearly missing.
        let blueless = |x_m| {
            let image = seen_image(camera(x_m, 0.0))
                .0
                .map(|p| *p * Vec3::new(0.5, 0.5, 0.01));
            Cells::new(&LinearImage(image), camera(x_m, 0.0), false)
        };
        let told = blueless(0.0).exposure_to(&blueless(0.2), Some(&GROUND));
        assert_eq!(told.unwrap().tint, None);
    }

    #[test]
    fn small_differences_are_none_and_larger_ones_do_not_jump() {
        let certain = |stops: f64, red: f64| {
            let tint = Some([red, 0.0, -0.5 * red]);
            let of = Exposure { stops, tint }.certain();
            (of.stops, of.tint.unwrap()[0])
        };
        for (found, wanted) in [
            ((0.04, 0.04), (0.0, 0.0)),
            ((-0.06, 0.05), (-0.01, 0.0)),
            // The square of a half is a quarter.
            ((1.05, -0.1), (1.0, -0.075)),
            ((0.0, 0.0), (0.0, 0.0)),
        ] {
            let (stops, red) = certain(found.0, found.1);
            let (stops, red) = (stops - wanted.0, red - wanted.1);
            assert!(
                stops.abs().max(red.abs()) < 1e-12,
                "{found:?} {stops} {red}"
            );
        }
    }

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
