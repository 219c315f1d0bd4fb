//! `dipir-tradeoff` on a project of the user's.
use std::fs;

use crate::project::{Project, TRADEOFF};

#[test]
fn a_project_is_measured_once_and_shown_as_tables_and_plots() {
    let project = Project::new();
    let arguments = [
        "-p",
        "pipeline.toml",
        "--knob",
        "depth",
        "--repeats",
        "1",
        "--reference-error",
        "0.03",
        "-j",
        "2",
    ];
    let run = project.run(TRADEOFF, &arguments);
    run.expect_success();
    let told = "points, each 1 times, into tradeoff: Ctrl-C ends it";
    assert!(run.stderr.contains(told), "{}", run.stderr);
    for file in [
        "tradeoff.json",
        "tradeoff.csv",
        "tradeoff-render.svg",
        "tradeoff-render.png",
    ] {
        assert!(project.path("tradeoff").join(file).is_file(), "{file}");
    }
    let table = fs::read_to_string(project.path("tradeoff/tradeoff.csv")).unwrap();
    assert_eq!(
        table.lines().filter(|l| l.contains("\"depth\"")).count(),
        4,
        "{table}"
    );
    // What is measured stays: the same seconds again, though no two runs take the same.
    let before = project.read("tradeoff/tradeoff.json");
    project.run(TRADEOFF, &arguments).expect_success();
    assert_eq!(project.read("tradeoff/tradeoff.json"), before);
}

#[test]
fn a_knob_that_is_none_is_refused_with_those_there_are() {
    let project = Project::new();
    let run = project.run(TRADEOFF, &["--knob", "colour", "--track", "light"]);
    assert_eq!(run.code, Some(2), "{}", run.stderr);
    assert!(
        run.stderr.contains("--knob accepts: preset, target error"),
        "{}",
        run.stderr
    );
}
