//! Light and tone recovered from a picture, from the photograph to the composite.
use std::process::Child;
use std::time::{Duration, Instant};

use dipir_imaging::file::{read_photo, write_png};
use dipir_imaging::layers::Layers;
use dipir_imaging::metrics::rmse;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_numerics::hashing::mix64;
use dipir_optimize::lighting::Lighting;
use dipir_pipeline::manifest::Manifest;
use glam::Vec3;
use serde_json::Value;

use crate::project::*;

const OPTIMIZE_TABLE: &str = r#"
[light]
guidance = "reference"
reference = "reference.exr"
iterations = 150
lobes = 12
environment = [32, 16]
samples = 64
preview_every = 120

[composite]
target_error = 0.02
"#;

/// Where the sun of `sun.exr` stands, 39 degrees above the horizon.
fn sun() -> Vec3 {
    EnvironmentMap::constant(32, 16, Vec3::ZERO).direction_of(4, 10)
}

/// A project without a light, and what the object looks like under one: `reference.exr`, path
/// traced under a sun and a sky.
fn project() -> Project {
    let project = Project::new();
    let mut texels = vec![Vec3::splat(0.25); 32 * 16];
    texels[4 * 32 + 10] = Vec3::splat(150.0);
    let sky = EnvironmentMap::new(32, 16, texels).unwrap();
    sky.write(project.path("sky.exr")).unwrap();
    project.run_both(&[
        "-o",
        "truth",
        "-s",
        "composite.tone=reinhard",
        "-s",
        "composite.target_error=0.005",
    ]);
    project.write(
        "reference.exr",
        project.read("truth/composite/composite.exr"),
    );
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (scene, _) = text.split_once("[composite]").unwrap();
    project.write("pipeline.toml", format!("{scene}{OPTIMIZE_TABLE}"));
    project
}

fn json(project: &Project, name: &str) -> Value {
    serde_json::from_slice(&project.read(name)).unwrap()
}

#[test]
fn light_is_recovered_from_a_picture_and_lights_the_composite() {
    let project = project();
    let thorough = ["-s", "light.iterations=500", "-s", "light.samples=256"];
    project.run(SCENE, &thorough).expect_success();
    assert!(project.path("out/scene/transport.safetensors").exists());
    let run = project.run(OPTIMIZE, &[&thorough[..], &["--json"]].concat());
    run.expect_success();
    assert_eq!(run.stderr, "");
    let done: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(
        (&done["iterations"], &done["resumed_at"]),
        (&500.into(), &0.into())
    );
    project.run(COMPOSITE, &[]).expect_success();

    // What was written, and that others can read it.
    let light = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
    assert_eq!((light.lobes.len(), light.exposure), (12, 1.0));
    let map = EnvironmentMap::read(project.path("out/light/environment.exr")).unwrap();
    assert_eq!((map.width(), map.height()), (32, 16));
    ToneCurves::read_json(project.path("out/light/tone.json")).unwrap();
    let history = json(&project, "out/light/history.json");
    let rows = history.as_array().unwrap();
    assert_eq!(rows.len(), 500);
    for key in [
        "loss",
        "guidance",
        "consistency",
        "regularizer",
        "gradient_norm",
    ] {
        assert!(rows[499][key].is_f64(), "{key}");
    }
    assert!(rows[0].get("t").is_some() && rows[0].get("seconds").is_none());
    let names: Vec<String> = project
        .artifacts("out/light")
        .into_iter()
        .map(|a| a.0)
        .collect();
    assert_eq!(
        names,
        [
            "environment.exr",
            "history.json",
            "lighting.json",
            "previews/000000.png",
            "previews/000120.png",
            "previews/000240.png",
            "previews/000360.png",
            "previews/000480.png",
            "previews/000500.png",
            "tone.json",
        ]
    );
    assert!(
        !project.path("out/light-checkpoints").exists(),
        "nothing is left of a run that ended"
    );
    let manifest = Manifest::read(&project.path("out/light"), "").unwrap();
    assert_eq!(manifest.damages(&project.path("out/light")).unwrap(), []);
    let seconds = |name: &str| manifest.timings_s[name];
    let parts = seconds("guidance") + seconds("records");
    assert!(seconds("guidance") > 0.0 && parts < seconds("optimization"));
    let composite = Manifest::read(&project.path("out/composite"), "").unwrap();
    let roles: Vec<&str> = composite.inputs.iter().map(|a| a.role.as_str()).collect();
    assert!(
        roles.contains(&"lighting") && roles.contains(&"tone"),
        "{roles:?}"
    );

    // And that it is the light.
    let peak = light.peak_direction().unwrap();
    let degrees = peak.angle_between(sun()).to_degrees();
    // Half a texel of the record's environment.
    assert!(degrees < 5.6, "{degrees} degrees from the sun");
    let picture = |name: &str| {
        read_photo(project.path(name), Transfer::Srgb)
            .unwrap()
            .image
    };
    let apart = |name: &str| {
        let (a, b) = (picture(name), picture("reference.exr"));
        rmse(&Transfer::Srgb.encode(&a).0, &Transfer::Srgb.encode(&b).0)
    };
    let (found, before) = (
        apart("out/composite/composite.png"),
        apart("background.png"),
    );
    // The path tracer stops at .02, so what it leaves is noise for the most part.
    assert!(
        found < 0.02 && before > 0.035,
        "{found}, {before} without the object"
    );
}

