//! `.chan` files, as Nuke and Blender write cameras of a shot.
//!
//! A line is a frame: number, position x y z, rotation x y z in degrees, and the vertical field of
//! view in degrees. The world has +y up; a rotation turns about z, then x, then y: ZXY, which is Nuke's order by default
//! and a choice in Blender. The file does not say it.
use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;

const FORMAT: &str = ".chan";

/// A line of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Its number.
    pub number: i64,
    /// Its camera.
    pub camera: Camera,
    /// Whether the line has a field of view.
    pub states_fov: bool,
}

/// Reads all frames with their numbers, for images of `size` pixels. `fov_deg` is the vertical field
/// of view where the file has none.
///
/// # Errors
/// As [`frames`].
pub fn read(
    text: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
) -> Result<Vec<(i64, Camera)>, CameraError> {
    let frames = frames(text, size, fov_deg)?;
    Ok(frames.iter().map(|f| (f.number, f.camera)).collect())
}

/// As [`read`], and where the fields of view come from.
///
/// # Errors
/// On lines that are no frames or of the same frame, and where no field of view is known.
pub fn frames(text: &str, size: [f64; 2], fov_deg: Option<f64>) -> Result<Vec<Frame>, CameraError> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    let mut line_of = BTreeMap::new();
    lines
        .map(|(index, line)| {
            let frame = frame(index + 1, line, size, fov_deg)?;
            match line_of.insert(frame.number, index + 1) {
                None => Ok(frame),
                Some(first) => {
                    let (second, number) = (index + 1, frame.number);
                    let detail = format!("lines {first} and {second} are both frame {number}");
                    Err(CameraError::with_remedy(FORMAT, detail, "keep one of them"))
                }
            }
        })
        .collect()
}

/// The frame of a line with this number.
fn frame(
    number: usize,
    line: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
) -> Result<Frame, CameraError> {
    let wrong = |detail: &str| CameraError::new(FORMAT, format!("line {number}: {detail}"));
    let values: Option<Vec<f64>> = line.split_whitespace().map(|v| v.parse().ok()).collect();
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
    Ok(Frame {
        number: *frame as i64,
        camera: Camera {
            pose: Pose { position, rotation },
            lens,
        },
        states_fov: !rest.is_empty(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_lines_of_a_frame_are_refused_by_their_numbers() {
        let text = "# shot\n1001 0 1 5 0 0 0 40\n\n1002 0 1 4 0 0 0 40\n1001 0 1 3 0 0 0 40\n";
        let error = read(text, [600.0, 400.0], None).unwrap_err().to_string();
        let want = "lines 2 and 5 are both frame 1001; keep one of them";
        assert!(error.contains(want), "{error}");
    }

    #[test]
    fn a_line_says_whether_it_has_a_field_of_view() {
        let text = "1 0 1 5 0 0 0 40\n2 0 1 4 0 0 0\n";
        let frames = frames(text, [600.0, 400.0], Some(40.0)).unwrap();
        assert_eq!(frames[0].camera.lens, frames[1].camera.lens);
        assert!(frames[0].states_fov && !frames[1].states_fov);
    }
}
