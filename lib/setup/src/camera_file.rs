//! The camera of a photograph out of another program's file.
use std::path::Path;

use dipir_cameras::camera::WorldUp;
use dipir_cameras::{Camera, CameraError, Lens, chan, colmap, fspy, transforms};
use glam::{DVec2, DVec3};

use crate::error::SetupError;
use crate::view::{Aim, CameraOptions, EYE_HEIGHT_M, View};

/// Where the ground is in a file's world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ground {
    /// Through the origin, if the camera is above it.
    Origin,
    /// Below the camera.
    Unknown,
}

/// By how much the shapes of two pictures may differ, relative.
const SAME_SHAPE: f64 = 0.01;
/// Most that a lens bends a corner, and that pixels differ from squares at a corner, pixels.
const MOST_BENT_PX: f64 = 1.0;
/// Least shift of the optical axis that is written down, pixels.
const LEAST_SHIFT_PX: f64 = 0.5;

/// The camera that the file or folder at `path` has for `photo`, of `size` pixels. `up` overrules
/// which axis of its world points up.
///
/// # Errors
/// On files that cannot be read, without a camera for the photograph, of pictures of another
/// shape, and with lenses that bend lines.
pub fn read(
    path: &Path,
    photo: &Path,
    size: [u32; 2],
    up: Option<WorldUp>,
    asked: &CameraOptions,
) -> Result<View, SetupError> {
    asked.check()?;
    let size = size.map(f64::from);
    let is_chan = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("chan"));
    if let Some(fov_deg) = asked.fov_deg.filter(|_| !is_chan) {
        return Err(SetupError::Value {
            option: "--fov",
            value: fov_deg.to_string(),
            accepted: "left out, for the camera's file says it",
        });
    }
    let (camera, ground, program) = camera(path, photo, size, up, asked)?;
    let wrong = |detail: String, remedy: &'static str| SetupError::Camera {
        path: path.into(),
        detail,
        remedy,
    };
    let [w, h] = camera.lens.size;
    if (w / h / (size[0] / size[1]) - 1.0).abs() > SAME_SHAPE {
        return Err(wrong(
            format!(
                "it is of a picture of {w} x {h} pixels, and the photograph has {} x {}",
                size[0], size[1]
            ),
            "use the picture that it was made for",
        ));
    }
    let lens = camera.lens.scaled(size);
    if bent_px(&lens) > MOST_BENT_PX {
        return Err(wrong(
            "its lens bends straight lines, which the renderer's does not".into(),
            "undistort photograph and camera first, for instance with colmap image_undistorter",
        ));
    }
    let focal = lens.focal_px;
    if (focal.x / focal.y - 1.0).abs() * 0.5 * size[0] > MOST_BENT_PX {
        return Err(wrong(
            format!(
                "its pixels are not square: focal lengths {} and {}",
                focal.x, focal.y
            ),
            "name it in pipeline.toml: [scene.camera] transforms = \"transforms.json\"",
        ));
    }
    Ok(view(&camera, &lens, ground, program, path, asked))
}

fn view(
    camera: &Camera,
    lens: &Lens,
    ground: Ground,
    program: &str,
    path: &Path,
    asked: &CameraOptions,
) -> View {
    let (pose, size) = (camera.pose, DVec2::from_array(lens.size));
    let shift = lens.principal_px - 0.5 * size;
    let (ground_y, position_why) = match (asked.eye_height_m, ground) {
        (None, Ground::Origin) if pose.position.y > 0.01 => {
            (0.0, "the ground goes through the file's origin".to_string())
        }
        (height, _) => {
            let height = height.unwrap_or(EYE_HEIGHT_M);
            let why = match asked.eye_height_m {
                Some(_) => "the ground is below it as --eye-height says".into(),
                None => format!(
                    "where the ground is is not known: {height} m below it is a guess; or --eye-height"
                ),
            };
            (pose.position.y - height, why)
        }
    };
    // Debug quotes control characters.
    let name = path.file_name().unwrap_or(path.as_os_str());
    let from = format!("from {program}'s file {name:?}");
    View {
        position: pose.position,
        aim: Aim::At {
            // Five metres ahead: rounding the point does not turn the line of sight.
            look_at: pose.position - 5.0 * pose.rotation.z_axis,
            up: pose.rotation.y_axis,
        },
        fov_deg: 2.0 * (0.5 * size.y / lens.focal_px.y).atan().to_degrees(),
        principal_px: (shift.abs().max_element() > LEAST_SHIFT_PX).then_some(lens.principal_px),
        ground_y,
        position_why: format!("{from}; {position_why}"),
        aim_why: from.clone(),
        fov_why: from,
    }
}

