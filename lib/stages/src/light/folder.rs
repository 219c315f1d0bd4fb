//! What the light stage leaves, for the composite and the report.
use std::path::Path;

use dipir_cli::session::Session;
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_optimize::lighting::Lighting;
use dipir_pipeline::manifest::{Artifact, FILE_NAME, Manifest};
use dipir_pipeline::stage::StagePlan;
use glam::Quat;
use serde_json::{Value, json};

use crate::composite::table::CompositeTable;
use crate::known_light::{add_tint, tinted};
use crate::names::LIGHT;

/// What decides the recovered light beside the light stage's files.
pub fn recovered_params(table: &CompositeTable) -> Value {
    let mut params = json!({
        "recovered": true,
        "exposure_ev": table.exposure_ev,
        "rotation_deg": table.rotation_deg,
    });
    add_tint(&mut params, table);
    params
}

/// Role of the map of the surroundings among the stage's outputs.
const SURROUNDINGS: &str = "surroundings";

fn has_surroundings(manifest: &Manifest) -> bool {
    manifest.outputs.iter().any(|o| o.role == SURROUNDINGS)
}

/// Adds the files of the light that the composite reads to its plan.
pub fn add_inputs(session: &Session, plan: &mut StagePlan) -> anyhow::Result<()> {
    let manifest = manifest(session)?;
    let roles: &[&str] = match has_surroundings(&manifest) {
        true => &["lighting", "tone", SURROUNDINGS],
        false => &["lighting", "tone"],
    };
    Ok(plan.outputs_of(&manifest, roles)?)
}

/// A light that the light stage recovered.
pub struct Recovered {
    /// The lobes, on the photograph's scale. Where there are `surroundings`, only the sources that are
    /// not in them.
    pub lobes: SgMixture,
    /// The rest of the light, where it is a map.
    pub surroundings: Option<EnvironmentMap>,
    /// The tone curves that were recovered with it.
    pub tone: ToneCurves,
}

/// What the light stage left, exposed and turned; an error that says what to do if there is
/// nothing. `scene` is the manifest of the scene that is lit.
pub fn recovered(
    session: &Session,
    table: &CompositeTable,
    scene: &Manifest,
) -> anyhow::Result<Recovered> {
    let folder = LIGHT.folder(session);
    let manifest = manifest(session)?;
    warn_of_another_scene(session, &manifest, scene);
    let lighting_file = manifest.output(&folder, "lighting")?;
    let tone_file = manifest.output(&folder, "tone")?;
    let lighting = Lighting::read(&lighting_file)?;
    let mut lobes = lighting.exposed_lobes();
    let surroundings = match has_surroundings(&manifest) {
        true => {
            lobes.truncate(lighting.sources);
            Some(EnvironmentMap::read(
                manifest.output(&folder, SURROUNDINGS)?,
            )?)
        }
        false => None,
    };
    let tone = ToneCurves::read_json(&tone_file)?;
    exposed(session, table, lobes, surroundings, tone)
}

/// A light on the photograph's scale, exposed and turned as `[composite]` says.
pub(super) fn exposed(
    session: &Session,
    table: &CompositeTable,
    lobes: Vec<SphericalGaussian>,
    surroundings: Option<EnvironmentMap>,
    tone: ToneCurves,
) -> anyhow::Result<Recovered> {
    let exposure = table.exposure_ev.exp2();
    let turn = Quat::from_rotation_y(table.rotation_deg.to_radians());
    let lobes = lobes.into_iter().map(|lobe| SphericalGaussian {
        direction: turn * lobe.direction,
        radiance: lobe.radiance * exposure * table.tint_gain(),
        ..lobe
    });
    let surroundings = surroundings
        .map(|map| tinted(session, table, table.placement().place(session, &map)?))
        .transpose()?;
    Ok(Recovered {
        lobes: SgMixture::new(lobes.collect()).map_err(|e| {
            let message = format!(
                "{} stops make a light that cannot be used: {e}",
                table.exposure_ev
            );
            session.config.invalid("composite.exposure_ev", message)
        })?,
        surroundings,
        tone,
    })
}

/// The manifest of the light stage; an error that says what to do if it has not run.
pub fn manifest(session: &Session) -> anyhow::Result<Manifest> {
    let folder = LIGHT.folder(session);
    if !folder.join(FILE_NAME).exists() {
        return Err(missing(&folder.join("lighting.json")));
    }
    Ok(LIGHT.manifest(session)?)
}

/// Warns if the light was recovered before the scene was set up anew.
pub fn warn_of_another_scene(session: &Session, light: &Manifest, scene: &Manifest) {
    if session.light.is_some() {
        return;
    }
    let of = |list: &[Artifact]| {
        let found = list.iter().find(|a| a.role == "scene");
        found.map(|a| a.blake3.clone())
    };
    if of(&light.inputs) != of(&scene.outputs) {
        session.warn(
            "the light was recovered for another set-up of the scene; run dipir-light again to \
             recover it for this one",
        );
    }
}

/// The error of a stage that needs a light where there is none.
pub fn missing(recovered: &Path) -> anyhow::Error {
    anyhow::anyhow!(
        "there is no light: [composite] environment is not set and {} is missing; name a map, as \
         in --set composite.environment=sky.hdr, or run dipir-light first",
        recovered.display()
    )
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use glam::Vec3;

    use super::*;
    use crate::command_line::light::Cli;

    #[test]
    fn an_exposure_beyond_all_numbers_is_refused_by_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        std::fs::write(&file, "").unwrap();
        let args = ["dipir-light", "-q", "-p", &file.display().to_string()];
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        let table = CompositeTable {
            exposure_ev: 64.0,
            ..CompositeTable::default()
        };
        let light = |radiance: f32| {
            let map = EnvironmentMap::constant(4, 2, Vec3::splat(radiance));
            exposed(&session, &table, vec![], Some(map), ToneCurves::identity())
        };
        assert!(light(1.0).is_ok());
        let message = format!("{:#}", light(1e20).err().expect("refused"));
        assert!(
            message.contains("composite.exposure_ev")
                && message.contains("64 stops take the map's"),
            "{message}"
        );
    }
}
