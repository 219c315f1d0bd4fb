//! What a picture would show under a camera: how its edges lean from the vertical, and how brightness, tint and texture
//! change with elevation. Under the true camera edges are upright or level, and the sky is above.
//!
//! A mirrored picture under a mirrored camera gives the same numbers. Details finer than a
//! 128th of the longer side are removed first, so that sharpness tells nothing.
use dipir_imaging::metrics::LUMA;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use glam::{Vec2, Vec3};

use crate::lines::{LINES, Lines};
use crate::pose::Pose;

/// Pixels along the longer side.
const LONGEST: usize = 128;
/// Pixels along each side of the parts whose means are looked at, and from which edges are taken.
const PART: usize = 8;
const EDGE_PART: usize = 16;
/// Most edges that are taken from a part, the strongest.
const MOST: usize = 14;
/// Added to linear values before the logarithm.
const FLOOR: f32 = 0.02;
/// Deviation of the logarithm of luminance below which a picture is of one shade.
const BLANK: f32 = 0.03;
/// Least change of the logarithm of luminance at an edge, a pixel.
const LEAST_CHANGE: f32 = 0.01;
const QUANTILES: [f32; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];
/// Quarters of the height whose means are looked at.
const QUARTERS: usize = 4;
/// Numbers of the picture alone.
const CONTEXT: usize = 1 + QUANTILES.len() + 3 * QUARTERS + 3;
/// Leans from upright to level that are counted, in three bands of elevation.
const LEANS: usize = 15;
const BANDS: usize = 3;
/// Middles of the outer bands, degrees.
const BAND_DEG: f32 = 25.0;
/// Elevations at which level edges are counted, from `-ROWS_DEG`.
const ROWS: usize = 17;
const ROWS_DEG: f32 = 32.0;
/// Edges that lean at least so much are level, degrees.
const LEVEL_DEG: f32 = 75.0;
/// Elevations at which the picture's parts are looked at, and numbers told of each.
const STEPS: usize = 16;
const PER_STEP: usize = 4;
/// Height of the bands between which brightness differs, degrees.
const TOLD_DEG: f32 = 3.0;
const TOLD: usize = 60;

/// How many numbers tell of a picture under a camera.
pub const FEATURES: usize = 5 + CONTEXT + LINES + BANDS * (LEANS + 1) + ROWS + STEPS * PER_STEP + 2;

/// A place of an edge; positions are relative to the picture's middle, +y up, in units of its longer side.
#[derive(Clone, Copy, Debug)]
struct Edge {
    at: Vec2,
    /// Unit vector along it.
    along: Vec2,
    weight: f32,
}

/// Means of a part.
#[derive(Clone, Copy, Debug)]
struct Part {
    at: Vec2,
    /// Logarithm of luminance over its mean, of blue over green over its mean, and of texture over its mean.
    values: [f32; 3],
}

/// A small picture, ready to be seen under any camera.
#[derive(Clone, Debug)]
pub struct Look {
    edges: Vec<Edge>,
    parts: Vec<Part>,
    context: [f32; CONTEXT],
    /// Half of the width and height, in units of the longer side.
    half: Vec2,
    blank: bool,
}

impl Look {
    /// Of a photograph of any size.
    pub fn new(image: &LinearImage) -> Self {
        let (w, h) = (image.0.width().max(1), image.0.height().max(1));
        let longer = w.max(h);
        let [width, height] = [w, h].map(|n| (n * LONGEST).div_ceil(longer).max(PART));
        let clean = image.0.map(|p| {
            let channel = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
            Vec3::from_array(p.to_array().map(channel))
        });
        let small = resize(&clean, width, height, Filter::Area);
        let log = small.map(|p| (p.dot(LUMA) + FLOOR).ln());
        let blue = small.map(|p| ((p.z + FLOOR) / (p.y + FLOOR)).ln());
        let red = small.map(|p| ((p.x + FLOOR) / (p.y + FLOOR)).ln());
        let change = change(&log);
        let texture = change.map(|c| c.length());
        let half = 0.5 * Vec2::new(w as f32, h as f32) / longer as f32;
        let averages = [mean(&log), mean(&blue), mean(&texture)];
        let squares = log.pixels().iter().map(|l| (l - averages[0]).powi(2));
        let deviation = (squares.sum::<f32>() / log.pixels().len() as f32).sqrt();
        Self {
            edges: edges(&change, half),
            parts: parts([&log, &blue, &texture], averages, half),
            context: context([&log, &blue, &texture], mean(&red), averages, half),
            half,
            blank: deviation < BLANK,
        }
    }

