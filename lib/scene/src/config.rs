//! The `[scene]` table of `pipeline.toml`: as it is written, and what it means once checked.
//!
//! Two types for two moments: [`SceneConfig`] and its parts hold what was typed, with every key
//! optional that has a default; [`SceneConfig::validate`] turns it into [`SceneSettings`], in which
//! nothing contradicts anything else. Unknown keys are refused while parsing.
mod camera;
mod effects;
mod foreground;
mod lens;
mod proxy;
mod view;

use std::path::{Path, PathBuf};

use dipir_imaging::transfer::Transfer;
use glam::{DMat3, Vec2, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::camera::{CameraSettings, FARTHEST_M, FieldOfView, WorldUp};
use crate::error::Error;
use crate::foreground::DepthSettings;
use crate::limits::Limits;
use crate::pixels::Pixels;
use crate::placement::{Anchor, Placement, Rest, Size};

pub use effects::{EffectSwitch, EffectsConfig, EffectsMode};
pub use lens::DistortionConfig;
pub use proxy::{PlaneConfig, ProxyConfig, ProxySettings};
pub use view::ViewConfig;

/// The `[scene]` table as written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// The photograph: PNG, JPEG, EXR or HDR.
    #[schemars(extend("format" = "path"), extend("x-default" = "none; required"), example = &"photo.jpg")]
    pub background: Option<PathBuf>,
    /// How the photograph's values are encoded; EXR and HDR are always linear.
    #[schemars(extend("enum" = ["srgb", "gamma22", "linear"]), extend("default" = "srgb"), example = &"linear")]
    pub transfer: Option<String>,
    /// What the object is called in prompts to a diffusion model: a word or a few.
    #[schemars(extend("default" = "object"), example = &"car")]
    pub class: Option<String>,
    /// Mask of what stands in front of the object in the photograph, a PNG, JPEG or EXR of the photograph's
    /// size: white hides the object, black shows it.
    #[schemars(extend("format" = "path"), example = &"foreground.png")]
    pub occluders: Option<PathBuf>,
    /// Depths of the photograph, which tell what stands in front of an object: EXR, or PNG in shades of grey, of the
    /// photograph's shape, as a scanner or a depth network gives them. Their scale is found on the ground.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("format" = "path"), example = &"depth.png")]
    pub depth: Option<PathBuf>,
    /// What the values of `depth` are linear in: the depth along the optical axis, or one over it, as in most maps in which
    /// what is near is bright.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["auto", "depth", "disparity"]), extend("default" = "auto"), example = &"disparity")]
    pub depth_kind: Option<String>,
    /// Metres of a unit of `depth`; in a PNG of 16 bits a unit is 1,000 steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("exclusiveMinimum" = 0), extend("x-default" = "found on the ground"), example = 1.0)]
    pub depth_scale: Option<f32>,
    /// Whether what `depth` shows beside the proxy, as walls and furniture, catches the objects' shadows.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("default" = true), example = false)]
    pub depth_surfaces: Option<bool>,
    /// The objects that are put into the photograph; at least one.
    #[serde(default)]
    pub objects: Vec<ObjectConfig>,
    /// Where the photograph was taken from; required.
    pub camera: Option<CameraConfig>,
    /// What receives the shadow: a plane or a mesh. Without this table nothing does.
    pub proxy: Option<ProxyConfig>,
    /// Other photographs of the place, under the same light, from known directions: the light is estimated from all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub views: Vec<ViewConfig>,
    /// Which effects are simulated: `on`, `off`, or `auto`, for planning to decide.
    #[serde(default)]
    pub effects: EffectsConfig,
    /// How much files may ask for.
    #[serde(default, skip_serializing_if = "Limits::is_default")]
    pub limits: Limits,
}

