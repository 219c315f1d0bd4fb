//! `.chan` files, as Nuke and Blender write cameras of a shot.
//!
//! A line is a frame: number, position x y z, rotation x y z in degrees, and the vertical field of
//! view in degrees. The world has +y up. The file does not say in which order its rotations turn.
use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;
use crate::file::{self, Wanted, Which};

const FORMAT: &str = ".chan";

/// The axes about which rotations turn, the first one first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turns([usize; 3]);

impl Turns {
    /// About z, then x, then y, as Nuke turns by default.
    pub const ZXY: Self = Self([2, 0, 1]);

    /// From a word such as `zxy`; `None` if it does not name each axis once.
    pub fn parse(word: &str) -> Option<Self> {
        let axes: Option<Vec<usize>> = word.chars().map(|c| "xyz".find(c)).collect();
        let axes: [usize; 3] = axes?.try_into().ok()?;
        let is_whole = (0..3).all(|axis| axes.contains(&axis));
        is_whole.then_some(Self(axes))
    }

    /// The rotation by angles about x, y and z, radians.
    fn rotation(self, angles_rad: [f64; 3]) -> DMat3 {
        let about = |axis: usize| DMat3::from_axis_angle(DVec3::AXES[axis], angles_rad[axis]);
        let [first, second, third] = self.0.map(about);
        third * second * first
    }
}

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

/// Reads all frames with their numbers, turned as by Nuke, for images of `size` pixels. `fov_deg` is the vertical field
/// of view where the file has none.
///
/// # Errors
/// As [`frames`].
pub fn read(
    text: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
) -> Result<Vec<(i64, Camera)>, CameraError> {
    let frames = frames(text, size, fov_deg, Turns::ZXY)?;
    Ok(frames.iter().map(|f| (f.number, f.camera)).collect())
}

/// As [`read`], of rotations that turn as `turns` says, and where the fields of view come from.
///
/// # Errors
/// On lines that are no frames or of the same frame, and where no field of view is known.
pub fn frames(
    text: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
    turns: Turns,
) -> Result<Vec<Frame>, CameraError> {
    let lines = lines(text, size, fov_deg, turns).into_iter();
    lines.map(|(_, frame)| frame).collect()
}

/// The frames of all lines by their numbers, where these can be read, and what is wrong with a line.
pub(crate) fn lines(
    text: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
    turns: Turns,
) -> Vec<(Option<i64>, Result<Frame, CameraError>)> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    let mut line_of = BTreeMap::new();
    let read = |(index, line): (usize, &str)| {
        let second = index + 1;
        let number = number(line);
        let first = number.and_then(|number| Some((number, line_of.insert(number, second)?)));
        let frame = match first {
            None => frame(second, line, size, fov_deg, turns),
            Some((number, first)) => {
                let detail = format!("lines {first} and {second} are both frame {number}");
                Err(CameraError::with_remedy(FORMAT, detail, "keep one of them"))
            }
        };
        (number, frame)
    };
    lines.map(read).collect()
}

/// The wanted frame of these lines. Lines of other frames may be wrong.
pub(crate) fn wanted(
    mut lines: Vec<(Option<i64>, Result<Frame, CameraError>)>,
    wanted: &Wanted,
) -> Result<Frame, CameraError> {
    let (number, picture) = match wanted.which {
        Which::Number(n) => (Some(i64::from(n)), None),
        Which::Name(name) | Which::Frame(name, _) => (
            name.parse().ok().or_else(|| file::number(name.as_ref())),
            Some(name.as_ref()),
        ),
        Which::Photo(path) => (file::number(path), Some(path)),
    };
    if lines.len() == 1 && matches!(wanted.which, Which::Photo(_)) {
        return lines.remove(0).1;
    }
    let count = lines.len();
    let is_it = |own: &Option<i64>| own.is_some() && *own == number;
    let (own, others): (Vec<_>, Vec<_>) = lines.into_iter().partition(|(own, _)| is_it(own));
    // Of two lines of a frame the second is an error.
    let own: Result<Vec<Frame>, _> = own.into_iter().map(|(_, frame)| frame).collect();
    if let Some(frame) = own?.first() {
        return Ok(*frame);
    }
    // It may be a line whose number cannot be read.
    for (own, frame) in others {
        if own.is_none() {
            frame?;
        }
    }
    let name = picture.map(|p| p.file_name().unwrap_or_default());
    let which = match (number, name) {
        (Some(number), Some(name)) => {
            format!("none of number {number}, with which {name:?} ends")
        }
        (Some(number), None) => format!("none of number {number}"),
        (None, name) => format!(
            "{:?} does not end in the number of one",
            name.unwrap_or_default()
        ),
    };
    Err(CameraError::with_remedy(
        FORMAT,
        format!("it has {count} frames, and {which}"),
        "say which by its number, the first in its line",
    ))
}

/// The number of a line's frame, its first.
fn number(line: &str) -> Option<i64> {
    let first: f64 = line.split_whitespace().next()?.parse().ok()?;
    first.is_finite().then_some(first as i64)
}

/// The frame of a line with this number.
fn frame(
    number: usize,
    line: &str,
    size: [f64; 2],
    fov_deg: Option<f64>,
    turns: Turns,
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
    let rotation = turns.rotation([*rx, *ry, *rz].map(f64::to_radians));
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
    use glam::EulerRot;

    use super::*;

    #[test]
    fn two_lines_of_a_frame_are_refused_by_their_numbers() {
        let text = "# shot\n1001 0 1 5 0 0 0 40\n\n1002 0 1 4 0 0 0 40\n1001 0 1 3 0 0 0 40\n";
        let error = read(text, [600.0, 400.0], None).unwrap_err().to_string();
        let want = "lines 2 and 5 are both frame 1001; keep one of them";
        assert!(error.contains(want), "{error}");
    }

    #[test]
    fn rotations_turn_about_the_axes_in_the_order_that_is_named() {
        let text = "1 0 1 5 -20 30 40 50\n";
        let rotation = |word: &str| {
            let turns = Turns::parse(word).unwrap();
            frames(text, [600.0, 400.0], None, turns).unwrap()[0]
                .camera
                .pose
                .rotation
        };
        let [x, y, z] = [-20f64, 30.0, 40.0].map(f64::to_radians);
        for (word, order, angles) in [
            ("zxy", EulerRot::YXZ, [y, x, z]),
            ("xyz", EulerRot::ZYX, [z, y, x]),
            ("yzx", EulerRot::XZY, [x, z, y]),
        ] {
            // Glam names the last turn first.
            let want = DMat3::from_euler(order, angles[0], angles[1], angles[2]);
            assert!(rotation(word).abs_diff_eq(want, 1e-12), "{word}");
        }
        assert_eq!(Turns::parse("zxy"), Some(Turns::ZXY));
        for word in ["", "xy", "xxy", "xyzx", "xyw"] {
            assert_eq!(Turns::parse(word), None, "{word}");
        }
    }

    #[test]
    fn a_line_says_whether_it_has_a_field_of_view() {
        let text = "1 0 1 5 0 0 0 40\n2 0 1 4 0 0 0\n";
        let frames = frames(text, [600.0, 400.0], Some(40.0), Turns::ZXY).unwrap();
        assert_eq!(frames[0].camera.lens, frames[1].camera.lens);
        assert!(frames[0].states_fov && !frames[1].states_fov);
    }
}
