//! The `[scene.proxy]` table: what receives the shadow.
use dipir_cameras::Camera as LensCamera;
use dipir_points::Cloud;
use dipir_points::file::is_model;
use dipir_points::ground::Shape;

use super::lens::world_up;
use super::*;
use crate::ground::PointsSettings;
use crate::plane_of_pixels::PixelPlane;
use crate::proxy::Plane;

/// The `[scene.proxy]` table as written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ProxyConfig {
    /// An infinite plane.
    pub plane: Option<PlaneConfig>,
    /// A mesh in the coordinates of the scene, metres, in a format of objects. It replaces `plane`.
    /// It catches shadows and hides nothing: what stands in front of an object belongs into `scene.occluders` or `scene.depth`.
    #[schemars(extend("format" = "path"), example = &"room.glb")]
    pub mesh: Option<PathBuf>,
    /// Points of the scene; the ground through them replaces `plane`: `.ply`, `.pcd`, `.bin` of KITTI and
    /// nuScenes, COLMAP's folder or `points3D`, a depth map of the photograph (`.exr` in metres, `.png` of
    /// 16 bits in millimetres).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("format" = "path"), example = &"scan.bin")]
    pub points: Option<PathBuf>,
    /// Which axis of `points` points up.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["z", "y", "-y", "x", "-x"]), extend("x-default" = "`y` for `.ply`; for COLMAP that of the camera's `file`, else `-y`; others `z`"), example = &"z")]
    pub points_up: Option<String>,
    /// Metres of a unit of `points`; a factor on the metres of a depth map.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("exclusiveMinimum" = 0), extend("x-default" = "1; for COLMAP the camera's `file_scale`"), example = 0.01)]
    pub points_scale: Option<f32>,
    /// Where the sensor of `points` stands in the scene: KITTI's calibration (`.txt`) or its record of
    /// nuScenes (`.json`).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("format" = "path"), example = &"calib.txt")]
    pub points_pose: Option<PathBuf>,
    /// What the ground through `points` may be: a plane, a relief of heights on a grid, or what fits.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["auto", "plane", "relief"]), extend("default" = "auto"), example = &"plane")]
    pub points_shape: Option<String>,
    /// Pixels of the upright photograph that lie on the plane, column and row from 0, which with
    /// `lengths_m` or `camera_height_m` replace `plane`. The plane is level, or it follows from
    /// `rectangle` or from three lengths.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("examples" = [[[400.0, 900.0], [1500.0, 900.0], [1300.0, 700.0], [600.0, 700.0]]]))]
    pub pixels: Option<Vec<[f32; 2]>>,
    /// Known lengths on the plane: numbers of two of `pixels`, from 0, and the metres between them.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("examples" = [[[0.0, 1.0, 2.5]]]))]
    pub lengths_m: Option<Vec<[f32; 3]>>,
    /// Whether the four `pixels` are the corners of a rectangle, in order around it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("default" = false), example = true)]
    pub rectangle: Option<bool>,
    /// Height of the camera over the plane, metres, instead of a length. Alone it makes a level plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("exclusiveMinimum" = 0), example = 1.6)]
    pub camera_height_m: Option<f32>,
}

/// `plane = { point = …, normal = … }`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlaneConfig {
    /// Any point of the plane, metres.
    #[schemars(extend("examples" = [[0.0, 0.0, 0.0]]))]
    #[serde(default)]
    pub point: [f32; 3],
    /// Direction towards the side that is seen, of any length.
    #[schemars(extend("examples" = [[0.0, 1.0, 0.0]]))]
    #[serde(default = "plus_y")]
    pub normal: [f32; 3],
}

fn plus_y() -> [f32; 3] {
    [0.0, 1.0, 0.0]
}

/// A checked `[scene.proxy]` table.
#[derive(Clone, Debug, PartialEq)]
pub enum ProxySettings {
    /// No proxy.
    None,
    /// A plane with a unit normal.
    Plane(Plane),
    /// A mesh file.
    Mesh(PathBuf),
    /// The ground through points.
    Points(PointsSettings),
    /// A plane by pixels and lengths.
    Pixels(PixelPlane),
}

