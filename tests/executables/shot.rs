//! Frames under one light.
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;
use serde_json::{Value, json};

use crate::project::*;

/// A project whose light is estimated.
fn project() -> Project {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let text = text.replace("environment = \"sky.exr\"\n", "");
    project.write("pipeline.toml", text);
    project
}

fn shot(project: &Project, frames: &[&str]) -> Vec<Value> {
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
        &DisplayImage(Raster::filled(24, 36, Vec3::new(0.1, 0.3, 0.9))),
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
    project.run(DIPIR, &["clean"]).expect_success();
    assert_eq!(project.names("out/frames"), ["empty", "notes.txt"]);
}

#[test]
fn every_frame_has_the_camera_of_its_name() {
    let project = project();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (head, tail) = text.split_once("[scene.camera]\n").unwrap();
    let (_, tail) = tail.split_once("[scene.proxy]").unwrap();
    let with = |camera: &str| {
        let text = format!("{head}[scene.camera]\n{camera}\n[scene.proxy]{tail}");
        project.write("pipeline.toml", text);
    };
    let photo = project.read("background.png");
    let frame = |name: &str, x: f64| {
        project.write(name, &photo);
        let matrix = [
            [1.0, 0.0, 0.0, x],
            [0.0, 1.0, 0.0, 1.5],
            [0.0, 0.0, 1.0, 5.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        json!({ "file_path": name, "transform_matrix": matrix })
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
    refused(
        &["a.png", "./a.png"],
        "./a.png: another frame has the same name",
    );
    refused(
        &["a.png", "--set", "scene.objects.0.at_pixel=[18, 16]"],
        "scene.objects[0].at_pixel is found anew in every frame, and the camera moves: write position and yaw_deg",
    );
    // Frames of .chan have numbers.
    let numbered = ["f_1.png", "f_02.png"];
    numbered.iter().for_each(|name| project.write(name, &photo));
    let cameras = "1 0.5 1.5 5 0 0 0 40\n2 -0.5 1.5 5 0 0 0 40\n";
    project.write("camera.chan", cameras);
    with("file = \"camera.chan\"\nframe = 1");
    shot(&project, &numbered);
    assert_eq!(["frames/f_1", "frames/f_02"].map(place), [0.5, -0.5]);
    refused(
        &["a.png"],
        "a.png: its name does not end in the number of a frame of .chan",
    );
    with("transforms = \"transforms.json\"\ntransforms_up = \"y\"");
    refused(
        &["a.png"],
        "scene.camera.transforms names frames by number: write file in its place, which finds them by the names of their pictures",
    );
}
