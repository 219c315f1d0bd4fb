//! The camera of a photograph out of another program's file.
use std::path::Path;

use dipir_cameras::chan::Turns;
use dipir_cameras::file::{self, Wanted, Which};
use dipir_cameras::{CameraError, Lens, Pose, orientation};
use dipir_imaging::facts::Facts;
use dipir_scene::plausibility::{field_of_view, rounded};
use glam::{DVec2, DVec3};

use crate::error::SetupError;
use crate::project::Request;
use crate::view::{Aim, CameraFile, CameraOptions, EYE_HEIGHT_M, View};

/// Most that a lens bends a corner, and that pixels differ from squares at a corner, pixels.
const MOST_BENT_PX: f64 = 1.0;
/// Least shift of the optical axis that is written down, pixels.
const LEAST_SHIFT_PX: f64 = 0.5;
/// Least change of an axis of the camera that the order of its rotations makes: half a pixel at a focal length of 5,000.
const LEAST_TURN: f64 = 1e-4;

/// The camera that the file or folder at `path` has for the photograph of `request`, of which `facts` are known, what of it
/// may be wrong, one sentence each, and whether another axis of its world seems to point up.
///
/// # Errors
/// On files that cannot be read, without a camera for the photograph, and of pictures of another
/// shape.
pub fn read(
    path: &Path,
    request: &Request,
    facts: &Facts,
) -> Result<(View, Vec<String>, Option<String>), SetupError> {
    let (photo, asked, up) = (&*request.photo, &request.asked, request.camera_up);
    asked.check()?;
    let size = facts.size.map(f64::from);
    let is_chan = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("chan"));
    let fov_is_known = |fov_deg: f64| SetupError::Value {
        option: "--fov",
        value: fov_deg.to_string(),
        accepted: "left out, for the camera's file says it",
    };
    if let Some(fov_deg) = asked.fov_deg.filter(|_| !is_chan) {
        return Err(fov_is_known(fov_deg));
    }
    // A field of view along the longer side is vertical in an upright picture only.
    let longer = size[0].max(size[1]);
    let vertical = |deg: f64| {
        let half = (0.5 * deg.to_radians()).tan() * size[1] / longer;
        2.0 * half.atan().to_degrees()
    };
    // As `dipir run` looks for it: folders tell pictures of the same name apart.
    let whole = std::path::absolute(photo);
    let wanted = Wanted {
        size,
        which: match (request.camera_image.as_deref(), request.camera_frame) {
            (None, None) => Which::Photo(whole.as_deref().unwrap_or(photo)),
            (Some(name), None) => Which::Name(name),
            (None, Some(frame)) => Which::Number(frame),
            (Some(name), Some(frame)) if file::is_gltf(path) => Which::Frame(name, frame),
            (Some(_), Some(frame)) => {
                return Err(SetupError::Value {
                    option: "--camera-frame",
                    value: frame.to_string(),
                    accepted: "left out, for --camera-image says which camera; only of glTF both do",
                });
            }
        },
        up,
        fov_deg: asked.fov_deg.map(vertical),
        turns: None,
    };
    let found = orientation::read_turned(path, &wanted, facts.orientation);
    let (found, quarters) = found.map_err(|source| match source {
        CameraError::Read { path, source } => SetupError::Read { path, source },
        source => SetupError::CameraFile {
            path: path.into(),
            source,
        },
    })?;
    if let Some(fov_deg) = asked.fov_deg.filter(|_| found.states_fov) {
        return Err(fov_is_known(fov_deg));
    }
    let pose = found.pose.ok_or_else(|| SetupError::Camera {
        path: path.into(),
        detail: "it describes a lens alone".into(),
        remedy: "leave --camera out, and write file = \"…\" into [scene.camera] beside position and direction",
    })?;
    let mut view = view(
        &pose,
        &found.lens,
        found.ground_at_origin,
        found.program,
        path,
        asked,
    );
    let is_ambiguous = is_chan && depends_on_order(path, &wanted, &pose);
    let order = "it does not say in which order its rotations turn, and Nuke's is taken";
    let why = more_than_numbers(path, &found.lens, wanted.which).or(is_ambiguous.then_some(order));
    view.file = why.map(|why| CameraFile {
        path: path.into(),
        up,
        fov_deg: (!found.states_fov).then_some(view.fov_deg),
        image: request.camera_image.clone(),
        frame: request.camera_frame,
        why,
    });
    let mut warnings: Vec<String> = orientation::doubt_of_turn(path, size, facts.orientation)
        .into_iter()
        .collect();
    if is_ambiguous {
        warnings.push(format!(
            "\"{}\": {order}: if it is Blender's, write file_rotation_order = \"xyz\" into [scene.camera]",
            path.display()
        ));
    }
    let is_fisheye = found.lens.distortion.is_fisheye();
    warnings.extend(
        (!is_fisheye)
            .then(|| field_of_view(view.fov_deg, Some(path)))
            .flatten(),
    );
    warnings.extend(rounded(pose.position).map(|what| format!("\"{}\": {what}", path.display())));
    let up = up.is_none().then(|| file::doubt(path, quarters)).flatten();
    Ok((view, warnings, up))
}

