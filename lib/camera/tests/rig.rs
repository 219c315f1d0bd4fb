//! One rig of cameras, written in every format, and what is read back.
use std::path::Path;

use dipir_cameras::file::{self, Which};
use dipir_cameras::{
    Camera, CameraError, Distortion, Lens, Pose, WorldUp, chan, colmap, fspy, gltf, kitti,
    nuscenes, opencv, transforms,
};
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use proptest::prelude::*;
use serde_json::json;

const SIZE: [f64; 2] = [640.0, 480.0];

/// Three places around an object, looked at from above, without distortion.
fn rig() -> Vec<Camera> {
    [(0.3, -0.2, 0.0), (-1.1, -0.4, 0.1), (2.5, 0.1, -0.2)]
        .map(|(turn, tilt, roll)| {
            let rotation = DMat3::from_rotation_y(turn)
                * DMat3::from_rotation_x(tilt)
                * DMat3::from_rotation_z(roll);
            Camera {
                pose: Pose {
                    position: rotation * DVec3::new(0.1, 0.3, 5.0),
                    rotation,
                },
                lens: Lens::pinhole(SIZE, DVec2::splat(520.0)),
            }
        })
        .to_vec()
}

/// Where the cameras see points about the origin differs by less than 1e-4 of a pixel.
fn agree(got: &Camera, want: &Camera, what: &str) {
    assert!(
        (got.pose.position - want.pose.position).length() < 1e-4,
        "{what}"
    );
    for i in 0..27 {
        let corner = [i % 3, i / 3 % 3, i / 9].map(|v| 0.5 * f64::from(v) - 0.5);
        let point = DVec3::from_array(corner);
        let pixel = |camera: &Camera| camera.project(point).expect("in view");
        let apart = pixel(got) - pixel(want);
        assert!(apart.length() < 1e-4, "{what}: {apart}");
    }
}

/// Rows of the matrix of camera to a world with +z up.
fn z_up_rows(camera: &Camera) -> Vec<Vec<f64>> {
    let to_z_up = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
    let rotation = to_z_up * camera.pose.rotation;
    let matrix = DMat4::from_mat3(rotation);
    let matrix = DMat4::from_translation(to_z_up * camera.pose.position) * matrix;
    let rows = matrix.transpose().to_cols_array_2d();
    rows.map(|row| row.to_vec()).to_vec()
}

/// Quaternion (w x y z) and translation of a world with +z up to the camera in image axes.
fn world_to_image(camera: &Camera) -> ([f64; 4], DVec3) {
    let to_z_up = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let rotation = flip * (to_z_up * camera.pose.rotation).transpose();
    let translation = -(rotation * (to_z_up * camera.pose.position));
    let q = DQuat::from_mat3(&rotation);
    ([q.w, q.x, q.y, q.z], translation)
}

fn transforms_json(rig: &[Camera]) -> String {
    let frames: Vec<_> = rig
        .iter()
        .enumerate()
        .map(|(i, c)| json!({"file_path": format!("{i}.jpg"), "transform_matrix": z_up_rows(c)}))
        .collect();
    json!({"fl_x": 520.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "frames": frames})
        .to_string()
}

fn fspy_state(camera: &Camera, distance: f64, unit: &str) -> String {
    let mut rows = z_up_rows(camera);
    rows.iter_mut().for_each(|row| row[3] /= distance);
    rows[3] = vec![0.0, 0.0, 0.0, 1.0];
    json!({
        "globalSettings": {}, "calibrationSettingsBase": {"referenceDistanceUnit": unit},
        "cameraParameters": {
            "principalPoint": {"x": 0.0, "y": 0.0}, "cameraTransform": {"rows": rows},
            "horizontalFieldOfView": 2.0 * (320.0f64 / 520.0).atan(),
            "imageWidth": 640, "imageHeight": 480
        }
    })
    .to_string()
}

