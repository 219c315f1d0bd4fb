//! What the model must be able to tell before it is trusted to guide,
//! measured on scenes and solids that training never showed.

use std::collections::BTreeMap;
use std::f32::consts::{FRAC_PI_4, PI, TAU};
use std::ops::ControlFlow;

use candle_core::Tensor;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use half::f16;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::dataset::{RECORD_SIZE, SceneView};
use crate::encoder::LightEncoder;
use crate::energy::{Observation, SHARES, difference, energies, guiding, states};
use crate::error::Result;
use crate::examples::{Example, Lens, Tone, Window, angle_between, dilate};
use crate::lights::{Light, Sun};
use crate::record::{Layer, Record};
use crate::shapes::Shape;
use crate::student::latents_of;
use crate::studio::{Brief, Kinds, Outlook, Setting, Stage, View};
use crate::words::{Caption, LightWords};

/// Key of the scenes on which gates are measured; training uses others.
pub const HELD_OUT_SEED: u64 = 0x6a7e5;
/// Azimuths of the search.
const AZIMUTHS: usize = 16;
/// Offsets from the true azimuth that every scene is recorded for, degrees;
/// the mirror image is the last.
const OFFSETS: [f32; 7] = [0.0, 25.0, 35.0, -25.0, -35.0, 45.0, -45.0];

/// How well the true azimuth is told from others: shares of right answers and an error, over scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Recognition {
    /// The true light explains the picture better than the opposite one.
    pub over_opposite: f64,
    /// ... than its image in the mirror that swaps left and right, which is next to it where the sun is
    /// straight ahead or behind.
    pub over_mirror: f64,
    /// ... than a light 45 degrees off.
    pub over_45: f64,
    /// Median distance of the best azimuth from the true one, degrees.
    pub azimuth_median: f64,
    /// Share of best azimuths within 30 degrees.
    pub within_30: f64,
}

/// What a model can tell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Gates {
    /// Scenes that were looked at.
    pub scenes: usize,
    /// LDS 25 degrees off the truth points back to it.
    pub gradient_sign: f64,
    /// What the model's errors tell.
    #[serde(flatten)]
    pub recognition: Recognition,
    /// What the light encoder reads off the same pictures, without noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<Recognition>,
    /// The same for each solid that is inserted, by its name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub by_shape: BTreeMap<String, Gates>,
}

/// A scene recorded for a true sun and others around it.
pub struct Trial {
    planes: Vec<f16>,
    shape: Shape,
    outlook: Outlook,
    suns: Vec<Sun>,
    light: Light,
}

impl Trial {
    /// Trial number `index`.
    pub fn draw(index: u64) -> Self {
        let mut stage = Stage::draw(
            HELD_OUT_SEED,
            index,
            RECORD_SIZE as u32,
            Brief {
                kinds: Kinds::HeldOut,
                setting: Setting::Open,
                view: View::Close,
            },
        );
        let mut stream = NoiseStream::new(HELD_OUT_SEED ^ 1, index);
        let sun = Sun {
            azimuth: stream.uniform() as f32 * TAU,
            elevation: (18.0 + 47.0 * stream.uniform() as f32).to_radians(),
            sharpness: stage.suns[0].sharpness,
        };
        let offsets = OFFSETS.map(|o| sun.azimuth + o.to_radians());
        stage.suns = offsets
            .into_iter()
            .chain([-sun.azimuth])
            .map(|azimuth| Sun { azimuth, ..sun })
            .collect();
        let record = Record::trace(&stage, HELD_OUT_SEED, index);
        let share = 0.6 + 0.33 * stream.uniform() as f32;
        let total = PI * (0.5 + 0.5 * stream.uniform() as f32);
        let tints = (0.5 * stream.uniform() as f32, 0.5 * stream.uniform() as f32);
        let light = Light::new(0, sun.elevation, (total, share), tints, 1.0);
        Self {
            planes: record.planes.iter().map(|&v| f16::from_f32(v)).collect(),
            shape: stage.shape,
            outlook: stage.outlook(),
            suns: stage.suns,
            light,
        }
    }

