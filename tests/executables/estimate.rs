//! Light estimated from the photograph alone: what happens where a configuration names none.
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use dipir_light::environment::EnvironmentMap;
use dipir_optimize::lighting::Lighting;
use glam::Vec3;
use serde_json::{Value, json};

use crate::project::*;

/// A project that names no light.
fn project() -> Project {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write(
        "pipeline.toml",
        text.replace("environment = \"sky.exr\"\n", ""),
    );
    project
}

fn lit(project: &Project, args: &[&str]) -> Value {
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, args).expect_success();
    serde_json::from_slice(&project.read("out/light/estimate.json")).unwrap()
}

#[test]
fn a_photograph_without_a_light_asks_no_model_and_records_nothing() {
    let project = project();
    let run = project.run(DIPIR, &["run", "--json"]);
    run.expect_success();
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(value["ran"], json!(["scene", "light", "composite"]));
    assert!(!project.path("out/scene/transport.safetensors").exists());
    for name in [
        "estimate.json",
        "candidates.json",
        "candidates.png",
        "surroundings.exr",
        "environment.exr",
        "tone.json",
    ] {
        assert!(project.path("out/light").join(name).is_file(), "{name}");
    }
    let page = String::from_utf8(project.read("out/report.html")).unwrap();
    assert!(!page.contains("Not shown"));
    for part in [
        "Estimated from the photograph: most light from",
        "degrees high",
        "to the right of the view",
        "as bright as the photograph&#39;s mean",
        "of all light",
        "--set light.candidate=8",
    ] {
        assert!(page.contains(part), "{part}");
    }
    // The numbers are those of the file.
    let estimate: Value = serde_json::from_slice(&project.read("out/light/estimate.json")).unwrap();
    let end = |key: &str, end: &str| estimate[key][end].as_f64().unwrap();
    let interval = |key: &str, show: &dyn Fn(f64) -> String| {
        format!("{} to {}", show(end(key, "low")), show(end(key, "high")))
    };
    let degrees = |deg: f64| format!("{deg:.0}°");
    for text in [
        interval("azimuth_deg", &degrees),
        interval("elevation_deg", &degrees),
        interval("exposure_stops", &|stops| format!("{stops:+.1} stops")),
        interval("share", &|share| format!("{:.0}%", 100.0 * share)),
    ] {
        assert!(page.contains(&text), "{text}");
    }
}

#[test]
fn the_report_says_which_candidate_is_used() {
    let project = project();
    let run = project.run(DIPIR, &["run", "-s", "light.candidate=2"]);
    run.expect_success();
    let candidates: Value =
        serde_json::from_slice(&project.read("out/light/candidates.json")).unwrap();
    let used = candidates[1]["words"].as_str().unwrap();
    assert!(
        run.stdout.contains(&format!("\n  candidate 2: {used}\n")),
        "{}",
        run.stdout
    );
    // The estimate alone says where most light comes from.
    assert_eq!(
        run.stdout.matches("most light").count(),
        1,
        "{}",
        run.stdout
    );
    let page = String::from_utf8(project.read("out/report.html")).unwrap();
    assert!(page.contains(">used</td>"));
    let offers = |n: usize| page.contains(&format!("<code>--set light.candidate={n}</code>"));
    assert!(offers(1) && !offers(2) && offers(3));
}

#[test]
fn neutral_light_that_nothing_guides_runs_again_for_another_map() {
    let project = project();
    let ran = |sets: &[&str]| {
        let mut args = vec!["run", "--until", "light", "--json"];
        for set in ["light.start=neutral", "light.guidance=none"]
            .iter()
            .chain(sets)
        {
            args.extend(["-s", set]);
        }
        let run = project.run(DIPIR, &args);
        run.expect_success();
        serde_json::from_str::<Value>(&run.stdout).unwrap()["ran"].clone()
    };
    assert_eq!(ran(&[]), json!(["scene", "light"]));
    assert_eq!(ran(&[]), json!([]));
    for set in ["light.environment=[32,16]", "light.size=48"] {
        assert_eq!(ran(&[set]), json!(["light"]), "{set}");
        assert_eq!(ran(&[set]), json!([]), "{set}");
    }
}

#[test]
fn the_estimate_depends_on_photograph_and_camera_alone() {
    let project = project();
    lit(&project, &[]);
    let first = project.read("out/light/estimate.json");
    project.write("object.obj", OBJECT.replace("1.1", "0.4"));
    lit(
        &project,
        &["-s", "pipeline.seed=7", "-s", "pipeline.quality=high"],
    );
    assert!(project.read("out/light/estimate.json") == first);
    lit(
        &project,
        &["-s", "scene.class=car", "-s", "pipeline.threads=1"],
    );
    assert!(project.read("out/light/estimate.json") == first);
}