fn fspy_project(state: &str) -> Vec<u8> {
    let mut file = b"fspy".to_vec();
    for word in [1, state.len() as u32, 3] {
        file.extend(word.to_le_bytes());
    }
    file.extend(state.as_bytes());
    file.extend(b"jpg");
    file
}

const COLMAP_CAMERAS: &str = "# comment\n1 PINHOLE 640 480 520 520 320 240\n";
const COLMAP_POINTS: &str = "# comment\n7 1.0 2.0 3.0 255 0 0 0.5 1 2 3 4\n";

fn colmap_images(rig: &[Camera]) -> String {
    let mut text = "# comment\n".to_string();
    for (i, camera) in rig.iter().enumerate() {
        let (q, t) = world_to_image(camera);
        let numbers = q.iter().chain(t.as_ref()).map(f64::to_string);
        let numbers: Vec<String> = numbers.collect();
        text += &format!("{} {} 1 image {i}.jpg\n", i + 1, numbers.join(" "));
        text += ["\n", "1.0 2.0 -1\n"][i % 2];
    }
    text
}

fn colmap_binary(rig: &[Camera]) -> [Vec<u8>; 3] {
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend([1u32.to_le_bytes(), 1u32.to_le_bytes()].concat());
    cameras.extend([640u64.to_le_bytes(), 480u64.to_le_bytes()].concat());
    cameras.extend(
        [520.0f64, 520.0, 320.0, 240.0]
            .map(f64::to_le_bytes)
            .concat(),
    );
    let mut images = (rig.len() as u64).to_le_bytes().to_vec();
    for (i, camera) in rig.iter().enumerate() {
        let (q, t) = world_to_image(camera);
        images.extend((i as u32).to_le_bytes());
        q.iter()
            .chain(t.as_ref())
            .for_each(|v| images.extend(v.to_le_bytes()));
        images.extend(1u32.to_le_bytes());
        images.extend(format!("image {i}.jpg\0").as_bytes());
        images.extend(1u64.to_le_bytes());
        images.extend([0u8; 24]);
    }
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(7u64.to_le_bytes());
    points.extend([1.0f64, 2.0, 3.0].map(f64::to_le_bytes).concat());
    points.extend([0u8; 11]);
    points.extend(1u64.to_le_bytes());
    points.extend([0u8; 8]);
    [cameras, images, points]
}

fn chan_text(rig: &[Camera]) -> String {
    let fov = 2.0 * (240.0f64 / 520.0).atan().to_degrees();
    let angles = [(0.3, -0.2, 0.0), (-1.1, -0.4, 0.1), (2.5, 0.1, -0.2)];
    let mut text = String::new();
    for (i, (camera, (turn, tilt, roll))) in rig.iter().zip(angles).enumerate() {
        let p = camera.pose.position;
        let [y, x, z] = [turn, tilt, roll].map(f64::to_degrees);
        text += &format!(
            "{}\t{}\t{}\t{}\t{x}\t{y}\t{z}\t{fov}\n",
            i + 1,
            p.x,
            p.y,
            p.z
        );
    }
    text
}

/// A document whose cameras hang below a turned and scaled node, as Blender nests them.
fn gltf_json(rig: &[Camera]) -> String {
    let above = DMat4::from_scale_rotation_translation(
        DVec3::splat(2.0),
        DQuat::from_rotation_y(0.7),
        DVec3::new(1.0, -2.0, 3.0),
    );
    let mut nodes = vec![json!({"matrix": above.to_cols_array(), "children": [1, 2, 3]})];
    for (i, camera) in rig.iter().enumerate() {
        let own =
            DMat4::from_translation(camera.pose.position) * DMat4::from_mat3(camera.pose.rotation);
        let (scale, rotation, translation) =
            (above.inverse() * own).to_scale_rotation_translation();
        nodes.push(json!({
            "name": format!("view {i}"), "camera": 0, "rotation": rotation.to_array(),
            "translation": translation.to_array(), "scale": scale.to_array(),
        }));
    }
    let yfov = 2.0 * (240.0f64 / 520.0).atan();
    let perspective = json!({"yfov": yfov, "aspectRatio": 4.0 / 3.0, "znear": 0.1});
    json!({
        "asset": {"version": "2.0"}, "nodes": nodes,
        "cameras": [{"type": "perspective", "perspective": perspective}],
    })
    .to_string()
}

