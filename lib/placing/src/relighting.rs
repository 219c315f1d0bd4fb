//! The light of objects that stay where they are, while the sun is turned and the exposure changed.
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_preview::relit::{Piece, Relit};
use dipir_render::error::RenderError;
use dipir_scene::camera::Camera;
use dipir_stages::light::at_hand::{AtHand, Origin};
use glam::{Quat, Vec3};
use serde_json::Value;

use crate::edit::{Edit, SunEdit};
use crate::shown::description;

/// What was recorded last, and under which light it was looked at.
#[derive(Default)]
pub struct Relighting {
    record: Option<Recorded>,
    known: Option<Known>,
}

struct Recorded {
    /// What the record depends on.
    key: String,
    relit: Relit,
    camera: Camera,
}

/// A light with its sun and its exposure.
struct Known {
    key: String,
    light: AtHand,
    /// Where the light comes from.
    words: &'static str,
    sun: Option<SunEdit>,
    exposure_ev: f64,
    /// The exposure that the file says.
    said_ev: f64,
}

impl Relighting {
    /// Whether the objects are recorded as they stand in an edit that depends on `key`.
    pub fn is_recorded(&self, key: &str) -> bool {
        self.record.as_ref().is_some_and(|r| r.key == key)
    }

    /// Takes a record, `None` to forget the last one.
    pub fn keep(&mut self, record: Option<(String, Relit, Camera)>) {
        self.record = record.map(|(key, relit, camera)| Recorded { key, relit, camera });
    }

    /// Whether the light of `edit` follows from the one that is known.
    pub fn is_lit(&self, key: &str, edit: &Edit) -> bool {
        self.known.as_ref().is_some_and(|k| {
            let turns = k.light.origin == Origin::Estimate
                && k.sun.is_some()
                && edit.sun.is_some()
                && k.light.lobes.lobes().len() == 1;
            k.key == key && (k.sun == edit.sun || turns || k.light.origin.is_fixed())
        })
    }

    /// Takes the light of `edit` and where it comes from; `said_ev` is the exposure of the file.
    pub fn light_up(
        &mut self,
        key: &str,
        edit: &Edit,
        said_ev: f64,
        (light, words): (&AtHand, &'static str),
    ) {
        self.known = Some(Known {
            key: key.to_owned(),
            light: light.clone(),
            words,
            sun: edit.sun,
            exposure_ev: edit.exposure_ev.unwrap_or(said_ev),
            said_ev,
        });
    }

    /// The picture under the sun and exposure of `edit`, and what the page says of its light. `None` if the
    /// objects change nothing, or nothing is recorded.
    ///
    /// # Errors
    /// If the record was lost.
    pub fn picture(&self, edit: &Edit) -> Result<Option<(Piece, Value)>, RenderError> {
        let (Some(record), Some(known)) = (&self.record, &self.known) else {
            return Ok(None);
        };
        let light = match (&known.sun, &edit.sun) {
            (Some(from), Some(to)) if known.light.origin == Origin::Estimate => {
                turned(&known.light, from, to)
            }
            _ => known.light.clone(),
        };
        let stops = edit.exposure_ev.unwrap_or(known.said_ev) - known.exposure_ev;
        let piece = record.relit.under(&light, stops.exp2() as f32)?;
        let said = description(&light, known.words, &record.camera);
        Ok(piece.map(|piece| (piece, said)))
    }
}

/// `light`, whose one lobe stands at `from`, with the lobe at `to`. The rest stays: of a sun whose
/// direction is known the estimate does not depend on the direction.
fn turned(light: &AtHand, from: &SunEdit, to: &SunEdit) -> AtHand {
    let right = (to.azimuth_deg - from.azimuth_deg).to_radians() as f32;
    let up = (to.elevation_deg.to_radians() as f32).sin_cos();
    let turn = |lobe: &SphericalGaussian| {
        let level = Vec3::new(lobe.direction.x, 0.0, lobe.direction.z);
        let ahead = level.try_normalize().unwrap_or(Vec3::NEG_Z);
        let ahead = Quat::from_rotation_y(-right) * ahead;
        SphericalGaussian {
            direction: (ahead * up.1 + Vec3::Y * up.0).normalize(),
            ..*lobe
        }
    };
    let lobes = light.lobes.lobes().iter().map(turn).collect();
    AtHand {
        lobes: SgMixture::new(lobes).unwrap_or_else(|_| light.lobes.clone()),
        ..light.clone()
    }
}
