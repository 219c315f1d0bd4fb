//! A shot: frames that one light lights.
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cameras::CameraError;
use dipir_cameras::file::{self, Shown};
use dipir_cli::exit::{Usage, printable};
use dipir_cli::session::Session;
use dipir_imaging::facts::Facts;
use dipir_pipeline::mark::Owned;
use dipir_scene::config::{CameraConfig, EffectSwitch, SceneConfig};
use rayon::prelude::*;
use serde_json::json;

use crate::composite::table::CompositeTable;
use crate::names::COMPOSITE;
use crate::scene::folder::SceneFolder;
use crate::scene::with_place;

pub mod exposure;

/// Folder of the frames' artifacts in that of all.
pub const FOLDER: &str = "frames";
/// Keys that say what is in focus, and how wide the lens was open.
pub const FOCUS: [&str; 4] = [
    "composite.focus_m",
    "composite.focus_at_pixel",
    "composite.f_number",
    "composite.aperture_mm",
];
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

/// Whether the picture of the frame in the folder `frame` is made.
pub fn is_made(frame: &Path) -> bool {
    Owned::of_stage(&frame.join(COMPOSITE.name), COMPOSITE.name).is_some()
}

/// How much more the frame in `path` is exposed than the session's photograph, stops, if the Exif data of both tell; 0 if they
/// are exposed alike.
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
    Ok(Some(match stops.abs() >= SAME_EXPOSURE {
        true => stops,
        false => 0.0,
    }))
}

/// Whether all frames have one camera.
///
/// # Errors
/// If `[scene]` cannot be read, or has a camera that cannot be one.
pub fn camera_stands_still(session: &Session) -> anyhow::Result<bool> {
    let scene: SceneConfig = session.config.table("scene")?;
    let still = scene.camera_stands_still(&session.config.base_dir());
    still.map_err(|e| with_place(e, &session.config))
}

/// What makes the light, and what objects emit, that of a frame which is exposed by `stops` more than the session's photograph and has its white
/// balance by `tint`, stops of each channel, as `KEY=VALUE`.
///
/// # Errors
/// If `[composite]` cannot be read.
pub fn exposed(session: &Session, stops: f64, tint: [f64; 3]) -> anyhow::Result<Vec<String>> {
    let composite: CompositeTable = session.config.table("composite")?;
    let mut set = Vec::new();
    if stops != 0.0 {
        let own = [
            ("exposure_ev", composite.exposure_ev),
            ("emission_ev", composite.emission_ev.unwrap_or_default()),
        ];
        set.extend(own.map(|(key, ev)| {
            let ev = f64::from(ev) + stops;
            format!("composite.{key}={ev:.3}")
        }));
    }
    if tint != [0.0; 3] {
        let own = [
            ("tint", composite.tint),
            ("emission_tint", composite.emission_tint),
        ];
        set.extend(own.map(|(key, own)| {
            let own = own.unwrap_or_default();
            let [r, g, b]: [f64; 3] = std::array::from_fn(|k| f64::from(own[k]) + tint[k]);
            format!("composite.{key}=[{r:.3}, {g:.3}, {b:.3}]")
        }));
    }
    Ok(set)
}

/// What makes a frame focused as the session's photograph is, whose scene is set up: the same distance and opening, as
/// `KEY=VALUE` in place of all keys of [`FOCUS`]. Nothing where these say it alike of every frame, or say nothing.
///
/// # Errors
/// As [`CompositeTable::optics`], and if the scene cannot be read.
pub fn focused(session: &Session) -> anyhow::Result<Vec<String>> {
    let composite: CompositeTable = session.config.table("composite")?;
    let is_told = composite.focus_m.is_some() && composite.aperture_mm.is_some();
    if is_told || (composite.focus_m.is_none() && composite.focus_at_pixel.is_none()) {
        return Ok(Vec::new());
    }
    let loaded = SceneFolder::read(session)?.loaded;
    let lens = composite.lens(&session.config, &loaded)?;
    Ok(lens.map_or_else(Vec::new, |lens| {
        let aperture_mm = 2e3 * lens.radius;
        vec![
            format!("composite.focus_m={:?}", lens.focus),
            format!("composite.aperture_mm={aperture_mm:?}"),
        ]
    }))
}