/// A GLB of the document with a chunk of buffers behind it.
fn glb(json: &str) -> Vec<u8> {
    let words = |words: &[u32]| {
        words
            .iter()
            .flat_map(|w| w.to_le_bytes())
            .collect::<Vec<u8>>()
    };
    let length = json.len() as u32;
    let mut file = [b"glTF", &words(&[2, 12 + 8 + length + 8 + 4, length])[..]].concat();
    file.extend([b"JSON", json.as_bytes(), &words(&[4]), b"BIN\0\0\0\0\0"].concat());
    file
}

fn nuscenes_json(rig: &[Camera]) -> String {
    let mut records = vec![json!({
        "token": "lidar", "translation": [0, 0, 1.8], "rotation": [1, 0, 0, 0],
        "camera_intrinsic": []
    })];
    for (i, camera) in rig.iter().enumerate() {
        let to_z_up = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
        let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let q = DQuat::from_mat3(&(to_z_up * camera.pose.rotation * flip));
        records.push(json!({
            "token": "a camera", "channel": format!("CAM_{i}"), "rotation": [q.w, q.x, q.y, q.z],
            "translation": (to_z_up * camera.pose.position).to_array(),
            "camera_intrinsic": [[520, 0, 319.5], [0, 520, 239.5], [0, 0, 1]],
        }));
    }
    json!(records).to_string()
}

fn wanted(which: Which<'_>) -> file::Wanted<'_> {
    file::Wanted {
        size: SIZE,
        which,
        up: None,
        fov_deg: None,
        turns: None,
    }
}

#[test]
fn one_reader_gives_the_same_camera_from_every_format() {
    let rig = rig();
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    };
    put("sparse/cameras.txt", COLMAP_CAMERAS.as_bytes());
    put("sparse/images.txt", colmap_images(&rig).as_bytes());
    put("transforms.json", transforms_json(&rig).as_bytes());
    put("shot.chan", chan_text(&rig).as_bytes());
    put("scene.gltf", gltf_json(&rig).as_bytes());
    put("scene.glb", &glb(&gltf_json(&rig)));
    put("sensors.json", nuscenes_json(&rig).as_bytes());
    for (i, camera) in rig.iter().enumerate() {
        let n = i as u32;
        for (name, number) in [
            ("sparse", n),
            ("transforms.json", n),
            ("shot.chan", n + 1),
            ("scene.gltf", n),
            ("scene.glb", n),
            ("sensors.json", n),
        ] {
            let asked = file::Wanted {
                up: (name == "sparse").then_some(WorldUp::Z),
                ..wanted(Which::Number(number))
            };
            let found = file::read(&folder.path().join(name), &asked).unwrap();
            let (pose, lens) = (found.pose.unwrap(), found.lens);
            agree(&Camera { pose, lens }, camera, name);
        }
        for (name, of) in [
            ("transforms.json", format!("{i}.jpg")),
            ("scene.glb", format!("view {i}")),
            ("sensors.json", format!("CAM_{i}")),
        ] {
            let path = folder.path().join(name);
            let found = file::read(&path, &wanted(Which::Name(&of))).unwrap();
            let position = found.pose.unwrap().position;
            assert!(position.abs_diff_eq(camera.pose.position, 1e-4), "{name}");
        }
        let photo = format!("photos/{i}.png");
        let path = folder.path().join("transforms.json");
        let found = file::read(&path, &wanted(Which::Photo(Path::new(&photo)))).unwrap();
        assert!(
            found
                .pose
                .unwrap()
                .position
                .abs_diff_eq(camera.pose.position, 1e-4)
        );
    }
    assert_eq!(file::parts(&folder.path().join("sparse")).len(), 2);
}

