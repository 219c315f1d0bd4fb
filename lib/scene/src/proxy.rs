//! The stand-in for the photographed surface that receives the object's shadow.
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::mesh::TriangleMesh;

/// An infinite plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plane {
    /// Any point of it, metres.
    pub point: Vec3,
    /// Unit normal towards the side that is seen.
    pub normal: Vec3,
}

/// The geometry that catches the shadow.
#[derive(Clone, Debug)]
pub enum Proxy {
    /// No shadow is caught.
    None,
    /// An infinite plane: the unshadowed light is one closed-form sum for all pixels.
    Plane(Plane),
    /// A mesh, which may shadow itself.
    Mesh(TriangleMesh),
}
