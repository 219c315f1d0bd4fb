//! Help, options, exit codes.
use crate::project::*;

#[test]
fn help_of_every_executable_shows_examples_and_exit_codes() {
    let project = Project::new();
    for executable in [
        DIPIR,
        SCENE,
        env!("CARGO_BIN_EXE_dipir-concepts"),
        env!("CARGO_BIN_EXE_dipir-lora"),
        OPTIMIZE,
        COMPOSITE,
        env!("CARGO_BIN_EXE_dipir-model"),
        INSPECT,
        EVALUATE,
        TRADEOFF,
        PRETRAIN,
    ] {
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
    assert!(run.stderr.starts_with("error: "), "{:?}", run.stderr);
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

#[test]
fn what_gives_no_photograph_is_refused_by_option() {
    let project = Project::new();
    let base = ["background", "--from", "sky.exr", "--size", "8x4"];
    for (option, value, accepted) in [
        ("--yaw", "nan", "NaN: accepted: -360 to 360"),
        ("--pitch", "inf", "inf: accepted: -90 to 90"),
        ("--exposure-ev", "nan", "NaN: accepted: -64 to 64"),
        ("--exposure-ev", "65", "65: accepted: -64 to 64"),
        ("--fov", "1e-30", "accepted: 0.1 to 179"),
    ] {
        let run = project.run(SCENE, &[&base[..], &[option, value, "o.png"]].concat());
        assert_eq!(run.code, Some(2), "{}", run.stderr);
        let told = run.stderr.starts_with(&format!("error: {option} "));
        assert!(
            told && run.stderr.trim_end().ends_with(accepted),
            "{}",
            run.stderr
        );
    }
    for name in ["o.jpg", "o", "o.exr"] {
        let message = format!(
            "error: {name}: the photograph is written as a PNG: name it so, as in photo.png"
        );
        let run = project.run(SCENE, &[&base[..], &[name]].concat());
        run.expect_error(2, &message);
        assert!(!project.path(name).exists());
    }
    for (executable, args, what) in [
        (DIPIR, &["preview", "--wire", "-o", "o.jpg"][..], "preview"),
        (INSPECT, &["background.png", "--png", "o.jpg"], "picture"),
    ] {
        let message =
            format!("error: o.jpg: the {what} is written as a PNG: name it so, as in {what}.png");
        project.run(executable, args).expect_error(2, &message);
        assert!(!project.path("o.jpg").exists());
    }
    let args = ["background.png", "--png", "o.png", "--exposure-ev", "nan"];
    let message = "error: --exposure-ev NaN: accepted: -64 to 64";
    project.run(INSPECT, &args).expect_error(2, message);
}

#[test]
fn no_picture_replaces_what_it_is_made_from() {
    let project = Project::new();
    // A photograph that dipir made would be replaced.
    let cut = [
        "background",
        "--from",
        "sky.exr",
        "--size",
        "36x24",
        "bg.png",
    ];
    project.run(SCENE, &cut).expect_success();
    let before = project.read("bg.png");
    let set = ["--set", "scene.background=bg.png"];
    let run = project.run(
        DIPIR,
        &[&["preview", "--wire", "-o", "./bg.png"], &set[..]].concat(),
    );
    run.expect_error(
        2,
        "error: ./bg.png is what scene.background names, and the preview would replace it: name another \
         file with --out",
    );
    let run = project.run(DIPIR, &["preview", "--wire", "-o", "bg.png"]);
    run.expect_error(
        1,
        "error: cannot write \"bg.png\"\n  caused by: is there already, a photograph that dipir made; name another file",
    );
    let run = project.run(INSPECT, &["bg.png", "--png", "./bg.png"]);
    run.expect_error(
        2,
        "error: --png ./bg.png: that is the file which is shown; name another file",
    );
    assert!(project.read("bg.png") == before);
    project
        .run(INSPECT, &["bg.png", "--png", "o.png"])
        .expect_success();
    project
        .run(INSPECT, &["bg.png", "--png", "o.png"])
        .expect_success();
}

#[test]
fn a_value_of_the_command_line_is_called_by_its_option() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let text = text.replace("environment = \"sky.exr\"\n", "");
    let shadow = "[light.shadow]\nfoot = [4.0, 20.0]\ntip = [6.0, 18.0]\n";
    project.write("pipeline.toml", text + shadow);
    let set = "light.shadow.height_m=-1";
    let accepted = "metres above 0, as in 1.8";
    let message = format!("error: --set {set}: light.shadow.height_m is -1; accepted: {accepted}");
    let run = project.run(DIPIR, &["run", "--until", "light", "--set", set]);
    assert!(
        run.code == Some(2) && run.stderr.contains(&message),
        "{}",
        run.stderr
    );
    // A device is read where none is used, too.
    let message = "error: --set pipeline.device=foo: pipeline.device: \"foo\" is no device; \
                   accepted: cpu, cuda:N, metal:N, auto";
    for command in ["run", "status"] {
        let run = project.run(DIPIR, &[command, "--set", "pipeline.device=foo"]);
        run.expect_error(2, message);
    }
    for seconds in ["1e-300", "1e300"] {
        let set = format!("composite.time_budget_s={seconds}");
        let run = project.run(DIPIR, &["run", "--set", &set]);
        let accepted = "is out of range; accepted: seconds from 0.01 to 1e7, as in 60";
        let message = format!("error: --set {set}: composite.time_budget_s: {seconds} {accepted}");
        run.expect_error(2, &message);
    }
}

#[test]
fn several_files_are_looked_at_before_the_first_runs() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("b.toml", &text);
    let run = project.run(DIPIR, &["run", "pipeline.toml", "b.toml"]);
    let message =
        "error: pipeline.toml and b.toml write one folder, out: give each its own, [pipeline] out";
    run.expect_error(2, message);
    let run = project.run(DIPIR, &["run", "pipeline.toml", "gone.toml"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.starts_with("error: there is no gone.toml; "),
        "{}",
        run.stderr
    );
    assert!(!project.path("out").exists());
    project.write("b.toml", format!("[pipeline]\nout = \"x/../out\"\n{text}"));
    std::fs::create_dir(project.path("x")).unwrap();
    let run = project.run(DIPIR, &["run", "pipeline.toml", "b.toml"]);
    assert_eq!(run.code, Some(2), "{}", run.stderr);
}

#[test]
fn earlier_names_are_answered_with_the_present_ones() {
    let project = Project::new();
    let error = |executable: &str, args: &[&str], message: &str| {
        let run = project.run(executable, args);
        run.expect_error(2, message);
    };
    error(
        EARLIER,
        &[],
        "error: dipir-optimize is called dipir-light now",
    );
    error(
        DIPIR,
        &["run", "--from", "optimize"],
        "error: --from optimize: that stage is called light now",
    );
    error(
        DIPIR,
        &["status", "--set", "optimize.light=false"],
        "error: --set optimize.light=false: optimize.light is called light.recover_light now",
    );
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write("pipeline.toml", text + "[optimize]\niterations = 3\n");
    let run = project.run(DIPIR, &["run"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.ends_with(": [optimize] is called [light] now\n"),
        "{}",
        run.stderr
    );
}

#[test]
fn what_is_no_command_is_answered_with_what_was_meant() {
    let project = Project::new();
    let told = |args: &[&str]| {
        let run = project.run(DIPIR, args);
        assert_eq!(run.code, Some(2), "{args:?}");
        run.stderr
    };
    assert_eq!(
        told(&["rnu"]),
        "error: rnu is no command of dipir; did you mean dipir run?\n"
    );
    assert_eq!(
        told(&["pipeline.toml"]),
        "error: pipeline.toml is no command of dipir; to run it: dipir run pipeline.toml\n"
    );
    let photo = told(&["photo.jpg"]);
    assert!(
        photo.starts_with("error: photo.jpg is no command of dipir; ") && photo.contains("dipir "),
        "{photo}"
    );
}

#[test]
fn more_threads_than_any_machine_has_are_refused() {
    let project = Project::new();
    let accepted = "accepted: 0, for one a core, to 1024";
    let set = ["--set", "pipeline.threads=1000000"];
    let message = format!("error: --set pipeline.threads=1000000: pipeline.threads: {accepted}");
    project.run(SCENE, &set).expect_error(2, &message);
    let run = project.run(DIPIR, &[&["run"], &set[..]].concat());
    run.expect_error(2, &message);
    let message = format!("error: --threads 1025: {accepted}");
    for executable in [SCENE, COMPOSITE] {
        let run = project.run(executable, &["--threads", "1025"]);
        run.expect_error(2, &message);
    }
    let run = project.run(DIPIR, &["run", "-j", "1025"]);
    run.expect_error(2, &message);
    let message = format!("error: RAYON_NUM_THREADS=1000000 in the environment: {accepted}");
    for executable in [SCENE, DIPIR] {
        let mut command = project.command(executable, &["--version"]);
        let run = command.env("RAYON_NUM_THREADS", "1000000").output();
        Run::from(run.unwrap()).expect_error(2, &message);
    }
    assert!(!project.path("out").exists());
}

#[test]
fn terminal_escapes_in_names_and_values_are_shown() {
    let project = Project::new();
    let evil = "a\u{1b}[2J\u{9b}31m.obj";
    for (key, code) in [
        ("scene.objects.0.path", 1),
        ("scene.transfer", 2),
        ("x\u{1b}.y", 2),
    ] {
        let set = format!("{key}={evil}");
        let run = project.run(SCENE, &["--set", &set]);
        assert_eq!(run.code, Some(code), "{}", run.stderr);
        let obeyed = |c: char| c.is_control() && c != '\n';
        assert!(!run.stderr.contains(obeyed), "{:?}", run.stderr);
        assert!(run.stderr.contains("a\\u{1b}[2J"), "{}", run.stderr);
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_as_configuration_or_input_is_refused_at_once() {
    use std::process::Command;
    let project = Project::new();
    let made = Command::new("mkfifo").arg(project.path("pipe")).status();
    assert!(made.unwrap().success());
    project.run(DIPIR, &["status", "pipe"]).expect_error(
        2,
        "error: cannot read pipe: not a regular file; name another file with --pipeline",
    );
    project.run(SCENE, &[]).expect_success();
    let run = project.run(DIPIR, &["status", "--set", "composite.environment=pipe"]);
    assert!(
        run.stdout.contains("pipe: not a regular file"),
        "{}",
        run.stdout
    );
}

#[cfg(target_os = "linux")]
#[test]
fn a_limit_on_the_size_of_files_is_named_and_nothing_is_lost() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let before = project.artifacts("out/scene");
    // 1 block: 512 or 1024 bytes, by the shell.
    let script = format!("ulimit -f 1; {SCENE}");
    let run: Run = project
        .command("sh", &["-c", &script])
        .output()
        .unwrap()
        .into();
    assert_eq!(run.code, Some(1), "{run:?}");
    let told = run.stderr.to_lowercase();
    assert!(told.contains("file too large"), "{told}");
    assert!(project.artifacts("out/scene") == before);
    assert_eq!(project.names("out"), ["scene"]);
}

#[test]
fn names_may_begin_with_a_dash() {
    let project = Project::new();
    project.write("-p.toml", project.read("pipeline.toml"));
    let run = project.run(DIPIR, &["run", "-q", "--out=-out", "--", "-p.toml"]);
    run.expect_success();
    assert!(project.path("-out/composite/composite.png").exists());
    // The folders of a shot's frames are in it.
    let set = "--set=pipeline.out=-shot";
    let shot = project.run(DIPIR, &["shot", "-q", set, "--", "background.png"]);
    shot.expect_success();
    let frame = "-shot/frames/background/composite/composite.png";
    assert!(project.path(frame).exists());
    // The page names commands that can be typed.
    let page = String::from_utf8(project.read("-out/report.html")).unwrap();
    assert!(page.contains("--pipeline=-p.toml --out=-out"), "{page}");
}

#[test]
fn a_command_that_takes_one_file_says_so() {
    let project = Project::new();
    for command in ["status", "graph", "report", "clean"] {
        let help = project.run(DIPIR, &[command, "--help"]).stdout;
        let usage = format!("Usage: dipir {command} [OPTIONS] [FILE]\n");
        assert!(help.contains(&usage), "{help}");
    }
    let help = project.run(DIPIR, &["run", "--help"]).stdout;
    assert!(help.contains("[FILE]...\n"), "{help}");
}

#[test]
fn a_folder_of_artifacts_that_is_a_file_is_refused_by_name() {
    let project = Project::new();
    project.write("out", "mine");
    let message =
        "error: cannot create out: file exists; move it away or choose another folder with --out";
    for command in [&["run"][..], &["status"]] {
        project.run(DIPIR, command).expect_error(1, message);
    }
    assert_eq!(project.read("out"), b"mine");
    // A run that fails leaves no folder that it made.
    let run = project.run(DIPIR, &["run", "--from", "composite", "-o", "new/folder"]);
    assert_eq!(run.code, Some(1));
    assert!(!project.path("new").exists());
}

#[test]
fn what_later_stages_read_is_looked_for_before_any_runs() {
    let project = Project::new();
    let gone = |set: &[&str], key: &str, file: &str| {
        let run = project.run(DIPIR, &[&["run"], set].concat());
        let cause = format!("  caused by: `{file}` does not exist; check the path\n");
        let message = format!("error: cannot use {key} = \"{file}\"\n{cause}");
        assert_eq!((run.code, &*run.stderr), (Some(1), &*message));
        assert!(!project.path("out").exists());
    };
    gone(
        &["--set", "composite.environment=gone.hdr"],
        "composite.environment",
        "gone.hdr",
    );
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write(
        "pipeline.toml",
        text.replace("environment = \"sky.exr\"\n", ""),
    );
    let reference = "light.reference=gone.exr";
    let guided = ["--set", "light.guidance=reference", "--set", reference];
    gone(&guided, "light.reference", "gone.exr");
    gone(
        &["--set", "light.start=gone.json"],
        "light.start",
        "gone.json",
    );
    gone(&["--set", "model.path=gone"], "model.path", "gone");
    // Of stages that do not run nothing is asked.
    let until = ["run", "--until", "scene", "--set", "light.start=gone.json"];
    project.run(DIPIR, &until).expect_success();
    for (key, why) in [
        (
            "composite.environment",
            "is empty; name a file, or remove the key",
        ),
        (
            "light.start",
            "\"\" is neither a file nor one of these words",
        ),
    ] {
        let set = format!("{key}=\"\"");
        let run = project.run(DIPIR, &["run", "--set", &set]);
        let told = format!("error: --set {set}: {key}: {why}");
        assert_eq!(run.code, Some(2));
        assert!(run.stderr.starts_with(&told), "{}", run.stderr);
    }
}
