//! How wrong an answer is, in the picture first, and the gradient of that.
use std::f32::consts::PI;

use dipir_estimator::grid::{BASE_TEXELS, BINS};
use dipir_estimator::histogram::{SHARES, STOPS};
use dipir_estimator::network::{
    ENERGY, EXPOSURE, HISTOGRAM, LOG_ENERGY, LOG_RADIANCE, MAP, OUTPUTS, SHARE, SUN,
};
use dipir_estimator::posterior::soft_bins;

use crate::examples::Truth;
use crate::probes::{PROBES, Probes};

/// Weight of the light on surfaces and in reflections.
const PICTURE: f32 = 10.0;
/// The same without the strongest source.
const SMOOTH: f32 = 5.0;
/// Weight of the logarithm of the smooth part, texel by texel: decides what probes leave open.
const TEXELS: f32 = 0.02;
/// Weight of the source's energy.
const SOURCE: f32 = 0.3;
/// Weight of where the source stands, times how much light it has.
const DIRECTION: f32 = 0.05;
/// Weight of whether there is a sun.
const SUNNY: f32 = 0.05;
/// Weight of the distributions of exposure and of share.
const SPREAD: f32 = 0.03;
/// Reflectance of the surfaces that are judged.
const ALBEDO: f32 = 0.6;

/// A display value of linear light whose clipping is soft, so that it has a slope, and the slope.
fn shown(x: f32) -> (f32, f32) {
    let x = x.max(1e-6);
    let rest = (-ALBEDO * x).exp();
    let value = (1.0 - rest).powf(1.0 / 2.2);
    (value, value / (1.0 - rest) / 2.2 * rest * ALBEDO)
}

/// The loss of `outputs` for a photograph of mean luminance `reference`, its gradient added to `gradient` with weight
/// `weight`.
pub(crate) fn loss(
    outputs: &[f32],
    truth: &Truth,
    reference: f32,
    probes: &Probes,
    weight: f32,
    gradient: &mut [f32],
) -> f32 {
    debug_assert!(outputs.len() == OUTPUTS && gradient.len() == OUTPUTS);
    let mut total = picture(outputs, truth, reference, probes, weight, gradient);
    let wanted = soft_bins(truth.peak);
    let probability = softmax(&outputs[HISTOGRAM..HISTOGRAM + BINS]);
    let strength = weight * DIRECTION * (2.0 * truth.share + 0.1).min(1.0);
    for k in 0..BINS {
        total -= strength / weight * wanted[k] * probability[k].max(1e-12).ln();
        gradient[HISTOGRAM + k] += strength * (probability[k] - wanted[k]);
    }
    let sun = 1.0 / (1.0 + (-outputs[SUN]).exp());
    let is_sun = f32::from(u8::from(truth.sun));
    total -= SUNNY * (is_sun * sun.max(1e-12).ln() + (1.0 - is_sun) * (1.0 - sun).max(1e-12).ln());
    gradient[SUN] += weight * SUNNY * (sun - is_sun);
    for (from, scale, value) in [(EXPOSURE, STOPS, truth.stops), (SHARE, SHARES, truth.share)] {
        let wanted = scale.soft(f64::from(value));
        let probability = softmax(&outputs[from..from + scale.count]);
        for k in 0..scale.count {
            total -= SPREAD * wanted[k] * probability[k].max(1e-12).ln();
            gradient[from + k] += weight * SPREAD * (probability[k] - wanted[k]);
        }
    }
    total
}

fn softmax(scores: &[f32]) -> Vec<f32> {
    let best = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let e: Vec<f32> = scores.iter().map(|s| (s - best).exp()).collect();
    let total: f32 = e.iter().sum();
    e.iter().map(|v| v / total).collect()
}