#[test]
fn the_one_reader_explains_what_it_cannot_choose() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    std::fs::write(&path, transforms_json(&rig())).unwrap();
    let said = |asked: &file::Wanted| file::read(&path, asked).unwrap_err().to_string();
    assert_eq!(
        said(&wanted(Which::Number(3))),
        "the transforms.json file cannot be used: it has 3 cameras, and no camera 3; say which by \
         its number from 0 or by the name of its picture (dipir init: --camera-frame, --camera-image)"
    );
    assert!(said(&wanted(Which::Photo(Path::new("b.jpg")))).contains("none for \"b.jpg\""));
    let cropped = file::Wanted {
        size: [640.0, 400.0],
        ..wanted(Which::Number(0))
    };
    assert!(
        said(&cropped)
            .contains("of a picture of 640 x 480 pixels, and the photograph has 640 x 400")
    );
    let text = transforms_json(&rig())
        .replace("[1.0,", "[9.0,")
        .replace("0.0,1.0]", "0.0,9.0]");
    let turned = text.replacen("\"transform_matrix\":[[", "\"transform_matrix\":[[7", 1);
    std::fs::write(&path, turned).unwrap();
    assert!(said(&wanted(Which::Number(0))).contains("does not rotate"));
}

#[test]
fn a_glb_without_cameras_or_with_a_cycle_is_refused() {
    let said = |json: &str| gltf::read(&glb(json), SIZE).unwrap_err().to_string();
    assert!(said("{\"nodes\": []}").contains("it has no perspective camera"));
    let cycle = json!({
        "nodes": [{"camera": 0, "children": [1]}, {"children": [0]}],
        "cameras": [{"perspective": {"yfov": 1.0}}],
    });
    assert!(said(&cycle.to_string()).contains("its nodes form a cycle"));
}

#[test]
fn every_format_gives_the_same_cameras() {
    let rig = rig();
    let frames = transforms::read(transforms_json(&rig).as_bytes(), None, WorldUp::Z).unwrap();
    let text = colmap::read_text(
        COLMAP_CAMERAS,
        &colmap_images(&rig),
        COLMAP_POINTS,
        WorldUp::Z,
    )
    .unwrap();
    let [cameras, images, points] = colmap_binary(&rig);
    let binary = colmap::read_binary(&cameras, &images, &points, WorldUp::Z).unwrap();
    let shot = chan::read(&chan_text(&rig), SIZE, None).unwrap();
    assert_eq!(text.points, [DVec3::new(1.0, 3.0, -2.0)]);
    assert_eq!(binary, text);
    for (i, camera) in rig.iter().enumerate() {
        agree(&frames[i].1, camera, "transforms.json");
        assert_eq!(text.images[i].0, format!("image {i}.jpg"));
        agree(&text.images[i].1, camera, "COLMAP");
        agree(&shot[i].1, camera, ".chan");
        assert_eq!(shot[i].0, i as i64 + 1);
        let project = fspy_project(&fspy_state(camera, 0.01, "Centimeters"));
        agree(&fspy::read(&project, WorldUp::Z).unwrap(), camera, "fSpy");
        let state: serde_json::Value =
            serde_json::from_str(&fspy_state(camera, 1.0, "Meters")).unwrap();
        let exported = state["cameraParameters"].to_string();
        agree(
            &fspy::read(exported.as_bytes(), WorldUp::Z).unwrap(),
            camera,
            "fSpy's JSON",
        );
    }
}

