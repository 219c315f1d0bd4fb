//! Whole scenes from a `[scene]` table.
use std::path::Path;

use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_scene::config::SceneConfig;
use dipir_scene::description::SceneDescription;
use dipir_scene::import::load_object;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::{LoadedScene, Scene};
use glam::{Vec2, Vec3};
use serde_json::json;

use crate::glb::Glb;

/// A folder with a photo of 64 x 32 pixels and a tetrahedron of unit edges along the axes, whose
/// lowest point lies at y = -1.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let photo = DisplayImage(Raster::filled(64, 32, Vec3::splat(0.5)));
    dipir_imaging::file::write_png(folder.path().join("photo.png"), &photo).unwrap();
    let mut glb = Glb::new();
    let position = glb.floats(
        "VEC3",
        &[
            0.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 1.0,
        ],
    );
    let indices = glb.accessor(
        &[0, 1, 3, 0, 2, 1, 0, 3, 2, 1, 2, 3],
        crate::glb::U8,
        "SCALAR",
        12,
    );
    glb.mesh(json!({ "attributes": { "POSITION": position }, "indices": indices }));
    glb.push("nodes", json!({ "mesh": 0 }));
    std::fs::write(folder.path().join("tetrahedron.glb"), glb.bytes()).unwrap();
    folder
}

fn config(object: &str, rest: &str) -> SceneConfig {
    toml::from_str(&format!(
        "background = \"photo.png\"\n\
         [[objects]]\npath = \"tetrahedron.glb\"\n{object}\n\
         [camera]\nposition = [0, 1.6, 6]\nlook_at = [0, 0.5, 0]\nfov_deg = 40\n{rest}"
    ))
    .unwrap()
}

fn load(folder: &Path, object: &str, rest: &str) -> LoadedScene {
    Scene::load(&config(object, rest), folder).unwrap()
}

fn message(folder: &Path, object: &str, rest: &str) -> String {
    Scene::load(&config(object, rest), folder)
        .unwrap_err()
        .to_string()
}

/// A few roundings of numbers of order ten.
const ROUNDING: f32 = 20.0 * f32::EPSILON;

#[test]
fn the_lowest_point_rests_at_the_position() {
    let folder = folder();
    let object = "position = [1.0, 0.25, -2.0]\nyaw_deg = 90.0\nscale = 2.0";
    let loaded = load(folder.path(), object, "");
    let (low, high) = loaded.scene.mesh.bounds().unwrap();
    // A quarter turn counter-clockwise from above sends +x to -z and +z to +x.
    assert!(
        (low - Vec3::new(1.0, 0.25, -4.0)).length() < ROUNDING,
        "{low}"
    );
    assert!(
        (high - Vec3::new(3.0, 2.25, -2.0)).length() < ROUNDING,
        "{high}"
    );
    assert!(matches!(loaded.scene.proxy, Proxy::None));
}

#[test]
fn the_description_holds_the_position_that_a_pixel_said() {
    let folder = folder();
    let ground = "[proxy]\nplane = { normal = [0, 1, 0] }";
    let loaded = load(folder.path(), "at_pixel = [20, 28]", ground);
    // The foot of the object is its file's (0, -1, 0).
    let foot = loaded.description.objects[0]
        .transform()
        .transform_point3(glam::DVec3::NEG_Y);
    let pixel = loaded.scene.camera.project(foot.as_vec3()).unwrap();
    assert!((pixel - Vec2::new(20.0, 28.0)).length() < 0.01, "{pixel}");
    assert!(foot.y.abs() < 1e-5, "{foot}");
    let error = message(folder.path(), "at_pixel = [20, 1]", ground);
    assert!(
        error.contains("accepted: a pixel below the horizon"),
        "{error}"
    );
}

#[test]
fn height_sets_the_extent_along_up_and_center_the_middle() {
    let folder = folder();
    let loaded = load(folder.path(), "height_m = 3.0\nanchor = \"center\"", "");
    let (low, high) = loaded.scene.mesh.bounds().unwrap();
    assert!(
        (low - Vec3::new(-1.5, 0.0, -1.5)).length() < ROUNDING,
        "{low}"
    );
    assert!(
        (high - Vec3::new(1.5, 3.0, 1.5)).length() < ROUNDING,
        "{high}"
    );
}

