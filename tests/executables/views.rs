//! Several photographs of one place.
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use glam::{Mat3, Vec2, Vec3};
use serde_json::Value;

use crate::project::*;

/// Half a step of 8 bits in display values is at most .0045 in light, in each of three channels.
const ROUNDING: f32 = 0.008;
/// A photograph of what is behind the camera: a yellow wall.
const WALL: Vec3 = Vec3::new(0.7, 0.6, 0.2);
const VIEW: &str = "\n[[scene.views]]\nbackground = \"behind.png\"\n";

/// A project that names no light, and another photograph.
fn project(view: &str) -> Project {
    let project = Project::new();
    wall(&project, WALL);
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let text = text.replace("environment = \"sky.exr\"\n", "");
    project.write("pipeline.toml", text + view);
    project
}

fn wall(project: &Project, colour: Vec3) {
    let grey = Raster::filled(24, 36, colour);
    write_png(project.path("behind.png"), &DisplayImage(grey)).unwrap();
}

/// The wall's light.
fn shown() -> Vec3 {
    Vec3::from_array(WALL.to_array().map(|v| Transfer::Srgb.decode_scalar(v)))
}

fn ran(project: &Project, args: &[&str]) -> Vec<String> {
    let run = project.run(DIPIR, &[&["run", "--json"], args].concat());
    run.expect_success();
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    let names = value["ran"].as_array().unwrap();
    names.iter().map(|n| n.as_str().unwrap().into()).collect()
}

fn json(project: &Project, name: &str) -> Value {
    serde_json::from_slice(&project.read(name)).unwrap()
}

/// What the light is from behind.
fn behind(project: &Project) -> Vec3 {
    let map = EnvironmentMap::read(project.path("out/light/surroundings.exr")).unwrap();
    map.eval(Vec3::Z)
}

#[test]
fn another_photograph_belongs_to_the_light_and_to_no_other_stage() {
    let project = project("");
    assert_eq!(ran(&project, &[]), ["scene", "light", "composite"]);
    let alone = json(&project, "out/light/estimate.json");
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let view = format!("{VIEW}exposure_stops = 0.0\ncamera = {{ heading_deg = 180.0 }}\n");
    project.write("pipeline.toml", text + &view);
    assert_eq!(ran(&project, &[]), ["light", "composite"]);
    assert!(ran(&project, &[]).is_empty());
    let both = json(&project, "out/light/estimate.json");
    assert!(both["base"] != alone["base"] && both["posterior"] != alone["posterior"]);
    assert_eq!(both["heading_rad"], alone["heading_rad"]);
    let seen = behind(&project);
    assert!(seen.distance(shown()) < ROUNDING, "{seen}");
    let inputs = json(&project, "out/light/stage.json")["inputs"].clone();
    let named = |i: &&Value| i["role"] == "view" && i["path"] == "behind.png";
    assert_eq!(inputs.as_array().unwrap().iter().filter(named).count(), 1);
    let page = String::from_utf8(project.read("out/report.html")).unwrap();
    assert!(page.contains("Estimated from 2 photographs"));
    // If the view's file changes, the light runs again, and only the stages that read the light.
    wall(&project, Vec3::splat(0.3));
    assert_eq!(ran(&project, &[]), ["light", "composite"]);
}

#[test]
fn a_photograph_of_unknown_exposure_tells_directions_alone() {
    let view = format!("{VIEW}camera = {{ heading_deg = 180.0 }}\n");
    let project = project(&view);
    let run = project.run(DIPIR, &["run", "-v"]);
    run.expect_success();
    let hint = "scene.views[0].background: nothing tells how it is exposed";
    assert!(run.stderr.contains(hint), "{}", run.stderr);
    let unknown = json(&project, "out/light/estimate.json");
    let seen = behind(&project);
    assert!(seen.distance(shown()) > 2.0 * ROUNDING, "{seen}");
    ran(&project, &["-s", "scene.views.0.exposure_stops=3"]);
    let exposed = json(&project, "out/light/estimate.json");
    assert_eq!(unknown["posterior"], exposed["posterior"]);
    assert!(unknown["exposure_stops"] != exposed["exposure_stops"]);
    // Three stops more than the scene's photograph: an eighth of what it shows.
    let seen = behind(&project);
    assert!(seen.distance(shown() / 8.0) < ROUNDING / 8.0, "{seen}");
}

