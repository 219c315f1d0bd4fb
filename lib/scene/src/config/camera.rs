//! What `[scene.camera]` says, checked.
use dipir_cameras::Distortion;
use dipir_cameras::neighbours::Neighbour;
use dipir_imaging::facts::Facts;

use super::*;
use crate::camera::{FARTHEST_M, FileSettings};

impl SceneConfig {
    /// Where the camera stands in the frames of a shot before and after the photograph, relative to `base_dir` and as far as its
    /// file has them. They are turned as the photograph is, if `facts` of it are given.
    ///
    /// # Errors
    /// As where the scene is loaded.
    pub fn neighbours(
        &self,
        facts: Option<&Facts>,
        base_dir: &Path,
    ) -> Result<[Option<Neighbour>; 2], Error> {
        let Some(mut file) = self.camera_file()? else {
            return Ok([None; 2]);
        };
        file.orientation = facts.map_or(1, |facts| facts.orientation);
        file.neighbours(facts.map(|facts| facts.size), base_dir)
    }

    /// Whether every picture of a shot has the photograph's camera.
    ///
    /// # Errors
    /// On a camera that cannot be one.
    pub fn camera_stands_still(&self, base_dir: &Path) -> Result<bool, Error> {
        let file = self.camera_file()?;
        Ok(file.is_none_or(|file| file.stands_still(base_dir)))
    }

    /// The frame that the photograph shows of a camera that moves, if the names of the pictures beside it tell which.
    pub fn shown_frame(&self, base_dir: &Path) -> Option<u32> {
        let file = self.camera_file().ok()??;
        Some(file.shown(base_dir)?.frame)
    }

    fn camera_file(&self) -> Result<Option<FileSettings>, Error> {
        let Some((camera, photo)) = self.camera.as_ref().zip(self.background.as_ref()) else {
            return Ok(None);
        };
        Ok(match camera.validate(photo)? {
            CameraSettings::File(file) => Some(file),
            CameraSettings::LookAt { .. } => None,
        })
    }
}

impl CameraConfig {
    /// `photo` is the photograph, by whose name a file's camera is found.
    pub(super) fn validate(&self, photo: &Path) -> Result<CameraSettings, Error> {
        match (&self.transforms, &self.file) {
            (Some(path), _) => self.validate_file("transforms", path, photo),
            (None, Some(path)) => self.validate_file("file", path, photo),
            (None, None) => self.validate_look_at(),
        }
    }

    fn validate_look_at(&self) -> Result<CameraSettings, Error> {
        for (name, given) in [
            ("frame", self.frame.is_some()),
            ("image", self.image.is_some()),
            ("file_up", self.file_up.is_some()),
            ("file_rotation_order", self.file_rotation_order.is_some()),
            ("file_scale", self.file_scale.is_some()),
            ("transforms_up", self.transforms_up.is_some()),
        ] {
            if given {
                return Err(missing(
                    "scene.camera.file",
                    &format!("name the camera's file that scene.camera.{name} is about"),
                ));
            }
        }
        let [position, look_at, up] = self.stand()?;
        Ok(CameraSettings::LookAt {
            position,
            look_at,
            up,
            field_of_view: self.field_of_view()?,
            principal_px: finite_pixel("scene.camera.principal_px", self.principal_px)?,
            distortion: match &self.distortion {
                None => Distortion::NONE,
                Some(table) => table.validate()?,
            },
        })
    }

    /// Position, point looked at and up.
    pub(super) fn stand(&self) -> Result<[Vec3; 3], Error> {
        let point = |name: &str, value: Option<[f32; 3]>| {
            let key = format!("scene.camera.{name}");
            match value {
                Some(p) => finite_point(&key, p),
                None => Err(missing(
                    &key,
                    &format!("write {name} = [x, y, z] in metres"),
                )),
            }
        };
        let position = point("position", self.position)?;
        if position.abs().max_element() > FARTHEST_M {
            return Err(wrong(
                "scene.camera.position",
                triple(position),
                "metres, at most ten million from the origin, for instance [0.0, 1.6, 4.0]",
            ));
        }
        if self.is_turned() {
            let (look_at, up) = self.turned(position)?;
            return Ok([position, look_at, up]);
        }
        let look_at = point("look_at", self.look_at)?;
        let backward = position - look_at;
        if backward.length() < 1e-6 * (1.0 + position.length()) {
            return Err(wrong(
                "scene.camera.look_at",
                triple(look_at),
                "a point away from scene.camera.position",
            ));
        }
        let up = finite_point("scene.camera.up", self.up.unwrap_or([0.0, 1.0, 0.0]))?;
        // Below a thousandth of a radian between both directions roll is down to rounding.
        if backward.normalize().cross(up.normalize_or_zero()).length() < 1e-3 {
            return Err(wrong(
                "scene.camera.up",
                triple(up),
                "a direction across the line of sight; looking straight down or up, write up = [0.0, 0.0, -1.0]",
            ));
        }
        Ok([position, look_at, up])
    }