#[test]
fn on_a_tilted_plane_up_is_its_normal_and_the_foot_touches() {
    let folder = folder();
    let plane = "[proxy]\nplane = { point = [0, 1, 0], normal = [1.0, 2.0, 0.5] }";
    let object = "position = [3.0, 50.0, 1.0]\nyaw_deg = 30.0";
    let mesh = load(folder.path(), object, plane).scene.mesh;
    let n = Vec3::new(1.0, 2.0, 0.5).normalize();
    let heights: Vec<f32> = mesh.corners().map(|p| n.dot(p - Vec3::Y)).collect();
    let low = heights.iter().copied().fold(f32::INFINITY, f32::min);
    let high = heights.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    assert!(low.abs() < ROUNDING, "touches: {low}");
    // The object is one metre tall.
    assert!((high - 1.0).abs() < ROUNDING, "stands upright: {high}");
}

#[test]
fn hovering_over_a_horizontal_plane_is_obeyed_with_a_warning() {
    let folder = folder();
    let plane = "[proxy]\nplane = {}";
    let loaded = load(folder.path(), "position = [0.0, 0.5, 0.0]", plane);
    assert!((loaded.scene.mesh.bounds().unwrap().0.y - 0.5).abs() < ROUNDING);
    assert_eq!(
        loaded.warnings,
        [
            "scene.objects[0] hovers 0.500 m above the proxy plane, as its position says; rest = \"proxy\" puts it there"
        ]
    );
    let loaded = load(
        folder.path(),
        "position = [0.0, 0.5, 0.0]\nrest = \"proxy\"",
        plane,
    );
    assert!(loaded.scene.mesh.bounds().unwrap().0.y.abs() < ROUNDING);
    assert!(loaded.warnings.is_empty());
}

#[test]
fn objects_are_dropped_onto_a_proxy_mesh() {
    let folder = folder();
    // A ramp of slope 1/2 along x between x = -10 and 10.
    let mut glb = Glb::new();
    let position = glb.floats(
        "VEC3",
        &[
            -10.0, -5.0, 10.0, 10.0, 5.0, 10.0, 10.0, 5.0, -10.0, -10.0, -5.0, -10.0,
        ],
    );
    let indices = glb.accessor(&[0, 1, 2, 0, 2, 3], crate::glb::U8, "SCALAR", 6);
    glb.mesh(json!({ "attributes": { "POSITION": position }, "indices": indices }));
    glb.push("nodes", json!({ "mesh": 0 }));
    std::fs::write(folder.path().join("ramp.glb"), glb.bytes()).unwrap();
    let ramp = "[proxy]\nmesh = \"ramp.glb\"";
    let loaded = load(folder.path(), "position = [4.0, 0.0, 1.0]", ramp);
    assert!((loaded.scene.mesh.bounds().unwrap().0.y - 2.0).abs() < ROUNDING);
    assert_eq!(
        message(folder.path(), "position = [40.0, 0.0, 1.0]", ramp),
        "scene.objects[0].position is [40.0, 0.0, 1.0]; accepted: a position with the proxy mesh below or above it, which spans x from -10 to 10 and z from -10 to 10; or rest = \"position\""
    );
}

#[test]
fn the_camera_takes_its_resolution_from_the_photo() {
    let folder = folder();
    let camera = load(folder.path(), "", "").scene.camera;
    assert_eq!(camera.resolution, [64, 32]);
    let centre = camera.project(Vec3::new(0.0, 0.5, 0.0)).unwrap();
    // Pixels of order fifty.
    assert!((centre - Vec2::new(32.0, 16.0)).length() < 100.0 * f32::EPSILON);
    let top = camera.ray(Vec2::new(32.0, 0.0)).direction;
    let middle = camera.ray(Vec2::new(32.0, 16.0)).direction;
    assert!((top.angle_between(middle) - 20f32.to_radians()).abs() < 1e-5);
    assert!(top.y > middle.y, "row 0 is at the top");
}

#[test]
fn the_description_rebuilds_the_same_scene() {
    let folder = folder();
    let plane = "[proxy]\nplane = { normal = [0.1, 1.0, 0.0] }";
    let mut first = load(folder.path(), "yaw_deg = 33.0\nheight_m = 1.7", plane);
    first.description.seed = u64::MAX;
    let path = folder.path().join("scene.json");
    first.description.write(&path).unwrap();
    let description = SceneDescription::read(&path).unwrap();
    assert_eq!(description, first.description);
    let second = description.load(folder.path()).unwrap();
    assert_eq!(second.scene.mesh, first.scene.mesh);
    assert_eq!(second.scene.camera, first.scene.camera);
    assert_eq!(second.description.objects[0].triangles, 4);
    let roles: Vec<&str> = first.inputs.iter().map(|i| i.role.as_str()).collect();
    assert_eq!(roles, ["background", "object"]);
}

