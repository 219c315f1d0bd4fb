//! Inversion: finds the light under which the model explains the photograph's own objects best. The light encoder's
//! answer is a weak prior.

use std::f32::consts::TAU;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};

use candle_core::Tensor;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::caption::{Caption, LightDescription, ViewDirection};
use crate::encoder::{LightEncoder, SunSkyEstimate};
use crate::energy::{Observation, energies};
use crate::error::{Error, Result};
use crate::picture::{PIXELS, Picture, SIZE, mirrored};
use crate::text_conditioning::caption_states;

/// Azimuths of the search.
pub const AZIMUTHS: usize = 16;
/// Elevations of the search, degrees.
pub const ELEVATIONS: [f32; 3] = [20.0, 40.0, 60.0];
/// Candidates of the search.
const CANDIDATES: usize = AZIMUTHS * ELEVATIONS.len();
/// Least sun's share of a candidate: the least of the lights of training that have a sun.
const LEAST_SHARE: f32 = 0.45;
/// Width and height of the box in which errors count most, as shares of a crop's side: those of an object in training,
/// with margins.
const BOX_SHARES: [f32; 2] = [0.4, 0.6];

/// A square of the photograph.
#[derive(Debug, Clone)]
pub struct Crop {
    /// Display values [3, SIZE, SIZE] in [0, 1].
    pub picture: Picture,
    /// Direction of its middle.
    pub view_direction: ViewDirection,
}

/// Settings of the inversion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InversionSettings {
    /// Draws of noise for each crop. Every other draw is for the mirror image. 0 leaves the light to the encoder.
    pub draws: usize,
    /// Weight of energies, nats for an error of 1.
    pub energy_weight: f64,
    /// Weight of the encoder's azimuth: the opposite azimuth costs twice this, in nats, where its confidence is 1.
    pub encoder_weight: f64,
    /// Timestep of the noise, as a share of all. docs/prior.md compares others.
    pub timestep: f64,
}

impl Default for InversionSettings {
    fn default() -> Self {
        Self {
            draws: 2,
            energy_weight: 10.0,
            encoder_weight: 16.0,
            timestep: 0.5,
        }
    }
}

/// The light that was read off a photograph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// The light. Its azimuth is relative to the camera.
    pub light: SunSkyEstimate,
    /// The encoder's answer.
    pub encoder: SunSkyEstimate,
    /// Energies summed over crops, by elevation and azimuth, minus the least of them; empty without draws of noise.
    pub energies: Vec<Vec<f64>>,
    /// Answers for every crop.
    pub crops: Vec<CropReading>,
}

/// Answers for one crop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CropReading {
    /// The encoder's answer. Its azimuth is relative to the camera.
    pub encoder: SunSkyEstimate,
    /// Energies of the candidates, elevation by elevation; empty without draws of noise.
    pub energies: Vec<f64>,
}

/// A mask [SIZE, SIZE] of a box near the middle of a crop.
fn middle_box(stream: &mut NoiseStream) -> Vec<f32> {
    let mut between = |low: f32, high: f32| low + (high - low) * stream.uniform() as f32;
    let size = SIZE as f32;
    let side = [0; 2].map(|_| between(BOX_SHARES[0], BOX_SHARES[1]));
    let start = side.map(|s| ((1.0 - s) * between(0.35, 0.65) * size).round());
    let end = [0, 1].map(|k| (start[k] + side[k] * size).round());
    (0..PIXELS)
        .map(|i| {
            let p = [(i % SIZE) as f32, (i / SIZE) as f32];
            f32::from((0..2).all(|k| p[k] >= start[k] && p[k] < end[k]))
        })
        .collect()
}

