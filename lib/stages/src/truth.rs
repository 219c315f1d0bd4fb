//! How far the recovered light is from the true one, where that is known.
//!
//! The picture is compared with the one that the true light makes, path traced at the size at which
//! light is optimised. The recorded transport cannot be used: it has too few samples towards a sun
//! that was unknown when it was recorded. For neutral light, which has no peak, it is precise enough.
use std::path::PathBuf;
use std::sync::Arc;

use dipir_cli::session::Session;
use dipir_imaging::composite::composite as over;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_optimize::guidance::{rmse, touched};
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::{Objective, TermWeights};
use dipir_optimize::parameters::ambient_of;
use dipir_pipeline::manifest::{FILE_NAME, hash_file};
use dipir_render::adaptive::Stop;
use dipir_render::render::{Renderer, Settings};
use dipir_render::transport::Transport;
use glam::{Quat, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::composite::shutter::that_blurs;
use crate::composite::table::{CompositeTable, Tone};
use crate::interruption;
use crate::known_light::Placement;
use crate::names::{COMPOSITE, LIGHT, SCENE};
use crate::scene::folder::SceneFolder;
use crate::scene::transport::{self, Frame};

/// Error of the picture under the true light, display-referred RMSE, 95% bound: added in quadrature, a
/// small part of any difference that matters.
const ERROR: f32 = 0.01;

/// The `[report]` table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReportTable {
    /// Environment map under which the photograph was made, HDR or EXR, if it is known. The
    /// recovered light is compared with it.
    #[schemars(extend("format" = "path"), example = &"truth.exr")]
    pub truth: Option<PathBuf>,
    /// Exposure that brings that map to the photograph's scale, stops.
    #[schemars(range(min = -64, max = 64), example = -1.5)]
    pub truth_exposure_ev: f32,
    /// Turn of that map about the vertical, degrees, counter-clockwise from above.
    #[schemars(example = 90.0)]
    pub truth_rotation_deg: f32,
    /// Curve on the object's light under the true and the neutral light, as `composite.tone`.
    #[schemars(extend("default" = "none"), example = &"reinhard")]
    pub truth_tone: Option<Tone>,
}

impl ReportTable {
    /// How the map of `truth` is used.
    pub fn placement(&self) -> Placement {
        Placement {
            exposure_ev: ("report.truth_exposure_ev", self.truth_exposure_ev),
            rotation_deg: ("report.truth_rotation_deg", self.truth_rotation_deg),
        }
    }
}

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truth {
    /// Between the directions of most light, recovered (and turned by `composite.rotation_deg`) and true; absent if nothing
    /// was recovered.
    pub sun_error_deg: Option<f64>,
    /// Display-referred RMSE of the composite stage's picture, over what the object or its shadow
    /// touches.
    pub rmse_recovered: f64,
    /// The same under a constant light of the photograph's mean radiance.
    pub rmse_neutral: f64,
    /// Where most of the true light comes from.
    pub peak: Option<Vec3>,
    /// What the stage's picture shows and the other pictures do not.
    pub left_out: Vec<&'static str>,
}

/// What decides the comparison beside the stages' outputs.
pub fn key(session: &Session) -> anyhow::Result<Value> {
    let table: ReportTable = session.config.table("report")?;
    let hash = match &table.truth {
        Some(path) => hash_file(&session.resolve(path)).ok().map(|h| h.1),
        None => None,
    };
    Ok(json!([table, hash]))
}

