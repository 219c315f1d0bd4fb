//! The light stage: recovers the light and the tone curves under which the object looks as the
//! guidance wants it to.
pub mod distillation;
mod guide;
pub mod materials;
pub mod reading;
mod resume;

use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use dipir_cli::interrupt::Interrupted;
use dipir_cli::session::{Session, duration};
use dipir_imaging::file::{read_photo, write_png};
use dipir_imaging::raster::DisplayImage;
use dipir_optimize::OptimizeError;
use dipir_optimize::crop::{Framing, USUAL_SCALE, bounding_box};
use dipir_optimize::guidance::{Guidance, Reference, rmse, touched};
use dipir_optimize::history::Row;
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::Objective;
use dipir_optimize::optimization::{Event, Optimization, Outcome};
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::recorder::SceneRecorder;
use dipir_optimize::settings::{GuidanceKind, LightTable, Settings, Start};
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use dipir_prior::inversion::{InversionSettings, Reading};
use dipir_render::render::Renderer;
use dipir_render::transport::{RecordSettings, Transport};
use glam::Vec3;
use serde_json::{Value, json};

use crate::light::distillation::Adapter;
use crate::light::guide::{Asked, Guide, Judge};
use crate::light::resume::{Resume, fingerprint};
use crate::presets::{LightRun, Outlook};
use crate::scene::folder::{self, SceneFolder};
use crate::scene::transport::{self, Frame};
use crate::{interruption, model};

/// Name of the stage and of its folder.
pub const STAGE: &str = "light";
/// The executable that runs it.
pub const EXECUTABLE: &str = "dipir-light";
/// Raised whenever the same inputs give other outputs.
pub const VERSION: u32 = 3;

/// Side of the crops of a reference, when it is compared on crops.
const CROP_SIDE: usize = 128;

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    outcome: Outcome,
    size: [u32; 2],
    resumed_at: usize,
    /// Display-referred RMSE against the reference, over what the object or its shadow touches.
    rmse: Option<f64>,
    reading: Option<Reading>,
    /// What other presets would have taken; empty for a run that went on from a checkpoint.
    outlook: Outlook,
}

