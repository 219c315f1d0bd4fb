//! Quality checks: how well a model recognises light, on scenes and shapes that training never shows.

use std::collections::BTreeMap;
use std::f32::consts::{FRAC_PI_4, PI, TAU};
use std::fmt;
use std::ops::ControlFlow;

use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_numerics::stats::median;
use dipir_prior::caption::{Caption, LightDescription};
use dipir_prior::encoder::LightEncoder;
use dipir_prior::energy::{Observation, TIMESTEP_SHARES, energies, prediction_difference};
use dipir_prior::inversion::{AZIMUTHS, angle_between, minimum_angle};
use dipir_prior::picture::{dilate, latents_of};
use dipir_prior::text_conditioning::{caption_states, guidance_states};
use half::f16;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::CameraResponse;
use crate::dataset::{RECORD_SIZE, RecordedScene};
use crate::direct_light::{DirectLightImages, Layer};
use crate::error::Result;
use crate::examples::object_mask;
use crate::lighting::{Sun, SunSkyLight};
use crate::scene::{Framing, GeneratedScene, ObjectSet, SceneKind, Setting};
use crate::shapes::Shape;
use crate::square_camera::SquareCamera;
use crate::window::{CroppedScene, Window};

/// Key of the scenes of the checks. Training has other keys.
pub const HELD_OUT_SEED: u64 = 0x6a7e5;
/// Offsets of the recorded suns from the true azimuth, degrees. The mirrored sun follows them.
const OFFSETS: [f32; 7] = [0.0, 25.0, 35.0, -25.0, -35.0, 45.0, -45.0];

/// How well the true azimuth is recognised among others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Recognition {
    /// Share of scenes in which the true light is preferred to the opposite one.
    pub over_opposite: f64,
    /// Share in which it is preferred to the mirrored one, which is close to it where the sun is ahead or behind.
    pub over_mirror: f64,
    /// Share in which it is preferred to lights 45 degrees off.
    pub over_45: f64,
    /// Median error of the best azimuth, degrees.
    pub azimuth_median: f64,
    /// Share of best azimuths within 30 degrees of the true one.
    pub within_30: f64,
}

/// Results of the checks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QualityReport {
    /// Number of scenes.
    pub scenes: usize,
    /// Share of cases in which LDS opposes a step from 25 degrees off to 35 degrees off.
    pub gradient_sign: f64,
    /// Recognition by the energies of the diffusion model.
    #[serde(flatten)]
    pub recognition: Recognition,
    /// Recognition by the light encoder on the same pictures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<Recognition>,
    /// The same by shape of the main object.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub by_shape: BTreeMap<String, QualityReport>,
}

/// A scene of the checks, recorded for a true sun and for others around it.
struct HeldOutScene {
    planes: Vec<f16>,
    shape: Shape,
    camera: SquareCamera,
    suns: Vec<Sun>,
    light: SunSkyLight,
}

impl HeldOutScene {
    /// The scene number `index`.
    fn draw(index: u64) -> Self {
        let mut scene = GeneratedScene::draw(
            HELD_OUT_SEED,
            index,
            RECORD_SIZE as u32,
            SceneKind {
                objects: ObjectSet::HeldOut,
                setting: Setting::Open,
                framing: Framing::Close,
            },
        );
        let mut stream = NoiseStream::new(HELD_OUT_SEED ^ 1, index);
        let sun = Sun {
            azimuth: stream.uniform() as f32 * TAU,
            elevation: (18.0 + 47.0 * stream.uniform() as f32).to_radians(),
            sharpness: scene.suns[0].sharpness,
        };
        let offsets = OFFSETS.map(|o| sun.azimuth + o.to_radians());
        scene.suns = offsets
            .into_iter()
            .chain([-sun.azimuth])
            .map(|azimuth| Sun { azimuth, ..sun })
            .collect();
        let images = DirectLightImages::trace(&scene, HELD_OUT_SEED, index);
        let share = 0.6 + 0.33 * stream.uniform() as f32;
        let total = PI * (0.5 + 0.5 * stream.uniform() as f32);
        let tints = (0.5 * stream.uniform() as f32, 0.5 * stream.uniform() as f32);
        let light = SunSkyLight::new(0, sun.elevation, (total, share), tints, 1.0);
        Self {
            planes: images.planes.iter().map(|&v| f16::from_f32(v)).collect(),
            shape: scene.shape,
            camera: scene.square_camera(),
            suns: scene.suns,
            light,
        }
    }

