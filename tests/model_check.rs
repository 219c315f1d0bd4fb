//! `dipir-model check` and `dipir run --plan` as a user runs them.

use std::path::PathBuf;
use std::process::{Command, Output};

use serde_json::Value;

fn check(args: &[&str]) -> Output {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_dipir-model"));
    command.arg("check").args(args).current_dir(folder.path());
    command.output().unwrap()
}

fn reference(family: &str) -> String {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("lib/diffusion/tests/references");
    folder.join(family).display().to_string()
}

#[test]
fn every_part_agrees_and_is_timed_on_the_cpu() {
    let output = check(&[&reference("sd21"), "--device", "cpu", "--json"]);
    assert_eq!(output.status.code(), Some(0));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&report["device"], &report["precision"]),
        (&"cpu".into(), &"f32".into())
    );
    let parts = report["agreement"].as_array().unwrap();
    assert!(parts.len() >= 5 && parts.iter().all(|p| p["error"].as_f64().unwrap() < 1e-4));
    assert!(report["times"]["lora_step_s"].as_f64().unwrap() > 0.0);
    let output = check(&[&reference("sd15"), "--small", "--device", "cpu"]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    for part in [
        "text encoder",
        "VAE encoder's gradient",
        "one update of a LoRA",
    ] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn what_was_read_is_told_and_a_light_that_the_model_cannot_read_stops_no_check() {
    let pipeline = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("pipeline.toml");
    let pipeline = pipeline.display().to_string();
    let args = [
        "--small",
        "--device",
        "cpu",
        "--json",
        "--set",
        "light.start=read",
        "--set",
        "light.guidance=lds",
    ];
    let model = reference("sd15");
    let output = check(&[&[model.as_str(), "-p", pipeline.as_str()], &args[..]].concat());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{text}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let why = report["no_forecast"].as_str().unwrap();
    assert!(why.contains("--set light.start=auto"), "{why}");
    assert!(report["works"].as_array().unwrap().is_empty());
    let found = &report["description"];
    assert_eq!(found["prediction"], "epsilon");
    assert_eq!(
        (&found["inpainting"], &found["timesteps"]),
        (&false.into(), &1000.into())
    );
    assert!(found["stored"]["unet"][0].is_string() && found["betas"][0].is_number());
    let output = check(&[
        &model,
        "--small",
        "--device",
        "cpu",
        "--prediction",
        "v_prediction",
    ]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    for part in ["prediction   v_prediction", "on the disk", "family"] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn a_wrong_key_is_named_before_the_model_is_read() {
    let pipeline = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("pipeline.toml");
    let pipeline = pipeline.display().to_string();
    let wrong = "--device cpu --set light.start=neutral --set light.draws=0 -p";
    let wrong: Vec<_> = wrong.split(' ').chain([pipeline.as_str()]).collect();
    // Reading the model would end with an error of its own.
    let output = check(&[&["missing.safetensors"], &wrong[..]].concat());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("light.draws"), "{text}");
}

#[test]
fn a_gpu_that_is_not_there_is_an_error_if_it_was_named_and_a_line_if_not() {
    let output = check(&[&reference("sd15"), "--small", "--device", "cuda:7"]);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("--device \"cuda:7\"") && text.contains("\"auto\""),
        "{text}"
    );
    let output = check(&["missing.safetensors", "--device", "cpu"]);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("missing.safetensors"), "{text}");
}

#[test]
fn a_plan_tells_time_and_memory_of_every_stage_and_starts_none() {
    let folder = tempfile::tempdir().unwrap();
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_dipir"));
    command.args(["run", "--plan", "--json", "--pipeline"]);
    command.arg(root.join("pipeline.toml"));
    command
        .arg("--set")
        .arg(format!("model.path={:?}", reference("sd15")));
    command
        .args(["--set", "light.start=neutral", "--out"])
        .arg(folder.path().join("out"));
    let output = command.output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{text}");
    let plan: Value = serde_json::from_slice(&output.stdout).unwrap();
    let stages = plan["plan"].as_array().unwrap();
    let of = |name: &str| stages.iter().find(|s| s["stage"] == name).unwrap();
    for stage in ["concepts", "lora", "light"] {
        assert!(of(stage)["seconds"].as_f64().unwrap() > 0.0, "{plan}");
    }
    assert!(of("composite")["seconds"].is_null());
    assert!(!folder.path().join("out/scene").exists());
}
