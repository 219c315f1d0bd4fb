//! Networks from features to scores of bins: two hidden layers, applied by plain loops, which give the same bytes on
//! any number of threads.
use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::error::CalibrationError;
use crate::features::{ANGULAR, FEATURES};
use crate::posterior::Axis;

/// Middles of the bins of pitch, degrees.
pub const PITCH: Axis = Axis {
    low: -49.0,
    step: 2.5,
    count: 34,
};
/// Middles of the bins of roll, degrees.
pub const ROLL: Axis = Axis {
    low: -9.0,
    step: 1.0,
    count: 19,
};
/// Middles of the bins of the logarithm of the focal length over the longer side: 100 to 21 degrees.
pub const LOG_FOCAL: Axis = Axis {
    low: -0.9,
    step: 0.1,
    count: 20,
};
/// Standardised features are cut off here, deviations.
const FEATURE_LIMIT: f32 = 4.0;

/// What a network tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Head {
    /// Pitch and roll, of a picture whose focal length is given.
    Turn,
    /// The focal length.
    Focal,
}

impl Head {
    /// How many features it takes.
    pub fn inputs(self) -> usize {
        match self {
            Self::Turn => FEATURES + ANGULAR,
            Self::Focal => FEATURES,
        }
    }

    /// The axes whose bins it scores, one after the other.
    pub fn axes(self) -> &'static [Axis] {
        match self {
            Self::Turn => &[PITCH, ROLL],
            Self::Focal => &[LOG_FOCAL],
        }
    }

    /// How many scores it gives.
    pub fn outputs(self) -> usize {
        self.axes().iter().map(|a| a.count).sum()
    }

    fn name(self) -> &'static str {
        match self {
            Self::Turn => "turn",
            Self::Focal => "focal",
        }
    }
}

/// How much of each bin a value is: a bell as wide as the bins.
pub fn soft(axis: &Axis, value: f64) -> Vec<f32> {
    let bell = |v: f64| (-0.5 * ((v - value) / (0.7 * axis.step)).powi(2)).exp();
    let all: Vec<f64> = axis.values().map(bell).collect();
    let total: f64 = all.iter().sum::<f64>().max(1e-12);
    all.iter().map(|v| (v / total) as f32).collect()
}

/// Weights. Matrices are row-major with a row for each input.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// Mean of each feature over the training pictures.
    pub mean: Vec<f32>,
    /// Deviation of each feature over the training pictures.
    pub deviation: Vec<f32>,
    /// First, second and output layer, each with its bias.
    pub layers: [Vec<f32>; 6],
}

impl Network {
    /// Features as the first layer takes them.
    pub fn standardised(&self, features: &[f32]) -> Vec<f32> {
        let scaled =
            |(x, (m, d)): (&f32, (&f32, &f32))| ((x - m) / d).clamp(-FEATURE_LIMIT, FEATURE_LIMIT);
        let scales = self.mean.iter().zip(&self.deviation);
        features.iter().zip(scales).map(scaled).collect()
    }

    /// Probabilities of the bins of each axis of `head`.
    pub fn probabilities(&self, head: Head, features: &[f32]) -> Vec<Vec<f64>> {
        assert_eq!(features.len(), self.mean.len(), "features");
        let [a, b, c, d, e, f] = &self.layers;
        let silu = |x: f32| x / (1.0 + (-x).exp());
        let x = self.standardised(features);
        let h: Vec<f32> = affine(a, b, &x).into_iter().map(silu).collect();
        let step = affine(c, d, &h);
        let h: Vec<f32> = h.iter().zip(step).map(|(h, s)| h + silu(s)).collect();
        let scores = affine(e, f, &h);
        let mut from = 0;
        let each = head.axes().iter().map(|axis| {
            let own = &scores[from..from + axis.count];
            from += axis.count;
            let best = own.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let all: Vec<f64> = own.iter().map(|s| f64::from(s - best).exp()).collect();
            let total: f64 = all.iter().sum();
            all.iter().map(|v| v / total).collect()
        });
        each.collect()
    }
}

fn affine(weight: &[f32], bias: &[f32], x: &[f32]) -> Vec<f32> {
    let mut y = bias.to_vec();
    for (row, &value) in weight.chunks(bias.len()).zip(x) {
        y.iter_mut().zip(row).for_each(|(y, w)| *y += value * w);
    }
    y
}

const NAMES: [&str; 8] = [
    "mean",
    "deviation",
    "first.weight",
    "first.bias",
    "second.weight",
    "second.bias",
    "output.weight",
    "output.bias",
];

/// The bytes of a safetensors file with the networks of each head and `metadata`.
///
/// # Errors
/// If the format refuses them.
pub fn to_bytes(
    networks: &[(Head, &[Network])],
    metadata: HashMap<String, String>,
) -> Result<Vec<u8>, CalibrationError> {
    let refused = |e: safetensors::SafeTensorError| CalibrationError::Weights(e.to_string());
    let mut stored: Vec<(String, Vec<u8>)> = Vec::new();
    for (head, members) in networks {
        for (n, member) in members.iter().enumerate() {
            let parts = [&member.mean, &member.deviation].into_iter();
            for (name, values) in NAMES.iter().zip(parts.chain(&member.layers)) {
                let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                stored.push((format!("{}.{n}.{name}", head.name()), bytes));
            }
        }
    }
    let views = stored.iter().map(|(name, bytes)| {
        let view = TensorView::new(Dtype::F32, vec![bytes.len() / 4], bytes).map_err(refused)?;
        Ok((name.clone(), view))
    });
    let views = views.collect::<Result<Vec<_>, CalibrationError>>()?;
    safetensors::serialize(views, Some(metadata)).map_err(refused)
}

/// The networks of one head.
pub(crate) fn members(
    file: &SafeTensors<'_>,
    head: Head,
) -> Result<Vec<Network>, CalibrationError> {
    let mut all = Vec::new();
    let first = |n: usize| format!("{}.{n}.mean", head.name());
    while all.is_empty() || file.tensor(&first(all.len())).is_ok() {
        all.push(member(file, head, all.len())?);
    }
    Ok(all)
}

fn member(file: &SafeTensors<'_>, head: Head, n: usize) -> Result<Network, CalibrationError> {
    let mut parts: Vec<Vec<f32>> = Vec::with_capacity(NAMES.len());
    for (k, name) in NAMES.iter().enumerate() {
        let name = format!("{}.{n}.{name}", head.name());
        let refused = |why: &str| CalibrationError::Weights(format!("`{name}` {why}"));
        let tensor = file.tensor(&name).map_err(|_| refused("is missing"))?;
        if tensor.dtype() != Dtype::F32 {
            return Err(refused("is not F32"));
        }
        let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let values: Vec<f32> = tensor.data().chunks_exact(4).map(number).collect();
        let hidden = parts.get(3).map_or(0, Vec::len);
        let wanted = match k {
            0 | 1 => head.inputs(),
            // The first bias tells how many hidden units there are.
            2 => values.len() / head.inputs() * head.inputs(),
            3 => parts[2].len() / head.inputs(),
            4 => hidden * hidden,
            5 => hidden,
            6 => hidden * head.outputs(),
            _ => head.outputs(),
        };
        if values.len() != wanted || values.is_empty() {
            return Err(refused("has another size"));
        }
        if !values.iter().all(|v| v.is_finite()) {
            return Err(refused("holds values that are not finite"));
        }
        parts.push(values);
    }
    let mut parts = parts.into_iter();
    let mut next = || parts.next().unwrap_or_default();
    Ok(Network {
        mean: next(),
        deviation: next(),
        layers: std::array::from_fn(|_| next()),
    })
}
