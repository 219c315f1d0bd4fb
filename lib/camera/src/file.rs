//! The camera of a photograph in a file of any format that is known.
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::camera::{Camera, Lens, Pose, WorldUp};
use crate::chan::Turns;
use crate::error::CameraError;
use crate::orientation::read_turned;
use crate::{buffers, chan, colmap, foreign, fspy, kitti, moving, nuscenes, opencv, transforms};

pub use crate::buffers::{from_base64, is_buffer};
pub use crate::moving::Shown;
pub use crate::upright::doubt;

/// Which of a file's cameras is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which<'a> {
    /// The camera of the picture with this path, as far from its end as they agree, and in a `.chan` file the frame
    /// with the number at the end of its name; if no picture has its name, the only camera. A glTF camera that moves
    /// stands where [`shown`] says.
    Photo(&'a Path),
    /// By number: counted from 0; the frame in a `.chan` file and of a glTF's only camera if that moves, n of `Pn` in
    /// KITTI's.
    Number(u32),
    /// By the name of its picture, or of the camera itself.
    Name(&'a str),
    /// By its name, at this frame: of a glTF camera that moves.
    Frame(&'a str, u32),
}

/// What is asked of a file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted<'a> {
    /// Width and height of the photograph, pixels.
    pub size: [f64; 2],
    /// The camera.
    pub which: Which<'a>,
    /// Which axis of the file's world points up; by default as the program that wrote it has it.
    pub up: Option<WorldUp>,
    /// Vertical field of view of a `.chan` file that has none, degrees.
    pub fov_deg: Option<f64>,
    /// How rotations of a `.chan` file turn; by default [`Turns::ZXY`]. Other files say it themselves.
    pub turns: Option<Turns>,
}

/// A photograph's camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Found {
    /// For the photograph's size.
    pub lens: Lens,
    /// Where it stands; absent in calibrations of a lens alone.
    pub pose: Option<Pose>,
    /// The format, as messages name it.
    pub program: &'static str,
    /// Whether the ground goes through the origin, if the camera is above it.
    pub ground_at_origin: bool,
    /// Whether the file has the field of view; otherwise it is the one that was asked for.
    pub states_fov: bool,
}

/// KITTI's left camera in colour.
const KITTI_LEFT: u32 = 2;
/// What to do about an axis that points up for no reason.
const NO_AXIS: &str = "leave out which axis points up";

/// Reads the camera of a photograph from `path`: an `.fspy` project or its JSON, `transforms.json`,
/// `.chan`, `.gltf` or `.glb`, COLMAP's model, its folder or project, calibrations of OpenCV, ROS and KITTI, and
/// records of nuScenes.
///
/// # Errors
/// On files that cannot be read, without a camera for the photograph, and of pictures of another
/// shape.
pub fn read(path: &Path, wanted: &Wanted) -> Result<Found, CameraError> {
    read_turned(path, wanted, 1).map(|(found, _)| found)
}

/// The pictures of `transforms.json` or of COLMAP's model at `path`, by the names in it, and their cameras: without those that
/// cannot be read, and none of other files. A `transforms.json` may leave sizes to the pictures: its lenses are of no use.
pub fn pictures(path: &Path, up: Option<WorldUp>) -> Vec<(String, Camera)> {
    if let Some(files) = colmap::Files::at(path) {
        return colmap::pictures(&files, up.unwrap_or(WorldUp::MinusY)).unwrap_or_default();
    }
    let is_json = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("json"));
    let Some(bytes) = is_json.then(|| dipir_files::read(path).ok()).flatten() else {
        return Vec::new();
    };
    let bytes = dipir_files::without_byte_order_mark(&bytes);
    let frames = transforms::frames(bytes, Some([1e3, 1e3]), up.unwrap_or(WorldUp::Z));
    let frames = frames.unwrap_or_default().into_iter();
    frames
        .filter_map(|(name, own)| Some((name, own.ok()?)))
        .collect()
}

