//! A small network that reads the light off a photograph: a start for
//! guidance, and a prior for inversion.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::layers::{Conv2d, GroupNorm, Linear, NormActivation, Padding};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::optimizer::{AdamW, AdamWConfig};
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::weights::{Weights, write_safetensors};
use serde::{Deserialize, Serialize};

use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::examples::{self, Lens, SIZE, Window};
use crate::lights::Light;
use crate::photo::Look;
use crate::record::Layer;
use crate::shards::{SHARDS, Shards, mean_gradients};
use crate::words::LightWords;

/// File of the encoder in a model folder.
pub const FILE: &str = "light_encoder.safetensors";
/// Numbers that it tells.
const OUTPUTS: usize = 7;
const CHANNELS: [usize; 4] = [3, 48, 96, 160];
const HIDDEN: usize = 384;

/// What a photograph says about its light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LightEstimate {
    /// Azimuth, elevation and share of the sun.
    pub words: LightWords,
    /// How sure it is of the azimuth, 0 to about 1: the length of the mean of its directions.
    pub confidence: f32,
    /// Irradiance of open ground on the photograph's linear scale.
    pub irradiance: f32,
    /// Log of red over blue of the sun's light.
    pub warmth: f32,
    /// Log of red over blue of the sky's light.
    pub sky_warmth: f32,
}

/// Numbers by which the network is told the camera's pitch.
const PITCH: usize = 2;

/// The camera's pitch, radians, as the network is told it: training has about 0 to 50 degrees.
fn pitch_features(pitch: f32) -> [f32; PITCH] {
    let x = (pitch.clamp(0.0, 0.9) - 0.4) / 0.3;
    [x, x * x - 1.0]
}

