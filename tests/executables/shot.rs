//! Frames under one light.
use base64::Engine;
use base64::prelude::BASE64_STANDARD_NO_PAD;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;
use serde_json::{Value, json};

use crate::project::*;

/// A project whose light is estimated.
pub(crate) fn project() -> Project {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let text = text.replace("environment = \"sky.exr\"\n", "");
    project.write("pipeline.toml", text);
    project
}

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

pub(crate) fn shot(project: &Project, frames: &[&str]) -> Vec<Value> {
    let run = project.run(DIPIR, &[&["shot", "--json"], frames].concat());
    run.expect_success();
    // The last of what is printed: the frames'.
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    value["runs"].as_array().unwrap().clone()
}

#[test]
fn frames_are_lit_by_one_light_and_made_once() {
    let project = project();
    let photo = project.read("background.png");
    project.run(DIPIR, &["run"]).expect_success();
    let alone = project.read("out/composite/composite.exr");
    project.write("same_0001.png", photo);
    write_png(
        project.path("other_0002.png"),
        &DisplayImage(Raster::filled(36, 24, Vec3::new(0.1, 0.3, 0.9))),
    )
    .unwrap();
    let light = project.artifacts("out/light");
    let frames = ["same_0001.png", "other_0002.png"];
    let ran: Vec<Value> = shot(&project, &frames);
    assert_eq!(ran[0]["done"]["ran"], json!(["scene", "composite"]));
    // The light is that of the photograph, and stays.
    assert_eq!(project.artifacts("out/light"), light);
    assert!(!project.path("out/frames/other_0002/light").exists());
    // A frame that is the photograph gives its picture, and another one its own.
    let of = |name: &str| project.read(&format!("out/frames/{name}/composite/composite.exr"));
    assert_eq!(of("same_0001"), alone);
    assert_ne!(of("other_0002"), alone);
    for again in shot(&project, &frames) {
        assert_eq!(again["done"]["ran"], json!([]));
    }
    // Another light concerns every frame.
    let run = project.run(
        DIPIR,
        &[
            "shot",
            "--set",
            "light.sun.azimuth_deg=30",
            "--set",
            "light.sun.elevation_deg=30",
            "same_0001.png",
        ],
    );
    run.expect_success();
    assert_ne!(of("same_0001"), alone);
    // What is in the folder of frames and not ours stays.
    std::fs::create_dir(project.path("out/frames/empty")).unwrap();
    project.write("out/frames/notes.txt", "mine");
    // What a frame that was killed left goes.
    let begun = "out/frames/killed/.scene.partial";
    std::fs::create_dir_all(project.path(begun)).unwrap();
    let mark = r#"{"made_by":"dipir","schema":1,"kind":"unfinished","stage":"scene","files":[]}"#;
    project.write(&format!("{begun}/.dipir"), mark);
    project.run(DIPIR, &["clean"]).expect_success();
    assert_eq!(project.names("out/frames"), ["empty", "notes.txt"]);
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
    // What cannot be is said before anything runs.
    let refused = |args: &[&str], message: &str| {
        let run = project.run(DIPIR, &[&["shot"], args].concat());
        run.expect_error(2, &format!("error: {message}"));
    };
    refused(&["a.png", "gone.png"], "gone.png: there is no such file");
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
    // So has a glTF camera that moves: x is .5, .25 and -.5 at 1/24, 2/24 and 3/24 s.
    let keys: [f32; 12] = [1.0, 2.0, 3.0, 0.5, 1.5, 5.0, 0.25, 1.5, 5.0, -0.5, 1.5, 5.0];
    let keys = keys.iter().enumerate();
    let keys = keys.flat_map(|(i, k)| if i < 3 { k / 24.0 } else { *k }.to_le_bytes());
    let keys = BASE64_STANDARD_NO_PAD.encode(keys.collect::<Vec<u8>>());
    let accessor = |view: u32, kind: &str| json!({ "bufferView": view, "componentType": 5126, "type": kind, "count": 3 });
    let channel = json!({ "sampler": 0, "target": { "node": 1, "path": "translation" } });
    let moving = json!({
        "nodes": [{ "name": "still", "camera": 0 }, { "name": "tracked", "camera": 0 }],
        "cameras": [{ "perspective": { "yfov": 0.7 } }],
        "buffers": [{ "uri": format!("data:;base64,{keys}") }],
        "bufferViews": [{ "buffer": 0, "byteLength": 12 }, { "buffer": 0, "byteOffset": 12, "byteLength": 36 }],
        "accessors": [accessor(0, "SCALAR"), accessor(1, "VEC3")],
        "animations": [{ "samplers": [{ "input": 0, "output": 1 }], "channels": [channel] }],
    });
    project.write("shot.gltf", moving.to_string());
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
    with("transforms = \"transforms.json\"\ntransforms_up = \"y\"");
    refused(
        &["a.png"],
        "scene.camera.transforms names frames by number: write file in its place, which finds them by the names of their pictures",
    );
}