/// Runs the stage.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let Asked {
        table,
        settings,
        judge,
    } = Asked::of(session)?;
    let first = first_light(session, &table)?;
    let scene = SceneFolder::read(session)?;
    let frame = Frame::new(&scene.loaded, settings.size);
    let reference = match &judge {
        Judge::Reference { file, .. } => Some(read_reference(session, &scene, &frame, file)?),
        Judge::Diffusion { .. } => None,
    };

    let plan = plan(session)?;
    let fingerprint = fingerprint(&plan, &settings)?;
    let folder = session.stage_folder(STAGE);
    let mut writer = session.begin(plan)?;

    let simulation = scene.effects.simulation();
    let renderer = Renderer::new(&scene.loaded.scene).with_camera(frame.camera);
    let hash = transport::scene_hash(&scene.loaded, &simulation)?;
    let record = frame.record_settings(&settings, simulation, hash);
    let clock = Instant::now();
    let recorded = recorded(session, &scene, &renderer, &record)?;
    writer.set_timing("transport", clock.elapsed().as_secs_f64());

    let neutral = Parameters::neutral(settings.lobes, ambient_of(&frame.background));
    let transfer = scene.loaded.photo.transfer;
    let coverage = recorded.coverage().clone();
    let objective = Objective::new(
        Box::new(recorded),
        frame.background.clone(),
        transfer,
        settings.weights(),
    )?;
    let mask = touched(&objective);
    let shown = transfer.encode(&frame.background);
    let clock = Instant::now();
    let mut guide = Guide::open(session, &judge)?;
    let reading = guide.read(session, &judge, &shown, &renderer, &coverage, settings.seed)?;
    writer.set_timing("reading", clock.elapsed().as_secs_f64());
    let start = match (&first, &reading) {
        (Some((_, _, light)), _) => Parameters::of_lobes(&light.exposed_lobes()),
        (None, Some(reading)) => reading::start(&reading.light, &frame.camera, settings.lobes),
        (None, None) => neutral,
    };
    let resume = Resume::open(session, &fingerprint)?;
    let resumed_at = resume.restored(session, &settings, &start)?;
    let mut guidance: Box<dyn Guidance> = match (&judge, &reference) {
        (_, Some(reference)) => {
            let framing = match settings.crops {
                true => Framing::Crops {
                    side: CROP_SIDE,
                    scale: USUAL_SCALE,
                },
                false => Framing::Whole,
            };
            Box::new(Reference::new(reference.clone(), &objective, framing)?)
        }
        (Judge::Reference { .. }, None) => anyhow::bail!("the reference was not read"),
        (
            Judge::Diffusion {
                settings, class, ..
            },
            None,
        ) => {
            // A model that knows light sees the ground on which the shadow will fall.
            let paint = if reading.is_some() { &coverage } else { &mask };
            let seen = reading.as_ref().zip(bounding_box(&coverage));
            let seen = seen.map(|(r, object)| {
                let seen_from = reading::view_direction(&frame.camera, object);
                r.light.description.seen_from(seen_from.heading)
            });
            Box::new(guide.distillation(settings, class, seen.as_ref(), &shown, paint)?)
        }
    };
    let mut go_on = |_: f64| interruption();
    let mut recorder = SceneRecorder {
        renderer: &renderer,
        settings: record,
        progress: &mut go_on,
    };
    let clock = Instant::now();
    let optimization = Optimization {
        objective,
        guidance: &mut *guidance,
        recorder: Some(&mut recorder),
        settings: settings.clone(),
        start,
        checkpoint: Some(&resume.checkpoint()),
    };
    let outcome = follow(session, &settings, &resume, optimization)?;
    writer.set_timing("optimization", clock.elapsed().as_secs_f64());
    write_results(&settings, &outcome, &resume, &mut writer)?;
    if let Some(reading) = &reading {
        writer.write_json("reading", "reading.json", reading)?;
    }
    let rmse = reference.map(|reference| rmse(&outcome.picture, &reference, &mask, None));
    if let Some(rmse) = rmse {
        writer.set_estimated_error(rmse);
    }
    let manifest = writer.finish()?;
    resume.remove();
    let outlook = match resumed_at {
        0 => light_run(&scene, &settings, &judge, &manifest)
            .outlook(session.pipeline.quality, &table),
        _ => Outlook::default(),
    };
    Ok(Done {
        folder,
        manifest,
        outcome,
        size: frame.camera.resolution,
        resumed_at,
        rmse,
        reading,
        outlook,
    })
}

/// What took how long.
fn light_run(
    scene: &SceneFolder,
    settings: &Settings,
    judge: &Judge,
    manifest: &Manifest,
) -> LightRun {
    let seconds = |manifest: &Manifest, name: &str| manifest.timings_s.get(name).copied();
    let resolution = scene.loaded.scene.camera.resolution;
    let photo_side = resolution[0].max(resolution[1]) as usize;
    let refines = matches!(judge, Judge::Diffusion { reads: Some(_), .. });
    LightRun {
        iterations: (!refines).then_some(settings.iterations),
        samples: settings.samples,
        side: settings.size.min(photo_side),
        photo_side,
        record_s: seconds(&scene.manifest, "transport")
            .or(seconds(manifest, "transport"))
            .unwrap_or(0.0),
        optimization_s: seconds(manifest, "optimization").unwrap_or(0.0),
        by_model: matches!(judge, Judge::Diffusion { .. }),
    }
}

/// What a run would be, from the configuration and the manifests of the stages that it reads.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let Asked {
        table,
        settings,
        judge,
    } = Asked::of(session)?;
    let mut plan = StagePlan::new(
        STAGE,
        VERSION,
        params(&settings, &judge),
        session.pipeline.seed,
    );
    let scene = folder::manifest(session)?;
    folder::add_inputs(&mut plan, &scene, &["scene", "effects"])?;
    match &judge {
        Judge::Reference { path, file } => plan.input("reference", path, file)?,
        Judge::Diffusion {
            table, settings, ..
        } => {
            plan.device = session.pipeline.device.clone();
            model::inputs(session, table, &mut plan)?;
            if settings.adapt {
                Adapter::add_inputs(session, &mut plan)?;
            }
        }
    }
    if let Start::File(path) = &table.start {
        plan.input("start", path, &session.resolve(path))?;
    }
    Ok(plan)
}

