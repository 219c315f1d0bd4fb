//! Training one network on the photographs of some places.
use dipir_estimator::features::OF_CAMERA;
use dipir_estimator::grid::{BASE_TEXELS, BINS};
use dipir_estimator::histogram::{SHARES, STOPS};
use dipir_estimator::network::{
    ENERGY, EXPOSURE, HISTOGRAM, MAP, Network, OUTPUTS, SHARE, SUN, Sight,
};
use dipir_estimator::posterior::soft_bins;
use serde::{Deserialize, Serialize};

use crate::error::PlacesError;
use crate::examples::{Example, Truth};
use crate::loss::loss;
use crate::network::{Dropout, Optimiser, SplitMix64, Weights, backward, forward, with_weights};
use crate::probes::Probes;

/// How a network is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Training {
    /// Units of each hidden layer. 64 places do not fill more.
    pub hidden: usize,
    /// Passes over all photographs and their mirror images.
    pub epochs: usize,
    /// Photographs in a step; all of them where there are fewer.
    pub batch: usize,
    /// Highest learning rate; it rises over 100 steps and falls as a cosine.
    pub learning_rate: f32,
    /// Share of a weight that a unit of learning rate removes.
    pub weight_decay: f32,
    /// Share of hidden units that are left out in a step.
    pub dropout: f32,
    /// Share of features that are left out in a step.
    pub feature_dropout: f32,
    /// The same of the backbone's features.
    pub kind_dropout: f32,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            hidden: 96,
            epochs: 5,
            batch: 128,
            learning_rate: 2e-3,
            weight_decay: 0.1,
            dropout: 0.4,
            feature_dropout: 0.1,
            kind_dropout: 0.5,
        }
    }
}

/// A photograph or its mirror image.
struct Row<'a> {
    features: &'a [f32],
    truth: Truth,
    reference: f32,
}

/// Trains a network of a fold from nothing. `progress` gets the share that is done and the mean of recent losses; `false`
/// stops. A loss or a weight that is not finite is an error.
pub fn train(
    examples: &[&Example],
    fold: usize,
    settings: &Training,
    probes: &Probes,
    sight: Sight,
    seed: u64,
    progress: &mut dyn FnMut(f64, f64) -> bool,
) -> Result<Network, PlacesError> {
    let rows = rows(examples, fold, probes);
    let network = start(&rows, sight, settings.hidden, seed);
    let inputs: Vec<Vec<f32>> = rows
        .iter()
        .map(|r| network.standardised(r.features))
        .collect();
    let mut w: Weights = {
        let Network {
            first: [a, b],
            second: [c, d],
            output: [e, f],
            ..
        } = network.clone();
        [a, b, c, d, e, f]
    };
    let mut optimiser = Optimiser::new(&w);
    let mut random = SplitMix64::new(seed);
    let dropout = Dropout {
        hidden: settings.dropout,
        features: (0..sight.count())
            .map(|n| match sight == Sight::Kind && n >= OF_CAMERA {
                true => settings.kind_dropout,
                false => settings.feature_dropout,
            })
            .collect(),
    };
    let batch_size = settings.batch.min(rows.len()).max(1);
    let per_epoch = rows.len() / batch_size;
    let total = (settings.epochs * per_epoch).max(1);
    let (mut step, mut late) = (0usize, f64::NAN);
    for _ in 0..settings.epochs {
        let mut order: Vec<usize> = (0..rows.len()).collect();
        random.shuffle(&mut order);
        for batch in order.chunks_exact(batch_size) {
            let x: Vec<f32> = batch
                .iter()
                .flat_map(|k| inputs[*k].iter().copied())
                .collect();
            let pass = forward(&w, x, &dropout, &mut random);
            let mut gradient = vec![0.0; pass.outputs.len()];
            let mut sum = 0.0;
            let share = 1.0 / batch.len() as f32;
            for (n, k) in batch.iter().enumerate() {
                let span = n * OUTPUTS..(n + 1) * OUTPUTS;
                let row = &rows[*k];
                let g = &mut gradient[span.clone()];
                sum += loss(
                    &pass.outputs[span],
                    &row.truth,
                    row.reference,
                    probes,
                    share,
                    g,
                );
            }
            let mean = f64::from(sum * share);
            if !mean.is_finite() {
                return Err(PlacesError::Diverged { step });
            }
            late = if late.is_nan() {
                mean
            } else {
                late + 0.02 * (mean - late)
            };
            let done = step as f32 / total as f32;
            let warm = ((step + 1) as f32 / 100.0).min(1.0);
            let rate =
                settings.learning_rate * warm * (0.5 + 0.5 * (std::f32::consts::PI * done).cos());
            let gradients = backward(&w, &pass, &gradient);
            optimiser.step(&mut w, &gradients, rate, settings.weight_decay);
            step += 1;
            if step % 20 == 0 && !progress(step as f64 / total as f64, late) {
                return Err(PlacesError::Stopped);
            }
        }
    }
    if !optimiser.mean.iter().flatten().all(|w| w.is_finite()) {
        return Err(PlacesError::Diverged { step });
    }
    Ok(with_weights(&network, &optimiser.mean))
}