/// One `[[scene.objects]]` table as written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectConfig {
    /// The object's file: `.glb`, `.gltf`, `.obj`, `.ply` or `.stl`.
    #[schemars(extend("format" = "path"), extend("x-default" = "none; required"), example = &"car.glb")]
    pub path: Option<PathBuf>,
    /// Where the object rests, metres: x, y and z of the scene.
    #[schemars(extend("default" = [0.0, 0.0, 0.0]), extend("examples" = [[0.5, 0.0, -1.0]]))]
    pub position: Option<[f32; 3]>,
    /// Instead of `position`: the pixel of the upright photograph, column and row from 0, at which the object
    /// stands on the plane of `[scene.proxy]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("examples" = [[960.0, 810.0]]))]
    pub at_pixel: Option<[f32; 2]>,
    /// Instead of `position`: `auto` looks for a place on the ground that is free and seen, in the lower
    /// middle of the picture. With `[scene.proxy] points` nothing of them is in the object.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["auto"]), example = &"auto")]
    pub place: Option<String>,
    /// Another place than the best one: any number above 0 draws one of those that are free.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("default" = 0), example = 3)]
    pub place_draw: Option<u32>,
    /// Instead of `yaw_deg`: the pixel of the same plane, column and row from 0, that the object's front faces.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("examples" = [[1200.0, 900.0]]))]
    pub to_pixel: Option<[f32; 2]>,
    /// Turn about the axis that points away from the proxy, degrees, counter-clockwise from above.
    #[schemars(extend("default" = 0.0), example = 40.0)]
    pub yaw_deg: Option<f32>,
    /// Turn about the object's own x axis, degrees, before yaw.
    #[schemars(extend("default" = 0.0), example = -90.0)]
    pub pitch_deg: Option<f32>,
    /// Turn about the object's own z axis, degrees, before pitch.
    #[schemars(extend("default" = 0.0), example = 5.0)]
    pub roll_deg: Option<f32>,
    /// Factor on the lengths of the file, which are taken as metres. It excludes `height_m`.
    #[schemars(extend("exclusiveMinimum" = 0), extend("default" = 1.0), example = 0.01)]
    pub scale: Option<f32>,
    /// Height of the object as it is placed, metres. It replaces `scale`.
    #[schemars(extend("exclusiveMinimum" = 0), example = 1.4)]
    pub height_m: Option<f32>,
    /// What carries the object. `proxy`: it is dropped onto the proxy at the x and z of `position`.
    /// `position`: its lowest point gets the y of `position`, whatever the proxy. `surface`: it stands on what
    /// `scene.depth` shows at `at_pixel`, as a table's top.
    #[schemars(extend("enum" = ["proxy", "position", "surface"]), extend("x-default" = "`position` where the proxy is a horizontal plane or absent, else `proxy`"), example = &"proxy")]
    pub rest: Option<String>,
    /// Which point of the object comes to lie at the x and z of `position`: the origin of its file,
    /// or the center of its bounding box.
    #[schemars(extend("enum" = ["origin", "center"]), extend("default" = "origin"), example = &"center")]
    pub anchor: Option<String>,
}

