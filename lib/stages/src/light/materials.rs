//! Recovering materials under a known light, and using what was recovered.
use std::fmt;
use std::path::PathBuf;

use dipir_cli::interrupt::Interrupted;
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::EnvironmentSampler;
use dipir_optimize::OptimizeError;
use dipir_optimize::materials::{
    MaterialOptimization, MaterialOutcome, MaterialSettings, RecoveredMaterial,
};
use dipir_optimize::settings::LightTable;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::StagePlan;
use dipir_render::adaptive::{Progress, Stop};
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_scene::material::Material;
use serde_json::{Value, json};

use crate::composite::table::{CompositeTable, Tone};
use crate::interruption;
use crate::known_light;
use crate::light::folder::warn_of_another_scene;
use crate::light::request::{read_reference, reference_of};
use crate::light::resume::{self, Resume};
use crate::names::{LIGHT, begin};
use crate::scene::folder::{self as scene_folder, SceneFolder};
use crate::scene::transport::{self, Frame};
use crate::written;

/// Role of the file among the light stage's outputs.
const ROLE: &str = "materials";
/// Name of the file.
const FILE: &str = "materials.json";
/// Error at which the shadow around the object is known well enough.
const SHADOW_ERROR: f32 = 0.004;

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    outcome: MaterialOutcome,
    resumed_at: usize,
}

/// Whether `[light] materials` names any.
pub fn are_asked_for(session: &Session) -> anyhow::Result<bool> {
    let table: LightTable = session.config.table("light")?;
    Ok(!table.materials.is_empty())
}

/// Recovers the materials of `[light] materials` from the reference.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let table: LightTable = session.config.table("light")?;
    let composite: CompositeTable = session.config.table("composite")?;
    composite.check(&session.config)?;
    let settings = transport::settings(session, &table)?;
    let (_, reference_file) = reference_of(session, &table)?;
    let light = known_light::known(session, &composite)?.ok_or_else(|| needs_light(session))?;
    let scene = SceneFolder::read(session)?;
    let materials = indices(session, &scene.loaded.scene.materials, &table.materials)?;
    let frame = Frame::new(&scene.loaded, settings.size);
    let reference = read_reference(session, &scene, &frame, &reference_file)?;
    let material_settings = MaterialSettings {
        checkpoint_every: settings.checkpoint_every,
        ..settings_of(&table, settings.seed)
    };
    let plan = plan(session)?;
    let decisive = settings_of(&table, settings.seed);
    let fingerprint = resume::run_fingerprint(&plan, &json!(decisive))?;
    let folder = LIGHT.folder(session);
    let mut writer = begin(session, plan)?;
    let renderer = Renderer::new(&scene.loaded.scene).with_camera(frame.camera);
    let sampler = EnvironmentSampler::new(light.map.clone());
    let simulation = scene.effects.simulation();
    let background = shadowed(&renderer, &sampler, &simulation, &frame)?;
    let resume = Resume::open(session, &fingerprint)?;
    let checkpoint = resume.checkpoint();
    let optimization = MaterialOptimization {
        renderer: &renderer,
        light: &sampler,
        simulation,
        tone: composite.tone.and_then(Tone::curves),
        background: &background,
        transfer: scene.loaded.photo.transfer,
        reference: &reference,
        materials,
        settings: material_settings,
        checkpoint: Some(&checkpoint),
    };
    let kept = optimization.restored(&checkpoint);
    let resumed_at = resume.resumed_at(session, kept.map(|s| s.map(|s| s.iteration)))?;
    let progress = session.progress("materials");
    let outcome = optimization.run(&mut |share| {
        progress.set(share);
        interruption()
    });
    progress.done();
    let outcome = match outcome {
        Err(OptimizeError::Interrupted) => return Err(Interrupted.into()),
        other => other?,
    };
    writer.write_json(ROLE, FILE, &outcome.materials)?;
    writer.write_json("history", "history.json", &outcome.losses)?;
    let manifest = writer.finish_and(|| resume.remove())?;
    Ok(Done {
        folder,
        manifest,
        outcome,
        resumed_at,
    })
}

/// What a run would be, from the configuration and the scene stage's manifest.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let table: LightTable = session.config.table("light")?;
    let composite: CompositeTable = session.config.table("composite")?;
    composite.check(&session.config)?;
    let settings = transport::settings(session, &table)?;
    if settings.time_budget_s.is_some() {
        let message =
            "does not limit the recovery of materials; remove it, or set light.iterations";
        return Err(session
            .config
            .invalid("light.time_budget_s", message)
            .into());
    }
    let (reference_path, reference_file) = reference_of(session, &table)?;
    let (light, environment) =
        known_light::known_params(&composite).ok_or_else(|| needs_light(session))?;
    let params = json!({
        "materials": table.materials,
        "iterations": settings_of(&table, settings.seed).iterations,
        "size": settings.size,
        "seed": settings.seed,
        "light": light,
        "tone": composite.tone,
    });
    let mut plan = LIGHT.plan(session, params);
    let scene = scene_folder::manifest(session)?;
    scene_folder::add_inputs(&mut plan, &scene, &["scene", "effects"])?;
    plan.input("reference", &reference_path, &reference_file)?;
    plan.input("environment", environment, &session.resolve(environment))?;
    Ok(plan)
}

