//! The camera of a photograph in a file of any format that is known.
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::camera::{Camera, Lens, Pose, WorldUp};
use crate::error::CameraError;
use crate::{chan, colmap, fspy, gltf, kitti, nuscenes, opencv, transforms};

/// Which of a file's cameras is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which<'a> {
    /// The camera of the picture that has this file's name; if no picture has it, the only camera.
    Photo(&'a Path),
    /// By number: counted from 0; the frame in a `.chan` file, n of `Pn` in KITTI's.
    Number(u32),
    /// By the name of its picture, or of the camera itself.
    Name(&'a str),
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
}

/// By how much the shapes of two pictures may differ, relative.
const SAME_SHAPE: f64 = 0.01;
/// KITTI's left camera in colour.
const KITTI_LEFT: u32 = 2;

/// Reads the camera of a photograph from `path`: an `.fspy` project or its JSON, `transforms.json`,
/// `.chan`, `.gltf` or `.glb`, COLMAP's model, its folder or project, calibrations of OpenCV, ROS and KITTI, and
/// records of nuScenes.
///
/// # Errors
/// On files that cannot be read, without a camera for the photograph, and of pictures of another
/// shape.
pub fn read(path: &Path, wanted: &Wanted) -> Result<Found, CameraError> {
    let mut found = found(path, wanted)?;
    let ([w, h], size) = (found.lens.size, wanted.size);
    if (w / h / (size[0] / size[1]) - 1.0).abs() > SAME_SHAPE {
        return Err(CameraError::with_remedy(
            found.program,
            format!(
                "it is of a picture of {w} x {h} pixels, and the photograph has {} x {}",
                size[0], size[1]
            ),
            "use the picture that it was made for, uncropped, or name that picture's camera",
        ));
    }
    found.lens = found.lens.scaled(size);
    Ok(found)
}

/// Whether the file in `path` has one camera, whatever a picture is called. A file that cannot be read has none.
pub fn has_one(path: &Path) -> bool {
    let wanted = Wanted {
        size: [1.0, 1.0],
        which: Which::Photo(Path::new("")),
        up: None,
        fov_deg: Some(45.0),
    };
    found(path, &wanted).is_ok()
}

/// The files that [`read`] reads: `path` itself, or those of COLMAP's model.
pub fn parts(path: &Path) -> Vec<PathBuf> {
    match colmap::Files::at(path) {
        Some(files) => ["cameras", "images"].map(|stem| files.part(stem)).into(),
        None => vec![path.into()],
    }
}

/// Which of several models [`read`] reads.
pub fn choice(path: &Path) -> Option<String> {
    colmap::Files::at(path)?.choice()
}

fn found(path: &Path, wanted: &Wanted) -> Result<Found, CameraError> {
    let of = |camera: Camera, program, ground_at_origin| Found {
        lens: camera.lens,
        pose: Some(camera.pose),
        program,
        ground_at_origin,
    };
    let z_up = wanted.up.unwrap_or(WorldUp::Z);
    if let Some(files) = colmap::Files::at(path) {
        // COLMAP's world is that of a first camera, unless it was turned.
        let cameras = colmap::read_cameras(&files, wanted.up.unwrap_or(WorldUp::MinusY))?;
        let camera = chosen(&cameras, wanted, "COLMAP").map_err(|e| match (e, files.choice()) {
            (
                CameraError::Malformed {
                    format,
                    detail,
                    remedy,
                },
                Some(choice),
            ) => CameraError::with_remedy(format, format!("{detail}; {choice}"), remedy),
            (e, _) => e,
        })?;
        return Ok(of(camera, "COLMAP", false));
    }
    let bytes = dipir_files::read(path).map_err(|source| CameraError::Read {
        path: path.into(),
        source,
    })?;
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref().unwrap_or_default() {
        "chan" => {
            let text = String::from_utf8_lossy(&bytes);
            let frames = chan::read(&text, wanted.size, wanted.fov_deg)?;
            Ok(of(of_chan(&frames, wanted)?, ".chan", true))
        }
        "fspy" => Ok(of(fspy::read(&bytes, z_up)?, "fSpy", true)),
        "gltf" | "glb" => {
            let cameras = gltf::read(&bytes, wanted.size)?;
            let turn = wanted.up.unwrap_or(WorldUp::Y);
            let camera = chosen(&cameras, wanted, "glTF")?;
            let pose = camera.pose.in_our_world(turn);
            Ok(of(Camera { pose, ..camera }, "glTF", true))
        }
        "json" => in_json(&bytes, wanted, z_up, of),
        "yaml" | "yml" => lens_alone(&String::from_utf8_lossy(&bytes), wanted),
        "txt" => {
            let index = match wanted.which {
                Which::Number(n) => n,
                _ => KITTI_LEFT,
            };
            let camera = kitti::read(&String::from_utf8_lossy(&bytes), index, wanted.size)?;
            Ok(of(camera, "KITTI", false))
        }
        _ => Err(CameraError::with_remedy(
            "camera's",
            "it is not a kind of file that is known",
            "use .fspy, transforms.json, .chan, .glb, .gltf, COLMAP's folder or project, or a calibration \
             of OpenCV (.yaml, .json), KITTI (.txt) or nuScenes (.json)",
        )),
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
        let frames = transforms::read(bytes, Some(wanted.size), z_up)?;
        let camera = chosen(&frames, wanted, "transforms.json")?;
        return Ok(of(camera, "nerfstudio", false));
    }
    if has("camera_intrinsic") {
        let cameras = nuscenes::read(bytes, wanted.size, z_up)?;
        return Ok(of(chosen(&cameras, wanted, "nuScenes")?, "nuScenes", true));
    }
    if has("cameraTransform") || has("cameraParameters") {
        return Ok(of(fspy::read(bytes, z_up)?, "fSpy", true));
    }
    lens_alone(&String::from_utf8_lossy(bytes), wanted)
}

fn lens_alone(text: &str, wanted: &Wanted) -> Result<Found, CameraError> {
    Ok(Found {
        lens: opencv::read(text, Some(wanted.size))?,
        pose: None,
        program: "OpenCV",
        ground_at_origin: false,
    })
}

/// The camera that is wanted among those with names.
fn chosen(
    cameras: &[(String, Camera)],
    wanted: &Wanted,
    format: &'static str,
) -> Result<Camera, CameraError> {
    let named = |name: &Path| {
        let same = |part: fn(&Path) -> Option<&std::ffi::OsStr>| {
            let of = |c: &&(String, Camera)| part(Path::new(&c.0)) == part(name);
            cameras.iter().find(of)
        };
        same(Path::file_name).or_else(|| same(Path::file_stem))
    };
    let (found, what) = match wanted.which {
        Which::Number(n) => (cameras.get(n as usize), format!("no camera {n}")),
        Which::Name(name) => (
            cameras
                .iter()
                .find(|c| c.0 == name)
                .or(named(name.as_ref())),
            format!("none for {name:?}"),
        ),
        Which::Photo(path) => (
            named(path).or(match cameras {
                [only] => Some(only),
                _ => None,
            }),
            format!("none for {:?}", path.file_name().unwrap_or_default()),
        ),
    };
    let cameras_are = cameras.len();
    found.map(|c| c.1).ok_or_else(|| {
        CameraError::with_remedy(
            format,
            format!("it has {cameras_are} cameras, and {what}"),
            "say which by its number from 0 or by the name of its picture",
        )
    })
}

fn of_chan(frames: &[(i64, Camera)], wanted: &Wanted) -> Result<Camera, CameraError> {
    let found = match wanted.which {
        Which::Number(n) => frames.iter().find(|f| f.0 == i64::from(n)),
        Which::Name(name) => frames.iter().find(|f| f.0.to_string() == name),
        Which::Photo(_) => match frames {
            [only] => Some(only),
            _ => None,
        },
    };
    found.map(|f| f.1).ok_or_else(|| {
        CameraError::with_remedy(
            ".chan",
            format!(
                "it has {} frames, and not the one that is wanted",
                frames.len()
            ),
            "say which by its number, the first in its line",
        )
    })
}
