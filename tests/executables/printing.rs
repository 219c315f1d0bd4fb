//! What is printed where nobody reads, where there is no room, and of paths that are no text.
#![cfg(unix)]
use std::ffi::OsStr;
use std::fs::{self, File};
use std::os::unix::ffi::OsStrExt;
use std::process::{Command, Stdio};

use serde_json::Value;

use crate::project::*;

/// A folder in which the project lies, whose name is not UTF-8.
fn strange(project: &Project) -> &'static OsStr {
    let name = OsStr::from_bytes(b"photo\xff");
    let folder = project.path("").join(name);
    fs::create_dir(&folder).unwrap();
    for file in ["background.png", "object.obj", "sky.exr", "pipeline.toml"] {
        fs::rename(project.path(file), folder.join(file)).unwrap();
    }
    name
}

#[test]
fn a_folder_whose_name_is_not_utf_8_is_worked_in_and_told_of() {
    let project = Project::new();
    let folder = strange(&project);
    let run = |executable: &str, args: &[&str], file: &str| {
        let path = std::path::Path::new(folder).join(file);
        let mut command = project.command(executable, args);
        Run::from(command.arg(path).output().unwrap())
    };
    let told = |run: Run, key: &str| {
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        let text = value[key].as_str().or(value[key][0].as_str());
        assert!(text.unwrap().starts_with("photo\u{fffd}"), "{value}");
    };
    run(DIPIR, &["run"], "pipeline.toml").expect_success();
    // With and without --json, what was done and what is there.
    for args in [
        &["run"][..],
        &["run", "--force"],
        &["report"],
        &["preview", "--wire"],
        &["status", "--json"],
        &["clean", "--dry-run"],
    ] {
        run(DIPIR, args, "pipeline.toml").expect_success();
    }
    told(
        run(DIPIR, &["run", "--force", "--json"], "pipeline.toml"),
        "report",
    );
    told(run(DIPIR, &["report", "--json"], "pipeline.toml"), "report");
    let wire = ["preview", "--wire", "--json"];
    told(run(DIPIR, &wire, "pipeline.toml"), "preview");
    told(
        run(DIPIR, &["clean", "--json", "--dry-run"], "pipeline.toml"),
        "removed",
    );
    told(run(SCENE, &["--json", "-p"], "pipeline.toml"), "folder");
    told(
        run(COMPOSITE, &["--json", "-p"], "pipeline.toml"),
        "picture",
    );
    for file in [
        "background.png",
        "object.obj",
        "out/scene/scene.json",
        "out/scene",
        "sky.exr",
    ] {
        run(INSPECT, &[], file).expect_success();
        told(run(INSPECT, &["--json"], file), "path");
    }
    let damaged = std::path::Path::new(folder).join("out/scene/scene.json");
    fs::write(project.path("").join(damaged), "{}").unwrap();
    run(DIPIR, &["status", "--json"], "pipeline.toml").expect_success();
}

/// Runs with standard error going nowhere: to a pipe that nobody reads.
fn without_reader(project: &Project, executable: &str, args: &[&str]) -> Option<i32> {
    let script = "\"$@\" 2>&1 >/dev/null | exec 0<&-; exit ${PIPESTATUS[0]}";
    let mut all = vec!["-c", script, "bash", executable];
    all.extend(args);
    project
        .command("bash", &all)
        .output()
        .unwrap()
        .status
        .code()
}

#[cfg(target_os = "linux")]
#[test]
fn the_work_goes_on_where_nobody_reads_what_is_said_of_it() {
    let project = Project::new();
    let run = |args: &[&str]| {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let mut command = project.command(DIPIR, args);
        command
            .stderr(Stdio::from(full))
            .output()
            .unwrap()
            .status
            .code()
    };
    assert_eq!(run(&["run"]), Some(0));
    assert_eq!(run(&["run", "--force", "-v"]), Some(0));
    assert_eq!(
        without_reader(&project, DIPIR, &["run", "--force"]),
        Some(0)
    );
    project.write(
        "b.toml",
        [
            &b"[pipeline]\nout = \"b\"\n"[..],
            &project.read("pipeline.toml"),
        ]
        .concat(),
    );
    assert_eq!(run(&["run", "pipeline.toml", "b.toml"]), Some(0));
    assert!(project.path("b/composite/composite.png").exists());
    // An error is an error all the same.
    assert_eq!(run(&["status", "gone.toml"]), Some(2));
}

#[cfg(target_os = "linux")]
#[test]
fn a_result_that_cannot_be_printed_is_one_error() {
    let project = Project::new();
    let printed = |executable: &str, args: &[&str]| {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let mut command = project.command(executable, args);
        Run::from(command.stdout(Stdio::from(full)).output().unwrap())
    };
    for (executable, args) in [
        (DIPIR, &["keys", "--schema"][..]),
        (DIPIR, &["keys"]),
        (DIPIR, &["status"]),
        (DIPIR, &["status", "--json"]),
        (DIPIR, &["completions", "bash"]),
        (DIPIR, &["man"]),
        (DIPIR, &["--help"]),
        (DIPIR, &["run", "--help"]),
        (SCENE, &["--version"]),
        (INSPECT, &["background.png"]),
        (EVALUATE, &["methods", "--toml"]),
    ] {
        let run = printed(executable, args);
        assert_eq!(run.code, Some(1), "{args:?}: {}", run.stderr);
        let begins = "error: cannot write to standard output: no space left on device; ";
        assert!(run.stderr.starts_with(begins), "{args:?}: {}", run.stderr);
        assert_eq!(run.stderr.lines().count(), 1, "{}", run.stderr);
    }
    // All stages run, and then it is said once.
    let run = printed(DIPIR, &["run"]);
    assert_eq!(
        (run.code, run.stderr.matches("error: ").count()),
        (Some(1), 1)
    );
    assert!(project.path("out/composite/composite.png").exists());
    // A reader that has seen enough is none.
    for args in ["keys --schema", "--help"] {
        let script = format!("\"$1\" {args} | head -1 >/dev/null; exit ${{PIPESTATUS[0]}}");
        let mut command: Command = project.command("bash", &["-c", &script, "bash", DIPIR]);
        assert_eq!(command.output().unwrap().status.code(), Some(0), "{args}");
    }
}
