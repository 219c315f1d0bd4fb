//! `dipir-pretrain`: runs from a model, and errors.
use std::time::{Duration, Instant};

use dipir_light::environment::EnvironmentMap;
use glam::Vec3;
use serde_json::Value;

use crate::project::{PRETRAIN, Project, Run};

/// The embedded model's folder.
const PRIOR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/prior");

const NO_WEIGHTS: &str =
    "cannot read nowhere/unet/diffusion_pytorch_model.safetensors: No such file or directory";

/// Two updates on two scenes.
const TINY: [&str; 11] = [
    "train",
    "--out",
    "model",
    "--cache",
    "cache",
    "--scenes",
    "2",
    "--samples",
    "24",
    "--batch",
    "12",
];

#[test]
fn a_run_starts_from_a_model_and_continues_from_its_checkpoint() {
    let project = Project::new();
    let run = |more: &[&str]| {
        let quiet = ["--json", "--quiet", "--checkpoint-every", "1"];
        let run = project.run(
            PRETRAIN,
            &[&TINY[..], &["--relit", "1"], &quiet, more].concat(),
        );
        run.expect_success();
        // --quiet also silences checkpoints.
        assert_eq!(run.stderr, "");
        serde_json::from_str::<Value>(&run.stdout).unwrap()
    };
    let from = ["--from", PRIOR, "--learning-rate", "1e-6"];
    let first = run(&from);
    assert_eq!(
        (first["examples"].as_u64(), first["resumed_at"].as_u64()),
        (Some(24), Some(0))
    );
    let weights = "model/unet/diffusion_pytorch_model.safetensors";
    let trained = project.read(weights);
    let again = run(&from);
    assert_eq!(again["resumed_at"].as_u64(), Some(24));
    assert_eq!(project.read(weights), trained);
    // A run from a model has a smaller loss than one from random weights, and a deeper one starts with the same loss.
    let afresh = |more: &[&str]| {
        std::fs::remove_file(project.path("cache/checkpoint.safetensors")).unwrap();
        run(more)
    };
    let deeper = afresh(&[&from[..], &["--layers", "2"]].concat());
    let config: Value = serde_json::from_slice(&project.read("model/unet/config.json")).unwrap();
    assert_eq!(config["layers_per_block"].as_u64(), Some(2));
    let unknown = afresh(&[]);
    let [known, deeper, unknown] = [&first, &deeper, &unknown].map(|r| r["loss"].as_f64().unwrap());
    assert!(known < 0.5 * unknown, "{known} {unknown}");
    // Measured: .005 apart. Random weights are more than twice as far off.
    assert!((deeper / known - 1.0).abs() < 1e-2, "{deeper} {known}");

    let check = [
        "check", "model", "--first", "1000", "--scenes", "2", "--draws", "1", "--json",
    ];
    let found = project.run(PRETRAIN, &check);
    found.expect_success();
    let found: Value = serde_json::from_str(&found.stdout).unwrap();
    assert_eq!(found["scenes"].as_u64(), Some(2), "{found}");
    assert!(found["over_opposite"].is_f64() && found["encoder"].is_null());
    // A folder with a light encoder has a column for it.
    let encoder = std::path::Path::new(PRIOR).join("light_encoder.safetensors");
    std::fs::copy(encoder, project.path("model/light_encoder.safetensors")).unwrap();
    let table = project.run(PRETRAIN, &check[..check.len() - 1]);
    table.expect_success();
    let heads = table.stdout.lines().nth(1).unwrap_or_default();
    let heads: Vec<&str> = heads.split_whitespace().collect();
    assert_eq!(heads[..3], ["check", "wanted", "found"]);
    assert_eq!(heads.last(), Some(&"encoder"));
    assert_eq!(table.stdout.lines().count(), 9, "{}", table.stdout);
    let late = [&check[..], &["--timesteps", "0.5,1"]].concat();
    let message = "error: --timesteps 1: accepted are 0 to below 1";
    project.run(PRETRAIN, &late).expect_error(2, message);
}

