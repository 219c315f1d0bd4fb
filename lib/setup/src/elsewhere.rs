//! Other pictures of a shot, which look elsewhere than the photograph and tell its light, too.
use std::path::{Path, PathBuf};

use dipir_cameras::WorldUp;
use dipir_cameras::file::pictures;
use glam::DVec3;

/// Most of them: the light is known better from eight photographs than from four (docs/views.md).
const MOST: usize = 7;
/// Least angle between the directions of two, degrees: less shows little that is new, more leaves little that both show,
/// which tells their exposures.
const APART_DEG: f64 = 30.0;

/// The pictures beside `photo` of which the file at `path` has cameras that look elsewhere: first the nearest to those
/// that are taken. None if the file knows several pictures by the photograph's name.
pub(crate) fn looking_elsewhere(path: &Path, photo: &Path, up: Option<WorldUp>) -> Vec<PathBuf> {
    let (Some(own), Some(folder)) = (photo.file_name(), photo.parent()) else {
        return Vec::new();
    };
    let all: Vec<(PathBuf, DVec3)> = pictures(path, up)
        .into_iter()
        .filter_map(|(name, camera)| {
            let name = Path::new(&name).file_name()?;
            Some((folder.join(name), -camera.pose.rotation.z_axis))
        })
        .collect();
    let of_photo: Vec<DVec3> = all
        .iter()
        .filter(|(picture, _)| picture.file_name() == Some(own))
        .map(|(_, looks)| *looks)
        .collect();
    let [looks] = of_photo[..] else {
        return Vec::new();
    };
    let is_there = |picture: &Path| picture.metadata().is_ok_and(|m| m.is_file() && m.len() > 0);
    let mut taken = vec![looks];
    let mut found = Vec::new();
    while found.len() < MOST {
        let nearest = |looks: DVec3| {
            let angles = taken
                .iter()
                .map(|other| looks.angle_between(*other).to_degrees());
            angles.fold(f64::INFINITY, f64::min)
        };
        let apart = all
            .iter()
            .map(|(picture, looks)| (picture, *looks, nearest(*looks)));
        let apart = apart.filter(|(picture, _, deg)| *deg >= APART_DEG && is_there(picture));
        let Some((picture, looks, _)) = apart.min_by(|a, b| a.2.total_cmp(&b.2)) else {
            break;
        };
        found.push(picture.clone());
        taken.push(looks);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_that_look_elsewhere_are_found_one_beside_the_other() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        // A camera that turns by 10.1 degrees from frame to frame.
        let frame = |k: usize| {
            let (sin, cos) = (10.1 * k as f64).to_radians().sin_cos();
            format!(
                r#"{{ "file_path": "images/{k}.png", "transform_matrix":
                [[{cos},0,{sin},0],[0,1,0,1.5],[{},0,{cos},0],[0,0,0,1]] }}"#,
                -sin
            )
        };
        let frames: Vec<String> = (0..12).map(frame).collect();
        let text = format!(r#"{{ "fl_x": 25, "frames": [{}] }}"#, frames.join(","));
        std::fs::write(at("transforms.json"), &text).unwrap();
        (0..12).for_each(|k| std::fs::write(at(&format!("{k}.png")), "a").unwrap());
        // One is not there, another is empty.
        std::fs::remove_file(at("3.png")).unwrap();
        std::fs::write(at("4.png"), "").unwrap();
        let found = |photo: &str| {
            let all = looking_elsewhere(&at("transforms.json"), &at(photo), Some(WorldUp::Y));
            let name = |p: &PathBuf| p.file_stem().unwrap().to_string_lossy().into_owned();
            all.iter().map(name).collect::<Vec<_>>()
        };
        assert_eq!(found("0.png"), ["5", "8", "11"]);
        assert_eq!(found("6.png"), ["9", "2"]);
        assert!(found("other.png").is_empty());
        // Frames of two cameras with the same names.
        let twice = text.replace("images/1.png", "left/0.png");
        std::fs::write(at("transforms.json"), twice).unwrap();
        assert!(found("0.png").is_empty());
    }
}