    /// Whether it is of one shade, and tells nothing.
    pub fn is_blank(&self) -> bool {
        self.blank
    }

    /// The [`FEATURES`] numbers of the picture and its straight lines under a camera.
    pub fn features(&self, lines: &Lines, pose: &Pose) -> Vec<f32> {
        let focal = pose.focal() as f32;
        let [_, up, _] = pose.axes().map(|a| a.as_vec3());
        let mut all = Vec::with_capacity(FEATURES);
        all.extend([
            pose.pitch_deg as f32,
            pose.roll_deg.abs() as f32,
            pose.log_focal as f32,
            (self.half.x / focal).atan(),
            (self.half.y / focal).atan(),
        ]);
        all.extend(self.context);
        all.extend(lines.features(pose));
        self.leans(focal, up, &mut all);
        self.profile(focal, up, &mut all);
        debug_assert_eq!(all.len(), FEATURES);
        all
    }

    /// Shares of edges by lean and band, of bands, and of level edges by elevation.
    fn leans(&self, focal: f32, up: Vec3, all: &mut Vec<f32>) {
        let mut leans = [[0f32; LEANS]; BANDS];
        let mut rows = [0f32; ROWS];
        let mut total = 1e-6f32;
        for edge in &self.edges {
            let ray = Vec3::new(edge.at.x / focal, edge.at.y / focal, -1.0);
            let along = edge.along.extend(0.0);
            let squared = ray.length_squared();
            let (rise, length) = (ray.dot(up), squared.sqrt());
            // The angle between two planes through the camera: one holds the edge, the other the vertical.
            let across = length * ray.dot(along.cross(up)).abs();
            let beside = (squared * along.dot(up) - rise * ray.dot(along)).abs();
            let lean = across.atan2(beside).to_degrees();
            let elevation = (rise / length).clamp(-1.0, 1.0).asin().to_degrees();
            let band = (elevation / BAND_DEG + 1.0).clamp(0.0, (BANDS - 1) as f32);
            let at = lean_bin(lean);
            let (b, k) = ((band as usize).min(BANDS - 2), (at as usize).min(LEANS - 2));
            let (b1, k1) = (band - b as f32, at - k as f32);
            for (db, wb) in [(0, 1.0 - b1), (1, b1)] {
                leans[b + db][k] += edge.weight * wb * (1.0 - k1);
                leans[b + db][k + 1] += edge.weight * wb * k1;
            }
            let row = (elevation + ROWS_DEG) / (2.0 * ROWS_DEG) * (ROWS - 1) as f32;
            if lean >= LEVEL_DEG && (0.0..(ROWS - 1) as f32).contains(&row) {
                let (k, part) = (row as usize, row.fract());
                let weight = edge.weight * (lean - LEVEL_DEG) / (90.0 - LEVEL_DEG);
                rows[k] += weight * (1.0 - part);
                rows[k + 1] += weight * part;
            }
            total += edge.weight;
        }
        for band in leans {
            let own: f32 = band.iter().sum();
            all.push(own / total);
            // A band with few edges has no shares worth telling.
            all.extend(band.map(|v| v / (own + 0.05 * total)));
        }
        all.extend(rows.map(|v| v / total));
    }

