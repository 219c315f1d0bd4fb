//! Runs that end early, and runs at the same time.
use std::fs::File;
#[cfg(unix)]
use std::io::{BufRead, BufReader};
use std::process::Child;
#[cfg(unix)]
use std::process::Command;
use std::time::{Duration, Instant};

use crate::project::*;

/// Renders for as long as nobody stops it.
const ENDLESS: [&str; 4] = [
    "--set",
    "composite.target_error=1e-9",
    "--set",
    "composite.max_samples=4000000000",
];

/// Starts a composite and waits until it writes its folder.
fn start_endless(project: &Project) -> Child {
    let mut child = project.command(COMPOSITE, &ENDLESS).spawn().unwrap();
    wait_until_it_writes(project, &mut child);
    child
}

fn wait_until_it_writes(project: &Project, child: &mut Child) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !project.path("out/.composite.partial").exists() {
        let ended = child.try_wait().unwrap();
        assert!(
            ended.is_none() && Instant::now() < deadline,
            "it did not start: {ended:?}"
        );
        std::thread::yield_now();
    }
}

#[test]
fn a_killed_run_leaves_earlier_results_and_the_next_one_ends_as_if_undisturbed() {
    let project = Project::new();
    project.run_both(&[]);
    let before = project.artifacts("out/composite");
    let manifest = project.read("out/composite/stage.json");
    let mut child = start_endless(&project);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(project.artifacts("out/composite") == before);
    assert_eq!(project.read("out/composite/stage.json"), manifest);
    project.run(COMPOSITE, &[]).expect_success();
    assert!(project.artifacts("out/composite") == before);
    assert!(!project.path("out/.composite.partial").exists());
}

#[cfg(unix)]
fn send(signal: &str, to: &Child) {
    let pid = to.id().to_string();
    let sent = Command::new("kill").args([signal, &pid]).status();
    assert!(sent.unwrap().success());
}

/// Signals that ask a process to end; not that of a closed terminal where these tests themselves were started to outlive theirs.
#[cfg(unix)]
fn ending() -> &'static [&'static str] {
    let hangs_up = Command::new("sh").args(["-c", "kill -HUP $$"]).status();
    match hangs_up.unwrap().success() {
        true => &["-TERM"],
        false => &["-TERM", "-HUP"],
    }
}

#[cfg(unix)]
#[test]
fn a_signal_that_asks_to_end_ends_with_130_and_leaves_nothing_half_written() {
    let project = Project::new();
    project.run_both(&[]);
    let before = project.artifacts("out/composite");
    for signal in [&["-INT"], ending()].concat() {
        let child = start_endless(&project);
        send(signal, &child);
        let run: Run = child.wait_with_output().unwrap().into();
        run.expect_error(130, "interrupted; earlier results are as they were");
        assert!(project.artifacts("out/composite") == before);
        assert!(!project.path("out/.composite.partial").exists());
    }
    // A run that is watched is a process of its own, which the signal does not reach by itself.
    let ways = [&["run"][..], &["run", "--watch"]];
    for (signal, way) in ending().iter().flat_map(|s| ways.map(|way| (s, way))) {
        let mut run = project.command(DIPIR, &[way, &ENDLESS[..]].concat());
        let mut child = run.spawn().unwrap();
        wait_until_it_writes(&project, &mut child);
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), Some(130));
        for left in [".run.lock", ".composite.hashes", ".composite.partial"] {
            let is_left = project.path("out").join(left).exists();
            assert!(!is_left, "{signal} {way:?}: {left}");
        }
    }
}

#[cfg(unix)]
#[test]
fn a_watch_that_waits_ends_with_130() {
    use std::io::{BufRead, BufReader};

    let project = Project::new();
    let watch = ["run", "--watch", "--until", "scene"];
    let mut child = project.command(DIPIR, &watch).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let waits = |line: std::io::Result<String>| line.unwrap().starts_with("waiting for a change");
    assert!(lines.any(waits));
    send("-INT", &child);
    assert_eq!(child.wait().unwrap().code(), Some(130));
}

#[cfg(target_os = "linux")]
#[test]
fn a_terminal_that_is_closed_ends_no_run_that_was_started_to_outlive_it() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    // As nohup does.
    let script = r#"trap '' HUP; exec "$@""#;
    let args = [&["-c", script, "sh", COMPOSITE], &ENDLESS[..]].concat();
    let mut child = project.command("sh", &args).spawn().unwrap();
    wait_until_it_writes(&project, &mut child);
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap();
    let mask = |name: &str| {
        let mask = status.lines().find_map(|line| line.strip_prefix(name));
        u64::from_str_radix(mask.unwrap().trim(), 16).unwrap()
    };
    let (ignored, caught) = (mask("SigIgn:"), mask("SigCgt:"));
    let bit = |signal: u32| 1u64 << (signal - 1);
    let (hangup, termination) = (bit(1), bit(15));
    assert_eq!(ignored & hangup, hangup);
    assert_eq!(caught & (hangup | termination), termination);
    child.kill().unwrap();
    child.wait().unwrap();
}

