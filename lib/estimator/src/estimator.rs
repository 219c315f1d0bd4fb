//! From a photograph and its camera to its light.
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use dipir_backbone::Tuned;
use dipir_imaging::raster::LinearImage;
use dipir_light::luminance::luminance_f64;
use dipir_scene::camera::Camera;
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::error::EstimatorError;
use crate::estimate::{Interval, LightEstimate};
use crate::features::SmallPhoto;
use crate::grid::{BASE_TEXELS, BINS, base_texel, heading, mirrored_bin, mirrored_texel};
use crate::histogram::{SHARES, STOPS, Scale};
use crate::network::{
    ENERGY, EXPOSURE, HISTOGRAM, LOG_ENERGY, LOG_RADIANCE, MAP, Member, SHARE, SUN, Weights,
    from_bytes, to_bytes,
};
use crate::posterior::PeakPosterior;

/// The key of the calibration in the file's metadata.
const CALIBRATION: &str = "calibration";

/// What is measured on places that were left out, and applied to every estimate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Radiance is multiplied by this.
    pub exposure: f64,
    /// Weight of the exposure's median in the map's exposure, 0 to 1; the rest is the map's own.
    pub told: f64,
    /// The posterior's logarithm is divided by this, and so is the sun's score.
    pub temperature: f64,
    /// Probabilities below and above the exposure's interval, as the networks say them, at which it holds 80%.
    pub exposure_tails: [f64; 2],
    /// The same of the share's interval.
    pub share_tails: [f64; 2],
}

impl Default for Calibration {
    fn default() -> Self {
        Self {
            exposure: 1.0,
            told: 0.0,
            temperature: 1.0,
            exposure_tails: [0.1; 2],
            share_tails: [0.1; 2],
        }
    }
}

/// Pairs of networks whose answers are averaged, and their calibration. Where the light is, is told by both networks of
/// a pair; how bright it is, by the one that sees what kind of place it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimator {
    members: Vec<Member>,
    /// Tunings of the backbone, each for as many members, in their order.
    tuned: Vec<Arc<Tuned>>,
    calibration: Calibration,
}

impl Estimator {
    /// Pairs of networks, of which there has to be one, and the tunings of the backbone that they see: each of as many
    /// pairs, in their order, or none.
    pub fn new(
        members: Vec<Member>,
        tuned: Vec<Arc<Tuned>>,
        calibration: Calibration,
    ) -> Result<Self, EstimatorError> {
        if members.is_empty() {
            return Err(EstimatorError::Weights("there is no network".into()));
        }
        if !members.len().is_multiple_of(tuned.len().max(1)) {
            let (pairs, tunings) = (members.len(), tuned.len());
            let text = format!("{pairs} pairs of networks cannot share {tunings} tunings evenly");
            return Err(EstimatorError::Weights(text));
        }
        Ok(Self {
            members,
            tuned,
            calibration,
        })
    }

    /// The estimator that is part of the program.
    pub fn embedded() -> Result<Self, EstimatorError> {
        Self::from_bytes(include_bytes!("../weights/places.safetensors"))
    }

    /// The estimator of a file that [`to_bytes`](Self::to_bytes) made.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, EstimatorError> {
        let path = path.as_ref();
        let bytes = dipir_files::read(path).map_err(|source| EstimatorError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::from_bytes(&bytes)
    }

