//! Signs of where light comes from, and of sunlight: where the picture is brightest, how ground and what stands above
//! it differ from left to right, whether what is bright is warmer than what is dark, and which way edges face.
use std::f32::consts::TAU;

use glam::Vec3;

use crate::features::{CLIPPED, SIDE};

/// Added to channels before tints are taken.
const FLOOR: f32 = 0.004;
/// Rays below or above this elevation are of the ground or of what stands above it, degrees.
const LEVEL_DEG: f32 = 4.0;
/// Bins of edge direction.
const FACINGS: usize = 8;
/// Regions: ground and above.
const REGIONS: usize = 2;
/// Left, middle, right.
const THIRDS: usize = 3;
/// Features of each third of a region.
const PER_THIRD: usize = 5;
/// Features of the brightness of each region against its tint, and of the shape of its histogram.
const PER_SHAPE: usize = 4;
/// Numbers in all.
pub(crate) const CUES: usize = 6 + REGIONS * (THIRDS * PER_THIRD + PER_SHAPE + FACINGS);

/// The [`CUES`] of a picture of `SIDE` x `SIDE` pixels: linear light, the logarithm of its luminance over the
/// picture's mean, and the elevation of each pixel's ray in degrees.
pub(crate) fn cues(pixels: &[Vec3], light: &[f32], log: &[f32], elevation_deg: &[f32]) -> Vec<f32> {
    let mut all = Vec::with_capacity(CUES);
    all.extend(brightest(light, elevation_deg));
    for ground in [true, false] {
        let inside: Vec<usize> = (0..SIDE * SIDE)
            .filter(|&k| match ground {
                true => elevation_deg[k] < -LEVEL_DEG,
                false => elevation_deg[k] > LEVEL_DEG,
            })
            .collect();
        for third in 0..THIRDS {
            let part = inside.iter().copied();
            let part = part.filter(|k| k % SIDE * THIRDS / SIDE == third).collect();
            all.extend(part_of(part, pixels, log));
        }
        all.extend(shape(&inside, pixels, log));
        all.extend(facings(&inside, log));
    }
    debug_assert_eq!(all.len(), CUES);
    all
}

