//! Cameras, places and foregrounds of the frames of a shot.
use base64::Engine;
use base64::prelude::BASE64_STANDARD_NO_PAD;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;
use serde_json::{Value, json};

use crate::project::*;
use crate::shot::{project, shot};

/// Puts `camera` in place of the project's `[scene.camera]`, and `ground`, if there is one, of its `[scene.proxy]`.
fn set_camera(project: &Project, camera: &str, ground: Option<&str>) {
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (head, tail) = text.split_once("[scene.camera]\n").unwrap();
    let (_, tail) = tail.split_once("[scene.proxy]\n").unwrap();
    let (own, tail) = tail.split_once("\n\n").unwrap();
    let ground = ground.unwrap_or(own);
    let text = format!("{head}[scene.camera]\n{camera}\n[scene.proxy]\n{ground}\n\n{tail}");
    project.write("pipeline.toml", text);
}

/// A frame of `transforms.json` from a place 5 m before the object, which looks along -z.
fn frame_at(name: &str, [x, y]: [f64; 2]) -> Value {
    let matrix = [
        [1.0, 0.0, 0.0, x],
        [0.0, 1.0, 0.0, y],
        [0.0, 0.0, 1.0, 5.0],
        [0.0, 0.0, 0.0, 1.0],
    ];
    json!({ "file_path": name, "transform_matrix": matrix })
}

/// Two cameras, one of which moves: x is .5, .25 and -.5 at 1/24, 2/24 and 3/24 s.
fn moving_gltf() -> String {
    let keys: [f32; 12] = [1.0, 2.0, 3.0, 0.5, 1.5, 5.0, 0.25, 1.5, 5.0, -0.5, 1.5, 5.0];
    let keys = keys.iter().enumerate();
    let keys = keys.flat_map(|(i, k)| if i < 3 { k / 24.0 } else { *k }.to_le_bytes());
    let keys = BASE64_STANDARD_NO_PAD.encode(keys.collect::<Vec<u8>>());
    let accessor = |view: u32, kind: &str| json!({ "bufferView": view, "componentType": 5126, "type": kind, "count": 3 });
    let channel = json!({ "sampler": 0, "target": { "node": 1, "path": "translation" } });
    let file = json!({
        "nodes": [{ "name": "still", "camera": 0, "translation": [0.0, 1.5, 5.0] }, { "name": "tracked", "camera": 0 }],
        "cameras": [{ "perspective": { "yfov": 0.7 } }],
        "buffers": [{ "uri": format!("data:;base64,{keys}") }],
        "bufferViews": [{ "buffer": 0, "byteLength": 12 }, { "buffer": 0, "byteOffset": 12, "byteLength": 36 }],
        "accessors": [accessor(0, "SCALAR"), accessor(1, "VEC3")],
        "animations": [{ "samplers": [{ "input": 0, "output": 1 }], "channels": [channel] }],
    });
    file.to_string()
}

