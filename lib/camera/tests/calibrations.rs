//! Calibrations: what their numbers mean, and which cannot be read.
use std::path::Path;

use dipir_cameras::file::{self, Wanted, Which};
use dipir_cameras::{WorldUp, kitti, nuscenes, opencv};
use glam::DVec2;
use serde_json::{Value, json};

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

/// Where the camera stands that is found in a file of this name.
fn found_x(name: &str, text: &str, which: Which) -> Result<f64, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    let wanted = Wanted {
        size: [640.0, 480.0],
        which,
        up: None,
        fov_deg: None,
        turns: None,
    };
    let found = file::read(&path, &wanted).map_err(|e| e.to_string())?;
    Ok(found.pose.unwrap().position.x)
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
