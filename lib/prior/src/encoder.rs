//! The light encoder: a small convolutional network that estimates the light of a picture. Inversion uses its answer as
//! a prior.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::layers::{Conv2d, GroupNorm, Linear, NormActivation, Padding};
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::weights::Weights;
use serde::{Deserialize, Serialize};

use crate::caption::LightDescription;
use crate::error::{Error, Result};
use crate::picture::{SIZE, mirrored};

/// File of the encoder in a model folder.
pub const FILE: &str = "light_encoder.safetensors";
/// Outputs of the network: cosine and sine of the azimuth, elevation, sun's share, log irradiance, log red over blue of
/// sun and sky.
pub const OUTPUTS: usize = 7;
/// Elevation that the network answers with 0, radians.
pub const MIDDLE_ELEVATION: f32 = 0.75;
/// Sun's share that the network answers with 0.
pub const MIDDLE_SHARE: f32 = 0.6;
const CHANNELS: [usize; 4] = [3, 48, 96, 160];
const HIDDEN: usize = 384;

/// The light of a picture as one sun and a sky.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SunSkyEstimate {
    /// Azimuth and elevation of the sun, and its share.
    pub description: LightDescription,
    /// Confidence in the azimuth, 0 to about 1: the length of the mean of its unit vectors.
    pub confidence: f32,
    /// Irradiance of open ground, on the picture's linear scale.
    pub irradiance: f32,
    /// Log of red over blue of the sun's light.
    pub warmth: f32,
    /// Log of red over blue of the sky's light.
    pub sky_warmth: f32,
}

/// Inputs of the network that hold the camera's pitch.
pub const PITCH: usize = 2;

/// The camera's pitch, radians below the horizon, as inputs of the network. Training covers about 0 to 50 degrees;
/// other pitches are clamped.
pub fn pitch_features(pitch: f32) -> [f32; PITCH] {
    let x = (pitch.clamp(0.0, 0.9) - 0.4) / 0.3;
    [x, x * x - 1.0]
}

/// The network. The camera's pitch scales and shifts the features of every level, because the direction of a shadow in
/// the picture determines the sun's azimuth only if the pitch is known.
#[derive(Debug)]
pub struct LightEncoder {
    levels: Vec<Level>,
    hidden: Linear,
    out: Linear,
    variables: BTreeMap<String, Var>,
}

#[derive(Debug)]
struct Level {
    convolution: Conv2d,
    norm: GroupNorm,
    /// From the pitch to scales and shifts of all channels.
    pitch: Linear,
    /// A residual convolution. The first level has none, because there it would cost most.
    residual: Option<(GroupNorm, Conv2d)>,
}

impl Level {
    fn forward(&self, x: &Tensor, pitch: &Tensor) -> Result<Tensor> {
        let x = self.norm.forward(&self.convolution.forward(x)?)?;
        let (rows, channels) = (x.dim(0)?, x.dim(1)?);
        let change = self
            .pitch
            .forward(pitch)?
            .reshape((rows, 2, channels, 1, 1))?;
        let part = |k: usize| change.narrow(1, k, 1)?.squeeze(1);
        let scale = (part(0)? + 1.0)?;
        let x = x.broadcast_mul(&scale)?.broadcast_add(&part(1)?)?;
        match &self.residual {
            Some((norm, convolution)) => {
                let more = convolution.forward(&norm.forward(&x)?)?;
                Ok((x + more)?)
            }
            None => Ok(x),
        }
    }
}

