//! Features of a photograph. The first are means, contrasts and extremes of its parts, by place in the picture and by
//! elevation in the world: too little to recognise a place by, which is why light that is learned from few places
//! carries over. The others say what kind of place it is: what a network sees in it that was trained on a million
//! photographs of all kinds.
use std::sync::Arc;

use dipir_backbone::{Backbone, CHANNELS, Map, Tuned, frame};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use dipir_imaging::transfer::Transfer;
use dipir_light::luminance::luminance;
use dipir_scene::camera::Camera;
use glam::{Vec2, Vec3};

use crate::cues::{CUES, cues};

/// Pixels along each side of the picture that is looked at, whatever the photograph's size.
pub const SIDE: usize = 64;
/// Pixels along each side of the picture that the backbone looks at.
pub const LOOKED: usize = 192;
/// Parts of the picture along each side.
const CELLS: usize = 8;
/// Coarser parts, for edges.
const COARSE: usize = 4;
/// Added to linear values before the logarithm: a display value of .03 and less says nothing.
const FLOOR: f32 = 0.004;
/// Linear values from here on may be clipped (display .98).
pub const CLIPPED: f32 = 0.955;
/// Linear values below are black (display .04).
const BLACK: f32 = 0.0031;
/// Borders between bands of elevation, degrees.
const BANDS_DEG: [f32; 9] = [-91.0, -45.0, -25.0, -12.0, -4.0, 4.0, 12.0, 25.0, 91.0];
/// Features of each band.
const PER_BAND: usize = 7;
/// Quantiles of log-luminance that are features.
const QUANTILES: [f32; 7] = [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98];
/// Features that say what the camera is and how bright the photograph is; they come first.
pub const OF_CAMERA: usize = 6;
/// Features of parts of the picture, with those of the camera.
pub const OF_PARTS: usize = OF_CAMERA
    + 6 * CELLS * CELLS
    + 2 * COARSE * COARSE
    + QUANTILES.len()
    + 2
    + PER_BAND * (BANDS_DEG.len() - 1)
    + CUES;
/// Features of the backbone: means of its channels; they come last.
pub const OF_KIND: usize = CHANNELS[0] + CHANNELS[1];
/// Numbers in all.
pub const FEATURES: usize = OF_PARTS + OF_KIND;

/// A photograph and its camera, resized to the input of the features.
#[derive(Clone, Debug)]
pub struct SmallPhoto {
    /// Linear light in `[0, 1]`, row by row.
    pixels: Vec<Vec3>,
    /// Display values, [`LOOKED`] x [`LOOKED`].
    looked: Raster<Vec3>,
    /// Elevation of each pixel's ray, degrees.
    elevation_deg: Vec<f32>,
    /// Pitch of the view and half the angles that it spans to the side and upwards, radians.
    pitch_half: [f32; 3],
}

impl SmallPhoto {
    /// The whole `photo` without the frame around it, resized. Pixels that are no numbers count as black.
    pub fn new(photo: &LinearImage, camera: &Camera) -> Self {
        if let Some((photo, camera)) = unframed(photo, camera) {
            return Self::whole(&photo, &camera);
        }
        Self::whole(photo, camera)
    }

    fn whole(photo: &LinearImage, camera: &Camera) -> Self {
        let photo = photo.0.map(|p| clean(*p));
        let small = resize(&photo, SIDE, SIDE, Filter::Area);
        let shown =
            |p: &Vec3| Vec3::from_array(p.to_array().map(|v| Transfer::Srgb.encode_scalar(v)));
        let looked = resize(&photo, LOOKED, LOOKED, Filter::Tent).map(shown);
        let camera = Camera {
            resolution: camera.resolution.map(|n| n.max(1)),
            ..*camera
        };
        let camera = camera.scaled([SIDE as u32; 2]);
        let elevation = |k: usize| {
            let pixel = Vec2::new((k % SIDE) as f32 + 0.5, (k / SIDE) as f32 + 0.5);
            let up = camera.ray(pixel).direction.y;
            up.clamp(-1.0, 1.0).asin().to_degrees()
        };
        let half = 0.5 * SIDE as f32;
        let forward = -camera.rotation.z_axis;
        Self {
            pixels: small.pixels().iter().map(|p| clean(*p)).collect(),
            looked,
            elevation_deg: (0..SIDE * SIDE).map(elevation).collect(),
            pitch_half: [
                forward.y.clamp(-1.0, 1.0).asin(),
                (half / camera.focal_px.x).atan(),
                (half / camera.focal_px.y).atan(),
            ],
        }
    }