/// Compares, if `[report] truth` is set and the picture was made under the recovered light.
pub fn compare(session: &Session) -> anyhow::Result<Option<Truth>> {
    let table: ReportTable = session.config.table("report")?;
    let Some(path) = &table.truth else {
        return Ok(None);
    };
    let lit: CompositeTable = session.config.table("composite")?;
    let is_there = |stage: &str| session.stage_folder(stage).join(FILE_NAME).is_file();
    let needed = [SCENE.name, LIGHT.name, COMPOSITE.name];
    if lit.environment.is_some() || !needed.into_iter().all(is_there) {
        return Ok(None);
    }
    let folder = LIGHT.folder(session);
    let manifest = LIGHT.manifest(session)?;
    let recovered = Lighting::read(&manifest.output(&folder, "lighting")?)?;
    let truth = table.placement().read(session, "report.truth", path)?;

    let scene = SceneFolder::read(session)?;
    let (record, frame) = recorded(session, &scene)?;
    let transfer = scene.loaded.photo.transfer;
    let no_weights = TermWeights {
        consistency: 0.0,
        regularizer: 0.0,
    };
    let background = frame.background.clone();
    let objective = Objective::new(Box::new(record), background, transfer, no_weights)?;

    let peak = truth.peak().0;
    let wanted = under_truth(session, &scene, &frame, truth, table.truth_tone)?;
    let found = picture(session, &scene, &frame)?;
    let neutral = under_neutral(&objective, &frame, table.truth_tone)?;
    let mask = touched(&objective);
    let wanted = transfer.encode(&wanted);
    let apart = |linear: &LinearImage| rmse(&transfer.encode(linear), &wanted, &mask);
    let sun_error = |d: Vec3| apart_deg(d, lit.rotation_deg, peak);
    Ok(Some(Truth {
        sun_error_deg: recovered.peak_direction().map(sun_error),
        rmse_recovered: apart(&found),
        rmse_neutral: apart(&neutral),
        peak: Some(peak),
        left_out: left_out(session, &scene)?,
    }))
}

/// What the composite simulates beside what is compared.
fn left_out(session: &Session, scene: &SceneFolder) -> anyhow::Result<Vec<&'static str>> {
    let table: CompositeTable = session.config.table("composite")?;
    let optics = table.optics(&session.config, &scene.loaded)?;
    let (optics, _) = that_blurs(optics, &scene.loaded);
    let all = [
        ("depth of field", optics.lens.is_some()),
        ("motion blur", optics.shutter.is_some()),
        ("the ground's mirror image", table.gloss().is_some()),
        (
            "shadows on what scene.depth shows",
            scene.loaded.catching().is_some(),
        ),
        (
            "what composite.emission_ev and emission_tint change",
            table.emission_gain().is_some(),
        ),
    ];
    let shown = all.into_iter().filter(|(_, is_shown)| *is_shown);
    Ok(shown.map(|(what, _)| what).collect())
}

/// Degrees between the direction of a recovered light, turned as the picture has it, and the true one.
fn apart_deg(recovered: Vec3, rotation_deg: f32, truth: Vec3) -> f64 {
    let turned = Quat::from_rotation_y(rotation_deg.to_radians()) * recovered;
    f64::from(turned.angle_between(truth).to_degrees())
}

/// The scene stage's record, else one of its own, and the size at which it is compared.
fn recorded(session: &Session, scene: &SceneFolder) -> anyhow::Result<(Transport, Frame)> {
    if scene
        .manifest
        .outputs
        .iter()
        .any(|o| o.role == transport::ROLE)
    {
        let record = Transport::load(scene.manifest.output(&scene.folder, transport::ROLE)?)?;
        let longest = record.size()[0].max(record.size()[1]);
        return Ok((record, Frame::new(&scene.loaded, longest)));
    }
    let settings = transport::settings(session, &session.config.table("light")?)?;
    let frame = Frame::new(&scene.loaded, settings.size);
    let simulation = scene.effects.simulation();
    let hash = transport::scene_hash(&scene.loaded, &simulation)?;
    let renderer = Renderer::new(&scene.loaded.scene).with_camera(frame.camera);
    let record = transport::record(
        session,
        &renderer,
        &frame.record_settings(&settings, simulation, hash),
    )?;
    Ok((record, frame))
}

/// The composite stage's picture, linear.
fn picture(session: &Session, scene: &SceneFolder, frame: &Frame) -> anyhow::Result<LinearImage> {
    let folder = COMPOSITE.folder(session);
    let manifest = COMPOSITE.manifest(session)?;
    let layers = Layers::read_exr(manifest.output(&folder, "layers")?)?;
    let picture = LinearImage(layers.rgb("")?);
    Ok(frame.scale(&scene.loaded.undistorted(picture)))
}

