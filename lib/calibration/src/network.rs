//! Networks with two hidden layers, applied by plain loops, which give the same bytes on any number of threads. One
//! tells from a picture as a whole how probable cameras are, another scores a picture under a camera.
use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::error::CalibrationError;
use crate::look::FEATURES;
use crate::whole::{FOCALS, PITCHES, TOLD, Table, WHOLE, Whole};

/// How many numbers a camera is scored by.
pub const SCORED: usize = FEATURES + TOLD;
/// Standardised features are cut off here, deviations.
const FEATURE_LIMIT: f32 = 5.0;

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

    /// What the output layer says.
    pub fn outputs(&self, features: &[f32]) -> Vec<f32> {
        assert_eq!(features.len(), self.mean.len(), "features");
        let [a, b, c, d, e, f] = &self.layers;
        let silu = |x: f32| x / (1.0 + (-x).exp());
        let x = self.standardised(features);
        let h: Vec<f32> = affine(a, b, &x).into_iter().map(silu).collect();
        let step = affine(c, d, &h);
        let h: Vec<f32> = h.iter().zip(step).map(|(h, s)| h + silu(s)).collect();
        affine(e, f, &h)
    }
}

/// Two networks that left out the same places.
#[derive(Clone, Debug, PartialEq)]
pub struct Member {
    /// From [`WHOLE`] numbers to the logarithms of a [`Table`].
    pub whole: Network,
    /// From [`SCORED`] numbers to a correction, which is added to the table's logarithm.
    pub scorer: Network,
}

impl Member {
    /// What the picture as a whole tells: the mean of it and its mirror image.
    pub fn table(&self, whole: &Whole) -> Table {
        Table::mean(&whole.sides.each_ref().map(|side| self.whole.outputs(side)))
    }

    /// The logarithm of a camera's likelihood, plus a constant that is the same for all cameras of a picture. `features`
    /// are the [`FEATURES`] of lines and look, `told` is what the table says of the camera.
    pub fn score(&self, features: &[f32], told: [f32; TOLD]) -> f64 {
        let added = self.scorer.outputs(&[features, &told].concat())[0];
        f64::from(told[0] + added)
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

/// The networks of a member, how many numbers they take and how many they give.
const KINDS: [(&str, usize, usize); 2] =
    [("whole", WHOLE, PITCHES * FOCALS), ("scorer", SCORED, 1)];

/// The bytes of a safetensors file with networks and `metadata`.
///
/// # Errors
/// If the format refuses them.
pub(crate) fn to_bytes(
    members: &[Member],
    metadata: HashMap<String, String>,
) -> Result<Vec<u8>, CalibrationError> {
    let refused = |e: safetensors::SafeTensorError| CalibrationError::Weights(e.to_string());
    let mut stored: Vec<(String, Vec<u8>)> = Vec::new();
    for (n, member) in members.iter().enumerate() {
        for (kind, network) in KINDS.iter().zip([&member.whole, &member.scorer]) {
            let parts = [&network.mean, &network.deviation].into_iter();
            for (name, values) in NAMES.iter().zip(parts.chain(&network.layers)) {
                let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                stored.push((format!("member.{n}.{}.{name}", kind.0), bytes));
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

/// The networks of a file.
pub(crate) fn members(file: &SafeTensors<'_>) -> Result<Vec<Member>, CalibrationError> {
    let mut all = Vec::new();
    let first = |n: usize| format!("member.{n}.{}.{}", KINDS[0].0, NAMES[0]);
    while all.is_empty() || file.tensor(&first(all.len())).is_ok() {
        let of = |(kind, inputs, outputs): (&str, usize, usize)| {
            let place = format!("member.{}.{kind}", all.len());
            network(file, &place, inputs, outputs)
        };
        let [whole, scorer] = KINDS.map(of);
        all.push(Member {
            whole: whole?,
            scorer: scorer?,
        });
    }
    Ok(all)
}

fn network(
    file: &SafeTensors<'_>,
    place: &str,
    inputs: usize,
    outputs: usize,
) -> Result<Network, CalibrationError> {
    let mut parts: Vec<Vec<f32>> = Vec::with_capacity(NAMES.len());
    for (k, name) in NAMES.iter().enumerate() {
        let name = format!("{place}.{name}");
        let refused = |why: &str| CalibrationError::Weights(format!("`{name}` {why}"));
        let tensor = file.tensor(&name).map_err(|_| refused("is missing"))?;
        if tensor.dtype() != Dtype::F32 {
            return Err(refused("is not F32"));
        }
        let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let values: Vec<f32> = tensor.data().chunks_exact(4).map(number).collect();
        let hidden = parts.get(3).map_or(0, Vec::len);
        let wanted = match k {
            0 | 1 => inputs,
            // The first bias tells how many hidden units there are.
            2 => values.len() / inputs * inputs,
            3 => parts[2].len() / inputs,
            4 => hidden * hidden,
            5 => hidden,
            6 => hidden * outputs,
            _ => outputs,
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
