//! `dipir run` and its companions.
use std::path::Path;

use serde_json::{Value, json};

use crate::project::*;
use crate::whole;

#[test]
fn one_command_runs_what_is_needed_and_the_next_one_nothing() {
    let project = Project::new();
    let run = project.run(DIPIR, &["run"]);
    run.expect_success();
    assert_eq!(
        run.stderr,
        "scene: runs: it has not run yet\ncomposite: runs: it has not run yet\n"
    );
    assert!(run.stdout.contains("wrote out/scene in"), "{}", run.stdout);
    assert!(
        run.stdout
            .ends_with("ran scene, composite\nwrote out/report.html\n"),
        "{}",
        run.stdout
    );
    let run = project.run(DIPIR, &["run"]);
    run.expect_success();
    assert_eq!(
        run.stdout,
        "nothing to do: scene, composite are up to date\n"
    );
    assert_eq!(run.stderr, "");
    assert!(!project.path("out/light").exists() && !project.path("out/lora").exists());
}

#[test]
fn the_demo_of_the_readme_is_complete_and_runs_all_five_stages() {
    let project = Project::new();
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipeline.toml");
    let run = project.run(DIPIR, &["status", demo.to_str().unwrap(), "-o", "demo"]);
    run.expect_success();
    // Whatever it reads is there and valid, or this would be an error.
    assert_eq!(
        run.stdout,
        "scene      stale: it has not run yet\n\
         concepts   stale: it has not run yet\n\
         lora       waits for concepts, and runs if that changes\n\
         light      waits for scene, lora, and runs if that changes\n\
         composite  waits for scene, light, and runs if that changes\n"
    );
    assert!(!project.path("demo").exists());
}

#[test]
fn status_says_what_would_run_and_why() {
    let project = Project::new();
    let status = |args: &[&str]| {
        let run = project.run(DIPIR, &[&["status"], args].concat());
        run.expect_success();
        run.stdout
    };
    let unneeded = "concepts   not needed: [composite] environment gives the light\n\
                    lora       not needed: [composite] environment gives the light\n\
                    light      not needed: [composite] environment gives the light\n";
    assert_eq!(
        status(&[]),
        format!(
            "scene      stale: it has not run yet\n{unneeded}\
             composite  waits for scene, and runs if that changes\n"
        )
    );
    project.run(DIPIR, &["run", "-q"]).expect_success();
    assert_eq!(
        status(&[]),
        format!("scene      up to date\n{unneeded}composite  up to date\n")
    );
    project.write("object.obj", OBJECT.replace("1.1", "1.3"));
    assert_eq!(
        status(&["--set", "composite.max_samples=64"]),
        format!(
            "scene      stale: the object object.obj has other content\n{unneeded}\
             composite  stale: composite.max_samples changed from 16384 to 64; runs after scene\n"
        )
    );
    let value: Value = serde_json::from_str(&status(&["--json"])).unwrap();
    assert_eq!(
        value["stages"][0],
        json!({
            "stage": "scene", "executable": "dipir-scene", "state": "stale",
            "reasons": [{"reason": "input_changed", "role": "object", "path": "object.obj"}],
        })
    );
    assert_eq!(value["stages"][4]["state"], "waits");
}

#[test]
fn until_and_from_select_stages_and_force_runs_them_once_more() {
    let project = whole::project();
    let ran = |args: &[&str]| -> Value {
        let run = project.run(DIPIR, &[&["run", "--json"], args].concat());
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        value["ran"].clone()
    };
    assert_eq!(ran(&["--until", "scene"]), json!(["scene"]));
    assert_eq!(ran(&["--until", "lora"]), json!(["concepts", "lora"]));
    assert_eq!(ran(&[]), json!(["light", "composite"]));
    assert_eq!(ran(&["--from", "light"]), json!([]));
    assert_eq!(
        ran(&["--from", "light", "--force"]),
        json!(["light", "composite"])
    );
    assert_eq!(
        ran(&["--from", "light", "--until", "light", "--force"]),
        json!(["light"])
    );
    project.run(DIPIR, &["run", "--from", "lora"]).expect_error(
        2,
        "error: --from lora: the stage is not needed: [light] guidance = \"reference\" asks no \
         diffusion model",
    );
}

