//! Files that other programs change, and that cannot be written, while the page is open.
use std::fs;

use dipir_placing::desk::Desk;
use dipir_placing::edit::Edit;
use dipir_preview::png::{Kind, encode};
use serde_json::json;

mod project;
use project::{TEXT, open, project};

fn warnings(desk: &Desk) -> Vec<String> {
    let shown = desk.view(&Edit::none(1), false).unwrap();
    assert_eq!(shown["warnings"], desk.state().unwrap()["view"]["warnings"]);
    serde_json::from_value(shown["warnings"].clone()).unwrap()
}

#[test]
fn files_that_changed_since_they_were_read_are_told_and_the_page_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let desk = Desk::open(project(folder.path(), &[])).unwrap();
    assert!(warnings(&desk).is_empty());
    let at = |name: &str| folder.path().join(name);
    for (file, damaged, told) in [
        (
            "pipeline.toml",
            Some("[[["),
            "was changed by another program",
        ),
        ("pipeline.toml", None, "cannot read"),
        (
            "photo.png",
            Some("another"),
            "was written since it was read",
        ),
        ("photo.png", None, "is missing now"),
        ("box.obj", None, "is missing now"),
    ] {
        fs::rename(at(file), at("kept")).unwrap();
        if let Some(text) = damaged {
            fs::write(at(file), text).unwrap();
        }
        let [warning] = &warnings(&desk)[..] else {
            panic!("{file}: {:?}", warnings(&desk));
        };
        assert!(
            warning.contains(file) && warning.contains(told),
            "{warning}"
        );
        fs::rename(at("kept"), at(file)).unwrap();
        assert!(warnings(&desk).is_empty(), "{file}");
    }
    // What the page writes itself is no news.
    desk.paint(vec![255; desk.mask_bytes()]).unwrap();
    let painted = Edit {
        mask: true,
        ..Edit::none(1)
    };
    desk.save(&painted).unwrap();
    let again = Desk::open(open(folder.path(), &[])).unwrap();
    again.paint(vec![0; again.mask_bytes()]).unwrap();
    again.save(&painted).unwrap();
    assert!(warnings(&again).is_empty());
    // A file that was looked for in vain may come.
    let object = fs::read_to_string(at("box.obj")).unwrap();
    fs::write(at("box.obj"), format!("mtllib late.mtl\n{object}")).unwrap();
    let without = Desk::open(open(folder.path(), &[])).unwrap();
    let before = warnings(&without);
    fs::write(at("late.mtl"), "newmtl m\n").unwrap();
    let came = |w: &String| w.contains("late.mtl") && w.contains("was written since it was read");
    assert!(!before.iter().any(came) && warnings(&without).iter().any(came));
}

#[test]
fn objects_that_the_command_line_sets_are_not_saved_over_those_of_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let two = |first: &str, second: &str| {
        let object = |path: &str| format!("{{path=\"{path}\",at_pixel=[150.0,150.0]}}");
        format!("scene.objects=[{},{}]", object(first), object(second))
    };
    fs::write(folder.path().join("other.obj"), "").unwrap();
    let refused = Desk::open(project(folder.path(), &[&two("box.obj", "box.obj")])).err();
    let words = refused.expect("refused").to_string();
    assert_eq!(
        words,
        "--set gives the scene the objects [\"box.obj\", \"box.obj\"], and the file has [\"box.obj\"]: what is arranged here \
         is saved to the file, so write scene.objects there and leave it out of --set"
    );
    let other = "scene.objects=[{path=\"other.obj\",at_pixel=[150.0,150.0]}]";
    assert!(Desk::open(open(folder.path(), &[other])).is_err());
    let same = "scene.objects=[{path=\"box.obj\",at_pixel=[150.0,150.0]}]";
    Desk::open(open(folder.path(), &[same])).unwrap();
    // A list in one line is a list, too.
    let inline = TEXT.replace(
        "[[scene.objects]]\npath = \"box.obj\"\nat_pixel = [150.0, 150.0] # at the kerb\n",
        "",
    );
    let inline = inline.replace(
        "# mine\n",
        "\nobjects = [{ path = \"box.obj\", at_pixel = [150.0, 150.0] }, { path = \"box.obj\", at_pixel = [90.0, 150.0] }]\n",
    );
    fs::write(folder.path().join("pipeline.toml"), inline).unwrap();
    Desk::open(open(folder.path(), &[])).unwrap();
}

/// A file whose folder has so long a path that none of a longer name fits beside it: it cannot be replaced, by no user.
#[cfg(target_os = "linux")]
#[test]
fn a_save_that_fails_leaves_file_and_mask_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    drop(project(folder.path(), &[]));
    let mut deep = folder.path().canonicalize().unwrap();
    // A path has 4095 bytes at most, a name 255; beside "p" there is no room for ten letters more.
    while deep.as_os_str().len() < 4090 {
        let room = 4090 - deep.as_os_str().len();
        let name = if room > 255 {
            200
        } else {
            room.saturating_sub(1).max(1)
        };
        deep.push("d".repeat(name));
    }
    fs::create_dir_all(&deep).unwrap();
    fs::rename(folder.path().join("pipeline.toml"), deep.join("p")).unwrap();
    std::os::unix::fs::symlink(deep.join("p"), folder.path().join("pipeline.toml")).unwrap();
    let desk = Desk::open(open(folder.path(), &[])).unwrap();
    let mask = folder.path().join("holdout.png");
    let edit = serde_json::from_value(json!({"objects": [{"of": 0}], "mask": true})).unwrap();
    desk.paint(vec![255; desk.mask_bytes()]).unwrap();
    desk.save(&edit).unwrap_err();
    assert!(!mask.exists(), "a first mask stayed");
    let earlier = encode(Kind::Mask, 300, 200, &[7; 60_000]).unwrap();
    fs::write(&mask, &earlier).unwrap();
    let error = desk.save(&edit).unwrap_err().to_string();
    assert!(
        error.starts_with("cannot write \"") && error.contains("pipeline.toml"),
        "{error}"
    );
    assert!(fs::read(&mask).unwrap() == earlier);
    assert_eq!(fs::read_to_string(deep.join("p")).unwrap(), TEXT);
    assert!(desk.own_mask().is_empty());
}