    /// Whether angles say where it looks.
    pub(super) fn is_turned(&self) -> bool {
        let angles = [self.pitch_deg, self.roll_deg, self.heading_deg];
        angles.iter().any(Option::is_some)
    }

    /// The point in the centre of the image and what is up in it, of a camera that looks along -z,
    /// turned by `pitch_deg`, `roll_deg` and `heading_deg`.
    pub(super) fn turned(&self, position: Vec3) -> Result<(Vec3, Vec3), Error> {
        let given = match (self.pitch_deg, self.roll_deg) {
            (Some(_), _) => "scene.camera.pitch_deg",
            (None, Some(_)) => "scene.camera.roll_deg",
            (None, None) => "scene.camera.heading_deg",
        };
        for (name, other) in [("look_at", self.look_at), ("up", self.up)] {
            if other.is_some() {
                return Err(conflict(given, &format!("scene.camera.{name}")));
            }
        }
        let angle_rad = |name: &str, value: Option<f32>, most: f32| {
            let value = value.unwrap_or(0.0);
            match value.abs() <= most {
                true => Ok(f64::from(value).to_radians()),
                false => Err(wrong(
                    &format!("scene.camera.{name}"),
                    value,
                    &format!("degrees from -{most} to {most}, for instance {name} = -5.0"),
                )),
            }
        };
        let pitch = angle_rad("pitch_deg", self.pitch_deg, 90.0)?;
        let roll = angle_rad("roll_deg", self.roll_deg, 180.0)?;
        let heading = angle_rad("heading_deg", self.heading_deg, 360.0)?;
        let rotation = DMat3::from_rotation_y(-heading)
            * DMat3::from_rotation_x(pitch)
            * DMat3::from_rotation_z(-roll);
        // Far enough that rounding the point does not turn the line of sight.
        let distance = 1.0 + position.as_dvec3().length();
        let look_at = position.as_dvec3() - distance * rotation.z_axis;
        Ok((look_at.as_vec3(), rotation.y_axis.as_vec3()))
    }

    pub(super) fn field_of_view(&self) -> Result<FieldOfView, Error> {
        let millimetres = |name: &str, value: f32| {
            if value.is_finite() && value > 0.0 {
                Ok(value)
            } else {
                Err(wrong(
                    &format!("scene.camera.{name}"),
                    value,
                    "millimetres above 0, for instance focal_mm = 35.0 with sensor_mm = 36.0",
                ))
            }
        };
        match (self.fov_deg, self.focal_mm, self.sensor_mm) {
            (Some(_), Some(_), _) => Err(conflict("scene.camera.fov_deg", "scene.camera.focal_mm")),
            (Some(_), _, Some(_)) => {
                Err(conflict("scene.camera.fov_deg", "scene.camera.sensor_mm"))
            }
            (Some(fov), None, None) if fov > 0.0 && fov < 180.0 => {
                Ok(FieldOfView::Vertical(fov.to_radians()))
            }
            (Some(fov), None, None) => Err(wrong(
                "scene.camera.fov_deg",
                fov,
                "a vertical field of view between 0 and 180 degrees, for instance fov_deg = 40.0",
            )),
            (None, Some(focal), Some(sensor)) => Ok(FieldOfView::Lens {
                focal_mm: millimetres("focal_mm", focal)?,
                sensor_mm: millimetres("sensor_mm", sensor)?,
            }),
            // The photograph may know its sensor.
            (None, Some(focal), None) => Ok(FieldOfView::Focal(millimetres("focal_mm", focal)?)),
            (None, None, Some(_)) => Err(missing(
                "scene.camera.focal_mm",
                "scene.camera.sensor_mm needs the focal length, for instance focal_mm = 35.0",
            )),
            // The photograph may know all of it.
            (None, None, None) => Ok(FieldOfView::Photograph),
        }
    }
}