fn picture(
    outputs: &[f32],
    truth: &Truth,
    reference: f32,
    probes: &Probes,
    weight: f32,
    gradient: &mut [f32],
) -> f32 {
    let mut total = 0.0;
    let probability = softmax(&outputs[HISTOGRAM..HISTOGRAM + BINS]);
    let rows = probes.bins.chunks(BINS);
    let spread: Vec<f32> = rows
        .map(|row| row.iter().zip(&probability).map(|(w, p)| w * p).sum())
        .collect();
    let mut spread_gradient = [0f32; PROBES];
    for c in 0..3 {
        let kept = |v: f32, [low, high]: [f32; 2]| (v > low && v < high) as u8 as f32;
        let log: Vec<f32> = (0..BASE_TEXELS).map(|m| outputs[MAP + 3 * m + c]).collect();
        let base: Vec<f32> = log
            .iter()
            .map(|v| v.clamp(LOG_RADIANCE[0], LOG_RADIANCE[1]).exp())
            .collect();
        let raw = outputs[ENERGY + c];
        let energy = raw.clamp(LOG_ENERGY[0], LOG_ENERGY[1]).exp();
        let mut energy_gradient = 0.0;
        let mut base_gradient = [0f32; BASE_TEXELS];
        for p in 0..PROBES {
            let row = &probes.base[p * BASE_TEXELS..(p + 1) * BASE_TEXELS];
            let smooth: f32 = row.iter().zip(&base).map(|(w, b)| w * b).sum();
            let judge = |found: f32, wanted: f32, strength: f32| {
                let ((a, slope), (b, _)) = (shown(found * reference), shown(wanted * reference));
                let scale = strength * probes.strength[p] / (3 * PROBES) as f32;
                (
                    scale * (a - b) * (a - b),
                    2.0 * scale * (a - b) * slope * reference,
                )
            };
            let (l1, g1) = judge(smooth + spread[p] * energy, truth.all[p][c], PICTURE);
            let (l2, g2) = judge(smooth, truth.smooth[p][c], SMOOTH);
            total += l1 + l2;
            energy_gradient += g1 * spread[p];
            spread_gradient[p] += g1 * energy;
            base_gradient
                .iter_mut()
                .zip(row)
                .for_each(|(g, w)| *g += w * (g1 + g2));
        }
        let ((a, slope), (b, _)) = (
            shown(energy / PI * reference),
            shown(truth.energy[c] / PI * reference),
        );
        total += SOURCE / 3.0 * (a - b) * (a - b);
        energy_gradient += 2.0 * SOURCE / 3.0 * (a - b) * slope * reference / PI;
        gradient[ENERGY + c] += weight * energy_gradient * energy * kept(raw, LOG_ENERGY);
        for m in 0..BASE_TEXELS {
            let off = log[m] - truth.log_base[m][c];
            let scale = TEXELS / (3 * BASE_TEXELS) as f32;
            total += scale * off * off;
            let through = base_gradient[m] * base[m] * kept(log[m], LOG_RADIANCE);
            gradient[MAP + 3 * m + c] += weight * (through + 2.0 * scale * off);
        }
    }
    let mut each = vec![0f32; BINS];
    for (row, g) in probes.bins.chunks(BINS).zip(spread_gradient) {
        each.iter_mut().zip(row).for_each(|(e, w)| *e += w * g);
    }
    let mean: f32 = each.iter().zip(&probability).map(|(e, p)| e * p).sum();
    for k in 0..BINS {
        gradient[HISTOGRAM + k] += weight * probability[k] * (each[k] - mean);
    }
    total
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let probes = Probes::default();
        let wave = |k: usize| (0.7 * k as f32).sin();
        let texel = |k: usize| Vec3::new(1.2 + wave(k), 1.3 + wave(k + 1), 1.5 + wave(k + 2));
        let truth = Truth {
            smooth: (0..PROBES).map(texel).collect(),
            all: (0..PROBES).map(|k| texel(k) + Vec3::splat(0.4)).collect(),
            energy: Vec3::new(2.0, 1.5, 1.0),
            peak: Vec3::new(0.6, 0.48, -0.64),
            share: 0.4,
            sun: true,
            stops: 0.7,
            log_base: (0..BASE_TEXELS).map(|k| [wave(k), 0.1, -0.2]).collect(),
        };
        let outputs: Vec<f32> = (0..OUTPUTS).map(|k| 0.4 * wave(3 * k)).collect();
        let mut gradient = vec![0.0; OUTPUTS];
        let mut unused = vec![0.0; OUTPUTS];
        loss(&outputs, &truth, 0.3, &probes, 1.0, &mut gradient);
        for k in (0..OUTPUTS)
            .step_by(13)
            .chain(ENERGY..ENERGY + 3)
            .chain(SUN..OUTPUTS)
        {
            let mut at = |step: f32| {
                let mut moved = outputs.clone();
                moved[k] += step;
                loss(&moved, &truth, 0.3, &probes, 1.0, &mut unused)
            };
            // The loss is a sum of about 1 in f32: differences over .02 are good to 1e-5.
            let numeric = (at(0.01) - at(-0.01)) / 0.02;
            let off = (numeric - gradient[k]).abs();
            assert!(
                off < 2e-4 + 0.02 * numeric.abs(),
                "{k}: {numeric} {}",
                gradient[k]
            );
        }
    }
}
