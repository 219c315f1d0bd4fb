//! Cameras of a shot beside that of a picture.
use std::path::Path;

use crate::camera::{Camera, Pose, WorldUp};
use crate::chan::{self, Turns};
use crate::error::CameraError;
use crate::file::{self, Wanted, chosen, number, stem};
use crate::{colmap, moving, transforms};

/// Where the camera of a shot stands at another of its frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// How many frames later that is; negative for earlier ones.
    pub frames: i64,
    /// Where it stands.
    pub pose: Pose,
}

/// The nearest frames before and after the wanted picture that the file at `path` has a camera for, as [`read`](crate::file::read)
/// has it: of `.chan`, of a glTF camera that moves, and of `transforms.json` and COLMAP's model those pictures whose names are
/// alike but for the number at their end. None where the camera stands still, and of other files.
///
/// # Errors
/// As [`read`](crate::file::read).
pub fn neighbours(path: &Path, wanted: &Wanted) -> Result<[Option<Neighbour>; 2], CameraError> {
    if let Some(files) = colmap::Files::at(path) {
        let up = wanted.up.unwrap_or(WorldUp::MinusY);
        let pictures = colmap::pictures(&files, up)?.into_iter();
        let pictures: Vec<_> = pictures.map(|(name, own)| (name, Ok(own))).collect();
        return of_pictures(pictures, wanted, "COLMAP");
    }
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let kind = extension.as_deref().unwrap_or_default();
    if !["chan", "gltf", "glb", "json"].contains(&kind) {
        return Ok([None; 2]);
    }
    let bytes = dipir_files::read(path).map_err(|source| CameraError::Read {
        path: path.into(),
        source,
    })?;
    let bytes = dipir_files::without_byte_order_mark(&bytes);
    let y_up = wanted.up.unwrap_or(WorldUp::Y);
    let in_our_world = |(frames, camera): (i64, Camera)| (frames, camera.pose.in_our_world(y_up));
    match kind {
        "chan" => {
            let text = String::from_utf8_lossy(bytes);
            let turns = wanted.turns.unwrap_or(Turns::ZXY);
            let lines = || chan::lines(&text, wanted.size, wanted.fov_deg, turns);
            let own = chan::wanted(lines(), wanted)?.number;
            // Of two lines of a frame the second is an error.
            let frames = lines().into_iter().filter_map(|(_, frame)| frame.ok());
            let frames = frames.map(|f| (f.number.saturating_sub(own), f.camera));
            Ok(nearest(frames.map(in_our_world)))
        }
        "json" => {
            // Other documents have no frames.
            let up = wanted.up.unwrap_or(WorldUp::Z);
            match transforms::frames(bytes, Some(wanted.size), up) {
                Ok(frames) => of_pictures(frames, wanted, "transforms.json"),
                Err(_) => Ok([None; 2]),
            }
        }
        _ => {
            let beside = moving::beside(bytes, path.parent(), wanted)?;
            Ok(nearest(beside.into_iter().map(in_our_world)))
        }
    }
}

/// What is assumed of a frame that is wanted of a glTF camera before its first or after its last one, as a sentence.
pub fn beyond(path: &Path, wanted: &Wanted) -> Option<String> {
    let bytes = file::is_gltf(path).then(|| dipir_files::read(path).ok())??;
    moving::beyond(&bytes, path.parent(), wanted)
}

impl Neighbour {
    /// Of a picture that was turned by this many quarters, clockwise.
    #[must_use]
    pub fn turned(self, quarters: u32) -> Self {
        Self {
            pose: self.pose.turned(quarters),
            ..self
        }
    }
}

/// The nearest of `frames`, by how many frames later they are, on either side of 0.
fn nearest(frames: impl Iterator<Item = (i64, Pose)>) -> [Option<Neighbour>; 2] {
    let mut found: [Option<Neighbour>; 2] = [None; 2];
    for (frames, pose) in frames.filter(|(frames, _)| *frames != 0) {
        let side = &mut found[usize::from(frames > 0)];
        if side.is_none_or(|known| frames.unsigned_abs() < known.frames.unsigned_abs()) {
            *side = Some(Neighbour { frames, pose });
        }
    }
    found
}

