//! Cameras of glTF files that move.
mod files;
mod wrong;

use std::path::{Path, PathBuf};

use dipir_cameras::file::{self, Found, Wanted, Which};
use dipir_cameras::neighbours::neighbours;
use dipir_cameras::{Pose, gltf};
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde_json::json;

use crate::files::{Scene, glb, numbered};

/// The camera that is wanted of a file.
fn read(path: &Path, which: Which) -> Result<Found, String> {
    let wanted = Wanted {
        size: [640.0, 480.0],
        which,
        up: None,
        fov_deg: None,
        turns: None,
    };
    file::read(path, &wanted).map_err(|e| e.to_string())
}

/// The x of the camera that is wanted of a GLB.
fn x(bytes: &[u8], which: Which) -> Result<f64, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("shot.glb");
    std::fs::write(&path, bytes).unwrap();
    Ok(read(&path, which)?.pose.unwrap().position.x)
}

/// Of the plate with this number.
fn plate(bytes: &[u8], number: u32) -> Result<f64, String> {
    let name = format!("plate.{number}.png");
    x(bytes, Which::Photo(Path::new(&name)))
}

const FIRST: u32 = 1001;
/// Angles of the rig in each frame, about y, x and z, radians.
fn angles(frame: u32) -> [f64; 3] {
    let t = f64::from(frame - FIRST);
    [0.3 - 0.25 * t, -0.2 + 0.03 * t, 0.02 * t]
}

/// Where a tracked camera stands in twelve frames.
fn rig() -> Vec<(u32, Pose)> {
    let pose = |frame: u32| {
        let [turn, tilt, roll] = angles(frame);
        let rotation = DMat3::from_rotation_y(turn)
            * DMat3::from_rotation_x(tilt)
            * DMat3::from_rotation_z(roll);
        let position = rotation * DVec3::new(0.1, 0.3, 5.0 + 0.1 * f64::from(frame - FIRST));
        Pose { position, rotation }
    };
    (FIRST..FIRST + 12)
        .map(|frame| (frame, pose(frame)))
        .collect()
}

/// The rig as Blender writes it: below a node that moves and is scaled, and that below one with a matrix.
fn exported() -> Scene {
    let root =
        DMat4::from_rotation_translation(DQuat::from_rotation_z(0.4), DVec3::new(1.0, -2.0, 3.0));
    let (mut times, mut keys) = (Vec::new(), [const { Vec::<f32>::new() }; 4]);
    for (frame, pose) in rig() {
        let t = f64::from(frame - FIRST);
        let (turn, place) = (DQuat::from_rotation_x(0.1 * t), DVec3::new(t, 0.5 * t, -t));
        let dolly = DMat4::from_scale_rotation_translation(DVec3::splat(2.0), turn, place);
        let world = DMat4::from_translation(pose.position) * DMat4::from_mat3(pose.rotation);
        let (_, rotation, translation) =
            ((root * dolly).inverse() * world).to_scale_rotation_translation();
        times.push((f64::from(frame) / 24.0) as f32);
        // Half of the quaternions have the other sign.
        let rotation = if frame % 2 == 0 { -rotation } else { rotation };
        for (keys, values) in keys.iter_mut().zip([
            &place.to_array()[..],
            &turn.to_array(),
            &translation.to_array(),
            &rotation.to_array(),
        ]) {
            keys.extend(values.iter().map(|v| *v as f32));
        }
    }
    let mut scene = Scene::of(vec![
        json!({ "matrix": root.to_cols_array(), "children": [1] }),
        json!({ "name": "dolly", "scale": [2, 2, 2], "children": [2] }),
        json!({ "name": "Camera", "camera": 0, "scale": [0.5, 0.5, 0.5] }),
    ]);
    let targets = [
        (1, "translation"),
        (1, "rotation"),
        (2, "translation"),
        (2, "rotation"),
    ];
    for ((node, path), keys) in targets.into_iter().zip(keys) {
        scene.keys(
            json!({ "node": node, "path": path }),
            &times,
            &keys,
            "LINEAR",
        );
    }
    scene
}

