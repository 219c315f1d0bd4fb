//! The estimator's network in training: batches, dropout, gradients, and the optimiser.
use dipir_backbone::product;
use dipir_estimator::network::{Network, silu};
use dipir_numerics::hashing::mix64;

/// A sequence of random numbers.
pub(crate) struct SplitMix64(u64);

impl SplitMix64 {
    pub fn new(seed: u64) -> Self {
        Self(mix64(seed ^ 0x5eed))
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix64(self.0)
    }

    /// In `[0, 1)`.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / 16_777_216.0
    }

    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for k in (1..items.len()).rev() {
            items.swap(k, (self.bits() % (k as u64 + 1)) as usize);
        }
    }
}

/// Weights in the order first, second, output, each with its bias.
pub(crate) type Weights = [Vec<f32>; 6];

/// What a batch needs to come back.
pub(crate) struct Pass {
    x: Vec<f32>,
    steps: [Vec<f32>; 2],
    masks: [Vec<f32>; 2],
    hidden: [Vec<f32>; 2],
    /// `batch x outputs`.
    pub outputs: Vec<f32>,
}

/// Share of units that are left out of each hidden layer, and of each feature.
pub(crate) struct Dropout {
    pub hidden: f32,
    pub features: Vec<f32>,
}

/// The outputs for a batch of standardised features.
pub(crate) fn forward(
    w: &Weights,
    mut x: Vec<f32>,
    dropout: &Dropout,
    random: &mut SplitMix64,
) -> Pass {
    let n = w[1].len();
    let inputs = w[0].len() / n;
    let shares = dropout.features.iter().cycle();
    x.iter_mut()
        .zip(shares)
        .for_each(|(x, s)| *x *= kept(*s, random));
    let first = affine(&x, inputs, &w[0], &w[1]);
    let (h, m1) = activated(&first, dropout.hidden, random);
    let second = affine(&h, n, &w[2], &w[3]);
    let (s, m2) = activated(&second, dropout.hidden, random);
    let sum: Vec<f32> = h.iter().zip(&s).map(|(a, b)| a + b).collect();
    let outputs = affine(&sum, n, &w[4], &w[5]);
    Pass {
        x,
        steps: [first, second],
        masks: [m1, m2],
        hidden: [h, sum],
        outputs,
    }
}

/// Gradients of the weights, given those of the outputs.
pub(crate) fn backward(w: &Weights, pass: &Pass, outputs: &[f32]) -> Weights {
    let n = w[1].len();
    let [h, sum] = &pass.hidden;
    let (inputs, scores) = (w[0].len() / n, w[5].len());
    let (output, output_bias) = weight_gradient(sum, n, outputs, scores);
    let mut sum_gradient = input_gradient(outputs, scores, &w[4], n);
    let second_gradient = through(&sum_gradient, &pass.steps[1], &pass.masks[1]);
    let (second, second_bias) = weight_gradient(h, n, &second_gradient, n);
    let back = input_gradient(&second_gradient, n, &w[2], n);
    sum_gradient
        .iter_mut()
        .zip(&back)
        .for_each(|(a, b)| *a += b);
    let first_gradient = through(&sum_gradient, &pass.steps[0], &pass.masks[0]);
    let (first, first_bias) = weight_gradient(&pass.x, inputs, &first_gradient, n);
    [first, first_bias, second, second_bias, output, output_bias]
}

fn affine(x: &[f32], inputs: usize, weight: &[f32], bias: &[f32]) -> Vec<f32> {
    let (rows, n) = (x.len() / inputs, bias.len());
    let mut out = bias.repeat(rows);
    product(
        (rows, n, inputs),
        (x, inputs, 1),
        (weight, n, 1),
        &mut out,
        true,
    );
    out
}

fn weight_gradient(x: &[f32], inputs: usize, g: &[f32], n: usize) -> (Vec<f32>, Vec<f32>) {
    let rows = g.len() / n;
    let mut weight = vec![0.0; inputs * n];
    product(
        (inputs, n, rows),
        (x, 1, inputs),
        (g, n, 1),
        &mut weight,
        false,
    );
    let mut bias = vec![0.0; n];
    g.chunks(n)
        .for_each(|row| bias.iter_mut().zip(row).for_each(|(b, g)| *b += g));
    (weight, bias)
}

fn input_gradient(g: &[f32], n: usize, weight: &[f32], inputs: usize) -> Vec<f32> {
    let rows = g.len() / n;
    let mut out = vec![0.0; rows * inputs];
    product(
        (rows, inputs, n),
        (g, n, 1),
        (weight, 1, n),
        &mut out,
        false,
    );
    out
}

/// The factor of a number that is left out with a probability.
fn kept(share: f32, random: &mut SplitMix64) -> f32 {
    match share > 0.0 && random.unit() < share {
        true => 0.0,
        false => 1.0 / (1.0 - share),
    }
}

fn activated(steps: &[f32], share: f32, random: &mut SplitMix64) -> (Vec<f32>, Vec<f32>) {
    let mut h: Vec<f32> = steps.iter().map(|s| silu(*s)).collect();
    let mask: Vec<f32> = h.iter().map(|_| kept(share, random)).collect();
    h.iter_mut().zip(&mask).for_each(|(h, m)| *h *= m);
    (h, mask)
}

fn through(gradient: &[f32], steps: &[f32], mask: &[f32]) -> Vec<f32> {
    let slope = |x: f32| {
        let s = 1.0 / (1.0 + (-x).exp());
        s * (1.0 + x * (1.0 - s))
    };
    gradient
        .iter()
        .zip(steps.iter().zip(mask))
        .map(|(g, (x, m))| g * m * slope(*x))
        .collect()
}

/// The network with other weights.
pub(crate) fn with_weights(network: &Network, w: &Weights) -> Network {
    let [a, b, c, d, e, f] = w.clone();
    Network {
        first: [a, b],
        second: [c, d],
        output: [e, f],
        ..network.clone()
    }
}

/// Adam with decoupled weight decay [Loshchilov & Hutter 2019] and a running mean of the weights.
pub(crate) struct Optimiser {
    first: Weights,
    second: Weights,
    /// Mean of the weights over about 500 steps.
    pub mean: Weights,
    steps: i32,
}

impl Optimiser {
    pub fn new(w: &Weights) -> Self {
        let zero = || std::array::from_fn(|k| vec![0.0; w[k].len()]);
        Self {
            first: zero(),
            second: zero(),
            mean: w.clone(),
            steps: 0,
        }
    }

    pub fn step(&mut self, w: &mut Weights, gradient: &Weights, rate: f32, decay: f32) {
        self.steps += 1;
        let (c1, c2) = (
            1.0 - 0.9f32.powi(self.steps),
            1.0 - 0.999f32.powi(self.steps),
        );
        let keep = (self.steps as f32 / (self.steps as f32 + 10.0)).min(0.998);
        for k in 0..w.len() {
            // Biases do not decay.
            let kept = if k % 2 == 0 { 1.0 - rate * decay } else { 1.0 };
            for i in 0..w[k].len() {
                let g = gradient[k][i];
                let m = &mut self.first[k][i];
                *m += 0.1 * (g - *m);
                let v = &mut self.second[k][i];
                *v += 0.001 * (g * g - *v);
                let update = (*m / c1) / ((*v / c2).sqrt() + 1e-8);
                w[k][i] = w[k][i] * kept - rate * update;
                let average = &mut self.mean[k][i];
                *average += (1.0 - keep) * (w[k][i] - *average);
            }
        }
    }
}
