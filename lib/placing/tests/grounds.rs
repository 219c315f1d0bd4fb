//! Objects and camera on grounds that are no plane of the file.
use std::fs;

use dipir_placing::desk::Desk;
use dipir_placing::edit::Edit;
use dipir_scene::scene::Scene;
use image::{ImageBuffer, Luma};
use serde_json::{Value, json};
use tempfile::TempDir;

mod project;
use project::{TEXT, open, project};

const PLANE: &str = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";

/// The project on another ground, whose table says `proxy`.
fn on_ground(proxy: &str) -> (TempDir, Desk) {
    let text = TEXT.replace(PLANE, proxy);
    assert_ne!(text, TEXT);
    opened(&text)
}

/// A project of this text, with a level mesh and a slope beside it.
fn opened(text: &str) -> (TempDir, Desk) {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    for (name, near, far) in [("ground.obj", 0, 0), ("slope.obj", -1, 9)] {
        let square =
            format!("v -9 {near} 9\nv 9 {near} 9\nv 9 {far} -90\nv -9 {far} -90\nf 1 2 3 4\n");
        fs::write(folder.path().join(name), square).unwrap();
    }
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

/// The project on a ground, its object at a position and a second one at another.
fn at_positions(proxy: &str, first: &str, second: &str) -> (TempDir, Desk) {
    let one = TEXT.replace("at_pixel = [150.0, 150.0]", first);
    let more = format!("[[scene.objects]]\npath = \"box.obj\"\n{second}\n\n[scene.camera]");
    let proxy = match proxy {
        "" => "",
        proxy => &format!("[scene.proxy]\n{proxy}"),
    };
    let both = one.replace("[scene.camera]", &more);
    opened(&both.replace(&format!("[scene.proxy]\n{PLANE}"), proxy))
}

#[test]
fn objects_at_positions_follow_the_pointer_over_any_ground_and_keep_the_height_that_they_are_given()
{
    let at = "position = [0.0, 0.0, -4.0]";
    let on_a_table = "position = [1.0, 0.8, -4.0]";
    let fixed = "position = [1.0, 0.8, -4.0]\nrest = \"position\"";
    let lamp = "position = [1.0, 2.4, -4.0]";
    let slope = "mesh = \"slope.obj\"";
    for (proxy, second, pixels, height) in [
        (slope, at, [[120.0, 150.0], [190.0, 140.0]], None),
        (slope, fixed, [[120.0, 150.0], [190.0, 125.0]], Some(0.8)),
        (
            PLANE,
            on_a_table,
            [[120.0, 150.0], [190.0, 125.0]],
            Some(0.8),
        ),
        // Above the eyes, and above the horizon.
        (PLANE, lamp, [[120.0, 150.0], [200.0, 20.0]], Some(2.4)),
        ("", on_a_table, [[120.0, 150.0], [190.0, 125.0]], Some(0.8)),
    ] {
        let (folder, desk) = at_positions(proxy, at, second);
        let moved =
            edit(json!({"objects": [{"of": 0, "at": pixels[0]}, {"of": 1, "at": pixels[1]}]}));
        for view in shown_and_saved(&folder, &desk, &moved) {
            for (k, pixel) in pixels.iter().enumerate() {
                let at = [0, 1].map(|c| number(&view, &format!("/objects/{k}/contact/{c}")));
                // A position is written to a tenth of a millimetre, 0.02 pixels at 2 m.
                let off = (at[0] - pixel[0]).hypot(at[1] - pixel[1]);
                assert!(off < 0.05, "{proxy} {second}: {at:?} {pixel:?}");
            }
        }
        let text = fs::read_to_string(folder.path().join("pipeline.toml")).unwrap();
        let objects = text.split("[scene.camera]").next().unwrap();
        let kept = height.is_none_or(|h: f64| objects.contains(&format!(", {h:?}, ")));
        assert!(kept, "{text}");
    }
}

#[test]
fn an_object_whose_place_was_looked_for_is_turned_and_sized_there_and_outlives_another() {
    let looked_for = "place = \"auto\"\nheight_m = 0.5";
    let (folder, desk) = at_positions(PLANE, "position = [-1.5, 0.0, -6.0]", looked_for);
    let before = desk.view(&Edit::none(2), false).unwrap();
    let contact = |view: &Value, k: usize| {
        ["0", "1"].map(|c| number(view, &format!("/objects/{k}/contact/{c}")))
    };
    let place = contact(&before, 1);
    let near = |at: [f64; 2]| {
        // A position is written to a tenth of a millimetre, 0.02 pixels at 2 m.
        let off = (at[0] - place[0]).hypot(at[1] - place[1]);
        assert!(off < 0.05, "{at:?} {place:?}");
    };
    let turned = desk.view(
        &edit(json!({"objects": [{"of": 0}, {"of": 1, "yaw_deg": 30.0, "size": 1.2}]})),
        false,
    );
    let turned = turned.unwrap();
    near(contact(&turned, 1));
    assert!(
        (number(&turned, "/objects/1/size_m/1") - 0.6).abs() < 1e-5,
        "{turned}"
    );
    assert_ne!(turned["objects"][1]["lines"], before["objects"][1]["lines"]);
    let alone = edit(json!({"objects": [{"of": 1}]}));
    for view in shown_and_saved(&folder, &desk, &alone) {
        near(contact(&view, 0));
        assert!(
            (number(&view, "/objects/0/size_m/1") - 0.5).abs() < 1e-5,
            "{view}"
        );
    }
}

/// Depths of the level ground 1.6 m below the project's camera, millimetres.
fn depths() -> ImageBuffer<Luma<u16>, Vec<u16>> {
    let (focal, pitch) = (100.0 / 25f64.to_radians().tan(), 10f64.to_radians());
    ImageBuffer::from_fn(300, 200, |_, row| {
        let rise = (100.0 - (f64::from(row) + 0.5)) / focal * pitch.cos() - pitch.sin();
        let seen = Some(-1600.0 / rise).filter(|mm| (0.0..40_000.0).contains(mm));
        Luma([seen.map_or(0, |mm| mm.round() as u16)])
    })
}

#[test]
fn an_object_follows_the_pointer_over_a_depth_map_whose_camera_is_not_moved() {
    let ground = "points = \"depth.png\"";
    for place in ["at_pixel = [150.0, 150.0]", "position = [0.0, 0.0, -4.0]"] {
        let folder = tempfile::tempdir().unwrap();
        project(folder.path(), &[]);
        depths().save(folder.path().join("depth.png")).unwrap();
        let text = TEXT.replace(PLANE, ground);
        let text = text.replace("at_pixel = [150.0, 150.0]", place);
        fs::write(folder.path().join("pipeline.toml"), text).unwrap();
        let desk = Desk::open(open(folder.path(), &[])).unwrap();
        let moved = edit(json!({"objects": [{"of": 0, "at": [190.0, 140.0]}]}));
        for view in shown_and_saved(&folder, &desk, &moved) {
            let at = ["/objects/0/contact/0", "/objects/0/contact/1"].map(|p| number(&view, p));
            // A position is written to a tenth of a millimetre, 0.02 pixels at 2 m.
            assert!((at[0] - 190.0).hypot(at[1] - 140.0) < 0.05, "{at:?}");
        }
        // A run finds the ground anew from where the camera is.
        let turn = json!({"pitch_deg": -14.0, "roll_deg": 0.0, "fov_deg": 50.0});
        for (key, value) in [("turn", turn), ("height_m", json!(2.5))] {
            let mut change = json!({"objects": [{"of": 0}], "revision": 1});
            change[key] = value;
            let error = desk.view(&edit(change), false).unwrap_err().to_string();
            assert!(error.contains("depth map"), "{error}");
        }
    }
}

#[test]
fn an_object_on_what_depths_show_is_dragged_over_floor_and_table() {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    // A table in the right half, half as high as the camera.
    let floor = depths();
    let seen = ImageBuffer::from_fn(300, 200, |x, y| {
        let Luma([mm]) = *floor.get_pixel(x, y);
        Luma([if x < 150 { mm } else { mm / 2 }])
    });
    seen.save(folder.path().join("depth.png")).unwrap();
    let text = TEXT.replace("[scene]\n", "[scene]\ndepth = \"depth.png\"\n");
    let rests = "at_pixel = [100.0, 150.0]\nrest = \"surface\"";
    let text = text.replace("at_pixel = [150.0, 150.0]", rests);
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let desk = Desk::open(open(folder.path(), &[])).unwrap();
    let stands_at = || {
        let session = open(folder.path(), &[]);
        let scene = session.config.table("scene").unwrap();
        let loaded = Scene::load(&scene, folder.path()).unwrap();
        loaded.scene.mesh.bounds().unwrap().0.y
    };
    assert!(stands_at().abs() < 1e-3);
    let moved = edit(json!({"objects": [{"of": 0, "at": [220.0, 150.0]}]}));
    for view in shown_and_saved(&folder, &desk, &moved) {
        let at = ["/objects/0/contact/0", "/objects/0/contact/1"].map(|p| number(&view, p));
        assert!((at[0] - 220.0).hypot(at[1] - 150.0) < 0.05, "{at:?}");
    }
    // Depths in whole millimetres of 1 to 40 m.
    assert!((stands_at() - 0.8).abs() < 0.01, "{}", stands_at());
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