/// The light of `[light] start`: its file as the configuration names it, where it is, and what it
/// holds.
fn first_light(
    session: &Session,
    table: &LightTable,
) -> anyhow::Result<Option<(PathBuf, PathBuf, Lighting)>> {
    let Start::File(path) = &table.start else {
        return Ok(None);
    };
    let file = session.resolve(path);
    let light = Lighting::read(&file)
        .with_context(|| format!("cannot use light.start = \"{}\"", path.display()))?;
    if light.lobes.is_empty() {
        let message = format!(
            "\"{}\" holds no lobes; accepted: a lighting.json that holds some",
            path.display()
        );
        return Err(session.config.invalid("light.start", message).into());
    }
    Ok(Some((path.clone(), file, light)))
}

/// The reference, as the configuration names it and where it is.
pub fn reference_of(session: &Session, table: &LightTable) -> anyhow::Result<(PathBuf, PathBuf)> {
    let path = table.reference.clone().ok_or_else(|| {
        let message = "is missing: name the picture that the composite should equal, as in \
                       reference = \"image.exr\"";
        session.config.invalid("light.reference", message)
    })?;
    let file = session.resolve(&path);
    Ok((path, file))
}

/// The reference at the size of `frame`, as it is displayed.
pub fn read_reference(
    session: &Session,
    scene: &SceneFolder,
    frame: &Frame,
    file: &Path,
) -> anyhow::Result<DisplayImage> {
    let transfer = scene.loaded.photo.transfer;
    let image = read_photo(file, transfer)?.image;
    let found = [image.0.width() as u32, image.0.height() as u32];
    let expected = scene.loaded.scene.camera.resolution;
    if found != expected {
        let message = format!(
            "\"{}\" has {} x {} pixels; accepted: a picture of the photograph's size, {} x {}",
            file.display(),
            found[0],
            found[1],
            expected[0],
            expected[1]
        );
        return Err(session.config.invalid("light.reference", message).into());
    }
    Ok(transfer.encode(&frame.scale(&image)))
}

/// How light is read, as far as it decides.
fn read_param(reads: &Option<InversionSettings>) -> Value {
    match reads {
        Some(settings) if settings.draws == 0 => json!("encoder"),
        other => json!(other.is_some()),
    }
}

