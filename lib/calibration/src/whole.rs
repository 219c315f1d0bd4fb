//! What a picture shows as a whole, by a network that was trained on photographs of all kinds: what is sky, road or
//! ceiling, and how large things look, says how a camera was held.
//!
//! A narrow view of a panorama is blurred, a photograph is not. So that sharpness tells nothing of the field of view,
//! no picture is looked at with more than 96 pixels along its longer side, a little blurred, and networks learn from
//! pictures that are more and less so.
use dipir_backbone::{Backbone, CHANNELS, Map};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;

use crate::pose::{Pose, log_focal};

/// Pixels along the longer side that are looked at: as many as a panorama of 1024 columns has at 34 degrees.
const LONGEST: usize = 96;
/// How often neighbours of a photograph's are averaged, by 1 2 1.
pub(crate) const BLUR: usize = 1;
/// Most blur that networks learn from.
pub const MOST_BLUR: usize = 2;
/// Pixels along both sides of the backbone's picture, whatever the photograph's shape.
const LOOKED: usize = 192;
/// Parts of the shallow map along each side whose means are told; of the deep map all is one part.
const PARTS: usize = 3;
/// How many numbers tell of a picture as a whole; the last is its shape.
pub const WHOLE: usize = PARTS * PARTS * CHANNELS[0] + CHANNELS[1] + 1;

/// Points of a [`Table`]: pitch in degrees, and the angle along the longer side, of which the logarithm of the focal
/// length is divided evenly.
pub const PITCHES: usize = 25;
const PITCH_DEG: [f64; 2] = [-54.0, 34.0];
/// See [`PITCHES`].
pub const FOCALS: usize = 9;
const FOV_DEG: [f64; 2] = [102.0, 23.5];
/// Least logarithm that is told.
const LEAST: f64 = -15.0;
/// How many numbers a table tells of a camera.
pub const TOLD: usize = 3;

/// A picture as it is, and mirrored.
#[derive(Clone, Debug)]
pub struct Whole {
    /// [`WHOLE`] numbers each.
    pub sides: [Vec<f32>; 2],
}

impl Whole {
    /// Of a photograph of any size, with so much blur.
    pub fn new(image: &LinearImage, blur: usize) -> Self {
        let (w, h) = (image.0.width().max(1), image.0.height().max(1));
        let [width, height] = [w, h].map(|n| (n * LONGEST).div_ceil(w.max(h)));
        let clean = image.0.map(|p| {
            let channel = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
            Vec3::from_array(p.to_array().map(channel))
        });
        let mut small = resize(&clean, width, height, Filter::Area);
        for _ in 0..blur {
            small = averaged(&small);
        }
        let shown = resize(&small, LOOKED, LOOKED, Filter::Tent)
            .map(|p| Vec3::from_array(p.to_array().map(|v| Transfer::Srgb.encode_scalar(v))));
        let mirror = |k: usize| *shown.get(LOOKED - 1 - k % LOOKED, k / LOOKED);
        let mirrored =
            Raster::from_pixels(LOOKED, LOOKED, (0..LOOKED * LOOKED).map(mirror).collect());
        let shape = (w as f32 / h as f32).ln();
        Self {
            sides: [shown, mirrored].map(|picture| {
                let [shallow, deep] = Backbone::embedded().maps(&picture);
                let mut all = parts(&shallow);
                all.extend(deep.mean());
                all.push(shape);
                all
            }),
        }
    }
}

/// Means of a map's parts, row by row.
fn parts(map: &Map) -> Vec<f32> {
    let mut all = Vec::with_capacity(PARTS * PARTS * map.channels);
    for part in 0..PARTS * PARTS {
        let range = |k: usize, n: usize| k * n / PARTS..(k + 1) * n / PARTS;
        let columns = range(part % PARTS, map.width);
        let rows = range(part / PARTS, map.height);
        let mut sums = vec![0.0; map.channels];
        for cell in rows
            .clone()
            .flat_map(|y| columns.clone().map(move |x| y * map.width + x))
        {
            let values = &map.values[cell * map.channels..][..map.channels];
            sums.iter_mut().zip(values).for_each(|(s, v)| *s += v);
        }
        let count = (rows.len() * columns.len()) as f32;
        all.extend(sums.iter().map(|s: &f32| s / count));
    }
    all
}

