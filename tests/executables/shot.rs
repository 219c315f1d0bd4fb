//! Frames under one light.
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
    let jpeg = |name: &str, seconds, color| {
        let exif = [(EXPOSURE_TIME, seconds), (F_NUMBER, [2, 1])];
        project.write_jpeg(name, color, &exif);
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
    // What objects emit is exposed as long.
    let emission = |name: &str| {
        let manifest = project.read(&format!("out/frames/{name}/composite/stage.json"));
        let value: Value = serde_json::from_slice(&manifest).unwrap();
        value["params"]["emission"].clone()
    };
    assert_eq!(emission("longer"), json!({"ev": 1.0, "tint": null}));
    assert_eq!(emission("same"), Value::Null);
    assert!(emission("warm")["tint"][0].as_f64() > Some(0.0));
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
fn a_frame_alone_is_exposed_as_in_its_shot_which_is_not_measured_again() {
    let project = project();
    // Of twelve columns of shades each frame shows seven, the others are too bright: the last one has one of the photograph's.
    let frame = |name: &str, first: usize, stops: f32| {
        let value = |n: usize| {
            let (x, y) = (n % 96 / 8, n / 96 / 8);
            let light = (0.08 + 0.2 * ((x * 37 + y * 101) % 17) as f32 / 17.0) * stops.exp2();
            Vec3::splat(match (first..first + 7).contains(&x) {
                true => light / (1.0 + light),
                false => 1.0,
            })
        };
        let pixels = (0..96 * 64).map(value).collect();
        let image = LinearImage(Raster::from_pixels(96, 64, pixels));
        write_png(project.path(name), &Transfer::Srgb.encode(&image)).unwrap();
    };
    for (k, (first, stops)) in [(0, 0.0), (3, 0.3), (6, 0.8)].into_iter().enumerate() {
        frame(&format!("f_{k}.png"), first, stops);
    }
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "f_0.png"));
    let stops = |out: &str| {
        let manifest = project.read(&format!("{out}/frames/f_2/composite/stage.json"));
        let value: Value = serde_json::from_slice(&manifest).unwrap();
        value["params"]["light"]["exposure_ev"].as_f64().unwrap()
    };
    // Alone it is exposed as the photograph; what is told of it beside others takes the place of that.
    shot(&project, &["f_2.png"]);
    assert_eq!(stops("out"), 0.0);
    shot(&project, &["f_1.png", "f_2.png"]);
    let told = stops("out");
    assert!((told - 0.75).abs() < 0.04, "{told}");
    let kept = project.read("out/frames/exposures.json");
    for frames in [&["f_2.png"][..], &["f_1.png", "f_2.png"]] {
        for again in shot(&project, frames) {
            assert_eq!(again["done"]["ran"], json!([]), "{frames:?}");
        }
        assert_eq!(project.read("out/frames/exposures.json"), kept);
    }
    // So it is in another folder with what was kept.
    std::fs::create_dir_all(project.path("other/frames")).unwrap();
    project.write("other/frames/exposures.json", &kept);
    shot(&project, &["f_2.png", "--out", "other"]);
    assert_eq!(stops("other"), told);
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