#[test]
fn a_plan_foretells_a_recovery_with_other_settings_by_the_last_one() {
    let project = whole::project();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let light = |iterations: &str| -> Value {
        let set = format!("light.iterations={iterations}");
        let run = project.run(DIPIR, &["run", "--plan", "--json", "--set", &set]);
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        let all = value["plan"].as_array().unwrap();
        all.iter().find(|e| e["stage"] == "light").unwrap().clone()
    };
    let [some, more] = ["100000", "200000"].map(light);
    let from = "from the times of the last run, which had other settings";
    assert_eq!(some["from"], from);
    assert!(more["seconds"].as_f64() > some["seconds"].as_f64());
}

#[test]
fn independent_stages_may_run_side_by_side() {
    let project = whole::project();
    // Under a model's guidance the scene and the concepts need nothing of each other.
    let made = |jobs: &str, out: &str| {
        let cache = format!("concepts.cache={out}-cache");
        let mut args = vec!["run", "--json", "--jobs", jobs, "-o", out];
        for set in ["light.guidance=lds", "light.iterations=2", cache.as_str()] {
            args.extend(["--set", set]);
        }
        let run = project.run(DIPIR, &args);
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        assert_eq!(value["ran"].as_array().unwrap().len(), whole::STAGES.len());
        whole::all_artifacts(&project, out)
    };
    let (one, two) = (made("1", "one"), made("2", "two"));
    for (a, b) in one.iter().zip(&two) {
        assert!(!a.1.is_empty() && a == b, "{}", a.0);
    }
}

#[test]
fn a_stage_that_fails_says_so_once_and_leaves_the_rest() {
    let project = Project::new();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    let before = project.artifacts("out/composite");
    std::fs::remove_file(project.path("object.obj")).unwrap();
    project.run(DIPIR, &["run"]).expect_error(
        1,
        "error: the scene cannot be set up\n  caused by: cannot read the object \"object.obj\": No \
         such file or directory",
    );
    assert!(project.artifacts("out/composite") == before);
}