/// The `[scene.camera]` table as written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Centre of projection, metres: x, y and z of the scene.
    #[schemars(extend("x-default" = "none; required without `file`"), extend("examples" = [[0.0, 1.5, 4.0]]))]
    pub position: Option<[f32; 3]>,
    /// The point that is seen on the optical axis, which is the middle of the image unless `principal_px` is given, metres.
    #[schemars(extend("x-default" = "none; required without `file`"), extend("examples" = [[0.0, 0.5, 0.0]]))]
    pub look_at: Option<[f32; 3]>,
    /// The direction that is up in the image, of any length.
    #[schemars(extend("default" = [0.0, 1.0, 0.0]), extend("examples" = [[0.0, 0.0, -1.0]]))]
    pub up: Option<[f32; 3]>,
    /// Instead of `look_at` and `up`: turn upwards from looking along -z, degrees; `heading_deg` turns to the side.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = -90, max = 90), example = -8.0)]
    pub pitch_deg: Option<f32>,
    /// With `pitch_deg`: turn of the camera clockwise about its line of sight, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = -180, max = 180), example = 1.5)]
    pub roll_deg: Option<f32>,
    /// With `pitch_deg`: turn to the right from -z, degrees; a compass bearing, where -z is north.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = -360, max = 360), extend("default" = 0.0), example = 90.0)]
    pub heading_deg: Option<f32>,
    /// Where the optical axis meets the photograph, pixels from its top left corner; its middle by
    /// default.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("examples" = [[960.0, 640.0]]))]
    pub principal_px: Option<[f32; 2]>,
    /// Vertical field of view, degrees. It excludes `focal_mm` and `sensor_mm`.
    #[schemars(extend("exclusiveMinimum" = 0), extend("exclusiveMaximum" = 180), extend("x-default" = "what the photograph's Exif data tell"), example = 40.0)]
    pub fov_deg: Option<f32>,
    /// Focal length, millimetres. It replaces `fov_deg`.
    #[schemars(extend("exclusiveMinimum" = 0), example = 35.0)]
    pub focal_mm: Option<f32>,
    /// Width of the upright picture on the sensor, millimetres: of full frame 36, or 24 for a portrait. It belongs to `focal_mm`.
    #[schemars(extend("exclusiveMinimum" = 0), extend("x-default" = "the photograph's own, from its Exif data"), example = 36.0)]
    pub sensor_mm: Option<f32>,
    /// How the lens bends lines. The photograph is undistorted for everything that is computed, and the
    /// result is bent back onto it. Beside `file` it is for one without coefficients.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distortion: Option<DistortionConfig>,
    /// The camera's file of another program: fSpy (`.fspy`, `.json`), nerfstudio (`transforms.json`),
    /// `.chan`, `.glb`, `.gltf`, a folder of COLMAP's, nuScenes (`.json`), KITTI (`.txt`); OpenCV's
    /// (`.yaml`, `.json`) has the lens alone, and position and direction are written beside it.
    /// It replaces position, direction and field of view.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("format" = "path"), example = &"shot.fspy")]
    pub file: Option<PathBuf>,
    /// Which camera of `file` is the photograph's, by the name of its picture or its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-default" = "the one with the photograph's name, else the only one"), example = &"IMG_0042.jpg")]
    pub image: Option<String>,
    /// Which axis of the world of `file` points up.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["z", "y", "-y", "x", "-x"]), extend("x-default" = "as the program that wrote it has it: COLMAP `-y`, glTF and `.chan` `y`, others `z`"), example = &"z")]
    pub file_up: Option<String>,
    /// The axes about which rotations of a `.chan` file turn, the first one first; Blender's export is `xyz` unless it is told.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("enum" = ["zxy", "xyz", "xzy", "yxz", "yzx", "zyx"]), extend("default" = "zxy"), example = &"xyz")]
    pub file_rotation_order: Option<String>,
    /// Metres of a unit of the world of `file`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("exclusiveMinimum" = 0), extend("default" = 1.0), example = 0.01)]
    pub file_scale: Option<f32>,
    /// As `file`, a nerfstudio `transforms.json` whose frame is named by its number.
    #[schemars(extend("format" = "path"), example = &"transforms.json")]
    pub transforms: Option<PathBuf>,
    /// Which camera of `transforms` or `file` is the photograph's, from 0; in a `.chan` file and of a glTF camera
    /// that moves (with `image`, if there are several) the number of the frame, in KITTI's that of the camera.
    #[schemars(extend("x-default" = "`0` of `transforms`; of `file` as `image`"), example = 3)]
    pub frame: Option<u32>,
    /// Which axis of the world of `transforms` is up.
    #[schemars(extend("enum" = ["z", "y", "-y", "x", "-x"]), extend("default" = "z"), example = &"y")]
    pub transforms_up: Option<String>,
}

/// The checked `[scene]` table; paths are still as written.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSettings {
    /// The photograph.
    pub background: PathBuf,
    /// How its values are encoded.
    pub transfer: Transfer,
    /// What the object is called in prompts.
    pub class: String,
    /// Mask of the photo's own foreground.
    pub occluders: Option<PathBuf>,
    /// Depths that tell of it.
    pub depth: Option<DepthSettings>,
    /// At least one.
    pub objects: Vec<ObjectSettings>,
    /// Where the photo was taken from.
    pub camera: CameraSettings,
    /// What receives the shadow.
    pub proxy: ProxySettings,
    /// What to simulate.
    pub effects: EffectsConfig,
    /// How much files may ask for.
    pub limits: Limits,
}

/// A checked `[[scene.objects]]` table.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectSettings {
    /// The object's file.
    pub path: PathBuf,
    /// Where it goes, but for what `pixels` say.
    pub placement: Placement,
    /// Pixels that say where it goes.
    pub pixels: Pixels,
    /// Number of the draw, where its place is looked for.
    pub auto: Option<u32>,
}

impl SceneConfig {
    /// How photographs are encoded.
    fn transfer(&self) -> Result<Transfer, Error> {
        match self.transfer.as_deref() {
            None | Some("srgb") => Ok(Transfer::Srgb),
            Some("gamma22") => Ok(Transfer::Gamma22),
            Some("linear") => Ok(Transfer::Linear),
            Some(other) => {
                let accepted = ["srgb", "gamma22", "linear"];
                Err(wrong_word("scene.transfer", other, &accepted))
            }
        }
    }

