//! `dipir-inspect` on what the stages write and on what is broken.
use std::collections::HashMap;

use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use glam::Vec3;
use safetensors::tensor::{Dtype, TensorView, serialize};
use serde_json::{Value, json};

use crate::project::*;

fn json(project: &Project, path: &str) -> Value {
    let run = project.run(INSPECT, &["--json", path]);
    run.expect_success();
    serde_json::from_str(&run.stdout).unwrap()
}

#[test]
fn a_stage_folder_is_checked_by_hash() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    assert_eq!(json(&project, "out/scene")["whole"], true);
    let mut bytes = project.read("out/scene/effects.json");
    bytes.push(b' ');
    project.write("out/scene/effects.json", bytes);
    let run = project.run(INSPECT, &["out/scene"]);
    assert_eq!(run.code, Some(1));
    assert!(
        run.stderr
            .starts_with("error: out/scene/effects.json: damaged: "),
        "{}",
        run.stderr
    );
    assert!(
        run.stdout.contains("gbuffer.exr"),
        "the rest is shown: {}",
        run.stdout
    );
}

#[test]
fn effects_are_shown_as_a_table() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let run = project.run(INSPECT, &["out/scene/effects.json"]);
    run.expect_success();
    assert!(
        run.stdout.contains("every material is opaque"),
        "{}",
        run.stdout
    );
}

#[test]
fn an_environment_map_names_its_peak_and_gets_a_ring() {
    let project = Project::new();
    let run = project.run(INSPECT, &["--json", "sky.exr", "--png", "sky.png"]);
    run.expect_success();
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(
        value["environment"]["peak_radiance"],
        json!([20.0, 20.0, 20.0])
    );
    assert_eq!(json(&project, "sky.png")["width"], 16);
    // What a run refuses is no map here.
    let mut layers = Layers::new(4, 2);
    layers.latlong = true;
    let texels = (0..8).map(|i| Vec3::splat(1.0 - 2.0 * (i / 7) as f32));
    let texels = Raster::from_pixels(4, 2, texels.collect());
    layers.insert_rgb("", Precision::Full, &texels).unwrap();
    layers.write_exr(project.path("dark.exr")).unwrap();
    let run = project.run(INSPECT, &["dark.exr"]);
    run.expect_success();
    let why = "no environment map: cannot light a scene with `dark.exr`: radiance [-1, -1, -1] at column 3, row 1";
    assert!(run.stdout.contains(why), "{}", run.stdout);
}

#[test]
fn a_texture_that_cannot_be_read_is_told_as_the_scene_stage_tells_it() {
    let project = Project::new();
    let document = json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": "t.ktx2"}],
        "buffers": [{"byteLength": 60, "uri": "buffer.bin"}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
             "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
    });
    let values = [
        0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0,
    ];
    project.write("buffer.bin", values.map(f32::to_le_bytes).concat());
    project.write(
        "t.ktx2",
        [&b"\xabKTX 20\xbb\r\n\x1a\n"[..], &[0; 80]].concat(),
    );
    project.write("object.gltf", document.to_string());
    let message =
        "error: `t.ktx2` is a KTX texture; expected a PNG or JPEG image: convert the file";
    let object = "scene.objects=[{path=\"object.gltf\"}]";
    project.run(SCENE, &["-s", object]).expect_error(1, message);
    project
        .run(INSPECT, &["object.gltf"])
        .expect_error(1, message);
}

#[test]
fn objects_show_their_size_and_materials() {
    let project = Project::new();
    let value = json(&project, "object.obj");
    assert_eq!(value["triangles"], 4);
    assert_eq!(value["max_m"], json!([0.6f32, 1.1f32, 0.5]));
    project.write(
        "object.stl",
        "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 2 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n",
    );
    let value = json(&project, "object.stl");
    assert_eq!(value["triangles"], 1);
    assert_eq!(value["max_m"], json!([2.0, 1.0, 0.0]));
}

#[test]
fn names_in_a_file_cannot_command_the_terminal() {
    let project = Project::new();
    let name = "m\u{1b}[2J\u{9b}31m";
    project.write(
        "object.obj",
        format!("mtllib a.mtl\nusemtl {name}\n{OBJECT}"),
    );
    project.write("a.mtl", format!("newmtl {name}\nKd 0.5 0.5 0.5\n"));
    let run = project.run(INSPECT, &["object.obj"]);
    run.expect_success();
    let obeyed = |c: char| c.is_control() && c != '\n';
    assert!(!run.stdout.contains(obeyed), "{:?}", run.stdout);
    assert!(
        run.stdout.contains("m\\u{1b}[2J\\u{9b}31m"),
        "{}",
        run.stdout
    );
}

