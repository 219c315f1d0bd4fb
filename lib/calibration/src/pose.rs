//! How a camera is turned and how wide it sees.
use glam::{DMat3, DVec3};

/// Pitch, roll and focal length of a camera without distortion, its optical axis in the middle of the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Upwards, degrees.
    pub pitch_deg: f64,
    /// Clockwise about the line of sight, degrees.
    pub roll_deg: f64,
    /// Logarithm of the focal length over the picture's longer side.
    pub log_focal: f64,
}

impl Pose {
    /// The pose of a camera whose field of view along the longer side is `fov_deg`.
    pub fn new(pitch_deg: f64, roll_deg: f64, fov_deg: f64) -> Self {
        Self {
            pitch_deg,
            roll_deg,
            log_focal: log_focal(fov_deg),
        }
    }

    /// Focal length over the picture's longer side.
    pub fn focal(&self) -> f64 {
        self.log_focal.exp()
    }

    /// Columns: the camera's right, up and backward axes. Seen from above, the camera looks along the world's -z.
    pub fn rotation(&self) -> DMat3 {
        DMat3::from_rotation_x(self.pitch_deg.to_radians())
            * DMat3::from_rotation_z(-self.roll_deg.to_radians())
    }

    /// The world's right, up and backward axes in the camera's.
    pub(crate) fn axes(&self) -> [DVec3; 3] {
        let m = self.rotation().transpose();
        [m.x_axis, m.y_axis, m.z_axis]
    }
}

/// The logarithm of the focal length over the longer side, of the angle that is seen along it, degrees.
pub fn log_focal(fov_deg: f64) -> f64 {
    -(2.0 * (0.5 * fov_deg.to_radians()).tan()).ln()
}

/// The angle that is seen along the longer side, degrees.
pub fn fov_deg(log_focal: f64) -> f64 {
    2.0 * (0.5 / log_focal.exp()).atan().to_degrees()
}