fn of_pictures(
    pictures: Vec<(String, Result<Camera, CameraError>)>,
    wanted: &Wanted,
    format: &'static str,
) -> Result<[Option<Neighbour>; 2], CameraError> {
    let names: Vec<&str> = pictures.iter().map(|(name, _)| name.as_str()).collect();
    let own = chosen(&names, wanted, format)?;
    let Some((series, own)) = numbered(names[own]) else {
        return Ok([None; 2]);
    };
    let others = pictures.iter().filter_map(|(name, camera)| {
        let (_, number) = numbered(name).filter(|(of, _)| *of == series)?;
        Some((number.saturating_sub(own), camera.as_ref().ok()?.pose))
    });
    Ok(nearest(others))
}

/// A picture's name before the number at its end and after it, and the number.
fn numbered(name: &str) -> Option<([&str; 2], i64)> {
    let digits = stem(Path::new(name))?.to_str()?;
    let number = number(Path::new(name))?;
    // A name ends in its stem and, after a point, its extension.
    let end = name.rfind(digits)? + digits.len();
    let head = name[..end].trim_end_matches(|c: char| c.is_ascii_digit());
    Some(([head, &name[end..]], number))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::Which;

    fn wanted(which: Which<'_>) -> Wanted<'_> {
        Wanted {
            size: [600.0, 400.0],
            which,
            up: None,
            fov_deg: None,
            turns: None,
        }
    }

    /// How many frames away the neighbours of a picture are, and the first coordinates of their positions.
    fn beside(name: &str, text: &str, photo: &str) -> [Option<(i64, f64)>; 2] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        let wanted = wanted(Which::Photo(Path::new(photo)));
        let found = neighbours(&path, &wanted).unwrap();
        found.map(|n| n.map(|n| (n.frames, n.pose.position.x)))
    }

    #[test]
    fn a_name_has_a_number_between_its_head_and_its_extension() {
        for (name, want) in [
            ("a/plate.1001.png", Some((["a/plate.", ".png"], 1001))),
            ("plate.1001", Some((["plate.", ""], 1001))),
            ("7.jpg", Some((["", ".jpg"], 7))),
            ("12/12.12.jpg", Some((["12/12.", ".jpg"], 12))),
            ("left.png", None),
            ("", None),
        ] {
            assert_eq!(numbered(name), want, "{name}");
        }
    }

    #[test]
    fn a_chan_has_its_nearest_lines_by_number() {
        let chan = "1001 1 2 3 0 0 0 40\n1009 9 2 3 0 0 0 40\n1003 3 2 3 0 0 0 40\n1004 nan 2 3 0 0 0 40\n1005 5 2 3 0 0 0 40\n";
        let of = |photo| beside("shot.chan", chan, photo);
        assert_eq!(of("plate.1003.png"), [Some((-2, 1.0)), Some((2, 5.0))]);
        assert_eq!(of("plate.1001.png"), [None, Some((2, 3.0))]);
        assert_eq!(of("plate.1009.png"), [Some((-4, 5.0)), None]);
        let one = beside("shot.chan", "7 1 2 3 0 0 0 40", "plate.1003.png");
        assert_eq!(one, [None; 2]);
    }

    #[test]
    fn pictures_have_those_of_their_own_names() {
        let frame = |name: &str, x: u32| {
            format!(
                r#"{{ "file_path": "{name}", "fl_x": 500, "transform_matrix":
                   [[1,0,0,{x}],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }}"#
            )
        };
        let names = [
            "left/0010.png",
            "left/0012.png",
            "right/0011.png",
            "left/0013.png",
            "still.png",
            "left/0011.jpg",
        ];
        let frames: Vec<String> = names.iter().zip(0..).map(|(n, x)| frame(n, x)).collect();
        let json = format!(r#"{{ "frames": [{}] }}"#, frames.join(","));
        let of = |photo| beside("transforms.json", &json, photo);
        assert_eq!(of("left/0012.png"), [Some((-2, 0.0)), Some((1, 3.0))]);
        assert_eq!(of("left/0010.png"), [None, Some((2, 1.0))]);
        assert_eq!(of("right/0011.png"), [None; 2]);
        assert_eq!(of("still.png"), [None; 2]);
        let lens = "camera_matrix: [700, 0, 300, 0, 700, 200, 0, 0, 1]\n";
        assert_eq!(beside("lens.yaml", lens, "a.png"), [None; 2]);
        let lens = r#"{ "camera_matrix": [[700, 0, 300], [0, 700, 200], [0, 0, 1]] }"#;
        assert_eq!(beside("lens.json", lens, "a.png"), [None; 2]);
    }
}