#[test]
fn a_movie_among_the_frames_is_told_before_anything_runs() {
    let project = project();
    project.write("a.png", project.read("background.png"));
    project.write("clip.mp4", b"\0\0\0\x18ftypisom");
    project.run(DIPIR, &["shot", "a.png", "clip.mp4"]).expect_error(
        1,
        "error: `clip.mp4` is a movie; expected a PNG, JPEG, OpenEXR or Radiance HDR image: write its frames, for instance \
         with `mkdir frames && ffmpeg -i \"clip.mp4\" frames/%04d.png`, and give one of them, or all to \
         `dipir shot frames/*.png`",
    );
    assert!(!project.path("out").exists());
}

#[test]
fn a_frame_that_fails_leaves_no_folder() {
    let project = project();
    project.write("a.png", project.read("background.png"));
    project.write("cut.png", &project.read("background.png")[..60]);
    let failed = |frames: &[&str]| {
        let run = project.run(DIPIR, &[&["shot", "--same-exposure"], frames].concat());
        assert_eq!(run.code, Some(1), "{}", run.stderr);
    };
    failed(&["cut.png"]);
    assert!(!project.path("out/frames").exists());
    let page = || String::from_utf8(project.read("out/report.html")).unwrap();
    assert!(page().contains("0 made; 1 failed: cut.png.<"));
    failed(&["cut.png", "a.png"]);
    assert_eq!(project.names("out/frames"), ["a"]);
    for part in [
        "<h2>Frames</h2>",
        "<a href=\"frames/a/composite/composite.png\">a</a>",
        "1 made; 1 failed: cut.png.",
    ] {
        assert!(page().contains(part), "{part}: {}", page());
    }
    let before = page();
    shot(&project, &["a.png"]);
    assert_eq!(page(), before, "nothing has changed");
    project.write("b c.png", project.read("a.png"));
    shot(&project, &["b c.png"]);
    let link = "<a href=\"frames/b%20c/composite/composite.png\">b c</a>";
    assert!(page().contains(link) && page().contains("2 made. "));
    let found = ["a", "b c", "exposures.json"];
    assert_eq!(project.names("out/frames"), found);
    // A folder that was there is not ours.
    std::fs::create_dir(project.path("out/frames/cut")).unwrap();
    failed(&["cut.png"]);
    assert_eq!(project.names("out/frames").len(), found.len() + 1);
    project.run(DIPIR, &["clean"]).expect_success();
    assert_eq!(project.names("out/frames"), ["cut"]);
}

#[test]
fn frames_are_exposed_as_their_exif_data_say() {
    let project = project();
    // Exposure time, f-number and ISO of a TIFF header with one directory.
    let exif = |seconds: [u32; 2]| {
        let mut bytes =
            b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0".to_vec();
        let entry = |tag: u16, kind: u16, value: u32| {
            let mut e = [tag.to_le_bytes(), kind.to_le_bytes()].concat();
            e.extend([1, 0, 0, 0]);
            e.extend(value.to_le_bytes());
            e
        };
        bytes.extend([3, 0]);
        bytes.extend(entry(0x829a, 5, 68));
        bytes.extend(entry(0x829d, 5, 76));
        bytes.extend(entry(0x8827, 3, 100));
        bytes.extend([0; 4]);
        for number in [seconds[0], seconds[1], 2, 1] {
            bytes.extend(number.to_le_bytes());
        }
        bytes
    };
    let jpeg = |name: &str, seconds, color| {
        let picture = image::RgbImage::from_pixel(36, 24, image::Rgb(color));
        let mut encoded = std::io::Cursor::new(vec![]);
        picture
            .write_to(&mut encoded, image::ImageFormat::Jpeg)
            .unwrap();
        let encoded = encoded.into_inner();
        let exif = exif(seconds);
        let length = u16::try_from(exif.len() + 2).unwrap().to_be_bytes();
        let all = [&encoded[..2], &[0xff, 0xe1], &length, &exif, &encoded[2..]];
        project.write(name, all.concat());
    };
    jpeg("photo.jpg", [1, 100], [90, 100, 110]);
    jpeg("longer.jpg", [1, 50], [90, 100, 110]);
    jpeg("same.jpg", [1, 100], [90, 100, 110]);
    jpeg("warm.jpg", [1, 100], [110, 100, 90]);
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "photo.jpg"));
    let stops = |name: &str| {
        let manifest = format!("out/frames/{name}/composite/stage.json");
        let value: Value = serde_json::from_slice(&project.read(&manifest)).unwrap();
        value["params"]["light"]["exposure_ev"].as_f64().unwrap()
    };
    shot(&project, &["longer.jpg", "same.jpg", "warm.jpg"]);
    assert_eq!(["longer", "same", "warm"].map(stops), [1.0, 0.0, 0.0]);
    // The white balance is that of the pictures all the same: 110 is .61 stops over 90, and a level of 8 bits is .03.
    let warm = project.read("out/frames/warm/composite/stage.json");
    let warm: Value = serde_json::from_slice(&warm).unwrap();
    let [red, green, blue]: [f64; 3] =
        serde_json::from_value(warm["params"]["light"]["tint"].clone()).unwrap();
    assert!(red > green && green > blue && red - blue > 1.0, "{warm}");
    shot(
        &project,
        &["longer.jpg", "--set", "composite.exposure_ev=0.5"],
    );
    assert_eq!(stops("longer"), 1.5);
    shot(&project, &["longer.jpg", "--same-exposure"]);
    assert_eq!(stops("longer"), 0.0);
}

