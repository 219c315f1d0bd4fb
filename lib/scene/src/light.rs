//! Lights that an object's file brings along (`KHR_lights_punctual`).
use glam::{DMat4, DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// Where a light shines.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LightKind {
    /// Parallel light from infinitely far, of `intensity` lux.
    Directional,
    /// All around from a point, of `intensity` candela.
    Point,
    /// From a point into a cone, of `intensity` candela along its axis.
    Spot {
        /// Angle from the axis up to which the light is undimmed, radians.
        inner_cone_rad: f32,
        /// Angle from the axis beyond which there is none, radians.
        outer_cone_rad: f32,
    },
}

/// A light without extent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PunctualLight {
    /// Name in the source file; may be empty.
    pub name: String,
    /// Where it shines.
    pub kind: LightKind,
    /// Linear Rec.709, multiplies the intensity.
    pub color: Vec3,
    /// Candela, or lux where the light is directional. Placing an object does not change it, even
    /// where that scales the object.
    pub intensity: f32,
    /// Distance beyond which the light is cut off, metres; `None` is never.
    pub range: Option<f32>,
    /// Metres; without meaning where the light is directional.
    pub position: DVec3,
    /// Unit vector in which it shines; without meaning for [`LightKind::Point`].
    pub direction: DVec3,
}

impl PunctualLight {
    /// The light as an affine map places it. The range grows with the map's scale.
    pub fn placed(&self, map: &DMat4) -> Self {
        let scale = map.determinant().abs().cbrt() as f32;
        Self {
            position: map.transform_point3(self.position),
            direction: map
                .transform_vector3(self.direction)
                .normalize_or(self.direction),
            range: self.range.map(|r| r * scale),
            ..self.clone()
        }
    }
}