#[test]
fn every_frame_has_the_camera_of_its_name() {
    let project = project();
    let with = |camera: &str| set_camera(&project, camera, None);
    let photo = project.read("background.png");
    let frame = |name: &str, x: f64| {
        project.write(name, &photo);
        frame_at(name, [x, 1.5])
    };
    let frames = [
        frame("background.png", 0.0),
        frame("a.png", 0.5),
        frame("b.png", -0.5),
    ];
    let transforms = json!({ "camera_angle_x": 0.8, "w": 36, "h": 24, "frames": frames });
    project.write("transforms.json", transforms.to_string());
    let place = |name: &str| {
        let scene: Value =
            serde_json::from_slice(&project.read(&format!("out/{name}/scene/scene.json"))).unwrap();
        scene["camera"]["position"][0].as_f64().unwrap()
    };
    // Whether the photograph's own is found by its name or is chosen.
    for own in ["", "image = \"background.png\"", "frame = 0"] {
        with(&format!(
            "file = \"transforms.json\"\nfile_up = \"y\"\n{own}"
        ));
        shot(&project, &["b.png", "a.png"]);
        let places = ["frames/a", "frames/b", "."].map(place);
        assert_eq!(places, [0.5, -0.5, 0.0], "{own}");
        project.run(DIPIR, &["clean"]).expect_success();
    }
    // A number that names the photograph's camera does not hold those of COLMAP's model still.
    std::fs::create_dir_all(project.path("sparse/0")).unwrap();
    project.write("sparse/0/cameras.txt", "1 PINHOLE 36 24 40 40 18 12\n");
    let image = |(name, x): (&str, f64)| format!("1 0 1 0 0 {} 1.5 5 1 {name}\n\n", -x);
    let images = [("background.png", 0.0), ("a.png", 0.5), ("b.png", -0.5)].map(image);
    project.write("sparse/0/images.txt", images.concat());
    with("file = \"sparse/0/images.txt\"\nfile_up = \"y\"\nframe = 0");
    shot(&project, &["b.png", "a.png"]);
    let places = ["frames/a", "frames/b", "."].map(place);
    assert_eq!(places, [0.5, -0.5, 0.0]);
    project.run(DIPIR, &["clean"]).expect_success();
    with("file = \"transforms.json\"\nfile_up = \"y\"");
    // What cannot be is said before anything runs.
    let refused = |args: &[&str], message: &str| {
        let run = project.run(DIPIR, &[&["shot"], args].concat());
        run.expect_error(2, &format!("error: {message}"));
    };
    refused(&["a.png", "gone.png"], "gone.png: there is no such file");
    let two = "2 frames cannot be used, the first as follows\n  caused by: gone.png: there is no such file";
    refused(&["gone.png", "a.png", "lost.png"], two);
    project.write("empty.png", "");
    let empty = "empty.png: it is empty: copy it again, or leave it out";
    refused(&["a.png", "empty.png"], empty);
    std::fs::create_dir(project.path("all")).unwrap();
    refused(
        &["a.png", "all"],
        "all: it is a folder: name the pictures in it",
    );
    refused(
        &["pipeline.toml", "a.png"],
        "pipeline.toml is no frame: write dipir shot --pipeline pipeline.toml FRAME…",
    );
    for dots in ["...png", "..png"] {
        project.write(dots, &photo);
        let why = "without its extension this is no name of a folder; rename the file, as in frame_0001.png";
        refused(&["a.png", dots], &format!("{dots}: {why}"));
    }
    refused(
        &["a.png", "./a.png"],
        "./a.png: another frame has the same name",
    );
    for name in ["c.png", "d.png"] {
        project.write(name, &photo);
    }
    let stranger = ["shot", "a.png", "c.png", "d.png"];
    let run = project.run(DIPIR, &stranger);
    assert_eq!(run.code, Some(1), "{}", run.stderr);
    let told =
        "error: 2 frames cannot be used, the first as follows\n  caused by: c.png\n  caused by: ";
    assert!(run.stderr.starts_with(told), "{}", run.stderr);
    assert!(!project.path("out/scene").exists());
    // Frames of .chan have numbers.
    let numbered = ["f_1.png", "f_02.png"];
    numbered.iter().for_each(|name| project.write(name, &photo));
    let cameras = "1 0.5 1.5 5 0 0 0 40\n2 -0.5 1.5 5 0 0 0 40\n";
    project.write("camera.chan", cameras);
    with("file = \"camera.chan\"\nframe = 1");
    // Another run in the same folder may be waited for.
    shot(&project, &["--wait", "f_1.png", "f_02.png"]);
    assert_eq!(["frames/f_1", "frames/f_02"].map(place), [0.5, -0.5]);
    refused(
        &["a.png"],
        "a.png: its name does not end in the number of a frame of .chan",
    );
    // A version is no number of a frame, and a frame that is written counts for others.
    for name in ["p.1001_v2.png", "p.1002_v2.png", "f_1001.png", "f_1002.png"] {
        project.write(name, &photo);
    }
    refused(
        &["p.1001_v2.png", "p.1002_v2.png"],
        "p.1002_v2.png: the camera moves, and 2, the number at the end of its name, is that of p.1001_v2.png, too: rename the \
         pictures so that the frame's number ends their names, as in plate.1001.png",
    );
    let own = "scene.background=f_1001.png";
    let run = project.run(DIPIR, &["shot", "--set", own, "f_1002.png"]);
    run.expect_success();
    assert_eq!(place("frames/f_1002"), -0.5);
    // So has a glTF camera that moves.
    project.write("shot.gltf", moving_gltf());
    let plates = ["p.1001.png", "p.1003.png"];
    plates.iter().for_each(|name| project.write(name, &photo));
    with("file = \"shot.gltf\"\nimage = \"tracked\"\nframe = 2");
    let run = project.run(DIPIR, &[&["shot"], &plates[..]].concat());
    run.expect_success();
    let told = "picture 1001 is taken to be frame 1; if it is not, write the frame";
    assert_eq!(run.stderr.matches(told).count(), 1, "{}", run.stderr);
    let places = ["frames/p.1001", "frames/p.1003", "."].map(place);
    assert_eq!(places, [0.5, -0.5, 0.25]);
    // Counted from the photograph, whose frame is written.
    let own = "scene.background=p.1001.png";
    let run = project.run(DIPIR, &[&["shot", "--set", own], &plates[..]].concat());
    run.expect_success();
    assert!(!run.stderr.contains("is taken to be"), "{}", run.stderr);
    let places = ["frames/p.1001", "frames/p.1003"].map(place);
    assert_eq!(places, [0.25, -0.5]);
    let beyond = "in frame 4 it stands as in frame 3";
    assert!(run.stderr.contains(beyond), "{}", run.stderr);
    // One that stands still is that of all frames.
    with("file = \"shot.gltf\"\nimage = \"still\"");
    shot(&project, &["p.1001.png", "p.1003.png"]);
    assert_eq!(["frames/p.1001", "frames/p.1003"].map(place), [0.0; 2]);
    with("transforms = \"transforms.json\"\ntransforms_up = \"y\"");
    refused(
        &["a.png"],
        "scene.camera.transforms names frames by number: write file in its place, which finds them by the names of their pictures",
    );
}