    /// Means of the parts by elevation, and how much of brightness and tint elevation tells.
    fn profile(&self, focal: f32, up: Vec3, all: &mut Vec<f32>) {
        let mut steps = [[0f32; PER_STEP]; STEPS];
        let mut told = [[0f32; 3]; TOLD];
        let mut squares = [1e-3f32; 2];
        for part in &self.parts {
            let ray = Vec3::new(part.at.x / focal, part.at.y / focal, -1.0);
            let elevation = (ray.dot(up) / ray.length()).clamp(-1.0, 1.0).asin();
            let elevation = elevation.to_degrees();
            let at = step_bin(elevation).clamp(0.0, (STEPS - 1) as f32);
            let k = (at as usize).min(STEPS - 2);
            let share = at - k as f32;
            for (k, w) in [(k, 1.0 - share), (k + 1, share)] {
                steps[k][0] += w;
                for (s, v) in steps[k][1..].iter_mut().zip(part.values) {
                    *s += w * v;
                }
            }
            let row = (((elevation + 90.0) / TOLD_DEG) as usize).min(TOLD - 1);
            told[row][0] += 1.0;
            for k in 0..2 {
                told[row][k + 1] += part.values[k];
                squares[k] += part.values[k].powi(2);
            }
        }
        for step in steps {
            all.push(step[0] / self.parts.len() as f32);
            all.extend(step[1..].iter().map(|v| v / (step[0] + 1.0)));
        }
        for (k, squares) in squares.iter().enumerate() {
            let of = |row: &[f32; 3]| row[k + 1] * row[k + 1] / row[0].max(1.0);
            all.push(told.iter().map(of).sum::<f32>() / squares);
        }
    }
}

/// The place of a lean from 0 to 90 degrees among [`LEANS`] bins, which are narrow near both ends.
fn lean_bin(lean_deg: f32) -> f32 {
    let last = (LEANS - 1) as f32;
    let from_end = lean_deg.min(90.0 - lean_deg).max(0.0);
    let (low, high) = (2f32.sqrt(), 47f32.sqrt());
    let at = 0.5 * last * ((from_end + 2.0).sqrt() - low) / (high - low);
    if lean_deg > 45.0 { last - at } else { at }
}

/// The place of an elevation from -75 to 75 degrees among [`STEPS`] bins, which are narrow near the horizon.
fn step_bin(elevation_deg: f32) -> f32 {
    let half = 0.5 * (STEPS - 1) as f32;
    let at = ((elevation_deg.abs() + 4.0).sqrt() - 2.0) / (79f32.sqrt() - 2.0);
    half + half * at.copysign(elevation_deg)
}

fn mean(values: &Raster<f32>) -> f32 {
    values.pixels().iter().sum::<f32>() / values.pixels().len() as f32
}

/// Change to the right and downwards by Sobel's operator; 0 on the border.
fn change(log: &Raster<f32>) -> Raster<Vec2> {
    let (width, height) = (log.width(), log.height());
    let mut all = vec![Vec2::ZERO; width * height];
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let at = |dx: usize, dy: usize| *log.get(x + dx - 1, y + dy - 1);
            let column = |dx: usize| at(dx, 0) + 2.0 * at(dx, 1) + at(dx, 2);
            let row = |dy: usize| at(0, dy) + 2.0 * at(1, dy) + at(2, dy);
            all[y * width + x] = Vec2::new(column(2) - column(0), row(2) - row(0)) / 8.0;
        }
    }
    Raster::from_pixels(width, height, all)
}

/// Where a pixel's middle lies.
fn place(x: f32, y: f32, size: [usize; 2], half: Vec2) -> Vec2 {
    let [w, h] = size.map(|n| n as f32);
    Vec2::new((2.0 * x / w - 1.0) * half.x, (1.0 - 2.0 * y / h) * half.y)
}

/// The strongest pixels of each part that are stronger than their neighbours across the edge.
fn edges(change: &Raster<Vec2>, half: Vec2) -> Vec<Edge> {
    let (w, h) = (change.width(), change.height());
    let crest = |x: usize, y: usize| {
        let own = *change.get(x, y);
        let strength = own.length();
        let level = own.y.abs() > own.x.abs();
        let (dx, dy) = if level { (0, 1) } else { (1, 0) };
        let next = change.get(x + dx, y + dy).length();
        let before = change.get(x - dx, y - dy).length();
        strength > LEAST_CHANGE && strength >= next && strength > before
    };
    let mut all = Vec::new();
    for top in (0..h).step_by(EDGE_PART) {
        for left in (0..w).step_by(EDGE_PART) {
            let rows = top.max(1)..(top + EDGE_PART).min(h - 1);
            let columns = left.max(1)..(left + EDGE_PART).min(w - 1);
            let each = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
            let mut own: Vec<(usize, usize)> = each.filter(|(x, y)| crest(*x, *y)).collect();
            let strength = |(x, y): &(usize, usize)| change.get(*x, *y).length();
            own.sort_by(|a, b| strength(b).total_cmp(&strength(a)).then(a.cmp(b)));
            all.extend(own.iter().take(MOST).map(|(x, y)| {
                let across = *change.get(*x, *y);
                Edge {
                    at: place(*x as f32 + 0.5, *y as f32 + 0.5, [w, h], half),
                    // Along it and +y up.
                    along: Vec2::new(across.y, across.x) / across.length(),
                    weight: across.length().sqrt(),
                }
            }));
        }
    }
    all
}