#[test]
fn a_folder_of_colmap_is_read_in_text_and_binary() {
    let rig = rig();
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    let read = || {
        let files = colmap::Files::at(folder.path()).unwrap();
        let all = (0..rig.len()).map(|i| colmap::read_camera(&files, WorldUp::Z, |_| Ok(i)));
        all.collect::<Result<Vec<Camera>, CameraError>>()
    };
    assert!(matches!(read(), Err(CameraError::Read { .. })));
    put("cameras.txt", COLMAP_CAMERAS.as_bytes());
    put("images.txt", colmap_images(&rig).as_bytes());
    let text = read().unwrap();
    let [cameras, images, points] = colmap_binary(&rig);
    put("cameras.bin", &cameras);
    put("images.bin", &images);
    assert_eq!(read().unwrap(), text);
    let points = colmap::read_points(&points, true, WorldUp::Z).unwrap();
    assert_eq!(points.len(), 1);
}

#[test]
fn fspys_principal_point_counts_in_halves_of_the_longer_side() {
    let camera = rig()[0];
    for (size, want) in [([640, 480], [352.0, 272.0]), ([480, 640], [272.0, 352.0])] {
        let mut state: serde_json::Value =
            serde_json::from_str(&fspy_state(&camera, 1.0, "Meters")).unwrap();
        let p = &mut state["cameraParameters"];
        p["principalPoint"] = json!({"x": 0.1, "y": -0.1});
        p["imageWidth"] = json!(size[0]);
        p["imageHeight"] = json!(size[1]);
        let got = fspy::read(p.to_string().as_bytes(), WorldUp::Z).unwrap();
        assert!(
            got.lens
                .principal_px
                .abs_diff_eq(DVec2::from_array(want), 1e-9)
        );
        let focal = 0.5 * f64::from(size[0]) * 520.0 / 320.0;
        assert!((got.lens.focal_px.x - focal).abs() < 1e-9);
    }
}

#[test]
fn fspy_projects_without_a_camera_or_of_another_version_are_explained_in_one_line() {
    let words = |bytes: &[u8]| fspy::read(bytes, WorldUp::Z).unwrap_err().to_string();
    let empty = fspy_project("{\"cameraParameters\": null}");
    assert_eq!(
        words(&empty),
        "the fSpy file cannot be used: the project has no camera parameters; open it in fSpy, place \
         the vanishing lines until it shows a camera, and save it"
    );
    let mut other = empty.clone();
    other[4] = 2;
    assert_eq!(
        words(&other),
        "the fSpy file cannot be used: it is a project of version 2, and version 1 is read; export \
         the camera parameters as JSON from fSpy"
    );
}

const OPENCV_YAML: &str = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n\
camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 520., 0., 329.5, 0., 521.,\n       \
229.5, 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
data: [ -0.2, 5.0e-2, 1e-3, -2e-3, 0.01 ]\n";

