//! `dipir init`: from a photograph and a model to a configuration that runs.
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use serde_json::Value;

use crate::project::*;

const PHOTO: &str = "background.png";
const MODEL: &str = "object.obj";

#[test]
fn what_is_written_runs_as_it_is() {
    let project = Project::new();
    let init = project.run(DIPIR, &["init", PHOTO, MODEL, "--out", "first.toml"]);
    init.expect_success();
    for line in [
        "wrote first.toml",
        "dipir place first.toml",
        "dipir run first.toml --draft",
        "field of view: ",
    ] {
        assert!(init.stdout.contains(line), "{line}: {}", init.stdout);
    }
    let known = ["-p", "first.toml", "-s", "composite.environment=sky.exr"];
    project.run_both(&known);
    let scene: Value = serde_json::from_slice(&project.read("out-first/scene/scene.json")).unwrap();
    let rows = &scene["objects"][0]["transform"];
    // The ground is y = 0, and the tetrahedron keeps its own size.
    let [up, height] = [1, 3].map(|column| rows[1][column].as_f64().unwrap());
    assert!((up - 1.0).abs() < 1e-6 && height.abs() < 1e-6, "{rows}");
}

#[test]
fn a_file_that_is_there_is_never_overwritten() {
    let project = Project::new();
    let before = project.read("pipeline.toml");
    project.run(DIPIR, &["init", PHOTO, MODEL]).expect_error(
        2,
        "error: \"pipeline.toml\" is there already and stays as it is; name another file with --out",
    );
    assert_eq!(project.read("pipeline.toml"), before);
}

#[test]
fn what_is_asked_is_what_is_written() {
    let project = Project::new();
    let args = [
        "init",
        PHOTO,
        MODEL,
        MODEL,
        "--out",
        "first.toml",
        "--height-m",
        "0.5",
        "--class",
        "pyramid",
        "--fov",
        "60",
        "--pitch",
        "-12.5",
        "--eye-height",
        "2",
        "--json",
    ];
    let init = project.run(DIPIR, &args);
    init.expect_success();
    let json: Value = serde_json::from_str(&init.stdout).unwrap();
    assert_eq!(json["objects"].as_array().unwrap().len(), 2);
    assert_eq!(json["camera"]["position"][1], 2.0);
    let text = String::from_utf8(project.read("first.toml")).unwrap();
    for line in [
        "class = \"pyramid\"",
        "pitch_deg = -12.5",
        "height_m = 0.5",
        "[0.0, 2.0, 0.0]",
    ] {
        assert!(text.contains(line), "{line}: {text}");
    }
}

#[test]
fn a_camera_that_sees_no_ground_writes_nothing() {
    let project = Project::new();
    let args = ["init", PHOTO, MODEL, "--out", "first.toml", "--pitch", "60"];
    let init = project.run(DIPIR, &args);
    assert_eq!(init.code, Some(2), "{}", init.stderr);
    assert!(
        init.stderr.contains("the camera sees no ground"),
        "{}",
        init.stderr
    );
    assert!(!project.path("first.toml").exists());
}

#[test]
fn a_depth_map_gives_the_ground_and_objects_find_their_place() {
    let project = Project::new();
    // Level ground 1.6 m below a camera that looks down by 15 degrees, 60 degrees wide.
    let focal = 18.0 / 30f64.to_radians().tan();
    let (sin, cos) = 15f64.to_radians().sin_cos();
    let depth = |i: usize| {
        let y = ((i / 36) as f64 + 0.5 - 12.0) / focal;
        let descent = sin + y * cos;
        if descent > 0.05 {
            (1.6 / descent) as f32
        } else {
            0.0
        }
    };
    let depth = Raster::from_pixels(36, 24, (0..36 * 24).map(depth).collect());
    let mut layers = Layers::new(36, 24);
    layers.insert("Z", Precision::Full, depth).unwrap();
    layers.write_exr(project.path("depth.exr")).unwrap();
    let args = [
        "init",
        PHOTO,
        MODEL,
        "--out",
        "first.toml",
        "--pitch",
        "-15",
        "--fov",
        "60",
        "--height-m",
        "0.4",
        "--points",
        "depth.exr",
        "--place",
        "auto",
    ];
    let init = project.run(DIPIR, &args);
    init.expect_success();
    assert!(
        init.stdout.contains("ground: a plane, on which"),
        "{}",
        init.stdout
    );
    let known = ["-p", "first.toml", "-s", "composite.environment=sky.exr"];
    let scene = project.run(SCENE, &known);
    scene.expect_success();
    let scene: Value = serde_json::from_slice(&project.read("out-first/scene/scene.json")).unwrap();
    let ground = &scene["proxy"]["ground"];
    assert!(
        ground["point"][1].as_f64().unwrap().abs() < 1e-3,
        "{ground}"
    );
    let height = scene["objects"][0]["transform"][1][3].as_f64().unwrap();
    assert!(height.abs() < 1e-3, "{height}");
}