/// Whether the file in `path` has one camera, whatever a picture is called. A file that cannot be read has none.
pub fn has_one(path: &Path) -> bool {
    let wanted = Wanted {
        // Of any picture: the width of a camera of another shape shall be no fraction of a pixel.
        size: [1e3, 1e3],
        which: Which::Photo(Path::new("")),
        up: None,
        fov_deg: Some(45.0),
        turns: None,
    };
    found(path, &wanted).is_ok()
}

/// The frame that each of `photos` shows of a camera of the glTF file at `path` that moves: of the one with this `name` or,
/// without one, of the one that [`Which::Photo`] means. `None` if it stands still, and of other files.
///
/// # Errors
/// As [`read`].
pub fn all_shown(
    path: &Path,
    name: Option<&str>,
    photos: &[PathBuf],
) -> Result<Vec<Option<Shown>>, CameraError> {
    if !is_gltf(path) {
        return Ok(vec![None; photos.len()]);
    }
    let cannot_read = |source| CameraError::Read {
        path: path.into(),
        source,
    };
    let bytes = dipir_files::read(path).map_err(cannot_read)?;
    moving::shown(&bytes, path.parent(), name, photos)
}

/// As [`all_shown`], of one photo.
///
/// # Errors
/// As [`read`].
pub fn shown(path: &Path, name: Option<&str>, photo: &Path) -> Result<Option<Shown>, CameraError> {
    Ok(all_shown(path, name, &[photo.into()])?.pop().flatten())
}

/// Whether this is the name of a glTF file, of which a camera may move.
pub fn is_gltf(path: &Path) -> bool {
    let is = |kind| {
        path.extension()
            .is_some_and(|e| e.eq_ignore_ascii_case(kind))
    };
    is("gltf") || is("glb")
}

/// Whether this is the name of KITTI's calibration, whose cameras are fixed to a car.
pub fn is_kitti(path: &Path) -> bool {
    let is_text = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("txt"));
    is_text && colmap::Files::at(path).is_none()
}

/// The files that [`read`] reads: `path` itself, and those that have the keys of a glTF's cameras, or those of COLMAP's model.
pub fn parts(path: &Path) -> Vec<PathBuf> {
    match colmap::Files::at(path) {
        Some(files) => ["cameras", "images"].map(|stem| files.part(stem)).into(),
        None if is_gltf(path) => [vec![path.into()], buffers::files(path)].concat(),
        None => vec![path.into()],
    }
}

/// Which of several models [`read`] reads.
pub fn choice(path: &Path) -> Option<String> {
    colmap::Files::at(path)?.choice()
}

