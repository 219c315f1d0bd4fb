//! The light on the page: what of it is shown, and what is refused.
use std::fs;

use dipir_placing::desk::Desk;
use serde_json::json;

mod project;
use project::{TEXT, open, project};

#[test]
fn a_light_that_a_run_refuses_is_refused_when_it_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    // A run refuses a sun beside a neutral light.
    let desk = Desk::open(project(folder.path(), &[])).unwrap();
    let edit = |keys: serde_json::Value| {
        let mut edit = json!({"objects": [{"of": 0}]});
        edit.as_object_mut()
            .unwrap()
            .append(&mut keys.as_object().unwrap().clone());
        serde_json::from_value(edit).unwrap()
    };
    let sun = edit(json!({"sun": {"azimuth_deg": 30.0, "elevation_deg": 40.0}}));
    let shadow = edit(json!({"shadow": {"foot": [20.0, 170.0], "tip": [60.0, 150.0]}}));
    for (edit, key) in [(sun, "light.sun"), (shadow, "light.shadow")] {
        for error in [
            desk.draft(&edit, 1, 0).err().expect("refused"),
            desk.relight(&edit, 0).err().expect("refused"),
            desk.save(&edit).unwrap_err(),
        ] {
            assert!(error.to_string().contains(key), "{error:#}");
        }
    }
    let none = edit(json!({}));
    assert!(desk.draft(&none, 1, 0).unwrap().is_ok());
}

#[test]
fn a_shadow_that_the_file_tells_is_known_to_the_page() {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    for (light, is_told) in [
        ("start = \"neutral\"", false),
        (
            "shadow = { foot = [20.0, 170.0], tip = [60.0, 150.0] }",
            true,
        ),
    ] {
        let text = TEXT.replace("start = \"neutral\"", light);
        fs::write(folder.path().join("pipeline.toml"), text).unwrap();
        let desk = Desk::open(open(folder.path(), &[])).unwrap();
        assert_eq!(desk.state().unwrap()["shadow"], is_told);
    }
}

#[test]
fn what_is_told_of_the_sun_is_said_of_the_light() {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    let opened = |light: &str| {
        let text = TEXT.replace("start = \"neutral\"", light);
        fs::write(folder.path().join("pipeline.toml"), text).unwrap();
        Desk::open(open(folder.path(), &[])).unwrap()
    };
    let edit = |keys: &str| {
        let edit = format!("{{\"objects\": [{{\"of\": 0}}]{keys}}}");
        serde_json::from_str(&edit).unwrap()
    };
    let seen = "estimated from the photograph";
    let of_sun = format!("{seen}, the sun as [light] sun tells");
    let of_shadow = format!("{seen}, the sun as [light] shadow tells");
    let sun = "sun = { azimuth_deg = 30.0, elevation_deg = 40.0 }";
    let dial = ", \"sun\": {\"azimuth_deg\": -20.0, \"elevation_deg\": 50.0}";
    let line = ", \"shadow\": {\"foot\": [20.0, 170.0], \"tip\": [60.0, 150.0]}";
    for (light, keys, expected) in [
        ("", "", seen),
        ("", dial, &of_sun),
        ("", line, &of_shadow),
        (sun, "", &of_sun),
    ] {
        let (desk, edit) = (opened(light), edit(keys));
        let drawn = desk.draft(&edit, 1, 0).unwrap().ok().flatten();
        let turned = desk.relight(&edit, 0).unwrap().ok().flatten();
        for crop in [drawn, turned].map(|crop| crop.expect("an object is seen")) {
            assert_eq!(crop.light["origin"], expected, "{light}{keys}");
            assert_eq!(crop.light["told"], expected != seen, "{light}{keys}");
        }
    }
}

#[test]
fn a_sun_of_a_shadow_follows_the_camera_s_height() {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    let plane = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";
    let shadow = "shadow = { foot = [20.0, 190.0], tip = [90.0, 150.0], height_m = 1.0 }";
    let text = TEXT.replace("start = \"neutral\"", shadow);
    let text = text.replace(plane, "camera_height_m = 1.6");
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let opened = || Desk::open(open(folder.path(), &[])).unwrap();
    let picture = |desk: &Desk, keys: &str| {
        let edit = format!("{{\"objects\": [{{\"of\": 0}}]{keys}}}");
        let crop = desk.draft(&serde_json::from_str(&edit).unwrap(), 4, 0);
        crop.unwrap().ok().flatten().expect("an object is seen").png
    };
    let higher = ", \"height_m\": 3.2";
    let desk = opened();
    picture(&desk, "");
    assert!(picture(&desk, higher) == picture(&opened(), higher));
}