/// Pixel `k`'s place to the side, then upwards, in `[-1, 1]`.
fn place(k: usize) -> [f32; 2] {
    let at = |n: usize| (n as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
    [at(k % SIDE), -at(k / SIDE)]
}

/// The middle of the luminance and of its fourth power, which is that of what is brightest, with the latter's spread
/// to the side and its elevation.
fn brightest(light: &[f32], elevation_deg: &[f32]) -> [f32; 6] {
    let mut sums = [0f64; 8];
    for (k, l) in light.iter().enumerate() {
        let ([x, y], strong) = (place(k), l.powi(4) + 1e-6);
        let weak = l + 1e-3;
        let terms = [
            weak,
            weak * x,
            weak * y,
            strong,
            strong * x,
            strong * y,
            strong * x * x,
            strong * elevation_deg[k] / 45.0,
        ];
        sums.iter_mut()
            .zip(terms)
            .for_each(|(s, t)| *s += f64::from(t));
    }
    let mean = |k: usize, over: usize| (sums[k] / sums[over]) as f32;
    let spread = (mean(6, 3) - mean(4, 3).powi(2)).max(0.0).sqrt();
    [
        mean(1, 0),
        mean(2, 0),
        mean(4, 3),
        mean(5, 3),
        spread,
        mean(7, 3),
    ]
}

/// Low, middle and high log-luminance, the share of clipped pixels, and the tint of a part; zeros if it is small.
fn part_of(part: Vec<usize>, pixels: &[Vec3], log: &[f32]) -> [f32; PER_THIRD] {
    if part.len() < SIDE {
        return [0.0; PER_THIRD];
    }
    let mut sorted: Vec<f32> = part.iter().map(|&k| log[k]).collect();
    sorted.sort_by(f32::total_cmp);
    let quantile = |q: f32| sorted[(q * (sorted.len() - 1) as f32).round() as usize];
    let clipped = part.iter().filter(|k| pixels[**k].max_element() > CLIPPED);
    let count = part.len() as f32;
    [
        quantile(0.1),
        quantile(0.5),
        quantile(0.9),
        clipped.count() as f32 / count,
        part.iter().map(|&k| warmth(pixels[k])).sum::<f32>() / count,
    ]
}

/// The logarithm of red over blue.
fn warmth(pixel: Vec3) -> f32 {
    ((pixel.x + FLOOR) / (pixel.z + FLOOR)).ln()
}

/// How warmth goes with brightness (slope and correlation), then skewness and bimodality of log-luminance. Sun lights
/// surfaces warmer than the sky that lights their shadows, and makes two heaps of what was one.
fn shape(inside: &[usize], pixels: &[Vec3], log: &[f32]) -> [f32; PER_SHAPE] {
    if inside.len() < 2 * SIDE {
        return [0.0; PER_SHAPE];
    }
    let count = inside.len() as f64;
    let of = |value: &dyn Fn(usize) -> f64| inside.iter().map(|&k| value(k)).sum::<f64>() / count;
    let warm = |k: usize| f64::from(warmth(pixels[k]));
    let (mean, tint) = (of(&|k| f64::from(log[k])), of(&warm));
    let off = |k: usize| f64::from(log[k]) - mean;
    let moment = |n: i32| of(&|k| off(k).powi(n));
    let variance = moment(2) + 1e-3;
    let covariance = of(&|k| off(k) * (warm(k) - tint));
    let spread = of(&|k| (warm(k) - tint).powi(2)) + 1e-3;
    let skewness = moment(3) / variance.powf(1.5);
    let kurtosis = moment(4) / (variance * variance) + 1e-2;
    [
        covariance / variance,
        covariance / (variance * spread).sqrt(),
        skewness,
        (skewness * skewness + 1.0) / (kurtosis + 1.0),
    ]
    .map(|v| v as f32)
}

/// How steep log-luminance is, by the direction in which it grows.
fn facings(inside: &[usize], log: &[f32]) -> [f32; FACINGS] {
    let mut sums = [0f32; FACINGS];
    let mut count = 1.0;
    for &k in inside {
        let (x, y) = (k % SIDE, k / SIDE);
        if !(1..SIDE - 1).contains(&x) || !(1..SIDE - 1).contains(&y) {
            continue;
        }
        let (right, up) = (log[k + 1] - log[k - 1], log[k - SIDE] - log[k + SIDE]);
        let steep = right.hypot(up).min(2.0);
        let sector = up.atan2(right).rem_euclid(TAU) / TAU * FACINGS as f32;
        sums[sector as usize % FACINGS] += steep;
        count += 1.0;
    }
    sums.map(|s| s / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ground in the lower half whose right side is lit, four times as bright and warmer.
    fn cues_of(lit: impl Fn(usize) -> bool) -> Vec<f32> {
        let pixel = |k: usize| match lit(k % SIDE) {
            true => Vec3::new(0.5, 0.4, 0.3),
            false => Vec3::new(0.1, 0.1, 0.1),
        };
        let pixels: Vec<Vec3> = (0..SIDE * SIDE).map(pixel).collect();
        let light: Vec<f32> = pixels.iter().map(|p| p.y).collect();
        let log: Vec<f32> = light.iter().map(|l| l.ln()).collect();
        let elevation: Vec<f32> = (0..SIDE * SIDE).map(|k| 32.0 - (k / SIDE) as f32).collect();
        cues(&pixels, &light, &log, &elevation)
    }

    #[test]
    fn the_lit_side_is_found_and_changes_sides_in_a_mirror() {
        let (right, left) = (cues_of(|x| x >= SIDE / 2), cues_of(|x| x < SIDE / 2));
        assert_eq!(right.len(), CUES);
        assert!(right[0] > 0.2 && right[2] > 0.4, "{:?}", &right[..6]);
        for k in [0, 2] {
            assert!((right[k] + left[k]).abs() < 1e-5);
        }
        let thirds = 6;
        assert!(right[thirds + 1] < right[thirds + 2 * PER_THIRD + 1]);
    }

    #[test]
    fn warm_light_on_bright_ground_is_found() {
        let shape = 6 + THIRDS * PER_THIRD;
        let all = cues_of(|x| x >= SIDE / 2);
        // Brightness and warmth take the same two values: they go together but for the terms that keep them finite.
        assert!(all[shape] > 0.2 && all[shape + 1] > 0.95);
    }
}
