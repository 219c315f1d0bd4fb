//! How far the recovered light is from the true one, where that is known.
//!
//! The picture under the recovered light, under a neutral one and under the true one are made from
//! the scene stage's recorded transport, three products of a sparse matrix: they share their random
//! numbers, and no path is traced.
use std::path::PathBuf;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentMap;
use dipir_optimize::guidance::{rmse, touched};
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::{Objective, Weights};
use dipir_optimize::parameters::ambient_of;
use dipir_optimize::transport::LinearTransport;
use dipir_pipeline::manifest::{FILE_NAME, Manifest, hash_file};
use dipir_render::transport::Transport;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::composite::Tone;
use crate::scene_folder::SceneFolder;
use crate::transport::{self, Frame};
use crate::{optimize, scene};

/// The `[report]` table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReportTable {
    /// Environment map under which the photograph was made, HDR or EXR, if it is known.
    pub truth: Option<PathBuf>,
    /// Stops of exposure that bring it to the photograph's scale.
    pub truth_exposure_ev: f32,
    /// Turn of it about the vertical, degrees, counter-clockwise from above.
    pub truth_rotation_deg: f32,
    /// Curve on the object's light under the true and the neutral light; none by default.
    pub truth_tone: Option<Tone>,
}

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truth {
    /// Between the directions of most light, recovered and true; absent if nothing was recovered.
    pub sun_error_deg: Option<f64>,
    /// Display-referred RMSE of the picture under the recovered light, over what the object or its
    /// shadow touches.
    pub rmse_recovered: f64,
    /// The same under a constant light of the photograph's mean radiance.
    pub rmse_neutral: f64,
    /// Where most of the true light comes from.
    pub peak: Option<Vec3>,
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

/// Compares, if `[report] truth` is set and the light was recovered.
pub fn compare(session: &Session) -> anyhow::Result<Option<Truth>> {
    let table: ReportTable = session.config.table("report")?;
    let Some(path) = &table.truth else {
        return Ok(None);
    };
    let light = session.stage_folder(optimize::STAGE);
    let is_there = |stage: &str| session.stage_folder(stage).join(FILE_NAME).is_file();
    if !is_there(optimize::STAGE) || !is_there(scene::STAGE) {
        return Ok(None);
    }
    let manifest = Manifest::read(&light, optimize::EXECUTABLE)?;
    let recovered = Lighting::read(&manifest.output(&light, "lighting")?)?;
    let curves = ToneCurves::read_json(manifest.output(&light, "tone")?)?;
    let truth = EnvironmentMap::read(session.resolve(path))
        .with_context(|| format!("cannot use report.truth = \"{}\"", path.display()))?
        .scaled(table.truth_exposure_ev.exp2())
        .rotated_y(f64::from(table.truth_rotation_deg).to_radians());

    let scene = SceneFolder::read(session)?;
    let record = Transport::load(scene.manifest.output(&scene.folder, transport::ROLE)?)?;
    let longest = record.size()[0].max(record.size()[1]);
    let frame = Frame::new(&scene.loaded, longest);
    let transfer = scene.loaded.photo.transfer;
    let no_weights = Weights {
        consistency: 0.0,
        regularizer: 0.0,
    };
    let objective = Objective::new(
        Box::new(record),
        frame.background.clone(),
        transfer,
        no_weights,
    )?;
    let (columns, rows) = objective.transport().environment_size();
    let shown = |map: &EnvironmentMap, tone: &Curve| -> anyhow::Result<DisplayImage> {
        let linear = under(objective.transport(), map, tone, &frame.background)?;
        Ok(transfer.encode(&linear))
    };
    let plain = Curve::of(table.truth_tone);
    let wanted = shown(&truth.resampled(columns, rows), &plain)?;
    let found = shown(
        &recovered.map(columns, rows),
        &Curve::Recovered(Box::new(curves)),
    )?;
    let ambient = Vec3::splat(ambient_of(&frame.background) as f32);
    let neutral = shown(&EnvironmentMap::constant(columns, rows, ambient), &plain)?;
    let mask = touched(&objective);
    let apart = |picture: &DisplayImage| rmse(picture, &wanted, &mask, None);
    let peak = truth.peak().0;
    let sun_error = |d: Vec3| f64::from(d.angle_between(peak).to_degrees());
    Ok(Some(Truth {
        sun_error_deg: recovered.peak_direction().map(sun_error),
        rmse_recovered: apart(&found),
        rmse_neutral: apart(&neutral),
        peak: Some(peak),
    }))
}

/// What is done to the object and the shadow.
enum Curve {
    None,
    Reinhard,
    Recovered(Box<ToneCurves>),
}

impl Curve {
    fn of(tone: Option<Tone>) -> Self {
        match tone {
            None | Some(Tone::None) => Self::None,
            Some(Tone::Reinhard) => Self::Reinhard,
        }
    }
}

/// The picture under a light of the record's size, linear.
fn under(
    transport: &dyn LinearTransport,
    light: &EnvironmentMap,
    curve: &Curve,
    background: &LinearImage,
) -> anyhow::Result<LinearImage> {
    let object = LinearImage(transport.foreground(light.texels()));
    let shadow = LinearImage(transport.shadow(light.texels()));
    let alpha: &Raster<f32> = transport.coverage();
    let (object, shadow) = match curve {
        Curve::None => (object, shadow),
        Curve::Reinhard => (ToneCurves::identity().apply_object(&object, alpha), shadow),
        Curve::Recovered(curves) => (
            curves.apply_object(&object, alpha),
            curves.apply_shadow(&shadow),
        ),
    };
    Ok(composite(background, &object, alpha, &shadow)?)
}

impl Truth {
    /// One sentence.
    pub fn in_words(&self) -> String {
        let share = 100.0 * (self.rmse_recovered / self.rmse_neutral - 1.0);
        let direction = match share <= 0.0 {
            true => "below",
            false => "above",
        };
        let sun = match self.sun_error_deg {
            Some(angle) => format!("most light comes from {angle:.1} degrees off the true sun; "),
            None => String::new(),
        };
        format!(
            "{sun}RMSE of the picture {:.4}, {:.0}% {direction} the {:.4} under neutral light",
            self.rmse_recovered,
            share.abs(),
            self.rmse_neutral
        )
    }
}
