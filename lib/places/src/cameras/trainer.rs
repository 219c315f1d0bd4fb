//! Training the networks that tell cameras.
use dipir_calibration::look::FEATURES;
use dipir_calibration::network::{Network, SCORED};
use dipir_calibration::pose::Pose;
use dipir_calibration::whole::{FOCALS, PITCHES, TOLD, Table, WHOLE, Whole, shares};

use crate::error::PlacesError;
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

impl Training {
    /// Of the networks that score cameras.
    pub fn of_scorers() -> Self {
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

    /// Of the networks that see pictures as a whole.
    pub fn of_wholes() -> Self {
        Self {
            hidden: 64,
            epochs: 12,
            batch: 64,
            learning_rate: 2e-3,
            weight_decay: 1.0,
            dropout: 0.2,
            feature_dropout: 0.5,
        }
    }
}

/// A photograph under its own camera and under others.
pub(crate) struct Sample {
    /// As a whole.
    pub whole: Whole,
    /// The true camera and the others.
    pub poses: Vec<Pose>,
    /// [`FEATURES`] of each camera.
    pub features: Vec<f32>,
    /// Logarithms of the share of all cameras that each other one stands for, in two sets: with the true focal length,
    /// and with any.
    pub shares: [Vec<f32>; 2],
    /// Of the true camera in both sets.
    pub own: [f32; 2],
}

impl Sample {
    /// [`TOLD`] of each camera, by a network that did not learn from the photograph.
    pub fn told(&self, whole: &Network) -> Vec<f32> {
        let sides = self.whole.sides.each_ref();
        let table = Table::mean(&sides.map(|side| whole.outputs(side)));
        self.poses.iter().flat_map(|p| table.told(p)).collect()
    }
}

/// Trains a network from nothing to tell how probable the true camera is from pictures as a whole, as they are and
/// mirrored. Weights that are not finite are an error.
pub(crate) fn train_whole(
    samples: &[&Sample],
    settings: &Training,
    seed: u64,
) -> Result<Network, PlacesError> {
    let sides: Vec<(&[f32], &Pose)> = samples
        .iter()
        .flat_map(|s| s.whole.sides.iter().map(|side| (&side[..], &s.poses[0])))
        .collect();
    let rows = sides.iter().map(|s| s.0.to_vec());
    let mut network = start(rows, [WHOLE, settings.hidden, PITCHES * FOCALS], seed);
    let mut features = vec![settings.feature_dropout; WHOLE];
    // The shape is always known.
    features[WHOLE - 1] = 0.0;
    let dropout = Dropout {
        hidden: settings.dropout,
        features,
    };
    let step = |w: &Weights, batch: &[usize], random: &mut SplitMix64| {
        let rows = batch.iter().map(|k| network.standardised(sides[*k].0));
        let pass = forward(w, rows.collect::<Vec<_>>().concat(), &dropout, random);
        let truths: Vec<&Pose> = batch.iter().map(|k| sides[*k].1).collect();
        let (loss, gradient) = unlikelihood(&pass.outputs, &truths);
        (loss, backward(w, &pass, &gradient))
    };
    let start = network.layers.clone();
    network.layers = descend(start, sides.len(), settings, seed, step, &mut |_, _| ())?;
    Ok(network)
}

/// Trains a network from nothing by the probability of the true camera, from photographs and what is told of them as a
/// whole. `progress` is told the share that is done and the mean loss of late. Weights that are not finite are an error.
pub(crate) fn train(
    samples: &[(&Sample, Vec<f32>)],
    settings: &Training,
    seed: u64,
    progress: &mut dyn FnMut(f64, f64),
) -> Result<Network, PlacesError> {
    let rows = samples.iter().flat_map(rows);
    let mut network = start(rows, [SCORED, settings.hidden, 1], seed);
    let dropout = Dropout {
        hidden: settings.dropout,
        features: vec![0.0],
    };
    let step = |w: &Weights, batch: &[usize], random: &mut SplitMix64| {
        let batch: Vec<&(&Sample, Vec<f32>)> = batch.iter().map(|k| &samples[*k]).collect();
        let x = inputs(&network, &batch, settings.feature_dropout, random);
        let pass = forward(w, x, &dropout, random);
        let told = batch.iter().flat_map(|s| s.1.iter().step_by(TOLD));
        let scores: Vec<f32> = pass.outputs.iter().zip(told).map(|(s, t)| s + t).collect();
        let photographs: Vec<&Sample> = batch.iter().map(|s| s.0).collect();
        let (loss, gradient) = surprise(&scores, &photographs);
        (loss, backward(w, &pass, &gradient))
    };
    let start = network.layers.clone();
    network.layers = descend(start, samples.len(), settings, seed, step, progress)?;
    Ok(network)
}

/// Lowers a loss of `count` samples, of which `step` gives loss and gradient for some; returns the mean weights of late.
fn descend(
    mut w: Weights,
    count: usize,
    settings: &Training,
    seed: u64,
    step: impl Fn(&Weights, &[usize], &mut SplitMix64) -> (f64, Weights),
    progress: &mut dyn FnMut(f64, f64),
) -> Result<Weights, PlacesError> {
    let mut optimiser = Optimiser::new(&w);
    let mut random = SplitMix64::new(seed);
    let batch_size = settings.batch.min(count).max(1);
    let total = (settings.epochs * (count / batch_size)).max(1);
    let (mut steps, mut late) = (0usize, f64::NAN);
    for _ in 0..settings.epochs {
        let mut order: Vec<usize> = (0..count).collect();
        random.shuffle(&mut order);
        for batch in order.chunks_exact(batch_size) {
            let (loss, gradient) = step(&w, batch, &mut random);
            late = match late.is_nan() {
                true => loss,
                false => late + 0.02 * (loss - late),
            };
            let done = steps as f32 / total as f32;
            let warm = ((steps + 1) as f32 / 100.0).min(1.0);
            let rate =
                settings.learning_rate * warm * (0.5 + 0.5 * (std::f32::consts::PI * done).cos());
            optimiser.step(&mut w, &gradient, rate, settings.weight_decay);
            steps += 1;
            if steps.is_multiple_of(100) {
                progress(steps as f64 / total as f64, late);
            }
        }
    }
    match optimiser.mean.iter().flatten().all(|w| w.is_finite()) {
        true => Ok(optimiser.mean),
        false => Err(PlacesError::Diverged { step: steps }),
    }
}

/// What a photograph is scored by under each camera.
fn rows<'a>((sample, told): &'a (&Sample, Vec<f32>)) -> impl Iterator<Item = Vec<f32>> + 'a {
    let pairs = sample.features.chunks(FEATURES).zip(told.chunks(TOLD));
    pairs.map(|(f, t)| [f, t].concat())
}

