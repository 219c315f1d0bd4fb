//! Training one network that scores cameras.
use dipir_calibration::look::FEATURES;
use dipir_calibration::network::Network;

use crate::network::{Dropout, Optimiser, SplitMix64, Weights, backward, forward};

/// How networks are trained.
#[derive(Clone, Debug, PartialEq)]
pub struct Training {
    /// Units of each hidden layer.
    pub hidden: usize,
    /// Passes over all photographs.
    pub epochs: usize,
    /// Photographs in a step.
    pub batch: usize,
    /// Highest learning rate; it rises over 100 steps and falls as a cosine.
    pub learning_rate: f32,
    /// Share of a weight that a unit of learning rate removes.
    pub weight_decay: f32,
    /// Share of hidden units that are left out in a step.
    pub dropout: f32,
    /// Share of features that a photograph goes without in a step, under all cameras.
    pub feature_dropout: f32,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            hidden: 64,
            epochs: 12,
            batch: 32,
            learning_rate: 2e-3,
            weight_decay: 0.1,
            dropout: 0.1,
            feature_dropout: 0.15,
        }
    }
}

/// A photograph under its own camera and under others.
pub(crate) struct Sample {
    /// [`FEATURES`] of each camera, the true one first.
    pub features: Vec<f32>,
    /// Logarithms of the share of all cameras that each other one stands for, in two sets: with the true focal length,
    /// and with any.
    pub shares: [Vec<f32>; 2],
    /// Of the true camera in both sets.
    pub own: [f32; 2],
}

/// Trains a network from nothing by the probability of the true camera. `progress` is told the share that is done and
/// the mean loss of late.
pub(crate) fn train(
    samples: &[&Sample],
    settings: &Training,
    seed: u64,
    progress: &mut dyn FnMut(f64, f64),
) -> Network {
    let mut network = start(samples, settings.hidden, seed);
    let mut w: Weights = network.layers.clone();
    let mut optimiser = Optimiser::new(&w);
    let mut random = SplitMix64::new(seed);
    let dropout = Dropout {
        hidden: settings.dropout,
        features: vec![0.0],
    };
    let batch_size = settings.batch.min(samples.len()).max(1);
    let total = (settings.epochs * (samples.len() / batch_size)).max(1);
    let (mut step, mut late) = (0usize, f64::NAN);
    for _ in 0..settings.epochs {
        let mut order: Vec<usize> = (0..samples.len()).collect();
        random.shuffle(&mut order);
        for batch in order.chunks_exact(batch_size) {
            let batch: Vec<&Sample> = batch.iter().map(|k| samples[*k]).collect();
            let x = inputs(&network, &batch, settings.feature_dropout, &mut random);
            let pass = forward(&w, x, &dropout, &mut random);
            let (loss, gradient) = surprise(&pass.outputs, &batch);
            late = match late.is_nan() {
                true => loss,
                false => late + 0.02 * (loss - late),
            };
            let done = step as f32 / total as f32;
            let warm = ((step + 1) as f32 / 100.0).min(1.0);
            let rate =
                settings.learning_rate * warm * (0.5 + 0.5 * (std::f32::consts::PI * done).cos());
            let gradients = backward(&w, &pass, &gradient);
            optimiser.step(&mut w, &gradients, rate, settings.weight_decay);
            step += 1;
            if step.is_multiple_of(100) {
                progress(step as f64 / total as f64, late);
            }
        }
    }
    network.layers = optimiser.mean;
    network
}

/// Standardised features; those that a photograph goes without are at their mean.
fn inputs(
    network: &Network,
    batch: &[&Sample],
    left_out: f32,
    random: &mut SplitMix64,
) -> Vec<f32> {
    let mut all = Vec::new();
    for sample in batch {
        let kept = (1.0 - left_out).recip();
        let mask: Vec<f32> = (0..FEATURES)
            .map(|_| if random.unit() < left_out { 0.0 } else { kept })
            .collect();
        for features in sample.features.chunks(FEATURES) {
            let row = network.standardised(features);
            all.extend(row.iter().zip(&mask).map(|(x, m)| x * m));
        }
    }
    all
}