fn rows<'a>(examples: &[&'a Example], fold: usize, probes: &Probes) -> Vec<Row<'a>> {
    let both = |e: &&'a Example| {
        let row = |n: usize, truth: Truth| Row {
            features: &e.of_fold(fold)[0][n],
            truth,
            reference: e.reference,
        };
        [row(0, e.truth.clone()), row(1, e.truth.mirrored(probes))]
    };
    examples.iter().flat_map(both).collect()
}

/// A network that knows the means of features and of answers, and nothing else.
fn start(rows: &[Row<'_>], sight: Sight, hidden: usize, seed: u64) -> Network {
    let count = rows.len().max(1) as f64;
    let mut sums = vec![[0f64; 2]; sight.count()];
    for row in rows {
        for (s, x) in sums.iter_mut().zip(sight.of(row.features)) {
            s[0] += f64::from(*x);
            s[1] += f64::from(*x) * f64::from(*x);
        }
    }
    let mean: Vec<f32> = sums.iter().map(|s| (s[0] / count) as f32).collect();
    // A feature that hardly varies must not become noise.
    let spread =
        |s: &[f64; 2]| ((s[1] / count - (s[0] / count).powi(2)).max(0.0).sqrt() + 0.02) as f32;
    let mut random = SplitMix64::new(seed ^ 0x1a7e);
    let mut drawn = |inputs: usize| -> Vec<f32> {
        let bound = (inputs as f32).sqrt().recip();
        (0..inputs * hidden)
            .map(|_| bound * (2.0 * random.unit() - 1.0))
            .collect()
    };
    Network {
        sight,
        hidden,
        deviation: sums.iter().map(spread).collect(),
        mean,
        first: [drawn(sight.count()), vec![0.0; hidden]],
        second: [drawn(hidden), vec![0.0; hidden]],
        output: [vec![0.0; hidden * OUTPUTS], mean_answer(rows)],
    }
}

fn mean_answer(rows: &[Row<'_>]) -> Vec<f32> {
    let count = rows.len().max(1) as f32;
    let mut bias = vec![0.0; OUTPUTS];
    let (mut bins, mut suns) = (vec![0f32; BINS], 0.0);
    for row in rows {
        for k in 0..BASE_TEXELS {
            for c in 0..3 {
                bias[MAP + 3 * k + c] += row.truth.log_base[k][c] / count;
            }
        }
        bins.iter_mut()
            .zip(soft_bins(row.truth.peak))
            .for_each(|(b, s)| *b += s / count);
        suns += f32::from(u8::from(row.truth.sun)) / count;
    }
    for (k, b) in bins.iter().enumerate() {
        bias[HISTOGRAM + k] = (b + 1e-4).ln();
    }
    bias[ENERGY..ENERGY + 3].fill(0.0);
    bias[SUN] = ((suns + 0.01) / (1.01 - suns)).ln();
    for row in rows {
        let histograms = [
            (EXPOSURE, STOPS.soft(f64::from(row.truth.stops))),
            (SHARE, SHARES.soft(f64::from(row.truth.share))),
        ];
        for (from, soft) in histograms {
            let span = &mut bias[from..from + soft.len()];
            span.iter_mut().zip(soft).for_each(|(b, s)| *b += s / count);
        }
    }
    bias[EXPOSURE..OUTPUTS]
        .iter_mut()
        .for_each(|b| *b = (*b + 1e-3).ln());
    bias
}