#[test]
fn a_scene_without_a_record_is_recorded_when_light_is_recovered() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &[]).expect_success();
    let elsewhere = ["-o", "known"];
    let known = ["--set", "composite.environment=sky.exr"];
    let run = project.run(SCENE, &[&elsewhere[..], &known].concat());
    run.expect_success();
    assert!(!project.path("known/scene/transport.safetensors").exists());
    assert!(
        run.stdout
            .contains("light transport: not recorded, for no light is optimised"),
        "{}",
        run.stdout
    );
    project.run(OPTIMIZE, &elsewhere).expect_success();
    assert!(project.artifacts("out/light") == project.artifacts("known/light"));
}

/// Starts a long recovery and waits until its checkpoint has been replaced `changes` times.
fn start_and_wait(project: &Project, args: &[&str], changes: u32) -> Child {
    let mut child = project.command(OPTIMIZE, args).spawn().unwrap();
    let deadline = Instant::now() + Duration::from_secs(60);
    let (mut seen, mut last) = (0, None);
    while seen < changes {
        let ended = child.try_wait().unwrap();
        assert!(
            ended.is_none() && Instant::now() < deadline,
            "no checkpoint: {ended:?}"
        );
        let now = checkpoint_time(project);
        if now.is_some() && now != last {
            (seen, last) = (seen + 1, now);
        }
        std::thread::yield_now();
    }
    child
}

fn checkpoint_time(project: &Project) -> Option<std::time::SystemTime> {
    let folder = std::fs::read_dir(project.path("out/light-checkpoints")).ok()?;
    let run = folder.filter_map(Result::ok).next()?;
    let file = run.path().join("checkpoint.safetensors");
    file.metadata().and_then(|m| m.modified()).ok()
}

#[test]
fn killed_at_a_random_iteration_and_run_again_the_light_is_the_same_bytes() {
    let project = project();
    let long = [
        "--set",
        "light.iterations=400",
        "--set",
        "light.checkpoint_every=7",
    ];
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &long).expect_success();
    let whole = project.artifacts("out/light");
    std::fs::remove_dir_all(project.path("out/light")).unwrap();
    for k in 0..2 {
        let changes = 1 + (mix64(k) % 20) as u32;
        let mut child = start_and_wait(&project, &long, changes);
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(
            !project.path("out/light/stage.json").exists(),
            "killed before its end"
        );
        let run = project.run(OPTIMIZE, &[&long[..], &["--json"]].concat());
        run.expect_success();
        let done: Value = serde_json::from_str(&run.stdout).unwrap();
        assert!(done["resumed_at"].as_u64().unwrap() >= 7, "{done}");
        assert!(
            project.artifacts("out/light") == whole,
            "killed after checkpoint {changes}"
        );
        std::fs::remove_dir_all(project.path("out/light")).unwrap();
    }
}

#[test]
fn a_damaged_checkpoint_is_told_and_the_run_starts_from_the_beginning() {
    let project = project();
    let long = [
        "--set",
        "light.iterations=400",
        "--set",
        "light.checkpoint_every=7",
    ];
    project.run(SCENE, &[]).expect_success();
    let mut child = start_and_wait(&project, &long, 1);
    child.kill().unwrap();
    child.wait().unwrap();
    let folder = std::fs::read_dir(project.path("out/light-checkpoints")).unwrap();
    let run = folder.map(|e| e.unwrap().path()).next().unwrap();
    std::fs::write(run.join("checkpoint.safetensors"), "torn").unwrap();
    let run = project.run(OPTIMIZE, &[&long[..], &["--json"]].concat());
    run.expect_success();
    assert!(
        run.stderr.starts_with("warning: `out/light-checkpoints/")
            && run
                .stderr
                .trim_end()
                .ends_with("starting from the beginning"),
        "{}",
        run.stderr
    );
    let done: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(done["resumed_at"], 0);
}

