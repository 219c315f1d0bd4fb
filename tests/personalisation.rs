//! `dipir-concepts` and `dipir-lora` as a user runs them, on a small model in
//! the layout of Stable Diffusion.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;
use serde_json::Value;
use tempfile::TempDir;

const CONCEPTS: &str = env!("CARGO_BIN_EXE_dipir-concepts");
const LORA: &str = env!("CARGO_BIN_EXE_dipir-lora");

/// A photograph and a configuration for the model `family`.
fn project(family: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (36, 24);
    let pixels = (0..width * height)
        .map(|n| Vec3::new((n % width) as f32 / 36.0, (n / width) as f32 / 24.0, 0.5))
        .collect();
    let photo = DisplayImage(Raster::from_pixels(width, height, pixels));
    write_png(folder.path().join("background.png"), &photo).unwrap();
    let model = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("lib/diffusion/tests/references")
        .join(family);
    let config = format!(
        "[model]\npath = {model:?}\n\
         [scene]\nbackground = \"background.png\"\nclass = \"toy\"\n\
         [concepts]\ncount = 3\nsteps = 2\n\
         [lora]\nsteps = 3\nlearn_word = true\nrecompute = false\n"
    );
    fs::write(folder.path().join("pipeline.toml"), config).unwrap();
    folder
}

fn command(folder: &Path, executable: &str, args: &[&str]) -> Command {
    let mut command = Command::new(executable);
    command
        .args(args)
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// Runs to the end and returns what `--json` printed.
#[track_caller]
fn run(folder: &Path, executable: &str, args: &[&str]) -> Value {
    let output: Output = command(folder, executable, args)
        .arg("--json")
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stderr}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Every file below a stage's folder but `stage.json`, which holds times.
fn artifacts(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = vec![];
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(artifacts(&path));
        } else if path.file_name().unwrap() != "stage.json" {
            files.push((path.clone(), fs::read(&path).unwrap()));
        }
    }
    files.sort();
    files
}

#[test]
fn concepts_and_lora_run_on_every_kind_of_model() {
    for family in ["sd15", "sd21", "inpaint"] {
        let folder = project(family);
        let path = |name: &str| folder.path().join("out").join(name);
        assert_eq!(run(folder.path(), CONCEPTS, &[])["made"], 3);
        let list: Value =
            serde_json::from_slice(&fs::read(path("concepts/concepts.json")).unwrap()).unwrap();
        assert_eq!(list["concepts"].as_array().unwrap().len(), 3);
        assert!(
            list["concepts"][0]["prompt"]
                .as_str()
                .unwrap()
                .contains("toy")
        );
        for name in [
            "concepts/images/0002.png",
            "concepts/latents.safetensors",
            "concepts/stage.json",
        ] {
            assert!(path(name).is_file(), "{family}: {name}");
        }
        let done = run(folder.path(), LORA, &["--set", "lora.sample_every=3"]);
        assert_eq!(
            (&done["steps"], &done["resumed_at"]),
            (&3.into(), &0.into())
        );
        for name in [
            "lora/lora.safetensors",
            "lora/lora_kohya.safetensors",
            "lora/word.safetensors",
            "lora/training.json",
            "lora/training.csv",
            "lora/sheet.png",
            "lora/samples/000003.png",
            "lora/stage.json",
        ] {
            assert!(path(name).is_file(), "{family}: {name}");
        }
        // Before the first update, and after the last one.
        let csv = fs::read_to_string(path("lora/training.csv")).unwrap();
        assert_eq!(csv.lines().count(), 1 + 1 + 3, "{csv}");
        assert!(done["loss_at_start"].as_f64().unwrap() > 0.0 && done["change"].is_number());
        assert!(
            !path("lora-checkpoints").exists(),
            "checkpoints go when the result is there"
        );
    }
}

