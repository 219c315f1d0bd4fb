//! Which stages run again after which change: exactly those that depend on it.
use std::fs;

use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;

use crate::project::*;
use crate::whole::{self, STAGES, run_all};

/// Changes the project's file and runs what has become stale.
#[track_caller]
fn after(project: &Project, from: &str, to: &str) -> Vec<String> {
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    assert!(text.contains(from), "{from}");
    project.write("pipeline.toml", text.replace(from, to));
    run_all(project, &[])
}

#[test]
fn a_changed_key_runs_the_stages_that_depend_on_it_and_no_other() {
    let project = whole::project();
    assert_eq!(run_all(&project, &[]), STAGES);
    assert!(run_all(&project, &[]).is_empty());
    let table: [(&str, &str, &[&str]); 11] = [
        ("# A tetrahedron", "# Still a tetrahedron", &[]),
        ("count = 2", "count = 2\n\n", &[]),
        ("checkpoint_every = 10", "checkpoint_every = 9", &[]),
        (
            "iterations = 40",
            "iterations = 45",
            &["light", "composite"],
        ),
        (
            "lobes = 6",
            "lobes = 6\nlearning_rates = { tone = 0.004 }",
            &["light", "composite"],
        ),
        ("steps = 6", "steps = 6\nrank = 2", &["lora"]),
        ("count = 2", "count = 3", &["concepts", "lora"]),
        ("target_error = 0.05", "target_error = 0.04", &["composite"]),
        ("class = \"toy\"", "class = \"cup\"", &["concepts", "lora"]),
        (
            "path = \"object.obj\"",
            "path = \"object.obj\"\nyaw_deg = 20.0",
            &["scene", "light", "composite"],
        ),
        (
            "samples = 16",
            "samples = 20",
            &["scene", "light", "composite"],
        ),
    ];
    for (from, to, expected) in table {
        assert_eq!(after(&project, from, to), expected, "{from} -> {to}");
        assert!(run_all(&project, &[]).is_empty(), "once is enough: {to}");
    }
}

#[test]
fn defaults_that_are_written_down_and_limits_that_only_refuse_run_nothing() {
    let project = Project::new();
    let run = || {
        let run = project.run(DIPIR, &["run"]);
        run.expect_success();
        run.stdout
    };
    assert!(run().contains("ran scene, composite\n"));
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let written = text
        .replace(
            "class = \"toy\"",
            "transfer = \"srgb\"\nlimits = { triangles = 30000000 }\neffects = { shadow = \"auto\", tolerance = 0.002 }",
        )
        .replace(
            "object.obj\"",
            "object.obj\"\nposition = [0.0, 0.0, 0.0]\nyaw_deg = 0.0\nanchor = \"origin\"",
        )
        .replace("look_at", "up = [0.0, 1.0, 0.0]\nlook_at");
    project.write("pipeline.toml", &written);
    let stdout = run();
    let nothing = "nothing to do: scene, composite are up to date\n";
    assert!(stdout.starts_with(nothing), "{stdout}");
    // What is no default is told with the default that it was.
    project.write(
        "pipeline.toml",
        written.replace("[0.0, 0.0, 0.0]\nyaw", "[0.5, 0.0, 0.0]\nyaw"),
    );
    let status = project.run(DIPIR, &["status"]).stdout;
    let told = "scene      stale: scene.objects.0.position.0 changed from 0.0 to 0.5\n";
    assert!(status.starts_with(told), "{status}");
}

#[test]
fn changed_bytes_of_an_input_run_the_stages_that_read_it() {
    let project = whole::project();
    run_all(&project, &[]);
    project.write("object.obj", OBJECT.replace("1.1", "1.2"));
    assert_eq!(run_all(&project, &[]), ["scene", "light", "composite"]);
    let reference = project.read("reference.exr");
    project.write("reference.exr", &reference);
    assert!(run_all(&project, &[]).is_empty(), "touched, not changed");
    let photo = project.read("background.png");
    fs::write(project.path("background.png"), &photo).unwrap();
    assert!(run_all(&project, &[]).is_empty());
}

#[test]
fn a_texture_that_comes_late_runs_the_scene_again() {
    let project = Project::new();
    project.write("object.obj", format!("mtllib a.mtl\nusemtl m\n{OBJECT}"));
    let status = || project.run(DIPIR, &["status"]).stdout;
    let run = |done: &str| {
        let run = project.run(DIPIR, &["run", "--until", "scene"]);
        run.expect_success();
        assert_eq!(run.stdout == UP_TO_DATE, done.is_empty(), "{}", run.stdout);
        assert!(run.stderr.contains(done), "{done}: {}", run.stderr);
    };
    const UP_TO_DATE: &str = "nothing to do: scene is up to date\n";
    run("material library \"a.mtl\" cannot be read (No such file or directory); grey is used");
    run("");
    project.write("a.mtl", "newmtl m\nmap_Kd paint.png\n");
    let told = status();
    assert!(
        told.contains("the part of object a.mtl is there now"),
        "{told}"
    );
    run("the texture \"paint.png\" cannot be read (No such file or directory);");
    run("");
    // Elsewhere nothing is there, too.
    let moved = tempfile::tempdir().unwrap();
    let names = ["pipeline.toml", "background.png", "object.obj", "a.mtl"];
    for name in names {
        std::fs::copy(project.path(name), moved.path().join(name)).unwrap();
    }
    let there = moved.path().join("out");
    std::fs::rename(project.path("out"), &there).unwrap();
    let file = moved.path().join("pipeline.toml");
    let args = ["run", "--until", "scene", file.to_str().unwrap()];
    assert_eq!(project.run(DIPIR, &args).stdout, UP_TO_DATE);
    std::fs::rename(there, project.path("out")).unwrap();
    write_png(
        project.path("paint.png"),
        &DisplayImage(Raster::filled(2, 2, Vec3::new(1.0, 0.0, 0.0))),
    )
    .unwrap();
    let told = status();
    assert!(
        told.contains("the part of object paint.png is there now"),
        "{told}"
    );
    run("the part of object paint.png is there now");
    run("");
    assert!(!status().contains("is there now"));
}

#[test]
fn moving_the_folder_changes_nothing() {
    let project = whole::project();
    run_all(&project, &[]);
    let here = project.path("moved");
    fs::create_dir(&here).unwrap();
    for entry in fs::read_dir(project.path("")).unwrap() {
        let path = entry.unwrap().path();
        if path != here {
            fs::rename(&path, here.join(path.file_name().unwrap())).unwrap();
        }
    }
    let run = project.run(DIPIR, &["run", "moved/pipeline.toml"]);
    run.expect_success();
    assert_eq!(
        run.stdout,
        "nothing to do: scene, light, composite are up to date\n"
    );
}

#[test]
fn a_second_scene_of_the_same_class_and_model_shares_the_concept_images() {
    let project = whole::project();
    run_all(&project, &[]);
    let other = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let cache = project.path("cache");
    let text = text.replace("cache = \"cache\"", &format!("cache = {cache:?}"));
    other.write("pipeline.toml", text);
    other.write("reference.exr", project.read("reference.exr"));
    let run = other.run(DIPIR, &["run", "--until", "concepts", "--json"]);
    run.expect_success();
    let value: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    let result = &value["results"][0]["result"];
    assert_eq!((&result["made"], &result["reused"]), (&0.into(), &2.into()));
    assert!(project.artifacts("out/concepts") == other.artifacts("out/concepts"));
}
