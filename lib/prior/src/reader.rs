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
use crate::energy::{Observation, energies, states};
use crate::error::{Error, Result};
use crate::examples::{SIZE, dilate, mirrored};
use crate::gates::minimum_angle;
use crate::words::{Caption, Gaze, LightWords};

/// Azimuths of the search.
pub const AZIMUTHS: usize = 16;
/// Elevations of the search, degrees.
pub const ELEVATIONS: [f32; 3] = [20.0, 40.0, 60.0];

/// A square of the photograph.
#[derive(Debug, Clone)]
pub struct Crop {
    /// [3, SIZE, SIZE] in [0, 1].
    pub picture: Vec<f32>,
    /// Where its middle lies.
    pub gaze: Gaze,
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
    /// Draws of noise for each crop, every other of them in the mirror; 0 asks the encoder alone.
    pub draws: usize,
    /// Weight of the model's energies, in nats for the error of a crop.
    pub trust: f64,
    /// Weight of the encoder's azimuth: nats between it and the opposite one are twice this where the encoder
    /// is sure.
    pub encoder: f64,
    /// What is shown of a crop.
    pub context: Context,
    /// The timestep at which crops are looked at, as a share of all: higher ones add little (docs/prior.md).
    pub told_at: f64,
}

impl Default for ReaderSettings {
    fn default() -> Self {
        Self {
            draws: 2,
            trust: 10.0,
            encoder: 16.0,
            context: Context::Hidden,
            told_at: 0.5,
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
    /// What every crop says by itself.
    pub crops: Vec<CropReading>,
}

/// What was read off one crop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CropReading {
    /// What the encoder says, azimuth relative to the camera.
    pub encoder: LightEstimate,
    /// Energies of the candidates, one elevation after the other; none if only the encoder was asked.
    pub energies: Vec<f64>,
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
            let words = words.seen_from(crop.gaze.heading);
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
        let e = energies(model, &observation, contexts, &[settings.told_at], stream)?;
        sum.iter_mut()
            .zip(e)
            .for_each(|(s, e)| *s += e / settings.draws as f64);
    }
    Ok(sum)
}

/// Reads the light off `crops` of one photograph, the first `same` of which are views of one place and count as one.
/// `progress` is told the share that is done and may stop: then the result is
/// `None`.
pub fn read(
    model: &Model,
    encoder: &LightEncoder,
    crops: &[Crop],
    same: usize,
    settings: &ReaderSettings,
    seed: u64,
    progress: &(dyn Fn(f64) -> ControlFlow<()> + Sync),
) -> Result<Option<Reading>> {
    let readings = crops.iter().map(|crop| {
        let mut encoder = encoder.estimate(&crop.picture, crop.gaze.pitch)?;
        encoder.words.azimuth += crop.gaze.heading;
        Ok(CropReading {
            encoder,
            energies: vec![],
        })
    });
    let mut readings = readings.collect::<Result<Vec<_>>>()?;
    all_are_numbers(&readings)?;
    let shares = (0..readings.len()).map(|i| if i < same { 1.0 / same as f32 } else { 1.0 });
    let seen = LightEstimate::mean(readings.iter().map(|r| r.encoder).zip(shares))?;
    if settings.draws == 0 {
        return Ok(Some(combine(readings, &seen, settings)));
    }
    let share = seen.words.sun_share.max(0.45);
    let done = std::sync::atomic::AtomicUsize::new(0);
    let go_on = crops
        .par_iter()
        .zip(&mut readings)
        .enumerate()
        .map(|(i, (crop, reading))| {
            let mut stream = NoiseStream::new(seed ^ 0x4ead, i as u64);
            reading.energies = crop_energies(model, crop, share, settings, &mut stream)?;
            let n = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            Ok(progress(n as f64 / crops.len() as f64)
                .is_continue()
                .then_some(()))
        })
        .collect::<Result<Option<()>>>()?;
    all_are_numbers(&readings)?;
    Ok(go_on.map(|()| combine(readings, &seen, settings)))
}

/// Weights that are damaged make answers that nothing may be built on.
fn all_are_numbers(crops: &[CropReading]) -> Result<()> {
    let is_number = |crop: &CropReading| {
        let e = &crop.encoder;
        [
            e.words.azimuth,
            e.words.elevation,
            e.words.sun_share,
            e.confidence,
            e.irradiance,
            e.warmth,
            e.sky_warmth,
        ]
        .iter()
        .all(|v| v.is_finite())
            && crop.energies.iter().all(|e| e.is_finite())
    };
    match crops.iter().position(|crop| !is_number(crop)) {
        None => Ok(()),
        Some(index) => Err(Error::Argument(format!(
            "what the model says of crop {index} of the photograph is not a number: its weights are damaged; \
             fetch or train the model's folder again"
        ))),
    }
}

/// The length of the mean of directions around the circle that have so many nats against them.
fn mean_length(nats: &[f64]) -> f32 {
    let least = nats.iter().copied().fold(f64::INFINITY, f64::min);
    let (mut c, mut s, mut total) = (0.0, 0.0, 0.0);
    for (k, n) in nats.iter().enumerate() {
        let (p, angle) = (
            (least - n).exp(),
            f64::from(TAU) * k as f64 / nats.len() as f64,
        );
        c += p * angle.cos();
        s += p * angle.sin();
        total += p;
    }
    (c.hypot(s) / total) as f32
}