impl ProxySettings {
    /// What may be wrong with the points that were read, if there are any, as a sentence.
    pub(crate) fn doubt(
        &self,
        base_dir: &Path,
        view: &LensCamera,
        cloud: Option<&Cloud>,
    ) -> Option<String> {
        match self {
            Self::Points(points) => points.doubt(base_dir, view, cloud?),
            _ => None,
        }
    }
}

impl ProxyConfig {
    /// `camera` is the camera's table.
    pub(super) fn validate(&self, camera: &CameraConfig) -> Result<ProxySettings, Error> {
        let by_pixels = match &self.pixels {
            Some(_) => "pixels",
            None => "camera_height_m",
        };
        let ways = [
            ("plane", self.plane.is_some()),
            ("mesh", self.mesh.is_some()),
            ("points", self.points.is_some()),
            (
                by_pixels,
                self.pixels.is_some() || self.camera_height_m.is_some(),
            ),
        ];
        let given: Vec<&str> = ways.iter().filter(|w| w.1).map(|w| w.0).collect();
        if let [first, second, ..] = given[..] {
            let key = |name: &str| format!("scene.proxy.{name}");
            return Err(conflict(&key(first), &key(second)));
        }
        for (name, is_given, of) in [
            ("points_up", self.points_up.is_some(), "points"),
            ("points_scale", self.points_scale.is_some(), "points"),
            ("points_pose", self.points_pose.is_some(), "points"),
            ("points_shape", self.points_shape.is_some(), "points"),
            ("lengths_m", self.lengths_m.is_some(), "pixels"),
            ("rectangle", self.rectangle.is_some(), "pixels"),
        ] {
            if is_given && given != [of] {
                let remedy = format!("scene.proxy.{name} is about it");
                return Err(missing(&format!("scene.proxy.{of}"), &remedy));
            }
        }
        for (name, path) in [
            ("mesh", &self.mesh),
            ("points", &self.points),
            ("points_pose", &self.points_pose),
        ] {
            if let Some(path) = path {
                named(&format!("scene.proxy.{name}"), path)?;
            }
        }
        match given[..] {
            ["plane"] => self.plane.map_or(Ok(ProxySettings::None), |p| p.validate()),
            ["mesh"] => Ok(ProxySettings::Mesh(self.mesh.clone().unwrap_or_default())),
            ["points"] => self.validate_points(camera).map(ProxySettings::Points),
            [_] => self.validate_pixels().map(ProxySettings::Pixels),
            _ => Err(missing(
                "scene.proxy.plane",
                "write plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] } or mesh = \"proxy.glb\", or leave the table out",
            )),
        }
    }

    fn validate_points(&self, camera: &CameraConfig) -> Result<PointsSettings, Error> {
        let path = self.points.clone().unwrap_or_default();
        // COLMAP's points are in the world of its cameras.
        let of_camera = camera.file.as_ref().filter(|_| is_model(&path));
        let up = match (&self.points_up, of_camera) {
            (None, Some(_)) => world_up("scene.camera.file_up", &camera.file_up)?,
            (word, _) => world_up("scene.proxy.points_up", word)?,
        };
        let scale = match (self.points_scale, of_camera) {
            (None, Some(_)) => camera.file_scale.unwrap_or(1.0),
            (scale, _) => scale.unwrap_or(1.0),
        };
        if !(scale.is_finite() && scale > 0.0) {
            let accepted =
                "metres above 0 of a unit of the points, for instance points_scale = 0.01";
            return Err(wrong("scene.proxy.points_scale", scale, accepted));
        }
        Ok(PointsSettings {
            path,
            up,
            scale,
            pose: self.points_pose.clone(),
            shape: match self.points_shape.as_deref() {
                None | Some("auto") => Shape::Auto,
                Some("plane") => Shape::Plane,
                Some("relief") => Shape::Relief,
                Some(other) => {
                    let words = ["auto", "plane", "relief"];
                    return Err(wrong_word("scene.proxy.points_shape", other, &words));
                }
            },
        })
    }

