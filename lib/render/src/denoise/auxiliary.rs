//! What surfaces the camera sees on the object: free of noise, they tell which pixels may differ.
use glam::Vec3;

use crate::tiles::Tiles;

/// Normals and base colours of the object's pixels.
pub(crate) type Auxiliary = Tiles<Seen>;

/// The surface in a pixel, in 6 bytes; all 0 where there is none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Seen {
    /// Unit normal, in steps of 1 / 127.
    normal: [i8; 3],
    /// Base colour, in steps of 1 / 255.
    colour: [u8; 3],
}

impl Seen {
    pub(crate) fn new(normal: Vec3, colour: Vec3) -> Self {
        Self {
            normal: (normal * 127.0).to_array().map(|v| v.round() as i8),
            colour: (colour * 255.0).to_array().map(|v| v.round() as u8),
        }
    }

    /// Normal and base colour.
    pub(super) fn decoded(self) -> (Vec3, Vec3) {
        (
            Vec3::from(self.normal.map(f32::from)) / 127.0,
            Vec3::from(self.colour.map(f32::from)) / 255.0,
        )
    }
}