#[test]
fn a_changed_object_is_noticed() {
    let folder = folder();
    let first = load(folder.path(), "", "");
    let path = folder.path().join("tetrahedron.glb");
    let mut bytes = std::fs::read(&path).unwrap();
    bytes.push(0);
    std::fs::write(&path, &bytes).unwrap();
    let error = first
        .description
        .load(folder.path())
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        format!(
            "the object \"tetrahedron.glb\" changed since the scene was set up: its BLAKE3 hash is {}, the scene description has {}; run dipir-scene again",
            blake3::hash(&bytes).to_hex(),
            first.description.objects[0].file.blake3
        )
    );
}

#[test]
fn objects_of_one_file_share_its_materials() {
    let folder = folder();
    let twice = "[[objects]]\npath = \"tetrahedron.glb\"\nposition = [5.0, 0.0, 0.0]";
    let scene = load(folder.path(), "", twice).scene;
    assert_eq!(scene.materials.len(), 1);
    assert_eq!(scene.mesh.indices.len(), 8);
    let alone = load_object(&folder.path().join("tetrahedron.glb")).unwrap();
    let n = alone.mesh.positions.len();
    for (a, b) in scene.mesh.positions[..n]
        .iter()
        .zip(&scene.mesh.positions[n..])
    {
        assert!((*b - *a - Vec3::new(5.0, 0.0, 0.0)).length() < ROUNDING);
    }
}

#[test]
fn features_are_absent_unless_a_used_material_has_them() {
    let folder = folder();
    let features = load(folder.path(), "", "").scene.features();
    assert!(features.specular && features.single_sided);
    assert!(!features.textures && !features.emission && !features.clearcoat);
    assert!(!features.alpha_mask && !features.alpha_blend && !features.transmission);
}

#[test]
fn a_mask_of_another_size_is_refused() {
    let folder = folder();
    let mask = DisplayImage(Raster::filled(10, 10, Vec3::ONE));
    dipir_imaging::file::write_png(folder.path().join("mask.png"), &mask).unwrap();
    let mut config = config("", "");
    config.occluders = Some("mask.png".into());
    assert_eq!(
        Scene::load(&config, folder.path()).unwrap_err().to_string(),
        "scene.occluders is an image of 10 x 10 pixels (\"mask.png\"); accepted: one of the background's size, 64 x 32"
    );
}

/// Shades of a depth map of 64 x 32 pixels, by what is seen there: its depth, where the ground's is `ground`, metres.
fn put_depths(folder: &Path, seen: impl Fn(u32, u32, f64) -> f64) {
    put_depths_of(folder, [64, 32], seen);
}

/// The same of any size.
fn put_depths_of(folder: &Path, [width, height]: [u32; 2], seen: impl Fn(u32, u32, f64) -> f64) {
    let camera = load(folder, "", "").scene.camera.scaled([width, height]);
    let shades = image::ImageBuffer::from_fn(width, height, |x, y| {
        let ray = camera.ray(Vec2::new(x as f32, y as f32) + 0.5);
        let ahead = -ray.direction.dot(camera.rotation.z_axis);
        let ground = match ray.direction.y < 0.0 {
            true => f64::from(1.6 / -ray.direction.y * ahead),
            false => 1e3,
        };
        image::Luma([(1e4 / seen(x, y, ground)) as u16])
    });
    let path = folder.join("depth.png");
    image::DynamicImage::from(shades).save(path).unwrap();
}

const GROUND: &str = "[proxy]\nplane = { point = [0, 0, 0], normal = [0, 1, 0] }";

fn with_depth(folder: &Path, object: &str, more: &str) -> SceneConfig {
    let mut config = config(object, GROUND);
    config.depth = Some("depth.png".into());
    if !more.is_empty() {
        let mask =
            image::GrayImage::from_fn(64, 32, |_, y| image::Luma([if y < 3 { 255 } else { 0 }]));
        mask.save(folder.join(more)).unwrap();
        config.occluders = Some(more.into());
    }
    config
}

#[test]
fn a_mask_and_depths_hide_together_and_a_look_does_without_what_cannot_be_used() {
    let folder = folder();
    let folder = folder.path();
    // A fence in the left third.
    put_depths(
        folder,
        |x, _, ground| if x < 21 { ground.min(2.0) } else { ground },
    );
    let loaded = Scene::load(&with_depth(folder, "", "mask.png"), folder).unwrap();
    let hidden = loaded.occluders.as_ref().unwrap();
    assert_eq!(*hidden.get(40, 1), 1.0);
    assert_eq!(*hidden.get(8, 16), 1.0);
    assert_eq!(*hidden.get(40, 16), 0.0);
    assert_eq!(*loaded.mask().unwrap().get(8, 16), 0.0);
    // What is written down makes the same scene.
    let again = loaded.description.load(folder).unwrap();
    assert_eq!(again.occluders, loaded.occluders);
    assert_eq!(again.description, loaded.description);
    // Of another picture.
    put_depths(folder, |x, y, _| 1.0 + f64::from((x * 97 + y * 57) % 101));
    let config = with_depth(folder, "", "mask.png");
    let refused = Scene::load(&config, folder).unwrap_err().to_string();
    assert!(refused.contains("depth.png"), "{refused}");
    let look = Scene::load_for_a_look(&config, folder).unwrap();
    assert_eq!(look.occluders.as_ref(), look.mask());
    let told = |w: &String| w.starts_with("scene.depth is left out: ");
    assert!(look.warnings.iter().any(told), "{:?}", look.warnings);
}