#[test]
fn frames_without_exif_data_are_exposed_as_their_pictures_tell() {
    let project = project();
    // Ground and sky of many shades, taken by a camera that exposes each frame by itself.
    let shade = |n: usize| {
        let (x, y) = (n % 96, n / 96);
        0.08 + 0.2 * ((x / 6 * 37 + y / 6 * 101) % 17) as f32 / 17.0
    };
    let frame = |name: &str, stops: f32| {
        let value = |n: usize| {
            let light = shade(n) * stops.exp2();
            Vec3::splat(light / (1.0 + light))
        };
        let pixels = (0..96 * 64).map(value).collect();
        let image = LinearImage(Raster::from_pixels(96, 64, pixels));
        write_png(project.path(name), &Transfer::Srgb.encode(&image)).unwrap();
    };
    let exposures = [0.0, 0.5, 0.9, 1.4, 0.02];
    for (k, stops) in exposures.iter().enumerate() {
        frame(&format!("f_{k}.png"), *stops);
    }
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "f_0.png"));
    let stops = |k: usize| {
        let manifest = format!("out/frames/f_{k}/composite/stage.json");
        let value: Value = serde_json::from_slice(&project.read(&manifest)).unwrap();
        value["params"]["light"]["exposure_ev"].as_f64().unwrap()
    };
    let all = ["f_3.png", "f_1.png", "f_2.png", "f_4.png"];
    for done in shot(&project, &all) {
        assert_eq!(done["done"]["ran"], json!(["scene", "composite"]));
    }
    for k in 1..5 {
        // .05 stops do not count. Half a step of 8 bits is .02 stops in the darkest shade, and the mean of all is closer.
        let wanted = f64::from((exposures[k] - 0.05).max(0.0));
        assert!((stops(k) - wanted).abs() < 0.02, "{k}: {}", stops(k));
    }
    // What was measured is kept, and shown before anything runs.
    let kept = project.read("out/frames/exposures.json");
    for again in shot(&project, &all) {
        assert_eq!(again["done"]["ran"], json!([]));
    }
    let plan = project.run(DIPIR, &[&["shot", "--plan", "--json"], &all[..]].concat());
    let plan: Value = serde_json::from_str(&plan.stdout).unwrap();
    assert_eq!(plan["frames"]["run"], 0, "{plan}");
    assert_eq!(project.read("out/frames/exposures.json"), kept);
    // A picture of something else is as the frame before it, and a file of the user's with that name stays.
    project.write("out/frames/exposures.json", "mine");
    write_png(
        project.path("f_5.png"),
        &DisplayImage(Raster::filled(96, 64, Vec3::ONE)),
    )
    .unwrap();
    let run = project.run(DIPIR, &["shot", "f_1.png", "f_2.png", "f_5.png"]);
    run.expect_success();
    let warning = "f_5.png shows too little";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
    assert!((stops(5) - stops(2)).abs() < 1e-3);
    assert_eq!(project.read("out/frames/exposures.json"), b"mine");
    std::fs::remove_file(project.path("out/frames/exposures.json")).unwrap();
    shot(&project, &all);
    project.run(DIPIR, &["clean"]).expect_success();
    assert!(!project.path("out/frames").exists());
}

