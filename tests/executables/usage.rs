//! Help, options, exit codes.
use crate::project::*;

#[test]
fn help_of_every_executable_shows_examples_and_exit_codes() {
    let project = Project::new();
    for executable in [SCENE, OPTIMIZE, COMPOSITE, INSPECT] {
        let run = project.run(executable, &["--help"]);
        run.expect_success();
        assert!(run.stdout.contains("Usage:"), "{}", run.stdout);
        assert!(run.stdout.contains("Examples:"), "{}", run.stdout);
        assert!(run.stdout.contains("Exit codes:"), "{}", run.stdout);
        assert_eq!(run.stderr, "");
    }
}

#[test]
fn wrong_usage_exits_with_2() {
    let project = Project::new();
    for (executable, args) in [
        (SCENE, &["--no-such-option"][..]),
        (SCENE, &["--threads", "many"]),
        (SCENE, &["-q", "-v"]),
        (COMPOSITE, &["--target-error", "0.1", "--time-budget", "1"]),
        (INSPECT, &[]),
        (
            SCENE,
            &["background", "--from", "sky.exr", "--size", "10", "x.png"],
        ),
        (
            SCENE,
            &["background", "--from", "sky.exr", "--fov", "180", "x.png"],
        ),
    ] {
        let run = project.run(executable, args);
        assert_eq!(run.code, Some(2), "{args:?}: {}", run.stderr);
        assert!(run.stderr.starts_with("error: "), "{}", run.stderr);
    }
}

#[test]
fn json_goes_to_standard_output_and_nothing_else_does() {
    let project = Project::new();
    let run = project.run(SCENE, &["--json"]);
    run.expect_success();
    let value: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(value["triangles"], 4);
    assert_eq!(value["resolution"], serde_json::json!([36, 24]));
    assert_eq!(run.stderr, "", "no progress bar where there is no terminal");
}

#[test]
fn quiet_runs_print_nothing() {
    let project = Project::new();
    let run = project.run(SCENE, &["-q"]);
    run.expect_success();
    assert_eq!((run.stdout.as_str(), run.stderr.as_str()), ("", ""));
}

#[test]
fn output_is_free_of_colour_where_there_is_no_terminal() {
    let project = Project::new();
    let run = project.run(SCENE, &["--set", "scene.x=1"]);
    assert!(!run.stderr.contains('\x1b'), "{:?}", run.stderr);
}

#[test]
fn out_names_the_folder_of_all_stages() {
    let project = Project::new();
    project.run_both(&["--out", "elsewhere"]);
    assert!(project.path("elsewhere/scene/stage.json").exists());
    assert!(project.path("elsewhere/composite/composite.png").exists());
    assert!(!project.path("out").exists());
}

#[test]
fn a_pipeline_file_in_another_folder_keeps_its_paths() {
    let project = Project::new();
    let outside = tempfile::tempdir().unwrap();
    let file = project.path("pipeline.toml");
    let run = project
        .command(SCENE, &["-p", file.to_str().unwrap()])
        .current_dir(outside.path())
        .output()
        .unwrap();
    assert!(run.status.success());
    assert!(project.path("out/scene/scene.json").exists());
}

#[test]
fn a_photograph_is_cut_out_of_a_panorama() {
    let project = Project::new();
    let args = [
        "background",
        "--from",
        "sky.exr",
        "--size",
        "20x10",
        "--json",
        "photo.png",
    ];
    let run = project.run(SCENE, &args);
    run.expect_success();
    let value: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    // The sky is 0.4 everywhere that this camera looks: log2(0.18 / 0.4).
    let exposure = value["exposure_ev"].as_f64().unwrap();
    assert!(
        (exposure - (0.18f64 / 0.4).log2()).abs() < 1e-4,
        "{exposure}"
    );
    let run = project.run(INSPECT, &["--json", "photo.png"]);
    let value: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(
        (&value["width"], &value["height"]),
        (&20.into(), &10.into())
    );
    // sRGB of 0.18 is 0.4614, stored as 118 of 255.
    assert_eq!(
        value["channels"]["G"]["mean"]
            .as_f64()
            .map(|m| (m * 255.0).round()),
        Some(118.0)
    );
}