#[track_caller]
fn optimize_fails(project: &Project, set: &[&str], code: i32, message: &str) {
    let args: Vec<&str> = set.iter().flat_map(|s| ["--set", s]).collect();
    project.run(OPTIMIZE, &args).expect_error(code, message);
    assert!(!project.path("out/light").exists(), "nothing was written");
}

#[test]
fn what_cannot_be_optimised_is_refused_with_the_way_out() {
    let project = project();
    optimize_fails(
        &project,
        &["light.guidance=magic"],
        2,
        "error: --set light.guidance=magic: light.guidance is \"magic\", accepted: \"auto\", \
         \"none\", \"lds\", \"sds\", \"csd\", \"sdedit\", \"reference\"",
    );
    optimize_fails(
        &project,
        &["light.lobes=0"],
        2,
        "error: --set light.lobes=0: light.lobes: 0 is out of range; accepted: 1 to 1024",
    );
    optimize_fails(
        &project,
        &[],
        1,
        "error: out/scene/stage.json is missing: run dipir-scene first",
    );
    project.run(SCENE, &[]).expect_success();
    let small = dipir_imaging::raster::Raster::filled(3, 2, Vec3::splat(0.5));
    let small = dipir_imaging::raster::DisplayImage(small);
    dipir_imaging::file::write_png(project.path("small.png"), &small).unwrap();
    optimize_fails(
        &project,
        &["light.reference=small.png"],
        2,
        "error: --set light.reference=small.png: light.reference: \"small.png\" has 3 x 2 \
         pixels; accepted: a picture of the photograph's size, 36 x 24",
    );
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write(
        "pipeline.toml",
        text.replace("reference = \"reference.exr\"\n", ""),
    );
    optimize_fails(
        &project,
        &[],
        2,
        "error: pipeline.toml:18: light.reference: is missing: name the picture that the \
         composite should equal, as in reference = \"image.exr\"",
    );
    project.run(COMPOSITE, &[]).expect_error(
        1,
        "error: there is no light: [composite] environment is not set and out/light/lighting.json \
         is missing; name a map, as in --set composite.environment=sky.hdr, or run dipir-light \
         first",
    );
}

#[test]
fn light_that_was_recovered_for_another_scene_is_warned_of() {
    let project = project();
    let turned = ["--set", "scene.objects.0.yaw_deg=90"];
    for executable in [SCENE, OPTIMIZE] {
        project.run(executable, &[]).expect_success();
    }
    project.run(SCENE, &turned).expect_success();
    let run = project.run(COMPOSITE, &turned);
    run.expect_success();
    assert_eq!(
        run.stderr.trim_end(),
        "warning: the light was recovered for another set-up of the scene; run dipir-light again \
         to recover it for this one"
    );
}

#[test]
fn a_material_is_recovered_under_a_known_light_and_used_by_the_composite() {
    let project = Project::new();
    let object = format!("mtllib object.mtl\nusemtl paint\n{OBJECT}");
    project.write("object.obj", object);
    let paint = |color: &str| project.write("object.mtl", format!("newmtl paint\nKd {color}\n"));
    paint("0.6 0.3 0.1");
    let thorough = ["-s", "composite.target_error=0.005"];
    project.run_both(&[&["-o", "truth"][..], &thorough].concat());
    project.write(
        "reference.exr",
        project.read("truth/composite/composite.exr"),
    );
    paint("0.5 0.5 0.5");
    let table = "\n[light]\nguidance = \"reference\"\nreference = \"reference.exr\"\n\
                 materials = [\"paint\"]\niterations = 150\n";
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text + table);
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &[]).expect_success();
    let found = &json(&project, "out/light/materials.json")[0];
    assert_eq!(found["name"], "paint");
    project.run(COMPOSITE, &thorough).expect_success();
    let picture = |name: &str| read_photo(project.path(name), Transfer::Linear).unwrap();
    let [truth, composite] = ["truth", "out"]
        .map(|o| picture(&format!("{o}/composite/composite.png")))
        .map(|p| p.image);
    let apart = rmse(&truth.0, &composite.0);
    // Both pictures stop at .005; grey instead of paint is ten times that.
    assert!(apart < 0.012, "{apart} with {found}");

    project
        .run(OPTIMIZE, &["-s", r#"light.materials=["pant"]"#])
        .expect_error(
            2,
            "error: --set light.materials=[\"pant\"]: light.materials: the scene has no material \"pant\"; it has: \"paint\"",
        );
}

/// A painted tetrahedron under a known light whose material is asked for.
fn painted() -> Project {
    let project = Project::new();
    let object = format!("mtllib object.mtl\nusemtl paint\n{OBJECT}");
    project.write("object.obj", object);
    project.write("object.mtl", "newmtl paint\nKd 0.6 0.3 0.1\n");
    project.run_both(&["-o", "truth"]);
    project.write(
        "reference.exr",
        project.read("truth/composite/composite.exr"),
    );
    project.write("object.mtl", "newmtl paint\nKd 0.5 0.5 0.5\n");
    let table = "\n[light]\nguidance = \"reference\"\nreference = \"reference.exr\"\n\
                 materials = [\"paint\"]\niterations = 60\ncheckpoint_every = 5\n";
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text + table);
    project
}