    fn validate_pixels(&self) -> Result<PixelPlane, Error> {
        let mut pixels = Vec::new();
        for pixel in self.pixels.iter().flatten() {
            pixels.extend(finite_pixel("scene.proxy.pixels", Some(*pixel))?);
        }
        let is_number = |v: f32| v.fract() == 0.0 && v >= 0.0 && (v as usize) < pixels.len();
        let mut lengths = Vec::new();
        for [a, b, metres] in self.lengths_m.iter().flatten().copied() {
            if !(is_number(a) && is_number(b) && a != b && metres.is_finite() && metres > 0.0) {
                return Err(wrong(
                    "scene.proxy.lengths_m",
                    format!("[[{a:?}, {b:?}, {metres:?}]]"),
                    &format!(
                        "numbers of two of the {} pixels, from 0, and metres above 0, for instance [[0, 1, 2.5]]",
                        pixels.len()
                    ),
                ));
            }
            lengths.push((a as usize, b as usize, f64::from(metres)));
        }
        let height = self.camera_height_m;
        if let Some(h) = height.filter(|h| !(h.is_finite() && *h > 0.0)) {
            let accepted = "metres above 0, for instance camera_height_m = 1.6";
            return Err(wrong("scene.proxy.camera_height_m", h, accepted));
        }
        let rectangle = self.rectangle.unwrap_or(false);
        if rectangle && pixels.len() != 4 {
            let accepted = "four pixels, the corners of a rectangle in order around it";
            return Err(wrong(
                "scene.proxy.pixels",
                format!("{} pixels", pixels.len()),
                accepted,
            ));
        }
        match (height, lengths.is_empty()) {
            (Some(_), false) => Err(conflict(
                "scene.proxy.camera_height_m",
                "scene.proxy.lengths_m",
            )),
            (None, true) => Err(missing(
                "scene.proxy.lengths_m",
                "write the metres between two of the pixels, lengths_m = [[0, 1, 2.5]], or camera_height_m = 1.6",
            )),
            _ => Ok(PixelPlane {
                pixels,
                lengths,
                rectangle,
                height_m: height.map(f64::from),
            }),
        }
    }
}

impl PlaneConfig {
    fn validate(&self) -> Result<ProxySettings, Error> {
        let point = near_point("scene.proxy.plane.point", self.point)?;
        let normal = finite_point("scene.proxy.plane.normal", self.normal)?;
        let unit = normal.as_dvec3().normalize_or_zero().as_vec3();
        if unit == Vec3::ZERO {
            return Err(wrong(
                "scene.proxy.plane.normal",
                triple(normal),
                "a direction that is not zero, for instance normal = [0.0, 1.0, 0.0]",
            ));
        }
        Ok(ProxySettings::Plane(Plane {
            point,
            normal: unit,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_colmap_have_the_scale_and_the_up_of_its_cameras_whatever_their_folder_is_called() {
        let camera = CameraConfig {
            file: Some("model".into()),
            file_up: Some("y".into()),
            file_scale: Some(0.1),
            ..CameraConfig::default()
        };
        for (points, is_colmap) in [
            ("model", true),
            ("2026.06.21", true),
            ("shot_v1.2", true),
            ("sparse/points3D.bin", true),
            ("points3D.txt", true),
            ("scan.ply", false),
            ("scan.PCD", false),
            ("000042.bin", false),
            ("depth.exr", false),
        ] {
            let config = ProxyConfig {
                points: Some(points.into()),
                ..ProxyConfig::default()
            };
            let found = config.validate_points(&camera).unwrap();
            let wanted = match is_colmap {
                true => (Some(WorldUp::Y), 0.1),
                false => (None, 1.0),
            };
            assert_eq!((found.up, found.scale), wanted, "{points}");
        }
    }
}