#[test]
fn a_preview_keeps_the_recovered_light_while_objects_are_moved() {
    let project = project();
    lit(&project, &[]);
    let light = |set: &str| {
        let run = project.run(DIPIR, &["preview", "-o", "look.png", "--set", set]);
        run.expect_success();
        let (_, light) = run.stdout.trim().split_once("light: ").unwrap();
        light.to_string()
    };
    let recovered = "as the light stage left it";
    assert_eq!(light("scene.objects.0.yaw_deg=20"), recovered);
    assert_eq!(light("composite.exposure_ev=1"), recovered);
    // Of another camera or another sun it tells nothing.
    for other in ["scene.camera.fov_deg=41", "light.candidate=1"] {
        assert_ne!(light(other), recovered, "{other}");
    }
}

#[test]
fn a_sun_that_is_known_becomes_a_source_where_it_is() {
    let project = project();
    let sun =
        "light.sun={azimuth_deg = 60.0, elevation_deg = 40.0, sure_deg = 1.0, size_deg = 0.27}";
    lit(&project, &["-s", sun]);
    let light = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
    assert_eq!(light.sources, 1);
    // The camera looks along -z, slightly down: 60 degrees to the right of it and 40 up.
    let (azimuth, elevation) = (60f32.to_radians(), 40f32.to_radians());
    let wanted = glam::Vec3::new(
        azimuth.sin() * elevation.cos(),
        elevation.sin(),
        -azimuth.cos() * elevation.cos(),
    );
    let apart = light.lobes[0].direction.angle_between(wanted).to_degrees();
    assert!(apart < 0.1, "{apart} degrees");
    let map = EnvironmentMap::read(project.path("out/light/environment.exr")).unwrap();
    assert!(map.peak().0.angle_between(wanted).to_degrees() < 1.0);
    project.run(COMPOSITE, &[]).expect_success();
}

#[test]
fn a_sun_below_the_horizon_is_warned_of() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    let sun = "light.sun={azimuth_deg = 60.0, elevation_deg = -40.0}";
    let run = project.run(OPTIMIZE, &["-s", sun]);
    run.expect_success();
    let warning = "the sun is 40 degrees below the horizon";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
}

#[test]
fn a_start_that_cannot_be_used_is_refused_at_once() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    let lobe = r#"{"direction": [0, 1, 0], "radiance": [1, 1, 1], "sigma": 10}"#;
    let many = vec![lobe; 5000].join(",");
    project.write("many.json", format!("{{\"lobes\": [{many}]}}"));
    // A device that ends at once: if it were read, it would be empty.
    for (start, code, part) in [
        ("many.json", 2, "holds 5000 lobes"),
        ("/dev/null", 1, "not a regular file"),
    ] {
        let run = project.run(OPTIMIZE, &["-s", &format!("light.start={start}")]);
        assert_eq!(run.code, Some(code), "{}", run.stderr);
        assert!(run.stderr.contains(part), "{}", run.stderr);
    }
}

#[test]
fn candidates_are_chosen_by_number_and_one_that_is_not_there_is_refused() {
    let project = project();
    lit(&project, &[]);
    let mean = project.read("out/light/lighting.json");
    lit(&project, &["-s", "light.candidate=2"]);
    assert!(project.read("out/light/lighting.json") != mean);
    let run = project.run(OPTIMIZE, &["-s", "light.candidate=9"]);
    assert_eq!(run.code, Some(2));
    assert!(run.stderr.contains("accepted: 1 to 8"), "{}", run.stderr);
}

#[test]
fn what_only_an_estimate_uses_is_refused_where_nothing_is_estimated() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    let sun = "light.sun={azimuth_deg = 60.0, elevation_deg = 40.0}";
    let shadow = "light.shadow={foot = [4.0, 6.0], tip = [6.0, 5.0], height_m = 1.0}";
    for (start, set, key) in [
        ("light.start=neutral", sun, "light.sun"),
        ("light.start=mine.json", shadow, "light.shadow"),
        (
            "light.start=encoder",
            "light.candidate=2",
            "light.candidate",
        ),
    ] {
        let run = project.run(OPTIMIZE, &["-s", start, "-s", set]);
        assert_eq!(run.code, Some(2), "{key}: {}", run.stderr);
        for part in [key, "remove it, or set light.start = \"estimated\""] {
            assert!(run.stderr.contains(part), "{key}: {}", run.stderr);
        }
        assert!(!project.path("out/light").exists(), "{key}");
    }
}

#[test]
fn what_only_an_estimate_uses_is_warned_of_where_a_map_gives_the_light() {
    let project = Project::new();
    let sun = "light.sun={azimuth_deg = 60.0, elevation_deg = 40.0}";
    let args = ["-s", sun, "-s", "light.candidate=2"];
    project.run(SCENE, &args).expect_success();
    let run = project.run(COMPOSITE, &args);
    run.expect_success();
    let warning = "composite.environment gives the light, so that light.sun, light.candidate changes \
                   nothing; remove one of them";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
    let run = project.run(COMPOSITE, &[]);
    assert!(!run.stderr.contains("warning"), "{}", run.stderr);
}