    /// The estimator of a safetensors file's bytes.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, EstimatorError> {
        let Weights {
            members,
            tuned,
            metadata,
        } = from_bytes(bytes)?;
        let text = metadata.get(CALIBRATION).ok_or_else(|| {
            EstimatorError::Weights(format!("the metadata has no `{CALIBRATION}`"))
        })?;
        let calibration = serde_json::from_str(text)
            .map_err(|e| EstimatorError::Weights(format!("`{CALIBRATION}`: {e}")))?;
        Self::new(members, tuned, calibration)
    }

    /// The same networks with another calibration.
    pub fn calibrated(&self, calibration: Calibration) -> Self {
        Self {
            calibration,
            ..self.clone()
        }
    }

    /// What the networks say of the exposure and of the share, bin by bin, for the calibration of intervals.
    pub fn histograms(&self, features: &[[Vec<f32>; 2]]) -> [Vec<f64>; 2] {
        let sum = self.sum(features);
        [sum.exposure, sum.share]
    }

    /// The networks of all, with the calibration of the first.
    pub fn joined(all: &[Self]) -> Result<Self, EstimatorError> {
        let members = all.iter().flat_map(|e| e.members.iter().cloned()).collect();
        let tuned = all.iter().flat_map(|e| e.tuned.iter().cloned()).collect();
        Self::new(
            members,
            tuned,
            all.first().map(|e| e.calibration).unwrap_or_default(),
        )
    }

    /// The bytes of a safetensors file.
    pub fn to_bytes(&self) -> Result<Vec<u8>, EstimatorError> {
        let text = serde_json::to_string(&self.calibration)
            .map_err(|e| EstimatorError::Weights(e.to_string()))?;
        let metadata = HashMap::from([(CALIBRATION.into(), text)]);
        to_bytes(&self.members, &self.tuned, metadata)
    }

    /// The light of a whole photograph, which is decoded by its transfer function: values in `[0, 1]`.
    pub fn estimate(&self, photo: &LinearImage, camera: &Camera) -> LightEstimate {
        self.of_small_photo(&SmallPhoto::new(photo, camera), heading(camera))
    }

    /// The light of a photograph at the size that is looked at, taken towards an azimuth in the world.
    pub fn of_small_photo(&self, small: &SmallPhoto, heading_rad: f64) -> LightEstimate {
        let features = small.both_sides(&self.tuned);
        self.of_features(&features, small.reference(), heading_rad)
    }

    /// Tunings of the backbone that the networks see.
    pub fn tuned(&self) -> &[Arc<Tuned>] {
        &self.tuned
    }

    /// The light of a photograph's features and those of its mirror image, averaged: one pair for each tuning.
    pub fn of_features(
        &self,
        features: &[[Vec<f32>; 2]],
        reference: f32,
        heading_rad: f64,
    ) -> LightEstimate {
        let count = 2 * self.members.len();
        self.sum(features)
            .estimate(count, reference, heading_rad, &self.calibration)
    }

    fn sum(&self, features: &[[Vec<f32>; 2]]) -> Sum {
        let mut sums = [Sum::default(), Sum::default()];
        assert_eq!(features.len(), self.tuned.len().max(1), "tunings");
        let each = self.members.len() / features.len();
        for (n, member) in self.members.iter().enumerate() {
            let features = &features[n / each];
            for (sum, network) in sums.iter_mut().zip(member) {
                let plain = self.read(&network.forward(&features[0]), false);
                let mirrored = self.read(&network.forward(&features[1]), true);
                sum.add(&plain.plus(&mirrored));
            }
        }
        let [parts, kind] = sums;
        parts.joined_with(kind)
    }

    fn read(&self, o: &[f32], mirrored: bool) -> Sum {
        let texel = |k| if mirrored { mirrored_texel(k) } else { k };
        let bin = |k| if mirrored { mirrored_bin(k) } else { k };
        let radiance = |v: f32| f64::from(v.clamp(LOG_RADIANCE[0], LOG_RADIANCE[1])).exp();
        let energy = |v: f32| f64::from(v.clamp(LOG_ENERGY[0], LOG_ENERGY[1])).exp();
        let temperature = self.calibration.temperature;
        let scores: Vec<f64> = (0..BINS)
            .map(|k| f64::from(o[HISTOGRAM + bin(k)]) / temperature)
            .collect();
        let plain = |from: usize, count: usize| {
            let scores: Vec<f64> = o[from..from + count]
                .iter()
                .map(|v| f64::from(*v))
                .collect();
            softmax(&scores)
        };
        Sum {
            base: (0..BASE_TEXELS)
                .map(|k| std::array::from_fn(|c| radiance(o[MAP + 3 * texel(k) + c])))
                .collect(),
            peak: std::array::from_fn(|c| energy(o[ENERGY + c])),
            weights: softmax(&scores),
            sun: 1.0 / (1.0 + (-f64::from(o[SUN]) / temperature).exp()),
            exposure: plain(EXPOSURE, STOPS.count),
            share: plain(SHARE, SHARES.count),
        }
    }
}