#[test]
fn opencv_ros_nerfstudio_and_colmap_mean_the_same_distortion() {
    let want = Lens {
        principal_px: DVec2::new(330.0, 230.0),
        distortion: Distortion::brown_conrady([-0.2, 0.05, 0.01, 0.0], [0.0; 3], [1e-3, -2e-3])
            .unwrap(),
        ..Lens::pinhole(SIZE, DVec2::new(520.0, 521.0))
    };
    assert_eq!(opencv::read(OPENCV_YAML, None).unwrap(), want);
    let json = json!({
        "camera_matrix": [[520, 0, 329.5], [0, 521, 229.5], [0, 0, 1]],
        "distortion_coefficients": [[-0.2, 0.05, 1e-3, -2e-3, 0.01]],
    });
    assert_eq!(opencv::read(&json.to_string(), Some(SIZE)).unwrap(), want);
    let ros = "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [520, 0, 329.5, 0, 521, 229.5, 0, 0, 1]\ndistortion_model: plumb_bob\n\
        distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.2, 0.05, 0.001, -0.002, 0.01]\n";
    assert_eq!(opencv::read(ros, None).unwrap(), want);
    let by_hand = "image_width: 640 # pixels\nimage_height: 480\nK:\n- [520, 0, 329.5]\n- [0, 521, 229.5] # y\n\
        - [0, 0, 1]\nD:\n  - -0.2\n  - 0.05\n  - 0.001 # p1\n  - -0.002\n  - 0.01\nR: [1, 0, 0]\n";
    assert_eq!(opencv::read(by_hand, None).unwrap(), want);
    let tabs = OPENCV_YAML.replace("-0.2, 5.0e-2,", "-0.2,\t5.0e-2, # k1 k2\n  ");
    assert_eq!(opencv::read(&tabs, None).unwrap(), want);
    let identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
    let nerf = json!({
        "fl_x": 520, "fl_y": 521, "cx": 330, "cy": 230, "w": 640, "h": 480,
        "k1": -0.2, "k2": 0.05, "k3": 0.01, "p1": 1e-3, "p2": -2e-3,
        "frames": [{"transform_matrix": identity}],
    });
    let nerf = transforms::read(nerf.to_string().as_bytes(), None, WorldUp::Y).unwrap();
    assert_eq!(
        nerf[0].1,
        Camera {
            pose: Pose::IDENTITY,
            lens: want
        }
    );
    let full = "1 FULL_OPENCV 640 480 520 521 330 230 -0.2 0.05 1e-3 -2e-3 0.01 0 0 0";
    let image = "1 1 0 0 0 0 0 0 1 a.jpg\n\n";
    let colmap = colmap::read_text(full, image, "", WorldUp::MinusY).unwrap();
    assert_eq!(
        colmap.images[0].1,
        Camera {
            pose: Pose::IDENTITY,
            lens: want
        }
    );
}

#[test]
fn a_fisheye_is_the_same_in_opencv_nerfstudio_and_colmap() {
    let want = Distortion::kannala_brandt([-0.02, 0.01, 0.002, -0.001]).unwrap();
    let ros = "image_width: 640\nimage_height: 480\nK: [520, 0, 330, 0, 521, 230, 0, 0, 1]\n\
        distortion_model: equidistant\nD: [-0.02, 0.01, 0.002, -0.001]\n";
    assert_eq!(opencv::read(ros, None).unwrap().distortion, want);
    let identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]];
    let nerf = json!({
        "camera_model": "OPENCV_FISHEYE", "fl_x": 520, "w": 640, "h": 480,
        "k1": -0.02, "k2": 0.01, "k3": 0.002, "k4": -0.001,
        "frames": [{"transform_matrix": identity}],
    });
    let nerf = transforms::read(nerf.to_string().as_bytes(), None, WorldUp::Y).unwrap();
    assert_eq!(nerf[0].1.lens.distortion, want);
    let cameras = "1 OPENCV_FISHEYE 640 480 520 521 330 230 -0.02 0.01 0.002 -0.001";
    let model = colmap::read_text(cameras, "1 1 0 0 0 0 0 0 1 a\n", "", WorldUp::Y).unwrap();
    assert_eq!(model.images[0].1.lens.distortion, want);
}

const KITTI: &str = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP2: 700 0 600 42 0 700 180 0.7 0 0 1 0.002\n\
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";

/// Where numbers are so large or small that directions round to nothing.
#[test]
fn lenses_of_no_picture_are_refused() {
    let text =
        |f: &str, c: &str| format!("{{\"camera_matrix\": [{f}, 0, {c}, 0, 500, 240, 0, 0, 1]}}");
    assert!(opencv::read(&text("500", "320"), Some(SIZE)).is_ok());
    for (focal, axis) in [
        ("1e-200", "320"),
        ("1e200", "320"),
        ("500", "1e300"),
        ("-500", "320"),
    ] {
        let error = opencv::read(&text(focal, axis), Some(SIZE)).unwrap_err();
        assert!(error.to_string().contains("focal length"), "{error}");
    }
    for size in [[0.0, 480.0], [f64::NAN, 480.0], [640.0, 1e12]] {
        opencv::read(&text("500", "320"), Some(size)).unwrap_err();
    }
}