/// How far the lens moves the picture's corners.
fn bent_px(lens: &Lens) -> f64 {
    let [w, h] = lens.size;
    let corners = [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]];
    let bent = corners.map(|corner| {
        let straight = (DVec2::from_array(corner) - lens.principal_px) / lens.focal_px;
        let image = lens
            .distortion
            .image(DVec3::new(straight.x, straight.y, 1.0));
        image.map_or(f64::INFINITY, |i| {
            ((i.point - straight) * lens.focal_px).length()
        })
    });
    bent.into_iter().fold(0.0, f64::max)
}

type Found = (Camera, Ground, &'static str);

fn camera(
    path: &Path,
    photo: &Path,
    size: [f64; 2],
    up: Option<WorldUp>,
    asked: &CameraOptions,
) -> Result<Found, SetupError> {
    let damaged = |source: CameraError| SetupError::CameraFile {
        path: path.into(),
        source,
    };
    if path.is_dir() {
        // COLMAP's world is that of a first camera, unless it was turned.
        let model = colmap::read(path, up.unwrap_or(WorldUp::MinusY)).map_err(damaged)?;
        let camera = of_photo(&model.images, path, photo)?;
        return Ok((camera, Ground::Unknown, "COLMAP"));
    }
    let bytes = dipir_files::read(path).map_err(|source| SetupError::Read {
        path: path.into(),
        source,
    })?;
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("chan") => {
            // A field of view along the longer side is vertical in an upright picture only.
            let longer = size[0].max(size[1]);
            let vertical = asked.fov_deg.map(|deg| {
                let half = (0.5 * deg.to_radians()).tan() * size[1] / longer;
                2.0 * half.atan().to_degrees()
            });
            let text = String::from_utf8_lossy(&bytes);
            let frames = chan::read(&text, size, vertical).map_err(damaged)?;
            let frames: Vec<(String, Camera)> = frames
                .into_iter()
                .map(|(frame, camera)| (format!("frame {frame}"), camera))
                .collect();
            Ok((of_photo(&frames, path, photo)?, Ground::Origin, ".chan"))
        }
        Some("fspy" | "json") if !names_frames(&bytes) => {
            let camera = fspy::read(&bytes, up.unwrap_or(WorldUp::Z)).map_err(damaged)?;
            Ok((camera, Ground::Origin, "fSpy"))
        }
        Some("json") => {
            let up = up.unwrap_or(WorldUp::Z);
            let frames = transforms::read(&bytes, Some(size), up).map_err(damaged)?;
            let camera = of_photo(&frames, path, photo)?;
            Ok((camera, Ground::Unknown, "nerfstudio"))
        }
        _ => Err(SetupError::Camera {
            path: path.into(),
            detail: "it is not a kind of file that is known".into(),
            remedy: "use .fspy, fSpy's .json, transforms.json, .chan or a folder of COLMAP's",
        }),
    }
}

/// Whether the JSON is a `transforms.json`; a project of fSpy never is.
fn names_frames(bytes: &[u8]) -> bool {
    let key = b"\"frames\"";
    !bytes.starts_with(b"fspy") && bytes.windows(key.len()).any(|w| w == key)
}

