//! Where an object stands: its lowest point rests on the proxy.
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// How large the object is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Size {
    /// Factor on the file's metres.
    Scale(f32),
    /// Extent along the up direction once turned, metres.
    Height(f32),
}

/// What the height of the object's lowest point follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rest {
    /// The proxy below or above the placement's x and z.
    Proxy,
    /// The placement's position.
    Position,
}

/// Which point of the object comes to lie at the placement's position, seen from above.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Anchor {
    /// The origin of the object's file.
    #[default]
    Origin,
    /// The centre of the object's bounding box once turned.
    Center,
}

/// A checked placement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Where the object rests, metres.
    pub position: Vec3,
    /// Turn about the up direction, applied last.
    pub yaw_rad: f32,
    /// Turn about x, applied second.
    pub pitch_rad: f32,
    /// Turn about z, applied first.
    pub roll_rad: f32,
    /// How large the object is.
    pub size: Size,
    /// What its height follows; `None` decides by the proxy.
    pub rest: Option<Rest>,
    /// Which point lies at the position.
    pub anchor: Anchor,
}
