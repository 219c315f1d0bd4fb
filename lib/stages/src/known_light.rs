//! Which light a stage works under.
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_imaging::raster::LinearImage;
use dipir_light::environment::EnvironmentMap;
use dipir_optimize::settings::LightTable;
use dipir_pipeline::config::Config;
use dipir_pipeline::error::ConfigError;
use dipir_scene::camera::Camera;
use dipir_scene::config::SceneConfig;
use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use crate::composite::table::CompositeTable;

/// A light that is a map.
pub struct Light {
    /// Radiance from everywhere, on the photograph's scale.
    pub map: Arc<EnvironmentMap>,
}

/// What decides the light of `[composite] environment`, and its file, as the configuration names it;
/// `None` if the key is not set.
pub fn known_params(table: &CompositeTable) -> Option<(Value, &Path)> {
    let path = table.environment.as_deref()?;
    let mut params = json!({
        "environment": path,
        "exposure_ev": table.exposure_ev,
        "rotation_deg": table.rotation_deg,
    });
    add_tint(&mut params, table);
    Some((params, path))
}

/// Adds a tint to what decides a light, if there is one.
pub(crate) fn add_tint(params: &mut Value, table: &CompositeTable) {
    if let Some(tint) = table.tint {
        params["tint"] = json!(tint);
    }
}

/// `map` with another white balance.
///
/// # Errors
/// If its radiance is beyond `f32`.
pub(crate) fn tinted(
    session: &Session,
    table: &CompositeTable,
    map: EnvironmentMap,
) -> anyhow::Result<EnvironmentMap> {
    let Some(tint) = table.tint else {
        return Ok(map);
    };
    let gain = table.tint_gain();
    let texels = map.texels().iter().map(|texel| *texel * gain).collect();
    EnvironmentMap::new(map.width(), map.height(), texels).map_err(|e| {
        let message = format!("{tint:?} stops make a light that cannot be used: {e}");
        session.config.invalid("composite.tint", message).into()
    })
}

/// The map of `[composite] environment`, exposed and turned; `None` if the key is not set.
pub fn known(session: &Session, table: &CompositeTable) -> anyhow::Result<Option<Light>> {
    let Some((_, path)) = known_params(table) else {
        return Ok(None);
    };
    let map = table
        .placement()
        .read(session, "composite.environment", path)?;
    let map = tinted(session, table, map)?;
    Ok(Some(Light { map: Arc::new(map) }))
}

/// How a map is brought to the photograph's scale and turned into its world. Keys are dotted.
pub struct Placement {
    /// Its key, and stops.
    pub exposure_ev: (&'static str, f32),
    /// Its key, and degrees about the vertical, counter-clockwise from above.
    pub rotation_deg: (&'static str, f32),
}

impl Placement {
    /// Refuses values that no map can be placed with.
    ///
    /// # Errors
    /// Those values, by key.
    pub fn check(&self, config: &Config) -> Result<(), ConfigError> {
        let (key, stops) = self.exposure_ev;
        if !(stops.abs() <= 64.0) {
            return Err(config.out_of_range(key, stops, "stops from -64 to 64"));
        }
        let (key, degrees) = self.rotation_deg;
        if !degrees.is_finite() {
            return Err(config.invalid(key, "must be a finite angle in degrees"));
        }
        Ok(())
    }

    /// The map of `path`, the value of `file_key`, exposed and turned.
    ///
    /// # Errors
    /// On values that [`check`](Self::check) refuses, on a file that is no map, and on radiance beyond `f32`.
    pub fn read(
        &self,
        session: &Session,
        file_key: &str,
        path: &Path,
    ) -> anyhow::Result<EnvironmentMap> {
        self.check(&session.config)?;
        let map = EnvironmentMap::read(session.resolve(path))
            .with_context(|| format!("cannot use {file_key} = \"{}\"", path.display()))?;
        self.place(session, &map)
    }

    /// `map`, exposed and turned.
    ///
    /// # Errors
    /// On radiance beyond `f32`.
    pub(crate) fn place(
        &self,
        session: &Session,
        map: &EnvironmentMap,
    ) -> anyhow::Result<EnvironmentMap> {
        let most = |m: f32, t: &Vec3| m.max(t.max_element());
        let largest = map.texels().iter().fold(0.0, most);
        let (key, stops) = self.exposure_ev;
        if !(largest * stops.exp2()).is_finite() {
            let message = format!(
                "{stops} stops take the map's largest radiance, {largest}, beyond what 32-bit numbers hold; expose it less"
            );
            return Err(session.config.invalid(key, message).into());
        }
        Ok(map
            .scaled(stops.exp2())
            .rotated_y(f64::from(self.rotation_deg.1).to_radians()))
    }
}

/// Warns of keys that only an estimated light uses, where a map gives the light.
///
/// # Errors
/// On a `[light]` table that cannot be read.
pub fn warn_of_unused(session: &Session) -> anyhow::Result<()> {
    let table: LightTable = session.config.table("light")?;
    let scene: SceneConfig = session.config.table("scene")?;
    let views = (!scene.views.is_empty()).then_some("scene.views");
    let given: Vec<&str> = table.only_of_estimates().chain(views).collect();
    if !given.is_empty() {
        session.warn(&format!(
            "composite.environment gives the light, so that {} changes nothing; remove one of them",
            given.join(", ")
        ));
    }
    Ok(())
}

/// The photograph in the directions that it shows, mirrored behind the camera, its borders drawn out: a
/// light of `width` x `height` texels without any model.
pub fn projected(
    photo: &LinearImage,
    camera: &Camera,
    [width, height]: [usize; 2],
) -> anyhow::Result<EnvironmentMap> {
    let empty = EnvironmentMap::constant(width, height, Vec3::ZERO);
    let back = camera.rotation.z_axis;
    let last = Vec2::new((photo.0.width() - 1) as f32, (photo.0.height() - 1) as f32);
    let texel = |k: usize| {
        let direction = empty.direction_of(k / width, k % width);
        // Into the view: mirrored at the plane of the picture, and never parallel to it.
        let depth = direction.dot(back);
        let ahead = direction - back * (depth + depth.abs().max(1e-3));
        let pixel = camera
            .project(camera.position + ahead)
            .unwrap_or(camera.principal_px);
        let pixel = pixel.clamp(Vec2::ZERO, last);
        *photo.0.get(pixel.x as usize, pixel.y as usize)
    };
    Ok(EnvironmentMap::new(
        width,
        height,
        (0..width * height).map(texel).collect(),
    )?)
}