#[test]
fn more_concepts_begin_with_the_earlier_ones_and_take_them_from_the_cache() {
    let folder = project("sd15");
    run(folder.path(), CONCEPTS, &[]);
    let first = artifacts(&folder.path().join("out/concepts/images"));
    let done = run(folder.path(), CONCEPTS, &["--set", "concepts.count=5"]);
    assert_eq!((&done["made"], &done["reused"]), (&2.into(), &3.into()));
    let all = artifacts(&folder.path().join("out/concepts/images"));
    assert_eq!(all[..3], first[..]);
    // An image that is missing from the cache, as after a kill, comes back the same.
    let cache = fs::read_dir(folder.path().join("out/concepts-cache"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    fs::remove_file(cache.path().join("0001.safetensors")).unwrap();
    let done = run(folder.path(), CONCEPTS, &["--set", "concepts.count=5"]);
    assert_eq!((&done["made"], &done["reused"]), (&1.into(), &4.into()));
    assert_eq!(artifacts(&folder.path().join("out/concepts/images")), all);
    // Another seed is another cache.
    assert_eq!(run(folder.path(), CONCEPTS, &["--seed", "1"])["reused"], 0);
}

#[test]
fn scenes_of_one_class_share_a_cache() {
    let cache = tempfile::tempdir().unwrap();
    let setting = format!("concepts.cache={:?}", cache.path());
    let images = |class: &str, seed: &str| {
        let folder = project("sd15");
        let class = format!("scene.class={class}");
        let args = ["--set", &setting, "--set", &class, "--seed", seed];
        let done = run(folder.path(), CONCEPTS, &args);
        (
            done["made"].clone(),
            artifacts(&folder.path().join("out/concepts/images")).len(),
        )
    };
    assert_eq!(images("toy", "0"), (3.into(), 3));
    assert_eq!(images("toy", "0"), (0.into(), 3), "another scene");
    assert_eq!(images("car", "0"), (3.into(), 3), "another class");
    assert_eq!(images("toy", "7"), (3.into(), 3), "other noise");
}

#[test]
fn scenes_of_one_photograph_train_once_and_a_damaged_adapter_is_trained_anew() {
    let cache = tempfile::tempdir().unwrap();
    let setting = format!("lora.cache={:?}", cache.path());
    let adapter = |more: &[&str]| {
        let folder = project("sd15");
        run(folder.path(), CONCEPTS, &[]);
        let mut args = vec!["--set", setting.as_str()];
        args.extend(more);
        let done = run(folder.path(), LORA, &args);
        assert_eq!(done["steps"], 3);
        let found = done["from_cache"].as_bool().unwrap();
        (
            found,
            fs::read(folder.path().join("out/lora/lora.safetensors")).unwrap(),
        )
    };
    let (found, first) = adapter(&[]);
    assert!(!found);
    assert!(adapter(&[]) == (true, first.clone()), "another scene");
    assert!(!adapter(&["--set", "lora.rank=2"]).0, "other settings");
    for entry in fs::read_dir(cache.path()).unwrap() {
        fs::write(entry.unwrap().path().join("lora.safetensors"), "mine").unwrap();
    }
    assert!(adapter(&[]) == (false, first), "a damaged one");
}

#[test]
fn a_time_budget_ends_the_training_early_and_says_so() {
    let folder = project("sd15");
    let args = [
        "--set",
        "concepts.count=0",
        "--set",
        "lora.time_budget_s=1e-9",
    ];
    let output = command(folder.path(), LORA, &args).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        text.contains("1 updates of 3 within lora.time_budget_s"),
        "{text}"
    );
    // One update moves nothing.
    let warning = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        warning.contains("it changes nothing that can be seen"),
        "{warning}"
    );
}

#[test]
fn concepts_of_another_class_or_model_are_warned_of() {
    let folder = project("sd15");
    run(folder.path(), CONCEPTS, &[]);
    let warnings = |args: &[&str]| {
        let output = command(folder.path(), LORA, args).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{text}");
        text
    };
    assert!(!warnings(&[]).contains("other settings"));
    let other = warnings(&["--set", "scene.class=car"]);
    for part in [
        "the concept images were made",
        "scene.class changed from \"toy\" to \"car\"",
        "run dipir-concepts again",
    ] {
        assert!(other.contains(part), "{other}");
    }
    let copy = folder.path().join("copy");
    let family =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("lib/diffusion/tests/references/sd15");
    for part in ["", "unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
        fs::create_dir_all(copy.join(part)).unwrap();
        for entry in fs::read_dir(family.join(part)).unwrap().flatten() {
            if entry.path().is_file() {
                fs::copy(entry.path(), copy.join(part).join(entry.file_name())).unwrap();
            }
        }
    }
    assert!(!warnings(&["--set", "model.path=copy"]).contains("another model"));
    fs::write(copy.join("model_index.json"), "{\"_name\": 1}").unwrap();
    assert!(warnings(&["--set", "model.path=copy"]).contains("(another model)"));
}

