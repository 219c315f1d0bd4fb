//! The keys of `[scene]` that say what of the photograph stands in front.
use dipir_points::scale::Measure;

use super::*;

impl SceneConfig {
    /// The mask and the depths, unless the effect is switched off.
    pub(super) fn foreground(&self) -> Result<(Option<PathBuf>, Option<DepthSettings>), Error> {
        if let Some(mask) = &self.occluders {
            named("scene.occluders", mask)?;
        }
        let depth = self.depth_settings()?;
        if self.effects.occluders == Some(EffectSwitch::Off) {
            return Ok((None, None));
        }
        Ok((self.occluders.clone(), depth))
    }

    fn depth_settings(&self) -> Result<Option<DepthSettings>, Error> {
        let measure = match self.depth_kind.as_deref() {
            None | Some("auto") => None,
            Some("depth") => Some(Measure::Depth),
            Some("disparity") => Some(Measure::Disparity),
            Some(other) => {
                let accepted = ["auto", "depth", "disparity"];
                return Err(wrong_word("scene.depth_kind", other, &accepted));
            }
        };
        if let Some(scale) = self.depth_scale {
            if !(scale.is_finite() && scale > 0.0) {
                let accepted =
                    "metres above 0 of a unit of the depths, for instance depth_scale = 1.0";
                return Err(wrong("scene.depth_scale", scale, accepted));
            }
            if measure == Some(Measure::Disparity) {
                return Err(conflict(
                    "scene.depth_scale",
                    "scene.depth_kind = \"disparity\"",
                ));
            }
        }
        let Some(path) = &self.depth else {
            for (name, is_given) in [
                ("depth_kind", self.depth_kind.is_some()),
                ("depth_scale", self.depth_scale.is_some()),
                ("depth_surfaces", self.depth_surfaces.is_some()),
            ] {
                if is_given {
                    let remedy = format!("name the file of depths, or remove scene.{name}");
                    return Err(missing("scene.depth", &remedy));
                }
            }
            return Ok(None);
        };
        named("scene.depth", path)?;
        Ok(Some(DepthSettings {
            path: path.clone(),
            measure,
            scale: self.depth_scale,
            catches: self.depth_surfaces.unwrap_or(true),
        }))
    }
}