#[test]
fn what_the_photograph_shows_is_in_the_map_unless_it_is_turned_off() {
    let project = project();
    lit(&project, &[]);
    let ahead = |project: &Project| {
        let map = EnvironmentMap::read(project.path("out/light/environment.exr")).unwrap();
        map.eval(glam::Vec3::NEG_Z)
    };
    let with = ahead(&project);
    lit(&project, &["-s", "light.visible=false"]);
    let without = ahead(&project);
    // The horizon lies above the middle: display values of .55, about .54, .55, decoded.
    let seen = glam::Vec3::new(0.263, 0.255, 0.263);
    assert!(with.distance(seen) < 0.02, "{with}");
    assert!(without.distance(seen) > 0.05, "{without}");
}

#[test]
fn a_lighting_of_lobes_alone_written_by_hand_is_enough() {
    let project = project();
    project.write(
        "mine.json",
        r#"{"lobes": [{"direction": [0, 1, 0], "radiance": [1, 1, 1], "sigma": 10}]}"#,
    );
    project.run(SCENE, &[]).expect_success();
    project
        .run(OPTIMIZE, &["-s", "light.start=mine.json"])
        .expect_success();
    let light = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
    assert_eq!((light.lobes.len(), light.exposure), (1, 1.0));
    project.run(COMPOSITE, &[]).expect_success();
}

#[test]
fn a_plate_of_linear_light_is_lit_at_its_own_exposure() {
    let project = project();
    let picture = |gain: f32| {
        let value = |n: usize| Vec3::new(0.1, 0.15, 0.2) * (gain * (0.2 + n as f32 / 432.0));
        let pixels = (0..36 * 24).map(value).collect();
        let mut plate = Layers::new(36, 24);
        let colour = Raster::from_pixels(36, 24, pixels);
        plate.insert_rgb("", Precision::Full, &colour).unwrap();
        plate.write_exr(project.path("plate.exr")).unwrap();
        let set = ["--set", "scene.background=plate.exr", "--set"];
        let samples = "composite.max_samples=64";
        project
            .run(DIPIR, &[&["run"], &set[..], &[samples]].concat())
            .expect_success();
        let made = Layers::read_exr(project.path("out/composite/composite.exr")).unwrap();
        made.rgb("object").unwrap()
    };
    let (dim, bright) = (picture(0.0625), picture(16.0));
    let most = |object: &Raster<Vec3>| {
        let values = object.pixels().iter().map(|p| p.max_element());
        values.fold(0.0, f32::max)
    };
    // No curve holds it below white.
    assert!(most(&bright) > 1.0, "{}", most(&bright));
    for (dim, bright) in dim.pixels().iter().zip(bright.pixels()) {
        // Layers have half precision.
        let off = (*bright - 256.0 * *dim).abs().max_element();
        assert!(off < 0.01 * bright.max_element() + 1e-3, "{dim} {bright}");
    }
}

#[test]
fn keys_of_guidance_that_is_off_are_named_once() {
    let project = project();
    let warning = "warning: light.reference, light.iterations change nothing, for nothing guides the light: \
                   light.guidance = \"reference\" switches guidance on\n";
    let set = [
        "--set",
        "light.reference=a.exr",
        "--set",
        "light.iterations=9",
    ];
    for _ in 0..2 {
        let run = project.run(DIPIR, &[&["run"], &set[..]].concat());
        run.expect_success();
        assert_eq!(run.stderr.matches(warning).count(), 1, "{}", run.stderr);
    }
    let run = project.run(OPTIMIZE, &["--set", "light.prompt=noon"]);
    let warning = "warning: light.prompt changes nothing, for nothing guides the light: light.guidance = \"lds\" switches";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
    for silent in [
        &["--set", "light.iterations=0"][..],
        &["--set", "light.start=neutral"],
    ] {
        let run = project.run(DIPIR, &[&["run"], silent].concat());
        run.expect_success();
        assert!(!run.stderr.contains("warning"), "{}", run.stderr);
    }
    // Neutral light comes from no side.
    let run = project.run(OPTIMIZE, &["--set", "light.start=neutral"]);
    assert!(
        run.stdout
            .contains("\n  it is neutral, nearly alike from all sides\n"),
        "{}",
        run.stdout
    );
}

#[test]
fn a_time_without_its_offset_says_which_is_assumed() {
    let project = project();
    project.run(SCENE, &[]).expect_success();
    let told = |time: &str| {
        let sun =
            format!("light.sun={{time=\"{time}\",latitude=48.1,longitude=11.6,heading_deg=0.0}}");
        let run = project.run(OPTIMIZE, &["--set", &sun]);
        run.expect_success();
        run.stderr
    };
    let warning = told("2026-06-21T12:34:56");
    let said = "light.sun.time has no offset of its zone, and +01:00 is assumed by the longitude, which may be an hour off, \
                as with summer time: write it, as in \"2026-06-21T12:34:56+01:00\"";
    assert!(warning.contains(said), "{warning}");
    let with_offset = told("2026-06-21T12:34:56+02:00");
    assert!(!with_offset.contains("offset"), "{with_offset}");
}
