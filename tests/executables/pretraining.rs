//! `dipir-pretrain`: a run from a model and what it refuses.
use serde_json::Value;

use crate::project::{PRETRAIN, Project};

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
fn a_run_goes_on_from_a_model_and_then_from_its_checkpoint() {
    let project = Project::new();
    let run = |more: &[&str]| {
        let run = project.run(
            PRETRAIN,
            &[&TINY[..], &["--relit", "1", "--json"], more].concat(),
        );
        run.expect_success();
        serde_json::from_str::<Value>(&run.stdout).unwrap()
    };
    let from = ["--from", PRIOR, "--learning-rate", "1e-6"];
    let first = run(&from);
    assert_eq!(
        (first["examples"].as_u64(), first["resumed_at"].as_u64()),
        (Some(24), Some(0))
    );
    // From nothing it is 1 and more; of a model that knows pictures .2, and two updates of 1e-6 change nothing.
    assert!(first["loss"].as_f64().unwrap() < 0.5, "{first}");
    let weights = "model/unet/diffusion_pytorch_model.safetensors";
    let trained = project.read(weights);
    let again = run(&from);
    assert_eq!(again["resumed_at"].as_u64(), Some(24));
    assert_eq!(project.read(weights), trained);

    let gates = [
        "gates", "model", "--first", "1000", "--scenes", "2", "--draws", "1", "--json",
    ];
    let found = project.run(PRETRAIN, &gates);
    found.expect_success();
    let found: Value = serde_json::from_str(&found.stdout).unwrap();
    assert_eq!(found["scenes"].as_u64(), Some(2), "{found}");
}

#[test]
fn what_is_wrong_is_told_before_scenes_are_rendered() {
    let project = Project::new();
    for (wrong, code, told) in [
        (["--from", "nowhere"], 1, NO_WEIGHTS),
        (["--relit", "1.5"], 2, "--relit 1.5: accepted are 0 to 1"),
        (
            ["--learning-rate", "0"],
            2,
            "--learning-rate 0: accepted are numbers above 0",
        ),
    ] {
        let run = project.run(PRETRAIN, &[&TINY[..], &wrong].concat());
        run.expect_error(code, &format!("error: {told}"));
        assert!(!project.path("cache/scenes").exists(), "{wrong:?}");
    }
}