/// Whether a `.chan` file has another camera if its rotations turn as in Blender's default.
fn depends_on_order(path: &Path, wanted: &Wanted, pose: &Pose) -> bool {
    let blender = Wanted {
        turns: Turns::parse("xyz"),
        ..*wanted
    };
    let other = file::read(path, &blender).ok().and_then(|found| found.pose);
    other.is_some_and(|other| !other.rotation.abs_diff_eq(pose.rotation, LEAST_TURN))
}

/// What the file at `path` says that the numbers of a view do not, in words; `lens` is the photograph's.
fn more_than_numbers(path: &Path, lens: &Lens, which: Which) -> Option<&'static str> {
    if !file::has_one(path) {
        return Some(match which {
            Which::Photo(_) => {
                "it has several cameras, of which that of the photograph's name is taken"
            }
            _ => "it has several cameras, or one that moves",
        });
    }
    let focal = lens.focal_px;
    let oblong = (focal.x / focal.y - 1.0).abs() * 0.5 * lens.size[0];
    let is_more = bent_px(lens) > MOST_BENT_PX || oblong > MOST_BENT_PX;
    is_more.then_some("its lens bends lines or its pixels are not square")
}

fn view(
    pose: &Pose,
    lens: &Lens,
    ground_at_origin: bool,
    program: &str,
    path: &Path,
    asked: &CameraOptions,
) -> View {
    let size = DVec2::from_array(lens.size);
    let shift = lens.principal_px - 0.5 * size;
    let (ground_y, position_why) = match (asked.eye_height_m, ground_at_origin) {
        (None, true) if pose.position.y > 0.01 => {
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
        file: None,
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
        image.map_or(f64::INFINITY, |at| {
            ((at - straight) * lens.focal_px).length()
        })
    });
    bent.into_iter().fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use dipir_cameras::WorldUp;
    use dipir_imaging::raster::{DisplayImage, Raster};
    use dipir_pipeline::config::Config;
    use dipir_scene::camera::Camera;
    use dipir_scene::config::SceneConfig;

    use super::*;
    use crate::project::draft;

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
        told_of(name, text, size).map(|told| told.0)
    }

    /// The view and the warnings.
    fn told_of(name: &str, text: &str, size: [u32; 2]) -> Result<(View, Vec<String>), String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        let request = Request {
            photo: "photos/b.jpg".into(),
            ..Request::default()
        };
        let found = read(&path, &request, &Facts::of_size(size)).map_err(|e| e.to_string())?;
        Ok((found.0, found.1))
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
        assert!(view.file.unwrap().why.contains("several cameras"));
        // A lens with distortion is no pinhole: the configuration names the file for that, too.
        let one = |k1: f64| {
            let frame = frame("b.jpg", 3.0);
            let text = format!(
                r#"{{ "fl_x": 500, "w": 600, "h": 400, "k1": {k1}, "frames": [{frame}] }}"#
            );
            of(text).unwrap().file
        };
        assert_eq!(one(0.0), None);
        let bent = one(-0.2).unwrap();
        assert!(bent.path.ends_with("transforms.json") && bent.why.contains("bends lines"));
    }

    #[test]
    fn other_shapes_and_kinds_of_file_are_refused() {
        let error = view_of("room.json", FSPY, [800, 1200]).unwrap_err();
        assert!(error.contains("a picture of 600 x 400 pixels"), "{error}");
        let error = view_of("room.3dm", FSPY, [600, 400]).unwrap_err();
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

    #[test]
    fn a_file_whose_pictures_are_upright_by_another_axis_is_told_where_no_ground_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let grey = DisplayImage(Raster::filled(30, 20, glam::Vec3::splat(0.5)));
        dipir_imaging::file::write_png(at("b.png"), &grey).unwrap();
        std::fs::write(at("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        // +y up, looking a little down: taken as +z, they look straight down and are upside down.
        let frame = |name: &str| {
            format!(
                r#"{{ "file_path": "{name}", "transform_matrix":
                [[1,0,0,0],[0,0.98,0.199,1.5],[0,-0.199,0.98,0],[0,0,0,1]] }}"#
            )
        };
        let frames = ["a", "b", "c", "d", "e"].map(frame).join(",");
        let text = format!(r#"{{ "fl_x": 25, "frames": [{frames}] }}"#);
        std::fs::write(at("transforms.json"), text).unwrap();
        let of = |camera_up| {
            let request = Request {
                photo: at("b.png"),
                models: vec![at("a.obj")],
                out: at("pipeline.toml"),
                camera: Some(at("transforms.json")),
                camera_up,
                ..Request::default()
            };
            draft(&request).map_err(|e| e.to_string())
        };
        let error = of(None).unwrap_err();
        let want = "are upright if y of its world points up, and z is taken: write file_up = \"y\"";
        assert!(error.contains(want), "{error}");
        let error = of(Some(WorldUp::Z)).unwrap_err();
        assert!(
            error.ends_with("see whether --camera and --camera-up are right"),
            "{error}"
        );
        assert!(of(Some(WorldUp::Y)).unwrap().warnings.is_empty());
    }

    #[test]
    fn a_chan_in_radians_is_told_in_degrees() {
        let (_, told) = told_of("a.chan", "1 0 1.7 4 -10 0 0 0.7\n", [600, 400]).unwrap();
        let want = "if 0.700 was meant in radians, write 40.1";
        assert!(told.len() == 1 && told[0].contains(want), "{told:?}");
    }

    #[test]
    fn a_chan_whose_camera_depends_on_the_order_of_rotations_is_named_and_told() {
        // Tilted and turned: about z first or last, an angle of 0 turns nothing.
        let (view, told) = told_of("a.chan", "1 0 1.7 4 -10 30 0 40\n", [600, 400]).unwrap();
        assert!(view.file.is_none() && told.is_empty(), "{told:?}");
        let rolled = "1 0 1.7 4 -10 30 5 40\n";
        let (view, told) = told_of("a.chan", rolled, [600, 400]).unwrap();
        assert!(
            view.file
                .unwrap()
                .why
                .contains("in which order its rotations turn")
        );
        let want = "if it is Blender's, write file_rotation_order = \"xyz\" into [scene.camera]";
        assert!(told.len() == 1 && told[0].contains(want), "{told:?}");
        let (text, got, want) = written("shot.chan", rolled, Request::default());
        for line in ["file = \"shot.chan\"", "# file_rotation_order = \"xyz\""] {
            assert!(text.contains(line), "{text}");
        }
        // Digits of the file, and single precision.
        let apart = (got.rotation - want.rotation).to_cols_array();
        assert!(apart.iter().all(|e| e.abs() < 1e-5));
    }

    #[test]
    fn a_camera_where_the_scene_rounds_positions_is_told() {
        let at = |x: f64| {
            let text = format!("1 {x} 1.7 4 -10 0 0 40\n");
            told_of("a.chan", &text, [600, 400]).unwrap().1
        };
        assert!(at(-8000.0).is_empty());
        let told = at(-5_428_000.0);
        let want =
            "stands 5428 km from the origin of its world, where lengths are rounded to 500 mm";
        assert!(told.len() == 1 && told[0].contains(want), "{told:?}");
    }

    /// What `dipir init` writes for `in/plate.0002.png` of 30 x 20 pixels and a camera's file with this name in the
    /// same folder, and the camera that `dipir run` has for it.
    fn written(name: &str, text: &str, request: Request) -> (String, Camera, Camera) {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let at = |name: &str| folder.join(name);
        std::fs::create_dir(at("in")).unwrap();
        let grey = DisplayImage(Raster::filled(30, 20, glam::Vec3::splat(0.5)));
        dipir_imaging::file::write_png(at("in/plate.0002.png"), &grey).unwrap();
        std::fs::write(at("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        std::fs::write(at(name), text).unwrap();
        let draft = draft(&Request {
            photo: at("in/plate.0002.png"),
            models: vec![at("a.obj")],
            out: at("pipeline.toml"),
            camera: Some(at(name)),
            ..request
        });
        let document = draft.unwrap().document;
        let text = document.text();
        let config = Config::parse(&at("pipeline.toml"), &text, &[]).unwrap();
        let settings = config.table::<SceneConfig>("scene").unwrap().validate();
        let (camera, _) = settings.unwrap().camera.resolve([30, 20], folder).unwrap();
        (text, camera, document.view.camera([30, 20]))
    }

    #[test]
    fn a_file_of_several_cameras_is_named_and_means_the_same_camera() {
        let frame = |name: &str, z: f64| {
            format!(
                r#"{{ "file_path": "{name}", "transform_matrix":
                [[1,0,0,0],[0,1,0,{z}],[0,0,1,3],[0,0,0,1]] }}"#
            )
        };
        let frames = [
            frame("on/plate.0002.png", 1.0),
            frame("in/plate.0002.png", 2.0),
        ]
        .join(",");
        let transforms = format!(r#"{{ "fl_x": 25, "frames": [{frames}] }}"#);
        let y_up = Request {
            camera_up: Some(WorldUp::Y),
            ..Request::default()
        };
        let wide = Request {
            asked: CameraOptions {
                fov_deg: Some(50.0),
                ..CameraOptions::default()
            },
            ..Request::default()
        };
        let chan = "1 0 1.5 4 -10 0 0\n2 0 1.7 4 -10 0 0\n";
        for (name, text, request, keys) in [
            (
                "transforms.json",
                &*transforms,
                y_up,
                "file = \"transforms.json\"\nfile_up = \"y\"\n",
            ),
            (
                "shot.chan",
                chan,
                wide,
                "file = \"shot.chan\"\nfov_deg = 34.5",
            ),
        ] {
            let (text, got, want) = written(name, text, request);
            assert!(
                text.contains(keys) && text.contains("several cameras"),
                "{text}"
            );
            let tells_of_turns = text.contains("# file_rotation_order = \"xyz\"");
            assert_eq!(tells_of_turns, name == "shot.chan", "{text}");
            // Digits of the file, and single precision.
            assert!(got.position.distance(want.position) < 1e-5, "{name}");
            let apart = (got.rotation - want.rotation).to_cols_array();
            assert!(apart.iter().all(|e| e.abs() < 1e-5), "{name}");
            assert!((got.focal_px / want.focal_px - 1.0).abs().max_element() < 1e-5);
            assert_eq!(got.principal_px, want.principal_px);
        }
    }

    #[test]
    fn a_camera_that_the_photograph_does_not_name_is_asked_for_and_written() {
        let frame = |name: &str, z: f64| {
            format!(
                r#"{{ "file_path": "{name}", "transform_matrix":
                [[1,0,0,0],[0,1,0,{z}],[0,0,1,3],[0,0,0,1]] }}"#
            )
        };
        let frames = [frame("left.png", 1.0), frame("right.png", 2.0)].join(",");
        let transforms = format!(r#"{{ "fl_x": 25, "frames": [{frames}] }}"#);
        let asked = |image: Option<&str>, frame| Request {
            camera_image: image.map(Into::into),
            camera_frame: frame,
            camera_up: Some(WorldUp::Y),
            ..Request::default()
        };
        for (request, key) in [
            (asked(Some("right.png"), None), "image = \"right.png\"\n"),
            (asked(None, Some(1)), "frame = 1\n"),
        ] {
            let (text, got, want) = written("transforms.json", &transforms, request);
            let keys = format!("file = \"transforms.json\"\n{key}file_up = \"y\"\n");
            assert!(text.contains(&keys), "{text}");
            assert!((want.position.y - 2.0).abs() < 1e-6, "{}", want.position);
            assert!(got.position.distance(want.position) < 1e-5, "{key}");
        }
        let both = asked(Some("right.png"), Some(1));
        let error = read(Path::new("t.json"), &both, &Facts::of_size([30, 20])).unwrap_err();
        let error = error.to_string();
        assert!(
            error.starts_with("--camera-frame is 1; accepted: left out"),
            "{error}"
        );
    }

    #[test]
    fn a_field_of_view_that_the_file_has_is_not_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("shot.chan");
        let request = Request {
            asked: CameraOptions {
                fov_deg: Some(50.0),
                ..CameraOptions::default()
            },
            ..Request::default()
        };
        let of = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read(&path, &request, &Facts::of_size([600, 400])).map_err(|e| e.to_string())
        };
        assert!(of("1 0 1.7 4 0 0 0").is_ok());
        let error = of("1 0 1.7 4 0 0 0 40").unwrap_err();
        assert!(
            error.starts_with("--fov is 50; accepted: left out"),
            "{error}"
        );
    }
}