/// What all crops say by their energies, and the encoder's answer, to one answer.
pub fn combine(
    crops: Vec<CropReading>,
    seen: &LightEstimate,
    settings: &ReaderSettings,
) -> Reading {
    let mut sum = vec![0f64; AZIMUTHS * ELEVATIONS.len()];
    for crop in &crops {
        sum.iter_mut()
            .zip(&crop.energies)
            .for_each(|(s, e)| *s += e);
    }
    let least = sum.iter().copied().fold(f64::INFINITY, f64::min);
    let energies: Vec<Vec<f64>> = sum
        .chunks_exact(AZIMUTHS)
        .map(|row| row.iter().map(|e| e - least).collect())
        .collect();
    // Nats against every candidate: the model's and the encoder's.
    let angle = |k: usize| TAU * k as f32 / AZIMUTHS as f32;
    let pull = settings.encoder * seen.confidence as f64;
    let against = |(k, e): (usize, &f64)| {
        settings.trust * e - pull * f64::from((angle(k) - seen.words.azimuth).cos())
    };
    let nats: Vec<Vec<f64>> = energies
        .iter()
        .map(|row| row.iter().enumerate().map(against).collect())
        .collect();
    let by_azimuth: Vec<f64> = (0..AZIMUTHS)
        .map(|k| {
            let column = nats.iter().map(|row| row[k]);
            let least = column.clone().fold(f64::INFINITY, f64::min);
            least - column.map(|n| (least - n).exp()).sum::<f64>().ln()
        })
        .collect();
    let azimuth = minimum_angle(&by_azimuth);
    let confidence = mean_length(&by_azimuth);
    let was_asked = crops.iter().any(|c| !c.energies.is_empty());
    Reading {
        light: LightEstimate {
            // Three heights tell less of the elevation than the encoder does.
            words: LightWords {
                azimuth,
                ..seen.words
            },
            confidence,
            ..*seen
        },
        encoder: *seen,
        energies: if was_asked { energies } else { vec![] },
        crops,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEEN: LightEstimate = LightEstimate {
        words: LightWords {
            azimuth: 1.0,
            elevation: 0.7,
            sun_share: 0.8,
        },
        confidence: 1.0,
        irradiance: 2.0,
        warmth: 0.0,
        sky_warmth: 0.0,
    };

    /// Minima are looked for every half degree.
    const STEP: f32 = 0.009;

    /// A crop whose energies, `depth` deep, are least at `azimuth` and at the elevation number `row`.
    fn crop(azimuth: f32, row: usize, depth: f64) -> CropReading {
        let energies = (0..AZIMUTHS * ELEVATIONS.len())
            .map(|k| {
                let off = TAU * (k % AZIMUTHS) as f32 / AZIMUTHS as f32 - azimuth;
                let beside = f64::from(u8::from(k / AZIMUTHS != row));
                depth * (1.0 - f64::from(off.cos()) + beside)
            })
            .collect();
        CropReading {
            encoder: SEEN,
            energies,
        }
    }

    fn read(crops: Vec<CropReading>, encoder: f64) -> LightEstimate {
        let settings = ReaderSettings {
            trust: 1.0,
            encoder,
            ..ReaderSettings::default()
        };
        combine(crops, &SEEN, &settings).light
    }

    #[test]
    fn crops_that_agree_are_believed() {
        let light = read(vec![crop(2.3, 2, 9.0); 4], 0.0);
        assert!((light.words.azimuth - 2.3).abs() < STEP, "{light:?}");
        assert_eq!(light.words.elevation, SEEN.words.elevation);
        // Nats of 36 (1 - cos) at 3.2, 19.3 and 25.7 degrees from there, the nearest of 16 azimuths: weights .945, .133
        // and .028, whose mean vector is 1.0944 / 1.106 long.
        assert!((light.confidence - 0.9895).abs() < 5e-4, "{light:?}");
    }

    #[test]
    fn what_is_not_a_number_is_refused_with_what_to_do() {
        assert!(all_are_numbers(&[crop(1.0, 0, 1.0)]).is_ok());
        let mut energies = crop(1.0, 0, 1.0);
        energies.energies[3] = f64::NAN;
        let mut encoder = crop(1.0, 0, 1.0);
        encoder.encoder.irradiance = f32::INFINITY;
        for damaged in [energies, encoder] {
            let error = all_are_numbers(&[crop(1.0, 0, 1.0), damaged]).unwrap_err();
            assert!(
                error
                    .to_string()
                    .contains("crop 1 of the photograph is not a number")
            );
        }
    }

    #[test]
    fn crops_that_disagree_leave_doubt() {
        let light = read(vec![crop(1.0, 1, 2.0), crop(4.0, 1, 2.0)], 0.0);
        // Two vectors of 2, 3 radians apart: 4 cos(1.5) = 0.283 is left; I1 / I0 of it.
        assert!((light.confidence - 0.140).abs() < 1e-3, "{light:?}");
        let with_encoder = read(vec![crop(1.0, 1, 2.0), crop(4.0, 1, 2.0)], 8.0);
        // 8 towards 1.0 and 0.283 towards 2.5: 8.025 towards 1.035.
        assert!(
            (with_encoder.words.azimuth - 1.035).abs() < STEP,
            "{with_encoder:?}"
        );
        assert!(
            (with_encoder.confidence - 0.935).abs() < 1e-3,
            "{with_encoder:?}"
        );
    }

    #[test]
    fn energies_of_any_size_are_combined_to_numbers() {
        for depth in [0.0, 1e-12, 1e3, 1e12] {
            let light = read(vec![crop(1.0, 0, depth), crop(4.0, 2, depth)], 0.0);
            let words = light.words;
            assert!(
                words.azimuth.is_finite() && words.elevation.is_finite(),
                "{depth}"
            );
            assert!(
                (0.0..=1.0).contains(&light.confidence),
                "{depth}: {light:?}"
            );
        }
        // Without crops the encoder is left.
        let words = read(vec![], 2.0).words;
        assert!(
            (words.azimuth - SEEN.words.azimuth).abs() < STEP,
            "{words:?}"
        );
    }
}
