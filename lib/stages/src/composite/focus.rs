//! Depth of field, as `[composite]` and the photograph's own data say.
use dipir_pipeline::config::Config;
use dipir_pipeline::error::ConfigError;
use dipir_render::lens::ThinLens;
use dipir_scene::scene::LoadedScene;
use glam::Vec2;
use serde_json::{Value, json};

use super::table::CompositeTable;
use crate::scene::with_place;

/// Farthest distance of what is sharp, metres.
const FARTHEST_M: f32 = 1e5;
/// Widest opening, millimetres, and most f-number.
const WIDEST_MM: f32 = 1e3;
/// Discs of a smaller radius are not seen, pixels.
pub(super) const LEAST_PX: f32 = 0.25;

impl CompositeTable {
    pub(super) fn check_focus(&self, config: &Config) -> Result<(), ConfigError> {
        let positive = [
            (
                "focus_m",
                self.focus_m,
                FARTHEST_M,
                "metres above 0, at most 100000, as in 2.5",
            ),
            (
                "f_number",
                self.f_number,
                WIDEST_MM,
                "a number above 0, at most 1000, as in 1.8",
            ),
            (
                "aperture_mm",
                self.aperture_mm,
                WIDEST_MM,
                "millimetres above 0, at most 1000, as in 28.0",
            ),
        ];
        for (key, value, most, accepted) in positive {
            if let Some(v) = value
                && !(v > 0.0 && v <= most)
            {
                let key = format!("composite.{key}");
                return Err(config.out_of_range(&key, format!("{v:?}"), accepted));
            }
        }
        let excluded = [
            (
                "focus_at_pixel",
                "focus_m",
                self.focus_at_pixel.is_some() && self.focus_m.is_some(),
            ),
            (
                "aperture_mm",
                "f_number",
                self.aperture_mm.is_some() && self.f_number.is_some(),
            ),
        ];
        for (key, other, both) in excluded {
            if both {
                let message = format!("excludes {other}; keep one of the two");
                return Err(config.invalid(&format!("composite.{key}"), message));
            }
        }
        if self.focus_m.is_none() && self.focus_at_pixel.is_none() {
            let given = [
                ("aperture_mm", self.aperture_mm),
                ("f_number", self.f_number),
            ];
            if let Some((key, _)) = given.into_iter().find(|(_, v)| v.is_some()) {
                let message = "blurs what is out of focus; say what is in focus, too: focus_m = 2.5, or focus_at_pixel";
                return Err(config.invalid(&format!("composite.{key}"), message));
            }
        }
        Ok(())
    }

    /// What of the table says how the picture is focused; `None` if nothing does.
    pub(super) fn focus_params(&self) -> Option<Value> {
        let focus = match (self.focus_m, self.focus_at_pixel) {
            (Some(metres), _) => json!(metres),
            (None, pixel) => json!(pixel?),
        };
        Some(json!({"at": focus, "f_number": self.f_number, "aperture_mm": self.aperture_mm}))
    }

    /// The lens that the photograph was taken by, if the table says where it was focused.
    ///
    /// # Errors
    /// Where nothing is seen at the pixel that is in focus, and where nothing tells how wide the lens was open.
    pub(crate) fn lens(
        &self,
        config: &Config,
        loaded: &LoadedScene,
    ) -> anyhow::Result<Option<ThinLens>> {
        let camera = &loaded.scene.camera;
        let focus = match (self.focus_m, self.focus_at_pixel) {
            (Some(metres), _) => metres,
            (None, Some(pixel)) => {
                let key = "composite.focus_at_pixel";
                let seen = loaded.seen_at(Vec2::from(pixel), key);
                camera.depth(seen.map_err(|e| with_place(e, config))?)
            }
            (None, None) => return Ok(None),
        };
        let diameter_mm = match self.aperture_mm {
            Some(mm) => mm,
            None => self.diameter_mm(config, loaded)?,
        };
        let lens = ThinLens {
            radius: diameter_mm * 0.5e-3,
            focus,
        };
        Ok(Some(lens))
    }

    fn diameter_mm(&self, config: &Config, loaded: &LoadedScene) -> Result<f32, ConfigError> {
        let facts = &loaded.photo.facts;
        let f_number = self.f_number.or(facts.f_number.map(|n| n as f32));
        let missing = match (f_number, facts.focal_mm) {
            (Some(f_number), Some(focal_mm)) => return Ok(focal_mm as f32 / f_number),
            (None, _) => "how wide its lens was open",
            (_, None) => "the focal length of its lens",
        };
        let key = match (self.focus_m, self.f_number) {
            (_, Some(_)) => "composite.f_number",
            (Some(_), None) => "composite.focus_m",
            (None, None) => "composite.focus_at_pixel",
        };
        let message = format!(
            "the photograph does not say {missing}: write aperture_mm, its focal length over its f-number, as in 28.0 for 50 mm at f/1.8"
        );
        Err(config.invalid(key, message))
    }
}

/// Least and greatest radius of the discs that points of the objects are seen as, pixels.
pub(super) fn blur_px(lens: &ThinLens, loaded: &LoadedScene) -> [f32; 2] {
    let camera = &loaded.scene.camera;
    let positions = loaded.scene.mesh.positions.iter();
    let depths = positions.map(|p| camera.depth(*p)).filter(|d| *d > 0.0);
    let [nearest, farthest] = depths.fold([f32::INFINITY, 0.0], |[near, far], d| {
        [near.min(d), far.max(d)]
    });
    if farthest == 0.0 {
        return [0.0; 2];
    }
    let [near, far] = [nearest, farthest].map(|d| lens.blur_px(camera, d).max_element());
    let least = match (nearest..=farthest).contains(&lens.focus) {
        true => 0.0,
        false => near.min(far),
    };
    [least, near.max(far)]
}
