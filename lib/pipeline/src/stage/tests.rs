use serde_json::json;

use super::*;
use crate::error::Damage;

fn plan(seed: u64) -> StagePlan {
    StagePlan::new("scene", 1, json!({"class": "car"}), seed)
}

fn run(target: &Path, content: &str) -> Manifest {
    let mut writer = StageWriter::begin(target, plan(3), WhenLocked::Refuse).unwrap();
    let path = writer.output("image", "images/0000.png").unwrap();
    fs::write(path, content).unwrap();
    writer.set_estimated_error(0.25);
    writer.finish().unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn a_finished_stage_has_its_files_and_a_manifest_that_verifies() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let written = run(&target, "pixels");
    let read = Manifest::read(&target, "dipir-scene").unwrap();
    assert_eq!(read, written);
    assert_eq!(read.outputs[0].path, Path::new("images/0000.png"));
    assert_eq!(read.outputs[0].bytes, 6);
    assert_eq!(
        read.outputs[0].blake3,
        blake3::hash(b"pixels").to_hex().as_str()
    );
    assert_eq!(read.estimated_error, Some(0.25));
    assert_eq!(read.damages(&target).unwrap(), []);
    assert_eq!(names(out.path()), [".scene.lock", "scene"]);
}

#[test]
fn an_unfinished_stage_leaves_the_earlier_result_untouched() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    let before = fs::read(target.join(FILE_NAME)).unwrap();
    {
        let mut writer = StageWriter::begin(&target, plan(4), WhenLocked::Refuse).unwrap();
        fs::write(writer.output("image", "a.png").unwrap(), "half").unwrap();
    }
    assert_eq!(fs::read(target.join(FILE_NAME)).unwrap(), before);
    assert_eq!(fs::read(target.join("images/0000.png")).unwrap(), b"first");
    assert_eq!(names(out.path()), [".scene.lock", "scene"]);
}

#[test]
fn a_rerun_replaces_the_folder_as_a_whole() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    fs::write(target.join("stray.txt"), "x").unwrap();
    run(&target, "second");
    assert_eq!(fs::read(target.join("images/0000.png")).unwrap(), b"second");
    assert_eq!(names(&target), ["images", "stage.json"]);
}

#[test]
fn leftovers_of_a_killed_run_are_cleared() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let partial = out.path().join(".scene.partial");
    fs::create_dir(&partial).unwrap();
    fs::write(partial.join("stale.png"), "x").unwrap();
    run(&target, "new");
    assert_eq!(names(&target), ["images", "stage.json"]);
}

#[test]
fn a_kill_between_the_two_renames_loses_nothing() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    fs::rename(&target, out.path().join(".scene.previous")).unwrap();
    drop(StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap());
    assert_eq!(fs::read(target.join("images/0000.png")).unwrap(), b"first");
}

#[test]
fn swapping_in_two_steps_ends_as_an_exchange_does() {
    let out = tempfile::tempdir().unwrap();
    let (a, b) = (out.path().join("a"), out.path().join("b"));
    fs::create_dir(&a).unwrap();
    fs::create_dir(&b).unwrap();
    fs::write(a.join("new"), "").unwrap();
    fs::write(b.join("old"), "").unwrap();
    swap_in_two_steps(&a, &b).unwrap();
    assert_eq!(names(out.path()), ["b"]);
    assert_eq!(names(&b), ["new"]);
}

#[test]
fn a_folder_that_no_stage_wrote_is_left_alone() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    fs::create_dir(&target).unwrap();
    fs::write(target.join("holiday.jpg"), "x").unwrap();
    let error = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "{} is there already and holds no stage.json, so no stage wrote it and it is left \
             alone; move it away or choose another folder with --out",
            target.display()
        )
    );
    assert_eq!(names(&target), ["holiday.jpg"]);
}

#[test]
fn a_flipped_bit_a_cut_and_a_lost_file_are_told_apart() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let manifest = run(&target, "pixels");
    let file = target.join("images/0000.png");
    fs::write(&file, "pixelt").unwrap();
    assert!(matches!(
        manifest.damages(&target).unwrap()[0].1,
        Damage::Content { .. }
    ));
    fs::write(&file, "pix").unwrap();
    assert_eq!(
        manifest.output(&target, "image").unwrap_err().to_string(),
        format!(
            "{}: damaged: 3 bytes, but 6 were written; run the stage \"scene\" again",
            file.display()
        )
    );
    fs::remove_file(&file).unwrap();
    assert_eq!(manifest.damages(&target).unwrap()[0].1, Damage::Missing);
}

#[test]
fn any_flipped_byte_of_the_manifest_is_found() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "pixels");
    let file = target.join(FILE_NAME);
    let whole = fs::read(&file).unwrap();
    for k in 0..whole.len() {
        let mut flipped = whole.clone();
        flipped[k] ^= 1;
        fs::write(&file, flipped).unwrap();
        let error = Manifest::read(&target, "").unwrap_err().to_string();
        assert!(
            error.starts_with(&format!(
                "{}: not a stage manifest: damaged",
                file.display()
            )),
            "byte {k}: {error}"
        );
    }
}

#[test]
fn a_stage_that_has_not_run_is_named() {
    let error = Manifest::read(Path::new("out/scene"), "dipir-scene").unwrap_err();
    assert_eq!(
        error.to_string(),
        "out/scene/stage.json is missing: run dipir-scene first"
    );
}

#[test]
fn outputs_cannot_leave_their_folder() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let mut writer = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
    for name in ["../x", "/x", ""] {
        assert!(writer.output("x", name).is_err(), "{name}");
    }
}

#[test]
fn a_parent_that_is_a_file_is_one_clear_message() {
    let out = tempfile::tempdir().unwrap();
    let parent = out.path().join("file");
    fs::write(&parent, "").unwrap();
    let error = StageWriter::begin(&parent.join("scene"), plan(3), WhenLocked::Refuse);
    let text = error.unwrap_err().to_string();
    assert!(
        text.starts_with(&format!("cannot create {}", parent.display())),
        "{text}"
    );
}

#[test]
fn inputs_of_one_role_are_told_apart() {
    let out = tempfile::tempdir().unwrap();
    let file = out.path().join("a");
    fs::write(&file, "").unwrap();
    let mut plan = plan(0);
    for _ in 0..3 {
        plan.input("object", Path::new("a"), &file).unwrap();
    }
    let roles: Vec<_> = plan.inputs.iter().map(|a| a.role.as_str()).collect();
    assert_eq!(roles, ["object", "object 2", "object 3"]);
}