/// The network: a shadow's direction in the picture says that of the sun only to who knows how steeply the camera
/// looks down, so what every level finds is scaled and shifted by the pitch.
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
    /// To scales and shifts of all channels.
    pitch: Linear,
    /// What is added to that; the first level has none, where it would cost most and see least.
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
    fn new(parameters: Parameters) -> Result<Self> {
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

    /// Makes the pitch say nothing, as training begins.
    fn forget_pitch(&self) -> Result<()> {
        for (name, variable) in &self.variables {
            if name.contains(".pitch.") {
                variable.set(&variable.zeros_like()?)?;
            }
        }
        Ok(())
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

    /// Outputs [batch, OUTPUTS] for pictures [batch, 3, SIZE, SIZE] in [-1, 1] and features of the pitch
    /// [batch, PITCH].
    fn forward(&self, pictures: &Tensor, pitch: &Tensor) -> Result<Tensor> {
        let mut x = pictures.clone();
        for level in &self.levels {
            x = level.forward(&x, pitch)?;
        }
        let h = self.hidden.forward(&x.flatten_from(1)?)?;
        Ok(self.out.forward(&h.silu()?)?)
    }

    /// Writes [`FILE`] into `folder` in f16.
    fn write(&self, folder: &Path) -> Result<()> {
        let tensors = self
            .variables
            .iter()
            .map(|(n, v)| Ok((n.clone(), v.to_dtype(DType::F16)?)))
            .collect::<Result<BTreeMap<_, _>>>()?;
        write_safetensors(&folder.join(FILE), &tensors, &BTreeMap::new())?;
        Ok(())
    }

    /// Reads the light off a picture [3, SIZE, SIZE] in [0, 1] and off its mirror image, and averages. The
    /// azimuth is relative to where the picture's middle lies, `pitch` radians below the horizon.
    pub fn estimate(&self, picture: &[f32], pitch: f32) -> Result<LightEstimate> {
        let pair = [picture.to_vec(), examples::mirrored(picture)].concat();
        let x = Tensor::from_vec(pair, (2, 3, SIZE, SIZE), &Device::Cpu)?;
        let pitch = Tensor::new(&[pitch_features(pitch); 2], &Device::Cpu)?;
        let rows = self.forward(&x.affine(2.0, -1.0)?, &pitch)?;
        let rows = rows.to_vec2::<f32>()?;
        // The mirror swaps left and right.
        let mean = |i: usize| 0.5 * (rows[0][i] + if i == 1 { -rows[1][i] } else { rows[1][i] });
        Ok(LightEstimate {
            words: LightWords {
                azimuth: mean(1).atan2(mean(0)),
                elevation: (mean(2) + 0.75).clamp(0.15, 1.4),
                sun_share: (mean(3) + 0.6).clamp(0.0, 0.97),
            },
            confidence: mean(0).hypot(mean(1)),
            irradiance: mean(4).exp(),
            warmth: mean(5),
            sky_warmth: mean(6),
        })
    }
}

impl LightEstimate {
    /// Standard deviation of the azimuth, radians: that of a wrapped normal distribution whose mean vector is as long
    /// as the confidence [Mardia and Jupp 2000, 3.5.7].
    pub fn spread(&self) -> f32 {
        (-2.0 * self.confidence.clamp(1e-3, 1.0).ln()).sqrt()
    }

    /// The mean of what several pictures of one place say, each with its weight: of azimuths as vectors as long as
    /// they are sure, of irradiances geometric. Who is twice as sure counts four times as much.
    pub fn mean(of: impl Iterator<Item = (Self, f32)>) -> Result<Self> {
        // A little for those that see no sun, who still know its share.
        let weigh = |(e, w): (Self, f32)| (e, w * (e.confidence.min(1.0).powi(2) + 1e-3));
        let of: Vec<(Self, f32)> = of.map(weigh).collect();
        let total: f32 = of.iter().map(|e| e.1).sum();
        if of.is_empty() {
            return Err(Error::Argument("the light encoder needs a picture".into()));
        }
        let mean = |value: &dyn Fn(&Self) -> f32| {
            of.iter().map(|(e, w)| w * value(e)).sum::<f32>() / total
        };
        let c = mean(&|e| e.confidence * e.words.azimuth.cos());
        let s = mean(&|e| e.confidence * e.words.azimuth.sin());
        Ok(Self {
            words: LightWords {
                azimuth: s.atan2(c),
                elevation: mean(&|e| e.words.elevation),
                sun_share: mean(&|e| e.words.sun_share),
            },
            confidence: c.hypot(s),
            irradiance: mean(&|e| e.irradiance.ln()).exp(),
            warmth: mean(&|e| e.warmth),
            sky_warmth: mean(&|e| e.sky_warmth),
        })
    }
}

/// What the network should say about a light.
fn target(light: &Light, words: &LightWords, exposure: f32) -> [f32; OUTPUTS] {
    let seen = if words.is_overcast() { 0.0 } else { 1.0 };
    let (s, c) = words.azimuth.sin_cos();
    let sky = light.sky_irradiance();
    let ground = light.sun_color * words.elevation.sin() + sky;
    let ratio = |v: glam::Vec3| (v.x.max(1e-4) / v.z.max(1e-4)).ln();
    [
        c * seen,
        s * seen,
        words.elevation - 0.75,
        light.share - 0.6,
        (ground.element_sum() / 3.0 * exposure).ln(),
        ratio(light.sun_color) * seen,
        ratio(sky),
    ]
}

/// Pictures, what the network is told of the camera, what it should say, and how much each of that counts.
struct Batch {
    pictures: Tensor,
    pitch: Tensor,
    targets: Tensor,
    weights: Tensor,
}

/// Places with and without the inserted object.
fn batch(data: &Dataset, count: usize, stream: &mut NoiseStream) -> Result<Batch> {
    let (mut pictures, mut targets): (Vec<f32>, Vec<f32>) = (vec![], vec![]);
    let (mut pitch, mut weights): (Vec<f32>, Vec<f32>) = (vec![], vec![]);
    for _ in 0..count {
        let window = Window::draw(stream);
        let lens = Lens::new(data.scene(stream.below(data.len())), window);
        let light = Light::draw_any(lens.suns(), stream);
        // The whole picture has one more object in it.
        let layer = if stream.below(2) == 0 {
            Layer::Background
        } else {
            Layer::Whole
        };
        let look = Look::draw(stream);
        let mut picture = lens.layer(layer, &light);
        look.apply(&mut picture, stream);
        let words = lens.words(light.words(lens.suns()));
        pitch.extend(pitch_features(lens.gaze().pitch));
        pictures.extend(picture.iter().map(|v| 2.0 * v - 1.0));
        targets.extend(target(&light, &words, look.exposure));
        let seen = if words.is_overcast() { 0.0 } else { 1.0 };
        weights.extend([1.0, 1.0, 2.0 * seen, 2.0, 1.0, 0.3 * seen, 0.3]);
    }
    Ok(Batch {
        pictures: Tensor::from_vec(pictures, (count, 3, SIZE, SIZE), &Device::Cpu)?,
        pitch: Tensor::from_vec(pitch, (count, PITCH), &Device::Cpu)?,
        targets: Tensor::from_vec(targets, (count, OUTPUTS), &Device::Cpu)?,
        weights: Tensor::from_vec(weights, (count, OUTPUTS), &Device::Cpu)?,
    })
}

/// Pictures [3, SIZE, SIZE] in [0, 1] as training shows them, to be looked at.
pub fn pictures(data: &Dataset, count: usize, seed: u64) -> Result<Vec<Vec<f32>>> {
    let batch = batch(data, count, &mut NoiseStream::new(seed ^ 0xec0de, 0))?;
    let values = batch.pictures.affine(0.5, 0.5)?.flatten_from(1)?;
    Ok(values.to_vec2()?)
}

/// Settings of the training of an encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderSettings {
    /// Pictures in all; the learning rate falls to 0 over them.
    pub samples: usize,
    /// Key of all random numbers.
    pub seed: u64,
    /// Learning rate after the warm-up.
    pub learning_rate: f64,
}