/// Answers added up, relative to the photograph's mean.
#[derive(Default)]
struct Sum {
    base: Vec<[f64; 3]>,
    peak: [f64; 3],
    weights: Vec<f64>,
    sun: f64,
    exposure: Vec<f64>,
    share: Vec<f64>,
}

impl Sum {
    fn plus(mut self, other: &Self) -> Self {
        self.add(other);
        self
    }

    fn add(&mut self, other: &Self) {
        self.base.resize(BASE_TEXELS, [0.0; 3]);
        self.weights.resize(BINS, 0.0);
        self.exposure.resize(STOPS.count, 0.0);
        self.share.resize(SHARES.count, 0.0);
        for (a, b) in self.base.iter_mut().zip(&other.base) {
            a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        }
        let pairs = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        pairs(&mut self.peak, &other.peak);
        pairs(&mut self.weights, &other.weights);
        pairs(&mut self.exposure, &other.exposure);
        pairs(&mut self.share, &other.share);
        self.sun += other.sun;
    }

    /// The mean of both, each as bright as `kind`, with its exposure.
    fn joined_with(mut self, kind: Self) -> Self {
        let level = |s: &Self| luminance_f64(DVec3::from(s.mean()));
        let scale = level(&kind) / level(&self).max(1e-12);
        for v in self.base.iter_mut().flatten().chain(&mut self.peak) {
            *v *= scale;
        }
        self.add(&kind);
        let half = |v: &mut f64| *v *= 0.5;
        self.base.iter_mut().flatten().for_each(half);
        self.peak.iter_mut().for_each(half);
        self.weights.iter_mut().for_each(half);
        self.share.iter_mut().for_each(half);
        Self {
            sun: 0.5 * self.sun,
            exposure: kind.exposure,
            ..self
        }
    }

    fn estimate(
        self,
        count: usize,
        reference: f32,
        heading_rad: f64,
        c: &Calibration,
    ) -> LightEstimate {
        let n = count as f64;
        let over = luminance_f64(DVec3::from(self.mean())) / n;
        let told = STOPS.quantile(&self.exposure, 0.5) - over.max(1e-6).log2();
        let scale = c.exposure * (c.told * told).exp2() * f64::from(reference) / n;
        let texel = |t: &[f64; 3]| t.map(|v| (v * scale) as f32);
        LightEstimate {
            heading_rad,
            reference: f64::from(reference),
            base: self.base.iter().map(texel).collect(),
            peak: self.peak.map(|v| (v * scale) as f32),
            posterior: PeakPosterior::normalised(self.weights),
            sun_probability: self.sun / n,
            exposure_stops: middle_of(&STOPS, &self.exposure, c.exposure_tails),
            share: middle_of(&SHARES, &self.share, c.share_tails),
            azimuth_deg: Interval::new(0.0, 0.0, 0.0),
            elevation_deg: Interval::new(0.0, 0.0, 0.0),
            words: String::new(),
            source: None,
        }
        .described()
    }

    /// Mean radiance over the sphere.
    fn mean(&self) -> [f64; 3] {
        let sphere = 4.0 * std::f64::consts::PI;
        std::array::from_fn(|c| {
            let texel = |(k, t): (usize, &[f64; 3])| t[c] * f64::from(base_texel(k).1);
            let base: f64 = self.base.iter().enumerate().map(texel).sum();
            (base + self.peak[c]) / sphere
        })
    }
}

/// Probabilities of scores.
fn softmax(scores: &[f64]) -> Vec<f64> {
    let best = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = scores.iter().map(|s| (s - best).exp()).collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|w| w / total).collect()
}

/// A histogram's median and what lies between its tails.
fn middle_of(scale: &Scale, weights: &[f64], [low, high]: [f64; 2]) -> Interval {
    let at = |q: f64| scale.quantile(weights, q);
    Interval::new(at(low.min(0.5)), at(0.5), at(1.0 - high.min(0.5)))
}