impl LightEncoder {
    /// A network with weights from `parameters`.
    pub fn new(parameters: Parameters) -> Result<Self> {
        let mut levels = vec![];
        for (i, pair) in CHANNELS.windows(2).enumerate() {
            let p = parameters.sub(format!("levels.{i}"));
            let channels = pair[1];
            let residual = match i {
                0 => None,
                _ => {
                    let p = p.sub("residual");
                    let norm =
                        GroupNorm::new(&p.sub("norm"), 8, channels, 1e-5, NormActivation::Silu)?;
                    let same = Padding::Same(1);
                    let convolution =
                        Conv2d::new(&p.sub("conv"), (channels, channels), 3, 1, same)?;
                    Some((norm, convolution))
                }
            };
            levels.push(Level {
                convolution: Conv2d::new(
                    &p.sub("conv"),
                    (pair[0], channels),
                    3,
                    2,
                    Padding::Same(1),
                )?,
                norm: GroupNorm::new(&p.sub("norm"), 8, channels, 1e-5, NormActivation::Silu)?,
                pitch: Linear::new(&p.sub("pitch"), PITCH, 2 * channels)?,
                residual,
            });
        }
        let side = SIZE >> (CHANNELS.len() - 1);
        let flat = CHANNELS[CHANNELS.len() - 1] * side * side;
        let hidden = Linear::new(&parameters.sub("hidden"), flat, HIDDEN)?;
        let out = Linear::new(&parameters.sub("out"), HIDDEN, OUTPUTS)?;
        Ok(Self {
            levels,
            hidden,
            out,
            variables: parameters.finish(|_| false)?,
        })
    }

    /// The weights by name, to be trained.
    pub fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// Reads [`FILE`] of a model folder; `None` if it has none.
    pub fn load(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(FILE);
        if !path.is_file() {
            return Ok(None);
        }
        let weights = Weights::open_file(&path)?;
        let parameters = Parameters::from_weights(weights, DType::F32, &Device::Cpu, false);
        Self::new(parameters).map(Some)
    }

    /// Outputs [batch, OUTPUTS] for pictures [batch, 3, SIZE, SIZE] in [-1, 1] and [`pitch_features`] [batch, PITCH].
    pub fn forward(&self, pictures: &Tensor, pitch: &Tensor) -> Result<Tensor> {
        let mut x = pictures.clone();
        for level in &self.levels {
            x = level.forward(&x, pitch)?;
        }
        let h = self.hidden.forward(&x.flatten_from(1)?)?;
        Ok(self.out.forward(&h.silu()?)?)
    }

    /// Estimates the light of a picture [3, SIZE, SIZE] in [0, 1]: the mean of the answers for it and its mirror image.
    /// The azimuth is relative to the direction of the picture's middle, which is `pitch` radians below the horizon.
    pub fn estimate(&self, picture: &[f32], pitch: f32) -> Result<SunSkyEstimate> {
        let pair = [picture.to_vec(), mirrored(picture)].concat();
        let x = Tensor::from_vec(pair, (2, 3, SIZE, SIZE), &Device::Cpu)?;
        let pitch = Tensor::new(&[pitch_features(pitch); 2], &Device::Cpu)?;
        let rows = self.forward(&x.affine(2.0, -1.0)?, &pitch)?;
        let rows = rows.to_vec2::<f32>()?;
        // The mirror swaps left and right.
        let mean = |i: usize| 0.5 * (rows[0][i] + if i == 1 { -rows[1][i] } else { rows[1][i] });
        Ok(SunSkyEstimate {
            description: LightDescription {
                azimuth: mean(1).atan2(mean(0)),
                elevation: (mean(2) + MIDDLE_ELEVATION).clamp(0.15, 1.4),
                sun_share: (mean(3) + MIDDLE_SHARE).clamp(0.0, 0.97),
            },
            confidence: mean(0).hypot(mean(1)),
            irradiance: mean(4).exp(),
            warmth: mean(5),
            sky_warmth: mean(6),
        })
    }
}

impl SunSkyEstimate {
    /// Standard deviation of the azimuth, radians: of the wrapped normal distribution whose mean vector has the length
    /// of the confidence [Mardia and Jupp 2000, 3.5.7].
    pub fn spread(&self) -> f32 {
        (-2.0 * self.confidence.clamp(1e-3, 1.0).ln()).sqrt()
    }

