//! A lens, where it stands, and the two together.
use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::distortion::Distortion;
use crate::error::CameraError;

/// What turns directions into pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Width and height of the image, pixels.
    pub size: [f64; 2],
    /// Focal length over pixel pitch, horizontally and vertically, pixels.
    pub focal_px: DVec2,
    /// Where the optical axis meets the image, pixels from the top left corner.
    pub principal_px: DVec2,
    /// How lines are bent.
    pub distortion: Distortion,
}

/// The middle of the first pixel, pixels from the top left corner. OpenCV and those who follow it count from there.
pub(crate) const FIRST_PIXEL: DVec2 = DVec2::splat(0.5);
/// Pixels along a side of the largest picture.
const MOST_PIXELS: f64 = 1e7;
/// Focal lengths in sides of the picture: 179.9 degrees are seen at the shortest, 2 seconds of arc at the longest.
const SHORTEST: f64 = 5e-4;
const LONGEST: f64 = 1e5;
/// Distance of the optical axis, in sides of the picture: the picture is cut out of a larger one.
const FARTHEST: f64 = 1e4;

impl Lens {
    /// A lens without distortion and with its axis in the middle.
    pub fn pinhole(size: [f64; 2], focal_px: DVec2) -> Self {
        Self {
            size,
            focal_px,
            principal_px: 0.5 * DVec2::from_array(size),
            distortion: Distortion::NONE,
        }
    }

    /// Errors on sizes and focal lengths that no picture has.
    pub(crate) fn check(&self, format: &'static str) -> Result<(), CameraError> {
        let [w, h] = self.size;
        let size = DVec2::new(w, h);
        let is_size = w >= 1.0 && h >= 1.0 && size.max_element() <= MOST_PIXELS;
        let focal = self.focal_px / size;
        // Comparisons of glam's pass over a NaN beside a number.
        let is_finite = self.focal_px.is_finite() && self.principal_px.is_finite();
        let is_lens =
            is_finite && focal.min_element() >= SHORTEST && focal.max_element() <= LONGEST;
        let off = (self.principal_px / size).abs();
        if is_size && is_lens && off.max_element() <= FARTHEST {
            return Ok(());
        }
        let detail = format!(
            "it has a focal length of {} x {} pixels and its axis at {}, {} for an image of {w} x {h}",
            self.focal_px.x, self.focal_px.y, self.principal_px.x, self.principal_px.y
        );
        Err(CameraError::new(format, detail))
    }

    /// The same lens for an image of another size, which is the whole image stretched.
    pub fn scaled(&self, size: [f64; 2]) -> Self {
        let scale = DVec2::new(size[0] / self.size[0], size[1] / self.size[1]);
        Self {
            size,
            focal_px: self.focal_px * scale,
            principal_px: self.principal_px * scale,
            ..*self
        }
    }
}

/// Where a camera stands and how it is turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Centre of projection, metres.
    pub position: DVec3,
    /// Columns: the camera's right, up and backward axes in the world (orthonormal).
    pub rotation: DMat3,
}

impl Pose {
    /// At the origin, looking along -z.
    pub const IDENTITY: Self = Self {
        position: DVec3::ZERO,
        rotation: DMat3::IDENTITY,
    };

    /// From a matrix of camera to world by rows, three or four of them, in a world of which `up` is
    /// up. A common scale of the axes, which turns no ray, is divided out.
    pub(crate) fn from_rows(
        rows: &[Vec<f64>],
        up: WorldUp,
        format: &'static str,
    ) -> Result<Self, CameraError> {
        let wrong = |what: &str| {
            let accepted = "accepted: a rotation and a position, 4 by 4";
            CameraError::new(format, format!("its camera matrix {what}; {accepted}"))
        };
        if !(3..=4).contains(&rows.len()) || rows.iter().any(|r| r.len() != 4) {
            return Err(wrong("is not 4 by 4"));
        }
        let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
        let matrix = DMat3::from_cols(column(0), column(1), column(2));
        let pose = Self::from_axes(matrix, column(3)).ok_or_else(|| wrong("does not rotate"))?;
        Ok(pose.in_our_world(up))
    }

    /// The camera with these axes. They must be orthogonal and equally long, up to the rounding of the file.
    pub(crate) fn from_axes(matrix: DMat3, position: DVec3) -> Option<Self> {
        let scale = matrix.determinant().cbrt();
        let rotation = matrix * scale.recip();
        let error = rotation * rotation.transpose() - DMat3::IDENTITY;
        let rigid = error.to_cols_array().iter().all(|e| e.abs() < 1e-3);
        if !(scale > 0.0 && rigid && position.is_finite()) {
            return None;
        }
        let x = rotation.x_axis.normalize();
        let z = x.cross(rotation.y_axis).normalize();
        Some(Self {
            position,
            rotation: DMat3::from_cols(x, z.cross(x), z),
        })
    }

