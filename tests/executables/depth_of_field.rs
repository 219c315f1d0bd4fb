//! Objects out of focus.
use serde_json::Value;

use crate::project::*;

/// A lens so wide that the object, four metres away, is a disc of pixels.
const WIDE: &str = "composite.aperture_mm=400";

#[test]
fn what_is_out_of_focus_is_soft_and_takes_the_composite_alone() {
    let project = Project::new();
    project.run_both(&[]);
    let (sharp, look) = project.edges_and_look("out");
    assert!(look.get("out_of_focus_px").is_none(), "{look}");
    let near = ["--set", WIDE, "--set", "composite.focus_m=1.5"];
    let run = project.run(DIPIR, &[&["run"], &near[..]].concat());
    run.expect_success();
    assert!(run.stdout.contains("ran composite"), "{}", run.stdout);
    assert!(!run.stdout.contains("ran scene"), "{}", run.stdout);
    assert!(
        run.stdout.contains("points of the objects are discs of"),
        "{}",
        run.stdout
    );
    let file = project.read("out/composite/composite.exr");
    let (soft, look) = project.edges_and_look("out");
    let [least, most] = [0, 1].map(|i| look["out_of_focus_px"][i].as_f64().unwrap());
    // Of 24 rows that see 40 degrees the focal length is 33 pixels: times .2 m, times 1/1.5 less 1/4.6 and 1/3.5.
    assert!(
        (2.4..=2.7).contains(&least) && (2.8..=3.1).contains(&most),
        "{look}"
    );
    assert!(soft > 2 * sharp, "{sharp} {soft}");
    // By any number of threads, and again.
    let run = project.run(COMPOSITE, &[&["-j", "1"], &near[..]].concat());
    run.expect_success();
    assert_eq!(project.read("out/composite/composite.exr"), file);
    // The ground under the object: in focus.
    let there = ["--set", WIDE, "--set", "composite.focus_at_pixel=[18, 15]"];
    project.run(COMPOSITE, &there).expect_success();
    let (there, look) = project.edges_and_look("out");
    assert_eq!(look["out_of_focus_px"][0], 0.0, "{look}");
    assert!(there < soft, "{there} {soft}");
    // A lens too small to blur: the same picture as without.
    project.run(COMPOSITE, &[]).expect_success();
    let plain = project.read("out/composite/composite.exr");
    let small = [
        "--set",
        "composite.aperture_mm=1",
        "--set",
        "composite.focus_m=4",
    ];
    let run = project.run(COMPOSITE, &small);
    run.expect_success();
    assert!(
        run.stdout.contains("the objects are in focus"),
        "{}",
        run.stdout
    );
    assert_eq!(project.read("out/composite/composite.exr"), plain);
}

#[test]
fn the_photograph_says_how_wide_its_lens_was_open() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "photo.jpg"));
    let focused = ["run", "--set", "composite.focus_m=1.5"];
    project.write_jpeg("photo.jpg", [90; 3], &[(FOCAL_LENGTH, [200, 1])]);
    project.run(SCENE, &focused[1..]).expect_error(
        2,
        "error: --set composite.focus_m=1.5: composite.focus_m: the photograph does not say how wide its lens was open: write \
         aperture_mm, its focal length over its f-number, as in 28.0 for 50 mm at f/1.8",
    );
    project
        .run(
            DIPIR,
            &[&focused[..], &["--set", "composite.f_number=0.5"]].concat(),
        )
        .expect_success();
    let (_, known) = project.edges_and_look("out");
    project.write_jpeg(
        "photo.jpg",
        [90; 3],
        &[(F_NUMBER, [1, 2]), (FOCAL_LENGTH, [200, 1])],
    );
    project.run(DIPIR, &focused).expect_success();
    let (_, read) = project.edges_and_look("out");
    assert_eq!(known["out_of_focus_px"], read["out_of_focus_px"]);
    assert!(read["out_of_focus_px"][0].as_f64().unwrap() > 2.0, "{read}");
}

#[test]
fn all_frames_of_a_shot_are_focused_as_its_photograph() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text.replace("background.png", "photo.jpg"));
    let lens = [(F_NUMBER, [1, 2]), (FOCAL_LENGTH, [200, 1])];
    project.write_jpeg("photo.jpg", [90; 3], &lens);
    // Frames of a film say nothing of the lens.
    for name in ["a.png", "b.png"] {
        project.write(name, project.read("background.png"));
    }
    let at = ["--set", "composite.focus_at_pixel=[18, 15]"];
    let shot = |more: &[&str]| {
        let run = project.run(
            DIPIR,
            &[&["shot", "a.png", "b.png"], &at[..], more].concat(),
        );
        run.expect_success();
        run.stdout
    };
    project
        .run(DIPIR, &[&["run"], &at[..]].concat())
        .expect_success();
    let (_, photo) = project.edges_and_look("out");
    shot(&[]);
    for name in ["a", "b"] {
        let look = project.read(&format!("out/frames/{name}/composite/look.json"));
        let look: Value = serde_json::from_slice(&look).unwrap();
        assert_eq!(look["out_of_focus_px"], photo["out_of_focus_px"], "{name}");
    }
    assert!(!shot(&[]).contains("ran "));
    let planned = shot(&["--plan"]);
    assert!(planned.contains("nothing to do"), "{planned}");
    // Of a flag, too.
    assert!(shot(&["--set", "composite.f_number=1"]).contains("ran composite"));
}

#[test]
fn a_focus_that_makes_no_sense_is_refused() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    for (set, message) in [
        (
            "composite.focus_m=0",
            "composite.focus_m: 0.0 is out of range; accepted: metres above 0, at most 100000, as in 2.5",
        ),
        (
            "composite.f_number=-1",
            "composite.f_number: -1.0 is out of range; accepted: a number above 0, at most 1000, as in 1.8",
        ),
        (
            "composite.aperture_mm=28",
            "composite.aperture_mm: blurs what is out of focus; say what is in focus, too: focus_m = 2.5, or focus_at_pixel",
        ),
    ] {
        let run = project.run(COMPOSITE, &["--set", set]);
        run.expect_error(2, &format!("error: --set {set}: {message}"));
    }
    let sky = ["--set", WIDE, "--set", "composite.focus_at_pixel=[18, 0]"];
    let run = project.run(COMPOSITE, &sky);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.contains("composite.focus_at_pixel is [18.0, 0.0], where no ground is seen; accepted: a pixel below the horizon"),
        "{}",
        run.stderr
    );
    let beside = [
        "--set",
        WIDE,
        "--set",
        "composite.focus_at_pixel=[18, 24.5]",
    ];
    let run = project.run(COMPOSITE, &beside);
    assert!(
        run.stderr
            .contains("a pixel of the photograph, [0, 0] to [36.0, 24.0]"),
        "{}",
        run.stderr
    );
    let both = [WIDE, "composite.f_number=2", "composite.focus_m=2"]
        .map(|set| ["--set", set])
        .concat();
    let run = project.run(COMPOSITE, &both);
    assert!(
        run.stderr
            .contains("composite.aperture_mm: excludes f_number; keep one of the two"),
        "{}",
        run.stderr
    );
}