#[test]
fn a_place_is_looked_for_beside_what_depths_show() {
    let folder = folder();
    let folder = folder.path();
    let x_of = |seen: &dyn Fn(u32, u32, f64) -> f64| {
        put_depths(folder, seen);
        let object = "place = \"auto\"\nscale = 0.3";
        let loaded = Scene::load(&with_depth(folder, object, ""), folder).unwrap();
        let (low, high) = loaded.scene.mesh.bounds().unwrap();
        let middle = loaded.scene.camera.project(0.5 * (low + high)).unwrap();
        middle.x
    };
    let free = x_of(&|_, _, ground| ground);
    assert!((26.0..38.0).contains(&free), "{free}");
    // A wall across the middle, near the camera.
    let beside = x_of(&|x, _, ground| {
        if (22..42).contains(&x) {
            ground.min(3.0)
        } else {
            ground
        }
    });
    assert!(!(22.0..42.0).contains(&beside), "{beside}");
}

#[test]
fn an_object_stands_on_the_table_that_depths_show() {
    let folder = folder();
    let folder = folder.path();
    let camera = load(folder, "", "").scene.camera;
    // Half as high as the camera, in the right half, up to where a wall begins 6 m ahead.
    let top_m = 0.8;
    let seen = |x: u32, _: u32, ground: f64| match x >= 256 {
        true => (ground * (1.6 - top_m) / 1.6).min(6.0),
        false => ground.min(6.0),
    };
    put_depths_of(folder, [512, 256], seen);
    let put = |pixel: [f32; 2], rest: &str| {
        let object = format!("at_pixel = {pixel:?}\nscale = 0.3\nrest = {rest:?}");
        let loaded = Scene::load(&with_depth(folder, &object, ""), folder)?;
        let (low, _) = loaded.scene.mesh.bounds().unwrap();
        let again = loaded.description.load(folder).unwrap();
        let [found, known] = [&loaded, &again].map(|l| l.catching().unwrap());
        assert!(found.share() == known.share());
        let at = Vec2::new(48.0, 20.0);
        assert_eq!(found.point_at(&camera, at), known.point_at(&camera, at));
        assert_eq!(again.scene.mesh.bounds(), loaded.scene.mesh.bounds());
        Ok::<f64, dipir_scene::Error>(low.y.into())
    };
    // A row of the ground, 3 m away, and so of the table, 1.5 m away.
    let row = camera
        .project(Vec3::new(0.0, 0.0, camera.position.z - 3.0))
        .unwrap()
        .y;
    let on_table = put([48.0, row], "surface").unwrap();
    // The scale is that of the ground at the photograph's 64 x 32 pixels: half a pixel of its rows is 2% of what is seen there.
    assert!((on_table - top_m).abs() < 0.02 * 1.6, "{on_table}");
    assert!(put([48.0, row], "proxy").unwrap().abs() < 1e-5);
    assert!(put([16.0, row], "surface").unwrap().abs() < 1e-5);
    let refused = put([48.0, 2.0], "surface").unwrap_err().to_string();
    assert!(refused.contains("leans 80 degrees"), "{refused}");
    let mut without = with_depth(folder, "", "");
    without.depth_surfaces = Some(false);
    let without = Scene::load(&without, folder).unwrap();
    assert!(without.catching().is_none());
    assert!(
        without
            .description
            .load(folder)
            .unwrap()
            .catching()
            .is_none()
    );
    // A coarse map of a larger photograph.
    let large = DisplayImage(Raster::filled(256, 128, Vec3::splat(0.5)));
    dipir_imaging::file::write_png(folder.join("photo.png"), &large).unwrap();
    put_depths(folder, |x, y, ground| seen(8 * x, y, ground));
    let object = "at_pixel = [200, 120]\nrest = \"surface\"";
    let coarse = Scene::load(&with_depth(folder, object, ""), folder);
    let refused = coarse.unwrap_err().to_string();
    assert!(
        refused.contains("a map of 64 x 32 texels; accepted: at least 128"),
        "{refused}"
    );
    let coarse = Scene::load(&with_depth(folder, "", ""), folder).unwrap();
    assert!(coarse.occluders.is_some() && coarse.catching().is_none());
}
