//! Calibrations: what their numbers mean, and which cannot be read.
mod found;

use std::path::Path;

use dipir_cameras::file::{self, Which};
use dipir_cameras::{WorldUp, kitti, nuscenes, opencv};
use glam::{DVec2, DVec3};
use serde_json::{Value, json};

use crate::found::found_x;

/// A lens that cannot be read is not a lens without distortion.
#[test]
fn what_is_no_number_in_a_calibration_is_quoted() {
    let read = |text: &str| opencv::read(text, Some([640.0, 480.0])).map_err(|e| e.to_string());
    let yaml = "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0.1, -0.2]\n";
    let json = "{\"K\": [500, 0, 320, 0, 500, 240, 0, 0, 1], \"D\": [0.1, null]}";
    assert!(read(yaml).is_ok() && read(json).is_ok());
    for (text, word) in [
        (yaml.replace("-0.2", ".Nan"), ".Nan"),
        (yaml.replace("320", "five"), "five"),
        (json.replace("null", "true"), "true"),
    ] {
        let error = read(&text).unwrap_err();
        assert!(error.contains(&format!("{word:?} is no number")), "{error}");
    }
}

#[test]
fn a_matrix_by_columns_is_no_lens_with_its_axis_in_the_corner() {
    let read = |k: &str| opencv::read(&format!("K: {k}\n"), Some([640.0, 480.0]));
    assert!(read("[500, 0, 320, 0, 500, 240, 0, 0, 1]").is_ok());
    let error = read("[500, 0, 0, 0, 500, 0, 320, 240, 1]")
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("by rows; others write it by columns"),
        "{error}"
    );
}

#[test]
fn the_middle_of_a_picture_is_half_a_pixel_beyond_its_last_index_over_two() {
    let size = [640.0, 480.0];
    let opencv = opencv::read("K: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]\n", Some(size));
    let kitti = kitti::read("P2: 500 0 319.5 0 0 500 239.5 0 0 0 1 0\n", 2, size);
    let record = record(json!({ "channel": "CAM" }), 0.0).to_string();
    let nuscenes = nuscenes::read(record.as_bytes(), size, WorldUp::Z).unwrap();
    for lens in [opencv.unwrap(), kitti.unwrap().lens, nuscenes[0].1.lens] {
        assert_eq!(lens.principal_px, DVec2::new(320.0, 240.0));
    }
}

/// The development kits say which pixel a point lies in. That of nuScenes takes its colour from where the projection
/// rounds to; that of KITTI adds 1 and draws it in MATLAB, where pixel n reaches from n - 1/2 to n + 1/2, from 1.
#[test]
fn a_point_lies_in_the_pixel_that_the_development_kits_give_it() {
    let size = [640.0, 480.0];
    let k = [500.0, 0.0, 311.2, 0.0, 505.0, 244.9, 0.0, 0.0, 1.0];
    let p = format!("P2: {} 0 {} 0 0 {} {} 0 0 0 1 0\n", k[0], k[2], k[4], k[5]);
    let mut own = record(json!({ "channel": "CAM" }), 0.0);
    own["camera_intrinsic"] = json!([[k[0], 0, k[2]], [0, k[4], k[5]], [0, 0, 1]]);
    let nuscenes = nuscenes::read(own.to_string().as_bytes(), size, WorldUp::Z).unwrap();
    let kitti = kitti::read(&p, 2, size).unwrap();
    for i in 0..100 {
        // Image axes: in view, at positions within their pixels that differ.
        let z = 5.0 + 0.01 * f64::from(i);
        let seen = DVec3::new(
            0.37 * z * (f64::from(i) / 99.0 - 0.5),
            0.3 * z * (f64::from(i % 7) / 6.0 - 0.5),
            z,
        );
        let projected = DVec2::new(k[0] * seen.x / z + k[2], k[4] * seen.y / z + k[5]);
        for (camera, want) in [
            (nuscenes[0].1, projected.round()),
            (kitti, (projected + 1.0 + 0.5).floor() - 1.0),
        ] {
            let own = DVec3::new(seen.x, -seen.y, -seen.z);
            let pixel = camera.project(camera.pose.position + camera.pose.rotation * own);
            assert_eq!(pixel.unwrap().floor(), want, "{projected}");
        }
    }
}

#[test]
fn the_model_of_the_distortion_counts_wherever_that_of_the_camera_is() {
    let matrix = "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0.1, 0, 0, 0]\n";
    let (camera, lens) = ("camera_model: pinhole\n", "distortion_model: fisheye\n");
    for order in [[camera, lens], [lens, camera]] {
        let text = format!("{matrix}{}", order.concat());
        let found = opencv::read(&text, Some([640.0, 480.0])).unwrap();
        assert!(found.distortion.is_fisheye(), "{text}");
    }
}

/// As the sample program of OpenCV writes them: without a name of the model.
#[test]
fn a_fisheye_of_opencv_s_own_calibration_is_none_of_brown_and_conrady_s() {
    let read = |text: &str| opencv::read(text, Some([640.0, 480.0])).unwrap();
    let matrix = "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 500., 0., 320., 0., 500., \
        240., 0., 0., 1. ]\n";
    let coefficients = "distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n   data: [ -0.02, \
        0.003, 0.001, 0.002 ]\n";
    let json =
        json!({ "K": [500, 0, 320, 0, 500, 240, 0, 0, 1], "D": [-0.02, 0.003, 0.001, 0.002] });
    for is_fisheye in [false, true] {
        let kind = u8::from(is_fisheye);
        let head = format!("%YAML:1.0\n---\nflags: 4\nfisheye_model: {kind}\n");
        let mut json = json.clone();
        json["fisheye_model"] = json!(kind);
        for text in [format!("{head}{matrix}{coefficients}"), json.to_string()] {
            assert_eq!(read(&text).distortion.is_fisheye(), is_fisheye, "{text}");
        }
    }
}

