//! What the scene stage left for the stages that render.
use std::path::{Path, PathBuf};

use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::fingerprint::{StaleReason, parameter_changes};
use dipir_pipeline::manifest::{Artifact, Manifest, hash_file};
use dipir_pipeline::stage::{MISSING, StagePlan};
use dipir_render::effects::EffectsPlan;
use dipir_scene::config::SceneConfig;
use dipir_scene::description::SceneDescription;
use dipir_scene::scene::LoadedScene;
use serde::Deserialize;
use serde_json::json;

use crate::names::SCENE;
use crate::scene::{self, unnumbered};

/// The scene stage's folder, its files checked by hash, and the scene that they describe.
pub struct SceneFolder {
    /// Where it is.
    pub folder: PathBuf,
    /// Its `stage.json`.
    pub manifest: Manifest,
    /// The scene, rebuilt from the files that it was made of.
    pub loaded: LoadedScene,
    /// What to simulate.
    pub effects: EffectsPlan,
}

impl SceneFolder {
    /// Reads what the scene stage wrote and the files that it names.
    pub fn read(session: &Session) -> anyhow::Result<Self> {
        let folder = SCENE.folder(session);
        let manifest = manifest(session)?;
        warn_of_other_settings(session, &manifest)?;
        refuse_new_parts(session, &manifest)?;
        let description = SceneDescription::read(&manifest.output(&folder, "scene")?)?;
        let effects: EffectsPlan = read_json(&manifest.output(&folder, "effects")?)?;
        let loaded = description.load(&session.config.base_dir())?;
        Ok(Self {
            folder,
            manifest,
            loaded,
            effects,
        })
    }
}

/// The manifest of the scene stage.
pub fn manifest(session: &Session) -> Result<Manifest, StageError> {
    SCENE.manifest(session)
}

/// Adds the scene stage's outputs of the given roles, and the files that the scene is made of, to the
/// inputs of a plan. Their hashes come from the manifest, and are checked when the files are read.
pub fn add_inputs(plan: &mut StagePlan, scene: &Manifest, roles: &[&str]) -> anyhow::Result<()> {
    plan.outputs_of(scene, roles)?;
    // What camera and points tell is in scene.json, the light's has a role of its own.
    let told = ["camera", "points", "environment"];
    let made_of =
        |a: &&Artifact| !told.contains(&unnumbered(&a.role)) && !a.role.starts_with(MISSING);
    plan.inputs
        .extend(scene.inputs.iter().filter(made_of).cloned());
    Ok(())
}

/// Refuses a scene whose camera's files are others now, for a stage that reads more of them than is in `scene.json`.
pub fn refuse_other_camera(session: &Session, scene: &Manifest) -> anyhow::Result<()> {
    for file in &scene.inputs {
        let is_camera = unnumbered(&file.role) == "camera";
        if is_camera && hash_file(&session.resolve(&file.path))?.1 != file.blake3 {
            anyhow::bail!(
                "the camera's file \"{}\" changed since the scene was set up; run {} again",
                file.path.display(),
                SCENE.executable
            );
        }
    }
    Ok(())
}

/// Refuses a scene that lacks a file which is there now: its object would be read otherwise than it was.
fn refuse_new_parts(session: &Session, manifest: &Manifest) -> anyhow::Result<()> {
    for part in &manifest.inputs {
        if let Some(role) = part.role.strip_prefix(MISSING)
            && dipir_files::open(session.resolve(&part.path)).is_ok()
        {
            anyhow::bail!(
                "the {} \"{}\" is there now and was missing when the scene was set up; run {} again",
                unnumbered(role),
                part.path.display(),
                SCENE.executable
            );
        }
    }
    Ok(())
}

/// Warns if the scene's folder was made before the last edit of `[scene]`.
fn warn_of_other_settings(session: &Session, manifest: &Manifest) -> anyhow::Result<()> {
    let config: SceneConfig = session.config.table("scene")?;
    let was = scene::deciding(json!({"scene": manifest.params["scene"]}));
    let now = scene::deciding(json!({"scene": config}));
    let changes: Vec<String> = parameter_changes(&was, &now)
        .iter()
        .map(StaleReason::to_string)
        .collect();
    if !changes.is_empty() {
        session.warn(&format!(
            "the scene was set up with other settings ({}); run dipir-scene again to use the new ones",
            changes.join(", ")
        ));
    }
    Ok(())
}

fn read_json<T: for<'de> Deserialize<'de>>(path: &Path) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path)?;
    serde_json::from_str(&text).map_err(|e| {
        anyhow::anyhow!(
            "{}: {e}; it was written by another version: run {} again",
            path.display(),
            SCENE.executable
        )
    })
}
