//! Networks that score a picture under a camera: two hidden layers, applied by plain loops, which give the same bytes on
//! any number of threads.
use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::error::CalibrationError;
use crate::look::FEATURES;

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

    /// The logarithm of how much more probable a camera is than before the picture was seen, but for a summand of the
    /// picture.
    pub fn score(&self, features: &[f32]) -> f64 {
        assert_eq!(features.len(), self.mean.len(), "features");
        let [a, b, c, d, e, f] = &self.layers;
        let silu = |x: f32| x / (1.0 + (-x).exp());
        let x = self.standardised(features);
        let h: Vec<f32> = affine(a, b, &x).into_iter().map(silu).collect();
        let step = affine(c, d, &h);
        let h: Vec<f32> = h.iter().zip(step).map(|(h, s)| h + silu(s)).collect();
        affine(e, f, &h)[0].into()
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

/// The bytes of a safetensors file with networks and `metadata`.
///
/// # Errors
/// If the format refuses them.
pub fn to_bytes(
    networks: &[Network],
    metadata: HashMap<String, String>,
) -> Result<Vec<u8>, CalibrationError> {
    let refused = |e: safetensors::SafeTensorError| CalibrationError::Weights(e.to_string());
    let mut stored: Vec<(String, Vec<u8>)> = Vec::new();
    for (n, member) in networks.iter().enumerate() {
        let parts = [&member.mean, &member.deviation].into_iter();
        for (name, values) in NAMES.iter().zip(parts.chain(&member.layers)) {
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            stored.push((format!("member.{n}.{name}"), bytes));
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
pub(crate) fn members(file: &SafeTensors<'_>) -> Result<Vec<Network>, CalibrationError> {
    let mut all = Vec::new();
    let first = |n: usize| format!("member.{n}.{}", NAMES[0]);
    while all.is_empty() || file.tensor(&first(all.len())).is_ok() {
        all.push(member(file, all.len())?);
    }
    Ok(all)
}

fn member(file: &SafeTensors<'_>, n: usize) -> Result<Network, CalibrationError> {
    let mut parts: Vec<Vec<f32>> = Vec::with_capacity(NAMES.len());
    for (k, name) in NAMES.iter().enumerate() {
        let name = format!("member.{n}.{name}");
        let refused = |why: &str| CalibrationError::Weights(format!("`{name}` {why}"));
        let tensor = file.tensor(&name).map_err(|_| refused("is missing"))?;
        if tensor.dtype() != Dtype::F32 {
            return Err(refused("is not F32"));
        }
        let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let values: Vec<f32> = tensor.data().chunks_exact(4).map(number).collect();
        let hidden = parts.get(3).map_or(0, Vec::len);
        let wanted = match k {
            0 | 1 => FEATURES,
            // The first bias tells how many hidden units there are.
            2 => values.len() / FEATURES * FEATURES,
            3 => parts[2].len() / FEATURES,
            4 => hidden * hidden,
            5 | 6 => hidden,
            _ => 1,
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