/// As [`read`], of a picture of any shape.
pub fn found(path: &Path, wanted: &Wanted) -> Result<Found, CameraError> {
    let of = |camera: Camera, program, ground_at_origin| Found {
        lens: camera.lens,
        pose: Some(camera.pose),
        program,
        ground_at_origin,
        states_fov: true,
    };
    let z_up = wanted.up.unwrap_or(WorldUp::Z);
    if let Some(files) = colmap::Files::at(path) {
        let choose = |names: &[&str]| {
            chosen(names, wanted, "COLMAP").map_err(|e| match (e, files.choice()) {
                (
                    CameraError::Malformed {
                        format,
                        detail,
                        remedy,
                    },
                    Some(choice),
                ) => CameraError::with_remedy(format, format!("{detail}; {choice}"), remedy),
                (e, _) => e,
            })
        };
        // COLMAP's world is that of a first camera, unless it was turned.
        let up = wanted.up.unwrap_or(WorldUp::MinusY);
        let camera = colmap::read_camera(&files, up, choose)?;
        return Ok(of(camera, "COLMAP", false));
    }
    let cannot_read = |source| CameraError::Read {
        path: path.into(),
        source,
    };
    let bytes = dipir_files::read(path).map_err(cannot_read)?;
    // No binary file that is read here begins as text in UTF-16 does.
    dipir_files::refuse_utf16(&bytes).map_err(cannot_read)?;
    let bytes = dipir_files::without_byte_order_mark(&bytes);
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref().unwrap_or_default() {
        "chan" => {
            let text = String::from_utf8_lossy(bytes);
            let turns = wanted.turns.unwrap_or(Turns::ZXY);
            let lines = chan::lines(&text, wanted.size, wanted.fov_deg, turns);
            let chan::Frame {
                camera, states_fov, ..
            } = chan::wanted(lines, wanted)?;
            let pose = camera.pose.in_our_world(wanted.up.unwrap_or(WorldUp::Y));
            Ok(Found {
                states_fov,
                ..of(Camera { pose, ..camera }, ".chan", true)
            })
        }
        "fspy" => {
            only(wanted, "fSpy")?;
            Ok(of(fspy::read(bytes, z_up)?, "fSpy", true))
        }
        "gltf" | "glb" => {
            let camera = moving::read(bytes, path.parent(), wanted)?;
            let pose = camera.pose.in_our_world(wanted.up.unwrap_or(WorldUp::Y));
            Ok(of(Camera { pose, ..camera }, "glTF", true))
        }
        "json" => in_json(bytes, wanted, z_up, of),
        "yaml" | "yml" => lens_alone(&String::from_utf8_lossy(bytes), wanted),
        "txt" => {
            let index = match wanted.which {
                Which::Number(n) => n,
                Which::Photo(_) => KITTI_LEFT,
                Which::Name(name) | Which::Frame(name, _) => {
                    return Err(CameraError::with_remedy(
                        "KITTI",
                        format!("its cameras have numbers, and none the name {name:?}"),
                        "say which by its number, for instance frame = 2 for P2",
                    ));
                }
            };
            if wanted.up.is_some() {
                let detail = "its world is that of its camera 0, of which -y points up";
                return Err(CameraError::with_remedy("KITTI", detail, NO_AXIS));
            }
            let camera = kitti::read(&String::from_utf8_lossy(bytes), index, wanted.size)?;
            Ok(of(camera, "KITTI", false))
        }
        other => Err(foreign::of_extension(other, bytes)),
    }
}

