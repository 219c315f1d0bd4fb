//! Training one network from features to scores of bins.
use dipir_calibration::network::{Head, Network};

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
    /// Share of features that are left out in a step.
    pub feature_dropout: f32,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            hidden: 128,
            epochs: 8,
            batch: 128,
            learning_rate: 2e-3,
            weight_decay: 0.1,
            dropout: 0.4,
            feature_dropout: 0.1,
        }
    }
}

/// A photograph: its features, and how much of each bin it is.
pub(crate) struct Sample {
    pub features: Vec<f32>,
    pub target: Vec<f32>,
}

/// Trains a network from nothing by the cross entropy of each axis. `progress` is told the share that is done and the
/// mean loss of late.
pub(crate) fn train(
    head: Head,
    samples: &[&Sample],
    settings: &Training,
    seed: u64,
    progress: &mut dyn FnMut(f64, f64),
) -> Network {
    let mut network = start(head, samples, settings.hidden, seed);
    let inputs: Vec<Vec<f32>> = samples
        .iter()
        .map(|s| network.standardised(&s.features))
        .collect();
    let mut w: Weights = network.layers.clone();
    let mut optimiser = Optimiser::new(&w);
    let mut random = SplitMix64::new(seed);
    let dropout = Dropout {
        hidden: settings.dropout,
        features: settings.feature_dropout,
    };
    let total = (settings.epochs * (samples.len() / settings.batch)).max(1);
    let (mut step, mut late) = (0usize, f64::NAN);
    for _ in 0..settings.epochs {
        let mut order: Vec<usize> = (0..samples.len()).collect();
        random.shuffle(&mut order);
        for batch in order.chunks_exact(settings.batch) {
            let x = batch.iter().flat_map(|k| inputs[*k].iter().copied());
            let pass = forward(&w, x.collect(), dropout, &mut random);
            let targets: Vec<&[f32]> = batch.iter().map(|k| &samples[*k].target[..]).collect();
            let (loss, gradient) = cross_entropy(head, &pass.outputs, &targets);
            late = if late.is_nan() {
                loss
            } else {
                late + 0.02 * (loss - late)
            };
            let done = step as f32 / total as f32;
            let warm = ((step + 1) as f32 / 100.0).min(1.0);
            let rate =
                settings.learning_rate * warm * (0.5 + 0.5 * (std::f32::consts::PI * done).cos());
            let gradients = backward(&w, &pass, &gradient);
            optimiser.step(&mut w, &gradients, rate, settings.weight_decay);
            step += 1;
            if step % 100 == 0 {
                progress(step as f64 / total as f64, late);
            }
        }
    }
    network.layers = optimiser.mean;
    network
}

/// The mean loss of a batch of scores, and its gradient.
fn cross_entropy(head: Head, scores: &[f32], targets: &[&[f32]]) -> (f64, Vec<f32>) {
    let share = 1.0 / targets.len() as f32;
    let mut gradient = vec![0.0; scores.len()];
    let mut loss = 0.0;
    for (n, target) in targets.iter().enumerate() {
        let mut from = 0;
        for axis in head.axes() {
            let at = n * head.outputs() + from..n * head.outputs() + from + axis.count;
            let own = &scores[at.clone()];
            let best = own.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let total: f32 = own.iter().map(|s| (s - best).exp()).sum();
            for (k, g) in gradient[at].iter_mut().enumerate() {
                let wanted = target[from + k];
                let log = own[k] - best - total.ln();
                loss -= f64::from(share * wanted * log);
                *g = share * (log.exp() - wanted);
            }
            from += axis.count;
        }
    }
    (loss, gradient)
}

/// A network that knows the means of features and of answers, and nothing else.
fn start(head: Head, samples: &[&Sample], hidden: usize, seed: u64) -> Network {
    let count = samples.len().max(1) as f64;
    let mut sums = vec![[0f64; 2]; head.inputs()];
    let mut answers = vec![0f64; head.outputs()];
    for sample in samples {
        for (s, x) in sums.iter_mut().zip(&sample.features) {
            s[0] += f64::from(*x);
            s[1] += f64::from(*x) * f64::from(*x);
        }
        for (a, t) in answers.iter_mut().zip(&sample.target) {
            *a += f64::from(*t) / count;
        }
    }
    // A feature that hardly varies must not become noise.
    let spread =
        |s: &[f64; 2]| ((s[1] / count - (s[0] / count).powi(2)).max(0.0).sqrt() + 0.01) as f32;
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
            drawn(head.inputs()),
            vec![0.0; hidden],
            drawn(hidden),
            vec![0.0; hidden],
            vec![0.0; hidden * head.outputs()],
            answers.iter().map(|a| (a + 1e-3).ln() as f32).collect(),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gradient_of_the_cross_entropy_is_that_of_finite_differences() {
        let head = Head::Turn;
        let wave = |k: usize| (0.7 * k as f32).sin();
        let scores: Vec<f32> = (0..2 * head.outputs()).map(wave).collect();
        let target = |from: usize| -> Vec<f32> {
            let mut all = Vec::new();
            for axis in head.axes() {
                let raw: Vec<f32> = (0..axis.count).map(|k| 1.1 + wave(from + 3 * k)).collect();
                let total: f32 = raw.iter().sum();
                all.extend(raw.iter().map(|v| v / total));
            }
            all
        };
        let (a, b) = (target(0), target(5));
        let (_, gradient) = cross_entropy(head, &scores, &[&a, &b]);
        for k in (0..scores.len()).step_by(5) {
            let at = |step: f32| {
                let mut moved = scores.clone();
                moved[k] += step;
                cross_entropy(head, &moved, &[&a, &b]).0
            };
            // Sums of 53 terms in f32 of about 3: differences over .02 are good to 1e-4.
            let numeric = (at(0.01) - at(-0.01)) / 0.02;
            assert!(
                (numeric - f64::from(gradient[k])).abs() < 2e-4,
                "{k}: {numeric}"
            );
        }
    }

    #[test]
    fn a_network_learns_a_pitch_that_a_feature_tells() {
        let head = Head::Turn;
        let samples: Vec<Sample> = (0..512)
            .map(|n| {
                let pitch = -40.0 + 60.0 * f64::from(n * 37 % 512) / 512.0;
                let mut features = vec![0.0; head.inputs()];
                features[3] = pitch as f32 / 20.0;
                let [a, b] = [(0, pitch), (1, 0.0)]
                    .map(|(k, v)| dipir_calibration::network::soft(&head.axes()[k], v));
                Sample {
                    features,
                    target: [a, b].concat(),
                }
            })
            .collect();
        let settings = Training {
            hidden: 32,
            epochs: 60,
            dropout: 0.0,
            feature_dropout: 0.0,
            weight_decay: 0.0,
            ..Training::default()
        };
        let all: Vec<&Sample> = samples.iter().collect();
        let network = train(head, &all, &settings, 1, &mut |_, _| ());
        for n in [3, 100, 400] {
            let told = network.probabilities(head, &samples[n].features);
            let axis = head.axes()[0];
            let mean: f64 = axis.values().zip(&told[0]).map(|(v, p)| v * p).sum();
            let wanted = f64::from(samples[n].features[3]) * 20.0;
            // Half a bin.
            assert!((mean - wanted).abs() < 1.3, "{mean} {wanted}");
        }
    }
}