    fn cropped(&self, window: Window) -> CroppedScene<'_> {
        let scene = RecordedScene {
            planes: &self.planes,
            class: self.shape.word(),
            color: "white",
            camera: self.camera,
            suns: self.suns.clone(),
        };
        CroppedScene::new(scene, window)
    }

    /// The composite under the sun at `OFFSETS[sun]`, and its observation as in guidance.
    fn observe(
        &self,
        sun: usize,
        response: &CameraResponse,
        window: Window,
    ) -> Result<(Vec<f32>, Observation)> {
        let cropped = self.cropped(window);
        let light = SunSkyLight { sun, ..self.light };
        let mut image = cropped.composite(&self.light, &light);
        let mut clean = cropped.layer(Layer::Background, &self.light);
        response.apply(&mut image);
        response.apply(&mut clean);
        let object = object_mask(&cropped.coverage());
        let mask = dilate(&object, 1);
        let observation = Observation::new(&image, &clean, &mask, &object)?;
        Ok((image, observation))
    }

    fn description(&self, azimuth: f32) -> LightDescription {
        LightDescription {
            azimuth,
            ..self.light.describe(&self.suns)
        }
    }

    /// The caption that describes the sun at `azimuth`, for a picture seen through `window`.
    fn caption(&self, azimuth: f32, window: Window) -> Option<Caption> {
        let described = self
            .cropped(window)
            .seen_through_window(self.description(azimuth));
        Some(Caption::new(self.shape.word(), Some(&described)))
    }
}

/// Whether the true azimuth is preferred to others, and the error of the best one, in a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Preferences {
    opposite: bool,
    mirror: bool,
    beside: [bool; 2],
    azimuth_error: f64,
}