#[test]
fn an_exported_rig_stands_as_in_chan_and_transforms_json() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let put = |name: &str, bytes: &[u8]| std::fs::write(at(name), bytes).unwrap();
    let scene = exported();
    put("shot.glb", &scene.glb());
    put(
        "shot.gltf",
        scene
            .document(Some("keys/my%20keys.bin"))
            .to_string()
            .as_bytes(),
    );
    std::fs::create_dir(at("keys")).unwrap();
    put("keys/my keys.bin", scene.buffer());
    use base64::Engine;
    let text = base64::engine::general_purpose::STANDARD.encode(scene.buffer());
    let uri = format!("data:application/octet-stream;base64,{text}");
    put(
        "one.gltf",
        scene.document(Some(&uri)).to_string().as_bytes(),
    );
    let (mut chan, mut frames) = (String::new(), Vec::new());
    for (
        frame,
        Pose {
            position: p,
            rotation,
        },
    ) in rig()
    {
        let [y, x, z] = angles(frame).map(f64::to_degrees);
        chan += &format!("{frame} {} {} {} {x} {y} {z} 45.8\n", p.x, p.y, p.z);
        let row = |i: usize| rotation.row(i).extend(p[i]).to_array();
        let rows = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        frames.push(json!({ "file_path": format!("plate.{frame}.png"), "transform_matrix": rows }));
    }
    put("shot.chan", chan.as_bytes());
    let transforms = json!({ "camera_angle_y": 0.8, "w": 640, "h": 480, "frames": frames });
    put("transforms.json", transforms.to_string().as_bytes());
    for (frame, want) in rig() {
        let plate = format!("plate.{frame}.png");
        for name in [
            "shot.glb",
            "shot.gltf",
            "one.gltf",
            "shot.chan",
            "transforms.json",
        ] {
            let wanted = Wanted {
                size: [640.0, 480.0],
                which: Which::Photo(Path::new(&plate)),
                up: (name == "transforms.json").then_some(dipir_cameras::WorldUp::Y),
                fov_deg: None,
                turns: None,
            };
            let found = file::read(&at(name), &wanted).unwrap();
            let got = found.pose.unwrap();
            assert!(
                got.position.abs_diff_eq(want.position, 1e-4),
                "{name} {frame}: {got:?}"
            );
            assert!(
                got.rotation.abs_diff_eq(want.rotation, 1e-4),
                "{name} {frame}: {got:?}"
            );
            let beside = neighbours(&at(name), &wanted).unwrap();
            for (found, side) in beside.into_iter().zip([-1, 1]) {
                let other = rig()
                    .into_iter()
                    .find(|(n, _)| i64::from(*n) == i64::from(frame) + side);
                assert_eq!(found.map(|f| f.frames), other.map(|_| side), "{name}");
                let (Some(found), Some((_, want))) = (found, other) else {
                    continue;
                };
                let is_there = found.pose.position.abs_diff_eq(want.position, 1e-4)
                    && found.pose.rotation.abs_diff_eq(want.rotation, 1e-4);
                assert!(is_there, "{name} {frame}: {found:?}");
            }
        }
    }
    let beside = [at("shot.gltf"), at("keys/my keys.bin")];
    assert_eq!(file::parts(&at("shot.gltf")), beside);
    assert_eq!(file::parts(&at("one.gltf")), [at("one.gltf")]);
    std::fs::remove_file(at("keys/my keys.bin")).unwrap();
    let error = read(&at("shot.gltf"), Which::Number(FIRST)).unwrap_err();
    assert!(error.contains("my keys.bin"), "{error}");
}