/// What decides the outputs; how often the state is kept does not.
fn params(settings: &Settings, judge: &Judge) -> Value {
    let settings = Settings {
        checkpoint_every: 0,
        ..settings.clone()
    };
    match judge {
        Judge::Reference { .. } => {
            json!({"optimize": settings, "guidance": GuidanceKind::Reference})
        }
        Judge::Diffusion {
            table,
            settings: distillation,
            class,
            reads,
        } => json!({
            "optimize": settings, "guidance": distillation, "class": class,
            "precision": table.precision, "read": read_param(reads),
        }),
    }
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

/// Runs the loop, showing how far it is and keeping its previews.
fn follow(
    session: &Session,
    settings: &Settings,
    resume: &Resume,
    optimization: Optimization,
) -> anyhow::Result<Outcome> {
    let progress = session.progress("light");
    let mut unwritten: Option<anyhow::Error> = None;
    let mut watch = |event: Event| -> ControlFlow<()> {
        match event {
            Event::Step(row) => {
                progress.set((row.iteration + 1) as f64 / settings.iterations as f64);
                match (row.loss, &row.skipped) {
                    (Some(loss), _) => progress.say(format!("loss {loss:.4}")),
                    (None, bad) => progress.say(format!("skipped: {bad:?}")),
                }
                if row.recorded {
                    session.remark(|| format!("iteration {}: recorded anew", row.iteration));
                }
            }
            Event::Preview { iteration, picture } => {
                if let Err(e) = write_png(resume.preview(iteration), picture) {
                    unwritten = Some(e.into());
                    return ControlFlow::Break(());
                }
            }
        }
        interruption()
    };
    let outcome = optimization.run(&mut watch);
    if let Some(e) = unwritten {
        return Err(e);
    }
    progress.done();
    match outcome {
        Err(OptimizeError::Interrupted) => Err(Interrupted.into()),
        other => Ok(other?),
    }
}

fn write_results(
    settings: &Settings,
    outcome: &Outcome,
    resume: &Resume,
    writer: &mut StageWriter,
) -> anyhow::Result<()> {
    writer.write_json("lighting", "lighting.json", &outcome.lighting)?;
    let [columns, rows] = settings.environment;
    let path = writer.output("environment", "environment.exr")?;
    outcome.lighting.map(columns, rows).write(path)?;
    writer.write_json("tone", "tone.json", &outcome.tone)?;
    writer.write_json("history", "history.json", &rows_without_times(outcome)?)?;
    for name in resume.previews()? {
        let path = writer.output("preview", Path::new("previews").join(&name))?;
        let kept = resume.folder.join("previews").join(&name);
        std::fs::copy(&kept, path).with_context(|| format!("cannot copy {}", kept.display()))?;
    }
    Ok(())
}

/// The history without the seconds, which differ from run to run: they are in `stage.json`.
fn rows_without_times(outcome: &Outcome) -> anyhow::Result<Vec<Value>> {
    let row = |row: &Row| {
        let mut value = serde_json::to_value(row)?;
        if let Some(row) = value.as_object_mut() {
            row.shift_remove("seconds");
        }
        Ok(value)
    };
    outcome.history.iter().map(row).collect()
}

/// Degrees above the horizon, and counter-clockwise from +z seen from above.
fn angles_deg(direction: Vec3) -> [f32; 2] {
    let elevation = direction.y.clamp(-1.0, 1.0).asin();
    let azimuth = direction.x.atan2(direction.z);
    [elevation.to_degrees(), azimuth.to_degrees()]
}

impl Done {
    fn records(&self) -> usize {
        self.outcome.history.iter().filter(|r| r.recorded).count()
    }

    fn guidance(&self, row: Option<&Row>) -> Option<f64> {
        row.and_then(|r| r.guidance)
    }

    /// For programs.
    pub fn to_json(&self) -> Value {
        let history = &self.outcome.history;
        json!({
            "folder": self.folder,
            "size": self.size,
            "iterations": history.len(),
            "resumed_at": self.resumed_at,
            "skipped": self.outcome.skipped(),
            "stopped_early": self.outcome.stopped_early,
            "recorded_anew": self.records(),
            "guidance_at_start": self.guidance(history.first()),
            "guidance_at_end": self.guidance(history.last()),
            "rmse": self.rmse,
            "reading": self.reading,
            "other_presets": self.outlook.to_json(),
            "peak_direction": self.outcome.lighting.peak_direction(),
            "fusion_residual": self.outcome.lighting.fusion_residual,
            "elapsed_s": self.manifest.elapsed_s,
            "timings_s": self.manifest.timings_s,
            "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "wrote {} in {}",
            self.folder.display(),
            duration(self.manifest.elapsed_s)
        )?;
        write!(
            f,
            "  {} iterations on {} x {} pixels",
            self.outcome.history.len(),
            self.size[0],
            self.size[1]
        )?;
        if let Some(rmse) = self.rmse {
            write!(f, ", {rmse:.5} of display-referred RMSE from the reference")?;
        }
        if let Some(peak) = self.outcome.lighting.peak_direction() {
            let [elevation, azimuth] = angles_deg(peak);
            write!(
                f,
                "\n  most light comes from {elevation:.1} degrees above the horizon, {azimuth:.1} \
                 degrees from +z towards +x"
            )?;
        }
        let skipped = self.outcome.skipped();
        if skipped > 0 {
            write!(
                f,
                "\n  {skipped} steps were skipped, because something was not finite"
            )?;
        }
        if !self.outlook.0.is_empty() {
            write!(f, "\n  {}", self.outlook.text())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_told_as_heights_and_turns() {
        assert_eq!(angles_deg(Vec3::Y)[0], 90.0);
        assert_eq!(angles_deg(Vec3::Z), [0.0, 0.0]);
        assert_eq!(angles_deg(Vec3::X), [0.0, 90.0]);
        assert_eq!(angles_deg(Vec3::NEG_X), [0.0, -90.0]);
    }
}
