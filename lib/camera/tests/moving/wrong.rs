//! Keys that cannot be, and files that are damaged.
use dipir_cameras::file::Which;
use proptest::prelude::*;
use serde_json::{Value, json};

use crate::files::{Scene, glb, numbered};
use crate::{exported, plate, read};

/// The document of a camera that moves with `change` made to it.
fn changed(change: impl Fn(&mut Value)) -> Vec<u8> {
    let scene = numbered(1, 4, 24.0);
    let mut document = scene.document(None);
    change(&mut document);
    glb(&document, scene.buffer())
}

#[test]
fn pointers_of_nodes_are_read_and_those_of_the_lens_told() {
    let pointer = |to: &str| {
        let target = json!({ "path": "pointer",
            "extensions": { "KHR_animation_pointer": { "pointer": to } } });
        let bytes = changed(|d| d["animations"][0]["channels"][0]["target"] = target.clone());
        plate(&bytes, 3)
    };
    assert_eq!(pointer("/nodes/0/translation"), Ok(3.0));
    for other in [
        "/nodes/0/weights",
        "/cameras/0/perspective/znear",
        "/materials/0/alphaCutoff",
        "/cameras/1/perspective/yfov",
    ] {
        assert_eq!(pointer(other), Ok(-9.0), "{other}");
    }
    let error = pointer("/cameras/0/perspective/yfov").unwrap_err();
    let want = "its camera zooms: an animation changes yfov (KHR_animation_pointer), which is not read; export .chan";
    assert!(error.contains(want), "{error}");
}

#[test]
fn what_is_wrong_with_keys_is_told() {
    let set = |pointer: &'static str, value: Value| {
        let bytes = changed(|d| match d.pointer_mut(pointer) {
            Some(own) => *own = value.clone(),
            None => {
                let (parent, key) = pointer.rsplit_once('/').unwrap();
                d.pointer_mut(parent).unwrap()[key] = value.clone();
            }
        });
        plate(&bytes, 2)
    };
    assert_eq!(set("/asset/version", json!("2.0")), Ok(2.0));
    assert_eq!(set("/accessors/0/min", json!("of no use")), Ok(2.0));
    let huge = json!(u64::MAX);
    for (pointer, value, want) in [
        (
            "/accessors/0/count",
            json!(5),
            "its accessor 0 reads beyond its buffer",
        ),
        ("/accessors/0/count", json!(3), "has 3 times and 4 values"),
        (
            "/accessors/0/count",
            json!(10_000_000),
            "its camera has more than 1000000 keys",
        ),
        (
            "/accessors/1/count",
            huge.clone(),
            "its camera has more than 1000000 keys",
        ),
        (
            "/accessors/1/byteOffset",
            huge.clone(),
            "its accessor 1 reads beyond its buffer",
        ),
        (
            "/bufferViews/1/byteOffset",
            huge.clone(),
            "its accessor 1 reads beyond its buffer",
        ),
        (
            "/bufferViews/1/byteLength",
            huge.clone(),
            "its accessor 1 reads beyond its buffer",
        ),
        (
            "/bufferViews/1/byteStride",
            huge.clone(),
            "its accessor 1 reads beyond its buffer",
        ),
        ("/bufferViews/1/buffer", json!(7), "its buffer 7 is missing"),
        (
            "/bufferViews/1/extensions",
            json!({ "EXT_meshopt_compression": {} }),
            "are compressed (meshopt)",
        ),
        (
            "/buffers/0/uri",
            json!("/keys.bin"),
            "its buffer 0 is in a file of another folder: \"/keys.bin\"",
        ),
        (
            "/buffers/0/uri",
            json!("data:;base64,??"),
            "its buffer 0 is no valid base64",
        ),
        (
            "/accessors/0/type",
            json!("VEC3"),
            "its accessor 0 is of \"VEC3\", where keys have \"SCALAR\"",
        ),
        (
            "/accessors/1/componentType",
            json!(5125),
            "has components of kind 5125",
        ),
        (
            "/accessors/1/count",
            json!(-1),
            "its accessor 1 cannot be read",
        ),
        ("/accessors/1/sparse", json!({}), "its accessor 1 is sparse"),
        (
            "/animations/0/samplers/0/input",
            json!(9),
            "its accessor 9 is missing",
        ),
        (
            "/animations/0/samplers/0/interpolation",
            json!("BEZIER"),
            "has the interpolation \"BEZIER\"",
        ),
        (
            "/animations/0/samplers/0/interpolation",
            json!("CUBICSPLINE"),
            "4 times and 4 values, of which each time has 3",
        ),
        (
            "/animations/0/channels/0/sampler",
            json!(1),
            "has no keys: its sampler is missing",
        ),
        (
            "/animations/0/channels/0/target/path",
            json!("rotation"),
            "is of \"VEC3\", where keys have \"VEC4\"",
        ),
    ] {
        let error = set(pointer, value).unwrap_err();
        assert!(error.contains(want), "{pointer}: {error}");
    }
    let twice = changed(|d| {
        let own = d["animations"][0].clone();
        d["animations"].as_array_mut().unwrap().push(own);
    });
    let error = plate(&twice, 2).unwrap_err();
    assert!(
        error.contains("two animations have a translation of its node \"Camera\""),
        "{error}"
    );
    let keys = |path: &str, times: [f32; 2], values: &[f32]| {
        let mut scene = Scene::of(numbered(1, 1, 24.0).nodes);
        scene.keys(json!({ "node": 0, "path": path }), &times, values, "LINEAR");
        plate(&scene.glb(), 1).unwrap_err()
    };
    let frames = [0.0, 1.0 / 24.0];
    for (error, want) in [
        (
            keys("translation", [0.5, 0.5], &[0.0; 6]),
            "has times that do not increase",
        ),
        (
            keys("translation", [0.0, f32::NAN], &[0.0; 6]),
            "has a time that is no number at its key 1",
        ),
        (
            keys("translation", frames, &[f32::INFINITY; 6]),
            "has a value that is no number at its key 0",
        ),
        (
            keys("rotation", frames, &[0.0; 8]),
            "the rotation of its node \"Camera\" has a rotation of length 0",
        ),
        (
            keys("scale", frames, &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
            "scaled to nothing",
        ),
    ] {
        assert!(error.contains(want), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// A camera whose numbers are finite or an error, never a panic.
    #[test]
    fn damaged_files_never_panic(
        damage in proptest::collection::vec((0usize..5000, any::<u8>()), 0..8),
        course in 0usize..3,
        frame in 900u32..1100,
    ) {
        let scene = exported();
        let mut document = scene.document(None);
        for sampler in document["animations"][0]["samplers"].as_array_mut().unwrap() {
            sampler["interpolation"] = json!(["LINEAR", "STEP", "CUBICSPLINE"][course]);
        }
        let mut bytes = glb(&document, scene.buffer());
        for (at, value) in damage {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("shot.glb");
        std::fs::write(&path, &bytes).unwrap();
        if let Ok(found) = read(&path, Which::Number(frame)) {
            let pose = found.pose.unwrap();
            prop_assert!(pose.position.is_finite() && pose.rotation.is_finite());
        }
    }
}
