//! Several photographs of one place under one light.
use crate::error::EstimatorError;
use crate::estimate::{Interval, LightEstimate};
use crate::grid::{BASE, BINS};
use crate::posterior::PeakPosterior;

/// Added to every bin's probability before estimates are multiplied: none is so sure that another cannot object.
const DOUBT: f64 = 0.1 / BINS as f64;

/// The light that several photographs of one place agree on, relative to the first one's view and on its scale. Their
/// headings have to be known; they are taken to have the same exposure.
///
/// Posteriors are multiplied, intervals are multiplied as normal distributions, maps are averaged in the world.
pub fn combine(estimates: &[LightEstimate]) -> Result<LightEstimate, EstimatorError> {
    let first = estimates.first().ok_or(EstimatorError::Nothing)?;
    let count = estimates.len() as f64;
    let mut combined = first.clone();
    let mut scores = vec![0.0; BINS];
    let mut odds = 0.0;
    let mut base = vec![[0f64; 3]; first.base.len()];
    let mut peak = [0f64; 3];
    for e in estimates {
        let turn = first.heading_rad - e.heading_rad;
        let turned = e.posterior.turned(turn.to_degrees());
        for (s, w) in scores.iter_mut().zip(&turned.weights) {
            *s += (f64::from(*w) + DOUBT).ln();
        }
        let p = e.sun_probability.clamp(0.01, 0.99);
        odds += (p / (1.0 - p)).ln();
        for c in 0..3 {
            peak[c] += f64::from(e.peak[c].max(1e-6)).ln() / count;
        }
        add_turned(&mut base, &e.base, turn, 1.0 / count);
    }
    let best = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    combined.posterior =
        PeakPosterior::normalised(scores.iter().map(|s| (s - best).exp()).collect());
    // Photographs of one place make the same mistake about its kind: odds are averaged, not multiplied.
    combined.sun_probability = 1.0 / (1.0 + (-odds / count).exp());
    combined.base = base.iter().map(|t| t.map(|v| v as f32)).collect();
    combined.peak = peak.map(|v| v.exp() as f32);
    combined.share = product(estimates.iter().map(|e| (e.share, 0.0)));
    let scale = |e: &LightEstimate| (e.reference / first.reference).log2();
    combined.exposure_stops = product(estimates.iter().map(|e| (e.exposure_stops, scale(e))));
    Ok(combined.described())
}

/// Adds `weight` times a smooth part as a camera sees it whose azimuth is larger by `turn_rad`.
fn add_turned(sum: &mut [[f64; 3]], base: &[[f32; 3]], turn_rad: f64, weight: f64) {
    let columns = BASE[0];
    let shift = (turn_rad / std::f64::consts::TAU * columns as f64).rem_euclid(columns as f64);
    let (whole, part) = (shift.floor() as usize, shift.fract());
    for (k, s) in sum.iter_mut().enumerate() {
        let (row, j) = (k / columns * columns, k % columns);
        let near = base[row + (j + whole) % columns];
        let far = base[row + (j + whole + 1) % columns];
        for c in 0..3 {
            s[c] += weight * (f64::from(near[c]) * (1.0 - part) + f64::from(far[c]) * part);
        }
    }
}

/// The product of intervals as normal distributions, each moved by its offset. What they share is not averaged away:
/// the result is no narrower than 1 / sqrt(2) of the narrowest.
fn product(intervals: impl Iterator<Item = (Interval, f64)>) -> Interval {
    let (mut precision, mut mean, mut least) = (0.0, 0.0, f64::INFINITY);
    for (i, offset) in intervals {
        let width = (i.high - i.low).max(1e-6);
        precision += 1.0 / (width * width);
        mean += (i.middle + offset) / (width * width);
        least = least.min(width);
    }
    let (mean, width) = (
        mean / precision,
        precision
            .sqrt()
            .recip()
            .max(least / std::f64::consts::SQRT_2),
    );
    Interval::new(mean - 0.5 * width, mean, mean + 0.5 * width)
}