/// Programs shorten the names: a lens whose coefficients are not found would be one without distortion.
#[test]
fn coefficients_are_found_by_each_of_their_names() {
    let matrix = "[500, 0, 320, 0, 500, 240, 0, 0, 1]";
    let size = Some([640.0, 480.0]);
    let want = opencv::read(&format!("K: {matrix}\nD: [-0.2, 0.03]\n"), size).unwrap();
    assert!(!want.distortion.is_none());
    for (k, d) in [
        ("k", "d"),
        ("camera_matrix", "dist_coeff"),
        ("camera_matrix", "dist_coeffs"),
        ("cameraMatrix", "distCoeffs"),
        ("camera_matrix", "dist"),
        ("camera_matrix", "distortion"),
        ("Camera_Matrix", "Distortion_Coefficients"),
    ] {
        let yaml = format!("{k}: {matrix}\n{d}: [-0.2, 0.03]\n");
        let json = format!("{{\"{k}\": {matrix}, \"{d}\": [[-0.2], [0.03]]}}");
        for text in [yaml, json] {
            assert_eq!(opencv::read(&text, size).unwrap(), want, "{text}");
        }
    }
}

#[test]
fn a_camera_of_kalibr_s_is_that_of_opencv_s() {
    let camera = |name: &str, model: &str| {
        format!(
            "{name}:\n  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: [-0.02, 0.003, 0.001, 0.002]\n  \
             distortion_model: {model}\n  intrinsics: [500.0, 501.0, 319.5, 239.5]\n  resolution: [640, 480]\n  \
             rostopic: /cam0/image_raw\n"
        )
    };
    let opencv = "image_width: 640\nimage_height: 480\nK: [500, 0, 319.5, 0, 501, 239.5, 0, 0, 1]\n\
        D: [-0.02, 0.003, 0.001, 0.002]\n";
    for (kalibr, own) in [("radtan", "plumb_bob"), ("equidistant", "fisheye")] {
        let want = opencv::read(&format!("{opencv}distortion_model: {own}\n"), None);
        let found = opencv::read(&camera("cam0", kalibr), None);
        assert_eq!(found.unwrap(), want.unwrap());
    }
    let error = |text: &str| opencv::read(text, None).unwrap_err().to_string();
    let two = camera("cam0", "radtan") + &camera("cam1", "radtan");
    let want = "it has 2 cameras; write that of the photograph into a file of its own";
    assert!(error(&two).ends_with(want), "{}", error(&two));
    let unknown = error(&camera("cam0", "fov"));
    let want = "its distortion model is \"fov\"; accepted: plumb_bob";
    assert!(unknown.contains(want), "{unknown}");
}

#[test]
fn a_rectification_that_cannot_be_read_is_no_identity() {
    let scanner = "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";
    assert!(kitti::read_scanner(scanner).is_ok());
    assert!(kitti::read_scanner(&format!("{scanner}R0_rect: 1 0 0 0 1 0 0 0 1\n")).is_ok());
    let error = kitti::read_scanner(&format!("{scanner}R0_rect: 1 0 0 0 1 0 0 0\n"));
    let error = error.unwrap_err().to_string();
    assert!(error.contains("R0_rect is not 9 finite numbers"), "{error}");
}

/// A record of nuScenes with these names, of a camera `x` metres from the middle.
fn record(names: Value, x: f64) -> Value {
    let mut record = json!({
        "translation": [x, 0, 0], "rotation": [0.5, -0.5, 0.5, -0.5],
        "camera_intrinsic": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]],
    });
    let all = record.as_object_mut().unwrap();
    all.extend(names.as_object().unwrap().clone());
    record
}

#[test]
fn a_record_of_nuscenes_goes_by_each_of_its_names() {
    let names = |i: u32| json!({ "channel": format!("CAM_{i}"), "filename": format!("samples/{i}.jpg"), "token": format!("t{i}") });
    let text = json!([record(names(1), 1.0), record(names(2), 2.0)]).to_string();
    let x = |which| found_x("sensors.json", &text, which);
    assert_eq!(x(Which::Photo(Path::new("photos/2.jpg"))), Ok(2.0));
    for name in ["CAM_2", "samples/2.jpg", "2.jpg", "t2"] {
        assert_eq!(x(Which::Name(name)), Ok(2.0), "{name}");
    }
    assert_eq!(x(Which::Number(0)), Ok(1.0));
    let error = x(Which::Name("t3")).unwrap_err();
    assert!(
        error.contains("it has 2 cameras, and none for \"t3\""),
        "{error}"
    );
}

#[test]
fn a_gltf_of_one_upright_camera_has_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("shot.gltf");
    for aspect in [0.5, 2.0] {
        let perspective = json!({ "yfov": 0.7, "aspectRatio": aspect });
        let document =
            json!({ "nodes": [{ "camera": 0 }], "cameras": [{ "perspective": perspective }] });
        std::fs::write(&path, document.to_string()).unwrap();
        assert!(file::has_one(&path), "{aspect}");
    }
}