/// The candidates of the search. Azimuths are relative to the camera.
fn candidates(share: f32) -> Vec<LightDescription> {
    ELEVATIONS
        .iter()
        .flat_map(|e| {
            (0..AZIMUTHS).map(move |k| LightDescription {
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
    settings: &InversionSettings,
    stream: &mut NoiseStream,
) -> Result<Vec<f64>> {
    let contexts = |mirror: bool| -> Result<Tensor> {
        let captions = candidates(share).into_iter().map(|light| {
            let light = light.seen_from(crop.view_direction.heading);
            let light = if mirror { light.mirrored() } else { light };
            Some(Caption::new("object", Some(&light)))
        });
        caption_states(model, &captions.collect::<Vec<_>>())
    };
    let views = [
        (crop.picture.clone(), contexts(false)?),
        (mirrored(&crop.picture), contexts(true)?),
    ];
    // The model sees nothing around the box, or the crop's own light would be visible there.
    let hidden = vec![1.0; PIXELS];
    let mut sum = vec![0f64; CANDIDATES];
    for draw in 0..settings.draws {
        let (picture, contexts) = &views[draw % 2];
        let focus = middle_box(stream);
        let observation = Observation::new(picture, picture, &hidden, &focus)?;
        let e = energies(model, &observation, contexts, &[settings.timestep], stream)?;
        sum.iter_mut()
            .zip(e)
            .for_each(|(s, e)| *s += e / settings.draws as f64);
    }
    Ok(sum)
}

/// Estimates the light from `crops` of one photograph. The first `same` of them show one place: in the mean of the
/// encoder's answers they count as one crop together, in the sum of energies as one each. `progress` is called with the
/// share that is done and may stop the search; then the result is `None`.
pub fn invert(
    model: &Model,
    encoder: &LightEncoder,
    crops: &[Crop],
    same: usize,
    settings: &InversionSettings,
    seed: u64,
    progress: &(dyn Fn(f64) -> ControlFlow<()> + Sync),
) -> Result<Option<Reading>> {
    let readings = crops.iter().map(|crop| {
        let mut encoder = encoder.estimate(&crop.picture, crop.view_direction.pitch)?;
        encoder.description.azimuth += crop.view_direction.heading;
        Ok(CropReading {
            encoder,
            energies: vec![],
        })
    });
    let mut readings = readings.collect::<Result<Vec<_>>>()?;
    check_finite(&readings)?;
    let shares = (0..readings.len()).map(|i| if i < same { 1.0 / same as f32 } else { 1.0 });
    let prior = SunSkyEstimate::mean(readings.iter().map(|r| r.encoder).zip(shares))?;
    if settings.draws == 0 {
        return Ok(Some(combine(readings, &prior, settings)));
    }
    let share = prior.description.sun_share.max(LEAST_SHARE);
    let done = AtomicUsize::new(0);
    let finished = crops
        .par_iter()
        .zip(&mut readings)
        .enumerate()
        .map(|(i, (crop, reading))| {
            let mut stream = NoiseStream::new(seed ^ 0x4ead, i as u64);
            reading.energies = crop_energies(model, crop, share, settings, &mut stream)?;
            let n = done.fetch_add(1, Ordering::Relaxed) + 1;
            Ok(progress(n as f64 / crops.len() as f64)
                .is_continue()
                .then_some(()))
        })
        .collect::<Result<Option<()>>>()?;
    check_finite(&readings)?;
    Ok(finished.map(|()| combine(readings, &prior, settings)))
}

/// Refuses answers that are not finite, as damaged weights give them.
fn check_finite(crops: &[CropReading]) -> Result<()> {
    let is_finite = |crop: &CropReading| {
        let e = &crop.encoder;
        [
            e.description.azimuth,
            e.description.elevation,
            e.description.sun_share,
            e.confidence,
            e.irradiance,
            e.warmth,
            e.sky_warmth,
        ]
        .iter()
        .all(|v| v.is_finite())
            && crop.energies.iter().all(|e| e.is_finite())
    };
    match crops.iter().position(|crop| !is_finite(crop)) {
        None => Ok(()),
        Some(index) => Err(Error::Argument(format!(
            "the model's answer for crop {index} of the photograph is not a number: its weights are damaged; \
             fetch or train the model's folder again"
        ))),
    }
}

/// The length of the mean of unit vectors around the circle, each weighted by exp(-nats).
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

/// One answer from the energies of all crops and the encoder's answer, `prior`.
pub fn combine(
    crops: Vec<CropReading>,
    prior: &SunSkyEstimate,
    settings: &InversionSettings,
) -> Reading {
    let mut sum = vec![0f64; CANDIDATES];
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
    // The cost of every candidate in nats, from the model and from the encoder.
    let angle = |k: usize| TAU * k as f32 / AZIMUTHS as f32;
    let pull = settings.encoder_weight * prior.confidence as f64;
    let against = |(k, e): (usize, &f64)| {
        settings.energy_weight * e - pull * f64::from((angle(k) - prior.description.azimuth).cos())
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
    let has_energies = crops.iter().any(|c| !c.energies.is_empty());
    Reading {
        light: SunSkyEstimate {
            // Three elevations are too coarse; the encoder estimates the elevation better.
            description: LightDescription {
                azimuth,
                ..prior.description
            },
            confidence,
            ..*prior
        },
        encoder: *prior,
        energies: if has_energies { energies } else { vec![] },
        crops,
    }
}

/// The difference of two angles, radians in [0, pi].
pub fn angle_between(a: f32, b: f32) -> f32 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// The angle of the minimum of samples at 2 pi k / n: of their first four harmonics on a grid of half degrees.
pub fn minimum_angle(values: &[f64]) -> f32 {
    let n = values.len() as f64;
    let harmonics: Vec<(f64, f64)> = (1..=4)
        .map(|h| {
            let at = |k: usize| h as f64 * k as f64 / n * std::f64::consts::TAU;
            let sum = |f: fn(f64) -> f64| -> f64 {
                values.iter().enumerate().map(|(k, v)| v * f(at(k))).sum()
            };
            (sum(f64::cos) * 2.0 / n, sum(f64::sin) * 2.0 / n)
        })
        .collect();
    let value = |a: f64| -> f64 {
        let terms = harmonics.iter().zip(1..);
        terms
            .map(|((c, s), h)| c * (h as f64 * a).cos() + s * (h as f64 * a).sin())
            .sum()
    };
    let grid = (0..720).map(|i| i as f64 / 720.0 * std::f64::consts::TAU);
    grid.min_by(|a, b| value(*a).total_cmp(&value(*b)))
        .unwrap_or(0.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_minimum_of_a_shifted_cosine_is_found() {
        for shift in [0.1f64, 2.0, 5.5] {
            let values: Vec<f64> = (0..16)
                .map(|k| -(k as f64 / 16.0 * std::f64::consts::TAU - shift).cos())
                .collect();
            assert!(angle_between(minimum_angle(&values), shift as f32) < 0.01);
        }
    }

    const PRIOR: SunSkyEstimate = SunSkyEstimate {
        description: LightDescription {
            azimuth: 1.0,
            elevation: 0.7,
            sun_share: 0.8,
        },
        confidence: 1.0,
        irradiance: 2.0,
        warmth: 0.0,
        sky_warmth: 0.0,
    };

    /// Half a degree, the step of the grid on which minima are found.
    const STEP: f32 = 0.009;

    /// A crop whose energies, `depth` deep, are least at `azimuth` and at the elevation number `row`.
    fn crop(azimuth: f32, row: usize, depth: f64) -> CropReading {
        let energies = (0..CANDIDATES)
            .map(|k| {
                let off = TAU * (k % AZIMUTHS) as f32 / AZIMUTHS as f32 - azimuth;
                let beside = f64::from(u8::from(k / AZIMUTHS != row));
                depth * (1.0 - f64::from(off.cos()) + beside)
            })
            .collect();
        CropReading {
            encoder: PRIOR,
            energies,
        }
    }

    fn combined(crops: Vec<CropReading>, encoder_weight: f64) -> SunSkyEstimate {
        let settings = InversionSettings {
            energy_weight: 1.0,
            encoder_weight,
            ..InversionSettings::default()
        };
        combine(crops, &PRIOR, &settings).light
    }

    #[test]
    fn crops_that_agree_are_believed() {
        let light = combined(vec![crop(2.3, 2, 9.0); 4], 0.0);
        assert!((light.description.azimuth - 2.3).abs() < STEP, "{light:?}");
        assert_eq!(light.description.elevation, PRIOR.description.elevation);
        // Nats of 36 (1 - cos) at 3.2, 19.3 and 25.7 degrees from there, the nearest of 16 azimuths: weights .945, .133
        // and .028, whose mean vector is 1.0944 / 1.106 long.
        assert!((light.confidence - 0.9895).abs() < 5e-4, "{light:?}");
    }

    #[test]
    fn answers_that_are_not_finite_are_refused_with_a_remedy() {
        assert!(check_finite(&[crop(1.0, 0, 1.0)]).is_ok());
        let mut energies = crop(1.0, 0, 1.0);
        energies.energies[3] = f64::NAN;
        let mut encoder = crop(1.0, 0, 1.0);
        encoder.encoder.irradiance = f32::INFINITY;
        for damaged in [energies, encoder] {
            let error = check_finite(&[crop(1.0, 0, 1.0), damaged]).unwrap_err();
            assert!(
                error
                    .to_string()
                    .contains("crop 1 of the photograph is not a number")
            );
        }
    }

    #[test]
    fn crops_that_disagree_leave_doubt() {
        let light = combined(vec![crop(1.0, 1, 2.0), crop(4.0, 1, 2.0)], 0.0);
        // Two vectors of 2, 3 radians apart: 4 cos(1.5) = 0.283 is left; I1 / I0 of it.
        assert!((light.confidence - 0.140).abs() < 1e-3, "{light:?}");
        let with_encoder = combined(vec![crop(1.0, 1, 2.0), crop(4.0, 1, 2.0)], 8.0);
        // 8 towards 1.0 and 0.283 towards 2.5: 8.025 towards 1.035.
        assert!(
            (with_encoder.description.azimuth - 1.035).abs() < STEP,
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
            let light = combined(vec![crop(1.0, 0, depth), crop(4.0, 2, depth)], 0.0);
            let found = light.description;
            assert!(
                found.azimuth.is_finite() && found.elevation.is_finite(),
                "{depth}"
            );
            assert!(
                (0.0..=1.0).contains(&light.confidence),
                "{depth}: {light:?}"
            );
        }
        // Without crops only the encoder counts.
        let found = combined(vec![], 2.0).description;
        assert!(
            (found.azimuth - PRIOR.description.azimuth).abs() < STEP,
            "{found:?}"
        );
    }
}