/// What sets each of `frames` in place of the session's photograph, as `KEY=VALUE`. The camera is its own, unless it
/// `stands_still`. `tell` hears what is assumed of it, and whether that is a warning.
///
/// # Errors
/// If there is no such file or mask, if it is of a format that is not read, or its camera cannot be told from the configuration.
pub fn overrides(
    session: &Session,
    frames: &[PathBuf],
    stands_still: bool,
    tell: impl FnMut(String, bool),
) -> anyhow::Result<Vec<Vec<String>>> {
    let scene: SceneConfig = session.config.table("scene")?;
    let sets = frames.iter().map(|path| picture(session, &scene, path));
    let mut sets = all_or_first(sets)?;
    let Some(camera) = &scene.camera else {
        return Ok(sets);
    };
    if stands_still && camera.transforms.is_none() {
        return Ok(sets);
    }
    if let Some(depth) = scene.depth.as_ref().filter(|_| masks(&scene)) {
        let without = |path: &&PathBuf| beside(depth, &scene, path).is_none();
        if let Some(frame) = frames.iter().find(without) {
            let why = "the camera moves, and scene.depth has no file for it: name those of the frames as their pictures, or \
                       with the same numbers at their ends";
            return Err(wrong(frame, why).into());
        }
    }
    let moved = moved(session, &scene, camera, frames, tell)?;
    let mut taken = BTreeMap::new();
    for ((set, path), moved) in sets.iter_mut().zip(frames).zip(moved) {
        let key = key_of_frame(camera)?;
        let numbered = match (moved, key) {
            (None, Some("frame")) => Some(frame_of_chan(&scene, camera, path)?),
            _ => moved,
        };
        if let Some(frame) = numbered {
            let own = number(path);
            let other = own.and_then(|own| Some((own, taken.insert(own, path)?)));
            // Of one name they have one folder, which is refused elsewhere.
            let other = other.filter(|(_, other)| stem(other) != stem(path));
            if let Some((own, other)) = other {
                let why = format!(
                    "the camera moves, and {own}, the number at the end of its name, is that of {}, too: rename the pictures so \
                     that the frame's number ends their names, as in plate.1001.png",
                    other.display()
                );
                return Err(wrong(path, &why).into());
            }
            // The number alone would take the place of a glTF camera's name.
            let name = camera.image.iter().filter(|_| moved.is_some());
            set.extend(name.map(|name| format!("scene.camera.image={}", json!(name))));
            set.push(format!("scene.camera.frame={frame}"));
        } else if let Some(key) = key {
            let value = text(path, &std::path::absolute(path)?)?;
            set.push(format!("scene.camera.{key}={value}"));
        }
    }
    Ok(sets)
}

/// Whether masks and depths are read.
fn masks(scene: &SceneConfig) -> bool {
    scene.effects.occluders != Some(EffectSwitch::Off)
}

/// The frame of a `.chan` file that the picture in `path` is. Where the photograph's is written, others are counted from it.
fn frame_of_chan(scene: &SceneConfig, camera: &CameraConfig, path: &Path) -> Result<u32, Usage> {
    let why = "its name does not end in the number of a frame of .chan";
    let number = number(path).ok_or_else(|| wrong(path, why))?;
    let frame = counted(scene, camera, path).unwrap_or(number.into());
    u32::try_from(frame).map_err(|_| {
        let why = format!("counted from the photograph's frame it is frame {frame}");
        wrong(path, &why)
    })
}

/// The frame that the picture in `path` is, by the frame that is written for the photograph, if their names are alike but for
/// their numbers.
fn counted(scene: &SceneConfig, camera: &CameraConfig, path: &Path) -> Option<i64> {
    let [own, photo] = [path, scene.background.as_deref()?].map(|p| Some(split(stem(p)?)));
    let (own, photo) = own.zip(photo).filter(|(own, photo)| own.0 == photo.0)?;
    let number = |digits: &str| digits.parse::<u32>().ok().map(i64::from);
    Some(i64::from(camera.frame?) + number(own.1)? - number(photo.1)?)
}

