//! The guided filter (He, Sun and Tang, 2010): a mask whose edges follow those of a picture.
use glam::{Mat3, Vec3};
use rayon::prelude::*;

use crate::raster::Raster;

/// Side of the squares that are filtered each by itself, pixels.
const TILE: usize = 128;
/// Tiles of a batch.
const TILES_AT_ONCE: usize = 1024;

/// `mask` with the edges of a picture: `guide` gives the colour of each of its pixels, counted row by row.
///
/// In every square of `2 radius + 1` pixels a side the mask is taken to be a linear function of the colours, by least squares.
/// `softness`, a variance of colours, is a penalty on its slope. Where the mask has one value, it keeps it. The result is in
/// `[0, 1]`.
pub fn guided(
    mask: &Raster<f32>,
    guide: impl Fn(usize) -> Vec3 + Sync,
    radius: usize,
    softness: f32,
) -> Raster<f32> {
    let (width, height) = (mask.width(), mask.height());
    let columns = width.div_ceil(TILE);
    let tiles: Vec<usize> = (0..columns * height.div_ceil(TILE)).collect();
    let mut filtered = mask.clone();
    // A batch at a time, so that what tiles take is small beside the picture.
    for batch in tiles.chunks(TILES_AT_ONCE) {
        let tile = |&tile: &usize| {
            let (x, y) = (tile % columns * TILE, tile / columns * TILE);
            let (inner, outer) = ([x, y], [x, y].map(|at| at.saturating_sub(2 * radius)));
            // The filter averages twice.
            let end = |at: usize, reach: usize, size: usize| (at + TILE + reach).min(size);
            let outer_end = [end(x, 2 * radius, width), end(y, 2 * radius, height)];
            let rows = outer[1]..outer_end[1];
            let part = rows.flat_map(|v| v * width + outer[0]..v * width + outer_end[0]);
            let values: Vec<f32> = part.clone().map(|i| mask.pixels()[i]).collect();
            if values.iter().all(|v| *v == values[0]) {
                return None;
            }
            let colours: Vec<Vec3> = part.map(&guide).collect();
            let across = outer_end[0] - outer[0];
            let lines = lines(&values, &colours, across, radius, softness);
            let inside = |at: [usize; 2]| (at[1] - outer[1]) * across + at[0] - outer[0];
            let pixels =
                (y..end(y, 0, height)).flat_map(|v| (x..end(x, 0, width)).map(move |u| [u, v]));
            let pixels = pixels.map(|at| {
                let [x, y, z, offset] = lines[inside(at)];
                (colours[inside(at)].dot(Vec3::new(x, y, z)) + offset).clamp(0.0, 1.0)
            });
            Some((inner, pixels.collect::<Vec<f32>>()))
        };
        let done: Vec<_> = batch.par_iter().filter_map(tile).collect();
        for ([x, y], pixels) in done {
            let across = (x + TILE).min(width) - x;
            for (v, row) in pixels.chunks(across).enumerate() {
                let start = (y + v) * width + x;
                filtered.pixels_mut()[start..start + across].copy_from_slice(row);
            }
        }
    }
    filtered
}

/// Slope and offset of the linear function of each pixel, the mean of those of the squares that hold it.
fn lines(
    values: &[f32],
    colours: &[Vec3],
    width: usize,
    radius: usize,
    softness: f32,
) -> Vec<[f32; 4]> {
    let products = |(&p, &c): (&f32, &Vec3)| {
        let pc = p * c;
        [
            p,
            c.x,
            c.y,
            c.z,
            pc.x,
            pc.y,
            pc.z,
            c.x * c.x,
            c.x * c.y,
            c.x * c.z,
            c.y * c.y,
            c.y * c.z,
            c.z * c.z,
        ]
    };
    let products: Vec<[f32; 13]> = values.iter().zip(colours).map(products).collect();
    let line = |[p, x, y, z, px, py, pz, xx, xy, xz, yy, yz, zz]: [f32; 13]| {
        let mean = Vec3::new(x, y, z);
        let with_mask = Vec3::new(px, py, pz) - p * mean;
        let variance = Mat3::from_cols(
            Vec3::new(xx + softness, xy, xz) - x * mean,
            Vec3::new(xy, yy + softness, yz) - y * mean,
            Vec3::new(xz, yz, zz + softness) - z * mean,
        );
        let slope = variance.inverse() * with_mask;
        [slope.x, slope.y, slope.z, p - slope.dot(mean)]
    };
    let lines = means(&products, width, radius).into_iter().map(line);
    means(&lines.collect::<Vec<_>>(), width, radius)
}

/// Means over squares of `2 radius + 1` pixels a side, as far as they lie in the picture.
fn means<const N: usize>(values: &[[f32; N]], width: usize, radius: usize) -> Vec<[f32; N]> {
    let height = values.len() / width;
    let mut across = vec![[0.0; N]; values.len()];
    for y in 0..height {
        let row = y * width..(y + 1) * width;
        running(&values[row.clone()], &mut across[row], 1, width, radius);
    }
    let mut both = vec![[0.0; N]; values.len()];
    for x in 0..width {
        running(&across[x..], &mut both[x..], width, height, radius);
    }
    both
}