    fn lens(&self, window: Window) -> Lens<'_> {
        let scene = SceneView {
            planes: &self.planes,
            class: self.shape.word(),
            color: "white",
            outlook: self.outlook,
            suns: self.suns.clone(),
        };
        Lens::new(scene, window)
    }

    /// The composite under the sun at `OFFSETS[sun]`, seen as in guidance.
    fn observe(&self, sun: usize, tone: &Tone, window: Window) -> Result<(Vec<f32>, Observation)> {
        let lens = self.lens(window);
        let light = Light { sun, ..self.light };
        let mut image = lens.composite(&self.light, &light);
        let mut clean = lens.layer(Layer::Background, &self.light);
        tone.apply(&mut image);
        tone.apply(&mut clean);
        let hard: Vec<f32> = lens
            .coverage()
            .iter()
            .map(|&c| f32::from(c > 0.02))
            .collect();
        let mask = dilate(&hard, 1);
        let observation = Observation::new(&image, &clean, &mask, &hard)?;
        Ok((image, observation))
    }

    fn words(&self, azimuth: f32) -> LightWords {
        LightWords {
            azimuth,
            ..self.light.words(&self.suns)
        }
    }

    /// The caption that names the sun at `azimuth`, for a picture seen through `window`.
    fn caption(&self, azimuth: f32, window: Window) -> Option<Caption> {
        let words = self.lens(window).words(self.words(azimuth));
        Some(Caption::new(self.shape.word(), Some(&words)))
    }
}

/// Which other azimuths are told from the true one in a scene, and how far off the best is.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Told {
    opposite: bool,
    mirror: bool,
    beside: [bool; 2],
    azimuth_error: f64,
}

impl Told {
    /// By an answer: of two azimuths the nearer one is preferred.
    fn by(answer: f32, truth: f32) -> Self {
        let error = angle_between(answer, truth);
        let nearer = |than: f32| error < angle_between(answer, than);
        Self {
            opposite: nearer(truth + PI),
            mirror: nearer(-truth),
            beside: [FRAC_PI_4, -FRAC_PI_4].map(|d| nearer(truth + d)),
            azimuth_error: f64::from(error.to_degrees()),
        }
    }
}

struct Answer {
    shape: Shape,
    signs: [bool; 2],
    model: Told,
    encoder: Option<Told>,
}

fn ask(
    (model, encoder): (&Model, Option<&LightEncoder>),
    index: u64,
    draws: usize,
    told_at: &[f64],
) -> Result<Answer> {
    let trial = Trial::draw(index);
    let mut stream = NoiseStream::new(HELD_OUT_SEED ^ 2, index);
    let tone = Tone {
        exposure: 1.0,
        shoulder: 0.5,
    };
    let truth = trial.suns[0].azimuth;
    let around = (0..AZIMUTHS).map(|k| truth + TAU * k as f32 / AZIMUTHS as f32);
    let azimuths: Vec<f32> = around
        .chain([-truth, truth + FRAC_PI_4, truth - FRAC_PI_4])
        .collect();
    let mut e = vec![0f64; azimuths.len()];
    // How far going further away goes against what LDS asks for.
    let mut against = [0f32; 2];
    for draw in 0..draws {
        let window = Window::of_draw(draw);
        let captions: Vec<_> = azimuths.iter().map(|&a| trial.caption(a, window)).collect();
        let asked = states(model, &captions)?;
        let (_, observation) = trial.observe(0, &tone, window)?;
        let found = energies(model, &observation, &asked, told_at, &mut stream)?;
        e.iter_mut().zip(found).for_each(|(e, f)| *e += f);
        let words = trial.lens(window).words(trial.words(truth));
        let contexts = guiding(model, trial.shape.word(), &words)?;
        for (against, (near, far)) in against.iter_mut().zip([(1, 2), (3, 4)]) {
            let (image, observation) = trial.observe(near, &tone, window)?;
            let (further, _) = trial.observe(far, &tone, window)?;
            let step = (latents_of(further)? - latents_of(image)?)?;
            let lds = difference(model, &observation, &contexts, &SHARES, &mut stream)?;
            *against += (step * lds)?.sum_all()?.to_scalar::<f32>()?;
        }
    }
    let best = minimum_around(&e[..AZIMUTHS]);
    let encoder = match encoder {
        Some(encoder) => {
            let (image, _) = trial.observe(0, &tone, Window::MIDDLE)?;
            let pitch = trial.lens(Window::MIDDLE).gaze().pitch;
            let read = encoder.estimate(&image, pitch)?;
            Some(Told::by(read.words.azimuth, truth))
        }
        None => None,
    };
    Ok(Answer {
        shape: trial.shape,
        signs: against.map(|a| a > 0.0),
        model: Told {
            opposite: e[0] < e[AZIMUTHS / 2],
            mirror: e[0] < e[AZIMUTHS],
            beside: [e[0] < e[AZIMUTHS + 1], e[0] < e[AZIMUTHS + 2]],
            azimuth_error: best.to_degrees() as f64,
        },
        encoder,
    })
}