impl Default for EncoderSettings {
    fn default() -> Self {
        Self {
            samples: 300_000,
            seed: 3,
            learning_rate: 1.5e-3,
        }
    }
}

/// Pictures of one update.
const BATCH: usize = 64;
/// Pictures after which the file is written.
pub const SAVED_EVERY: usize = 1000 * BATCH;

/// Trains an encoder on `samples` pictures and writes [`FILE`] into `folder`
/// in f16, now and then and at the end. `report` is told samples and loss and may stop; whether it
/// was finished is returned. What was written by then is good to go on `from`.
pub fn train(
    data: &Dataset,
    settings: &EncoderSettings,
    from: Option<&Path>,
    folder: &Path,
    report: &mut dyn FnMut(usize, f64) -> ControlFlow<()>,
) -> Result<bool> {
    let &EncoderSettings {
        samples,
        seed,
        learning_rate,
    } = settings;
    let parameters = match from {
        None => Parameters::random(seed, &Device::Cpu),
        Some(from) => {
            let weights = Weights::open_file(&from.join(FILE))?;
            Parameters::from_weights(weights, DType::F32, &Device::Cpu, true)
        }
    };
    let encoder = LightEncoder::new(parameters)?;
    if from.is_none() {
        encoder.forget_pitch()?;
    }
    let config = AdamWConfig {
        weight_decay: 0.02,
        ..AdamWConfig::default()
    };
    let mut optimizer = AdamW::new(&encoder.variables, config)?;
    let threads = Shards::new()?;
    let steps = samples.div_ceil(BATCH);
    for step in 0..steps {
        let work = |shard: usize| -> Result<(f64, BTreeMap<String, Tensor>)> {
            let key = (step * SHARDS + shard) as u64;
            let mut stream = NoiseStream::new(seed ^ 0xec0de, key);
            let batch = batch(data, BATCH / SHARDS, &mut stream)?;
            let found = encoder.forward(&batch.pictures, &batch.pitch)?;
            let error = ((found - batch.targets)?.sqr()? * batch.weights)?;
            let loss = error.mean_all()?;
            let gradients = optimizer.collect(&loss.backward()?)?;
            Ok((loss.to_scalar::<f32>()?.into(), gradients))
        };
        let (losses, gradients): (Vec<_>, Vec<_>) = threads.run(work)?.into_iter().unzip();
        let loss = losses.iter().sum::<f64>() / SHARDS as f64;
        let gradients = mean_gradients(&gradients)?;
        let done = step as f64 / steps as f64;
        let rate = learning_rate * ((step + 1) as f64 / 100.0).min(1.0);
        let rate = rate * 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
        optimizer.step(&gradients, 1.0, |_| rate)?;
        let seen = (step + 1) * BATCH;
        let stop = report(seen, loss).is_break();
        if stop || seen.is_multiple_of(SAVED_EVERY) {
            encoder.write(folder)?;
        }
        if stop {
            return Ok(false);
        }
    }
    encoder.write(folder)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{DatasetSettings, Places};
    use crate::studio::Kinds;

    fn estimate(azimuth: f32, confidence: f32, irradiance: f32) -> LightEstimate {
        LightEstimate {
            words: LightWords {
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

    fn mean(of: &[LightEstimate]) -> Result<LightEstimate> {
        LightEstimate::mean(of.iter().map(|e| (*e, 1.0)))
    }

    #[test]
    fn a_mean_listens_to_those_that_are_sure_and_is_unsure_where_they_disagree() {
        let agreed = mean(&[estimate(1.0, 0.9, 2.0); 3]).unwrap();
        assert!(
            (agreed.words.azimuth - 1.0).abs() < 1e-6 && (agreed.confidence - 0.9).abs() < 1e-6
        );
        // The second has .011 of .822 of the weight: 4^(.011/.822) = 1.019, and next to nothing of the azimuth.
        let sure = mean(&[estimate(0.0, 0.9, 1.0), estimate(2.0, 0.1, 4.0)]).unwrap();
        assert!(
            sure.words.azimuth < 0.002 && (sure.irradiance - 1.0187).abs() < 1e-3,
            "{sure:?}"
        );
        let overcast = mean(&[estimate(0.0, 0.0, 1.0), estimate(2.0, 0.0, 4.0)]).unwrap();
        assert!((overcast.irradiance - 2.0).abs() < 1e-5 && overcast.confidence == 0.0);
        let opposed = mean(&[estimate(0.0, 0.9, 1.0), estimate(3.0, 0.9, 1.0)]).unwrap();
        // .9 cos(1.5) is left, of a spread of sqrt(-2 ln .0637).
        assert!(
            (opposed.confidence - 0.0637).abs() < 1e-3 && (opposed.spread() - 2.347).abs() < 0.01,
            "{opposed:?}"
        );
        assert!(mean(&[]).is_err());
    }

    #[test]
    fn a_network_that_was_never_shown_the_pitch_does_not_heed_it() {
        let encoder = LightEncoder::new(Parameters::random(3, &Device::Cpu)).unwrap();
        let picture: Vec<f32> = (0..3 * SIZE * SIZE).map(|i| (i % 7) as f32 / 7.0).collect();
        let told = |pitch: f32| encoder.estimate(&picture, pitch).unwrap();
        assert_ne!(told(0.1), told(0.6));
        encoder.forget_pitch().unwrap();
        assert_eq!(told(0.1), told(0.6));
        // Beyond what training shows is taken for its end.
        assert_eq!(pitch_features(1.4), pitch_features(0.9));
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

    #[test]
    fn a_run_that_is_stopped_leaves_an_encoder_to_go_on_from() {
        let folder = tempfile::tempdir().unwrap();
        let settings = DatasetSettings {
            seed: 5,
            scenes: 1,
            places: Places::Anywhere,
            kinds: Kinds::Trained,
        };
        let on = &mut |_| ControlFlow::Continue(());
        let data = Dataset::make(folder.path(), &settings, on)
            .unwrap()
            .unwrap();
        assert!(folder.path().join("places-00000.safetensors").is_file());
        let shown = pictures(&data, 3, 1).unwrap();
        let in_range = |p: &Vec<f32>| p.iter().all(|v| (-1e-6..=1.000_001).contains(v));
        assert!(shown.len() == 3 && shown.iter().all(in_range));
        let settings = EncoderSettings {
            samples: 4 * BATCH,
            ..EncoderSettings::default()
        };
        let (mut seen, stop_at) = (vec![], 2 * BATCH);
        let done = train(&data, &settings, None, folder.path(), &mut |count, loss| {
            seen.push((count, loss));
            match count >= stop_at {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        });
        assert!(!done.unwrap() && seen.len() == 2);
        let from = Some(folder.path());
        let mut counts = vec![];
        let done = train(&data, &settings, from, folder.path(), &mut |count, loss| {
            assert!(loss.is_finite());
            counts.push(count);
            ControlFlow::Continue(())
        });
        assert!(done.unwrap());
        assert_eq!(counts, [1, 2, 3, 4].map(|k| k * BATCH));
        let encoder = LightEncoder::load(folder.path()).unwrap().unwrap();
        let found = encoder.estimate(&shown[0], 0.3).unwrap();
        assert!(found.confidence.is_finite() && found.irradiance > 0.0);
    }
}