    /// The picture in a mirror.
    pub fn mirrored(&self) -> Self {
        Self {
            pixels: flipped(&self.pixels, SIDE),
            looked: Raster::from_pixels(LOOKED, LOOKED, flipped(self.looked.pixels(), LOOKED)),
            elevation_deg: flipped(&self.elevation_deg, SIDE),
            ..*self
        }
    }

    /// Mean linear luminance: the scale that lights are estimated on.
    pub fn reference(&self) -> f32 {
        let sum: f64 = self.pixels.iter().map(|p| f64::from(luminance(*p))).sum();
        (sum / self.pixels.len() as f64) as f32 + 1e-3
    }

    /// The [`FEATURES`] numbers, for each of the backbone's tunings; once, without, where there is none.
    pub fn features(&self, tuned: &[Arc<Tuned>]) -> Vec<Vec<f32>> {
        let (parts, backbone) = (self.of_parts(), Backbone::embedded());
        let front = backbone.front(&self.looked);
        let with = |tuned: Option<&Tuned>| {
            let maps = backbone.maps_behind(front.clone(), tuned);
            let mut all = parts.clone();
            all.extend(maps.iter().flat_map(Map::mean));
            debug_assert_eq!(all.len(), FEATURES);
            all
        };
        match tuned.is_empty() {
            true => vec![with(None)],
            false => tuned.iter().map(|t| with(Some(t))).collect(),
        }
    }

    /// The features of the picture and of its mirror image, for each tuning.
    pub fn both_sides(&self, tuned: &[Arc<Tuned>]) -> Vec<[Vec<f32>; 2]> {
        let mirrored = self.mirrored().features(tuned);
        let pairs = self.features(tuned).into_iter().zip(mirrored);
        pairs.map(|(plain, mirrored)| [plain, mirrored]).collect()
    }

    fn of_parts(&self) -> Vec<f32> {
        let light: Vec<f32> = self.pixels.iter().map(|p| luminance(*p)).collect();
        let log: Vec<f32> = light.iter().map(|l| (l + FLOOR).ln()).collect();
        let reference = self.reference().ln();
        let [pitch, half_x, half_y] = self.pitch_half;
        let mut all = vec![
            reference,
            pitch,
            3.0 * pitch.sin(),
            half_x,
            half_y,
            half_x * pitch,
        ];
        all.extend(self.cells(&log, reference));
        all.extend(edges(&log));
        let mut sorted = log.clone();
        sorted.sort_by(f32::total_cmp);
        let quantile =
            |q: &f32| sorted[(q * (sorted.len() - 1) as f32).round() as usize] - reference;
        all.extend(QUANTILES.iter().map(quantile));
        let share = |test: &dyn Fn(f32) -> bool| {
            let count = self.pixels.iter().filter(|p| test(p.max_element())).count();
            count as f32 / self.pixels.len() as f32
        };
        all.push(share(&|v| v > CLIPPED));
        all.push(share(&|v| v < BLACK));
        for band in BANDS_DEG.windows(2) {
            all.extend(self.band([band[0], band[1]], &light, &log, reference));
        }
        let relative: Vec<f32> = log.iter().map(|l| l - reference).collect();
        all.extend(cues(&self.pixels, &light, &relative, &self.elevation_deg));
        debug_assert_eq!(all.len(), OF_PARTS);
        all
    }

    fn cells(&self, log: &[f32], reference: f32) -> Vec<f32> {
        let mut parts: [Vec<f32>; 6] = Default::default();
        for cell in 0..CELLS * CELLS {
            let inside: Vec<usize> = pixels_of(cell, CELLS).collect();
            let count = inside.len() as f32;
            let mean =
                inside.iter().map(|&k| self.pixels[k]).sum::<Vec3>() / count + Vec3::splat(FLOOR);
            let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
            let (mut sum, mut squares) = (0.0, 0.0);
            for &k in &inside {
                (low, high) = (low.min(log[k]), high.max(log[k]));
                sum += log[k];
                squares += log[k] * log[k];
            }
            let values = [
                luminance(mean).ln() - reference,
                (mean.x / mean.y).ln(),
                (mean.z / mean.y).ln(),
                (squares / count - (sum / count).powi(2)).max(0.0).sqrt(),
                high - reference,
                low - reference,
            ];
            parts.iter_mut().zip(values).for_each(|(p, v)| p.push(v));
        }
        parts.concat()
    }