/// Where a function on evenly spaced angles, the first of them 0, has its
/// minimum: the first four harmonics on a fine grid. The distance from 0.
fn minimum_around(values: &[f64]) -> f32 {
    let angle = minimum_angle(values);
    angle_between(angle, 0.0)
}

/// The angle of the minimum of samples at 2 pi k / n, smoothed to four
/// harmonics.
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

/// Measures the gates on `scenes` scenes from number `first` on with `draws` of noise at each
/// timestep, every other of them seen in the mirror: the timesteps of [`SHARES`] for LDS, those of `told_at`, shares of all,
/// for what explains the picture. `progress` is told how many are done and may stop.
pub fn measure(
    model: &Model,
    encoder: Option<&LightEncoder>,
    first: u64,
    scenes: usize,
    draws: usize,
    told_at: &[f64],
    progress: &(dyn Fn(usize) -> ControlFlow<()> + Sync),
) -> Result<Gates> {
    let done = std::sync::atomic::AtomicUsize::new(0);
    let answers: Vec<Answer> = (first..first.saturating_add(scenes as u64))
        .into_par_iter()
        .map(|i| {
            let answer = ask((model, encoder), i, draws, told_at)?;
            let n = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            Ok((progress(n).is_continue()).then_some(answer))
        })
        .collect::<Result<Vec<Option<_>>>>()?
        .into_iter()
        .flatten()
        .collect();
    let mut by_shape: BTreeMap<String, Vec<&Answer>> = BTreeMap::new();
    for answer in &answers {
        let name = format!("{:?}", answer.shape).to_lowercase();
        by_shape.entry(name).or_default().push(answer);
    }
    let by_shape = by_shape.into_iter().map(|(k, v)| (k, summary(&v)));
    Ok(Gates {
        by_shape: by_shape.collect(),
        ..summary(&answers.iter().collect::<Vec<_>>())
    })
}

/// Shares and medians of some answers.
fn summary(answers: &[&Answer]) -> Gates {
    let signs = answers.iter().flat_map(|a| a.signs);
    let encoder: Option<Vec<Told>> = answers.iter().map(|a| a.encoder).collect();
    Gates {
        scenes: answers.len(),
        gradient_sign: share(signs),
        recognition: recognition(&answers.iter().map(|a| a.model).collect::<Vec<_>>()),
        encoder: encoder.map(|told| recognition(&told)),
        by_shape: BTreeMap::new(),
    }
}

fn recognition(told: &[Told]) -> Recognition {
    let mut errors: Vec<f64> = told.iter().map(|t| t.azimuth_error).collect();
    errors.sort_by(f64::total_cmp);
    Recognition {
        over_opposite: share(told.iter().map(|t| t.opposite)),
        over_mirror: share(told.iter().map(|t| t.mirror)),
        over_45: share(told.iter().flat_map(|t| t.beside)),
        azimuth_median: errors.get(told.len() / 2).copied().unwrap_or(f64::NAN),
        within_30: share(errors.iter().map(|e| *e <= 30.0)),
    }
}

