//! Cameras that move while their shutter is open.
use crate::project::*;

/// A project whose photograph is the second of three frames of a camera that goes a metre a frame to the right.
fn project() -> Project {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (head, tail) = text.split_once("[scene.camera]\n").unwrap();
    let (_, tail) = tail.split_once("[scene.proxy]\n").unwrap();
    let text = format!("{head}[scene.camera]\nfile = \"shot.chan\"\n[scene.proxy]\n{tail}");
    let text = text.replace("background.png", "f.02.png");
    project.write("pipeline.toml", text);
    project.write("f.02.png", project.read("background.png"));
    let lines = ["1 -1", "2 0", "3 1"].map(|begin| format!("{begin} 1.2 4 -12 0 0 40\n"));
    project.write("shot.chan", lines.concat());
    project
}

#[test]
fn what_the_camera_passes_is_blurred_and_takes_the_composite_alone() {
    let project = project();
    project.run_both(&[]);
    let (sharp, look) = project.edges_and_look("out");
    assert!(look.get("moving_px").is_none(), "{look}");
    let plain = project.read("out/composite/composite.exr");
    let open = ["--set", "composite.shutter_deg=180"];
    let run = project.run(DIPIR, &[&["run"], &open[..]].concat());
    run.expect_success();
    assert!(run.stdout.contains("ran composite"), "{}", run.stdout);
    assert!(!run.stdout.contains("ran scene"), "{}", run.stdout);
    let told = "motion blur: points of the objects are lines of";
    assert!(run.stdout.contains(told), "{}", run.stdout);
    let file = project.read("out/composite/composite.exr");
    let (soft, look) = project.edges_and_look("out");
    // Of 24 rows that see 40 degrees the focal length is 33 pixels: times .5 m, over 3 to 5 m.
    let [least, most] = [0, 1].map(|i| look["moving_px"][i].as_f64().unwrap());
    assert!(least > 3.2 && least < most && most < 5.6, "{look}");
    assert!(soft > sharp, "{sharp} {soft}");
    let run = project.run(COMPOSITE, &[&["-j", "1"], &open[..]].concat());
    run.expect_success();
    assert_eq!(project.read("out/composite/composite.exr"), file);
    // Of a neighbour that was tracked anew the composite depends, though the scene is as it was.
    let lines = String::from_utf8(project.read("shot.chan")).unwrap();
    project.write("shot.chan", lines.replace("3 1 ", "3 2 "));
    let run = project.run(DIPIR, &[&["run"], &open[..]].concat());
    run.expect_success();
    assert!(
        run.stdout.contains("ran scene, composite"),
        "{}",
        run.stdout
    );
    assert_ne!(project.read("out/composite/composite.exr"), file);
    project.write("shot.chan", &lines);
    // The composite alone does not mix old and new.
    let run = project.run(COMPOSITE, &open);
    run.expect_error(
        1,
        "error: the camera's file \"shot.chan\" changed since the scene was set up; run dipir-scene again",
    );
    // Half as fast over twice as many frames is as far, and so are units of twice the length at half the numbers.
    let slower = lines
        .replace("1 -1 1.2 4", "0 -2 1.2 4")
        .replace("3 1 1.2 4", "4 2 1.2 4");
    for (lines, scale) in [
        (slower, 1.0),
        (
            lines
                .replace("1.2 4", ".6 2")
                .replace("-1 .6", "-.5 .6")
                .replace("1 .6", ".5 .6"),
            2.0,
        ),
    ] {
        project.write("shot.chan", lines);
        let scale = format!("scene.camera.file_scale={scale}");
        let run = project.run(DIPIR, &[&["run", "--set", &scale], &open[..]].concat());
        run.expect_success();
        assert!(
            project.read("out/composite/composite.exr") == file,
            "{scale}"
        );
    }
    project.write("shot.chan", lines);
    // A frame at either end of the shot goes on as it came.
    project.write("f.03.png", project.read("f.02.png"));
    let run = project.run(DIPIR, &[&["shot", "f.03.png"], &open[..]].concat());
    run.expect_success();
    let (_, look) = project.edges_and_look("out/frames/f.03");
    assert!(look["moving_px"][0].as_f64().unwrap() > 3.0, "{look}");
    let run = project.run(DIPIR, &[&["shot", "f.03.png"], &open[..]].concat());
    run.expect_success();
    assert!(!run.stdout.contains("ran "), "{}", run.stdout);
    // Too short to be seen: the same picture as without.
    let run = project.run(COMPOSITE, &["--set", "composite.shutter_deg=1"]);
    run.expect_success();
    let told = "motion blur: the camera hardly moves past the objects";
    assert!(run.stdout.contains(told), "{}", run.stdout);
    assert_eq!(project.read("out/composite/composite.exr"), plain);
}

#[test]
fn motion_blur_goes_with_everything_else() {
    let project = project();
    project.write("mask.png", project.read("f.02.png"));
    let open = ["--set", "composite.shutter_deg=180"];
    for set in [
        "composite.most_pixels=216",
        "composite.time_budget_s=1",
        "composite.aperture_mm=100",
        "composite.ground_roughness=0.1",
        "scene.occluders=mask.png",
        "composite.denoise=false",
    ] {
        let more: &[&str] = match set {
            "composite.aperture_mm=100" => &["--set", "composite.focus_m=2"],
            _ => &[],
        };
        let run = project.run(DIPIR, &[&["run", "--set", set], more, &open].concat());
        run.expect_success();
        let (_, look) = project.edges_and_look("out");
        assert!(
            look["moving_px"][0].as_f64().unwrap() > 3.0,
            "{set}: {look}"
        );
    }
    let look = |name: &str, more: &[&str]| {
        let run = project.run(DIPIR, &[&["preview", "-o", name], more].concat());
        run.expect_success();
        project.read(name)
    };
    assert!(look("sharp.png", &[]) != look("moving.png", &open));
}

#[test]
fn a_shutter_that_makes_no_sense_is_refused() {
    let project = project();
    for deg in ["0", "361"] {
        let set = format!("composite.shutter_deg={deg}");
        let run = project.run(SCENE, &["--set", &set]);
        run.expect_error(
            2,
            &format!(
                "error: --set {set}: composite.shutter_deg: {deg}.0 is out of range; accepted: degrees above 0, at most 360, as in 180"
            ),
        );
    }
    let lines = String::from_utf8(project.read("shot.chan")).unwrap();
    let own = lines.lines().nth(1).unwrap();
    project.write("shot.chan", own);
    // Of the place alone a photograph need not be a frame of the shot.
    let run = project.run(SCENE, &["--set", "composite.shutter_deg=180"]);
    run.expect_success();
    let told = "composite.shutter_deg: nothing tells how the camera moves: scene.camera.file has no frame before or after the \
                photograph's. Name the shot's .chan";
    for command in [&["run"][..], &["shot", "f.02.png"]] {
        let args = [
            command,
            &["--set", "composite.shutter_deg=180", "-o", "new"],
        ]
        .concat();
        let run = project.run(DIPIR, &args);
        assert_eq!(run.code, Some(2), "{}", run.stderr);
        assert!(run.stderr.contains(told), "{}", run.stderr);
        assert!(!project.path("new/scene").exists());
    }
}