fn in_json(
    bytes: &[u8],
    wanted: &Wanted,
    z_up: WorldUp,
    of: impl Fn(Camera, &'static str, bool) -> Found,
) -> Result<Found, CameraError> {
    let json: Value = serde_json::from_slice(bytes)
        .map_err(|e| CameraError::new("camera's JSON", e.to_string()))?;
    let record = json.get(0).unwrap_or(&json);
    let has = |key: &str| record.get(key).is_some();
    if has("frames") {
        let mut frames = transforms::frames(bytes, Some(wanted.size), z_up)?;
        let names: Vec<&str> = frames.iter().map(|f| f.0.as_str()).collect();
        let chosen = chosen(&names, wanted, "transforms.json")?;
        return Ok(of(frames.swap_remove(chosen).1?, "nerfstudio", false));
    }
    if has("camera_intrinsic") {
        let cameras = nuscenes::read_named(bytes, wanted.size, z_up)?;
        let camera = by_names(cameras, wanted, "nuScenes")??;
        return Ok(of(camera, "nuScenes", true));
    }
    if has("cameraTransform") || has("cameraParameters") {
        only(wanted, "fSpy")?;
        return Ok(of(fspy::read(bytes, z_up)?, "fSpy", true));
    }
    match foreign::of_json(&json) {
        Some(error) => Err(error),
        None => lens_alone(&String::from_utf8_lossy(bytes), wanted),
    }
}

/// What is wanted by the first name of each or, if none has it, by their others.
pub(crate) fn by_names<T, const N: usize>(
    mut all: Vec<([Option<String>; N], T)>,
    wanted: &Wanted,
    format: &'static str,
) -> Result<T, CameraError> {
    let by = |name: &dyn Fn(&[Option<String>; N]) -> Option<&String>| {
        let named = all.iter().map(|(names, _)| name(names));
        let named: Vec<&str> = named.map(|n| n.map_or("", |n| n.as_str())).collect();
        chosen(&named, wanted, format)
    };
    let others = || (0..N).find_map(|k| by(&|names| names[k].as_ref()).ok());
    let chosen = by(&|names| names.iter().flatten().next()).or_else(|e| others().ok_or(e))?;
    Ok(all.swap_remove(chosen).1)
}

fn lens_alone(text: &str, wanted: &Wanted) -> Result<Found, CameraError> {
    only(wanted, "OpenCV")?;
    if wanted.up.is_some() {
        let detail = "it describes a lens alone, which stands in no world";
        return Err(CameraError::with_remedy("OpenCV", detail, NO_AXIS));
    }
    Ok(Found {
        lens: opencv::read(text, Some(wanted.size))?,
        pose: None,
        program: "OpenCV",
        ground_at_origin: false,
        states_fov: true,
    })
}

/// Errors if another camera than the first is wanted of a file that has one.
pub(crate) fn only(wanted: &Wanted, format: &'static str) -> Result<(), CameraError> {
    match wanted.which {
        Which::Number(n @ 1..) => Err(CameraError::with_remedy(
            format,
            format!("it has one camera, and no camera {n}"),
            "leave the number out",
        )),
        _ => Ok(()),
    }
}

/// Which one is wanted among cameras with these names.
pub(crate) fn chosen(
    cameras: &[&str],
    wanted: &Wanted,
    format: &'static str,
) -> Result<usize, CameraError> {
    let (found, what) = match wanted.which {
        Which::Number(n) => (
            Some(n as usize).filter(|n| *n < cameras.len()),
            format!("no camera {n}"),
        ),
        Which::Name(name) | Which::Frame(name, _) => {
            let exact = nearest(cameras, format, name, |own| (own == name).then_some(()))?;
            let by_path = || nearest(cameras, format, name, |own| agreement(own, name.as_ref()));
            (
                exact.map_or_else(by_path, |i| Ok(Some(i)))?,
                format!("none for {name:?}"),
            )
        }
        Which::Photo(path) => {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let only = (cameras.len() == 1).then_some(0);
            let by_path = nearest(cameras, format, &name, |own| agreement(own, path))?;
            (by_path.or(only), format!("none for {name:?}"))
        }
    };
    let cameras_are = cameras.len();
    found.ok_or_else(|| {
        CameraError::with_remedy(
            format,
            format!("it has {cameras_are} cameras, and {what}"),
            "say which by its number from 0 or by the name of its picture (dipir init: --camera-frame, --camera-image)",
        )
    })
}

/// Which of `cameras` agrees best with what is called `name`. An error if two of them do.
fn nearest<A: Ord>(
    cameras: &[&str],
    format: &'static str,
    name: &str,
    agreement: impl Fn(&str) -> Option<A>,
) -> Result<Option<usize>, CameraError> {
    let all = cameras.iter().enumerate();
    let all: Vec<(A, usize)> = all
        .filter_map(|(i, own)| Some((agreement(own)?, i)))
        .collect();
    let Some(best) = all.iter().map(|(agreement, _)| agreement).max() else {
        return Ok(None);
    };
    let mut best = all.iter().filter(|a| a.0 == *best).map(|a| a.1);
    let (first, second) = (best.next(), best.next());
    let Some((first, second)) = first.zip(second) else {
        return Ok(first);
    };
    let names = [first, second].map(|i| cameras[i]);
    let remedy = match names[0] == names[1] {
        true => format!("say which by its number, for instance frame = {second}"),
        false => format!("say which, for instance image = {:?}", names[1]),
    };
    let detail = format!(
        "its cameras {:?} and {:?} match {name:?} equally well",
        names[0], names[1]
    );
    Err(CameraError::with_remedy(format, detail, remedy))
}

/// How many components at the end of two paths are the same, and whether the last ones have the same extension;
/// `None` if those differ in more.
fn agreement(own: &str, other: &Path) -> Option<(usize, bool)> {
    // Programs on Windows separate folders by `\`.
    let own = own.replace('\\', "/");
    let own = Path::new(&own);
    let is_exact = own.file_name()? == other.file_name()?;
    if !is_exact && stem(own) != stem(other) {
        return None;
    }
    let [own, other] = [own, other].map(|path| path.components().rev().skip(1));
    let same = own.zip(other).take_while(|(a, b)| a == b).count();
    Some((1 + same, is_exact))
}

/// A path's last component without its extension. A number is no extension: `Camera.001`, `plate.1001`.
pub(crate) fn stem(path: &Path) -> Option<&OsStr> {
    let is_number = |e: &OsStr| e.as_encoded_bytes().iter().all(u8::is_ascii_digit);
    match path.extension().is_some_and(is_number) {
        true => path.file_name(),
        false => path.file_stem(),
    }
}

/// The digits at the end of a picture's name.
pub(crate) fn number(picture: &Path) -> Option<i64> {
    let stem = stem(picture)?.to_str()?;
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    stem[head.len()..].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(which: Which<'_>) -> Wanted<'_> {
        Wanted {
            size: [600.0, 400.0],
            which,
            up: None,
            fov_deg: None,
            turns: None,
        }
    }

    /// Index of the one that is chosen, or what is wrong.
    fn choice_of(names: &[&str], which: Which) -> Result<usize, String> {
        chosen(names, &wanted(which), "COLMAP").map_err(|e| e.to_string())
    }

    #[test]
    fn of_pictures_of_the_same_name_that_of_the_same_folders_is_chosen() {
        let sides = ["left/0001.png", "right/0001.png", "right/0002.png"];
        let of = |names: &[&str], path: &str| choice_of(names, Which::Photo(path.as_ref()));
        assert_eq!(of(&sides, "/shots/left/0001.png"), Ok(0));
        assert_eq!(of(&sides, "right/0001.png"), Ok(1));
        // With other extensions, too, and the folder tells more than the extension.
        assert_eq!(of(&sides, "right/0001.exr"), Ok(1));
        assert_eq!(of(&["left/1.png", "right/1.jpg"], "right/1.png"), Ok(1));
        assert_eq!(of(&["a/1.jpg", "a/1.png"], "b/1.png"), Ok(1));
        assert_eq!(of(&["./a/1", "./b/1"], "in/b/1.png"), Ok(1));
        // What is unique needs no folder.
        assert_eq!(of(&sides, "elsewhere/0002.jpg"), Ok(2));
        for (path, image) in [("0001.png", "0001.png"), ("up/0001.jpg", "0001.jpg")] {
            let error = of(&sides, path).unwrap_err();
            let want = format!(
                "its cameras \"left/0001.png\" and \"right/0001.png\" match {image:?} equally well; \
                 say which, for instance image = \"right/0001.png\""
            );
            assert!(error.ends_with(&want), "{error}");
        }
    }

    #[test]
    fn a_name_is_one_camera_s() {
        let of = |names: &[&str], name: &str| choice_of(names, Which::Name(name));
        let sides = ["left/0001.png", "0001.png", "right/0001.png"];
        for (name, want) in sides.iter().zip(0..) {
            assert_eq!(of(&sides, name), Ok(want));
        }
        assert_eq!(of(&sides, "/shots/right/0001.png"), Ok(2));
        let error = of(&["CAM", "CAM"], "CAM").unwrap_err();
        let want = "match \"CAM\" equally well; say which by its number, for instance frame = 1";
        assert!(error.ends_with(want), "{error}");
        // Numbers at the end are no extensions.
        let blender = ["Camera", "Camera.001"];
        assert_eq!(of(&blender, "Camera.jpg"), Ok(0));
        assert_eq!(of(&blender, "Camera.001.jpg"), Ok(1));
        assert!(of(&blender, "Camera.002").unwrap_err().contains("none for"));
        // Cameras without names have none that is asked for.
        assert!(choice_of(&["", ""], Which::Photo(Path::new(""))).is_err());
    }

    /// What is read of a file with this name.
    fn found_in(name: &str, text: &str, wanted: &Wanted) -> Result<Found, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        read(&path, wanted).map_err(|e| e.to_string())
    }

    #[test]
    fn a_chan_has_the_frame_with_the_number_of_the_picture() {
        let chan = "1001 1 2 3 0 0 0 40\n1002 4 5 6 0 0 0 40\n";
        let z =
            |which| found_in("shot.chan", chan, &wanted(which)).map(|f| f.pose.unwrap().position.z);
        let photo = |path| z(Which::Photo(Path::new(path)));
        assert_eq!(photo("plates/plate.1001.png"), Ok(3.0));
        assert_eq!(photo("plate_01002.exr"), Ok(6.0));
        assert_eq!(z(Which::Name("plate.1002.png")), Ok(6.0));
        assert_eq!(z(Which::Name("1002")), Ok(6.0));
        let said = |path| photo(path).unwrap_err();
        let want = "it has 2 frames, and none of number 1003, with which \"plate.1003.png\" ends; say which";
        assert!(
            said("plate.1003.png").contains(want),
            "{}",
            said("plate.1003.png")
        );
        let want = "it has 2 frames, and \"plate.png\" does not end in the number of one";
        assert!(said("plate.png").contains(want), "{}", said("plate.png"));
        let one = "7 1 2 3 0 0 0 40";
        let of_one = wanted(Which::Photo(Path::new("plate.1003.png")));
        assert!(found_in("shot.chan", one, &of_one).is_ok());
    }

    #[test]
    fn of_a_chan_only_the_line_of_the_frame_has_to_be_right() {
        let chan = "1001 1 2 3 0 0 0 40\n1002 nan 5 6 0 0 0 40\n1003 1 2\n1004 1 2 7 0 0 0 40\n1004 0 0 0 0 0 0 40\n";
        let z = |text: &str, n| {
            found_in("shot.chan", text, &wanted(Which::Number(n)))
                .map(|f| f.pose.unwrap().position.z)
        };
        assert_eq!(z(chan, 1001), Ok(3.0));
        for (n, want) in [
            (1002, "line 2: expected a frame, a position and a rotation"),
            (1003, "line 3: expected a frame, a position and a rotation"),
            (1004, "lines 4 and 5 are both frame 1004; keep one of them"),
            (1005, "it has 5 frames, and none of number 1005"),
        ] {
            let error = z(chan, n).unwrap_err();
            assert!(error.contains(want), "{error}");
        }
        let numberless = "1001 1 2 3 0 0 0 40\n1OO2 4 5 6 0 0 0 40\n";
        assert_eq!(z(numberless, 1001), Ok(3.0));
        let error = z(numberless, 1002).unwrap_err();
        assert!(error.contains("line 2: expected a frame"), "{error}");
    }

    #[test]
    fn a_chan_is_turned_up_and_says_whether_it_has_a_field_of_view() {
        let of = |text: &str| {
            let asked = Wanted {
                up: Some(WorldUp::Z),
                fov_deg: Some(50.0),
                ..wanted(Which::Photo(Path::new("a.png")))
            };
            found_in("shot.chan", text, &asked).unwrap()
        };
        let (own, asked) = (of("1 1 2 3 0 0 0 40"), of("1 1 2 3 0 0 0"));
        assert!(own.states_fov && !asked.states_fov);
        assert_eq!(own.pose.unwrap().position.to_array(), [1.0, 3.0, -2.0]);
    }

    #[test]
    fn what_a_file_cannot_answer_is_refused() {
        let kitti = "P2: 700 0 300 0 0 700 200 0 0 0 1 0\n";
        let lens = "camera_matrix: [700, 0, 300, 0, 700, 200, 0, 0, 1]\n";
        let photo = wanted(Which::Photo(Path::new("a.png")));
        let up = Wanted {
            up: Some(WorldUp::Z),
            ..photo
        };
        for (name, text, asked, want) in [
            (
                "calib.txt",
                kitti,
                wanted(Which::Name("P3")),
                "none the name \"P3\"; say which by its number",
            ),
            ("calib.txt", kitti, up, "of which -y points up; leave out"),
            (
                "lens.yaml",
                lens,
                up,
                "a lens alone, which stands in no world",
            ),
            (
                "lens.yaml",
                lens,
                wanted(Which::Number(2)),
                "it has one camera, and no camera 2",
            ),
        ] {
            assert!(found_in(name, text, &photo).is_ok(), "{name}");
            let error = found_in(name, text, &asked).unwrap_err();
            assert!(error.contains(want), "{error}");
        }
    }
}
