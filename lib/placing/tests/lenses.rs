//! Photographs whose lens bends lines: the page shows them undistorted, files have the pixels of the photograph.
use std::fs;
use std::path::Path;

use dipir_imaging::file::{read_mask, write_png};
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_placing::desk::Desk;
use dipir_placing::edit::Edit;
use dipir_scene::config::SceneConfig;
use dipir_scene::ground;
use dipir_scene::scene::{LoadedScene, Scene};
use glam::{DVec2, DVec3, Vec3};
use serde_json::{Value, json};
use tempfile::TempDir;

mod project;
use project::{TEXT, open, project};

const LENSES: [&str; 3] = [
    "distortion = { k1 = -0.25, k2 = 0.05, p1 = 0.002, p2 = -0.001 }",
    "principal_px = [170.0, 90.0]\ndistortion = { k1 = 0.12 }",
    "distortion = { fisheye = true, k1 = -0.02, k2 = 0.005 }",
];
/// Where the photograph has a mark, pixels.
const MARK: DVec2 = DVec2::new(236.0, 164.0);
/// Radius of the mark, pixels.
const RADIUS: f64 = 4.0;

/// A disc about [`MARK`] on a picture of the size of the project's photograph.
fn marked(low: f32, high: f32) -> Raster<f32> {
    let value = |i: usize| {
        let pixel = DVec2::new((i % 300) as f64, (i / 300) as f64) + 0.5;
        let inside = (RADIUS + 0.5 - pixel.distance(MARK)).clamp(0.0, 1.0);
        low + (high - low) * inside as f32
    };
    Raster::from_pixels(300, 200, (0..60_000).map(value).collect())
}

