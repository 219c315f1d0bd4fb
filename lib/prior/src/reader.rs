//! Reading the light off a photograph: the light under which the model
//! explains the photograph's own objects best (inversion), with the light
//! encoder as a weak prior.

use std::f32::consts::TAU;
use std::ops::ControlFlow;

use candle_core::Tensor;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::encoder::{LightEncoder, LightEstimate};
use crate::energy::{Observation, SHARES, energies, states};
use crate::error::Result;
use crate::examples::{SIZE, dilate, mirrored};
use crate::gates::minimum_angle;
use crate::words::{Caption, LightWords};

/// Azimuths of the search.
pub const AZIMUTHS: usize = 16;
/// Elevations of the search, degrees.
pub const ELEVATIONS: [f32; 3] = [20.0, 40.0, 60.0];

/// A square of the photograph.
#[derive(Debug, Clone)]
pub struct Crop {
    /// [3, SIZE, SIZE] in [0, 1].
    pub picture: Vec<f32>,
    /// Angle on the ground from the camera's forward direction to the
    /// crop's middle, towards the right, radians.
    pub heading: f32,
}

/// What the model sees of a crop when it is asked to explain its middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Context {
    /// Everything around a box in the middle, shadows included.
    Box,
    /// Nothing.
    Hidden,
    /// The ground as it would be without object and shadow, filled in from
    /// around.
    Filled,
}

/// How the photograph is read.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReaderSettings {
    /// Draws of noise for each crop and timestep; 0 asks the encoder alone.
    pub draws: usize,
    /// Weight of the model's energies, in nats for the summed error of all
    /// crops.
    pub trust: f64,
    /// Weight of the encoder's azimuth.
    pub encoder: f64,
    /// What is shown of a crop.
    pub context: Context,
}

impl Default for ReaderSettings {
    fn default() -> Self {
        Self {
            draws: 2,
            trust: 400.0,
            encoder: 2.0,
            context: Context::Hidden,
        }
    }
}

/// What was read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// The light, azimuth relative to the camera.
    pub light: LightEstimate,
    /// What the encoder alone says.
    pub encoder: LightEstimate,
    /// Summed energies by elevation and azimuth, each less the smallest; none if only the encoder was asked.
    pub energies: Vec<Vec<f64>>,
}

/// The share of a crop's side that its blanked box takes, as in training
/// between the object's own box and that with margins.
const BOX_SHARES: [f32; 2] = [0.4, 0.6];

/// A box in the middle of a crop, moved a little.
fn middle_box(stream: &mut NoiseStream) -> Vec<f32> {
    let mut between = |low: f32, high: f32| low + (high - low) * stream.uniform() as f32;
    let size = SIZE as f32;
    let side = [
        between(BOX_SHARES[0], BOX_SHARES[1]),
        between(BOX_SHARES[0], BOX_SHARES[1]),
    ];
    let start = side.map(|s| ((1.0 - s) * between(0.35, 0.65) * size).round());
    let end = [0, 1].map(|k| (start[k] + side[k] * size).round());
    (0..SIZE * SIZE)
        .map(|i| {
            let p = [(i % SIZE) as f32, (i / SIZE) as f32];
            f32::from((0..2).all(|k| p[k] >= start[k] && p[k] < end[k]))
        })
        .collect()
}

/// A crop without what stands in its middle.
struct Plate {
    /// [3, SIZE, SIZE], the ground filled in where object and shadow are.
    shown: Vec<f32>,
    /// 1 where the object is, [SIZE, SIZE].
    object: Vec<f32>,
}

