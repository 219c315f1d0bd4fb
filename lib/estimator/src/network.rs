//! The network: two hidden layers from features to light, small enough to be applied by plain loops, which give the
//! same bytes on any number of threads.
use std::collections::HashMap;
use std::sync::Arc;

use dipir_backbone::Tuned;
use safetensors::tensor::{SafeTensors, TensorView};

use crate::error::EstimatorError;
use crate::features::{FEATURES, OF_CAMERA, OF_KIND, OF_PARTS};
use crate::grid::{BASE_TEXELS, BINS};
use crate::histogram::{SHARES, STOPS};

/// Where the logarithms of the smooth part begin among the outputs, texel after texel, red, green, blue.
pub const MAP: usize = 0;
/// Where the logarithm of the strongest source's energy begins: red, green, blue.
pub const ENERGY: usize = MAP + 3 * BASE_TEXELS;
/// Where the scores of the bins begin.
pub const HISTOGRAM: usize = ENERGY + 3;
/// The score of a sun-like source.
pub const SUN: usize = HISTOGRAM + BINS;
/// Where the scores of the mean radiance begin, stops over the photograph's mean: bins of
/// [`STOPS`](crate::histogram::STOPS).
pub const EXPOSURE: usize = SUN + 1;
/// Where the scores of the strongest source's share begin: bins of [`SHARES`](crate::histogram::SHARES).
pub const SHARE: usize = EXPOSURE + STOPS.count;
/// Outputs in all.
pub const OUTPUTS: usize = SHARE + SHARES.count;
/// Standardised features are clamped to this many standard deviations, so that no camera or picture leads to infinity.
pub const FEATURE_LIMIT: f32 = 5.0;
/// The backbone's features are multiplied by this after that: many numbers say the same.
const OF_KIND_SCALE: f32 = 0.3;
/// Logarithms of radiance over the photograph's mean are kept between these.
pub const LOG_RADIANCE: [f32; 2] = [-8.0, 6.0];
/// Logarithms of energy over the photograph's mean are kept between these.
pub const LOG_ENERGY: [f32; 2] = [-8.0, 8.0];

/// `x / (1 + exp(-x))`.
#[inline]
pub fn silu(x: f32) -> f32 {
    x / (1.0 + (-x).exp())
}

/// Which features a network sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sight {
    /// Those of the camera and of parts of the picture: where light comes from.
    Parts,
    /// Those of the camera and of the backbone: what kind of place it is, which says how bright it is.
    Kind,
}

impl Sight {
    /// Both, in the order in which a file holds them.
    pub const ALL: [Self; 2] = [Self::Parts, Self::Kind];

    /// How many features.
    pub fn count(self) -> usize {
        match self {
            Self::Parts => OF_PARTS,
            Self::Kind => OF_CAMERA + OF_KIND,
        }
    }

    /// Those of all features that are seen.
    pub fn of(self, features: &[f32]) -> impl Iterator<Item = &f32> {
        assert_eq!(features.len(), FEATURES, "features");
        let (first, last) = match self {
            Self::Parts => (OF_PARTS, FEATURES),
            Self::Kind => (OF_CAMERA, OF_PARTS),
        };
        features[..first].iter().chain(&features[last..])
    }

    fn name(self) -> &'static str {
        match self {
            Self::Parts => "parts",
            Self::Kind => "kind",
        }
    }
}

/// Weights. Matrices are row-major with a row for each input.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// What it sees.
    pub sight: Sight,
    /// Units of each hidden layer.
    pub hidden: usize,
    /// Mean of each feature over the training photographs.
    pub mean: Vec<f32>,
    /// Deviation of each feature over the training photographs.
    pub deviation: Vec<f32>,
    /// First layer, inputs x hidden, then its bias.
    pub first: [Vec<f32>; 2],
    /// Second layer, `hidden x hidden`, then its bias.
    pub second: [Vec<f32>; 2],
    /// Output layer, `hidden x OUTPUTS`, then its bias.
    pub output: [Vec<f32>; 2],
}

impl Network {
    /// Features as the first layer takes them.
    pub fn standardised(&self, features: &[f32]) -> Vec<f32> {
        let seen = self.sight.of(features).enumerate();
        let one = |((n, x), (m, d)): ((usize, &f32), (&f32, &f32))| {
            let value = ((x - m) / d).clamp(-FEATURE_LIMIT, FEATURE_LIMIT);
            match self.sight == Sight::Kind && n >= OF_CAMERA {
                true => OF_KIND_SCALE * value,
                false => value,
            }
        };
        seen.zip(self.mean.iter().zip(&self.deviation))
            .map(one)
            .collect()
    }

    /// The [`OUTPUTS`] numbers for [`FEATURES`] features.
    pub fn forward(&self, features: &[f32]) -> Vec<f32> {
        let x = self.standardised(features);
        let h: Vec<f32> = layer(&self.first, &x).into_iter().map(silu).collect();
        let step = layer(&self.second, &h);
        let h: Vec<f32> = h.iter().zip(step).map(|(h, s)| h + silu(s)).collect();
        layer(&self.output, &h)
    }

