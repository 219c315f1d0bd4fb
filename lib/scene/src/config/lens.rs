//! What `[scene.camera]` says of another program's file, and of a lens that bends lines.
use dipir_cameras::Distortion;

use super::*;
use crate::camera::{FileSettings, Which};

/// The `[scene.camera.distortion]` table as written: the coefficients of a lens as OpenCV names them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DistortionConfig {
    /// Whether the lens is a fisheye, imaged by its angle (Kannala and Brandt's model, `k1` to `k4`);
    /// otherwise radii are stretched and decentred (Brown and Conrady's, `k1` to `k4`, `p1` and `p2`).
    #[schemars(extend("default" = false), example = true)]
    pub fisheye: bool,
    /// Radial, at the radius or angle squared.
    #[schemars(extend("default" = 0.0), example = -0.12)]
    pub k1: f64,
    /// Radial, at its fourth power.
    #[schemars(extend("default" = 0.0), example = 0.03)]
    pub k2: f64,
    /// Radial, at its sixth power.
    #[schemars(extend("default" = 0.0), example = -0.002)]
    pub k3: f64,
    /// Radial, at its eighth power.
    #[schemars(extend("default" = 0.0), example = 0.0001)]
    pub k4: f64,
    /// Tangential, upwards and downwards.
    #[schemars(extend("default" = 0.0), example = 0.0005)]
    pub p1: f64,
    /// Tangential, to the sides.
    #[schemars(extend("default" = 0.0), example = -0.0003)]
    pub p2: f64,
}

impl DistortionConfig {
    pub(super) fn validate(&self) -> Result<Distortion, Error> {
        let k = [self.k1, self.k2, self.k3, self.k4];
        let tangential = [self.p1, self.p2];
        if self.fisheye && tangential != [0.0; 2] {
            return Err(conflict(
                "scene.camera.distortion.fisheye",
                "scene.camera.distortion.p1",
            ));
        }
        let lens = match self.fisheye {
            true => Distortion::kannala_brandt(k),
            false => Distortion::brown_conrady(k, [0.0; 3], tangential),
        };
        lens.ok_or_else(|| {
            wrong(
                "scene.camera.distortion",
                format!("{k:?}, {tangential:?}"),
                "finite numbers, for instance k1 = -0.12",
            )
        })
    }
}

impl CameraConfig {
    /// A camera in a file; `photo` is the photograph.
    pub(super) fn validate_file(
        &self,
        key: &'static str,
        path: &Path,
        photo: &Path,
    ) -> Result<CameraSettings, Error> {
        let of_transforms = key == "transforms";
        let stands = [
            ("position", self.position.is_some()),
            ("look_at", self.look_at.is_some()),
            ("up", self.up.is_some()),
            ("pitch_deg", self.pitch_deg.is_some()),
            ("roll_deg", self.roll_deg.is_some()),
            ("heading_deg", self.heading_deg.is_some()),
        ];
        let lens = [
            ("principal_px", self.principal_px.is_some()),
            // A .chan file may lack it.
            ("fov_deg", self.fov_deg.is_some() && !is_chan(path)),
            ("focal_mm", self.focal_mm.is_some()),
            ("sensor_mm", self.sensor_mm.is_some()),
            ("distortion", self.distortion.is_some()),
        ];
        let other = [
            ("file", of_transforms && self.file.is_some()),
            ("file_up", of_transforms && self.file_up.is_some()),
            ("file_scale", of_transforms && self.file_scale.is_some()),
            ("image", of_transforms && self.image.is_some()),
            (
                "transforms_up",
                !of_transforms && self.transforms_up.is_some(),
            ),
        ];
        let stands = stands.into_iter().filter(|_| of_transforms);
        let all = stands.chain(lens).chain(other);
        if let Some((name, _)) = all.clone().find(|(_, given)| *given) {
            return Err(conflict(
                &format!("scene.camera.{key}"),
                &format!("scene.camera.{name}"),
            ));
        }
        let which = match (&self.image, self.frame) {
            (Some(_), Some(_)) => {
                return Err(conflict("scene.camera.image", "scene.camera.frame"));
            }
            (Some(name), None) => Which::Name(name.clone()),
            (None, Some(number)) => Which::Number(number),
            (None, None) if of_transforms => Which::Number(0),
            (None, None) => Which::Photo(photo.into()),
        };
        let scale = self.file_scale.unwrap_or(1.0);
        if !(scale.is_finite() && scale > 0.0) {
            let accepted = "metres above 0 of a unit of the file, for instance file_scale = 0.01";
            return Err(wrong("scene.camera.file_scale", scale, accepted));
        }
        let has_stand = self.position.is_some() && !of_transforms;
        Ok(CameraSettings::File(FileSettings {
            key,
            path: path.into(),
            which,
            up: match of_transforms {
                true => world_up("scene.camera.transforms_up", &self.transforms_up)?,
                false => world_up("scene.camera.file_up", &self.file_up)?,
            },
            scale,
            stand: match has_stand {
                true => Some(self.stand()?),
                false => None,
            },
            fov_deg: self.fov_deg,
        }))
    }
}

fn is_chan(path: &Path) -> bool {
    let extension = path.extension();
    extension.is_some_and(|e| e.eq_ignore_ascii_case("chan"))
}

/// An axis by its word.
pub(super) fn world_up(key: &str, word: &Option<String>) -> Result<Option<WorldUp>, Error> {
    Ok(match word.as_deref() {
        None => None,
        Some("z") => Some(WorldUp::Z),
        Some("y") => Some(WorldUp::Y),
        Some("-y") => Some(WorldUp::MinusY),
        Some(other) => return Err(wrong_word(key, other, &["z", "y", "-y"])),
    })
}