#[test]
fn a_picture_that_joins_the_others_may_change_the_frame() {
    let project = project();
    let photo = project.read("background.png");
    project.write("shot.gltf", moving_gltf());
    let own = ["--set", "scene.background=p.1002.png"];
    for name in ["p.1002.png", "p.1003.png"] {
        project.write(name, &photo);
    }
    // Of one camera alone the pictures tell the frame.
    let alone = moving_gltf().replacen("\"camera\":0,", "", 1);
    project.write("shot.gltf", alone);
    set_camera(&project, "file = \"shot.gltf\"", None);
    project.run(SCENE, &own).expect_success();
    let x = || {
        let scene: Value = serde_json::from_slice(&project.read("out/scene/scene.json")).unwrap();
        scene["camera"]["position"][0].as_f64().unwrap()
    };
    assert_eq!(x(), 0.5);
    project.write("p.1001.png", &photo);
    let status = project.run(DIPIR, &[&["status"], &own[..]].concat());
    assert!(
        status.stdout.contains("camera_frame changed from 1 to 2"),
        "{}",
        status.stdout
    );
    project.run(SCENE, &own).expect_success();
    assert_eq!(x(), 0.25);
}

#[test]
fn objects_and_ground_are_as_in_the_photograph() {
    let project = project();
    let moving = "file = \"transforms.json\"\nfile_up = \"y\"";
    set_camera(&project, moving, Some("camera_height_m = 1.6"));
    let frame = |name: &str, place: [f64; 2]| {
        project.write(name, project.read("background.png"));
        frame_at(name, place)
    };
    let frames = [frame("f.0.png", [0.0, 1.6]), frame("f.1.png", [0.5, 1.9])];
    project.write("background.png", project.read("f.0.png"));
    let file = json!({ "camera_angle_x": 0.8, "w": 36, "h": 24, "frames": frames });
    project.write("transforms.json", file.to_string());
    let black = DisplayImage(Raster::filled(36, 24, Vec3::ZERO));
    write_png(project.path("roto.0.png"), &black).unwrap();
    let at_pixel = [
        "--set",
        "scene.background=f.0.png",
        "--set",
        "scene.objects.0.at_pixel=[18, 20]",
        "--set",
        "scene.occluders=roto.0.png",
    ];
    let run = project.run(DIPIR, &[&["shot", "f.1.png"][..], &at_pixel].concat());
    run.expect_error(2, "error: f.1.png: its mask roto.1.png is missing");
    // What is switched off is not asked for.
    let off = ["--plan", "--set", "scene.effects.occluders=off"];
    let run = project.run(DIPIR, &[&["shot", "f.1.png"][..], &at_pixel, &off].concat());
    run.expect_success();
    write_png(project.path("roto.1.png"), &black).unwrap();
    // Each frame of a camera that moves has depths of its own.
    for (depth, why) in [
        (
            "depth.png",
            "error: f.1.png: the camera moves, and scene.depth has no file for it",
        ),
        (
            "depth.0.png",
            "error: f.1.png: the file of its depths depth.1.png is missing",
        ),
    ] {
        let depth = format!("scene.depth={depth}");
        let run = project.run(
            DIPIR,
            &[&["shot", "f.1.png", "--set", &depth][..], &at_pixel].concat(),
        );
        assert_eq!(run.code, Some(2), "{}", run.stderr);
        assert!(run.stderr.contains(why), "{}", run.stderr);
    }
    shot(&project, &[&["f.1.png"][..], &at_pixel].concat());
    let of = |folder: &str| -> Value {
        let path = format!("{folder}/scene/scene.json");
        serde_json::from_slice(&project.read(&path)).unwrap()
    };
    let (photo, frame) = (of("out"), of("out/frames/f.1"));
    assert_eq!(
        frame["objects"][0]["transform"],
        photo["objects"][0]["transform"]
    );
    assert_eq!(frame["proxy"], photo["proxy"]);
    assert_ne!(frame["camera"], photo["camera"]);
    assert_eq!(frame["occluders"]["path"], "roto.1.png");
    // Another place in the photograph is another place in every frame.
    let elsewhere = ["--set", "scene.objects.0.at_pixel=[10, 20]"];
    let ran = shot(
        &project,
        &[&["f.1.png"][..], &at_pixel, &elsewhere].concat(),
    );
    assert_eq!(ran[0]["done"]["ran"], json!(["scene", "composite"]));
    assert_ne!(of("out/frames/f.1")["objects"], frame["objects"]);
    let status = project.run(DIPIR, &["status"]);
    status.expect_success();
    assert!(
        status.stdout.contains("1 of 1 that were begun, in "),
        "{}",
        status.stdout
    );
}

