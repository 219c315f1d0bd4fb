//! Runs that are killed at any moment, in any stage, and run again.
//!
//! A few kills here; `DIPIR_KILLS=50 cargo test --test executables kills -- --nocapture` for more. Runs
//! take one thread and two in turn; all must end with the bytes of the first one.
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command};
use std::time::Duration;

use dipir_numerics::hashing::mix64;
use dipir_pipeline::manifest::Manifest;

use crate::project::*;
use crate::whole::{self, STAGES, all_artifacts, run_all};

/// Which process of a run is killed.
#[derive(Clone, Copy, Debug)]
enum Victim {
    /// `dipir`, whose child then has to notice.
    Runner,
    /// The stage's executable.
    Stage,
    /// Both at once, as when the machine goes down.
    Both,
}

/// In [0, 1), by number.
fn share(n: u64) -> f64 {
    (mix64(n) >> 11) as f64 / (1u64 << 53) as f64
}

fn how_many() -> usize {
    let asked = std::env::var("DIPIR_KILLS").ok();
    asked.and_then(|n| n.parse().ok()).unwrap_or(STAGES.len())
}

/// Removes what `stage` and all later ones wrote, and what they would go on from.
fn forget(project: &Project, stage: usize) {
    let out = project.path("out");
    for name in &STAGES[stage..] {
        let _ = fs::remove_dir_all(out.join(name));
        let _ = fs::remove_dir_all(out.join(format!("{name}-checkpoints")));
    }
    if stage <= 1 {
        let _ = fs::remove_dir_all(project.path("cache"));
    }
}