/// Refuses frames without a camera, or with a shutter and a camera that nothing says the motion of, each with the session that makes it, before anything runs.
///
/// # Errors
/// Where the camera's file has none for a frame.
pub fn check_cameras(frames: &[(PathBuf, Session)]) -> anyhow::Result<()> {
    let check = |(path, session): &(PathBuf, Session)| {
        let view = exposure::settings(session)?;
        let checked = view.check_camera(&session.config.base_dir());
        let placed = checked.map_err(|e| with_place(e, &session.config));
        let composite: CompositeTable = session.config.table("composite")?;
        let moves = placed.and_then(|()| composite.shutter_params(&session.config).map(|_| ()));
        moves.with_context(|| path.display().to_string())
    };
    let checked: Vec<_> = frames.par_iter().map(check).collect();
    all_or_first(checked).map(|_| ())
}

/// The values, or the first error with the number of all.
fn all_or_first<T>(results: impl IntoIterator<Item = anyhow::Result<T>>) -> anyhow::Result<Vec<T>> {
    let (mut all, mut wrong) = (Vec::new(), Vec::new());
    for result in results {
        match result {
            Ok(value) => all.push(value),
            Err(e) => wrong.push(e),
        }
    }
    let count = wrong.len();
    match wrong.into_iter().next() {
        None => Ok(all),
        Some(first) if count == 1 => Err(first),
        Some(first) => Err(first.context(format!(
            "{count} frames cannot be used, the first as follows"
        ))),
    }
}

fn wrong(frame: &Path, why: &str) -> Usage {
    Usage(printable(&format!("{}: {why}", frame.display())))
}

/// A path of a frame as TOML has it.
fn text(frame: &Path, path: &Path) -> Result<String, Usage> {
    let text = path.to_str().map(|text| json!(text).to_string());
    text.ok_or_else(|| wrong(frame, "its path is not UTF-8"))
}

/// What sets the picture and the mask of the frame in `path`.
fn picture(session: &Session, scene: &SceneConfig, path: &Path) -> anyhow::Result<Vec<String>> {
    let wrong = |why: &str| wrong(path, why);
    if path.is_dir() {
        return Err(wrong("it is a folder: name the pictures in it").into());
    }
    if !path.is_file() {
        return Err(wrong("there is no such file").into());
    }
    if path.metadata().is_ok_and(|found| found.len() == 0) {
        return Err(wrong("it is empty: copy it again, or leave it out").into());
    }
    dipir_imaging::file::check_format(path)?;
    let mut set = vec![format!(
        "scene.background={}",
        text(path, &std::path::absolute(path)?)?
    )];
    let own = |given: &Option<PathBuf>| {
        let given = given.as_ref().filter(|_| masks(scene));
        beside(given?, scene, path)
    };
    for (key, what, own) in [
        ("occluders", "its mask", own(&scene.occluders)),
        ("depth", "the file of its depths", own(&scene.depth)),
    ] {
        let Some(file) = own else {
            continue;
        };
        if !session.config.base_dir().join(&file).is_file() {
            let file = file.display();
            return Err(wrong(&format!("{what} {file} is missing")).into());
        }
        set.push(format!("scene.{key}={}", text(path, &file)?));
    }
    Ok(set)
}

/// At which frame of the file the camera stands in each of the pictures, if it moves in a glTF. Where the photograph's
/// frame is written, others are counted from it.
fn moved(
    session: &Session,
    scene: &SceneConfig,
    camera: &CameraConfig,
    frames: &[PathBuf],
    mut tell: impl FnMut(String, bool),
) -> anyhow::Result<Vec<Option<u32>>> {
    let Some(own) = &camera.file else {
        return Ok(vec![None; frames.len()]);
    };
    let own = session.config.base_dir().join(own);
    let named = |e: CameraError| Usage(printable(&format!("\"{}\": {e}", own.display())));
    let photos = frames.iter().map(std::path::absolute);
    let photos: Vec<PathBuf> = photos.collect::<std::io::Result<_>>()?;
    let shown = file::all_shown(&own, camera.image.as_deref(), &photos).map_err(named)?;
    let mut frame_of = |path: &Path, shown: Shown| {
        if let Some(frame) = counted(scene, camera, path) {
            // Before the first frame the camera stands still.
            return frame.clamp(0, u32::MAX.into()) as u32;
        }
        let assumed = format!("\"{}\": {}", own.display(), shown.assumed);
        tell(assumed, shown.is_doubtful);
        shown.frame
    };
    let all = frames.iter().zip(shown);
    Ok(all
        .map(|(path, shown)| shown.map(|shown| frame_of(path, shown)))
        .collect())
}

