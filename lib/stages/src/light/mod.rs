//! The light stage: estimates the light of the photograph, or recovers light and tone curves under
//! which the object looks as the guidance asks.
pub mod at_hand;
mod candidates;
mod done;
mod estimate;
pub(crate) mod exposed;
pub mod folder;
pub mod forecast;
pub mod materials;
pub(crate) mod method;
pub(crate) mod request;
mod resume;
mod surroundings;
mod views;
mod words;

pub use method::idle_guidance;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

use anyhow::Context;
use dipir_cli::interrupt::Interrupted;
use dipir_cli::progress::Progress;
use dipir_cli::session::Session;
use dipir_guidance::distillation::Adapter;
use dipir_guidance::recover::{Event, ModelGuidance, Problem, Recovery, Target, recover_light};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::DisplayImage;
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::SphericalGaussian;
use dipir_optimize::history::Row;
use dipir_optimize::lighting::Lighting;
use dipir_optimize::optimization;
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::settings::{Settings, Start};
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use dipir_prior::inversion::Reading;
use dipir_render::render::Renderer;
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::camera::Camera;
use serde_json::Value;

use crate::light::estimate::Estimated;
use crate::light::forecast::light_run;
use crate::light::request::{First, Guide, Request, first_light, read_reference};
use crate::light::resume::{Resume, fingerprint};
use crate::light::surroundings::{map_of, narrow_first, surroundings};
use crate::model::{self, Loaded};
use crate::names::{LIGHT, LORA, begin};
use crate::presets::Outlook;
use crate::scene::folder::{self as scene_folder, SceneFolder};
use crate::scene::transport::{self, Frame};
use crate::{interruption, lora, upstream};

pub(crate) use words::{percent, quantities};

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    found: Found,
    /// Whether it is the light of a neutral start.
    is_neutral: bool,
    /// The iterations that were asked for, where a time budget decided how many were run.
    wanted: Option<usize>,
    /// The camera of the picture that the light was recovered on.
    camera: Camera,
    resumed_at: usize,
    /// What other presets would have taken; empty for a run that went on from a checkpoint.
    outlook: Outlook,
}

/// What the stage reads.
struct Inputs {
    scene: SceneFolder,
    /// The picture at the size at which light is recovered.
    frame: Frame,
    /// The light of `[light] start`, if that is a file.
    first: Option<Lighting>,
    /// With `guidance = "reference"`.
    reference: Option<DisplayImage>,
}

impl Inputs {
    fn read(session: &Session, request: &Request) -> anyhow::Result<Self> {
        let first = first_light(session, &request.table)?;
        let scene = SceneFolder::read(session)?;
        let frame = Frame::new(&scene.loaded, request.settings.size);
        let reference = match &request.guide {
            Guide::Reference { file, .. } => Some(read_reference(session, &scene, &frame, file)?),
            Guide::Model { .. } | Guide::None => None,
        };
        Ok(Self {
            scene,
            frame,
            first,
            reference,
        })
    }
}

/// The loaded model, if one guides.
struct Model {
    loaded: Loaded,
    adapter: Option<Adapter>,
}

impl Model {
    fn load(session: &Session, guide: &Guide) -> anyhow::Result<Option<Self>> {
        let Guide::Model {
            table,
            settings,
            reading,
            ..
        } = guide
        else {
            return Ok(None);
        };
        let mut loaded = model::load(session, table)?;
        if settings.adapt {
            let now = lora::plan_with(session, false)?;
            upstream::warn_of_other_settings(session, &LORA, "the LoRA was", &now);
        }
        let adapter = settings
            .adapt
            .then(|| lora::folder::read(session, &mut loaded))
            .transpose()?;
        if reading.is_some() {
            dipir_prior::text_conditioning::add_placeholders(&mut loaded.tokenizer);
        }
        Ok(Some(Self { loaded, adapter }))
    }
}

