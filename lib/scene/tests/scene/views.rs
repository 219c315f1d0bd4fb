//! Other photographs of the place.
use std::path::Path;

use dipir_cameras::{Distortion, Lens};
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_scene::config::SceneConfig;
use dipir_scene::views::View;
use glam::{DVec2, Vec3};
use serde_json::json;

const SCENE: &str = "background = \"photo.png\"\n[camera]\n";
const TYPED: &str = "position = [0, 1.6, 4]\npitch_deg = -8\nfov_deg = 50\n";

fn picture(folder: &Path, name: &str, [width, height]: [usize; 2]) {
    let grey = Raster::filled(width, height, Vec3::splat(0.5));
    dipir_imaging::file::write_png(folder.join(name), &DisplayImage(grey)).unwrap();
}

/// Of the scene's photograph: 50 degrees of a picture of other pixels.
fn lens() -> Lens {
    let focal = 200.0 / 25f64.to_radians().tan();
    Lens::pinhole([600.0, 400.0], DVec2::splat(focal))
}

/// The first view of a scene with this camera.
fn view(folder: &Path, camera: &str, table: &str) -> Result<View, String> {
    let text = format!("{SCENE}{camera}[[views]]\n{table}");
    let config: SceneConfig = toml::from_str(&text).unwrap();
    let views = config.views().map_err(|e| e.to_string())?;
    views[0].load(folder, &lens()).map_err(|e| e.to_string())
}

fn forward(view: &View) -> Vec3 {
    -view.camera.rotation.z_axis
}

#[test]
fn angles_turn_a_view_to_the_side_first() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "side.png", [60, 40]);
    let table = "background = \"side.png\"\ncamera = { heading_deg = 90, pitch_deg = 30 }";
    let (sin, cos) = 30f32.to_radians().sin_cos();
    // Neither the table nor the photograph tells the field of view: it is the scene's, along the height, whatever
    // tells that.
    let exif = "position = [0, 1, 4]\npitch_deg = -8\n";
    for camera in [TYPED, exif, "file = \"transforms.json\"\n"] {
        let view = view(folder.path(), camera, table).unwrap();
        assert!(forward(&view).distance(Vec3::new(cos, sin, 0.0)) < 1e-5);
        let focal = 20.0 / 25f32.to_radians().tan();
        assert!((view.camera.focal_px.x - focal).abs() < 1e-3);
        assert_eq!(view.camera.resolution, [60, 40]);
    }
}

#[test]
fn a_view_held_upright_has_the_scenes_focal_length() {
    let folder = tempfile::tempdir().unwrap();
    let table = "background = \"b.png\"\ncamera = { heading_deg = 90 }";
    // Of pictures of a tenth of the scene's size.
    let focal = 20.0 / 25f32.to_radians().tan();
    for size in [[60, 40], [40, 60]] {
        picture(folder.path(), "b.png", size);
        let view = view(folder.path(), TYPED, table).unwrap();
        assert!(
            (view.camera.focal_px - focal).abs().max_element() < 1e-3,
            "{size:?}: {}",
            view.camera.focal_px
        );
    }
}

#[test]
fn a_view_with_the_scenes_fisheye_has_its_focal_length() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "b.png", [60, 40]);
    let text = format!(
        "{SCENE}{TYPED}[[views]]\nbackground = \"b.png\"\n\
         camera = {{ heading_deg = 90, distortion = {{ fisheye = true, k1 = -0.02 }} }}"
    );
    let config: SceneConfig = toml::from_str(&text).unwrap();
    let scene_lens = Lens {
        distortion: Distortion::kannala_brandt([-0.02, 0.0, 0.0, 0.0]).unwrap(),
        ..Lens::pinhole([600.0, 400.0], DVec2::splat(170.0))
    };
    let views = config.views().unwrap();
    let view = views[0].load(folder.path(), &scene_lens).unwrap();
    assert!(
        (view.camera.focal_px.y - 17.0).abs() < 1e-3,
        "{}",
        view.camera.focal_px
    );
}

#[test]
fn a_view_is_a_camera_of_the_scenes_file_by_its_name_or_as_it_says() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "b.png", [150, 100]);
    // Frames look along -z, +x, +z and -x of a world with +z up.
    let frame = |name: &str, [x, y]: [i32; 2]| {
        json!({
            "file_path": name,
            "transform_matrix": [[y, 0, -x, 0], [-x, 0, -y, 0], [0, 1, 0, 2], [0, 0, 0, 1]],
        })
    };
    let file = json!({
        "fl_x": 100.0, "fl_y": 100.0, "w": 150, "h": 100,
        "frames": [frame("photo.png", [0, 1]), frame("b.png", [1, 0]), frame("c.png", [0, -1])],
    });
    std::fs::write(folder.path().join("transforms.json"), file.to_string()).unwrap();
    for key in ["file", "transforms"] {
        let camera = format!("{key} = \"transforms.json\"\n");
        let seen = |rest: &str| {
            let table = format!("background = \"b.png\"\n{rest}");
            forward(&view(folder.path(), &camera, &table).unwrap())
        };
        assert!(seen("").distance(Vec3::X) < 1e-6, "{}", seen(""));
        assert!(seen("camera = { frame = 2 }").distance(Vec3::Z) < 1e-6);
        assert!(seen("camera = { image = \"photo.png\" }").distance(Vec3::NEG_Z) < 1e-6);
    }
}

#[test]
fn a_lens_that_bends_lines_is_undone() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "b.png", [60, 40]);
    let lens = "heading_deg = 0, fov_deg = 50, distortion = { k1 = -0.15 }";
    let table = format!("background = \"b.png\"\ncamera = {{ {lens} }}");
    let view = view(folder.path(), TYPED, &table).unwrap();
    let size = [view.image.0.width() as u32, view.image.0.height() as u32];
    assert_eq!(size, view.camera.resolution);
    assert!(size[0] > 60 && view.taken.image.0.width() == 60);
}

#[test]
fn wrong_views_are_explained_by_their_keys() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "b.png", [60, 40]);
    for (camera, table, wanted) in [
        (
            TYPED,
            "",
            "scene.views[0].background is missing; name another photograph of the place",
        ),
        (
            TYPED,
            "background = \"photo.png\"",
            "scene.views[0].background is \"photo.png\"; accepted: another photograph than scene.background",
        ),
        (
            TYPED,
            "background = \"b.png\"",
            "scene.views[0].camera is missing; write where the photograph looks, as in camera = { heading_deg = 90.0",
        ),
        (
            TYPED,
            "background = \"b.png\"\nexposure_stops = 40\ncamera = { heading_deg = 90 }",
            "scene.views[0].exposure_stops is 40; accepted: stops from -30 to 30",
        ),
        (
            TYPED,
            "background = \"b.png\"\ncamera = { pitch_deg = -95 }",
            "scene.views[0].camera.pitch_deg is -95; accepted: degrees from -90 to 90",
        ),
        (
            TYPED,
            "background = \"b.png\"\ncamera = { pitch_deg = 0, up = [0, 1, 0] }",
            "scene.views[0].camera.pitch_deg and scene.views[0].camera.up cannot both be given",
        ),
        (
            TYPED,
            "background = \"b.png\"\ncamera = { heading_deg = 90, focal_mm = 50 }",
            "scene.views[0].camera.sensor_mm is missing; the photograph does not say which sensor took it",
        ),
        (
            TYPED,
            "background = \"c.png\"\ncamera = { heading_deg = 90 }",
            "c.png",
        ),
    ] {
        let error = view(folder.path(), camera, table).unwrap_err();
        assert!(error.contains(wanted), "{table}: {error}");
    }
}