/// The key that chooses a frame's camera, if its picture's name does not.
fn key_of_frame(camera: &CameraConfig) -> anyhow::Result<Option<&'static str>> {
    if camera.transforms.is_some() {
        let message = "scene.camera.transforms names frames by number: write file in its place, \
                       which finds them by the names of their pictures";
        return Err(Usage(message.into()).into());
    }
    let is_chan = |file: &PathBuf| {
        let extension = file.extension();
        extension.is_some_and(|e| e.eq_ignore_ascii_case("chan"))
    };
    Ok(match &camera.file {
        Some(file) if is_chan(file) => Some("frame"),
        Some(_) if camera.image.is_some() || camera.frame.is_some() => Some("image"),
        _ => None,
    })
}

/// What a frame has in place of `given`, a mask or depths of the photograph, and beside it. If that has the photograph's
/// name, the frame's has the frame's; if it ends in the photograph's number, the frame's ends in the frame's, with as many
/// digits. Otherwise `None`: all frames have the photograph's.
fn beside(given: &Path, scene: &SceneConfig, frame: &Path) -> Option<PathBuf> {
    let (of_given, of_photo) = (stem(given)?, stem(scene.background.as_ref()?)?);
    let of_frame = stem(frame)?;
    let [(head, n), (_, photo), (_, number)] = [of_given, of_photo, of_frame].map(split);
    let value = |digits: &str| digits.parse::<u64>().ok();
    let name = match of_given == of_photo {
        true => of_frame.to_string(),
        false if value(n)? == value(photo)? => {
            format!("{head}{:0width$}", value(number)?, width = n.len())
        }
        false => return None,
    };
    let extension = given.extension()?.to_str()?;
    Some(given.with_file_name(format!("{name}.{extension}")))
}

fn stem(path: &Path) -> Option<&str> {
    path.file_stem()?.to_str()
}

/// A name, and the digits at its end.
fn split(stem: &str) -> (&str, &str) {
    stem.split_at(stem.trim_end_matches(|c: char| c.is_ascii_digit()).len())
}

/// What sorts frames as they were taken: by the name before its number, and by that.
pub fn order(path: &Path) -> (PathBuf, u64, PathBuf) {
    let (head, digits) = split(stem(path).unwrap_or_default());
    let number = digits.parse().unwrap_or(u64::MAX);
    (path.with_file_name(head), number, path.into())
}

/// The number at the end of a file's name.
fn number(path: &Path) -> Option<u32> {
    split(stem(path)?).1.parse().ok()
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

    #[test]
    fn a_chan_names_frames_by_number_however_its_extension_is_written() {
        for (file, key) in [
            ("s.chan", Some("frame")),
            ("S.CHAN", Some("frame")),
            ("s.glb", None),
        ] {
            let camera = CameraConfig {
                file: Some(file.into()),
                ..CameraConfig::default()
            };
            assert_eq!(key_of_frame(&camera).unwrap(), key, "{file}");
        }
    }

    #[test]
    fn a_frame_has_the_mask_and_the_depths_of_its_number() {
        let mask = |photo: &str, mask: &str, frame: &str| {
            let scene = SceneConfig {
                background: Some(photo.into()),
                ..SceneConfig::default()
            };
            let found = beside(Path::new(mask), &scene, Path::new(frame))?;
            Some(found.to_str().unwrap().to_string())
        };
        for (photo, given, frame, wanted) in [
            (
                "a/f.1001.jpg",
                "m/roto.1001.png",
                "b/f.1002.jpg",
                Some("m/roto.1002.png"),
            ),
            ("f_01.jpg", "m/f_01.png", "f_07.jpg", Some("m/f_07.png")),
            (
                "f_9.jpg",
                "roto.0009.png",
                "f_10.jpg",
                Some("roto.0010.png"),
            ),
            ("f_09.jpg", "roto.9.png", "f_10.jpg", Some("roto.10.png")),
            ("left.jpg", "m/left.png", "right.jpg", Some("m/right.png")),
            ("f_01.jpg", "bonnet.png", "f_02.jpg", None),
            ("f_01.jpg", "roto_7.png", "f_02.jpg", None),
            ("f_01.jpg", "roto_01.png", "still.jpg", None),
        ] {
            assert_eq!(
                mask(photo, given, frame).as_deref(),
                wanted,
                "{given} {frame}"
            );
        }
    }
}