fn parts(of: [&Raster<f32>; 3], averages: [f32; 3], half: Vec2) -> Vec<Part> {
    let (w, h) = (of[0].width(), of[0].height());
    let mut all = Vec::new();
    for top in (0..h).step_by(PART) {
        for left in (0..w).step_by(PART) {
            let (bottom, right) = ((top + PART).min(h), (left + PART).min(w));
            let count = ((bottom - top) * (right - left)) as f32;
            let mean = |values: &Raster<f32>| {
                let rows = (top..bottom).map(|y| values.row(y)[left..right].iter().sum::<f32>());
                rows.sum::<f32>() / count
            };
            let [log, blue, texture] = of.map(mean);
            let [x, y] = [left + right, top + bottom].map(|n| 0.5 * n as f32);
            all.push(Part {
                at: place(x, y, [w, h], half),
                values: [
                    log - averages[0],
                    blue - averages[1],
                    ((texture + 0.01) / (averages[2] + 0.01)).ln(),
                ],
            });
        }
    }
    all
}

fn context(of: [&Raster<f32>; 3], red: f32, averages: [f32; 3], half: Vec2) -> [f32; CONTEXT] {
    let mut sorted = of[0].pixels().to_vec();
    sorted.sort_by(f32::total_cmp);
    let quantile = |q: f32| sorted[(q * (sorted.len() - 1) as f32) as usize] - averages[0];
    let h = of[0].height();
    let quarters = |values: &Raster<f32>| -> [f32; QUARTERS] {
        std::array::from_fn(|k| {
            let rows = k * h / QUARTERS..((k + 1) * h / QUARTERS).max(k * h / QUARTERS + 1);
            let count = (rows.len() * values.width()) as f32;
            rows.map(|y| values.row(y).iter().sum::<f32>()).sum::<f32>() / count
        })
    };
    let mut all = vec![(half.x / half.y).ln().abs()];
    all.extend(QUANTILES.map(quantile));
    all.extend(quarters(of[0]).map(|v| v - averages[0]));
    all.extend(quarters(of[1]).map(|v| v - averages[1]));
    all.extend(quarters(of[2]).map(|v| ((v + 0.01) / (averages[2] + 0.01)).ln()));
    all.extend([red, averages[1], (averages[2] + 0.01).ln()]);
    std::array::from_fn(|k| all[k])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leans_and_elevations_fill_their_bins_from_end_to_end() {
        assert!(lean_bin(0.0).abs() < 1e-5 && (lean_bin(90.0) - 14.0).abs() < 1e-5);
        assert!((lean_bin(45.0) - 7.0).abs() < 1e-5);
        assert!((step_bin(75.0) - 15.0).abs() < 1e-5 && step_bin(-75.0).abs() < 1e-5);
        let all: Vec<f32> = (0..=90).map(|k| lean_bin(k as f32)).collect();
        assert!(all.windows(2).all(|w| w[0] < w[1]), "{all:?}");
    }

    #[test]
    fn a_mirrored_picture_under_a_mirrored_camera_looks_the_same() {
        use crate::generated::{Built, picture};
        let pose = Pose::new(-7.0, 2.0, 60.0);
        let image = picture(Built::Street, 5, &pose, [256, 192]);
        let (w, h) = (image.0.width(), image.0.height());
        let pixel = |k: usize| *image.0.get(w - 1 - k % w, k / w);
        let turned = LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()));
        let other = Pose {
            roll_deg: -pose.roll_deg,
            ..pose
        };
        let none = Lines::new(&[], [w, h]);
        let a = Look::new(&image).features(&none, &pose);
        let b = Look::new(&turned).features(&none, &other);
        // Which of two equal neighbours is the crest depends on the side: some hundredths of the shares.
        let off = a.iter().zip(&b).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 0.1, "{a:?} {b:?}");
    }
}
