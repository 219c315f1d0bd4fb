//! Objects and camera on grounds that are no plane of the file.
use std::fs;

use dipir_placing::desk::Desk;
use dipir_placing::edit::Edit;
use serde_json::{Value, json};
use tempfile::TempDir;

mod project;
use project::{TEXT, open, project};

const PLANE: &str = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";

/// The project on another ground, whose table says `proxy`.
fn on_ground(proxy: &str) -> (TempDir, Desk) {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    let square = "v -9 0 9\nv 9 0 9\nv 9 0 -90\nv -9 0 -90\nf 1 2 3 4\n";
    fs::write(folder.path().join("ground.obj"), square).unwrap();
    let text = TEXT.replace(PLANE, proxy);
    assert_ne!(text, TEXT);
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let desk = Desk::open(open(folder.path(), &[])).unwrap();
    (folder, desk)
}

fn edit(value: Value) -> Edit {
    serde_json::from_value(value).unwrap()
}

/// What is shown of an edit, and of the file that it was saved to.
fn shown_and_saved(folder: &TempDir, desk: &Desk, edit: &Edit) -> [Value; 2] {
    let shown = desk.view(edit, false).unwrap();
    desk.save(edit).unwrap();
    let again = Desk::open(open(folder.path(), &[])).unwrap();
    let none = Edit::none(edit.objects.len());
    [shown, again.view(&none, false).unwrap()]
}

fn number(view: &Value, path: &str) -> f64 {
    view.pointer(path).and_then(Value::as_f64).unwrap()
}

#[test]
fn an_object_at_a_pixel_of_a_mesh_is_moved_to_another_pixel() {
    let (folder, desk) = on_ground("mesh = \"ground.obj\"");
    let moved = edit(json!({"objects": [{"of": 0, "at": [190.0, 140.0]}]}));
    let [shown, saved] = shown_and_saved(&folder, &desk, &moved);
    for view in [shown, saved] {
        let at = ["/objects/0/contact/0", "/objects/0/contact/1"].map(|p| number(&view, p));
        // Pixels of single precision.
        let off = (at[0] - 190.0).hypot(at[1] - 140.0);
        assert!(off < 1e-2, "{at:?}");
    }
    let text = fs::read_to_string(folder.path().join("pipeline.toml")).unwrap();
    assert!(
        text.contains("at_pixel = [190.0, 140.0] # at the kerb"),
        "{text}"
    );
}

#[test]
fn a_ground_below_the_camera_follows_it() {
    let (folder, desk) = on_ground("camera_height_m = 1.6 # about");
    let higher = edit(json!({"objects": [{"of": 0}], "height_m": 2.5}));
    let [shown, saved] = shown_and_saved(&folder, &desk, &higher);
    assert!(
        (number(&shown, "/camera/height_m") - 2.5).abs() < 1e-5,
        "{shown}"
    );
    assert!(
        (number(&saved, "/camera/height_m") - 2.5).abs() < 1e-5,
        "{saved}"
    );
    let text = fs::read_to_string(folder.path().join("pipeline.toml")).unwrap();
    assert!(text.contains("camera_height_m = 2.5 # about"), "{text}");
}

#[test]
fn a_ground_through_pixels_is_shown_as_it_will_be_for_a_turned_camera() {
    let lengths = "pixels = [[60.0, 180.0], [240.0, 180.0]]\nlengths_m = [[0, 1, 2.0]]";
    let (folder, desk) = on_ground(lengths);
    let turned = edit(json!({
        "objects": [{"of": 0}],
        "turn": {"pitch_deg": -14.0, "roll_deg": 0.0, "fov_deg": 50.0},
    }));
    let before = desk.view(&Edit::none(1), false).unwrap();
    let [shown, saved] = shown_and_saved(&folder, &desk, &turned);
    let height = |view: &Value| number(view, "/camera/height_m");
    // Steeper, two metres at these pixels are seen from higher up.
    assert!(height(&shown) > 1.05 * height(&before), "{shown} {before}");
    // Rays of single precision.
    assert!(
        (height(&shown) / height(&saved) - 1.0).abs() < 1e-5,
        "{shown} {saved}"
    );
    let lifted = edit(json!({"objects": [{"of": 0}], "height_m": 2.5, "revision": 1}));
    let error = desk.view(&lifted, false).unwrap_err().to_string();
    assert!(error.contains("scene.proxy.lengths_m"), "{error}");
}

#[test]
fn what_the_command_line_sets_holds_after_an_edit_and_is_not_saved() {
    let folder = tempfile::tempdir().unwrap();
    let desk = Desk::open(project(folder.path(), &["scene.camera.fov_deg=80"])).unwrap();
    let moved = edit(json!({"objects": [{"of": 0, "at": [160.0, 150.0]}]}));
    for change in [Edit::none(1), moved.clone()] {
        let view = desk.view(&change, false).unwrap();
        let fov = number(&view, "/camera/fov_deg");
        assert!((fov - 80.0).abs() < 1e-3, "{view}");
    }
    let [_, saved] = shown_and_saved(&folder, &desk, &moved);
    let fov = number(&saved, "/camera/fov_deg");
    assert!((fov - 50.0).abs() < 1e-3, "{saved}");
}
