//! Disks that are full, and disks that cannot be written: small ones in memory, each mounted for
//! one script alone. Where the system lets nobody mount, the tests say so and prove nothing.
#![cfg(target_os = "linux")]
use crate::project::*;
use crate::whole::{self, all_artifacts, run_all};

/// Runs `script` with an empty disk of `size` in the folder `disk`; `$1` is `dipir`. `None` if it
/// cannot be mounted.
fn on_a_disk_of(project: &Project, size: &str, script: &str) -> Option<Run> {
    std::fs::create_dir_all(project.path("disk")).unwrap();
    let script = format!("mount -t tmpfs -o size={size} none disk || exit 99\n{script}");
    let args = [
        "--user",
        "--map-root-user",
        "--mount",
        "sh",
        "-c",
        &script,
        "sh",
        DIPIR,
    ];
    let output = project.command("unshare", &args).output();
    let run = output.ok().map(Run::from);
    let run = run.filter(|run| run.code != Some(99) && !run.stderr.starts_with("unshare: "));
    if run.is_none() {
        eprintln!("no disk can be mounted here: not tested");
    }
    run
}

/// A disk that fills up while a stage writes: whatever it was about to write, the run ends with
/// one message that says so, and everything on the disk is as it was.
#[test]
fn a_full_disk_is_one_message_and_leaves_earlier_results() {
    let project = whole::project();
    run_all(&project, &[]);
    let before = all_artifacts(&project, "out");
    assert!(before.iter().all(|(_, files)| !files.is_empty()));
    // Every stage writes anew, and has 0 to 8 KiB for it: not even a manifest, or the first files.
    for (stage, kib) in [
        ("scene", 0),
        ("concepts", 4),
        ("lora", 4),
        ("light", 8),
        ("composite", 8),
    ] {
        let until = match stage {
            "concepts" | "lora" => "lora",
            _ => "composite",
        };
        // The filler takes what is left beyond some room.
        let script = format!(
            "cp -r out disk/out && dd if=/dev/zero of=disk/room bs=1k count={kib} 2>/dev/null
             cat /dev/zero > disk/filler 2>/dev/null; rm disk/room
             \"$1\" run -q --force --from {stage} --until {until} --out disk/out \
             --set concepts.cache=disk/cache; code=$?
             rm disk/filler; rm -rf after; cp -r disk/out after; exit $code"
        );
        let Some(run) = on_a_disk_of(&project, "16m", &script) else {
            return;
        };
        assert_eq!(run.code, Some(1), "{stage}: {run:?}");
        assert_eq!(
            run.stderr.matches("error: ").count(),
            1,
            "{stage}: {}",
            run.stderr
        );
        assert!(
            run.stderr
                .to_lowercase()
                .contains("no space left on device"),
            "{stage}: {}",
            run.stderr
        );
        assert!(all_artifacts(&project, "after") == before, "{stage}");
        let left = std::fs::read_dir(project.path("after")).unwrap();
        let left: Vec<_> = left
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .filter(|name| name.ends_with(".partial") || name.ends_with(".lock"))
            .collect();
        assert!(left.is_empty(), "{stage}: {left:?}");
    }
}

#[test]
fn what_fills_a_disk_can_be_cleaned_away() {
    let project = Project::new();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let script = "cp -r out disk/out && cat /dev/zero > disk/filler 2>/dev/null
                  \"$1\" clean --out disk/out && ls -A disk/out";
    if let Some(run) = on_a_disk_of(&project, "4m", script) {
        run.expect_success();
        assert_eq!(
            run.stdout,
            "removed disk/out/scene, disk/out/composite, disk/out/report.html\n"
        );
    }
}

#[test]
fn a_disk_that_cannot_be_written_can_be_read_and_is_one_message() {
    let project = Project::new();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let before = project.artifacts("out/composite");
    let read_only = "cp -r out disk/out && mount -o remount,ro disk";
    let script = format!("{read_only}\n\"$1\" run --out disk/out && \"$1\" status --out disk/out");
    let Some(run) = on_a_disk_of(&project, "4m", &script) else {
        return;
    };
    run.expect_success();
    assert!(
        run.stdout
            .starts_with("nothing to do: scene, composite are up to date\n"),
        "{}",
        run.stdout
    );
    let script = format!(
        "{read_only}\n\"$1\" run -q --force --out disk/out; code=$?; cp -r disk/out after; exit $code"
    );
    let run = on_a_disk_of(&project, "4m", &script).unwrap();
    run.expect_error(
        1,
        "error: cannot write disk/out/.run.lock: read-only file system; choose a folder that you \
         may write with --out (earlier results are untouched)",
    );
    assert!(project.artifacts("after/composite") == before);
}