/// The share that is right; 0 of nothing.
fn share(right: impl Iterator<Item = bool>) -> f64 {
    let (right, all) = right.fold((0usize, 0usize), |(r, n), x| (r + usize::from(x), n + 1));
    right as f64 / all.max(1) as f64
}

/// An example as it would be trained on, for pictures of the data.
pub fn show(scene: SceneView<'_>, stream: &mut NoiseStream) -> Example {
    Example::draw(scene, &crate::examples::Recipe::default(), stream)
}

/// Latents as pictures [3, SIZE, SIZE] in [0, 1], for contact sheets.
pub fn picture_of(latents: &Tensor) -> Result<Vec<f32>> {
    let x = (latents / crate::blueprint::SCALING)?;
    let x = dipir_diffusion::vae::pixel_shuffle(&x, crate::blueprint::FACTOR)?;
    Ok(x.affine(0.5, 0.5)?
        .clamp(0.0, 1.0)?
        .flatten_all()?
        .to_vec1()?)
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

    #[test]
    fn of_two_azimuths_the_nearer_to_an_answer_is_preferred() {
        let told = |answer: f32, truth: f32| Told::by(answer.to_radians(), truth.to_radians());
        // 20 degrees off: less than half of 45 to one side, and of the 60 to the mirror image.
        let found = told(50.0, 30.0);
        assert!(found.opposite && found.mirror && found.beside == [true, true]);
        assert!((found.azimuth_error - 20.0).abs() < 1e-4, "{found:?}");
        // 25 degrees beyond: the light 45 degrees further is nearer, the one before is not.
        assert_eq!(told(55.0, 30.0).beside, [false, true]);
        // Across the sun straight ahead: the mirror image is nearer, at 350 degrees.
        let across = told(-4.0, 10.0);
        assert!(!across.mirror && across.opposite && (across.azimuth_error - 14.0).abs() < 1e-4);
        assert!(!told(200.0, 30.0).opposite);
    }

    #[test]
    fn the_mirror_swaps_a_picture_and_its_caption() {
        let trial = Trial::draw(2);
        let [plain, swapped] = [0, 1].map(Window::of_draw);
        let layer = |window| trial.lens(window).layer(Layer::Background, &trial.light);
        assert_eq!(layer(swapped), crate::examples::mirrored(&layer(plain)));
        assert_ne!(layer(swapped), layer(plain));
        let azimuth = trial.suns[0].azimuth;
        assert_eq!(
            trial.caption(azimuth, swapped),
            trial.caption(-azimuth, plain)
        );
    }

    #[test]
    fn shadows_fall_away_from_the_sun() {
        // The sun from the right: the shadow darkens the ground on the left.
        let mut stage = Stage::draw(
            3,
            1,
            RECORD_SIZE as u32,
            Brief {
                kinds: Kinds::Trained,
                setting: Setting::Open,
                view: View::Close,
            },
        );
        for sun in &mut stage.suns {
            *sun = Sun {
                azimuth: PI / 2.0,
                elevation: 0.6,
                sharpness: 300.0,
            };
        }
        let record = Record::trace(&stage, 1, 1);
        let n = RECORD_SIZE * RECORD_SIZE;
        let plane = 9 * crate::record::BASIS;
        let shadow = &record.planes[plane * n..][..n];
        let coverage = &record.planes[(crate::record::PLANES - 1) * n..][..n];
        let mean_x = |w: &dyn Fn(usize) -> f32| {
            let total: f32 = (0..n).map(w).sum();
            (0..n).map(|i| w(i) * (i % RECORD_SIZE) as f32).sum::<f32>() / total
        };
        let shade = mean_x(&|i| (1.0 - shadow[i]).max(0.0));
        let object = mean_x(&|i| coverage[i]);
        assert!(
            shade < object - 1.0,
            "shadow at {shade}, object at {object}"
        );
    }
}