/// Runs the stage.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let clock = Instant::now();
    let request = Request::of(session)?;
    let inputs = Inputs::read(session, &request)?;
    let plan = plan(session)?;
    let fingerprint = fingerprint(&plan, &request.settings)?;
    let reading = clock.elapsed();
    let mut writer = begin(session, plan)?;
    writer.add_time(reading);
    let clock = Instant::now();
    let estimated = match request.start {
        First::Estimated => {
            let (loaded, lobes) = (&inputs.scene.loaded, request.settings.lobes);
            Some(estimate::estimate(session, &request.table, loaded, lobes)?)
        }
        _ => None,
    };
    writer.set_timing("estimate", clock.elapsed().as_secs_f64());
    let (found, resumed_at, resume) = match &request.guide {
        Guide::None => (start_alone(&request, &inputs, estimated.as_ref()), 0, None),
        _ => {
            let resume = Resume::open(session, &fingerprint)?;
            let start = estimated.as_ref().map(|e| e.lobes.as_slice());
            let (recovery, at) = recover(session, &request, &inputs, start, &resume, &mut writer)?;
            (Found::of(recovery), at, Some(resume))
        }
    };
    let found = found.with_surroundings(&request, &inputs, estimated);
    write_results(&request.settings, &found, resume.as_ref(), &mut writer)?;
    if let Some(estimated) = &found.estimated {
        let (loaded, simulation) = (&inputs.scene.loaded, inputs.scene.effects.simulation());
        let visible = request.shows_visible();
        let sheet = candidates::sheet(loaded, &simulation, estimated, visible)?;
        write_png(writer.output("candidates_sheet", "candidates.png")?, &sheet)?;
    }
    let manifest = writer.finish_and(|| resume.iter().for_each(Resume::remove))?;
    let budget = request.settings.time_budget_s;
    let outlook = match (resumed_at, &request.guide) {
        (0, Guide::Reference { .. } | Guide::Model { .. }) if budget.is_none() => {
            let resolution = inputs.scene.loaded.scene.camera.resolution;
            light_run(resolution, &request.settings, &request.guide, &manifest)
                .outlook(session.pipeline.quality, &request.table)
        }
        _ => Outlook::default(),
    };
    Ok(Done {
        folder: LIGHT.folder(session),
        manifest,
        is_neutral: request.start == First::Neutral
            && found.history.is_empty()
            && found.surroundings.is_none(),
        found,
        wanted: budget.map(|_| request.settings.iterations),
        camera: inputs.frame.camera,
        resumed_at,
        outlook,
    })
}

/// The light that was found, and how.
struct Found {
    lighting: Lighting,
    tone: ToneCurves,
    history: Vec<Row>,
    stopped_early: bool,
    /// What the guiding model read off the photograph.
    reading: Option<Reading>,
    /// Display-referred RMSE against the reference.
    rmse: Option<f64>,
    /// What the estimator said of the photograph.
    estimated: Option<Estimated>,
    /// The light without its sources, the first lobes, where it is traced as a map.
    surroundings: Option<EnvironmentMap>,
}

impl Found {
    fn of(recovery: Recovery) -> Self {
        let outcome = recovery.outcome;
        Self {
            lighting: outcome.lighting,
            tone: outcome.tone,
            history: outcome.history,
            stopped_early: outcome.stopped_early,
            reading: recovery.reading,
            rmse: recovery.rmse,
            estimated: None,
            surroundings: None,
        }
    }

    /// Steps that were skipped because something was not finite.
    fn skipped(&self) -> usize {
        self.history.iter().filter(|r| r.skipped.is_some()).count()
    }

    /// With the map of the surroundings, where one is traced.
    fn with_surroundings(
        mut self,
        request: &Request,
        inputs: &Inputs,
        estimated: Option<Estimated>,
    ) -> Self {
        let loaded = &inputs.scene.loaded;
        let visible = request.shows_visible();
        let as_estimated = estimated
            .as_ref()
            .filter(|_| matches!(request.guide, Guide::None));
        let smooth = match as_estimated {
            Some(e) => {
                self.lighting.sources = e.sources;
                Some(e.smooth.clone())
            }
            None => visible.then(|| {
                let (lobes, sources) = narrow_first(&self.lighting.exposed_lobes());
                let smooth = map_of(&lobes[sources..]);
                self.lighting.lobes = lobes;
                self.lighting.exposure = 1.0;
                self.lighting.sources = sources;
                smooth
            }),
        };
        let others = estimated.as_ref().map_or(&[][..], |e| &e.seen);
        self.surroundings = smooth.map(|light| surroundings(loaded, others, &light, visible));
        self.estimated = estimated;
        self
    }
}

/// The light where nothing guides: the start itself.
fn start_alone(request: &Request, inputs: &Inputs, estimated: Option<&Estimated>) -> Found {
    let lighting = match (&inputs.first, estimated) {
        (Some(light), _) => light.clone(),
        (None, Some(estimated)) => Lighting::of_lobes(estimated.lobes.clone()),
        (None, None) => {
            let ambient = ambient_of(&inputs.frame.background);
            let neutral = Parameters::neutral(request.settings.lobes, ambient);
            Lighting::of_lobes(neutral.foreground_lobes())
        }
    };
    Found {
        lighting,
        tone: ToneCurves::identity(),
        history: vec![],
        stopped_early: false,
        reading: None,
        rmse: None,
        estimated: None,
        surroundings: None,
    }
}