#[test]
fn pictures_have_the_frames_of_their_numbers_or_both_begin_together() {
    for (first, keys, pictures, picture, want, told) in [
        // Counted alike: keys for more or fewer frames than there are pictures.
        (1001, 20, 1001..=1020, 1007, 1007.0, None),
        (1, 30, 10..=20, 10, 10.0, None),
        (0, 21, 1..=20, 20, 20.0, None),
        (
            5,
            10,
            1..=14,
            3,
            5.0,
            Some("frames' numbers; pictures beyond its frames have"),
        ),
        // Counted from the first picture.
        (
            0,
            20,
            1..=20,
            1,
            0.0,
            Some("picture 1 is taken to be frame 0; if it is not, write"),
        ),
        (
            0,
            20,
            1..=20,
            20,
            19.0,
            Some("picture 1 is taken to be frame 0"),
        ),
        (
            1,
            20,
            1001..=1020,
            1005,
            5.0,
            Some("picture 1001 is taken to be frame 1"),
        ),
        (
            1,
            20,
            1001..=1030,
            1029,
            20.0,
            Some("picture 1001 is taken to be frame 1"),
        ),
        (
            86400,
            3,
            1..=3,
            2,
            86401.0,
            Some("the pictures have the numbers 1 to 3"),
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for n in pictures.clone() {
            std::fs::write(at(&format!("plate.{n}.png")), "").unwrap();
        }
        // Of no such name.
        for other in ["plate.7777.jpg", "mask.8888.png", "readme"] {
            std::fs::write(at(other), "").unwrap();
        }
        let path = at("shot.glb");
        std::fs::write(&path, numbered(first, keys, 24.0).glb()).unwrap();
        let photo = at(&format!("plate.{picture}.png"));
        let found = read(&path, Which::Photo(&photo)).unwrap();
        let case = format!("{first} {keys} {pictures:?} {picture}");
        assert_eq!(found.pose.unwrap().position.x, want, "{case}");
        let shown = file::shown(&path, None, &photo).unwrap().unwrap();
        assert_eq!(shown.is_doubtful, told.is_some(), "{case}: {shown:?}");
        assert!(shown.assumed.contains(told.unwrap_or("")), "{shown:?}");
        let last = first + keys - 1;
        let frames = format!("the camera moves, with frames {first} to {last} at 24 a second");
        assert!(shown.assumed.starts_with(&frames), "{shown:?}");
    }
    let error = x(
        &numbered(1, 5, 24.0).glb(),
        Which::Photo(Path::new("still.png")),
    )
    .unwrap_err();
    let want =
        "with frames 1 to 5 at 24 a second, and \"still.png\" does not end in the number of one";
    assert!(error.contains(want), "{error}");
}

#[test]
fn the_rate_is_that_of_the_keys() {
    for rate in [
        5.0,
        12.0,
        24.0,
        24.0 / 1.001,
        24.0 * 1.001,
        25.0,
        59.94,
        60.0,
        240.0,
        37.3,
    ] {
        for first in [0, 1, 1001] {
            let bytes = numbered(first, 40, rate).glb();
            assert_eq!(
                plate(&bytes, first + 17),
                Ok(f64::from(first) + 17.0),
                "{rate}"
            );
        }
    }
    // Keys that stay are met where they are, not before.
    let mut document = numbered(1, 50, 30.0).document(None);
    document["animations"][0]["samplers"][0]["interpolation"] = json!("STEP");
    let steps = glb(&document, numbered(1, 50, 30.0).buffer());
    for n in 1..=50 {
        assert_eq!(plate(&steps, n), Ok(f64::from(n)));
    }
    let of = |frames: &[f32]| {
        let mut scene = numbered(1, 1, 24.0);
        let times: Vec<f32> = frames.iter().map(|k| k / 24.0).collect();
        let values: Vec<f32> = frames.iter().flat_map(|k| [*k, 0.0, 0.0]).collect();
        let target = json!({ "node": 0, "path": "scale" });
        scene.keys(
            target,
            &times,
            &values.iter().map(|v| 1.0 + v).collect::<Vec<_>>(),
            "LINEAR",
        );
        plate(&scene.glb(), 2).map(|_| ())
    };
    // Uniform scale is none of x alone: the frames themselves are right.
    for (frames, want) in [
        (&[1.0, 100.0][..], "its keys are 4.125 s apart"),
        (
            &[1.0, 3.0, 5.0, 7.0],
            "keys are 0.083 s apart, but the one at",
        ),
        (&[1.0, 2.0, 3.5, 4.5], "but the one at"),
        (&[0.0, 1.0, 10.0, 20.0, 30.0], "most frames have no key"),
        (&[0.0, 0.01, 0.02], "s apart"),
    ] {
        let error = of(frames).unwrap_err();
        assert!(
            error.contains("the frames of its camera cannot be told: "),
            "{error}"
        );
        assert!(error.contains(want), "{error}");
        assert!(
            error.contains("export it with a key for each frame"),
            "{error}"
        );
    }
}

#[test]
fn of_several_cameras_one_is_named_and_its_frame_with_it() {
    let mut scene = numbered(1, 10, 24.0);
    scene
        .nodes
        .push(json!({ "name": "other", "camera": 0, "children": [2] }));
    scene
        .nodes
        .push(json!({ "name": "still", "camera": 0, "translation": [7, 0, 0] }));
    let times = [1.0 / 24.0, 2.0 / 24.0];
    let target = json!({ "node": 1, "path": "translation" });
    // What does not change moves no camera, but it says where it stands.
    scene.keys(target, &times, &[3.0, 0.0, 0.0, 3.0, 0.0, 0.0], "LINEAR");
    let bytes = scene.glb();
    let of = |which| x(&bytes, which);
    assert_eq!(of(Which::Frame("Camera", 4)), Ok(4.0));
    assert_eq!(of(Which::Frame("Camera", 0)), Ok(1.0));
    assert_eq!(of(Which::Frame("Camera", 99)), Ok(10.0));
    assert_eq!(of(Which::Name("other")), Ok(3.0));
    assert_eq!(of(Which::Number(1)), Ok(3.0));
    assert_eq!(of(Which::Name("still")), Ok(10.0));
    assert_eq!(of(Which::Photo(Path::new("still.png"))), Ok(10.0));
    for (which, want) in [
        (
            Which::Name("Camera"),
            "for instance image = \"Camera\" with frame = 1",
        ),
        (
            Which::Number(0),
            "the camera moves, with frames 1 to 10 at 24 a second; say which",
        ),
        (
            Which::Frame("still", 3),
            "its camera \"still\" stands still, and has no frame 3",
        ),
        (
            Which::Photo(Path::new("plate.0003.png")),
            "it has 3 cameras, and none for",
        ),
    ] {
        let error = of(which).unwrap_err();
        assert!(error.contains(want), "{error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("shot.glb");
    std::fs::write(&path, &bytes).unwrap();
    let shown = |name| file::shown(&path, Some(name), Path::new("plate.0003.png")).unwrap();
    assert_eq!(shown("Camera").unwrap().frame, 3);
    assert_eq!(shown("still"), None);
}

#[test]
fn photos_of_several_folders_and_cameras_are_told_together_as_alone() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut scene = numbered(1, 10, 24.0);
    scene.nodes = ["plate.1", "plate.101"]
        .map(|name| json!({ "name": name, "camera": 0 }))
        .into();
    let times: Vec<f32> = (5..8).map(|frame| frame as f32 / 24.0).collect();
    let target = json!({ "node": 1, "path": "translation" });
    scene.keys(
        target,
        &times,
        &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0],
        "LINEAR",
    );
    let path = at("shot.glb");
    std::fs::write(&path, scene.glb()).unwrap();
    let mut photos = Vec::new();
    for (name, numbers) in [
        ("a/plate.", 1..=12),
        ("b/plate.", 101..=104),
        ("a/mask.", 41..=42),
    ] {
        std::fs::create_dir_all(at(name).parent().unwrap()).unwrap();
        let own = numbers.map(|n| at(&format!("{name}{n}.png")));
        photos.extend(own.inspect(|photo| std::fs::write(photo, "").unwrap()));
    }
    let frames = |name, photos: &[PathBuf]| -> Vec<u32> {
        let all = file::all_shown(&path, name, photos).unwrap();
        for (photo, shown) in photos.iter().zip(&all) {
            assert_eq!(*shown, file::shown(&path, name, photo).unwrap());
        }
        all.into_iter().map(|shown| shown.unwrap().frame).collect()
    };
    let plates = 1..=12;
    let first: Vec<u32> = plates.clone().chain(1..=4).chain([1, 2]).collect();
    assert_eq!(frames(Some("plate.1"), &photos), first);
    let other: Vec<u32> = plates.chain(5..=8).chain([5, 6]).collect();
    assert_eq!(frames(Some("plate.101"), &photos), other);
    // Without a name each has the camera of its own.
    assert_eq!(
        frames(None, &[photos[0].clone(), photos[12].clone()]),
        [1, 5]
    );
}

#[test]
fn a_camera_that_stands_still_is_one_and_one_that_moves_is_many() {
    let folder = tempfile::tempdir().unwrap();
    let has_one = |scene: &Scene| {
        let path = folder.path().join("shot.glb");
        std::fs::write(&path, scene.glb()).unwrap();
        file::has_one(&path)
    };
    let at_rest = || Scene::of(numbered(1, 1, 24.0).nodes);
    let mut constant = at_rest();
    let target = json!({ "node": 0, "path": "translation" });
    constant.keys(
        target,
        &[0.0, 4.0],
        &[2.0, 0.0, 0.0, 2.0, 0.0, 0.0],
        "LINEAR",
    );
    assert!(has_one(&at_rest()) && has_one(&constant));
    assert_eq!(plate(&constant.glb(), 3), Ok(2.0));
    assert_eq!(
        x(&constant.glb(), Which::Photo(Path::new("any.png"))),
        Ok(2.0)
    );
    assert!(!has_one(&numbered(1, 2, 24.0)));
    // Of one camera a number is that of a frame.
    assert_eq!(x(&numbered(1, 9, 24.0).glb(), Which::Number(5)), Ok(5.0));
    let error = x(&constant.glb(), Which::Number(5)).unwrap_err();
    assert!(
        error.contains("it has one camera, and no camera 5"),
        "{error}"
    );
    // Without animation, as ever.
    assert_eq!(
        gltf::read(&numbered(1, 9, 24.0).glb(), [6.0, 4.0]).unwrap()[0]
            .1
            .pose
            .position
            .x,
        -9.0
    );
}
