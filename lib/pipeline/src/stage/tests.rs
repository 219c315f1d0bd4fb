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
    assert_eq!(names(out.path()), ["scene"]);
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
    assert_eq!(names(out.path()), ["scene"]);
}

#[test]
fn a_rerun_replaces_what_it_wrote_and_keeps_what_others_put_beside_it() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    fs::write(target.join("notes.txt"), "mine").unwrap();
    fs::write(target.join("images/9.psd"), "mine").unwrap();
    fs::create_dir_all(target.join("versions/old")).unwrap();
    fs::write(target.join("versions/old/a.psd"), "mine").unwrap();
    for content in ["second", "third"] {
        run(&target, content);
        let image = fs::read_to_string(target.join("images/0000.png")).unwrap();
        assert_eq!(image, content);
        assert_eq!(
            names(&target),
            [".dipir", "images", "notes.txt", "stage.json", "versions"]
        );
        assert_eq!(names(&target.join("images")), ["0000.png", "9.psd"]);
        assert!(target.join("versions/old/a.psd").exists());
        assert_eq!(names(out.path()), ["scene"]);
    }
}

#[test]
fn a_file_of_a_new_output_s_name_is_kept_under_another() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    fs::write(target.join("a.png"), "mine").unwrap();
    for _ in 0..2 {
        let mut writer = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
        fs::write(writer.output("image", "a.png").unwrap(), "ours").unwrap();
        writer.finish().unwrap();
        assert_eq!(
            names(&target),
            [".dipir", "a.png", "a.png.kept", "stage.json"]
        );
        assert_eq!(fs::read(target.join("a.png.kept")).unwrap(), b"mine");
    }
}

#[test]
fn a_kill_after_the_swap_loses_nothing_of_others() {
    let out = tempfile::tempdir().unwrap();
    let (target, partial) = (out.path().join("scene"), out.path().join(".scene.partial"));
    run(&target, "first");
    fs::write(target.join("notes.txt"), "mine").unwrap();
    fs::rename(&target, &partial).unwrap();
    run(&out.path().join("other"), "second");
    fs::rename(out.path().join("other"), &target).unwrap();
    // A process that is asked to stop now must not take it for its own unfinished work.
    discard(&partial);
    drop(StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap());
    assert_eq!(fs::read(target.join("notes.txt")).unwrap(), b"mine");
    assert_eq!(fs::read(target.join("images/0000.png")).unwrap(), b"second");
    assert_eq!(names(out.path()), ["scene"]);
}

#[test]
fn a_folder_with_another_s_stage_json_is_left_alone() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    for (name, text) in [
        ("stage.json", "{\"stage\": \"scene\"}".to_string()),
        ("stage.json", other_manifest()),
    ] {
        fs::create_dir_all(&target).unwrap();
        fs::write(target.join(name), &text).unwrap();
        fs::write(target.join("painting.psd"), "years of work").unwrap();
        let error = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap_err();
        assert_eq!(
            error.to_string(),
            format!(
                "{} is there already and holds a stage.json that the stage \"scene\" did \
                 not write, so it is left alone; move it away or choose another folder with --out",
                target.display()
            )
        );
        assert_eq!(names(&target), ["painting.psd", "stage.json"]);
        assert_eq!(names(out.path()), ["scene"]);
    }
}

/// A manifest of another stage.
fn other_manifest() -> String {
    let out = tempfile::tempdir().unwrap();
    let plan = StagePlan::new("lora", 1, json!({}), 0);
    let target = out.path().join("lora");
    let writer = StageWriter::begin(&target, plan, WhenLocked::Refuse).unwrap();
    writer.finish().unwrap().to_text().unwrap()
}

#[test]
fn a_damaged_manifest_of_ours_is_written_anew_and_others_files_stay() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    run(&target, "first");
    fs::write(target.join("notes.txt"), "mine").unwrap();
    fs::write(target.join(FILE_NAME), "damaged").unwrap();
    run(&target, "second");
    assert_eq!(
        names(&target),
        [".dipir", "images", "notes.txt", "stage.json"]
    );
    // The other way round.
    fs::write(target.join(".dipir"), "damaged").unwrap();
    run(&target, "third");
    assert_eq!(
        names(&target),
        [".dipir", "images", "notes.txt", "stage.json"]
    );
}

#[cfg(unix)]
#[test]
fn links_at_the_names_of_a_stage_s_folders_are_left_alone() {
    let out = tempfile::tempdir().unwrap();
    let (target, mine) = (out.path().join("scene"), out.path().join("mine"));
    run(&mine, "first");
    for name in ["scene", ".scene.partial", ".scene.previous"] {
        let link = out.path().join(name);
        std::os::unix::fs::symlink(&mine, &link).unwrap();
        let begun = StageWriter::begin(&target, plan(3), WhenLocked::Refuse);
        assert!(begun.is_err() || name == ".scene.previous", "{name}");
        drop(begun);
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink(), "{name}");
        assert_eq!(names(&mine), [".dipir", "images", "stage.json"]);
        fs::remove_file(&link).unwrap();
    }
}

#[test]
fn leftovers_of_a_killed_run_are_cleared() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let partial = out.path().join(".scene.partial");
    fs::create_dir(&partial).unwrap();
    for left in [None, Some("stale.png")] {
        if let Some(name) = left {
            Mark::new(Kind::Unfinished, "scene", vec![])
                .make(&partial)
                .unwrap();
            fs::write(partial.join(name), "x").unwrap();
        }
        run(&target, "new");
        assert_eq!(names(&target), [".dipir", "images", "stage.json"]);
        assert_eq!(names(out.path()), ["scene"]);
        fs::create_dir_all(&partial).unwrap();
    }
}

