//! Files of several cameras: which one is read, and what the others do.
mod found;

use std::path::Path;

use dipir_cameras::file::{self, Wanted, Which};
use serde_json::json;

use crate::found::found_x;

/// Blender names a camera's data, which several objects may share, and each object.
#[test]
fn a_gltf_s_camera_goes_by_its_node_s_name_too() {
    let node = |name: &str, x: f64| json!({ "name": name, "camera": 0, "translation": [x, 0, 0] });
    let text = json!({
        "nodes": [node("left", -1.0), node("right", 1.0)],
        "cameras": [{ "name": "lens", "perspective": { "yfov": 0.7 } }],
    });
    let x = |which| found_x("shot.gltf", &text.to_string(), which);
    assert_eq!(x(Which::Name("right")), Ok(1.0));
    assert_eq!(x(Which::Photo(Path::new("plates/left.png"))), Ok(-1.0));
    let error = x(Which::Name("lens")).unwrap_err();
    let want = "match \"lens\" equally well; say which by its number, for instance frame = 1";
    assert!(error.contains(want), "{error}");
}

/// A rig of which the others are of no use here.
#[test]
fn a_camera_that_cannot_be_read_keeps_no_other_from_being_read() {
    let rows = |x: f64| json!([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    let frames = json!({ "fl_x": 500, "frames": [
        { "file_path": "a.png", "transform_matrix": rows(1.0) },
        { "file_path": "b.png", "transform_matrix": rows(2.0), "camera_model": "EQUIRECTANGULAR" },
        { "file_path": "c.png", "transform_matrix": null },
        { "file_path": "d.png", "transform_matrix": [[1, 0, 0, null]] },
    ] });
    let sensor = |x: f64, turn: serde_json::Value, file: &str| {
        json!({ "translation": [x, 0, 0], "rotation": turn, "filename": file,
            "camera_intrinsic": [[500, 0, 300], [0, 500, 200], [0, 0, 1]] })
    };
    let records = json!([
        sensor(1.0, json!([1, 0, 0, 0]), "a.png"),
        sensor(2.0, json!([0, 0, 0, 0]), "b.png"),
        sensor(3.0, json!(null), "c.png"),
    ]);
    // The parent's scale shears the turned camera alone.
    let nodes = json!([
        { "scale": [2, 1, 1], "children": [1, 2] },
        { "name": "a", "camera": 0, "translation": [0.5, 0, 0] },
        { "name": "b", "camera": 0, "rotation": [0, 0, 0.38268343, 0.92387953] },
    ]);
    let gltf = json!({ "nodes": nodes, "cameras": [{ "perspective": { "yfov": 0.7 } }] });
    for (name, text, photo, wrong) in [
        (
            "transforms.json",
            &frames,
            "b.png",
            "camera_model is \"EQUIRECTANGULAR\"",
        ),
        (
            "transforms.json",
            &frames,
            "c.png",
            "the frame has no transform_matrix",
        ),
        (
            "transforms.json",
            &frames,
            "d.png",
            "the frame cannot be read: invalid type: null",
        ),
        ("sensors.json", &records, "b.png", "no rotation"),
        ("sensors.json", &records, "c.png", "invalid type: null"),
        (
            "rig.gltf",
            &gltf,
            "b.png",
            "sheared, mirrored or scaled to nothing",
        ),
    ] {
        let of = |photo: &str| found_x(name, &text.to_string(), Which::Photo(Path::new(photo)));
        assert_eq!(of("a.png"), Ok(1.0), "{name}");
        let error = of(photo).unwrap_err();
        assert!(error.contains(wrong), "{error}");
    }
}

#[test]
fn a_gltf_of_orthographic_cameras_says_that_they_are() {
    let camera = json!({ "type": "orthographic", "orthographic": { "xmag": 1, "ymag": 1 } });
    let text = json!({ "nodes": [{ "camera": 0 }], "cameras": [camera] }).to_string();
    let error = found_x("shot.gltf", &text, Which::Number(0)).unwrap_err();
    assert!(error.contains("its cameras are orthographic"), "{error}");
}

/// Files of later versions of COLMAP.
#[test]
fn a_model_of_cameras_with_a_number_that_is_not_known_keeps_no_earlier_one_from_being_read() {
    let folder = tempfile::tempdir().unwrap();
    let numbers =
        |values: &[f64]| -> Vec<u8> { values.iter().flat_map(|v| v.to_le_bytes()).collect() };
    let camera = |id: u32, kind: u32, parameters: &[f64]| {
        let head = [id.to_le_bytes(), kind.to_le_bytes()].concat();
        let size = [640u64.to_le_bytes(), 480u64.to_le_bytes()].concat();
        [head, size, numbers(parameters)].concat()
    };
    let pinhole = [520.0, 520.0, 320.0, 240.0];
    let cameras = [
        3u64.to_le_bytes().to_vec(),
        camera(1, 1, &pinhole),
        camera(2, 99, &[520.0, 320.0]),
        camera(3, 1, &pinhole),
    ];
    let image = |id: u32| {
        let pose = numbers(&[1.0, 0.0, 0.0, 0.0, f64::from(id), 0.0, 0.0]);
        let name = format!("{id}.png\0").into_bytes();
        let ids = [id.to_le_bytes(), id.to_le_bytes()];
        [ids[0].to_vec(), pose, ids[1].to_vec(), name, vec![0; 8]].concat()
    };
    let images = [3u64.to_le_bytes().to_vec(), image(1), image(2), image(3)];
    std::fs::write(folder.path().join("cameras.bin"), cameras.concat()).unwrap();
    std::fs::write(folder.path().join("images.bin"), images.concat()).unwrap();
    let of = |name| {
        let asked = Wanted {
            size: [640.0, 480.0],
            which: Which::Name(name),
            up: None,
            fov_deg: None,
            turns: None,
        };
        file::read(folder.path(), &asked).map_err(|e| e.to_string())
    };
    assert_eq!(of("1.png").unwrap().pose.unwrap().position.x, -1.0);
    for name in ["2.png", "3.png"] {
        let error = of(name).unwrap_err();
        assert!(
            error.contains("its camera model is 99; accepted:"),
            "{error}"
        );
    }
    let known = file::pictures(folder.path(), None);
    assert_eq!(known.len(), 1);
}