    /// Checks every key; the first that is wrong is reported with its value and the accepted form.
    pub fn validate(&self) -> Result<SceneSettings, Error> {
        let background = self.background.clone().ok_or_else(|| {
            missing(
                "scene.background",
                "name the photograph: background = \"photo.jpg\"",
            )
        })?;
        named("scene.background", &background)?;
        let transfer = self.transfer()?;
        let class = self.class.as_deref().unwrap_or("object").trim();
        if class.is_empty() {
            return Err(wrong(
                "scene.class",
                "\"\"",
                "a word for the object, for instance class = \"car\"",
            ));
        }
        let foreground = self.foreground()?;
        if self.objects.is_empty() {
            return Err(missing(
                "scene.objects",
                "add a table [[scene.objects]] with path = \"object.glb\"",
            ));
        }
        let objects = self
            .objects
            .iter()
            .enumerate()
            .map(|(i, object)| object.validate(&format!("scene.objects[{i}]")))
            .collect::<Result<Vec<_>, _>>()?;
        let on_surface = |o: &ObjectSettings| o.placement.rest == Some(Rest::Surface);
        if foreground.1.is_none() && objects.iter().any(on_surface) {
            let remedy = "rest = \"surface\" stands an object on what these depths show";
            return Err(match self.depth {
                None => missing("scene.depth", remedy),
                Some(_) => wrong(
                    "scene.effects.occluders",
                    "\"off\"",
                    &format!("\"auto\", for {remedy}"),
                ),
            });
        }
        let camera = self.camera.as_ref().ok_or_else(|| {
            missing(
                "scene.camera",
                "add a table [scene.camera] with position, look_at and fov_deg, or with file",
            )
        })?;
        if let Some(t) = self.effects.tolerance
            && !(0.0..=1.0).contains(&t)
        {
            return Err(wrong(
                "scene.effects.tolerance",
                t,
                "a display-referred error from 0 to 1, for instance tolerance = 0.002",
            ));
        }
        if let Some(d) = self.effects.max_depth
            && !(1..=EffectsConfig::MOST_DEPTH).contains(&d)
        {
            return Err(wrong(
                "scene.effects.max_depth",
                d,
                "interactions from 1 to 8, for instance max_depth = 3",
            ));
        }
        let megapixels = self.limits.photo_megapixels;
        if megapixels > Limits::MOST_PHOTO_MEGAPIXELS {
            return Err(wrong(
                "scene.limits.photo_megapixels",
                megapixels,
                "millions of pixels up to 268, of which the result's files have no more, for instance photo_megapixels = 250",
            ));
        }
        self.views()?;
        let proxy = match &self.proxy {
            None => ProxySettings::None,
            Some(proxy) => proxy.validate(camera)?,
        };
        let camera = camera.validate(&background)?;
        Ok(SceneSettings {
            background,
            transfer,
            class: class.into(),
            occluders: foreground.0,
            depth: foreground.1,
            objects,
            camera,
            proxy,
            effects: self.effects,
            limits: self.limits,
        })
    }
}

impl ObjectConfig {
    fn validate(&self, at: &str) -> Result<ObjectSettings, Error> {
        let key = |name: &str| format!("{at}.{name}");
        let path = self.path.clone().ok_or_else(|| {
            missing(
                &key("path"),
                "name the object's file: path = \"object.glb\"",
            )
        })?;
        named(&key("path"), &path)?;
        let angle_rad = |name: &str, value: Option<f32>| match value.unwrap_or(0.0) {
            v if v.is_finite() => Ok(v.to_radians()),
            v => Err(wrong(&key(name), v, "a finite angle in degrees")),
        };
        let positive = |name: &str, value: f32, unit: &str, example: &str| {
            if value.is_finite() && value > 0.0 {
                Ok(value)
            } else {
                Err(wrong(
                    &key(name),
                    value,
                    &format!("{unit} above 0, for instance {name} = {example}"),
                ))
            }
        };
        let size = match (self.scale, self.height_m) {
            (Some(_), Some(_)) => return Err(conflict(&key("scale"), &key("height_m"))),
            (scale, None) => {
                Size::Scale(positive("scale", scale.unwrap_or(1.0), "a factor", "1.0")?)
            }
            (None, Some(h)) => Size::Height(positive("height_m", h, "metres", "1.4")?),
        };
        let auto = match (self.place.as_deref(), self.place_draw) {
            (None, None) => None,
            (Some("auto"), draw) => Some(draw.unwrap_or(0)),
            (Some(other), _) => return Err(wrong_word(&key("place"), other, &["auto"])),
            (None, Some(_)) => {
                return Err(missing(&key("place"), "place_draw needs place = \"auto\""));
            }
        };
        let placed = auto.is_some();
        for (by_pixel, other, both) in [
            ("place", "position", placed && self.position.is_some()),
            ("place", "at_pixel", placed && self.at_pixel.is_some()),
            ("place", "anchor", placed && self.anchor.is_some()),
            (
                "at_pixel",
                "position",
                self.at_pixel.is_some() && self.position.is_some(),
            ),
            (
                "to_pixel",
                "yaw_deg",
                self.to_pixel.is_some() && self.yaw_deg.is_some(),
            ),
        ] {
            if both {
                return Err(conflict(&key(by_pixel), &key(other)));
            }
        }
        Ok(ObjectSettings {
            path,
            auto,
            pixels: Pixels {
                at: finite_pixel(&key("at_pixel"), self.at_pixel)?,
                to: finite_pixel(&key("to_pixel"), self.to_pixel)?,
            },
            placement: Placement {
                position: near_point(&key("position"), self.position.unwrap_or_default())?,
                yaw_rad: angle_rad("yaw_deg", self.yaw_deg)?,
                pitch_rad: angle_rad("pitch_deg", self.pitch_deg)?,
                roll_rad: angle_rad("roll_deg", self.roll_deg)?,
                size,
                rest: match self.rest.as_deref() {
                    None => None,
                    Some("proxy") => Some(Rest::Proxy),
                    Some("position") => Some(Rest::Position),
                    Some("surface") if self.at_pixel.is_some() => Some(Rest::Surface),
                    Some("surface") => {
                        let remedy = "rest = \"surface\" stands the object on what is seen at it";
                        return Err(missing(&key("at_pixel"), remedy));
                    }
                    Some(other) => {
                        let words = ["proxy", "position", "surface"];
                        return Err(wrong_word(&key("rest"), other, &words));
                    }
                },
                anchor: match self.anchor.as_deref() {
                    None | Some("origin") => Anchor::Origin,
                    Some("center") => Anchor::Center,
                    Some(other) => {
                        return Err(wrong_word(&key("anchor"), other, &["origin", "center"]));
                    }
                },
            },
        })
    }
}