/// Recovers light and tone curves, and returns the iteration at which it went on.
fn recover(
    session: &Session,
    request: &Request,
    inputs: &Inputs,
    start: Option<&[SphericalGaussian]>,
    resume: &Resume,
    writer: &mut StageWriter,
) -> anyhow::Result<(Recovery, usize)> {
    let (settings, frame, loaded) = (&request.settings, &inputs.frame, &inputs.scene.loaded);
    let simulation = inputs.scene.effects.simulation();
    let renderer = Renderer::new(&loaded.scene).with_camera(frame.camera);
    let hash = transport::scene_hash(loaded, &simulation)?;
    let record = frame.record_settings(settings, simulation, hash);
    let clock = Instant::now();
    let recorded = recorded(session, &inputs.scene, &renderer, &record)?;
    writer.set_timing("transport", clock.elapsed().as_secs_f64());
    let clock = Instant::now();
    let model = Model::load(session, &request.guide)?;
    let loading_s = clock.elapsed().as_secs_f64();
    let target = match (&request.guide, &model, &inputs.reference) {
        (
            Guide::Model {
                settings,
                class,
                reading,
                ..
            },
            Some(model),
            _,
        ) => Target::Model(ModelGuidance {
            model: &model.loaded,
            adapter: model.adapter.as_ref(),
            settings,
            class,
            reading: reading.as_ref(),
        }),
        (_, _, Some(reference)) => Target::Reference(reference),
        _ => anyhow::bail!("neither model nor reference was read"),
    };
    let first = inputs.first.as_ref().map(Lighting::exposed_lobes);
    let checkpoint = resume.checkpoint();
    let problem = Problem {
        renderer: &renderer,
        transport: recorded,
        record,
        background: &frame.background,
        transfer: loaded.photo.transfer,
        settings,
        start: first.as_deref().or(start),
        checkpoint: Some(&checkpoint),
    };
    let (recovery, resumed_at) = follow(session, settings, resume, |watch| {
        recover_light(problem, &target, watch)
    })?;
    writer.set_timing("reading", loading_s + recovery.reading_s);
    writer.set_timing("optimization", recovery.optimization_s);
    writer.set_timing("guidance", recovery.guidance_s);
    writer.set_timing("records", recovery.records_s);
    Ok((recovery, resumed_at))
}

/// What a run would be, from the configuration and the manifests of the stages that it reads.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let request = Request::of(session)?;
    let mut plan = LIGHT.plan(session, request.params());
    let scene = scene_folder::manifest(session)?;
    scene_folder::add_inputs(&mut plan, &scene, &["scene", "effects"])?;
    match &request.guide {
        Guide::None => {}
        Guide::Reference { path, file } => plan.input("reference", path, file)?,
        Guide::Model {
            table, settings, ..
        } => {
            plan.device = session.pipeline.device.clone();
            model::inputs(session, table, &mut plan)?;
            if settings.adapt {
                lora::folder::add_inputs(session, &mut plan)?;
            }
        }
    }
    views::add_inputs(session, &request.views, &mut plan)?;
    if let Start::File(path) = &request.table.start {
        plan.input("start", path, &session.resolve(path))?;
    }
    Ok(plan)
}

/// The scene stage's record if it was made for these settings, else a new one.
fn recorded(
    session: &Session,
    scene: &SceneFolder,
    renderer: &Renderer,
    settings: &RecordSettings,
) -> anyhow::Result<Transport> {
    let listed = scene.manifest.outputs.iter();
    if listed.into_iter().any(|o| o.role == transport::ROLE) {
        let path = scene.manifest.output(&scene.folder, transport::ROLE)?;
        let found = Transport::load(path)?;
        if transport::is_current(&found, settings, renderer.camera()) {
            return Ok(found);
        }
        session.remark(|| "the scene's record was made with other settings: recording anew".into());
    }
    transport::record(session, renderer, settings)
}

/// Runs `recover` with progress bars, keeps its previews, and returns the iteration at which it went on.
fn follow(
    session: &Session,
    settings: &Settings,
    resume: &Resume,
    recover: impl FnOnce(&(dyn Fn(Event) -> ControlFlow<()> + Sync)) -> dipir_guidance::Result<Recovery>,
) -> anyhow::Result<(Recovery, usize)> {
    let watch = Watch {
        session,
        settings,
        resume,
        state: Mutex::default(),
    };
    let recovered = recover(&|event| watch.event(event));
    let state = watch.state.into_inner().unwrap_or_else(|e| e.into_inner());
    if let Some(error) = state.failed {
        return Err(error);
    }
    if let Some(bar) = state.bar {
        bar.done();
    }
    match recovered {
        Err(dipir_guidance::Error::Interrupted) => Err(Interrupted.into()),
        other => Ok((other?, state.resumed_at)),
    }
}