#[cfg(unix)]
#[test]
fn control_c_saves_what_was_trained() {
    let project = Project::new();
    let endless = ["--samples", "1200000", "--checkpoint-every", "1"];
    let endless: Vec<&str> = TINY
        .into_iter()
        .filter(|a| !["--samples", "24"].contains(a))
        .chain(endless)
        .collect();
    let mut child = project.command(PRETRAIN, &endless).spawn().unwrap();
    let checkpoint = project.path("cache/checkpoint.safetensors");
    let deadline = Instant::now() + Duration::from_secs(120);
    while !checkpoint.is_file() {
        let ended = child.try_wait().unwrap();
        assert!(ended.is_none() && Instant::now() < deadline, "{ended:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
    let pid = child.id().to_string();
    let sent = std::process::Command::new("kill")
        .args(["-INT", &pid])
        .status();
    assert!(sent.unwrap().success());
    let mut run: Run = child.wait_with_output().unwrap().into();
    // Without a terminal there is a line for every checkpoint; the interruption writes the last one.
    let (notes, error) = run.stderr.trim_end().rsplit_once('\n').unwrap();
    for note in notes.lines() {
        assert!(note.contains(" examples, loss "), "{note}");
    }
    run.stderr = error.to_owned();
    run.expect_error(130, "interrupted; earlier results are as they were");
    // The weights so far are a model, and another run continues from the checkpoint.
    assert!(
        project
            .path("model/unet/diffusion_pytorch_model.safetensors")
            .is_file()
    );
    let again = project.run(PRETRAIN, &[&TINY[..], &["--json"]].concat());
    again.expect_success();
    let again: Value = serde_json::from_str(&again.stdout).unwrap();
    assert!(again["resumed_at"].as_u64().unwrap() > 0, "{again}");
}

#[test]
fn wrong_arguments_are_refused_before_scenes_are_rendered() {
    let project = Project::new();
    for (wrong, code, message) in [
        (["--from", "nowhere"], 1, NO_WEIGHTS),
        (["--relit", "1.5"], 2, "--relit 1.5: accepted are 0 to 1"),
        (["--layers", "0"], 2, "--layers 0: accepted are 1 to 8"),
        (
            ["--contrast", "-1"],
            2,
            "--contrast -1: accepted are 0 and more",
        ),
        (
            ["--learning-rate", "0"],
            2,
            "--learning-rate 0: accepted are numbers above 0",
        ),
    ] {
        let run = project.run(PRETRAIN, &[&TINY[..], &wrong].concat());
        run.expect_error(code, &format!("error: {message}"));
        for written in ["cache/scenes", "model"] {
            assert!(!project.path(written).exists(), "{wrong:?}");
        }
    }
}

#[test]
fn an_encoder_starts_from_that_of_a_model() {
    let project = Project::new();
    let tiny = [
        "encoder",
        "--out",
        "model",
        "--cache",
        "cache",
        "--scenes",
        "2",
        "--samples",
        "128",
    ];
    let nowhere = project.run(PRETRAIN, &[&tiny[..], &["--from", "nowhere"]].concat());
    let message = "error: cannot read nowhere/light_encoder.safetensors: No such file or directory";
    nowhere.expect_error(1, message);
    assert!(!project.path("cache").exists() && !project.path("model").exists());
    let late = [&tiny[..], &["--learning-rate", "-1"]].concat();
    let message = "error: --learning-rate -1: accepted are numbers above 0";
    project.run(PRETRAIN, &late).expect_error(2, message);
    let lost = [&tiny[..], &["--sheet", "nowhere/sheet.png"]].concat();
    let message =
        "error: cannot write nowhere/sheet.png: there is no folder nowhere; create it first";
    project.run(PRETRAIN, &lost).expect_error(1, message);
    assert!(!project.path("cache").exists() && !project.path("model").exists());
    // A trained encoder has a smaller loss than a new one.
    let loss = |more: &[&str]| {
        let run = project.run(PRETRAIN, &[&tiny[..], &["--json"], more].concat());
        run.expect_success();
        let result: Value = serde_json::from_str(&run.stdout).unwrap();
        result["loss"].as_f64().unwrap()
    };
    let sheet = ["--from", PRIOR, "--sheet", "sheet.png"];
    let (known, unknown) = (loss(&sheet), loss(&[]));
    assert!(known < 0.5 * unknown, "{known} {unknown}");
    // Pictures of its training: eight rows of twelve, enlarged three times.
    let sheet = image::open(project.path("sheet.png")).unwrap().to_rgb8();
    assert_eq!(sheet.dimensions(), (12 * 32 * 3, 8 * 32 * 3));
    let tiles: std::collections::BTreeSet<Vec<u8>> = (0..96)
        .map(|k| (k % 12 * 96, k / 12 * 96))
        .map(|(x, y)| image::imageops::crop_imm(&sheet, x, y, 96, 96).to_image())
        .map(|tile| tile.into_raw())
        .collect();
    assert!(tiles.len() > 90, "{} of 96 differ", tiles.len());
}

#[test]
fn the_light_estimator_is_trained_on_a_folder_of_panoramas() {
    let project = Project::new();
    std::fs::create_dir(project.path("maps")).unwrap();
    for (name, grey) in [("hall", 0.2), ("yard", 0.6)] {
        let map = EnvironmentMap::constant(64, 32, Vec3::splat(grey));
        map.write(project.path("maps").join(format!("{name}.exr")))
            .unwrap();
    }
    let small = [
        "--folds",
        "2",
        "--networks",
        "1",
        "--views",
        "2",
        "--judged",
        "1",
        "--hidden",
        "4",
        "--epochs",
        "1",
    ];
    let command = [
        "light",
        "maps",
        "out/places.safetensors",
        "--json",
        "--quiet",
        "--keep-folds",
    ];
    let run = project.run(PRETRAIN, &[&command[..], &small].concat());
    run.expect_success();
    let told: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(told["standard"][0]["photographs"], 2);
    for extension in ["safetensors", "json", "fold0", "fold1"] {
        let file = project.path("out/places").with_extension(extension);
        assert!(file.is_file(), "{}", file.display());
    }
    let folds = project.run(PRETRAIN, &["folds", "maps", "--folds", "2"]);
    folds.expect_success();
    assert_eq!(folds.stdout, "hall\t0\nyard\t1\n");
    let few = project.run(PRETRAIN, &["folds", "maps"]);
    assert_eq!((few.code, few.stdout.as_str()), (Some(1), ""));
    assert!(few.stderr.contains("of 2 places"), "{}", few.stderr);
    // What was tuned without other places.
    let tuned = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/lib/estimator/weights/tuned.safetensors"
    );
    let other = project.run(
        PRETRAIN,
        &[&command[..], &small, &["--tuned", tuned]].concat(),
    );
    assert_eq!(other.code, Some(1));
    assert!(
        other.stderr.contains("holds 5 folds, not 2"),
        "{}",
        other.stderr
    );
    let none = project.run(PRETRAIN, &["light", "nowhere", "out/places.safetensors"]);
    assert_eq!(none.code, Some(1));
    assert!(
        none.stderr.contains("cannot read `nowhere`"),
        "{}",
        none.stderr
    );
}
