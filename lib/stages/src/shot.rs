//! A shot: frames that one light lights.
use std::path::{Path, PathBuf};

use dipir_cli::exit::{Usage, printable};
use dipir_cli::session::Session;
use dipir_imaging::facts::Facts;
use dipir_scene::config::{CameraConfig, ObjectConfig, SceneConfig};
use serde_json::json;

use crate::composite::table::CompositeTable;

/// Folder of the frames' artifacts in that of all.
pub const FOLDER: &str = "frames";
/// Exposures that differ by less are one, stops: cameras round times and f-numbers.
const SAME_EXPOSURE: f64 = 0.05;

/// Folders of the frames that were begun.
pub fn folders(out: &Path) -> Vec<PathBuf> {
    let entries = out.join(FOLDER).read_dir().into_iter().flatten().flatten();
    let folders = entries.filter(|e| e.file_type().is_ok_and(|t| t.is_dir()));
    let mut folders: Vec<PathBuf> = folders.map(|e| e.path()).collect();
    folders.sort();
    folders
}

/// How much more the frame in `path` is exposed than the session's photograph, stops, if the Exif data of both tell and
/// they are not exposed alike.
///
/// # Errors
/// If `[scene]` cannot be read.
pub fn exposure_stops(session: &Session, path: &Path) -> anyhow::Result<Option<f64>> {
    let scene: SceneConfig = session.config.table("scene")?;
    let photo = scene.background.map(|b| session.config.base_dir().join(b));
    let told = |path: &Path| Facts::exposure_stops_of(path);
    let Some((photo, frame)) = photo.and_then(|p| told(&p)).zip(told(path)) else {
        return Ok(None);
    };
    let stops = (frame - photo).clamp(-30.0, 30.0);
    Ok((stops.abs() >= SAME_EXPOSURE).then_some(stops))
}

/// What sets the frame in `path`, exposed by `stops` more, in place of the session's photograph, as `KEY=VALUE`.
///
/// # Errors
/// If there is no such file, or what is placed or seen in it cannot be told from the configuration.
pub fn overrides(session: &Session, path: &Path, stops: f64) -> anyhow::Result<Vec<String>> {
    let wrong = |why: &str| Usage(printable(&format!("{}: {why}", path.display())));
    let scene: SceneConfig = session.config.table("scene")?;
    let (true, Some(name)) = (path.is_file(), path.file_name()) else {
        return Err(wrong("there is no such file").into());
    };
    let text = |path: &Path| match path.to_str() {
        Some(text) => Ok(json!(text).to_string()),
        None => Err(wrong("its path is not UTF-8")),
    };
    let mut set = vec![format!(
        "scene.background={}",
        text(&std::path::absolute(path)?)?
    )];
    if stops != 0.0 {
        let composite: CompositeTable = session.config.table("composite")?;
        let exposure_ev = f64::from(composite.exposure_ev) + stops;
        set.push(format!("composite.exposure_ev={exposure_ev:.3}"));
    }
    let Some(camera) = &scene.camera else {
        return Ok(set);
    };
    if let Some(file) = &camera.file {
        if dipir_cameras::file::has_one(&session.config.base_dir().join(file)) {
            return Ok(set);
        }
        refuse_pixels(&scene.objects)?;
    }
    if let Some(key) = key_of_frame(camera)? {
        let value = match key {
            "frame" => number(path)
                .ok_or_else(|| wrong("its name does not end in the number of a frame of .chan"))?
                .to_string(),
            _ => text(Path::new(name))?,
        };
        set.push(format!("scene.camera.{key}={value}"));
    }
    Ok(set)
}

/// The key that chooses a frame's camera, if its picture's name does not.
fn key_of_frame(camera: &CameraConfig) -> anyhow::Result<Option<&'static str>> {
    if camera.transforms.is_some() {
        let message = "scene.camera.transforms names frames by number: write file in its place, \
                       which finds them by the names of their pictures";
        return Err(Usage(message.into()).into());
    }
    let is_chan = |file: &PathBuf| file.extension().is_some_and(|e| e == "chan");
    Ok(match &camera.file {
        Some(file) if is_chan(file) => Some("frame"),
        Some(_) if camera.image.is_some() || camera.frame.is_some() => Some("image"),
        _ => None,
    })
}

/// The digits at the end of a file's name.
fn number(path: &Path) -> Option<u32> {
    let stem = path.file_stem()?.to_str()?;
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    stem[head.len()..].parse().ok()
}

/// Refuses what would be placed anew in every frame.
fn refuse_pixels(objects: &[ObjectConfig]) -> anyhow::Result<()> {
    for (i, object) in objects.iter().enumerate() {
        let keys = [
            ("at_pixel", object.at_pixel.is_some()),
            ("to_pixel", object.to_pixel.is_some()),
            ("place", object.place.is_some()),
        ];
        if let Some((key, _)) = keys.iter().find(|key| key.1) {
            let message = format!(
                "scene.objects[{i}].{key} is found anew in every frame, and the camera moves: write position and yaw_deg"
            );
            return Err(Usage(message).into());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_a_frame_ends_its_name() {
        for (name, wanted) in [
            ("shot_0042.png", Some(42)),
            ("7.jpg", Some(7)),
            ("v2_plate.jpg", None),
            ("99999999999.jpg", None),
        ] {
            assert_eq!(number(Path::new(name)), wanted, "{name}");
        }
    }
}