#[test]
fn a_killed_lora_run_resumes_to_the_same_bytes() {
    let folder = project("sd15");
    run(folder.path(), CONCEPTS, &[]);
    let args = ["--set", "lora.steps=60", "--set", "lora.checkpoint_every=1"];
    let mut child = command(folder.path(), LORA, &args).spawn().unwrap();
    let checkpoints = folder.path().join("out/lora-checkpoints");
    let deadline = Instant::now() + Duration::from_secs(60);
    let written = || {
        let mut folders = fs::read_dir(&checkpoints).into_iter().flatten().flatten();
        folders.any(|f| f.path().join("checkpoint.safetensors").is_file())
    };
    while !written() {
        assert!(Instant::now() < deadline && child.try_wait().unwrap().is_none());
        std::thread::yield_now();
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!folder.path().join("out/lora").exists());
    let done = run(folder.path(), LORA, &args);
    assert!(done["resumed_at"].as_u64().unwrap() > 0, "{done}");
    let resumed = artifacts(&folder.path().join("out/lora"));
    let done = run(folder.path(), LORA, &args);
    assert_eq!(done["resumed_at"], 0);
    assert!(
        artifacts(&folder.path().join("out/lora")) == resumed,
        "the resumed run has other bytes"
    );
}

#[test]
fn what_is_missing_or_impossible_is_said_with_a_remedy() {
    let folder = project("sd15");
    let fails = |executable: &str, args: &[&str], code: i32, part: &str| {
        let output = command(folder.path(), executable, args).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(stderr.contains(part), "{part:?} is not in: {stderr}");
        assert!(output.stdout.is_empty());
    };
    fails(LORA, &[], 1, "dipir-concepts");
    fails(
        CONCEPTS,
        &["--set", "model.path=nowhere"],
        1,
        "model.path = \"nowhere\"",
    );
    fails(
        CONCEPTS,
        &["--set", "model.precision=f8"],
        2,
        "f32, bf16, f16",
    );
    fails(CONCEPTS, &["--set", "concepts.guidence=3"], 2, "guidance");
    fails(
        CONCEPTS,
        &["--set", "concepts.size=15"],
        2,
        "concepts.size: 15 is out of range; accepted: multiples of",
    );
    fails(
        CONCEPTS,
        &["--set", "pipeline.device=tpu"],
        2,
        "cpu, cuda:N, metal:N, auto",
    );
    fails(
        CONCEPTS,
        &["--set", "pipeline.device=metal:0"],
        2,
        "--features metal",
    );
    fails(LORA, &["--set", "lora.min_crop=0"], 2, "above 0, up to 1");
    for (executable, setting, part) in [
        (LORA, "lora.alpha=inf", "lora.alpha: inf is out of range"),
        (
            LORA,
            "lora.word=my word",
            "lora.word: \"my word\" cannot be learnt",
        ),
        (
            CONCEPTS,
            "concepts.guidance=nan",
            "concepts.guidance: NaN is out of range",
        ),
        (
            CONCEPTS,
            "concepts.steps=1001",
            "concepts.steps: 1001 is out of range; accepted: up to 1000",
        ),
    ] {
        fails(executable, &["--set", setting], 2, part);
    }
    // Before the training.
    let args = [
        "--set",
        "concepts.count=0",
        "--set",
        "lora.sheet_steps=1001",
    ];
    let part = "lora.sheet_steps: 1001 is out of range; accepted: up to 1000";
    fails(LORA, &args, 2, part);
    fails(
        LORA,
        &[
            "--set",
            "lora.path=nowhere.safetensors",
            "--set",
            "lora.learn_word=false",
        ],
        2,
        "lora.path: \"nowhere.safetensors\" is not there",
    );
    // Without concept preservation no concepts are needed.
    run(folder.path(), LORA, &["--set", "concepts.count=0"]);
}