/// The picture under the true light, path traced, linear.
fn under_truth(
    session: &Session,
    scene: &SceneFolder,
    frame: &Frame,
    truth: EnvironmentMap,
    tone: Option<Tone>,
) -> anyhow::Result<LinearImage> {
    let curves = tone.and_then(Tone::curves);
    let settings = Settings {
        seed: session.pipeline.seed,
        stop: Stop::TargetError(ERROR),
        denoise: true,
        tone: curves.as_ref(),
        ..frame.render_settings()
    };
    let renderer = Renderer::new(&scene.loaded.scene).with_camera(frame.camera);
    let light = EnvironmentSampler::new(Arc::new(truth));
    let progress = session.progress("true light");
    let rendered = renderer
        .render(
            &light,
            &scene.effects.simulation(),
            &settings,
            &mut |state| {
                progress.set(state.fraction);
                interruption()
            },
        )
        .map_err(crate::render_error)?;
    progress.done();
    let film = rendered.film;
    let object = toned(LinearImage(film.object), &film.alpha, tone);
    let shadow = LinearImage(film.shadow);
    Ok(over(&frame.background, &object, &film.alpha, &shadow)?)
}

/// The picture under a constant light of the photograph's mean radiance, linear.
fn under_neutral(
    objective: &Objective,
    frame: &Frame,
    tone: Option<Tone>,
) -> anyhow::Result<LinearImage> {
    let transport = objective.transport();
    let (columns, rows) = transport.environment_size();
    let ambient = Vec3::splat(ambient_of(&frame.background) as f32);
    let light = EnvironmentMap::constant(columns, rows, ambient);
    let alpha: &Raster<f32> = transport.coverage();
    let object = LinearImage(transport.foreground(light.texels()));
    let shadow = LinearImage(transport.shadow(light.texels()));
    let object = toned(object, alpha, tone);
    Ok(over(&frame.background, &object, alpha, &shadow)?)
}

fn toned(object: LinearImage, alpha: &Raster<f32>, tone: Option<Tone>) -> LinearImage {
    match tone.and_then(Tone::curves) {
        None => object,
        Some(curves) => curves.apply_object(&object, alpha),
    }
}

impl Truth {
    /// One sentence.
    pub fn in_words(&self) -> String {
        let share = 100.0 * (self.rmse_recovered / self.rmse_neutral - 1.0);
        let than = match share {
            // Nothing that the object or its shadow touches is in the picture, or neutral light is the true one.
            s if !s.is_finite() => "beside".to_string(),
            s if s <= 0.0 => format!("{:.0}% below", s.abs()),
            s => format!("{s:.0}% above"),
        };
        let sun = match self.sun_error_deg {
            Some(angle) => format!("most light comes from {angle:.1} degrees off the true sun; "),
            None => String::new(),
        };
        let left_out = match self.left_out.is_empty() {
            true => String::new(),
            false => format!(
                "; the pictures under the true and the neutral light lack {}, which counts as an error",
                self.left_out.join(", ")
            ),
        };
        format!(
            "{sun}RMSE of the picture {:.4}, {than} the {:.4} under neutral light{left_out}",
            self.rmse_recovered, self.rmse_neutral
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_turn_of_the_picture_s_light_counts_in_its_error() {
        let sun = Vec3::new(0.0, 0.6, 0.8);
        // By a quarter turn light from +z comes from +x.
        let quarter = Vec3::new(0.8, 0.6, 0.0);
        assert!(apart_deg(sun, 90.0, quarter) < 0.1);
        assert!(apart_deg(sun, 0.0, sun) < 0.1);
        assert!(apart_deg(sun, 90.0, sun) > 60.0);
    }

    #[test]
    fn an_error_is_told_beside_that_of_neutral_light() {
        let words = |rmse_recovered, rmse_neutral| {
            let truth = Truth {
                sun_error_deg: None,
                rmse_recovered,
                rmse_neutral,
                peak: None,
                left_out: vec![],
            };
            truth.in_words()
        };
        let ends = |recovered, neutral, end: &str| {
            let words = words(recovered, neutral);
            assert!(words.ends_with(end), "{words}");
        };
        ends(
            0.05,
            0.1,
            "0.0500, 50% below the 0.1000 under neutral light",
        );
        ends(
            0.2,
            0.1,
            "0.2000, 100% above the 0.1000 under neutral light",
        );
        ends(0.1, 0.1, "0.1000, 0% below the 0.1000 under neutral light");
        ends(0.0, 0.0, "0.0000, beside the 0.0000 under neutral light");
    }
}