fn finite_point(key: &str, value: [f32; 3]) -> Result<Vec3, Error> {
    let point = Vec3::from_array(value);
    if point.is_finite() {
        Ok(point)
    } else {
        Err(wrong(key, triple(point), "three finite numbers [x, y, z]"))
    }
}

/// A finite point that is not too far out.
fn near_point(key: &str, value: [f32; 3]) -> Result<Vec3, Error> {
    let point = finite_point(key, value)?;
    if point.abs().max_element() > FARTHEST_M {
        let accepted = "metres, at most ten million from the origin, for instance [0.5, 0.0, -1.0]";
        return Err(wrong(key, triple(point), accepted));
    }
    Ok(point)
}

/// Refuses a path without a letter, which would stand for the project's folder.
fn named(key: &str, path: &Path) -> Result<(), Error> {
    match path.to_string_lossy().trim().is_empty() {
        true => Err(wrong(key, "empty", "the name of a file")),
        false => Ok(()),
    }
}

fn finite_pixel(key: &str, value: Option<[f32; 2]>) -> Result<Option<Vec2>, Error> {
    match value.map(Vec2::from_array) {
        Some(p) if !p.is_finite() => Err(wrong(
            key,
            format!("[{:?}, {:?}]", p.x, p.y),
            "two finite numbers [x, y], pixels from the photograph's top left corner",
        )),
        pixel => Ok(pixel),
    }
}

fn triple(v: Vec3) -> String {
    format!("[{:?}, {:?}, {:?}]", v.x, v.y, v.z)
}

fn wrong(key: &str, value: impl std::fmt::Display, accepted: &str) -> Error {
    Error::Config {
        key: key.into(),
        value: value.to_string(),
        accepted: accepted.into(),
    }
}

fn wrong_word(key: &str, value: &str, accepted: &[&str]) -> Error {
    let mut list = String::new();
    for (i, word) in accepted.iter().enumerate() {
        let separator = match i {
            0 => "",
            _ if i + 1 == accepted.len() => " or ",
            _ => ", ",
        };
        list += &format!("{separator}\"{word}\"");
    }
    let nearest = accepted
        .iter()
        .map(|word| (strsim::damerau_levenshtein(word, value), word))
        .min();
    if let Some((distance, word)) = nearest
        && distance <= 2
        && distance < word.len()
    {
        list += &format!(" (did you mean \"{word}\"?)");
    }
    wrong(key, format!("\"{value}\""), &list)
}

fn missing(key: &str, remedy: &str) -> Error {
    Error::Missing {
        key: key.into(),
        remedy: remedy.into(),
    }
}

fn conflict(first: &str, second: &str) -> Error {
    Error::Conflict {
        first: first.into(),
        second: second.into(),
    }
}
