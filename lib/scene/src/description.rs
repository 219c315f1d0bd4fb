//! `scene.json`: what a scene was made of, so that another executable rebuilds the same.
use std::collections::HashSet;
use std::path::{Path, PathBuf};

use dipir_cameras::Lens;
use dipir_imaging::transfer::Transfer;
use dipir_points::Ground;
use dipir_points::scale::{Measure, Scale};
use glam::DMat4;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::config::EffectsConfig;
use crate::error::Error;
use crate::limits::Limits;
use crate::proxy::Plane;

/// A file with the hash of its contents.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Relative to the folder of the pipeline file, or absolute.
    pub path: PathBuf,
    /// BLAKE3, hexadecimal.
    pub blake3: String,
}

/// The photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoRecord {
    /// Its file.
    #[serde(flatten)]
    pub file: FileRecord,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// How its values are encoded.
    pub transfer: Transfer,
}

/// An object as placed, or a proxy mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectRecord {
    /// The object's file.
    #[serde(flatten)]
    pub file: FileRecord,
    /// Buffers, images and material libraries beside it.
    pub dependencies: Vec<FileRecord>,
    /// Rows of the matrix that maps the file's coordinates to the world, metres.
    pub transform: [[f64; 4]; 4],
    /// Vertices after import.
    pub vertices: u64,
    /// Triangles after import.
    pub triangles: u64,
}

impl ObjectRecord {
    pub(crate) fn rows(map: &DMat4) -> [[f64; 4]; 4] {
        map.transpose().to_cols_array_2d()
    }

    /// Maps the file's coordinates to the world.
    pub fn transform(&self) -> DMat4 {
        DMat4::from_cols_array_2d(&self.transform).transpose()
    }
}

/// Depths of the photo, as they were read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthRecord {
    /// Their file.
    pub file: FileRecord,
    /// What its values are linear in, if that was said.
    pub measure: Option<Measure>,
    /// Metres of a unit, if that was said.
    pub scale: Option<f32>,
    /// The scale that was found on the ground, if it was.
    pub found: Option<Scale>,
    /// Whether what they show beside the proxy catches shadows.
    #[serde(default)]
    pub catches: bool,
}

/// What receives the shadow.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProxyRecord {
    /// Nothing.
    None,
    /// A plane.
    Plane(Plane),
    /// A mesh in world coordinates.
    Mesh(ObjectRecord),
    /// The ground through points.
    Ground(Box<Ground>),
}

impl ProxyRecord {
    /// The plane, or that through the points; `None` for meshes.
    pub fn plane(&self) -> Option<Plane> {
        match self {
            Self::Plane(plane) => Some(*plane),
            Self::Ground(ground) => Some(Plane {
                point: ground.point.as_vec3(),
                normal: ground.normal.as_vec3().normalize(),
            }),
            Self::None | Self::Mesh(_) => None,
        }
    }
}

/// The content of `scene.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneDescription {
    /// [`SceneDescription::SCHEMA`].
    pub schema: String,
    /// Of every random number.
    pub seed: u64,
    /// The photo.
    pub background: PhotoRecord,
    /// Mask of the photo's own foreground.
    pub occluders: Option<FileRecord>,
    /// Depths that tell of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthRecord>,
    /// In the order of the configuration.
    pub objects: Vec<ObjectRecord>,
    /// The photo's camera; of the undistorted photo, if there is a `lens`.
    pub camera: Camera,
    /// The photo's lens, if it bends lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
    /// What receives the shadow.
    pub proxy: ProxyRecord,
    /// What the user says about effects.
    pub effects: EffectsConfig,
    /// How much files may ask for.
    #[serde(default, skip_serializing_if = "Limits::is_default")]
    pub limits: Limits,
}

impl SceneDescription {
    /// Name and version of the format.
    pub const SCHEMA: &str = "dipir.scene.v2";

    /// Writes the description as JSON.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let mut text = serde_json::to_string_pretty(self)
            .map_err(|e| Error::malformed(e.to_string(), "report this as a bug"))?;
        text.push('\n');
        std::fs::write(path, text).map_err(|source| Error::Write {
            path: path.into(),
            source,
        })
    }

    /// Reads a description.
    pub fn read(path: &Path) -> Result<Self, Error> {
        const AGAIN: &str = "run dipir-scene again";
        let bytes = dipir_files::read(path).map_err(|source| Error::Read {
            role: "the scene description".into(),
            path: path.into(),
            source,
        })?;
        let description: Self = serde_json::from_slice(&bytes).map_err(|e| {
            Error::malformed(format!("not a scene description: {e}"), AGAIN).in_file(path)
        })?;
        if description.schema != Self::SCHEMA {
            let detail = format!(
                "schema is \"{}\"; accepted: \"{}\"",
                description.schema,
                Self::SCHEMA
            );
            return Err(Error::malformed(detail, AGAIN).in_file(path));
        }
        Ok(description)
    }
}

/// A warning if objects of the same file stand at the same place.
pub(crate) fn repeated(objects: &[ObjectRecord]) -> Option<String> {
    let mut seen = HashSet::new();
    for object in objects {
        seen.insert((
            &object.file.path,
            object.transform.map(|row| row.map(f64::to_bits)),
        ));
    }
    match objects.len() - seen.len() {
        0 => None,
        n => Some(format!(
            "scene.objects: {n} of them stand where the same file stands already, and are drawn once"
        )),
    }
}