/// Follows the recovery of light.
struct Watch<'a> {
    session: &'a Session,
    settings: &'a Settings,
    resume: &'a Resume,
    state: Mutex<WatchState>,
}

#[derive(Default)]
struct WatchState {
    bar: Option<Progress>,
    resumed_at: usize,
    /// Iterations of the run, where a time budget decides them.
    planned: Option<usize>,
    /// Why the recovery was broken off.
    failed: Option<anyhow::Error>,
}

impl Watch<'_> {
    fn event(&self, event: Event) -> ControlFlow<()> {
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        match self.handle(event, &mut state) {
            Ok(()) => interruption(),
            Err(error) => {
                state.failed = Some(error);
                ControlFlow::Break(())
            }
        }
    }

    fn handle(&self, event: Event, state: &mut WatchState) -> anyhow::Result<()> {
        match event {
            Event::Reading(share) => {
                let bar = state
                    .bar
                    .get_or_insert_with(|| self.session.progress("reading"));
                bar.set(share);
            }
            Event::Start(start) => {
                state.resumed_at = self.resume.restored(self.session, self.settings, start)?;
                state.bar = Some(self.session.progress("light"));
            }
            Event::Recording => {}
            Event::Optimization(optimization::Event::Planned(planned)) => {
                let wanted = self.settings.iterations;
                state.planned = Some(planned);
                self.session.remark(|| {
                    format!("{planned} iterations of {wanted} fit into light.time_budget_s")
                });
            }
            Event::Optimization(optimization::Event::Step(row)) => {
                if let Some(bar) = &state.bar {
                    let iterations = state.planned.unwrap_or(self.settings.iterations);
                    bar.set((row.iteration + 1) as f64 / iterations as f64);
                    match (row.loss, &row.skipped) {
                        (Some(loss), _) => bar.say(format!("loss {loss:.4}")),
                        (None, bad) => bar.say(format!("skipped: {bad:?}")),
                    }
                }
                if row.recorded {
                    let line = || format!("iteration {}: recorded anew", row.iteration);
                    self.session.remark(line);
                }
            }
            Event::Optimization(optimization::Event::Preview { iteration, picture }) => {
                write_png(self.resume.preview(iteration), picture)?;
            }
        }
        Ok(())
    }
}

fn write_results(
    settings: &Settings,
    found: &Found,
    resume: Option<&Resume>,
    writer: &mut StageWriter,
) -> anyhow::Result<()> {
    writer.write_json("lighting", "lighting.json", &found.lighting)?;
    let environment = match &found.surroundings {
        Some(map) => {
            map.write(writer.output("surroundings", "surroundings.exr")?)?;
            let sources = &found.lighting.exposed_lobes()[..found.lighting.sources];
            sum(map, &map_of(sources))?
        }
        None => found
            .lighting
            .map(settings.environment[0], settings.environment[1]),
    };
    environment.write(writer.output("environment", "environment.exr")?)?;
    writer.write_json("tone", "tone.json", &found.tone)?;
    if let Some(estimated) = &found.estimated {
        writer.write_json("estimate", "estimate.json", &estimated.estimate)?;
        writer.write_json("candidates", "candidates.json", &estimated.candidates)?;
    }
    if let Some(reading) = &found.reading {
        writer.write_json("reading", "reading.json", reading)?;
    }
    if let Some(rmse) = found.rmse {
        writer.set_estimated_error(rmse);
    }
    let Some(resume) = resume else {
        return Ok(());
    };
    writer.write_json(
        "history",
        "history.json",
        &rows_without_times(&found.history)?,
    )?;
    for name in resume.previews()? {
        let path = writer.output("preview", Path::new("previews").join(&name))?;
        let kept = resume.preview_named(&name);
        std::fs::copy(&kept, path).with_context(|| format!("cannot copy {}", kept.display()))?;
    }
    Ok(())
}

/// Texel by texel; both maps have the same size.
fn sum(a: &EnvironmentMap, b: &EnvironmentMap) -> anyhow::Result<EnvironmentMap> {
    let texels = a.texels().iter().zip(b.texels()).map(|(a, b)| *a + *b);
    Ok(EnvironmentMap::new(
        a.width(),
        a.height(),
        texels.collect(),
    )?)
}

/// The history without the seconds, which differ from run to run: they are in `stage.json`.
fn rows_without_times(history: &[Row]) -> anyhow::Result<Vec<Value>> {
    let row = |row: &Row| {
        let mut value = serde_json::to_value(row)?;
        if let Some(row) = value.as_object_mut() {
            row.shift_remove("seconds");
        }
        Ok(value)
    };
    history.iter().map(row).collect()
}