    /// The mean of weighted estimates for pictures of one place. Each also counts by the square of its confidence.
    /// Azimuths are averaged as vectors of the length of the confidence, irradiances geometrically. An error if there
    /// is no estimate.
    pub fn mean(of: impl Iterator<Item = (Self, f32)>) -> Result<Self> {
        // Estimates without a sun count a little: they still hold its share.
        let weigh = |(e, w): (Self, f32)| (e, w * (e.confidence.min(1.0).powi(2) + 1e-3));
        let of: Vec<(Self, f32)> = of.map(weigh).collect();
        let total: f32 = of.iter().map(|e| e.1).sum();
        if of.is_empty() {
            return Err(Error::Argument("the light encoder needs a picture".into()));
        }
        let mean = |value: &dyn Fn(&Self) -> f32| {
            of.iter().map(|(e, w)| w * value(e)).sum::<f32>() / total
        };
        let c = mean(&|e| e.confidence * e.description.azimuth.cos());
        let s = mean(&|e| e.confidence * e.description.azimuth.sin());
        Ok(Self {
            description: LightDescription {
                azimuth: s.atan2(c),
                elevation: mean(&|e| e.description.elevation),
                sun_share: mean(&|e| e.description.sun_share),
            },
            confidence: c.hypot(s),
            irradiance: mean(&|e| e.irradiance.ln()).exp(),
            warmth: mean(&|e| e.warmth),
            sky_warmth: mean(&|e| e.sky_warmth),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(azimuth: f32, confidence: f32, irradiance: f32) -> SunSkyEstimate {
        SunSkyEstimate {
            description: LightDescription {
                azimuth,
                elevation: 0.6,
                sun_share: 0.7,
            },
            confidence,
            irradiance,
            warmth: 0.1,
            sky_warmth: -0.2,
        }
    }

    fn mean(of: &[SunSkyEstimate]) -> Result<SunSkyEstimate> {
        SunSkyEstimate::mean(of.iter().map(|e| (*e, 1.0)))
    }

    #[test]
    fn confident_estimates_dominate_a_mean_and_contradictions_lower_its_confidence() {
        let agreed = mean(&[estimate(1.0, 0.9, 2.0); 3]).unwrap();
        assert!(
            (agreed.description.azimuth - 1.0).abs() < 1e-6
                && (agreed.confidence - 0.9).abs() < 1e-6
        );
        // The second has .011 of .822 of the weight: 4^(.011/.822) = 1.019, and next to nothing of the azimuth.
        let sure = mean(&[estimate(0.0, 0.9, 1.0), estimate(2.0, 0.1, 4.0)]).unwrap();
        assert!(
            sure.description.azimuth < 0.002 && (sure.irradiance - 1.0187).abs() < 1e-3,
            "{sure:?}"
        );
        let overcast = mean(&[estimate(0.0, 0.0, 1.0), estimate(2.0, 0.0, 4.0)]).unwrap();
        assert!((overcast.irradiance - 2.0).abs() < 1e-5 && overcast.confidence == 0.0);
        let opposed = mean(&[estimate(0.0, 0.9, 1.0), estimate(3.0, 0.9, 1.0)]).unwrap();
        // The mean vector has length .9 cos(1.5) = .0637, and the spread is sqrt(-2 ln .0637).
        assert!(
            (opposed.confidence - 0.0637).abs() < 1e-3 && (opposed.spread() - 2.347).abs() < 0.01,
            "{opposed:?}"
        );
        assert!(mean(&[]).is_err());
    }

    #[test]
    fn a_pitch_beyond_the_training_counts_as_the_nearest_one_within() {
        assert_eq!(pitch_features(1.4), pitch_features(0.9));
        assert_eq!(pitch_features(-0.2), pitch_features(0.0));
    }

    #[test]
    fn the_spread_is_that_of_a_wrapped_normal() {
        // The mean of exp(i x) over a normal x of deviation d is exp(-d d / 2).
        for d in [0.05f32, 0.3, 1.0, 2.0] {
            let of = estimate(0.0, (-0.5 * d * d).exp(), 1.0);
            assert!((of.spread() / d - 1.0).abs() < 1e-3, "{d}: {}", of.spread());
        }
        assert_eq!(estimate(0.0, 1.2, 1.0).spread(), 0.0);
        assert!(estimate(0.0, 0.0, 1.0).spread().is_finite());
    }
}
