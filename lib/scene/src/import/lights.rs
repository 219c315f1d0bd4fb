//! `KHR_lights_punctual` of a glTF document.
use glam::{DMat4, DVec3, Vec3};
use serde::Deserialize;

use super::accessor::get;
use super::document::{Document, raw_extension};
use crate::error::Error;
use crate::light::{LightKind, PunctualLight};

pub(super) const LIGHTS: &str = "KHR_lights_punctual";

/// The extension of the document.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct List {
    lights: Vec<Light>,
}

/// The extension of a node.
#[derive(Debug, Deserialize)]
struct Use {
    light: u32,
}

#[derive(Debug, Deserialize)]
struct Light {
    #[serde(default)]
    name: String,
    #[serde(rename = "type")]
    kind: String,
    color: Option<[f32; 3]>,
    intensity: Option<f32>,
    range: Option<f32>,
    #[serde(default)]
    spot: Spot,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Spot {
    inner_cone_angle: Option<f32>,
    outer_cone_angle: Option<f32>,
}

/// The lights at the nodes that `globals` places and that are not `hidden`, in the file's
/// coordinates.
pub(super) fn read(
    document: &Document,
    globals: &[Option<DMat4>],
    hidden: &[bool],
) -> Result<Vec<PunctualLight>, Error> {
    let list: List = match &document.extensions {
        Some(e) => raw_extension(&e.others, LIGHTS, "the document")?.unwrap_or_default(),
        None => List::default(),
    };
    let mut found = Vec::new();
    for (i, node) in document.nodes.iter().enumerate() {
        let (Some(global), Some(extensions), false) = (globals[i], &node.extensions, hidden[i])
        else {
            continue;
        };
        let at = format!("nodes[{i}]");
        if let Some(Use { light }) = raw_extension(&extensions.others, LIGHTS, &at)? {
            let place = format!("{at}.extensions.{LIGHTS}.light");
            let light = get(&list.lights, light as usize, &place, "lights")?;
            found.push(light.at(&global, &place)?);
        }
    }
    Ok(found)
}

impl Light {
    fn at(&self, global: &DMat4, place: &str) -> Result<PunctualLight, Error> {
        let wrong = |what: &str| {
            Err(Error::malformed(
                format!("the light of {place} has {what}"),
                "export the file again",
            ))
        };
        let inner = self.spot.inner_cone_angle.unwrap_or(0.0);
        let outer = self
            .spot
            .outer_cone_angle
            .unwrap_or(std::f32::consts::FRAC_PI_4);
        let kind = match self.kind.as_str() {
            "directional" => LightKind::Directional,
            "point" => LightKind::Point,
            "spot" if !(inner >= 0.0 && inner < outer && outer <= std::f32::consts::FRAC_PI_2) => {
                return wrong(&format!(
                    "a cone from {inner} to {outer}; accepted: 0 <= inner < outer <= pi/2"
                ));
            }
            "spot" => LightKind::Spot {
                inner_cone_rad: inner,
                outer_cone_rad: outer,
            },
            other => {
                return wrong(&format!(
                    "the type \"{other}\"; accepted: directional, point, spot"
                ));
            }
        };
        let color = Vec3::from_array(self.color.unwrap_or([1.0; 3]));
        let intensity = self.intensity.unwrap_or(1.0);
        let range = self.range.unwrap_or(1.0);
        let numbers = [color.x, color.y, color.z, intensity, range];
        if !numbers.iter().all(|v| v.is_finite() && *v >= 0.0) {
            return wrong("a colour, intensity or range that is negative or not finite");
        }
        Ok(PunctualLight {
            name: self.name.clone(),
            kind,
            color,
            intensity,
            range: self.range,
            position: global.w_axis.truncate(),
            // Lights shine along their node's -z.
            direction: global
                .transform_vector3(DVec3::NEG_Z)
                .normalize_or(DVec3::NEG_Z),
        })
    }
}
