//! The recovery of light: everything between a recorded scene and the light that explains it.
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use dipir_diffusion::model::Model;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::gaussian::SphericalGaussian;
use dipir_optimize::crop::{Framing, USUAL_SCALE, bounding_box};
use dipir_optimize::guidance::{Guidance, Reference, rmse, touched};
use dipir_optimize::objective::Objective;
use dipir_optimize::optimization::{self, Optimization, Outcome};
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::recorder::SceneRecorder;
use dipir_optimize::settings::Settings;
use dipir_prior::inversion::{InversionSettings, Reading};
use dipir_render::render::Renderer;
use dipir_render::transport::{RecordSettings, Transport};

use crate::distillation::{Adapter, Distillation, DistillationSettings};
use crate::error::{Error, Result};
use crate::reading::{self, Insertion, read_light, view_direction};
use crate::timed::Timed;

/// Side of the crops of a reference, pixels, when it is compared on crops.
const CROP_SIDE: usize = 128;

/// A scene whose light is to be recovered.
pub struct Problem<'a> {
    /// The scene, seen at the size at which light is recovered.
    pub renderer: &'a Renderer<'a>,
    /// How light reaches that picture.
    pub transport: Transport,
    /// How transport is recorded anew when the light differs too much from the recorded one.
    pub record: RecordSettings<'a>,
    /// The photograph at that size.
    pub background: &'a LinearImage,
    /// How the photograph is encoded.
    pub transfer: Transfer,
    /// The settings of `[light]`.
    pub settings: &'a Settings,
    /// The light to start from; without it, the light that is read off the photograph, or neutral
    /// light.
    pub start: Option<&'a [SphericalGaussian]>,
    /// Where the state is kept between iterations, and resumed from.
    pub checkpoint: Option<&'a Path>,
}

/// What the composite should look like.
pub enum Target<'a> {
    /// A picture of the photograph's size at which light is recovered.
    Reference(&'a DisplayImage),
    /// What a diffusion model asks for.
    Model(ModelGuidance<'a>),
}

/// A diffusion model and how it is used.
pub struct ModelGuidance<'a> {
    /// The model.
    pub model: &'a Model,
    /// Its LoRA, if one is used.
    pub adapter: Option<&'a Adapter>,
    /// How it guides.
    pub settings: &'a DistillationSettings,
    /// What the object is called.
    pub class: &'a str,
    /// How the model reads light off the photograph; `None` if it cannot or should not.
    pub reading: Option<&'a InversionSettings>,
}

/// What `watch` gets while light is recovered.
#[derive(Debug)]
pub enum Event<'a> {
    /// Light is being read off the photograph; the share that is done.
    Reading(f64),
    /// Light transport is being recorded anew.
    Recording,
    /// The optimisation starts here, or goes on from the checkpoint.
    Start(&'a Parameters),
    /// An event of the optimisation.
    Optimization(optimization::Event<'a>),
}

/// What was recovered.
pub struct Recovery {
    /// Light, tone curves, picture and history.
    pub outcome: Outcome,
    /// What was read off the photograph, if anything was.
    pub reading: Option<Reading>,
    /// Display-referred RMSE against the reference, over what the object or its shadow touches.
    pub rmse: Option<f64>,
    /// Seconds of reading.
    pub reading_s: f64,
    /// Seconds of the optimisation.
    pub optimization_s: f64,
    /// Those of them that model or reference took.
    pub guidance_s: f64,
    /// Those of them in which transport was recorded anew.
    pub records_s: f64,
}

/// Recovers the light and the tone curves under which the composite fits the target.
///
/// The same problem gives the same light, for any number of threads and of interruptions.
///
/// # Errors
/// Those of model and optimisation; [`Error::Interrupted`] if `watch` stopped the work. The state is in
/// the checkpoint then.
pub fn recover_light(
    problem: Problem,
    target: &Target,
    watch: &(dyn Fn(Event) -> ControlFlow<()> + Sync),
) -> Result<Recovery> {
    let settings = problem.settings;
    let neutral = Parameters::neutral(settings.lobes, ambient_of(problem.background));
    let coverage = problem.transport.coverage().clone();
    let objective = Objective::new(
        Box::new(problem.transport),
        problem.background.clone(),
        problem.transfer,
        settings.weights(),
    )?;
    let mask = touched(&objective);
    let shown = problem.transfer.encode(problem.background);

    let clock = Instant::now();
    let reading = match target {
        Target::Model(model) => read(model, &shown, problem.renderer, &coverage, settings, watch)?,
        Target::Reference(_) => None,
    };
    let reading_s = clock.elapsed().as_secs_f64();
    let camera = problem.renderer.camera();
    let start = match (problem.start, &reading) {
        (Some(lobes), _) => Parameters::of_lobes(lobes),
        (None, Some(reading)) => reading::start(&reading.light, camera, settings.lobes),
        (None, None) => neutral,
    };
    if watch(Event::Start(&start)).is_break() {
        return Err(Error::Interrupted);
    }

    let guidance: Box<dyn Guidance> = match target {
        Target::Reference(reference) => {
            let framing = match settings.crops {
                true => Framing::Crops {
                    side: CROP_SIDE,
                    scale: USUAL_SCALE,
                },
                false => Framing::Whole,
            };
            Box::new(Reference::new((*reference).clone(), &objective, framing)?)
        }
        Target::Model(model) => {
            // An inpainting model paints the object alone where the light is read: it sees the
            // ground on which the shadow will fall.
            let paint = if reading.is_some() { &coverage } else { &mask };
            let seen = reading.as_ref().zip(bounding_box(&coverage));
            let seen = seen.map(|(r, object)| {
                r.light
                    .description
                    .seen_from(view_direction(camera, object).heading)
            });
            Box::new(Distillation::new(
                model.model,
                model.settings.clone(),
                model.adapter,
                model.class,
                seen.as_ref(),
                &shown,
                paint,
            )?)
        }
    };
    let mut go_on = |_: f64| watch(Event::Recording);
    let mut guidance = Timed::new(guidance);
    let mut recorder = Timed::new(SceneRecorder {
        renderer: problem.renderer,
        settings: problem.record,
        progress: &mut go_on,
    });
    let clock = Instant::now();
    let outcome = Optimization {
        objective,
        guidance: &mut guidance,
        recorder: Some(&mut recorder),
        settings: settings.clone(),
        start,
        checkpoint: problem.checkpoint,
    }
    .run(&mut |event| watch(Event::Optimization(event)))?;
    let rmse = match target {
        Target::Reference(reference) => Some(rmse(&outcome.picture, reference, &mask)),
        Target::Model(_) => None,
    };
    Ok(Recovery {
        outcome,
        reading,
        rmse,
        reading_s,
        optimization_s: clock.elapsed().as_secs_f64(),
        guidance_s: guidance.seconds,
        records_s: recorder.seconds,
    })
}

/// The light that the model reads off the photograph; `None` if it should not read.
fn read(
    model: &ModelGuidance,
    photo: &DisplayImage,
    renderer: &Renderer,
    coverage: &Raster<f32>,
    settings: &Settings,
    watch: &(dyn Fn(Event) -> ControlFlow<()> + Sync),
) -> Result<Option<Reading>> {
    let Some(how) = model.reading else {
        return Ok(None);
    };
    let object = bounding_box(coverage).ok_or(Error::NothingToSee)?;
    let place = Insertion {
        camera: renderer.camera(),
        proxy: &renderer.scene().proxy,
        object,
    };
    let report = |share: f64| watch(Event::Reading(share));
    read_light(model.model, photo, &place, how, settings.seed, &report)
}