    fn tensors(&self) -> [(&'static str, Vec<usize>, &Vec<f32>); 8] {
        let (inputs, n) = (self.sight.count(), self.hidden);
        [
            ("mean", vec![inputs], &self.mean),
            ("deviation", vec![inputs], &self.deviation),
            ("first.weight", vec![inputs, n], &self.first[0]),
            ("first.bias", vec![n], &self.first[1]),
            ("second.weight", vec![n, n], &self.second[0]),
            ("second.bias", vec![n], &self.second[1]),
            ("output.weight", vec![n, OUTPUTS], &self.output[0]),
            ("output.bias", vec![OUTPUTS], &self.output[1]),
        ]
    }
}

fn layer([weight, bias]: &[Vec<f32>; 2], x: &[f32]) -> Vec<f32> {
    let mut y = bias.clone();
    for (row, &value) in weight.chunks(bias.len()).zip(x) {
        y.iter_mut().zip(row).for_each(|(y, w)| *y += value * w);
    }
    y
}

/// A network of each [`Sight`].
pub type Member = [Network; 2];

/// The bytes of a safetensors file with networks as `member.N.parts.*` and `member.N.kind.*`, tunings of the backbone as
/// `tuned.N.*`, and `metadata`.
pub fn to_bytes(
    members: &[Member],
    tuned: &[Arc<Tuned>],
    metadata: HashMap<String, String>,
) -> Result<Vec<u8>, EstimatorError> {
    let refused = |e: safetensors::SafeTensorError| EstimatorError::Weights(e.to_string());
    let mut stored: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    for (n, network) in members
        .iter()
        .enumerate()
        .flat_map(|(n, m)| m.iter().map(move |network| (n, network)))
    {
        let sight = network.sight.name();
        for (name, shape, values) in network.tensors() {
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            stored.push((format!("member.{n}.{sight}.{name}"), shape, bytes));
        }
    }
    for (n, tuned) in tuned.iter().enumerate() {
        for (name, values) in tuned.tensors(&format!("tuned.{n}")) {
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            stored.push((name, vec![values.len()], bytes));
        }
    }
    let views = stored
        .iter()
        .map(|(name, shape, bytes)| {
            let view =
                TensorView::new(safetensors::Dtype::F32, shape.clone(), bytes).map_err(refused)?;
            Ok((name.clone(), view))
        })
        .collect::<Result<Vec<_>, EstimatorError>>()?;
    safetensors::serialize(views, Some(metadata)).map_err(refused)
}

/// What such bytes hold.
pub struct Weights {
    /// Pairs of networks.
    pub members: Vec<Member>,
    /// Tunings of the backbone, each for as many of the pairs, in their order; none where all see it as it is.
    pub tuned: Vec<Arc<Tuned>>,
    /// The file's metadata.
    pub metadata: HashMap<String, String>,
}

/// All tunings `tuned.N.*` of a file.
pub fn tunings(file: &SafeTensors<'_>) -> Result<Vec<Arc<Tuned>>, EstimatorError> {
    let mut all = Vec::new();
    while let Some(tuned) = Tuned::read(file, &format!("tuned.{}", all.len()))
        .map_err(|e| EstimatorError::Weights(e.to_string()))?
    {
        all.push(Arc::new(tuned));
    }
    Ok(all)
}

/// The networks, the tunings and the metadata of such bytes.
pub fn from_bytes(bytes: &[u8]) -> Result<Weights, EstimatorError> {
    let refused = |e: safetensors::SafeTensorError| EstimatorError::Weights(e.to_string());
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(refused)?;
    let file = SafeTensors::deserialize(bytes).map_err(refused)?;
    let mut members = Vec::new();
    let first = |n: usize| format!("member.{n}.{}.mean", Sight::ALL[0].name());
    while file.tensor(&first(members.len())).is_ok() {
        let n = members.len();
        let [parts, kind] = Sight::ALL.map(|sight| network(&file, n, sight));
        members.push([parts?, kind?]);
    }
    if members.is_empty() {
        return Err(EstimatorError::Weights(format!(
            "there is no `{}`",
            first(0)
        )));
    }
    Ok(Weights {
        members,
        tuned: tunings(&file)?,
        metadata: header.metadata().clone().unwrap_or_default(),
    })
}

fn network(file: &SafeTensors<'_>, n: usize, sight: Sight) -> Result<Network, EstimatorError> {
    let prefix = format!("member.{n}.{}", sight.name());
    let read = |name: &str, shape: &[usize]| -> Result<Vec<f32>, EstimatorError> {
        let name = format!("{prefix}.{name}");
        let refused = |why: String| EstimatorError::Weights(format!("`{name}` {why}"));
        let tensor = file
            .tensor(&name)
            .map_err(|_| refused("is missing".into()))?;
        if tensor.dtype() != safetensors::Dtype::F32 || tensor.shape() != shape {
            return Err(refused(format!(
                "is {:?} of {:?}, not F32 of {shape:?}",
                tensor.dtype(),
                tensor.shape()
            )));
        }
        let values: Vec<f32> = tensor
            .data()
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect();
        match values.iter().all(|v| v.is_finite()) {
            true => Ok(values),
            false => Err(refused("holds values that are not finite".into())),
        }
    };
    let bias = file
        .tensor(&format!("{prefix}.first.bias"))
        .map_err(|_| EstimatorError::Weights(format!("`{prefix}.first.bias` is missing")))?;
    let hidden = bias.shape().first().copied().unwrap_or(0);
    let inputs = sight.count();
    Ok(Network {
        sight,
        hidden,
        mean: read("mean", &[inputs])?,
        deviation: read("deviation", &[inputs])?,
        first: [
            read("first.weight", &[inputs, hidden])?,
            read("first.bias", &[hidden])?,
        ],
        second: [
            read("second.weight", &[hidden, hidden])?,
            read("second.bias", &[hidden])?,
        ],
        output: [
            read("output.weight", &[hidden, OUTPUTS])?,
            read("output.bias", &[OUTPUTS])?,
        ],
    })
}
