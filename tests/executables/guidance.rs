//! Light recovered under the guidance of a diffusion model: small ones with random weights, which
//! know nothing, so that only the machinery is looked at.
use std::path::PathBuf;

use dipir_optimize::lighting::Lighting;
use serde_json::{Value, json};

use crate::project::*;

/// A project that is guided by the small model of a family.
fn project(family: &str, more: &str) -> Project {
    let project = Project::new();
    let model = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("lib/diffusion/tests/references")
        .join(family);
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (scene, _) = text.split_once("[composite]").unwrap();
    let table = format!(
        "[model]\npath = {model:?}\n\
         [light]\niterations = 3\nlobes = 6\nenvironment = [16, 8]\nsamples = 16\nadapt = false\n{more}\n\
         [composite]\ntarget_error = 0.05\n"
    );
    project.write("pipeline.toml", format!("{scene}{table}"));
    project.run(SCENE, &[]).expect_success();
    project
}

fn history(project: &Project) -> Vec<Value> {
    serde_json::from_slice(&project.read("out/light/history.json")).unwrap()
}

#[test]
fn every_family_and_every_kind_of_guidance_moves_the_light() {
    for (family, guidance) in [
        ("sd15", "lds"),
        ("sd21", "sds"),
        ("inpaint", "csd"),
        ("sd15", "sdedit"),
    ] {
        let project = project(family, &format!("guidance = \"{guidance}\""));
        let run = project.run(OPTIMIZE, &[]);
        run.expect_success();
        let rows = history(&project);
        assert_eq!(rows.len(), 3, "{family}");
        for row in &rows {
            assert!(
                row["gradient_norm"].as_f64().unwrap() > 0.0,
                "{family}: {row}"
            );
            // The largest timestep falls from 0.6 to 0.3.
            let t = row["t"].as_f64().unwrap();
            assert!((0.02..=0.6).contains(&t), "{family}: {t}");
        }
        let light = Lighting::read(&project.path("out/light/lighting.json")).unwrap();
        assert_eq!(light.lobes.len(), 6);
        project.run(COMPOSITE, &[]).expect_success();
    }
}

#[test]
fn the_same_bytes_for_any_number_of_threads_and_other_bytes_for_another_seed() {
    let project = project("inpaint", "");
    let light = |args: &[&str]| {
        project.run(OPTIMIZE, args).expect_success();
        project.read("out/light/lighting.json")
    };
    let one = light(&["-s", "pipeline.threads=1"]);
    let two = light(&["-s", "pipeline.threads=2"]);
    let other = light(&["-s", "pipeline.seed=5"]);
    assert!(one == two && one != other);
}

#[test]
fn what_cannot_guide_is_refused_with_what_to_do() {
    let project = project("sd15", "");
    for (set, code, says) in [
        ("light.start=read", 2, "light.start"),
        ("light.timesteps=[[0.9, 0.5]]", 2, "light.timesteps"),
        (
            "light.timesteps=[[0.1, 0.5], [0.1, 0.4], [0.1, 0.3]]",
            2,
            "one pair, or two",
        ),
        ("light.draws=0", 2, "1 to 64"),
        ("light.adapt=true", 1, "dipir-lora"),
        ("model.path=nowhere", 1, "nowhere"),
    ] {
        let run = project.run(OPTIMIZE, &["-s", set]);
        assert_eq!(run.code, Some(code), "{set}: {}", run.stderr);
        assert!(run.stderr.contains(says), "{set}: {}", run.stderr);
        assert!(!project.path("out/light").exists(), "{set}");
    }
}

#[test]
fn without_a_path_the_embedded_model_reads_the_light() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (scene, _) = text.split_once("[composite]").unwrap();
    let table = "[light]\nstart = \"encoder\"\niterations = 1\nlobes = 6\n\
                 environment = [16, 8]\nsamples = 16\nadapt = false\n";
    project.write("pipeline.toml", format!("{scene}{table}"));
    project.run(SCENE, &[]).expect_success();
    project.run(OPTIMIZE, &[]).expect_success();
    let reading: Value = serde_json::from_slice(&project.read("out/light/reading.json")).unwrap();
    let azimuth = |of: &str| reading[of]["description"]["azimuth"].as_f64().unwrap();
    // A minimum on half degrees.
    let apart = (azimuth("light") - azimuth("encoder")).rem_euclid(std::f64::consts::TAU);
    assert!(apart.min(std::f64::consts::TAU - apart) < 0.01, "{reading}");
    assert_eq!(reading["energies"], json!([]));
    let stage: Value = serde_json::from_slice(&project.read("out/light/stage.json")).unwrap();
    let inputs = stage["inputs"].as_array().unwrap();
    let unet = "embedded/unet/diffusion_pytorch_model.safetensors";
    assert!(inputs.iter().any(|i| i["path"] == unet), "{inputs:?}");
    // The same files in a folder are the same model.
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("data/prior");
    let set = format!("model.path={folder:?}");
    let light = project.read("out/light/lighting.json");
    project.run(OPTIMIZE, &["-s", &set]).expect_success();
    assert_eq!(project.read("out/light/lighting.json"), light);
}