/// By 1 2 1 along rows and columns.
fn averaged(picture: &Raster<Vec3>) -> Raster<Vec3> {
    let (w, h) = (picture.width(), picture.height());
    let line = |at: &dyn Fn(usize) -> Vec3, k: usize, n: usize| {
        0.25 * at(k.saturating_sub(1)) + 0.5 * at(k) + 0.25 * at((k + 1).min(n - 1))
    };
    let along = |k: usize| line(&|x| *picture.get(x, k / w), k % w, w);
    let rows = Raster::from_pixels(w, h, (0..w * h).map(along).collect());
    let across = |k: usize| line(&|y| *rows.get(k % w, y), k / w, h);
    Raster::from_pixels(w, h, (0..w * h).map(across).collect())
}

/// How probable cameras are: logarithms of probabilities on a grid of pitch and focal length, between whose points
/// they change evenly.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    both: Vec<f64>,
    pitch: Vec<f64>,
    focal: Vec<f64>,
}

impl Table {
    /// The mean of logarithms in any scale, each `PITCHES x FOCALS`.
    pub fn mean(all: &[Vec<f32>]) -> Self {
        let mut both = vec![0.0; PITCHES * FOCALS];
        for logs in all {
            let logs: Vec<f64> = logs.iter().map(|l| f64::from(*l)).collect();
            let total = log_sum(logs.iter().copied());
            for (b, l) in both.iter_mut().zip(logs) {
                *b += (l - total) / all.len() as f64;
            }
        }
        let total = log_sum(both.iter().copied());
        both.iter_mut().for_each(|b| *b -= total);
        let row = |p: usize| log_sum(both[p * FOCALS..][..FOCALS].iter().copied());
        let column = |f: usize| log_sum(both[f..].iter().step_by(FOCALS).copied());
        Self {
            pitch: (0..PITCHES).map(row).collect(),
            focal: (0..FOCALS).map(column).collect(),
            both,
        }
    }

    /// [`TOLD`] numbers of a camera: how probable its pitch and focal length are together, and each alone.
    pub fn told(&self, pose: &Pose) -> [f32; TOLD] {
        let [(p, u), (f, v)] = place(pose);
        let between =
            |values: &[f64], k: usize, t: f64| values[k] + t * (values[k + 1] - values[k]);
        let row = |p: usize| between(&self.both[p * FOCALS..][..FOCALS], f, v);
        let both = row(p) + u * (row(p + 1) - row(p));
        [both, between(&self.pitch, p, u), between(&self.focal, f, v)]
            .map(|log| log.max(LEAST) as f32)
    }
}

/// Shares of the points of a [`Table`] around a camera, as index and share.
pub fn shares(pose: &Pose) -> [(usize, f32); 4] {
    let [(p, u), (f, v)] = place(pose);
    let at = |dp: usize, df: usize| {
        let share = (if dp == 1 { u } else { 1.0 - u }) * (if df == 1 { v } else { 1.0 - v });
        ((p + dp) * FOCALS + f + df, share as f32)
    };
    [at(0, 0), at(0, 1), at(1, 0), at(1, 1)]
}

/// The points of pitch and focal length before a camera's, and the parts of the steps to the next.
fn place(pose: &Pose) -> [(usize, f64); 2] {
    let along = |value: f64, [low, high]: [f64; 2], count: usize| {
        let at = (value - low) / (high - low) * (count - 1) as f64;
        let at = at.clamp(0.0, (count - 1) as f64);
        let k = (at as usize).min(count - 2);
        (k, at - k as f64)
    };
    let focals = FOV_DEG.map(log_focal);
    [
        along(pose.pitch_deg, PITCH_DEG, PITCHES),
        along(pose.log_focal, focals, FOCALS),
    ]
}