impl Plate {
    /// Takes for the ground what a plane through the crop's colours explains;
    /// what stands out in the middle is the shadow where it is a darker shade
    /// of the ground, else the object.
    fn new(picture: &[f32]) -> Self {
        let n = SIZE * SIZE;
        let at = |i: usize| [0, 1, 2].map(|c| picture[c * n + i]);
        let place = |i: usize| {
            let unit = |k: usize| (k as f32 + 0.5) / SIZE as f32 - 0.5;
            [1.0, unit(i % SIZE), unit(i / SIZE)]
        };
        let radius = |i: usize| {
            let [_, x, y] = place(i);
            (x * x + y * y).sqrt()
        };
        // Least squares, reweighted: the middle and what stands out count little.
        let mut ground = vec![[0f32; 3]; n];
        let mut spread = 0.2f32;
        for round in 0..6 {
            let weight = |i: usize| {
                let away = (0..3)
                    .map(|c| (at(i)[c] - ground[i][c]).powi(2))
                    .sum::<f32>();
                let fit = if round == 0 {
                    1.0
                } else {
                    1.0 / (1.0 + away / (spread * spread)).powi(2)
                };
                fit * if radius(i) > 0.3 { 1.0 } else { 0.1 }
            };
            let weights: Vec<f32> = (0..n).map(weight).collect();
            let mut gram = [[0f32; 3]; 3];
            for (i, w) in weights.iter().enumerate() {
                let x = place(i);
                for (row, a) in gram.iter_mut().zip(x) {
                    row.iter_mut().zip(x).for_each(|(g, b)| *g += w * a * b);
                }
            }
            let inverse = glam::Mat3::from_cols_array_2d(&gram).inverse();
            for c in 0..3 {
                let mut right = glam::Vec3::ZERO;
                for (i, w) in weights.iter().enumerate() {
                    right += glam::Vec3::from_array(place(i)) * (w * at(i)[c]);
                }
                let fit = inverse * right;
                for (i, g) in ground.iter_mut().enumerate() {
                    g[c] = fit.dot(glam::Vec3::from_array(place(i)));
                }
            }
            let total: f32 = weights.iter().sum();
            let residual = (0..n).map(|i| {
                weights[i]
                    * (0..3)
                        .map(|c| (at(i)[c] - ground[i][c]).powi(2))
                        .sum::<f32>()
            });
            spread = (residual.sum::<f32>() / total).sqrt().clamp(0.02, 0.2);
        }
        let mut shown = picture.to_vec();
        let mut object = vec![0f32; n];
        for i in (0..n).filter(|&i| radius(i) < 0.45) {
            let (p, g) = (at(i), ground[i]);
            let away = (0..3).map(|c| (p[c] - g[c]).powi(2)).sum::<f32>().sqrt();
            if away < 2.0 * spread {
                continue;
            }
            for c in 0..3 {
                shown[c * n + i] = g[c].clamp(0.0, 1.0);
            }
            let ratio = [0, 1, 2].map(|c| p[c] / g[c].max(0.02));
            let mean = (ratio[0] + ratio[1] + ratio[2]) / 3.0;
            let tinted = ratio.iter().any(|r| (r - mean).abs() > 0.12);
            if (tinted || mean > 0.95) && radius(i) < 0.33 {
                object[i] = 1.0;
            }
        }
        // A grey object cannot be told from its shadow: the middle of the crop.
        if object.iter().sum::<f32>() < 12.0 {
            (0..n)
                .filter(|&i| radius(i) < 0.2)
                .for_each(|i| object[i] = 1.0);
        }
        let object = dilate(&object, 1);
        // What is painted anew is not looked at.
        Self { shown, object }
    }
}

/// The candidates of the search, relative to the camera.
fn candidates(share: f32) -> Vec<LightWords> {
    ELEVATIONS
        .iter()
        .flat_map(|e| {
            (0..AZIMUTHS).map(move |k| LightWords {
                azimuth: TAU * k as f32 / AZIMUTHS as f32,
                elevation: e.to_radians(),
                sun_share: share,
            })
        })
        .collect()
}

/// Energies of all candidates on one crop.
fn crop_energies(
    model: &Model,
    crop: &Crop,
    share: f32,
    settings: &ReaderSettings,
    stream: &mut NoiseStream,
) -> Result<Vec<f64>> {
    let asked = |swap: bool| -> Result<Tensor> {
        let captions = candidates(share).into_iter().map(|words| {
            let words = words.seen_from(crop.heading);
            let words = if swap { words.mirrored() } else { words };
            Some(Caption::new("object", Some(&words)))
        });
        states(model, &captions.collect::<Vec<_>>())
    };
    // Every other draw sees the mirror image.
    let views = [
        (crop.picture.clone(), asked(false)?),
        (mirrored(&crop.picture), asked(true)?),
    ];
    let mut sum = vec![0f64; AZIMUTHS * ELEVATIONS.len()];
    for draw in 0..settings.draws {
        let (picture, contexts) = &views[draw % 2];
        let observation = match settings.context {
            Context::Box => {
                let mask = middle_box(stream);
                Observation::new(picture, picture, &mask, &mask)?
            }
            Context::Hidden => {
                let all = vec![1.0; SIZE * SIZE];
                let focus = middle_box(stream);
                Observation::new(picture, picture, &all, &focus)?
            }
            Context::Filled => {
                let Plate { shown, object } = Plate::new(picture);
                Observation::new(picture, &shown, &object, &object)?
            }
        };
        let e = energies(model, &observation, contexts, &SHARES, stream)?;
        sum.iter_mut()
            .zip(e)
            .for_each(|(s, e)| *s += e / settings.draws as f64);
    }
    Ok(sum)
}