#[test]
fn a_camera_that_stands_still_is_that_of_the_photograph() {
    let project = project();
    let still = "file = \"camera.json\"
file_up = \"y\"
image = \"background.png\"";
    set_camera(&project, still, None);
    let frame = frame_at("background.png", [0.5, 1.5]);
    let file = json!({ "camera_angle_x": 0.8, "w": 36, "h": 24, "frames": [frame] });
    project.write("camera.json", file.to_string());
    let picture = |name: &str, width, height| {
        let grey = DisplayImage(Raster::filled(width, height, Vec3::splat(0.4)));
        write_png(project.path(name), &grey).unwrap();
    };
    picture("half.png", 18, 12);
    picture("wide.png", 36, 12);
    shot(&project, &["half.png"]);
    let camera = |folder: &str| -> Value {
        let path = format!("{folder}/scene/scene.json");
        let scene: Value = serde_json::from_slice(&project.read(&path)).unwrap();
        scene["camera"].clone()
    };
    let (photo, half) = (camera("out"), camera("out/frames/half"));
    assert_eq!(half["position"], photo["position"]);
    let focal = |camera: &Value| camera["focal_px"][1].as_f64().unwrap();
    // Each is rounded to f32 on its own.
    assert!((focal(&half) / focal(&photo) - 0.5).abs() < 1e-6);
    let run = project.run(DIPIR, &["shot", "half.png", "wide.png"]);
    assert_ne!(run.code, Some(0));
    assert!(
        run.stderr
            .contains("it has 36 x 12 pixels, and the photograph"),
        "{}",
        run.stderr
    );
    assert!(
        run.stderr.ends_with("1 of 2 failed: wide.png\n"),
        "{}",
        run.stderr
    );
}
