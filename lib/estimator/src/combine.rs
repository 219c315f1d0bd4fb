//! Several photographs of one place under one light.
use std::f64::consts::{PI, TAU};

use dipir_light::luminance::luminance_f64;
use glam::DVec3;

use crate::error::EstimatorError;
use crate::estimate::{Interval, LightEstimate};
use crate::grid::{BASE, BINS, base_texel};
use crate::posterior::PeakPosterior;

/// Added to every bin's probability before estimates are multiplied: none is so sure that another cannot object.
const DOUBT: f64 = 0.1 / BINS as f64;
/// Of the smooth light a photograph counts for a direction by `exp(NEARNESS cos)` of the angle from where it looks.
const NEARNESS: f64 = 4.0;

/// What one of several photographs of a place says of its light.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewEstimate {
    /// Its estimate by itself.
    pub estimate: LightEstimate,
    /// Its exposure over that of the first photograph, stops; `None` where it is not known. Not used of the first.
    pub stops: Option<f64>,
}

/// The light that several photographs of one place agree on, relative to the first one's view and on its scale. Their
/// headings have to be known. A photograph whose exposure is not known says nothing of how bright the light is.
///
/// Posteriors are averaged as logarithms, times the root of their number: photographs of one place err alike.
/// Brightness is averaged in stops, the smooth light by how near to it each photograph looks.
pub fn combine(views: &[ViewEstimate]) -> Result<LightEstimate, EstimatorError> {
    let first = &views.first().ok_or(EstimatorError::Nothing)?.estimate;
    if views.len() == 1 {
        return Ok(first.clone());
    }
    let count = views.len() as f64;
    let mut combined = first.clone();
    let mut scores = vec![0.0; BINS];
    let mut odds = 0.0;
    let mut base = vec![([0f64; 3], 0f64); first.base.len()];
    let mut peak = [0f64; 3];
    for ViewEstimate { estimate: e, .. } in views {
        let turn = first.heading_rad - e.heading_rad;
        let turned = e.posterior.turned(turn.to_degrees());
        for (s, w) in scores.iter_mut().zip(&turned.weights) {
            *s += (f64::from(*w) + DOUBT).ln();
        }
        let p = e.sun_probability.clamp(0.01, 0.99);
        odds += (p / (1.0 - p)).ln();
        let level = mean(e);
        for c in 0..3 {
            peak[c] += (f64::from(e.peak[c]) / level).max(1e-6).ln() / count;
        }
        add_turned(&mut base, &e.base, turn, 1.0 / level);
    }
    let best = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let tempered = |s: &f64| ((s - best) / count.sqrt()).exp();
    combined.posterior = PeakPosterior::normalised(scores.iter().map(tempered).collect());
    // Photographs of one place make the same mistake about its kind: odds are averaged, not multiplied.
    combined.sun_probability = 1.0 / (1.0 + (-odds / count).exp());
    let texel = |(sum, weight): &([f64; 3], f64)| sum.map(|v| (v / weight) as f32);
    combined.base = base.iter().map(texel).collect();
    combined.peak = peak.map(|v| v.exp() as f32);
    let rest = || {
        views
            .iter()
            .skip(1)
            .filter_map(|v| Some((&v.estimate, v.stops?)))
    };
    let known = || std::iter::once((first, 0.0)).chain(rest());
    let level = averaged(known().map(|(e, stops)| (e.exposure_stops, mean(e).log2() - stops)));
    combined.exposure_stops = joined(known().map(|(e, stops)| {
        let offset = (e.reference / first.reference).log2() - stops;
        (e.exposure_stops, offset)
    }));
    combined.share = joined(views.iter().map(|v| (v.estimate.share, 0.0)));
    let scale = (level.exp2() / mean(&combined)) as f32;
    combined.peak = combined.peak.map(|v| v * scale);
    for texel in &mut combined.base {
        *texel = texel.map(|v| v * scale);
    }
    Ok(combined.described())
}

/// Mean radiance over the sphere, as luminance; above 0.
fn mean(e: &LightEstimate) -> f64 {
    let texel =
        |(k, t): (usize, &[f32; 3])| DVec3::from(t.map(f64::from)) * f64::from(base_texel(k).1);
    let base: DVec3 = e.base.iter().enumerate().map(texel).sum();
    let all = base + DVec3::from(e.peak.map(f64::from));
    (luminance_f64(all) / (4.0 * PI)).max(1e-9)
}

/// Adds a smooth part as a camera sees it whose azimuth is larger by `turn_rad`, each texel times `scale` and by how
/// near to it that smooth part's own camera looks, and adds up these weights.
fn add_turned(sum: &mut [([f64; 3], f64)], base: &[[f32; 3]], turn_rad: f64, scale: f64) {
    let columns = BASE[0];
    let shift = (turn_rad / TAU * columns as f64).rem_euclid(columns as f64);
    let (whole, part) = (shift.floor() as usize, shift.fract());
    for (k, (s, total)) in sum.iter_mut().enumerate() {
        let (row, j) = (k / columns * columns, k % columns);
        let near = base[row + (j + whole) % columns];
        let far = base[row + (j + whole + 1) % columns];
        let towards = base_texel(k).0.as_dvec3();
        let ahead = DVec3::new(-turn_rad.sin(), 0.0, -turn_rad.cos());
        let weight = (NEARNESS * towards.dot(ahead)).exp();
        *total += weight;
        for c in 0..3 {
            let value = f64::from(near[c]) * (1.0 - part) + f64::from(far[c]) * part;
            s[c] += weight * scale * value;
        }
    }
}

/// The mean of the offsets, by how narrow the intervals are.
fn averaged(intervals: impl Iterator<Item = (Interval, f64)>) -> f64 {
    let (mut precision, mut sum) = (0.0, 0.0);
    for (i, offset) in intervals {
        let width = (i.high - i.low).max(1e-6);
        precision += 1.0 / (width * width);
        sum += offset / (width * width);
    }
    sum / precision
}

/// The mean of intervals, each moved by its offset: what one photograph of a place is wrong about, the others mostly
/// are, too, so that all of them are hardly surer than one.
fn joined(intervals: impl Iterator<Item = (Interval, f64)> + Clone) -> Interval {
    let [low, middle, high] = [
        |i: &Interval| i.low,
        |i: &Interval| i.middle,
        |i: &Interval| i.high,
    ]
    .map(|end| averaged(intervals.clone().map(|(i, offset)| (i, end(&i) + offset))));
    Interval::new(low, middle, high)
}