    /// Of the pixels between two elevations: their share, mean and deviation of log-luminance, two tints, mean
    /// luminance, and how log-luminance grows to the right. Zeros where there are hardly any.
    fn band(
        &self,
        [low, high]: [f32; 2],
        light: &[f32],
        log: &[f32],
        reference: f32,
    ) -> [f32; PER_BAND] {
        let mut sums = [0f64; 8];
        for (k, p) in self.pixels.iter().enumerate() {
            if !(self.elevation_deg[k] >= low && self.elevation_deg[k] < high) {
                continue;
            }
            let across = ((k % SIDE) as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
            let value = log[k] - reference;
            let floored = *p + Vec3::splat(FLOOR);
            let terms = [
                1.0,
                value,
                value * value,
                (floored.x / floored.y).ln(),
                (floored.z / floored.y).ln(),
                light[k],
                value * across,
                across,
            ];
            sums.iter_mut()
                .zip(terms)
                .for_each(|(s, t)| *s += f64::from(t));
        }
        let share = (sums[0] / (SIDE * SIDE) as f64) as f32;
        if share < 0.01 {
            return [share, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        }
        let mean = |k: usize| (sums[k] / sums[0]) as f32;
        [
            share,
            mean(1),
            (mean(2) - mean(1) * mean(1)).max(0.0).sqrt(),
            mean(3),
            mean(4),
            0.3 * mean(5) / reference.exp(),
            mean(6) - mean(1) * mean(7),
        ]
    }
}

/// The photograph inside its frame, and the camera of that part; `None` without a frame.
pub(crate) fn unframed(photo: &LinearImage, camera: &Camera) -> Option<(LinearImage, Camera)> {
    let inside = frame::inside(photo)?;
    let [left, top, width, height] = inside;
    let camera = Camera {
        resolution: camera.resolution.map(|n| n.max(1)),
        ..*camera
    };
    // The camera may belong to another size of the same picture.
    let camera = camera.scaled([photo.0.width() as u32, photo.0.height() as u32]);
    let camera = Camera {
        principal_px: camera.principal_px - Vec2::new(left as f32, top as f32),
        resolution: [width as u32, height as u32],
        ..camera
    };
    Some((frame::cut(photo, inside), camera))
}

/// A pixel as linear light between black and white.
fn clean(pixel: Vec3) -> Vec3 {
    let channel = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
    Vec3::from_array(pixel.to_array().map(channel))
}

fn flipped<T: Copy>(values: &[T], side: usize) -> Vec<T> {
    let turned = |row: &[T]| row.iter().rev().copied().collect::<Vec<T>>();
    values.chunks(side).flat_map(turned).collect()
}

/// The pixels of one of `per_side` x `per_side` parts.
fn pixels_of(cell: usize, per_side: usize) -> impl Iterator<Item = usize> {
    let side = SIDE / per_side;
    let first = cell / per_side * side * SIDE + cell % per_side * side;
    (0..side * side).map(move |k| first + k / side * SIDE + k % side)
}

/// Mean differences between neighbours to the side, then upwards, in coarse parts.
fn edges(log: &[f32]) -> Vec<f32> {
    let mut all = Vec::with_capacity(2 * COARSE * COARSE);
    for step in [1, SIDE] {
        for cell in 0..COARSE * COARSE {
            let (mut sum, mut count) = (0.0f32, 0);
            for k in pixels_of(cell, COARSE) {
                let inside = if step == 1 {
                    k % SIDE + 1 < SIDE
                } else {
                    k + SIDE < SIDE * SIDE
                };
                if inside {
                    sum += (log[k + step] - log[k]).abs();
                    count += 1;
                }
            }
            all.push(sum / count.max(1) as f32);
        }
    }
    all
}
