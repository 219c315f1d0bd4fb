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
             composite  stale: max_samples changed from 16384 to 64; runs after scene\n"
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
fn independent_stages_may_run_side_by_side() {
    let project = whole::project();
    project
        .run(DIPIR, &["run", "-q", "-o", "one"])
        .expect_success();
    project
        .run(DIPIR, &["run", "-q", "-o", "two", "--jobs", "2"])
        .expect_success();
    for stage in ["scene", "light", "composite"] {
        let one = project.artifacts(&format!("one/{stage}"));
        assert!(one == project.artifacts(&format!("two/{stage}")), "{stage}");
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
    let run = project.run(DIPIR, &["run", "--set", "optimize.iteration=3"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.starts_with(
            "error: --set optimize.iteration=3: unknown key \"optimize.iteration\" (did you mean \
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
         light      dipir-light   reads scene, lora\n\
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
    let left: Vec<String> = std::fs::read_dir(project.path("out"))
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|name| !name.ends_with(".lock"))
        .collect();
    assert_eq!(left, ["notes.txt"]);
    std::fs::create_dir(project.path("out/scene")).unwrap();
    project.write("out/scene/thesis.tex", "years of work");
    project.run(DIPIR, &["clean"]).expect_error(
        2,
        "error: out/scene holds no stage.json, so no stage wrote it and it is left alone; nothing \
         was removed",
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