/// The camera of the image with the photograph's name, else the only one.
fn of_photo(cameras: &[(String, Camera)], path: &Path, photo: &Path) -> Result<Camera, SetupError> {
    let same = |part: fn(&Path) -> Option<&std::ffi::OsStr>| {
        let named = |c: &&(String, Camera)| part(Path::new(&c.0)) == part(photo);
        cameras.iter().find(named)
    };
    let found = same(Path::file_name).or_else(|| same(Path::file_stem));
    match (found, cameras) {
        (Some((_, camera)), _) | (None, [(_, camera)]) => Ok(*camera),
        _ => Err(SetupError::Camera {
            path: path.into(),
            detail: format!(
                "it has {} cameras, and none for {:?}",
                cameras.len(),
                photo.file_name().unwrap_or_default()
            ),
            remedy: "leave the photograph's camera alone in it, or name the photograph as it does",
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera 2 m over the origin's ground that looks down by atan(1/2), in Blender's world.
    const FSPY: &str = r#"{
        "principalPoint": { "x": 0.1, "y": 0.0 },
        "cameraTransform": { "rows": [
            [1, 0, 0, 0],
            [0, 0.4472135955, -0.894427191, -4],
            [0, 0.894427191, 0.4472135955, 2],
            [0, 0, 0, 1] ] },
        "horizontalFieldOfView": 1.0, "imageWidth": 600, "imageHeight": 400
    }"#;

    fn view_of(name: &str, text: &str, size: [u32; 2]) -> Result<View, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        let found = read(
            &path,
            Path::new("photos/b.jpg"),
            size,
            None,
            &CameraOptions::default(),
        );
        found.map_err(|e| e.to_string())
    }

    #[test]
    fn fspy_gives_the_camera_over_the_ground_of_its_origin() {
        // Twice the size of fSpy's picture.
        let view = view_of("room.json", FSPY, [1200, 800]).unwrap();
        assert!(view.position.abs_diff_eq(DVec3::new(0.0, 2.0, 4.0), 1e-9));
        assert_eq!(view.ground_y, 0.0);
        // fSpy's offset is in halves of the longer side.
        let principal = view.principal_px.unwrap();
        assert!(principal.abs_diff_eq(DVec2::new(660.0, 400.0), 1e-9));
        let camera = view.camera([1200, 800]);
        let seen = camera.project(glam::Vec3::ZERO).unwrap();
        // Ten digits of the file and single precision.
        assert!(
            seen.distance(glam::Vec2::new(660.0, 400.0)) < 1e-2,
            "{seen}"
        );
        let focal = 600.0 / 0.5f32.tan();
        assert!((camera.focal_px.x - focal).abs() < 1e-2);
    }

    #[test]
    fn the_frame_of_the_photograph_is_taken() {
        let frame = |name: &str, z: f64| {
            format!(
                r#"{{ "file_path": "{name}", "transform_matrix":
                [[1,0,0,0],[0,0,-1,0],[0,1,0,{z}],[0,0,0,1]] }}"#
            )
        };
        let file = |names: [&str; 2], k1: f64| {
            let frames = [frame(names[0], 1.0), frame(names[1], 3.0)].join(",");
            format!(r#"{{ "fl_x": 500, "w": 600, "h": 400, "k1": {k1}, "frames": [{frames}] }}"#)
        };
        let of = |text: String| view_of("transforms.json", &text, [600, 400]);
        let view = of(file(["images/a.jpg", "images/b.jpg"], 0.0)).unwrap();
        assert!((view.position.y - 3.0).abs() < 1e-9);
        assert!((view.ground_y - 1.4).abs() < 1e-9 && view.principal_px.is_none());
        let error = of(file(["c.jpg", "d.jpg"], 0.0)).unwrap_err();
        assert!(
            error.contains("it has 2 cameras, and none for \"b.jpg\""),
            "{error}"
        );
        let error = of(file(["a.jpg", "b.jpg"], -0.2)).unwrap_err();
        assert!(error.contains("bends straight lines"), "{error}");
    }

    #[test]
    fn other_shapes_and_kinds_of_file_are_refused() {
        let error = view_of("room.json", FSPY, [800, 1200]).unwrap_err();
        assert!(error.contains("a picture of 600 x 400 pixels"), "{error}");
        let error = view_of("room.fbx", FSPY, [600, 400]).unwrap_err();
        assert!(
            error.contains("not a kind of file that is known"),
            "{error}"
        );
    }

    #[test]
    fn a_chan_of_one_frame_stands_as_it_says() {
        let view = view_of("shot.chan", "1 0.5 1.7 4 -10 0 0 40\n", [600, 400]).unwrap();
        assert!((view.fov_deg - 40.0).abs() < 1e-9 && view.ground_y == 0.0);
        let Aim::At { look_at, .. } = view.aim else {
            panic!("a point");
        };
        let drop = 5.0 * 10f64.to_radians().sin();
        assert!((look_at.y - (1.7 - drop)).abs() < 1e-9);
    }
}