/// Reads the light off `crops` of one photograph, the first of them around
/// the place of the insertion; the encoder sees those `near` first ones.
/// `progress` is told the share that is done and may stop: then the result is
/// `None`.
pub fn read(
    model: &Model,
    encoder: &LightEncoder,
    crops: &[Crop],
    near: usize,
    settings: &ReaderSettings,
    seed: u64,
    progress: &(dyn Fn(f64) -> ControlFlow<()> + Sync),
) -> Result<Option<Reading>> {
    let pictures: Vec<Vec<f32>> = crops.iter().take(near).map(|c| c.picture.clone()).collect();
    let mut seen = encoder.estimate(&pictures)?;
    seen.words.azimuth += crops.first().map_or(0.0, |c| c.heading);
    if settings.draws == 0 {
        return Ok(Some(Reading {
            light: seen,
            encoder: seen,
            energies: vec![],
        }));
    }
    let share = seen.words.sun_share.max(0.45);
    let done = std::sync::atomic::AtomicUsize::new(0);
    let each = crops
        .par_iter()
        .enumerate()
        .map(|(i, crop)| {
            let mut stream = NoiseStream::new(seed ^ 0x4ead, i as u64);
            let e = crop_energies(model, crop, share, settings, &mut stream)?;
            let n = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            Ok(progress(n as f64 / crops.len() as f64)
                .is_continue()
                .then_some(e))
        })
        .collect::<Result<Option<Vec<_>>>>()?;
    let Some(each) = each else {
        return Ok(None);
    };
    let mut sum = vec![0f64; AZIMUTHS * ELEVATIONS.len()];
    for e in each {
        sum.iter_mut().zip(e).for_each(|(s, e)| *s += e);
    }
    Ok(Some(combine(&sum, &seen, settings)))
}

/// Energies and the encoder's answer to one answer.
pub fn combine(sum: &[f64], seen: &LightEstimate, settings: &ReaderSettings) -> Reading {
    let least = sum.iter().copied().fold(f64::INFINITY, f64::min);
    let energies: Vec<Vec<f64>> = sum
        .chunks_exact(AZIMUTHS)
        .map(|row| row.iter().map(|e| e - least).collect())
        .collect();
    // Nats of every candidate: the model's and the encoder's.
    let angle = |k: usize| TAU * k as f32 / AZIMUTHS as f32;
    let pull = settings.encoder * seen.confidence as f64;
    let nats: Vec<Vec<f64>> = energies
        .iter()
        .map(|row| {
            row.iter()
                .enumerate()
                .map(|(k, e)| {
                    settings.trust * e - pull * f64::from((angle(k) - seen.words.azimuth).cos())
                })
                .collect()
        })
        .collect();
    let best = nats.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let by_azimuth: Vec<f64> = (0..AZIMUTHS)
        .map(|k| {
            -nats
                .iter()
                .map(|row| (best - row[k]).exp())
                .sum::<f64>()
                .ln()
        })
        .collect();
    let azimuth = minimum_angle(&by_azimuth);
    // The mean elevation under the posterior, half-way to the encoder's.
    let (mut mean, mut total) = (0.0, 0.0);
    for (row, elevation) in nats.iter().zip(ELEVATIONS) {
        for n in row {
            let p = (best - n).exp();
            mean += p * f64::from(elevation.to_radians());
            total += p;
        }
    }
    let elevation = 0.5 * ((mean / total) as f32 + seen.words.elevation);
    Reading {
        light: LightEstimate {
            words: LightWords {
                azimuth,
                elevation,
                ..seen.words
            },
            ..*seen
        },
        encoder: *seen,
        energies,
    }
}
