//! A pinhole camera that looks down its own -z.
use glam::{Mat3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// A ray with a unit direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, metres.
    pub origin: Vec3,
    /// Unit vector.
    pub direction: Vec3,
}

/// A pinhole camera. Pixel (0, 0) is top left; pixel centres lie at half-integers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Centre of projection, metres.
    pub position: Vec3,
    /// Columns: the camera's right, up and backward axes in world space (orthonormal).
    pub rotation: Mat3,
    /// Focal length over pixel pitch, horizontally and vertically, pixels.
    pub focal_px: Vec2,
    /// Where the optical axis meets the image, pixels from the top left corner.
    pub principal_px: Vec2,
    /// Image width and height, pixels.
    pub resolution: [u32; 2],
}

impl Camera {
    /// The ray through the continuous image position `pixel` (column, row), in pixels.
    pub fn ray(&self, pixel: Vec2) -> Ray {
        let d = (pixel - self.principal_px) / self.focal_px;
        Ray {
            origin: self.position,
            direction: (self.rotation * Vec3::new(d.x, -d.y, -1.0)).normalize(),
        }
    }

    /// The image position of `point`, or `None` if it does not lie in front of the camera.
    pub fn project(&self, point: Vec3) -> Option<Vec2> {
        let c = self.rotation.transpose() * (point - self.position);
        (c.z < 0.0)
            .then(|| self.principal_px + self.focal_px * Vec2::new(c.x / -c.z, -c.y / -c.z))
    }
}