#[test]
fn killed_and_run_again_the_material_is_the_same_bytes() {
    let project = painted();
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &[]).expect_success();
    let whole = project.artifacts("out/light");
    std::fs::remove_dir_all(project.path("out/light")).unwrap();
    let mut child = start_and_wait(&project, &[], 2);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!project.path("out/light/stage.json").exists());
    let run = project.run(OPTIMIZE, &["--json"]);
    run.expect_success();
    let done: Value = serde_json::from_str(&run.stdout).unwrap();
    assert!(done["resumed_at"].as_u64().unwrap() >= 5, "{done}");
    assert!(project.artifacts("out/light") == whole);
    assert!(!project.path("out/light-checkpoints").exists());
}

#[test]
fn tone_curves_alone_are_recovered_under_a_light_that_is_kept() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &[]).expect_success();
    let kept = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
    project.write("kept.json", project.read("out/light/lighting.json"));
    // The object is wanted lighter: its values to the power of .8, the ground as it is.
    let picture = read_photo(project.path("reference.exr"), Transfer::Srgb).unwrap();
    let shown = Transfer::Srgb.encode(&picture.image).0;
    let layers = Layers::read_exr(project.path("truth/composite/composite.exr")).unwrap();
    let coverage = layers.channel("object.A").unwrap().pixels();
    let lifted = shown.pixels().iter().zip(coverage);
    let lifted = lifted.map(|(v, a)| v.lerp(v.powf(0.8), *a)).collect();
    let lifted = Raster::from_pixels(shown.width(), shown.height(), lifted);
    write_png(project.path("lifted.png"), &DisplayImage(lifted)).unwrap();
    let arguments = [
        "-s",
        "light.recover_light=false",
        "-s",
        "light.start=kept.json",
        "-s",
        "light.reference=lifted.png",
        "-s",
        "light.learning_rates.tone=0.02",
        "--json",
    ];
    let run = project.run(OPTIMIZE, &arguments);
    run.expect_success();
    let done: Value = serde_json::from_str(&run.stdout).unwrap();
    let number = |key: &str| done[key].as_f64().unwrap();
    assert!(
        number("guidance_at_end") < 0.7 * number("guidance_at_start"),
        "{done}"
    );
    let light = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
    assert_eq!(light.lobes.len(), kept.lobes.len());
    for (a, b) in light.lobes.iter().zip(&kept.lobes) {
        // Through logarithms in f64 and back, and a gain of 1 to a few roundings.
        assert!(a.direction.distance(b.direction) < 1e-6);
        assert!((a.radiance - b.radiance).abs().max_element() <= 1e-5 * b.radiance.max_element());
        assert!((a.sigma / b.sigma - 1.0).abs() < 1e-6);
    }
    let tone = ToneCurves::read_json(project.path("out/light/tone.json")).unwrap();
    // Lifted: the object's curve rises above the diagonal.
    assert!(tone.foreground.eval(0.3) > 0.32, "{tone:?}");

    let run = project.run(OPTIMIZE, &["-s", "light.start=none.json"]);
    assert_eq!(run.code, Some(1));
    let message = "cannot use light.start = \"none.json\"";
    assert!(run.stderr.contains(message), "{}", run.stderr);
}
