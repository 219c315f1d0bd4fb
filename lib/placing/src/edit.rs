//! What the page changes of a `pipeline.toml`.
use serde::{Deserialize, Serialize};

/// Changes of a file; what is absent stays as it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edit {
    /// All objects, in the order in which the file will have them.
    pub objects: Vec<ObjectEdit>,
    /// How the camera is turned, and how wide it sees.
    #[serde(default)]
    pub turn: Option<Turn>,
    /// Height of the camera over the ground, metres.
    #[serde(default)]
    pub height_m: Option<f64>,
    /// Where the sun is.
    #[serde(default)]
    pub sun: Option<SunEdit>,
    /// A shadow in the photograph.
    #[serde(default)]
    pub shadow: Option<ShadowEdit>,
    /// Exposure of the light, stops.
    #[serde(default)]
    pub exposure_ev: Option<f64>,
    /// Whether the painted mask is used.
    #[serde(default)]
    pub mask: bool,
}

impl Edit {
    /// All of it that a record of light transport depends on.
    pub fn without_light(&self) -> Self {
        Self {
            sun: None,
            exposure_ev: None,
            ..self.clone()
        }
    }
}

/// An object.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectEdit {
    /// Index of the object of the file that it is, or is a copy of.
    pub of: usize,
    /// Where it stands, pixels of the photograph.
    #[serde(default)]
    pub at: Option<[f64; 2]>,
    /// Turn about the up direction, degrees.
    #[serde(default)]
    pub yaw_deg: Option<f64>,
    /// Factor on the size that the file says.
    #[serde(default)]
    pub size: Option<f64>,
}

/// A camera's direction over a level ground, and its field of view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Turn {
    /// Upwards, degrees.
    pub pitch_deg: f64,
    /// Clockwise about the line of sight, degrees.
    pub roll_deg: f64,
    /// Vertical field of view, degrees.
    pub fov_deg: f64,
}

/// A sun by its direction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SunEdit {
    /// From the view to the right, degrees.
    pub azimuth_deg: f64,
    /// Above the horizon, degrees.
    pub elevation_deg: f64,
}

/// A shadow, pixels of the photograph.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShadowEdit {
    /// Where the thing stands.
    pub foot: [f64; 2],
    /// Where the shadow of its top falls.
    pub tip: [f64; 2],
    /// Height of the thing, metres.
    #[serde(default)]
    pub height_m: Option<f64>,
}

impl Edit {
    /// An edit that changes nothing, for a file with this many objects.
    pub fn none(objects: usize) -> Self {
        let object = |of| ObjectEdit {
            of,
            ..ObjectEdit::default()
        };
        Self {
            objects: (0..objects).map(object).collect(),
            ..Self::default()
        }
    }
}