fn log_sum(logs: impl Iterator<Item = f64> + Clone) -> f64 {
    let best = logs.clone().fold(f64::NEG_INFINITY, f64::max);
    best + logs.map(|l| (l - best).exp()).sum::<f64>().ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generated::{Built, picture};

    #[test]
    fn parts_of_a_map_are_means_of_their_cells() {
        let (width, height, channels) = (7, 6, 2);
        let value = |k: usize| ((k * 37) % 101) as f32;
        let values = (0..width * height * channels).map(value).collect();
        let map = Map {
            width,
            height,
            channels,
            values,
        };
        let found = parts(&map);
        // Columns 2 and 3, rows 4 and 5, channel 1.
        let cells = [4 * 7 + 2, 4 * 7 + 3, 5 * 7 + 2, 5 * 7 + 3];
        let wanted = cells.iter().map(|c| value(2 * c + 1)).sum::<f32>() / 4.0;
        assert_eq!(found.len(), 18);
        assert!((found[7 * 2 + 1] - wanted).abs() < 1e-4);
    }

    #[test]
    fn tables_are_probabilities_that_change_evenly_between_points() {
        let logs = |seed: f32| -> Vec<f32> {
            let one = |k: usize| (0.37 * k as f32 + seed).sin();
            (0..PITCHES * FOCALS).map(one).collect()
        };
        let (a, b) = (logs(0.0), logs(2.0));
        let table = Table::mean(&[a.clone(), b.clone()]);
        let total = |logs: &[f64]| logs.iter().map(|l| l.exp()).sum::<f64>();
        for logs in [&table.both, &table.pitch, &table.focal] {
            assert!((total(logs) - 1.0).abs() < 1e-9);
        }
        let of = |pose: &Pose, logs: &[f32]| -> f32 {
            let parts = shares(pose);
            assert!((parts.iter().map(|p| p.1).sum::<f32>() - 1.0).abs() < 1e-6);
            parts.iter().map(|(k, share)| share * logs[*k]).sum()
        };
        // What both say but for a summand, at any camera.
        let [one, other] = [Pose::new(-13.7, 3.0, 47.0), Pose::new(30.0, 0.0, 100.0)];
        let mean = |pose: &Pose| 0.5 * (of(pose, &a) + of(pose, &b));
        let told = table.told(&one)[0] - table.told(&other)[0];
        assert!((told - (mean(&one) - mean(&other))).abs() < 1e-5);
        // At a point alone.
        let at = Pose {
            pitch_deg: PITCH_DEG[0],
            roll_deg: 0.0,
            log_focal: log_focal(FOV_DEG[1]),
        };
        let [both, pitch, focal] = table.told(&at).map(f64::from);
        assert!((both - table.both[FOCALS - 1]).abs() < 1e-6);
        assert!((pitch - table.pitch[0]).abs() < 1e-6);
        assert!((focal - table.focal[FOCALS - 1]).abs() < 1e-6);
    }

    #[test]
    fn sides_change_places_in_a_mirror_and_more_pixels_tell_no_more() {
        let pose = Pose::new(-7.0, 2.0, 60.0);
        let image = picture(Built::Street, 5, &pose, [128, 96]);
        let again = |w: usize, h: usize, at: &dyn Fn(usize, usize) -> [usize; 2]| {
            let pixel = |k: usize| {
                let [x, y] = at(k % w, k / w);
                *image.0.get(x, y)
            };
            let pixels = (0..w * h).map(pixel).collect();
            Whole::new(&LinearImage(Raster::from_pixels(w, h, pixels)), BLUR)
        };
        let close = |a: &[f32], b: &[f32]| {
            assert_eq!(a.len(), WHOLE);
            let off = a.iter().zip(b).map(|(a, b)| (a - b).abs());
            // Sums in single precision, of numbers up to 17, in another order.
            assert!(off.fold(0.0, f32::max) < 1e-4);
        };
        let whole = Whole::new(&image, BLUR);
        let mirrored = again(128, 96, &|x, y| [127 - x, y]);
        let enlarged = again(256, 192, &|x, y| [x / 2, y / 2]);
        for k in 0..2 {
            close(&whole.sides[k], &mirrored.sides[1 - k]);
            close(&whole.sides[k], &enlarged.sides[k]);
        }
    }
}