/// Starts a run and returns when it has started `stage`.
fn start(project: &Project, stage: &str, threads: &str) -> Child {
    let until = match stage {
        "concepts" | "lora" => "lora",
        _ => "composite",
    };
    let mut command = project.command(DIPIR, &["run", "-j", threads, "--until", until]);
    let mut child = command.stdout(std::process::Stdio::null()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let begin = format!("{stage}: runs");
    let started = lines.any(|line| line.unwrap().starts_with(&begin));
    assert!(started, "{stage} did not start");
    // Somebody has to read what comes, or the child ends when it writes.
    std::thread::spawn(move || lines.for_each(drop));
    child
}

fn kill(pid: u32) {
    let _ = Command::new("kill")
        .args(["-KILL", &pid.to_string()])
        .status();
}

/// The processes that `pid` started, where the system tells.
fn children(pid: u32) -> Vec<u32> {
    let list = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children"));
    let list = list.unwrap_or_default();
    list.split_whitespace()
        .filter_map(|p| p.parse().ok())
        .collect()
}

#[cfg(unix)]
#[test]
fn killed_at_any_moment_and_run_again_everything_is_the_same_bytes() {
    let project = whole::project();
    run_all(&project, &[]);
    let whole = all_artifacts(&project, "out");
    let seconds = STAGES.map(|stage| {
        let folder = project.path("out").join(stage);
        Manifest::read(&folder, "").unwrap().elapsed_s
    });
    let mut hits = [0; STAGES.len()];
    for n in 0..how_many() {
        let k = n % STAGES.len();
        let victim = [Victim::Runner, Victim::Stage, Victim::Both][(mix64(n as u64) % 3) as usize];
        let threads = ["1", "2"][n % 2];
        forget(&project, k);
        let mut child = start(&project, STAGES[k], threads);
        // The start of a process counts, too.
        let span = 0.02 + 1.1 * seconds[k];
        std::thread::sleep(Duration::from_secs_f64(span * share(1000 + n as u64)));
        let stages = children(child.id());
        if !matches!(victim, Victim::Stage) {
            child.kill().unwrap();
        }
        if !matches!(victim, Victim::Runner) {
            stages.iter().for_each(|pid| kill(*pid));
        }
        child.wait().unwrap();
        hits[k] += usize::from(
            !project
                .path("out")
                .join(STAGES[k])
                .join("stage.json")
                .exists(),
        );
        // What one thread left, the other number of threads ends.
        run_all(&project, &["-j", ["2", "1"][n % 2]]);
        assert!(
            all_artifacts(&project, "out") == whole,
            "kill {n}: {victim:?} in {}, {threads} threads",
            STAGES[k]
        );
        assert!(run_all(&project, &[]).is_empty(), "kill {n}");
    }
    println!(
        "{} kills; before its end was hit: {STAGES:?} {hits:?}",
        how_many()
    );
    assert!(hits.iter().sum::<usize>() > 0, "every kill came too late");
    // With ten kills a stage, chance alone spares none.
    let is_many = how_many() >= 10 * STAGES.len();
    assert!(!is_many || hits.iter().all(|&h| h > 0), "{hits:?}");
    // A kill after a stage's last file, before it tidied up, leaves its checkpoint: the stage's next
    // run takes that away.
    for stage in STAGES {
        fs::remove_dir_all(project.path("out").join(stage)).unwrap();
    }
    run_all(&project, &[]);
    assert!(all_artifacts(&project, "out") == whole);
    let left: Vec<_> = fs::read_dir(project.path("out"))
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".partial") || name.ends_with("-checkpoints"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
}

#[cfg(unix)]
#[test]
fn control_c_stops_the_stage_and_the_next_run_goes_on() {
    let project = whole::project();
    run_all(&project, &[]);
    let whole = all_artifacts(&project, "out");
    forget(&project, 3);
    let mut child = start(&project, "light", "2");
    let pid = child.id().to_string();
    let sent = Command::new("kill").args(["-INT", &pid]).status().unwrap();
    assert!(sent.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(!project.path("out/.light.partial").exists());
    assert!(!project.path("out/light").exists());
    assert_eq!(run_all(&project, &[]), ["light", "composite"]);
    assert!(all_artifacts(&project, "out") == whole);
}

#[test]
fn one_thread_and_two_write_the_same_bytes_in_every_stage() {
    let project = whole::project();
    for (threads, out) in [("1", "one"), ("2", "two")] {
        // Without a common cache, so that both make their images.
        let cache = format!("concepts.cache={out}-cache");
        run_all(&project, &["-j", threads, "-o", out, "--set", &cache]);
    }
    let [one, two] = ["one", "two"].map(|out| all_artifacts(&project, out));
    for (a, b) in one.iter().zip(&two) {
        assert!(!a.1.is_empty() && a == b, "{}", a.0);
    }
}

#[test]
fn a_flipped_byte_in_any_artifact_is_found_named_and_rebuilt() {
    let project = whole::project();
    run_all(&project, &[]);
    let whole = all_artifacts(&project, "out");
    let flip = |name: &str| {
        let mut bytes = project.read(name);
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        project.write(name, bytes);
    };
    // All at once: each is named.
    let files: Vec<String> = whole
        .iter()
        .flat_map(|(stage, files)| files.iter().map(move |f| format!("out/{stage}/{}", f.0)))
        .collect();
    assert!(files.len() > 15, "{files:?}");
    files.iter().for_each(|name| flip(name));
    let status = |until: &str| {
        let run = project.run(DIPIR, &["status", "--until", until]);
        run.expect_success();
        run.stdout
    };
    let told = status("composite") + &status("lora");
    for name in &files {
        assert!(
            told.contains(&format!("{name}: damaged: ")),
            "{name}: {told}"
        );
    }
    assert_eq!(run_all(&project, &[]), STAGES);
    assert!(all_artifacts(&project, "out") == whole);

    // One at a time: what has the right bytes again is not read anew by the others.
    for (name, ran) in [
        ("out/scene/transport.safetensors", "scene"),
        ("out/scene/stage.json", "scene"),
        ("out/concepts/images/0001.png", "concepts"),
        ("out/lora/lora.safetensors", "lora"),
        ("out/light/stage.json", "light"),
        ("out/composite/composite.png", "composite"),
    ] {
        flip(name);
        let told = status("composite") + &status("lora");
        assert!(told.contains(&format!("{name}: ")), "{name}: {told}");
        assert_eq!(run_all(&project, &[]), [ran], "{name}");
        assert!(all_artifacts(&project, "out") == whole, "{name}");
    }

    // What stages keep for themselves is checked before it is used.
    let cache = fs::read_dir(project.path("cache")).unwrap().next().unwrap();
    let cache = cache.unwrap().path();
    for kept in ["0000.png", "0001.safetensors", "0000.blake3"] {
        let mut bytes = fs::read(cache.join(kept)).unwrap();
        bytes[20] ^= 4;
        fs::write(cache.join(kept), bytes).unwrap();
    }
    fs::remove_dir_all(project.path("out/concepts")).unwrap();
    assert_eq!(run_all(&project, &[]), ["concepts"]);
    assert!(all_artifacts(&project, "out") == whole);
}

#[test]
fn a_second_run_at_the_same_time_is_refused_in_one_message() {
    let project = Project::new();
    let endless = [
        "run",
        "--set",
        "composite.target_error=1e-9",
        "--set",
        "composite.max_samples=4000000000",
    ];
    let mut first = project.command(DIPIR, &endless).spawn().unwrap();
    let mut lines = BufReader::new(first.stderr.take().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap().starts_with("composite: runs")));
    let second = project.run(DIPIR, &["run"]);
    let cleaned = project.run(DIPIR, &["clean"]);
    let message = format!(
        "error: out is being written by process {}; wait for it to end, pass --wait, or choose \
         another folder with --out",
        first.id()
    );
    first.kill().unwrap();
    first.wait().unwrap();
    second.expect_error(1, &message);
    let message = format!(
        "error: out is being written by process {}; wait for it to end, and nothing was removed",
        first.id()
    );
    cleaned.expect_error(1, &message);
    // The child of the killed run stops by itself, and the next run waits for it.
    project.run(DIPIR, &["run"]).expect_success();
}

#[cfg(target_os = "linux")]
#[test]
fn a_folder_that_cannot_be_written_is_one_message() {
    // Nobody makes folders in /sys, whatever their rights.
    let project = Project::new();
    let run = project.run(DIPIR, &["run", "--out", "/sys/dipir"]);
    assert_eq!(run.code, Some(1));
    assert!(
        run.stderr.starts_with("error: cannot create /sys/dipir: ")
            && run.stderr.lines().count() == 1
            && run
                .stderr
                .contains("choose a folder that you may write with --out"),
        "{}",
        run.stderr
    );
}

/// A stage that ends just after `dipir` was killed has finished: it does not run again.
#[test]
fn hashes_that_a_killed_run_left_go_though_their_stage_does_not_run() {
    let project = Project::new();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let hashes = "{\"dipir_hashes\":1,\"known\":[],\"read\":[]}";
    project.write("out/.scene.hashes", hashes);
    let text = "mine, and no hashes";
    project.write("out/.light.hashes", text);
    let other = ["run", "-q", "--set", "composite.exposure_ev=0.5"];
    project.run(DIPIR, &other).expect_success();
    assert!(!project.path("out/.scene.hashes").exists());
    assert_eq!(project.read("out/.light.hashes"), text.as_bytes());
}