#[test]
fn a_wrong_key_is_told_before_anything_runs() {
    let project = Project::new();
    let run = project.run(DIPIR, &["run", "--set", "light.iteration=3"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.starts_with(
            "error: --set light.iteration=3: unknown key \"light.iteration\" (did you mean \
             \"iterations\"?)"
        ),
        "{}",
        run.stderr
    );
    assert!(!project.path("out").exists());
}

#[test]
fn the_graph_is_shown_for_people_and_for_graphviz() {
    let project = whole::project();
    let graph = |args: &[&str]| {
        let run = project.run(DIPIR, &[&["graph"], args].concat());
        run.expect_success();
        run.stdout
    };
    assert_eq!(
        graph(&["--set", "light.guidance=lds"]),
        "scene      dipir-scene      reads no other stage\n\
         concepts   dipir-concepts   reads no other stage\n\
         lora       dipir-lora       reads concepts\n\
         light      dipir-light      reads scene, lora\n\
         composite  dipir-composite  reads scene, light\n"
    );
    let dot = graph(&["--dot"]);
    assert!(
        dot.contains("light -> composite;") && !dot.contains("lora -> light;"),
        "{dot}"
    );
}

#[test]
fn clean_removes_what_stages_wrote_and_nothing_else() {
    let project = Project::new();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    project.write("out/notes.txt", "mine");
    let run = project.run(DIPIR, &["clean", "--dry-run", "--stage", "composite"]);
    run.expect_success();
    assert_eq!(run.stdout, "would remove out/composite\n");
    assert!(project.path("out/composite").exists());
    project.run(DIPIR, &["clean"]).expect_success();
    assert_eq!(project.names("out"), ["notes.txt"]);
    std::fs::create_dir(project.path("out/scene")).unwrap();
    project.write("out/scene/thesis.tex", "years of work");
    project.run(DIPIR, &["clean"]).expect_error(
        2,
        "error: out/scene holds no stage.json, so no stage wrote it and it is left alone; nothing \
         was removed",
    );
}

#[test]
fn what_a_kill_in_the_middle_of_replacing_left_goes_with_the_next_run_or_clean() {
    let project = Project::new();
    let page = "<!doctype html>\n<html lang=\"en\">";
    let leave = || {
        project.write("out/.report.html.partial", "");
        project.write("out/..scene.hashes.partial", "{\"dipir_hashes\":1,");
        project.write("out/..light.hashes.partial", page);
    };
    std::fs::create_dir(project.path("out")).unwrap();
    leave();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    for gone in [".report.html.partial", "..scene.hashes.partial"] {
        assert!(!project.path("out").join(gone).exists(), "{gone}");
    }
    leave();
    project.run(DIPIR, &["clean"]).expect_success();
    // Another's file of such a name is kept; no lock is left.
    assert_eq!(project.names("out"), ["..light.hashes.partial"]);
    project.run(DIPIR, &["clean"]).expect_success();
    assert_eq!(project.names("out"), ["..light.hashes.partial"]);
}

#[test]
fn clean_says_what_it_removes_and_leaves_what_others_put_there() {
    let project = whole::project();
    project.write("pipeline.toml", {
        let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
        text.replace("cache = \"cache\"\n", "")
    });
    project
        .run(DIPIR, &["run", "-q", "--until", "concepts"])
        .expect_success();
    project.run(DIPIR, &["run", "-q"]).expect_success();
    project.write("out/scene/notes.txt", "mine");
    let cache = format!(
        "out/concepts-cache/{}",
        project.names("out/concepts-cache")[0]
    );
    project.write(&format!("{cache}/holiday.png"), "mine");
    let run = project.run(DIPIR, &["clean", "--cache", "--dry-run"]);
    run.expect_success();
    let would = run.stdout.clone();
    assert!(
        would.starts_with("would remove out/scene/effects.json, "),
        "{would}"
    );
    assert!(
        would.ends_with(&format!(
            "out/report.html\nleft alone, as no stage wrote it: out/scene/notes.txt, \
             {cache}/holiday.png\n"
        )),
        "{would}"
    );
    let run = project.run(DIPIR, &["clean", "--cache"]);
    run.expect_success();
    assert_eq!(run.stdout, would.replace("would remove", "removed"));
    assert_eq!(project.names("out"), ["concepts-cache", "scene"]);
    assert_eq!(project.names("out/scene"), [".dipir", "notes.txt"]);
    assert_eq!(project.names(&cache), [".dipir", "holiday.png"]);
    // The next run takes its folder again, with the notes in it.
    project.run(DIPIR, &["run", "-q"]).expect_success();
    assert_eq!(project.read("out/scene/notes.txt"), b"mine");
    assert!(project.path("out/scene/scene.json").exists());
}

/// Everything in the project's folder that no stage wrote.
const MINE: [&str; 6] = [
    "report.html",
    "lora-checkpoints/mine",
    "light-checkpoints/0123456789abcdef/checkpoint.safetensors",
    "concepts-cache/mine.png",
    ".scene.partial/mine",
    ".composite.hashes",
];

#[test]
fn the_folder_of_the_project_as_out_costs_nobody_anything() {
    let project = Project::new();
    for name in MINE {
        let path = project.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        project.write(name, "years of work");
    }
    let here = ["--set", "pipeline.out=."];
    let untouched = |project: &Project| {
        for name in MINE {
            assert_eq!(project.read(name), b"years of work", "{name}");
        }
    };
    let before = project.names("");
    std::fs::create_dir(project.path("inner")).unwrap();
    project.write("inner/pipeline.toml", project.read("pipeline.toml"));
    let before = [&before[..], &["inner".to_string()]].concat();
    let named =
        |names: Vec<String>| -> std::collections::BTreeSet<String> { names.into_iter().collect() };
    for (file, out) in [("pipeline.toml", "."), ("inner/pipeline.toml", "..")] {
        let set = format!("pipeline.out={out}");
        let run = project.run(DIPIR, &["clean", file, "--cache", "--set", &set]);
        run.expect_success();
        assert_eq!(run.stdout, "nothing to remove\n", "{out}");
        // No lock is left where nothing ran.
        assert_eq!(named(project.names("")), named(before.clone()));
        untouched(&project);
    }
    // What lies where a stage would write keeps it from running.
    let run = project.run(DIPIR, &[&["run"], &here[..]].concat());
    assert_eq!(run.code, Some(1), "{}", run.stderr);
    assert!(
        run.stderr.contains(".scene.partial is there already"),
        "{}",
        run.stderr
    );
    untouched(&project);
    std::fs::rename(project.path(".scene.partial"), project.path("away")).unwrap();
    let run = project.run(DIPIR, &[&["run"], &here[..]].concat());
    run.expect_success();
    let warning = "warning: there is no report: cannot write ./report.html: \"report.html\" is there \
                   already and dipir did not make it; move it away or choose another folder with \
                   --out";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
    project
        .run(DIPIR, &[&["clean"], &here[..]].concat())
        .expect_success();
    std::fs::rename(project.path("away"), project.path(".scene.partial")).unwrap();
    untouched(&project);
    assert_eq!(named(project.names("")), named(before));
}

#[test]
fn a_folder_with_a_foreign_stage_json_is_neither_run_over_nor_cleaned() {
    let project = Project::new();
    std::fs::create_dir_all(project.path("out/scene")).unwrap();
    project.write("out/scene/stage.json", "{\"stage\": \"theatre\"}");
    project.write("out/scene/painting.psd", "years of work");
    let why = "holds a stage.json that the stage \"scene\" did not write, so it is left alone";
    project.run(SCENE, &[]).expect_error(
        1,
        &format!(
            "error: out/scene is there already and {why}; move it away or choose another folder \
             with --out"
        ),
    );
    project
        .run(DIPIR, &["clean"])
        .expect_error(2, &format!("error: out/scene {why}; nothing was removed"));
    assert_eq!(project.names("out/scene"), ["painting.psd", "stage.json"]);
    assert_eq!(project.names("out"), ["scene"]);
}

#[cfg(unix)]
#[test]
fn links_at_the_names_of_our_files_are_not_followed() {
    let project = Project::new();
    project.write("thesis.tex", "years of work");
    for name in [
        ".run.lock",
        ".scene.lock",
        "report.html",
        ".report.html.partial",
    ] {
        std::fs::create_dir_all(project.path("out")).unwrap();
        let link = project.path("out").join(name);
        std::os::unix::fs::symlink("../thesis.tex", &link).unwrap();
        let run = project.run(DIPIR, &["run"]);
        assert!(run.stderr.contains(name), "{name}: {}", run.stderr);
        assert_eq!(project.read("thesis.tex"), b"years of work", "{name}");
        assert!(
            std::fs::symlink_metadata(&link).unwrap().is_symlink(),
            "{name}"
        );
        std::fs::remove_dir_all(project.path("out")).unwrap();
    }
}

#[cfg(unix)]
#[test]
fn every_input_is_read_once_to_be_hashed() {
    let project = whole::project();
    // A file that was written a moment ago could change without a trace.
    std::thread::sleep(std::time::Duration::from_millis(100));
    let hashed = |args: &[&str]| -> Vec<(String, u64)> {
        let run = project.run(DIPIR, &[&["run", "--json"], args].concat());
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        let reads = value["hashed"].as_object().unwrap().clone();
        let reads = reads
            .into_iter()
            .filter(|(path, _)| !path.starts_with("out/"));
        reads.map(|(path, n)| (path, n.as_u64().unwrap())).collect()
    };
    let all = |args: &[&str], least: usize| {
        let reads = hashed(args);
        assert!(reads.len() >= least, "{reads:?}");
        assert!(reads.iter().all(|(_, times)| *times == 1), "{reads:?}");
        assert!(
            reads.iter().any(|(path, _)| path == "background.png"),
            "{reads:?}"
        );
    };
    all(&[], 3);
    // Twelve files of a model, read by two stages; the photograph by one of them.
    all(&["--until", "lora"], 10);
    // Up to date: once more each, for nothing is trusted from one run to the next.
    all(&[], 3);
    project.write("object.obj", OBJECT.replace("1.1", "1.2"));
    std::thread::sleep(std::time::Duration::from_millis(100));
    all(&[], 3);
    assert!(
        !project
            .names("out")
            .iter()
            .any(|name| name.ends_with(".hashes"))
    );
}

#[test]
fn a_changed_model_is_told_in_one_phrase() {
    let project = whole::project();
    project
        .run(DIPIR, &["run", "-q", "--until", "concepts"])
        .expect_success();
    let value: Value = serde_json::from_slice(&project.read("out/concepts/stage.json")).unwrap();
    let files = value["inputs"].as_array().unwrap().len();
    assert!(files > 5, "{files}");
    let other = ["status", "--until", "concepts", "--set", "model.path=none"];
    let status = project.run(DIPIR, &other);
    status.expect_success();
    let line = status
        .stdout
        .lines()
        .find(|l| l.starts_with("concepts"))
        .unwrap();
    assert!(
        line.contains(&format!("{files} files of the model are no longer read")),
        "{line}"
    );
}

#[test]
fn a_project_is_named_in_three_ways_and_several_run_one_after_the_other() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    for name in ["a", "b"] {
        let table = format!("[pipeline]\nout = \"out-{name}\"\n");
        project.write(&format!("{name}.toml"), table + &text);
    }
    project
        .run(DIPIR, &["run", "-q", "-p", "a.toml"])
        .expect_success();
    project
        .run(DIPIR, &["status", "--pipeline", "a.toml"])
        .expect_success();
    let run = project.run(DIPIR, &["run", "a.toml", "b.toml"]);
    run.expect_success();
    assert!(
        run.stdout
            .starts_with("a.toml: nothing to do: scene, composite are up to date\n")
            && run.stdout.contains("b.toml: ran scene, composite\n"),
        "{}",
        run.stdout
    );
    assert!(project.path("out-b/composite/composite.png").exists());
    // One that fails is told, and the others run.
    project.write("b.toml", "[scene]\nx = 1\n");
    let run = project.run(DIPIR, &["run", "--json", "b.toml", "a.toml"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr
            .starts_with("error: b.toml\n  caused by: b.toml:2: "),
        "{}",
        run.stderr
    );
    let value: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(value["runs"][0], json!({"file": "b.toml", "exit_code": 2}));
    assert_eq!(value["runs"][1]["done"]["ran"], json!([]));
    project
        .run(DIPIR, &["status", "a.toml", "b.toml"])
        .expect_error(
            2,
            "error: b.toml: this takes one file; dipir run takes several",
        );
    project
        .run(DIPIR, &["run", "-o", "x", "a.toml", "b.toml"])
        .expect_error(
            2,
            "error: --out with several files: each has a folder of its own, [pipeline] out",
        );
}

#[test]
fn make_may_drive_the_stages_instead() {
    let rules = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/pipeline.mk");
    let project = whole::project();
    let folder = Path::new(SCENE).parent().unwrap();
    let make = |goal: &[&str]| {
        let bin = format!("BIN={}/", folder.display());
        let rules = rules.to_str().unwrap();
        let fixed = [
            "-f",
            rules,
            &bin,
            "OUT=out",
            "REFERENCE=1",
            "INPUTS=object.obj",
        ];
        let output = project
            .command("make", &[&fixed[..], goal].concat())
            .output();
        output.ok().map(Run::from)
    };
    let Some(run) = make(&[]) else {
        eprintln!("make is not installed: its rules are not tested");
        return;
    };
    run.expect_success();
    for line in [
        "wrote out/scene in",
        "wrote out/light in",
        "wrote out/composite in",
    ] {
        assert!(run.stdout.contains(line), "{line}: {}", run.stdout);
    }
    assert!(
        make(&[])
            .unwrap()
            .stdout
            .contains("Nothing to be done for 'all'")
    );
    // The other way round they agree, too.
    let run = project.run(DIPIR, &["run"]);
    assert!(
        run.stdout
            .starts_with("nothing to do: scene, light, composite are up to date\n"),
        "{}",
        run.stdout
    );
    make(&["out/lora/stage.json"]).unwrap().expect_success();
    assert!(project.path("out/lora/lora.safetensors").exists());
}