fn settings_of(table: &LightTable, seed: u64) -> MaterialSettings {
    let default = MaterialSettings::default();
    MaterialSettings {
        iterations: table.iterations.unwrap_or(default.iterations),
        seed,
        ..default
    }
}

fn needs_light(session: &Session) -> anyhow::Error {
    let message = "needs a known light, for a picture alone does not tell a dark material from a \
                   dim light; name a map, as in --set composite.environment=sky.hdr";
    session.config.invalid("light.materials", message).into()
}

/// The photograph with the object's shadow, at the frame's size.
fn shadowed(
    renderer: &Renderer,
    light: &EnvironmentSampler,
    simulation: &Simulation,
    frame: &Frame,
) -> anyhow::Result<LinearImage> {
    let settings = Settings {
        stop: Stop::TargetError(SHADOW_ERROR),
        ..frame.render_settings()
    };
    let rendered = renderer
        .render(light, simulation, &settings, &mut |_: &Progress| {
            interruption()
        })
        .map_err(crate::render_error)?;
    let pixels = frame.background.0.pixels().iter();
    let shaded = pixels
        .zip(rendered.film.shadow.pixels())
        .map(|(&photo, &ratio)| photo * ratio)
        .collect();
    let (width, height) = (frame.background.0.width(), frame.background.0.height());
    Ok(LinearImage(Raster::from_pixels(width, height, shaded)))
}

/// Where materials of these names stand; several may share one.
fn indices(
    session: &Session,
    materials: &[Material],
    names: &[String],
) -> anyhow::Result<Vec<usize>> {
    let mut found = Vec::new();
    for name in names {
        let before = found.len();
        found.extend((0..materials.len()).filter(|&m| materials[m].name == *name));
        if found.len() == before {
            let known: Vec<String> = materials.iter().map(|m| format!("{:?}", m.name)).collect();
            let message = format!(
                "the scene has no material {name:?}; it has: {}",
                known.join(", ")
            );
            return Err(session.config.invalid("light.materials", message).into());
        }
    }
    found.sort_unstable();
    found.dedup();
    Ok(found)
}

/// The manifest of the light stage, if the configuration asks for recovered materials.
fn recovery(session: &Session) -> anyhow::Result<Option<Manifest>> {
    if !are_asked_for(session)? {
        return Ok(None);
    }
    Ok(Some(LIGHT.manifest(session)?))
}

/// Adds the recovered materials to the inputs of a plan, if the configuration asks for them.
pub fn add_input(session: &Session, plan: &mut StagePlan) -> anyhow::Result<()> {
    match recovery(session)? {
        Some(manifest) => Ok(plan.outputs_of(&manifest, &[ROLE])?),
        None => Ok(()),
    }
}

/// Puts what the light stage recovered of the materials into `scene`, if the configuration asks
/// for it.
pub fn use_recovered(session: &Session, scene: &mut SceneFolder) -> anyhow::Result<()> {
    let Some(manifest) = recovery(session)? else {
        return Ok(());
    };
    warn_of_another_scene(session, &manifest, &scene.manifest);
    let file = manifest.output(&LIGHT.folder(session), ROLE)?;
    let text = std::fs::read_to_string(&file)?;
    let found: Vec<RecoveredMaterial> = serde_json::from_str(&text).map_err(|e| {
        let tool = LIGHT.executable;
        anyhow::anyhow!(
            "{}: {e}; it was written by another version: run {tool} again",
            file.display()
        )
    })?;
    for material in &mut scene.loaded.scene.materials {
        if let Some(f) = found.iter().find(|f| f.name == material.name) {
            f.apply(material);
        }
    }
    Ok(())
}

impl Done {
    /// For programs.
    pub fn to_json(&self) -> Value {
        json!({
            "folder": json_path(&self.folder),
            "materials": self.outcome.materials,
            "iterations": self.outcome.losses.len(),
            "resumed_at": self.resumed_at,
            "loss_at_start": self.outcome.losses.first(),
            "loss_at_end": self.outcome.losses.last(),
            "elapsed_s": self.manifest.elapsed_s,
            "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        for m in &self.outcome.materials {
            let [r, g, b] = m.base_color;
            write!(
                f,
                "\n  {:?}: base colour {r:.3} {g:.3} {b:.3}, metallic {:.3}, roughness {:.3}, emission \
                 x {:.3}",
                m.name, m.metallic, m.roughness, m.emissive_strength
            )?;
        }
        Ok(())
    }
}