    /// From world to camera in image axes (+y down, +z forward), as computer vision writes it:
    /// `camera = rotation * world + translation`.
    pub(crate) fn from_world_to_image(rotation: DMat3, translation: DVec3) -> Option<Self> {
        let to_world = rotation.transpose();
        let flipped = DMat3::from_cols(to_world.x_axis, -to_world.y_axis, -to_world.z_axis);
        Self::from_axes(flipped, -(to_world * translation))
    }

    /// From a world of which `up` is up.
    pub fn in_our_world(self, up: WorldUp) -> Self {
        let turn = up.to_ours();
        Self {
            position: turn * self.position,
            rotation: turn * self.rotation,
        }
    }
}

/// Which axis of a file's world points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WorldUp {
    /// +y, as here.
    #[default]
    Y,
    /// +z, as in Blender and nerfstudio: (x, y, z) becomes (x, z, -y).
    Z,
    /// -y, as where a first camera in image axes is the world: (x, y, z) becomes (x, -y, -z).
    MinusY,
    /// +x, as where that camera was turned by a quarter: (x, y, z) becomes (-y, x, z).
    X,
    /// -x, as where it was turned the other way: (x, y, z) becomes (y, -x, z).
    MinusX,
}

impl WorldUp {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Y, Self::Z, Self::MinusY, Self::X, Self::MinusX];
    /// Those of pictures that were taken upright.
    pub const USUAL: [Self; 3] = [Self::Y, Self::Z, Self::MinusY];

    /// Its word in configurations.
    pub fn word(self) -> &'static str {
        match self {
            Self::Y => "y",
            Self::Z => "z",
            Self::MinusY => "-y",
            Self::X => "x",
            Self::MinusX => "-x",
        }
    }

    /// The rotation into our world.
    pub fn to_ours(self) -> DMat3 {
        match self {
            Self::Y => DMat3::IDENTITY,
            Self::Z => DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
            Self::MinusY => DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z),
            Self::X => DMat3::from_cols(DVec3::Y, DVec3::NEG_X, DVec3::Z),
            Self::MinusX => DMat3::from_cols(DVec3::NEG_Y, DVec3::X, DVec3::Z),
        }
    }
}

/// A lens at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Where it stands.
    pub pose: Pose,
    /// What it sees with.
    pub lens: Lens,
}

impl Camera {
    /// Column and row where `point` is seen, pixels; `None` if it is not.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        let own = self.pose.rotation.transpose() * (point - self.pose.position);
        let lens = &self.lens;
        // Image axes: y down, z forward.
        let image = lens.distortion.image(DVec3::new(own.x, -own.y, -own.z))?;
        Some(lens.principal_px + lens.focal_px * image)
    }

    /// The unit direction of what is seen at `pixel`; `None` where the lens sees nothing.
    pub fn ray(&self, pixel: DVec2) -> Option<DVec3> {
        let lens = &self.lens;
        let plane = (pixel - lens.principal_px) / lens.focal_px;
        let d = lens.distortion.direction(plane)?;
        Some((self.pose.rotation * DVec3::new(d.x, -d.y, -d.z)).normalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let distortion = Distortion::brown_conrady([-0.2, 0.05, 0.0, 0.0], [0.0; 3], [1e-3, 2e-3]);
        Camera {
            pose: Pose {
                position: DVec3::new(1.0, 2.0, 3.0),
                rotation: DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.2),
            },
            lens: Lens {
                principal_px: DVec2::new(330.0, 230.0),
                distortion: distortion.unwrap(),
                ..Lens::pinhole([640.0, 480.0], DVec2::new(500.0, 510.0))
            },
        }
    }

    #[test]
    fn a_distorted_checkerboard_comes_back() {
        let camera = camera();
        let mut seen = 0;
        for i in -6..=6 {
            for j in -4..=4 {
                let board = DVec3::new(0.5 * f64::from(i), 0.5 * f64::from(j), -6.0);
                let point = camera.pose.position + camera.pose.rotation * board;
                let Some(pixel) = camera.project(point) else {
                    continue;
                };
                // Undistorted, the corners are on a regular grid again.
                let d = camera.pose.rotation.transpose() * camera.ray(pixel).unwrap();
                let straight = DVec2::new(d.x, -d.y) / -d.z * camera.lens.focal_px;
                let want = DVec2::new(board.x, -board.y) / 6.0 * camera.lens.focal_px;
                assert!(straight.abs_diff_eq(want, 1e-6), "{straight} {want}");
                seen += 1;
            }
        }
        assert_eq!(seen, 13 * 9);
    }

    #[test]
    fn a_scaled_lens_sees_the_same_directions() {
        let camera = camera();
        let small = Camera {
            lens: camera.lens.scaled([320.0, 120.0]),
            ..camera
        };
        let pixel = DVec2::new(100.0, 400.0);
        let ray = small.ray(pixel * DVec2::new(0.5, 0.25)).unwrap();
        assert!(ray.abs_diff_eq(camera.ray(pixel).unwrap(), 1e-10));
    }
}
