//! Training of the light encoder.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::optimizer::{AdamW, AdamWConfig};
use dipir_diffusion::parameters::Parameters;
use dipir_diffusion::weights::{Weights, write_safetensors};
use dipir_prior::caption::LightDescription;
use dipir_prior::encoder::{
    FILE, LightEncoder, MIDDLE_ELEVATION, MIDDLE_SHARE, OUTPUTS, PITCH, pitch_features,
};
use dipir_prior::picture::SIZE;

use crate::camera::CameraEffects;
use crate::data_parallel::{PARTS, Workers, mean_gradients};
use crate::dataset::Dataset;
use crate::direct_light::Layer;
use crate::error::Result;
use crate::lighting::SunSkyLight;
use crate::window::{CroppedScene, Window};

/// Makes a new network ignore the pitch.
fn ignore_pitch(encoder: &LightEncoder) -> Result<()> {
    for (name, variable) in encoder.variables() {
        if name.contains(".pitch.") {
            variable.set(&variable.zeros_like()?)?;
        }
    }
    Ok(())
}

/// Writes [`FILE`] into `folder` in f16.
fn write(encoder: &LightEncoder, folder: &Path) -> Result<()> {
    let tensors = encoder
        .variables()
        .iter()
        .map(|(n, v)| Ok((n.clone(), v.to_dtype(DType::F16)?)))
        .collect::<Result<BTreeMap<_, _>>>()?;
    write_safetensors(&folder.join(FILE), &tensors, &BTreeMap::new())?;
    Ok(())
}

/// Target of the network for `light`, described by `seen` through a window, at an exposure.
fn target(light: &SunSkyLight, seen: &LightDescription, exposure: f32) -> [f32; OUTPUTS] {
    let has_sun = if seen.is_overcast() { 0.0 } else { 1.0 };
    let (s, c) = seen.azimuth.sin_cos();
    let sky = light.sky_irradiance();
    let ground = light.sun_color * seen.elevation.sin() + sky;
    let ratio = |v: glam::Vec3| (v.x.max(1e-4) / v.z.max(1e-4)).ln();
    [
        c * has_sun,
        s * has_sun,
        seen.elevation - MIDDLE_ELEVATION,
        light.share - MIDDLE_SHARE,
        (ground.element_sum() / 3.0 * exposure).ln(),
        ratio(light.sun_color) * has_sun,
        ratio(sky),
    ]
}

/// Inputs, targets and weights of targets.
struct Batch {
    pictures: Tensor,
    pitch: Tensor,
    targets: Tensor,
    weights: Tensor,
}

/// Random pictures of scenes, with and without the main object.
fn batch(data: &Dataset, count: usize, stream: &mut NoiseStream) -> Result<Batch> {
    let (mut pictures, mut targets): (Vec<f32>, Vec<f32>) = (vec![], vec![]);
    let (mut pitch, mut weights): (Vec<f32>, Vec<f32>) = (vec![], vec![]);
    for _ in 0..count {
        let window = Window::draw(stream);
        let scene = CroppedScene::new(data.scene(stream.below(data.len())), window);
        let light = SunSkyLight::draw_varied(scene.suns(), stream);
        // The whole scene has one more object.
        let layer = if stream.below(2) == 0 {
            Layer::Background
        } else {
            Layer::Whole
        };
        let effects = CameraEffects::draw(stream);
        let mut picture = scene.layer(layer, &light);
        effects.apply(&mut picture, stream);
        let seen = scene.seen_through_window(light.describe(scene.suns()));
        pitch.extend(pitch_features(scene.view_direction().pitch));
        pictures.extend(picture.iter().map(|v| 2.0 * v - 1.0));
        targets.extend(target(&light, &seen, effects.exposure));
        let has_sun = if seen.is_overcast() { 0.0 } else { 1.0 };
        weights.extend([1.0, 1.0, 2.0 * has_sun, 2.0, 1.0, 0.3 * has_sun, 0.3]);
    }
    Ok(Batch {
        pictures: Tensor::from_vec(pictures, (count, 3, SIZE, SIZE), &Device::Cpu)?,
        pitch: Tensor::from_vec(pitch, (count, PITCH), &Device::Cpu)?,
        targets: Tensor::from_vec(targets, (count, OUTPUTS), &Device::Cpu)?,
        weights: Tensor::from_vec(weights, (count, OUTPUTS), &Device::Cpu)?,
    })
}