#[test]
fn frames_of_linear_light_are_exposed_alike() {
    let project = project();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "sky.exr"));
    project.write("b.exr", project.read("sky.exr"));
    let run = project.run(DIPIR, &["shot", "b.exr"]);
    run.expect_success();
    assert!(!run.stderr.contains("exposed"), "{}", run.stderr);
    let manifest = project.read("out/frames/b/composite/stage.json");
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["params"]["light"]["exposure_ev"], 0.0);
}

#[test]
fn a_shot_is_planned_before_it_runs() {
    let project = project();
    for name in ["a.png", "b.png"] {
        project.write(name, project.read("background.png"));
    }
    let plan = |frames: &[&str]| -> Value {
        let run = project.run(DIPIR, &[&["shot", "--plan", "--json"], frames].concat());
        run.expect_success();
        serde_json::from_str(&run.stdout).unwrap()
    };
    let first = plan(&["a.png", "b.png"]);
    assert_eq!(first["frames"]["run"], 2);
    assert_eq!(first["frames"]["seconds"], Value::Null);
    assert_eq!(first["plan"][1]["runs"], true, "{first}");
    assert!(!project.path("out").exists());
    shot(&project, &["a.png"]);
    let second = plan(&["a.png", "b.png"]);
    assert_eq!(second["frames"]["run"], 1);
    assert_eq!(plan(&["a.png", "b.png", "--force"])["frames"]["run"], 2);
    let seconds = |key: &str| second["frames"][key].as_f64().unwrap();
    assert!(seconds("seconds") > 0.0);
    assert_eq!(seconds("seconds"), seconds("seconds_each"));
    // Of other settings the light runs again, and then every frame.
    let draft = plan(&[
        "a.png",
        "b.png",
        "--draft",
        "--set",
        "light.sun.azimuth_deg=30",
    ]);
    assert_eq!(draft["frames"]["run"], 2);
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
    assert!(status.stdout.contains("1 in "), "{}", status.stdout);
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

#[test]
fn the_json_of_a_shot_tells_each_file_once() {
    let project = project();
    for name in ["a_0001.png", "b_0002.png"] {
        project.write(name, project.read("background.png"));
    }
    let run = project.run(DIPIR, &["shot", "--json", "a_0001.png", "b_0002.png"]);
    run.expect_success();
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    // What was done of the photograph, and where the page is.
    assert_eq!(value["photo"]["ran"], json!(["scene", "light"]));
    assert_eq!(value["report"], json!("out/report.html"));
    // A frame tells what was read for it, not for those before it.
    let of_first = "out/frames/a_0001/scene/scene.json";
    let hashed = |k: usize| value["runs"][k]["done"]["hashed"].as_object().unwrap();
    assert!(hashed(0).contains_key(of_first), "{:?}", hashed(0));
    assert!(!hashed(1).contains_key(of_first), "{:?}", hashed(1));
}

#[test]
fn one_shot_at_a_time_makes_the_frames_of_a_folder() {
    let project = project();
    let names = ["a.png", "b.png", "c.png"];
    for name in names {
        project.write(name, project.read("background.png"));
    }
    project
        .run(DIPIR, &["run", "--until", "light"])
        .expect_success();
    // Its frames are being made when it has begun the first.
    let args = [
        &["shot"],
        &names[..],
        &["--set", "composite.target_error=1e-9"],
    ]
    .concat();
    let args = [&args[..], &["--set", "composite.max_samples=4000000000"]].concat();
    let mut first = project.command(DIPIR, &args).spawn().unwrap();
    while !project.path("out/frames/a/.composite.partial").exists() {
        assert!(first.try_wait().unwrap().is_none(), "it did not start");
        std::thread::yield_now();
    }
    let held = format!(
        "out is being written by process {}; wait for it to end",
        first.id()
    );
    for other in [
        &["shot", "b.png"][..],
        &["run", "--set", "light.candidate=1"],
    ] {
        let run = project.run(DIPIR, other);
        assert_eq!(run.code, Some(1), "{other:?}");
        assert!(run.stderr.contains(&held), "{other:?}: {}", run.stderr);
    }
    assert!(!project.path("out/frames/b").exists());
    first.kill().unwrap();
    first.wait().unwrap();
    // Waits, if at all, for the stage of the one that was killed.
    assert_eq!(
        shot(&project, &["--wait", "a.png", "b.png", "c.png"]).len(),
        3
    );
}