/// The project with a lens, a mark in its photograph, and some of its text replaced.
fn opened(lens: &str, replace: &[(&str, &str)]) -> (TempDir, Desk) {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    let photo = marked(0.2, 1.0).map(|v| Vec3::splat(*v));
    write_png(folder.path().join("photo.png"), &DisplayImage(photo)).unwrap();
    let mut text = TEXT.replace("fov_deg = 50.0", &format!("fov_deg = 90.0\n{lens}"));
    for (from, to) in replace {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let desk = Desk::open(open(folder.path(), &[])).unwrap();
    (folder, desk)
}

/// Middle of what is brighter than the darkest pixel.
fn centroid(width: usize, values: impl Iterator<Item = f64> + Clone) -> DVec2 {
    let least = values.clone().fold(f64::INFINITY, f64::min);
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for (i, value) in values.enumerate() {
        sum += (DVec2::new((i % width) as f64, (i / width) as f64) + 0.5) * (value - least);
        weight += value - least;
    }
    sum / weight
}

/// Where the page shows the mark.
fn shown(desk: &Desk) -> DVec2 {
    let photo = image::load_from_memory(desk.photo()).unwrap().to_luma8();
    let width = photo.width() as usize;
    centroid(width, photo.as_raw().iter().map(|v| f64::from(*v)))
}

/// What a run makes of the file.
fn run(folder: &Path) -> LoadedScene {
    let session = open(folder, &[]);
    let config: SceneConfig = session.config.table("scene").unwrap();
    Scene::load(&config, folder).unwrap()
}

/// Where the photograph shows a point, pixels.
fn seen(loaded: &LoadedScene, point: DVec3) -> DVec2 {
    let original = loaded.original.as_ref().unwrap();
    let view = ground::view(&loaded.scene.camera, Some(&original.undistortion));
    view.project(point).unwrap()
}

fn edit(value: Value) -> Edit {
    serde_json::from_value(value).unwrap()
}

fn text(folder: &TempDir) -> String {
    fs::read_to_string(folder.path().join("pipeline.toml")).unwrap()
}

/// Two numbers of an array of the file.
fn pixel(text: &str, key: &str) -> DVec2 {
    let start = text.find(&format!("{key} = [")).unwrap() + key.len() + 4;
    let inside = text[start..].split(']').next().unwrap();
    let numbers: Vec<f64> = inside
        .split(',')
        .map(|n| n.trim().parse().unwrap())
        .collect();
    DVec2::new(numbers[0], numbers[1])
}

/// The mark's middle is found in the bent picture within a tenth of a pixel, as a disc that is bent keeps its middle up to
/// a twentieth of its radius; a tenth of a pixel is what the file rounds to. Together less than half a pixel.
const OFF: f64 = 0.5;

#[test]
fn an_object_that_is_put_onto_a_mark_stands_there_in_the_photograph() {
    for lens in LENSES {
        for place in ["at_pixel = [150.0, 150.0]", "position = [0.0, 0.0, -4.0]"] {
            let (folder, desk) = opened(lens, &[("at_pixel = [150.0, 150.0]", place)]);
            let at = shown(&desk);
            assert!(at.distance(MARK) > 3.0, "{lens} bends nothing: {at}");
            let moved = edit(json!({"objects": [{"of": 0, "at": at.to_array()}]}));
            let view = desk.view(&moved, false).unwrap();
            let contact = [0, 1].map(|k| view["objects"][0]["contact"][k].as_f64().unwrap());
            assert!(
                DVec2::from_array(contact).distance(at) < OFF,
                "{contact:?} {at}"
            );
            desk.save(&moved).unwrap();
            let loaded = run(folder.path());
            let stands = loaded.description.objects[0]
                .transform()
                .transform_point3(DVec3::ZERO);
            let there = seen(&loaded, stands);
            assert!(there.distance(MARK) < OFF, "{lens} {place}: {there}");
            if place.starts_with("at_pixel") {
                let written = pixel(&text(&folder), "at_pixel");
                assert!(written.distance(MARK) < OFF, "{lens}: {written}");
            }
        }
    }
}

#[test]
fn a_mask_that_is_painted_over_a_mark_hides_it_in_the_photograph_and_comes_back() {
    for lens in LENSES {
        let (folder, desk) = opened(lens, &[]);
        let photo = image::load_from_memory(desk.photo()).unwrap().to_luma8();
        let least = *photo.as_raw().iter().min().unwrap();
        let over = photo
            .as_raw()
            .iter()
            .map(|v| if *v > least + 9 { 255 } else { 0 });
        desk.paint(over.collect()).unwrap();
        desk.save(&edit(json!({"objects": [{"of": 0}], "mask": true})))
            .unwrap();
        let mask = read_mask(folder.path().join("holdout.png")).unwrap();
        assert_eq!([mask.width(), mask.height()], [300, 200]);
        let there = centroid(300, mask.pixels().iter().map(|v| f64::from(*v)));
        assert!(there.distance(MARK) < OFF, "{lens}: {there}");
        // What is shown again lies on the mark.
        let again = Desk::open(open(folder.path(), &[])).unwrap();
        let own = again.own_mask();
        assert_eq!(own.len(), again.mask_bytes());
        let width = photo.width() as usize;
        let back = centroid(width, own.iter().map(|v| f64::from(*v)));
        assert!(back.distance(shown(&again)) < OFF, "{lens}: {back}");
    }
}

#[test]
fn a_shadow_is_saved_where_the_photograph_shows_it() {
    for lens in LENSES {
        let (folder, desk) = opened(lens, &[("start = \"neutral\"", "")]);
        let tip = shown(&desk);
        let foot = tip - DVec2::new(30.0, 0.0);
        let ends = json!({"foot": foot.to_array(), "tip": tip.to_array(), "height_m": 1.0});
        let drawn = edit(json!({"objects": [{"of": 0}], "shadow": ends}));
        assert!(desk.draft(&drawn, 1, 0).unwrap().is_ok());
        desk.save(&drawn).unwrap();
        let written = ["foot", "tip"].map(|key| pixel(&text(&folder), key));
        assert!(written[1].distance(MARK) < OFF, "{lens}: {written:?}");
        // The light stage casts rays through these pixels of the picture without distortion.
        let loaded = run(folder.path());
        for (written, drawn) in written.into_iter().zip([foot, tip]) {
            let there = loaded.undistorted_pixel(written).unwrap();
            assert!(there.distance(drawn) < OFF, "{lens}: {there} {drawn}");
        }
    }
}

#[test]
fn a_ground_through_pixels_follows_a_camera_that_turns() {
    let plane = "plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }";
    let lengths = "pixels = [[60.0, 180.0], [240.0, 180.0]]\nlengths_m = [[0, 1, 2.0]]";
    for lens in LENSES {
        let (folder, desk) = opened(lens, &[(plane, lengths)]);
        let before = desk.view(&Edit::none(1), false).unwrap();
        let fov_deg = before["camera"]["fov_deg"].clone();
        let turn = |fov_deg: Value| {
            let turn = json!({"pitch_deg": -20.0, "roll_deg": 1.0, "fov_deg": fov_deg});
            edit(json!({"objects": [{"of": 0}], "turn": turn}))
        };
        let shown = desk.view(&turn(fov_deg.clone()), false).unwrap();
        let height = |view: &Value| view["camera"]["height_m"].as_f64().unwrap();
        assert!(
            (height(&shown) / height(&before) - 1.0).abs() > 0.02,
            "{lens}"
        );
        desk.save(&turn(fov_deg)).unwrap();
        let text = text(&folder);
        assert!(
            text.contains("pitch_deg = -20.0") && text.contains("fov_deg = 90.0"),
            "{text}"
        );
        let again = Desk::open(open(folder.path(), &[])).unwrap();
        let saved = again.view(&Edit::none(1), false).unwrap();
        // Both are rounded to single precision.
        assert!(
            (height(&shown) / height(&saved) - 1.0).abs() < 1e-6,
            "{lens}"
        );
        let error = again
            .view(&turn(json!(40.0)), false)
            .unwrap_err()
            .to_string();
        assert!(error.contains("coefficients of the lens"), "{error}");
    }
}

#[test]
fn lines_turn_a_camera_whose_lens_bends_lines_and_keep_its_field_of_view() {
    let (_folder, desk) = opened(LENSES[0], &[]);
    let camera = desk.view(&Edit::none(1), false).unwrap()["camera"].clone();
    // Not at right angles in the world, for any field of view.
    let lines = serde_json::from_value(json!({
        "first": [[[100.0, 190.0], [150.0, 130.0]], [[220.0, 190.0], [180.0, 130.0]]],
        "second": [[[10.0, 180.0], [250.0, 150.0]], [[10.0, 150.0], [250.0, 132.0]]],
    }));
    let found = desk.solve(&Edit::none(1), &lines.unwrap()).unwrap();
    assert!(!found.found_fov);
    let fov_deg = camera["fov_deg"].as_f64().unwrap();
    assert!((found.turn.fov_deg - fov_deg).abs() < 1e-9);
    let turned = edit(json!({"objects": [{"of": 0}], "turn": found.turn}));
    let view = desk.view(&turned, false).unwrap();
    // Angles are written to a thousandth of a degree.
    for key in ["pitch_deg", "roll_deg"] {
        let want = serde_json::to_value(found.turn).unwrap()[key]
            .as_f64()
            .unwrap();
        assert!(
            (view["camera"][key].as_f64().unwrap() - want).abs() < 1e-3,
            "{view}"
        );
    }
}

#[test]
fn what_the_photograph_does_not_show_is_refused_in_words() {
    // The corners of the picture that is shown lie beyond the photograph.
    let (folder, desk) = opened(LENSES[0], &[]);
    let state = desk.state().unwrap();
    let size: [f64; 2] = serde_json::from_value(state["size"].clone()).unwrap();
    // The page darkens what lies beyond the border: the middle of the photograph's left side is a point of it.
    let border: Vec<[f64; 2]> = serde_json::from_value(state["border"].clone()).unwrap();
    let loaded = run(folder.path());
    let camera = &loaded.scene.camera;
    let lens = ground::view(camera, loaded.original.as_ref().map(|o| &o.undistortion));
    let ray = lens.ray(DVec2::new(0.0, 100.0)).unwrap();
    let want = camera.project(camera.position + ray.as_vec3()).unwrap();
    let middle = DVec2::from_array(border[border.len() * 7 / 8]);
    // Single precision of hundreds of pixels.
    assert!(middle.distance(want.as_dvec2()) < 0.01, "{middle} {want}");
    let corner = [size[0] - 1.0, size[1] - 1.0];
    let put = edit(json!({"objects": [{"of": 0, "at": corner}]}));
    let shadow = json!({"foot": [150.0, 150.0], "tip": corner});
    let drawn = edit(json!({"objects": [{"of": 0}], "shadow": shadow}));
    for change in [put, drawn] {
        let error = desk.view(&change, false).unwrap_err().to_string();
        assert!(error.contains("does not show this place"), "{error}");
    }
}

#[test]
fn coefficients_of_zero_are_as_none() {
    let (folder, none) = opened("", &[]);
    let (other, zero) = opened("distortion = { k1 = 0.0 }", &[]);
    assert_eq!(none.photo(), zero.photo());
    assert_eq!(none.state().unwrap()["border"], json!([]));
    let states = [&none, &zero].map(|desk| {
        let mut state = desk.state().unwrap();
        state["file"] = Value::Null;
        state
    });
    assert_eq!(states[0], states[1]);
    let moved = edit(json!({"objects": [{"of": 0, "at": [187.123, 151.456]}]}));
    none.save(&moved).unwrap();
    zero.save(&moved).unwrap();
    let same = text(&other).replace("distortion = { k1 = 0.0 }", "");
    assert_eq!(text(&folder), same);
}