#[test]
fn what_a_result_makes_needless_goes_before_another_run_may_begin() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let writer = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
    let mut tidied = false;
    let tidy_up = || {
        tidied = true;
        assert!(target.join(FILE_NAME).is_file());
        let other = StageWriter::begin(&target, plan(3), WhenLocked::Refuse);
        assert!(matches!(other, Err(StageError::Locked { .. })));
    };
    writer.finish_and(tidy_up).unwrap();
    assert!(tidied);
    StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
}

#[test]
fn a_kill_while_an_unfinished_folder_is_removed_blocks_no_later_run() {
    let out = tempfile::tempdir().unwrap();
    let (target, partial) = (out.path().join("scene"), out.path().join(".scene.partial"));
    // A mark, two files and a folder.
    for removed in 0..=4 {
        let mark = Mark::new(Kind::Unfinished, "scene", vec![]);
        mark.make(&partial).unwrap();
        for name in ["!a.png", "z.png"] {
            fs::write(partial.join(name), "x").unwrap();
        }
        fs::create_dir(partial.join("images")).unwrap();
        let paths = mark_last(&partial).unwrap();
        assert_eq!(paths.len(), 4);
        for path in &paths[..removed] {
            let gone = fs::remove_file(path).or_else(|_| fs::remove_dir(path));
            gone.unwrap();
        }
        run(&target, "new");
        assert_eq!(names(out.path()), ["scene"], "{removed} were removed");
    }
}

#[test]
fn a_result_without_its_place_is_put_there_with_what_others_put_beside_it() {
    let out = tempfile::tempdir().unwrap();
    let (target, partial) = (out.path().join("scene"), out.path().join(".scene.partial"));
    run(&target, "first");
    fs::write(target.join("notes.txt"), "mine").unwrap();
    fs::rename(&target, &partial).unwrap();
    drop(StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap());
    assert_eq!(names(out.path()), ["scene"]);
    assert_eq!(fs::read(target.join("images/0000.png")).unwrap(), b"first");
    assert_eq!(fs::read(target.join("notes.txt")).unwrap(), b"mine");
    // Something of another's at its place is not replaced.
    fs::rename(&target, &partial).unwrap();
    fs::write(&target, "mine").unwrap();
    StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap_err();
    assert_eq!(fs::read(&target).unwrap(), b"mine");
    assert!(partial.join("notes.txt").exists());
}

#[test]
fn a_folder_at_the_name_of_the_unfinished_one_that_is_not_ours_is_left_alone() {
    let out = tempfile::tempdir().unwrap();
    let target = out.path().join("scene");
    let partial = out.path().join(".scene.partial");
    fs::create_dir(&partial).unwrap();
    fs::write(partial.join("thesis.tex"), "years of work").unwrap();
    StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap_err();
    assert_eq!(names(&partial), ["thesis.tex"]);
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
    // What was there before is tidied up as after an exchange, once others' files are safe.
    assert_eq!(names(out.path()), [".b.previous", "b"]);
    assert_eq!(names(&b), ["new"]);
    assert_eq!(names(&out.path().join(".b.previous")), ["old"]);
}

#[test]
fn a_folder_that_cannot_be_swapped_in_leaves_the_earlier_one_in_its_place() {
    let out = tempfile::tempdir().unwrap();
    let (absent, b) = (out.path().join("a"), out.path().join("b"));
    fs::create_dir(&b).unwrap();
    fs::write(b.join("old"), "").unwrap();
    swap_in_two_steps(&absent, &b).unwrap_err();
    assert_eq!(names(out.path()), ["b"]);
    assert_eq!(names(&b), ["old"]);
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
        plan.input("object's part", Path::new("a"), &file).unwrap();
    }
    plan.missing("object", Path::new("b"));
    plan.input("object", Path::new("a"), &file).unwrap();
    let roles: Vec<_> = plan.inputs.iter().map(|a| a.role.as_str()).collect();
    let expected = "object, object's part, object 2, object's part 2, object 3, object's part 3, missing object, object 4";
    assert_eq!(roles.join(", "), expected);
}

#[test]
fn a_folder_that_vanishes_meanwhile_is_not_made_again_without_its_mark() {
    let parent = tempfile::tempdir().unwrap();
    let target = parent.path().join("out/scene");
    let mut writer = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
    fs::remove_dir_all(parent.path().join("out")).unwrap();
    for name in ["a.png", "images/0000.png"] {
        let error = writer.output("image", name).unwrap_err().to_string();
        assert!(
            error.ends_with("it was removed while the stage ran; run again"),
            "{error}"
        );
    }
    drop(writer);
    assert!(!parent.path().join("out").exists());
    // An empty one holds nothing of anybody's.
    for _ in 0..2 {
        fs::create_dir_all(parent.path().join("out/.scene.partial")).unwrap();
        run(&target, "pixels");
        assert_eq!(names(&parent.path().join("out")), ["scene"]);
    }
    // Nor does one whose mark is gone when its writer ends.
    let writer = StageWriter::begin(&target, plan(3), WhenLocked::Refuse).unwrap();
    fs::remove_file(writer.partial().join(".dipir")).unwrap();
    drop(writer);
    assert_eq!(names(&parent.path().join("out")), ["scene"]);
}

#[test]
fn time_before_the_folder_was_opened_counts() {
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("scene");
    let mut writer = StageWriter::begin(&target, plan(0), WhenLocked::Refuse).unwrap();
    writer.add_time(Duration::from_millis(500));
    assert!(writer.finish().unwrap().elapsed_s >= 0.5);
}
