//! A project that has work for every stage: light is recovered from a picture, and a small model
//! is personalised.
use std::path::PathBuf;

use serde_json::Value;

use crate::project::*;

/// A tetrahedron on a floor, and the picture that it should make. Everything is small: a run of
/// all stages takes a second or two.
pub fn project() -> Project {
    let project = Project::new();
    project.run_both(&["-o", "truth"]);
    project.write(
        "reference.exr",
        project.read("truth/composite/composite.exr"),
    );
    std::fs::remove_dir_all(project.path("truth")).unwrap();
    let model =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("lib/diffusion/tests/references/sd15");
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let (scene, _) = text.split_once("[composite]").unwrap();
    let rest = format!(
        r#"
[model]
path = {model:?}

[concepts]
count = 2
steps = 2
cache = "cache"

[lora]
steps = 6
checkpoint_every = 2
sample_every = 3
recompute = false

[light]
guidance = "reference"
reference = "reference.exr"
iterations = 40
lobes = 6
environment = [16, 8]
samples = 16
preview_every = 15
checkpoint_every = 10

[composite]
target_error = 0.05
"#
    );
    project.write("pipeline.toml", format!("{scene}{rest}"));
    project
}

/// All stages of [`project`], in order.
pub const STAGES: [&str; 5] = ["scene", "concepts", "lora", "light", "composite"];

/// Runs every stage that is not up to date, the model's as well, and returns which ran, in the
/// order of [`STAGES`].
#[track_caller]
pub fn run_all(project: &Project, args: &[&str]) -> Vec<String> {
    let mut ran = Vec::new();
    for until in ["composite", "lora"] {
        let run = project.run(
            DIPIR,
            &[&["run", "--json", "--until", until], args].concat(),
        );
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        let names = value["ran"].as_array().unwrap();
        ran.extend(names.iter().map(|n| n.as_str().unwrap().to_string()));
    }
    ran.sort_by_key(|name| STAGES.iter().position(|s| s == name));
    ran
}

/// A stage, and its files with their bytes.
pub type Artifacts = (String, Vec<(String, Vec<u8>)>);

/// Every file that the stages wrote in `out`, but `stage.json`.
pub fn all_artifacts(project: &Project, out: &str) -> Vec<Artifacts> {
    STAGES
        .iter()
        .map(|stage| {
            let folder = format!("{out}/{stage}");
            (stage.to_string(), project.artifacts(&folder))
        })
        .collect()
}