#[test]
fn what_photographs_show_tells_how_they_are_exposed() {
    // The last shows nothing of the first: the one between them tells.
    let turned = [
        ("background.png", 0f32, 1f32),
        ("behind.png", 30.0, 0.25),
        ("far.png", 60.0, 0.5),
    ];
    let view = |(name, heading_deg, _): &(&str, f32, f32)| {
        format!(
            "\n[[scene.views]]\nbackground = \"{name}\"\ncamera = {{ heading_deg = {heading_deg:.1}, pitch_deg = -11.31 }}\n"
        )
    };
    // In another order.
    let project = project(&[view(&turned[2]), view(&turned[1])].concat());
    for (name, heading_deg, gain) in turned {
        let shade = |n: usize| {
            // 40 degrees high: the camera of the project.
            let at = Vec2::new((n % 96) as f32 + 0.5 - 48.0, 31.5 - (n / 96) as f32) / 32.0
                * 20f32.to_radians().tan();
            let turn = Mat3::from_rotation_y(-heading_deg.to_radians())
                * Mat3::from_rotation_x(-11.31f32.to_radians());
            let d = (turn * at.extend(-1.0)).normalize();
            let cell = |angle: f32| (angle.to_degrees() / 4.0).floor() as i32;
            let k = cell(d.x.atan2(-d.z)) * 37 + cell(d.y.asin()) * 101;
            0.1 + 0.4 * k.rem_euclid(17) as f32 / 17.0
        };
        let pixels = (0..96 * 64).map(|n| Vec3::splat(gain * shade(n))).collect();
        let image = LinearImage(Raster::from_pixels(96, 64, pixels));
        write_png(project.path(name), &Transfer::Srgb.encode(&image)).unwrap();
    }
    let run = project.run(DIPIR, &["run", "--until", "light", "-v"]);
    run.expect_success();
    for (view, stops) in [(0, -1.0f64), (1, -2.0)] {
        let head = format!("scene.views[{view}].background: exposed by ");
        let line = run.stderr.lines().find(|l| l.starts_with(&head));
        let told = line.unwrap_or_else(|| panic!("{}", run.stderr));
        let told: f64 = told[head.len()..]
            .split(' ')
            .next()
            .unwrap()
            .parse()
            .unwrap();
        // Half a step of 8 bits is .03 stops in the darkest shade, and two ratios are added up; means of many are closer.
        assert!((told - stops).abs() < 0.05, "{view}: {told}");
    }
}

#[test]
fn cameras_that_turn_together_turn_the_light_and_keep_the_estimate() {
    let light = |turn: i32| {
        let view = format!("{VIEW}camera = {{ heading_deg = {}.0 }}\n", 120 + turn);
        let project = project(&view);
        let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
        let looks = format!("pitch_deg = -11.0\nheading_deg = {turn}.0");
        let text = text.replace("look_at = [0.0, 0.4, 0.0]", &looks);
        project.write("pipeline.toml", text);
        project.run(SCENE, &[]).expect_success();
        project.run(OPTIMIZE, &[]).expect_success();
        json(&project, "out/light/estimate.json")
    };
    let (here, there) = (light(0), light(90));
    assert_eq!(here["words"], there["words"]);
    for key in ["azimuth_deg", "elevation_deg", "exposure_stops", "share"] {
        for end in ["low", "middle", "high"] {
            let [a, b] = [&here, &there].map(|e| e[key][end].as_f64().unwrap());
            assert!((a - b).abs() < 1e-2, "{key}.{end}: {a} {b}");
        }
    }
    let [a, b] = [&here, &there].map(|e| e["heading_rad"].as_f64().unwrap());
    assert!((b - a - std::f64::consts::FRAC_PI_2).abs() < 1e-5);
}

#[test]
fn views_that_cannot_be_used_are_refused_by_their_key() {
    let view = format!("{VIEW}camera = {{ heading_deg = 180.0 }}\n");
    let project = project(&view);
    project.run(SCENE, &[]).expect_success();
    for (set, code, parts) in [
        (
            "scene.views.0.background=gone.png",
            1,
            [
                "cannot use scene.views[0].background = \"gone.png\"",
                "gone.png",
            ],
        ),
        (
            "scene.views.0.background=object.obj",
            1,
            [
                "cannot use scene.views[0].background = \"object.obj\"",
                "PNG",
            ],
        ),
        (
            "scene.views.0.camera.pitch_deg=100",
            2,
            [
                "scene.views[0].camera.pitch_deg is 100",
                "degrees from -90 to 90",
            ],
        ),
        (
            "light.start=neutral",
            2,
            [
                "scene.views",
                "remove it, or set light.start = \"estimated\"",
            ],
        ),
    ] {
        let run = project.run(OPTIMIZE, &["-s", set]);
        assert_eq!(run.code, Some(code), "{set}: {}", run.stderr);
        for part in parts {
            assert!(run.stderr.contains(part), "{set}: {}", run.stderr);
        }
        assert!(!project.path("out/light").exists(), "{set}");
    }
}
