//! Same inputs, same seed: same bytes.
use crate::project::*;

#[test]
fn a_rerun_writes_the_same_bytes() {
    let project = Project::new();
    project.run_both(&[]);
    let first = (
        project.artifacts("out/scene"),
        project.artifacts("out/composite"),
    );
    project.run_both(&[]);
    let second = (
        project.artifacts("out/scene"),
        project.artifacts("out/composite"),
    );
    assert!(first == second);
    assert_eq!(first.0.len(), 3);
    // The picture, its layers, what was simulated, and how the photograph looks.
    assert_eq!(first.1.len(), 4);
}

#[test]
fn one_thread_and_two_write_the_same_bytes() {
    let project = Project::new();
    project.run_both(&["-j", "1", "-o", "one"]);
    project.run_both(&["-j", "2", "-o", "two"]);
    for stage in ["scene", "composite"] {
        let one = project.artifacts(&format!("one/{stage}"));
        let two = project.artifacts(&format!("two/{stage}"));
        assert!(one == two, "{stage}");
    }
}

#[test]
fn another_seed_writes_other_bytes() {
    let project = Project::new();
    project.run_both(&["-o", "a"]);
    project.run_both(&["-o", "b", "--seed", "1"]);
    assert!(project.artifacts("a/composite") != project.artifacts("b/composite"));
}