/// Pictures [3, SIZE, SIZE] in [0, 1] of the training, for a contact sheet.
pub fn pictures(data: &Dataset, count: usize, seed: u64) -> Result<Vec<Vec<f32>>> {
    let batch = batch(data, count, &mut NoiseStream::new(seed ^ 0xec0de, 0))?;
    let values = batch.pictures.affine(0.5, 0.5)?.flatten_from(1)?;
    Ok(values.to_vec2()?)
}

/// Settings of the training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderSettings {
    /// Pictures of the whole run, over which the learning rate falls to 0.
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
/// Pictures between two times that the file is written.
pub const SAVED_EVERY: usize = 1000 * BATCH;

/// Trains an encoder and writes [`FILE`] into `folder`, every [`SAVED_EVERY`] pictures and at the end. It starts from the
/// encoder of the model folder `from`, if there is one. `report` is called with the number of pictures and the loss and
/// may stop the run, which also writes the file. Returns whether the run is complete.
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
        ignore_pitch(&encoder)?;
    }
    let config = AdamWConfig {
        weight_decay: 0.02,
        ..AdamWConfig::default()
    };
    let mut optimizer = AdamW::new(encoder.variables(), config)?;
    let workers = Workers::new()?;
    let steps = samples.div_ceil(BATCH);
    for step in 0..steps {
        let work = |part: usize| -> Result<(f64, BTreeMap<String, Tensor>)> {
            let key = (step * PARTS + part) as u64;
            let mut stream = NoiseStream::new(seed ^ 0xec0de, key);
            let batch = batch(data, BATCH / PARTS, &mut stream)?;
            let found = encoder.forward(&batch.pictures, &batch.pitch)?;
            let error = ((found - batch.targets)?.sqr()? * batch.weights)?;
            let loss = error.mean_all()?;
            let gradients = optimizer.collect(&loss.backward()?)?;
            Ok((loss.to_scalar::<f32>()?.into(), gradients))
        };
        let (losses, gradients): (Vec<_>, Vec<_>) = workers.run(work)?.into_iter().unzip();
        let loss = losses.iter().sum::<f64>() / PARTS as f64;
        let gradients = mean_gradients(&gradients)?;
        let done = step as f64 / steps as f64;
        let rate = learning_rate * ((step + 1) as f64 / 100.0).min(1.0);
        let rate = rate * 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
        optimizer.step(&gradients, 1.0, |_| rate)?;
        let seen = (step + 1) * BATCH;
        let stop = report(seen, loss).is_break();
        if stop || seen.is_multiple_of(SAVED_EVERY) {
            write(&encoder, folder)?;
        }
        if stop {
            return Ok(false);
        }
    }
    write(&encoder, folder)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{DatasetSettings, SceneMix};
    use crate::scene::ObjectSet;

    #[test]
    fn a_new_network_ignores_the_pitch() {
        let encoder = LightEncoder::new(Parameters::random(3, &Device::Cpu)).unwrap();
        let picture: Vec<f32> = (0..3 * SIZE * SIZE).map(|i| (i % 7) as f32 / 7.0).collect();
        let estimate = |pitch: f32| encoder.estimate(&picture, pitch).unwrap();
        assert_ne!(estimate(0.1), estimate(0.6));
        ignore_pitch(&encoder).unwrap();
        assert_eq!(estimate(0.1), estimate(0.6));
    }

    #[test]
    fn a_stopped_run_leaves_an_encoder_that_another_run_starts_from() {
        let folder = tempfile::tempdir().unwrap();
        let settings = DatasetSettings {
            seed: 5,
            scenes: 1,
            mix: SceneMix::WithCourtyards,
            objects: ObjectSet::Training,
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