#[test]
fn tensors_show_shapes_types_and_what_is_not_a_number() {
    let project = Project::new();
    let floats: Vec<u8> = [1.0f32, -2.0, f32::NAN, 4.0]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let halves: Vec<u8> = [1.5f32, 2.5]
        .iter()
        .flat_map(|&v| half::f16::from_f32(v).to_le_bytes())
        .collect();
    let tensors = HashMap::from([
        (
            "a.weight",
            TensorView::new(Dtype::F32, vec![2, 2], &floats).unwrap(),
        ),
        ("b", TensorView::new(Dtype::F16, vec![2], &halves).unwrap()),
    ]);
    let metadata = HashMap::from([("rank".to_string(), "4".to_string())]);
    project.write(
        "lora.safetensors",
        serialize(tensors, Some(metadata)).unwrap(),
    );
    let value = json(&project, "lora.safetensors");
    let a = &value["tensors"]["a.weight"];
    assert_eq!(
        (&a["min"], &a["max"], &a["mean"]),
        (&(-2.0).into(), &4.0.into(), &1.0.into())
    );
    assert_eq!((&a["nan"], &a["shape"]), (&1.into(), &json!([2, 2])));
    assert_eq!(value["tensors"]["b"]["mean"], 2.0);
    assert_eq!(value["metadata"]["rank"], "4");
}

#[test]
fn hostile_tensor_headers_are_refused() {
    let project = Project::new();
    let file = |header: &str, length: u64, data: &[u8]| {
        [&length.to_le_bytes()[..], header.as_bytes(), data].concat()
    };
    let sized = |header: &str, data: &[u8]| file(header, header.len() as u64, data);
    for (name, bytes) in [
        ("a header of 2^63 bytes", file("{}", 1 << 63, &[])),
        ("a header beyond the end", file("{}", 1000, &[])),
        ("no header", vec![1, 2, 3]),
        ("not JSON", sized("nonsense", &[])),
        (
            "offsets past the data",
            sized(
                r#"{"a":{"dtype":"F32","shape":[4],"data_offsets":[0,16]}}"#,
                &[0; 8],
            ),
        ),
        (
            "a shape that overflows",
            sized(
                r#"{"a":{"dtype":"F32","shape":[4294967296,4294967296,4],"data_offsets":[0,16]}}"#,
                &[0; 16],
            ),
        ),
        (
            "a shape that does not fit its bytes",
            sized(
                r#"{"a":{"dtype":"F32","shape":[3],"data_offsets":[0,16]}}"#,
                &[0; 16],
            ),
        ),
        (
            "offsets that run backwards",
            sized(
                r#"{"a":{"dtype":"F32","shape":[4],"data_offsets":[16,0]}}"#,
                &[0; 16],
            ),
        ),
        (
            "bytes that no tensor owns",
            sized(
                r#"{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#,
                &[0; 16],
            ),
        ),
    ] {
        project.write("x.safetensors", bytes);
        let run = project.run(INSPECT, &["x.safetensors"]);
        assert_eq!(run.code, Some(1), "{name}");
        let start = "error: x.safetensors: not a valid safetensors file: ";
        assert!(run.stderr.starts_with(start), "{name}: {}", run.stderr);
    }
}

#[test]
fn what_is_no_artifact_is_told() {
    let project = Project::new();
    project.write("zero.png", "");
    project
        .run(INSPECT, &["zero.png"])
        .expect_error(1, "error: zero.png is empty (0 bytes); make it anew");
    project
        .run(INSPECT, &["none.exr"])
        .expect_error(1, "error: cannot read none.exr: no such file or directory");
    project.run(INSPECT, &["pipeline.toml"]).expect_error(
        1,
        "error: pipeline.toml is of no kind known here; accepted: PNG, JPEG, HDR, EXR, GLB, glTF, \
         OBJ, PLY, STL, JSON, safetensors, or a stage's folder",
    );
    project.run(INSPECT, &["."]).expect_error(
        1,
        "error: . holds no stage.json, so it is not the folder of a finished stage; name one, as in \
         out/scene, or a single file",
    );
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    let project = Project::new();
    let mut child = project.command(INSPECT, &["sky.exr"]).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[cfg(unix)]
#[test]
fn a_pipe_or_a_device_is_refused_and_not_waited_for() {
    for path in ["pipe", "/dev/null"] {
        let project = Project::new();
        let made = project.command("mkfifo", &["pipe"]).status().unwrap();
        assert!(made.success());
        project.run(INSPECT, &[path]).expect_error(
            1,
            &format!("error: {path} is a pipe or a device; name a file or a folder"),
        );
    }
}
