//! `.chan` files, as Nuke and Blender write cameras of a shot.
//!
//! A line is a frame: number, position x y z, rotation x y z in degrees, and the vertical field of
//! view in degrees. The world has +y up; a rotation turns about z, then x, then y.
use glam::{DMat3, DVec2, DVec3};

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;

const FORMAT: &str = ".chan";

/// Reads all frames with their numbers, for images of `size` pixels. `fov_deg` is the vertical field
/// of view where the file has none.
///
/// # Errors
/// On lines that are no frames, and where no field of view is known.
pub fn read(
    text: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
) -> Result<Vec<(i64, Camera)>, CameraError> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    lines
        .map(|(number, line)| {
            let wrong =
                |detail: &str| CameraError::new(FORMAT, format!("line {}: {detail}", number + 1));
            let values: Option<Vec<f64>> =
                line.split_whitespace().map(|v| v.parse().ok()).collect();
            let values = values.filter(|v| v.iter().all(|v| v.is_finite()));
            let Some([frame, tx, ty, tz, rx, ry, rz, rest @ ..]) = values.as_deref() else {
                return Err(wrong("expected a frame, a position and a rotation"));
            };
            let Some(fov) = rest.first().copied().or(fov_deg) else {
                return Err(wrong("it has no field of view"));
            };
            if !(fov > 0.0 && fov < 180.0) {
                return Err(wrong("its field of view is not between 0 and 180 degrees"));
            }
            let [x, y, z] = [*rx, *ry, *rz].map(f64::to_radians);
            let rotation =
                DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x) * DMat3::from_rotation_z(z);
            let focal = 0.5 * size[1] / (0.5 * fov.to_radians()).tan();
            let lens = Lens::pinhole(size, DVec2::splat(focal));
            lens.check(FORMAT)?;
            let position = DVec3::new(*tx, *ty, *tz);
            Ok((
                *frame as i64,
                Camera {
                    pose: Pose { position, rotation },
                    lens,
                },
            ))
        })
        .collect()
}