/// Standardised features; those that a photograph goes without are at their mean.
fn inputs(
    network: &Network,
    batch: &[&(&Sample, Vec<f32>)],
    left_out: f32,
    random: &mut SplitMix64,
) -> Vec<f32> {
    let mut all = Vec::new();
    for sample in batch {
        let kept = (1.0 - left_out).recip();
        let mask: Vec<f32> = (0..SCORED)
            .map(|_| if random.unit() < left_out { 0.0 } else { kept })
            .collect();
        for features in rows(sample) {
            let row = network.standardised(&features);
            all.extend(row.iter().zip(&mask).map(|(x, m)| x * m));
        }
    }
    all
}

/// The mean of the negative logarithms of the true camera's probability, and its gradient.
fn unlikelihood(logs: &[f32], truths: &[&Pose]) -> (f64, Vec<f32>) {
    let share = 1.0 / truths.len() as f32;
    let mut gradient = Vec::with_capacity(logs.len());
    let mut loss = 0.0;
    for (own, truth) in logs.chunks_exact(PITCHES * FOCALS).zip(truths) {
        let best = own.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let total: f32 = own.iter().map(|l| (l - best).exp()).sum();
        let from = gradient.len();
        gradient.extend(own.iter().map(|l| share * (l - best).exp() / total));
        for (point, part) in shares(truth) {
            loss += f64::from(share * part * (best + total.ln() - own[point]));
            gradient[from + point] -= share * part;
        }
    }
    (loss, gradient)
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

/// A network of so many inputs, hidden units and outputs that knows the means of features and nothing else.
fn start(
    rows: impl Iterator<Item = Vec<f32>>,
    [inputs, hidden, outputs]: [usize; 3],
    seed: u64,
) -> Network {
    let mut sums = vec![[0f64; 2]; inputs];
    let mut count = 0.0;
    for row in rows {
        count += 1.0;
        for (s, x) in sums.iter_mut().zip(row) {
            s[0] += f64::from(x);
            s[1] += f64::from(x) * f64::from(x);
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
            drawn(inputs),
            vec![0.0; hidden],
            drawn(hidden),
            vec![0.0; hidden],
            vec![0.0; hidden * outputs],
            vec![0.0; outputs],
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
        let pose = Pose::new(f64::from(n as u32 % 7) * 8.0 - 40.0, 0.0, 60.0);
        // As a whole, one of seven numbers says what the pitch is.
        let mut side = vec![0.0; WHOLE];
        side[5 + n % 7] = 1.0;
        Sample {
            whole: Whole {
                sides: [side.clone(), side],
            },
            poses: vec![pose; count],
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
            ..Training::of_scorers()
        };
        let nothing = |s: &Sample| vec![0.0; s.poses.len() * TOLD];
        let all: Vec<(&Sample, Vec<f32>)> = samples.iter().map(|s| (s, nothing(s))).collect();
        let network = train(&all, &settings, 1, &mut |_, _| ()).unwrap();
        for s in &all {
            let scores: Vec<f32> = rows(s).map(|row| network.outputs(&row)[0]).collect();
            assert!(scores[1..].iter().all(|o| *o < scores[0]), "{scores:?}");
        }
    }

    #[test]
    fn the_gradient_of_the_unlikelihood_is_that_of_finite_differences() {
        let poses = [Pose::new(-12.3, 1.0, 41.0), Pose::new(20.0, -3.0, 99.0)];
        let logs: Vec<f32> = (0..2 * PITCHES * FOCALS)
            .map(|k| (1.3 * k as f32).sin())
            .collect();
        let truths = [&poses[0], &poses[1]];
        let (_, gradient) = unlikelihood(&logs, &truths);
        let points = poses.iter().enumerate().flat_map(|(n, p)| {
            let own = shares(p).map(|(k, _)| n * PITCHES * FOCALS + k);
            own.into_iter().chain([n * 200 + 7])
        });
        for k in points {
            let at = |step: f32| {
                let mut moved = logs.clone();
                moved[k] += step;
                unlikelihood(&moved, &truths).0
            };
            // Sums of about 6 in f32: differences over .1 are good to 3e-5.
            let numeric = (at(0.05) - at(-0.05)) / 0.1;
            assert!(
                (numeric - f64::from(gradient[k])).abs() < 1e-4,
                "{k}: {numeric} {}",
                gradient[k]
            );
        }
    }

    #[test]
    fn a_network_learns_the_pitch_of_pictures_as_a_whole() {
        let samples: Vec<Sample> = (0..70).map(|n| sample(n, [1, 1])).collect();
        let settings = Training {
            hidden: 16,
            epochs: 250,
            batch: 16,
            weight_decay: 0.1,
            dropout: 0.0,
            feature_dropout: 0.0,
            ..Training::of_wholes()
        };
        let all: Vec<&Sample> = samples.iter().collect();
        let network = train_whole(&all, &settings, 1).unwrap();
        for s in &samples {
            let table = Table::mean(&[network.outputs(&s.whole.sides[0])]);
            let own = table.told(&s.poses[0])[0];
            for off in [-8.0, 8.0] {
                let other = Pose {
                    pitch_deg: s.poses[0].pitch_deg + off,
                    ..s.poses[0]
                };
                assert!(table.told(&other)[0] < own - 1.0, "{own}");
            }
        }
    }
}