/// Means along a line of `count` values that stand `step` apart.
fn running<const N: usize>(
    values: &[[f32; N]],
    means: &mut [[f32; N]],
    step: usize,
    count: usize,
    radius: usize,
) {
    let mut sum = [0.0f64; N];
    let change = |sum: &mut [f64; N], i: usize, sign: f64| {
        for (s, v) in sum.iter_mut().zip(&values[i * step]) {
            *s += sign * f64::from(*v);
        }
    };
    for i in 0..radius.min(count) {
        change(&mut sum, i, 1.0);
    }
    for i in 0..count {
        if i + radius < count {
            change(&mut sum, i + radius, 1.0);
        }
        if i > radius {
            change(&mut sum, i - radius - 1, -1.0);
        }
        let held = (i + radius).min(count - 1) + 1 - i.saturating_sub(radius);
        means[i * step] = sum.map(|s| (s / held as f64) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture of two colours with a little texture whose border runs aslant, and how much of each pixel the second has.
    fn two_colours(size: usize) -> (Raster<Vec3>, Raster<f32>) {
        let of = |i: usize| {
            let (x, y) = ((i % size) as f32, (i / size) as f32);
            let share = (x - 0.4 * y - 0.3 * size as f32 + 0.5).clamp(0.0, 1.0);
            let texture = 0.02 * ((x * 1.7 + y * 2.3).sin());
            let colour = Vec3::new(0.3, 0.5, 0.2).lerp(Vec3::new(0.5, 0.35, 0.4), share);
            (colour + texture, share)
        };
        let pixels: Vec<(Vec3, f32)> = (0..size * size).map(of).collect();
        let (colours, shares) = pixels.into_iter().unzip();
        (
            Raster::from_pixels(size, size, colours),
            Raster::from_pixels(size, size, shares),
        )
    }

    /// How many pixels of `a` are on the wrong side.
    fn wrong(a: &Raster<f32>, truth: &Raster<f32>) -> usize {
        let both = a.pixels().iter().zip(truth.pixels());
        both.filter(|(a, b)| (**a > 0.5) != (**b > 0.5)).count()
    }

    #[test]
    fn a_coarse_mask_gets_the_edges_of_the_picture() {
        let (guide, truth) = two_colours(150);
        // As of a depth map with pixels of 6 by 6.
        let coarse = |i: usize| {
            let (x, y) = (i % 150 / 6 * 6 + 3, i / 150 / 6 * 6 + 3);
            truth.get(x.min(149), y.min(149)).round()
        };
        let coarse = Raster::from_pixels(150, 150, (0..150 * 150).map(coarse).collect());
        let fine = guided(&coarse, |i| guide.pixels()[i], 9, 1e-4);
        let (before, after) = (wrong(&coarse, &truth), wrong(&fine, &truth));
        assert!(5 * after < before, "{before} {after}");
    }

    #[test]
    fn squares_of_one_value_stay_and_tiles_do_not_show() {
        let (guide, truth) = two_colours(150);
        let filtered = guided(&truth, |i| guide.pixels()[i], 4, 1e-4);
        for (i, (a, b)) in filtered.pixels().iter().zip(truth.pixels()).enumerate() {
            let (x, y) = ((i % 150) as f32, (i / 150) as f32);
            // Nine pixels from the border in each direction.
            if (x - 0.4 * y - 45.0).abs() > 9.0 * 1.4 + 2.0 {
                assert!((a - b).abs() < 1e-5, "{a} {b} at {x} {y}");
            }
        }
        // The same as of a picture in which rows 60 to 70 are the first ones.
        let part = |r: &Raster<f32>| Raster::from_pixels(150, 90, r.pixels()[150 * 60..].to_vec());
        let colours = &guide.pixels()[150 * 60..];
        let of_part = guided(&part(&truth), |i| colours[i], 4, 1e-4);
        for y in 20..90 {
            for x in 0..150 {
                let (a, b) = (of_part.get(x, y), filtered.get(x, y + 60));
                assert!((a - b).abs() < 1e-5, "{a} {b} at {x} {y}");
            }
        }
    }

    #[test]
    fn means_are_those_of_the_squares() {
        let values: Vec<[f32; 1]> = (0..7 * 5).map(|i| [((i * i) % 11) as f32]).collect();
        let found = means(&values, 7, 2);
        for (i, found) in found.iter().enumerate() {
            let (x, y) = (i % 7, i / 7);
            let (mut sum, mut count) = (0.0, 0.0);
            for v in y.saturating_sub(2)..(y + 3).min(5) {
                for u in x.saturating_sub(2)..(x + 3).min(7) {
                    sum += values[v * 7 + u][0];
                    count += 1.0;
                }
            }
            assert!((found[0] - sum / count).abs() < 1e-5, "{i}");
        }
    }
}