#[cfg(unix)]
#[test]
fn a_run_that_waits_for_another_says_so_and_ends_when_it_is_asked_to() {
    let project = Project::new();
    let mut first = project.command(DIPIR, &[&["run"], &ENDLESS[..]].concat());
    let mut first = first.spawn().unwrap();
    wait_until_it_writes(&project, &mut first);
    let mut second = project.command(DIPIR, &["run", "--wait"]).spawn().unwrap();
    let mut told = String::new();
    let mut lines = BufReader::new(second.stderr.take().unwrap());
    lines.read_line(&mut told).unwrap();
    let wanted = format!("waiting for process {}, which writes out\n", first.id());
    assert_eq!(told, wanted);
    send("-INT", &second);
    assert_eq!(second.wait().unwrap().code(), Some(130));
    first.kill().unwrap();
    first.wait().unwrap();
}

#[cfg(unix)]
#[test]
fn an_abort_as_for_want_of_memory_says_what_it_comes_from() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let child = start_endless(&project);
    let pid = child.id().to_string();
    let sent = Command::new("kill").args(["-ABRT", &pid]).status();
    assert!(sent.unwrap().success());
    let run: Run = child.wait_with_output().unwrap().into();
    assert_eq!(run.code, None, "ended by the signal");
    assert!(run.stderr.contains("memory ran out"), "{}", run.stderr);
    // The next run takes away what is left.
    project.run(COMPOSITE, &[]).expect_success();
    assert_eq!(project.names("out"), ["composite", "scene"]);
}

#[cfg(unix)]
#[test]
fn control_c_at_a_terminal_is_told_once_by_the_run_and_not_by_its_stage() {
    use std::os::unix::process::CommandExt;
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    // A terminal sends it to the run and to its stage: to a group of processes.
    let mut command = project.command(DIPIR, &[&["run"], &ENDLESS[..]].concat());
    let mut child = command.process_group(0).spawn().unwrap();
    wait_until_it_writes(&project, &mut child);
    let group = format!("-{}", child.id());
    let sent = Command::new("kill").args(["-INT", "--", &group]).status();
    assert!(sent.unwrap().success());
    let run: Run = child.wait_with_output().unwrap().into();
    assert_eq!(run.code, Some(130));
    assert_eq!(
        run.stderr.matches("interrupted").count(),
        1,
        "{}",
        run.stderr
    );
}

#[test]
fn a_second_run_at_the_same_time_is_refused() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let mut child = start_endless(&project);
    let run = project.run(COMPOSITE, &[]);
    child.kill().unwrap();
    child.wait().unwrap();
    run.expect_error(
        1,
        &format!(
            "error: out/composite is being written by process {}; wait for it to end, pass --wait, \
             or choose another folder with --out",
            child.id()
        ),
    );
}

#[test]
fn a_second_run_waits_if_asked_to() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let mut first = start_endless(&project);
    let second = project.command(COMPOSITE, &["--wait"]).spawn().unwrap();
    first.kill().unwrap();
    first.wait().unwrap();
    Run::from(second.wait_with_output().unwrap()).expect_success();
    assert!(project.path("out/composite/composite.png").exists());
}

#[test]
fn a_folder_that_no_stage_wrote_is_not_replaced() {
    let project = Project::new();
    std::fs::create_dir_all(project.path("out/scene")).unwrap();
    project.write("out/scene/thesis.tex", "years of work");
    project.run(SCENE, &[]).expect_error(
        1,
        "error: out/scene is there already and holds no stage.json, so no stage wrote it and it is \
         left alone; move it away or choose another folder with --out",
    );
    assert_eq!(project.read("out/scene/thesis.tex"), b"years of work");
}

#[test]
fn what_lies_beside_the_artifacts_is_there_after_the_next_run() {
    let project = Project::new();
    project.run_both(&[]);
    project.write("out/composite/painted over.psd", "years of work");
    project.write("out/composite/composite.png.bak", "mine");
    project.run_both(&[]);
    assert_eq!(
        project.read("out/composite/painted over.psd"),
        b"years of work"
    );
    assert_eq!(
        project.names("out/composite"),
        [
            ".dipir",
            "composite.exr",
            "composite.png",
            "composite.png.bak",
            "effects.json",
            "look.json",
            "painted over.psd",
            "stage.json"
        ]
    );
    assert_eq!(project.names("out"), ["composite", "scene"]);
}

#[test]
fn an_output_folder_that_is_a_file_is_one_message() {
    let project = Project::new();
    File::create(project.path("out")).unwrap();
    let run = project.run(SCENE, &[]);
    assert_eq!(run.code, Some(1));
    assert_eq!(
        run.stderr,
        "error: cannot create out: file exists; move it away or choose another folder with --out\n"
    );
}