/// The mean of the negative logarithms of the true camera's density over that of all in both sets, and its gradient.
fn surprise(scores: &[f32], batch: &[&Sample]) -> (f64, Vec<f32>) {
    let share = 1.0 / batch.len() as f32;
    let mut gradient = vec![0.0; scores.len()];
    let (mut loss, mut from) = (0.0, 0);
    for sample in batch {
        let truth = from;
        from += 1;
        for (shares, own) in sample.shares.iter().zip(sample.own) {
            let others = (from..).zip(shares);
            let all: Vec<(usize, f32)> = std::iter::once((truth, scores[truth] + own))
                .chain(others.map(|(k, s)| (k, scores[k] + s)))
                .collect();
            let best = all.iter().map(|a| a.1).fold(f32::NEG_INFINITY, f32::max);
            let total: f32 = all.iter().map(|a| (a.1 - best).exp()).sum();
            loss += f64::from(share * (best + total.ln() - scores[truth]));
            for (k, score) in all {
                gradient[k] += share * (score - best).exp() / total;
            }
            gradient[truth] -= share;
            from += shares.len();
        }
    }
    (loss, gradient)
}

/// A network that knows the means of features and nothing else.
fn start(samples: &[&Sample], hidden: usize, seed: u64) -> Network {
    let mut sums = vec![[0f64; 2]; FEATURES];
    let mut count = 0.0;
    for row in samples.iter().flat_map(|s| s.features.chunks(FEATURES)) {
        count += 1.0;
        for (s, x) in sums.iter_mut().zip(row) {
            s[0] += f64::from(*x);
            s[1] += f64::from(*x) * f64::from(*x);
        }
    }
    let count = f64::max(count, 1.0);
    // A feature that hardly varies must not become noise.
    let spread =
        |s: &[f64; 2]| ((s[1] / count - (s[0] / count).powi(2)).max(0.0).sqrt() + 3e-3) as f32;
    let mut random = SplitMix64::new(seed ^ 0xca3e);
    let mut drawn = |inputs: usize| -> Vec<f32> {
        let bound = (inputs as f32).sqrt().recip();
        (0..inputs * hidden)
            .map(|_| bound * (2.0 * random.unit() - 1.0))
            .collect()
    };
    Network {
        mean: sums.iter().map(|s| (s[0] / count) as f32).collect(),
        deviation: sums.iter().map(spread).collect(),
        layers: [
            drawn(FEATURES),
            vec![0.0; hidden],
            drawn(hidden),
            vec![0.0; hidden],
            vec![0.0; hidden],
            vec![0.0; 1],
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(n: usize, cameras: [usize; 2]) -> Sample {
        let count = 1 + cameras[0] + cameras[1];
        let wave = |k: usize| (0.7 * (k + 31 * n) as f32).sin();
        let mut features = vec![0.0; count * FEATURES];
        // One feature says how far a camera is from the true one.
        for k in 1..count {
            features[k * FEATURES + 3] = 0.3 + wave(k).abs();
        }
        let even = |count: usize| vec![-(count as f32).ln(); count];
        Sample {
            features,
            shares: cameras.map(even),
            own: [-5.0; 2],
        }
    }

    #[test]
    fn the_gradient_of_the_surprise_is_that_of_finite_differences() {
        let (a, b) = (sample(0, [3, 5]), sample(1, [4, 2]));
        let scores: Vec<f32> = (0..16).map(|k| (1.3 * k as f32).sin()).collect();
        let (_, gradient) = surprise(&scores, &[&a, &b]);
        for k in 0..scores.len() {
            let at = |step: f32| {
                let mut moved = scores.clone();
                moved[k] += step;
                surprise(&moved, &[&a, &b]).0
            };
            // Sums of about 4 in f32: differences over .02 are good to 1e-4.
            let numeric = (at(0.01) - at(-0.01)) / 0.02;
            assert!(
                (numeric - f64::from(gradient[k])).abs() < 2e-4,
                "{k}: {numeric}"
            );
        }
    }

    #[test]
    fn a_network_learns_what_tells_the_true_camera() {
        let samples: Vec<Sample> = (0..64).map(|n| sample(n, [6, 6])).collect();
        let settings = Training {
            hidden: 16,
            epochs: 40,
            dropout: 0.0,
            feature_dropout: 0.0,
            ..Training::default()
        };
        let all: Vec<&Sample> = samples.iter().collect();
        let network = train(&all, &settings, 1, &mut |_, _| ());
        for s in &samples {
            let scores = s.features.chunks(FEATURES).map(|f| network.score(f));
            let scores: Vec<f64> = scores.collect();
            assert!(scores[1..].iter().all(|o| *o < scores[0]), "{scores:?}");
        }
    }
}