impl Preferences {
    /// Preferences that follow from an answer: of two azimuths the nearer one is preferred.
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

struct SceneResult {
    shape: Shape,
    signs: [bool; 2],
    model: Preferences,
    encoder: Option<Preferences>,
}

fn check_scene(
    (model, encoder): (&Model, Option<&LightEncoder>),
    index: u64,
    draws: usize,
    shares: &[f64],
) -> Result<SceneResult> {
    let held_out = HeldOutScene::draw(index);
    let mut stream = NoiseStream::new(HELD_OUT_SEED ^ 2, index);
    let response = CameraResponse {
        exposure: 1.0,
        shoulder: 0.5,
    };
    let truth = held_out.suns[0].azimuth;
    let around = (0..AZIMUTHS).map(|k| truth + TAU * k as f32 / AZIMUTHS as f32);
    let azimuths: Vec<f32> = around
        .chain([-truth, truth + FRAC_PI_4, truth - FRAC_PI_4])
        .collect();
    let mut e = vec![0f64; azimuths.len()];
    // Product of the gradient with a step away from the true sun: positive if LDS opposes the step.
    let mut against = [0f32; 2];
    for draw in 0..draws {
        let window = Window::of_draw(draw);
        let captions: Vec<_> = azimuths
            .iter()
            .map(|&a| held_out.caption(a, window))
            .collect();
        let contexts = caption_states(model, &captions)?;
        let (_, observation) = held_out.observe(0, &response, window)?;
        let found = energies(model, &observation, &contexts, shares, &mut stream)?;
        e.iter_mut().zip(found).for_each(|(e, f)| *e += f);
        let described = held_out
            .cropped(window)
            .seen_through_window(held_out.description(truth));
        let contexts = guidance_states(model, held_out.shape.word(), &described)?;
        for (against, (near, far)) in against.iter_mut().zip([(1, 2), (3, 4)]) {
            let (image, observation) = held_out.observe(near, &response, window)?;
            let (farther, _) = held_out.observe(far, &response, window)?;
            let step = (latents_of(farther)? - latents_of(image)?)?;
            let lds = prediction_difference(
                model,
                &observation,
                &contexts,
                &TIMESTEP_SHARES,
                &mut stream,
            )?;
            *against += (step * lds)?.sum_all()?.to_scalar::<f32>()?;
        }
    }
    let error = angle_between(minimum_angle(&e[..AZIMUTHS]), 0.0);
    let encoder = match encoder {
        Some(encoder) => {
            let (image, _) = held_out.observe(0, &response, Window::MIDDLE)?;
            let pitch = held_out.cropped(Window::MIDDLE).view_direction().pitch;
            let estimate = encoder.estimate(&image, pitch)?;
            Some(Preferences::by(estimate.description.azimuth, truth))
        }
        None => None,
    };
    Ok(SceneResult {
        shape: held_out.shape,
        signs: against.map(|a| a > 0.0),
        model: Preferences {
            opposite: e[0] < e[AZIMUTHS / 2],
            mirror: e[0] < e[AZIMUTHS],
            beside: [e[0] < e[AZIMUTHS + 1], e[0] < e[AZIMUTHS + 2]],
            azimuth_error: error.to_degrees() as f64,
        },
        encoder,
    })
}

/// Runs the checks on `scenes` scenes from number `first` on, with `draws` of noise at each timestep; every other draw
/// sees the mirror image. LDS is checked at [`TIMESTEP_SHARES`], energies at `shares` of the timesteps. `progress` is
/// called with the number of finished scenes and may stop the checks.
pub fn measure(
    model: &Model,
    encoder: Option<&LightEncoder>,
    first: u64,
    scenes: usize,
    draws: usize,
    shares: &[f64],
    progress: &(dyn Fn(usize) -> ControlFlow<()> + Sync),
) -> Result<QualityReport> {
    let done = std::sync::atomic::AtomicUsize::new(0);
    let answers: Vec<SceneResult> = (first..first.saturating_add(scenes as u64))
        .into_par_iter()
        .map(|i| {
            let answer = check_scene((model, encoder), i, draws, shares)?;
            let n = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            Ok((progress(n).is_continue()).then_some(answer))
        })
        .collect::<Result<Vec<Option<_>>>>()?
        .into_iter()
        .flatten()
        .collect();
    let mut by_shape: BTreeMap<String, Vec<&SceneResult>> = BTreeMap::new();
    for answer in &answers {
        let name = format!("{:?}", answer.shape).to_lowercase();
        by_shape.entry(name).or_default().push(answer);
    }
    let by_shape = by_shape.into_iter().map(|(k, v)| (k, summary(&v)));
    Ok(QualityReport {
        by_shape: by_shape.collect(),
        ..summary(&answers.iter().collect::<Vec<_>>())
    })
}

/// The report of some scenes.
fn summary(answers: &[&SceneResult]) -> QualityReport {
    let signs = answers.iter().flat_map(|a| a.signs);
    let encoder: Option<Vec<Preferences>> = answers.iter().map(|a| a.encoder).collect();
    QualityReport {
        scenes: answers.len(),
        gradient_sign: share(signs),
        recognition: recognition(&answers.iter().map(|a| a.model).collect::<Vec<_>>()),
        encoder: encoder.map(|of| recognition(&of)),
        by_shape: BTreeMap::new(),
    }
}

fn recognition(of: &[Preferences]) -> Recognition {
    let errors: Vec<f64> = of.iter().map(|t| t.azimuth_error).collect();
    Recognition {
        over_opposite: share(of.iter().map(|t| t.opposite)),
        over_mirror: share(of.iter().map(|t| t.mirror)),
        over_45: share(of.iter().flat_map(|t| t.beside)),
        azimuth_median: median(&errors).unwrap_or(f64::NAN),
        within_30: share(errors.iter().map(|e| *e <= 30.0)),
    }
}

/// The share of true values; 0 of none.
fn share(right: impl Iterator<Item = bool>) -> f64 {
    let (right, all) = right.fold((0usize, 0usize), |(r, n), x| (r + usize::from(x), n + 1));
    right as f64 / all.max(1) as f64
}

/// Rows of the table: what is checked, and the goal.
const ROWS: [(&str, &str); 8] = [
    ("check", "wanted"),
    ("scenes", ""),
    ("LDS 25 degrees off points back to the true azimuth", "97%"),
    ("true light preferred to the opposite one", "98%"),
    ("true light preferred to its image, left and right", "98%"),
    ("true light preferred to one 45 degrees off", "90%"),
    ("best azimuth from the true one, median, degrees", "10"),
    ("best azimuth within 30 degrees of the true one", ""),
];

/// A column of the table.
fn column(name: &str, scenes: usize, gradient: Option<f64>, of: &Recognition) -> [String; 8] {
    let percent = |share: f64| format!("{:.1}%", 100.0 * share);
    [
        name.to_owned(),
        scenes.to_string(),
        gradient.map_or_else(String::new, percent),
        percent(of.over_opposite),
        percent(of.over_mirror),
        percent(of.over_45),
        format!("{:.1}", of.azimuth_median),
        percent(of.within_30),
    ]
}

impl fmt::Display for QualityReport {
    /// A table with a row for every check.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of_report = |name: &str, report: &Self| {
            let gradient = Some(report.gradient_sign);
            column(name, report.scenes, gradient, &report.recognition)
        };
        let mut columns = vec![of_report("found", self)];
        columns.extend(self.by_shape.iter().map(|(k, v)| of_report(k, v)));
        let encoder = self.encoder.as_ref();
        columns.extend(encoder.map(|e| column("encoder", self.scenes, None, e)));
        for (i, (what, wanted)) in ROWS.iter().enumerate() {
            let values = columns.iter().map(|c| format!(" {:>8}", c[i]));
            let end = if i + 1 < ROWS.len() { "\n" } else { "" };
            write!(
                f,
                "{what:<51}{wanted:>7}{}{end}",
                values.collect::<String>()
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_azimuths_the_nearer_to_an_answer_is_preferred() {
        let preferences =
            |answer: f32, truth: f32| Preferences::by(answer.to_radians(), truth.to_radians());
        // 20 degrees off is less than half of 45, and of the 60 to the mirror image.
        let found = preferences(50.0, 30.0);
        assert!(found.opposite && found.mirror && found.beside == [true, true]);
        assert!((found.azimuth_error - 20.0).abs() < 1e-4, "{found:?}");
        // 25 degrees off: the light 45 degrees off on that side is nearer, the one on the other side is not.
        assert_eq!(preferences(55.0, 30.0).beside, [false, true]);
        // The mirror image, at 350 degrees, is nearer.
        let across = preferences(-4.0, 10.0);
        assert!(!across.mirror && across.opposite && (across.azimuth_error - 14.0).abs() < 1e-4);
        assert!(!preferences(200.0, 30.0).opposite);
    }

    #[test]
    fn the_median_of_two_errors_lies_between_them() {
        // Answers 10 and 30 degrees off.
        let found = [10f32, 30.0].map(|a| Preferences::by(a.to_radians(), 0.0));
        assert!((recognition(&found).azimuth_median - 20.0).abs() < 1e-4);
        assert!(recognition(&[]).azimuth_median.is_nan());
    }

    #[test]
    fn the_mirror_swaps_a_picture_and_its_caption() {
        let held_out = HeldOutScene::draw(2);
        let [plain, swapped] = [0, 1].map(Window::of_draw);
        let layer = |window| {
            held_out
                .cropped(window)
                .layer(Layer::Background, &held_out.light)
        };
        assert_eq!(
            layer(swapped),
            dipir_prior::picture::mirrored(&layer(plain))
        );
        assert_ne!(layer(swapped), layer(plain));
        let azimuth = held_out.suns[0].azimuth;
        assert_eq!(
            held_out.caption(azimuth, swapped),
            held_out.caption(-azimuth, plain)
        );
    }

    #[test]
    fn shadows_fall_away_from_the_sun() {
        // The sun is on the right, so the shadow is on the left.
        let mut scene = GeneratedScene::draw(
            3,
            1,
            RECORD_SIZE as u32,
            SceneKind {
                objects: ObjectSet::Training,
                setting: Setting::Open,
                framing: Framing::Close,
            },
        );
        for sun in &mut scene.suns {
            *sun = Sun {
                azimuth: PI / 2.0,
                elevation: 0.6,
                sharpness: 300.0,
            };
        }
        let images = DirectLightImages::trace(&scene, 1, 1);
        let n = RECORD_SIZE * RECORD_SIZE;
        let plane = crate::direct_light::FIRST_SHADOW_PLANE;
        let shadow = &images.planes[plane * n..][..n];
        let coverage = &images.planes[(crate::direct_light::PLANES - 1) * n..][..n];
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