#[test]
fn kittis_projection_is_met() {
    let camera = kitti::read(KITTI, 2, [1242.0, 375.0]).unwrap();
    // 2 m to the right, 1.65 m below and 10 m ahead of camera 0, by the matrix, from the middle of the first pixel.
    let point = DVec3::new(2.0, 1.65, 10.0);
    let w = point.z + 0.002;
    let want = DVec2::new(
        (700.0 * point.x + 600.0 * point.z + 42.0) / w,
        (700.0 * point.y + 180.0 * point.z + 0.7) / w,
    );
    let ours = DVec3::new(point.x, -point.y, -point.z);
    let got = camera.project(ours).unwrap();
    assert!(got.abs_diff_eq(want + 0.5, 1e-9), "{got} {want}");
    // 10 m ahead of the scanner, 2 m to its right and 1.7 m below it.
    let (rotation, position) = kitti::read_scanner(KITTI).unwrap();
    let seen = rotation * DVec3::new(10.0, -2.0, -1.7) + position;
    assert!(
        seen.abs_diff_eq(DVec3::new(2.0, -1.7, -10.0), 1e-9),
        "{seen}"
    );
    let error = kitti::read(KITTI, 3, [1242.0, 375.0])
        .unwrap_err()
        .to_string();
    assert!(error.contains("it has neither P3 nor P_rect_03"), "{error}");
}

/// A file with bytes changed and its end cut off.
fn damaged(bytes: &[u8], damage: &[(usize, u8)], length: usize) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for &(at, value) in damage {
        let at = at % bytes.len();
        bytes[at] = value;
    }
    bytes.truncate(length);
    bytes
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// Cameras or an error, never a panic.
    #[test]
    fn damaged_files_never_panic(
        damage in proptest::collection::vec((0usize..2000, any::<u8>()), 0..8),
        length in 0usize..2500,
    ) {
        let rig = rig();
        let whole = |bytes: &[u8]| damaged(bytes, &damage, length);
        let text = |bytes: &[u8]| String::from_utf8_lossy(&whole(bytes)).into_owned();
        let _ = transforms::read(&whole(transforms_json(&rig).as_bytes()), None, WorldUp::Z);
        let project = fspy_project(&fspy_state(&rig[0], 1.0, "Meters"));
        let _ = fspy::read(&whole(&project), WorldUp::Z);
        let images = colmap_images(&rig);
        let _ = colmap::read_text(&text(COLMAP_CAMERAS.as_bytes()), &images, "", WorldUp::Y);
        let _ = colmap::read_text(COLMAP_CAMERAS, &text(images.as_bytes()), "", WorldUp::Y);
        let _ = colmap::read_text(COLMAP_CAMERAS, &images, &text(COLMAP_POINTS.as_bytes()), WorldUp::Y);
        let [cameras, images, points] = colmap_binary(&rig);
        let _ = colmap::read_binary(&whole(&cameras), &images, &points, WorldUp::Y);
        let _ = colmap::read_binary(&cameras, &whole(&images), &points, WorldUp::Y);
        let _ = colmap::read_binary(&cameras, &images, &whole(&points), WorldUp::Y);
        let _ = gltf::read(&whole(gltf_json(&rig).as_bytes()), SIZE);
        let _ = gltf::read(&whole(&glb(&gltf_json(&rig))), SIZE);
        let _ = nuscenes::read(&whole(nuscenes_json(&rig).as_bytes()), SIZE, WorldUp::Z);
        let _ = nuscenes::sensor(&whole(nuscenes_json(&rig).as_bytes()), WorldUp::Z);
        let _ = chan::read(&text(chan_text(&rig).as_bytes()), SIZE, None);
        let _ = opencv::read(&text(OPENCV_YAML.as_bytes()), None);
        let _ = kitti::read(&text(KITTI.as_bytes()), 2, SIZE);
        let _ = kitti::read_scanner(&text(KITTI.as_bytes()));
    }
}
