//! Cameras from files, lenses that bend lines, planes by pixels and points, and places on them.
use std::path::Path;

use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_scene::config::SceneConfig;
use dipir_scene::description::{ProxyRecord, SceneDescription};
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::{LoadedScene, Scene};
use glam::{DVec2, Vec2, Vec3};
use serde_json::json;

/// A folder with a photo of 300 x 200 pixels and a cube of 1 m.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let shade = |i: usize| Vec3::splat(0.2 + 0.5 * (i % 300) as f32 / 300.0);
    let photo = Raster::from_pixels(300, 200, (0..300 * 200).map(shade).collect());
    dipir_imaging::file::write_png(folder.path().join("photo.png"), &DisplayImage(photo)).unwrap();
    let corners = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from));
    let mut cube: String = corners
        .map(|[x, y, z]| format!("v {} {y} {}\n", x - 0.5, z - 0.5))
        .collect();
    for face in [
        "1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6",
    ] {
        cube += &format!("f {face}\n");
    }
    std::fs::write(folder.path().join("cube.obj"), cube).unwrap();
    folder
}

const STANDS: &str = "position = [0, 1.6, 4]\npitch_deg = -8\nfov_deg = 50";

fn scene(folder: &Path, object: &str, camera: &str, rest: &str) -> Result<LoadedScene, String> {
    let text = format!(
        "background = \"photo.png\"\n[[objects]]\npath = \"cube.obj\"\n{object}\n[camera]\n{camera}\n{rest}"
    );
    let config: SceneConfig = toml::from_str(&text).unwrap();
    Scene::load(&config, folder).map_err(|e| e.to_string())
}

fn loaded(folder: &Path, object: &str, camera: &str, rest: &str) -> LoadedScene {
    scene(folder, object, camera, rest).unwrap()
}

#[test]
fn a_file_and_transforms_are_the_same_camera() {
    let folder = folder();
    let frame = |name: &str, x: f64| {
        json!({
            "file_path": name,
            "transform_matrix": [[1, 0, 0, x], [0, 0, -1, -5], [0, 1, 0, 2], [0, 0, 0, 1]],
        })
    };
    let file = json!({
        "fl_x": 100.0, "fl_y": 110.0, "w": 150, "h": 100,
        "frames": [frame("images/a.png", 0.0), frame("images/photo.png", 1.0)],
    });
    std::fs::write(folder.path().join("transforms.json"), file.to_string()).unwrap();
    let camera = |lines: &str| loaded(folder.path(), "", lines, "").scene.camera;
    let first = camera("transforms = \"transforms.json\"");
    assert_eq!(first.position, Vec3::new(0.0, 2.0, 5.0));
    assert_eq!(first.focal_px, Vec2::new(200.0, 220.0));
    assert_eq!(first.principal_px, Vec2::new(150.0, 100.0));
    let forward = first.ray(first.principal_px).direction;
    assert!((forward - Vec3::NEG_Z).length() < 4.0 * f32::EPSILON);
    let own = camera("file = \"transforms.json\"");
    assert_eq!(own.position.x, 1.0);
    assert_eq!(own, camera("transforms = \"transforms.json\"\nframe = 1"));
    assert_eq!(
        first,
        camera("file = \"transforms.json\"\nimage = \"images/a.png\"")
    );
    let scaled = camera("file = \"transforms.json\"\nfile_scale = 0.5");
    assert_eq!(scaled.position, 0.5 * own.position);
    let error = scene(
        folder.path(),
        "",
        "transforms = \"transforms.json\"\nframe = 9",
        "",
    );
    assert!(
        error
            .unwrap_err()
            .contains("it has 2 cameras, and no camera 9")
    );
    let error = scene(
        folder.path(),
        "",
        "file = \"transforms.json\"\nposition = [0, 1, 2]\nlook_at = [0, 0, 0]",
        "",
    );
    let error = error.unwrap_err();
    assert!(
        error.contains("scene.camera.file and scene.camera.position cannot both"),
        "{error}"
    );
}

#[test]
fn a_calibration_is_a_lens_that_stands_where_the_table_says() {
    let folder = folder();
    let yaml = "image_width: 300\nimage_height: 200\ncamera_matrix:\n  data: [250, 0, 159.5, 0, 251, 94.5, 0, 0, 1]\n";
    std::fs::write(folder.path().join("lens.yaml"), yaml).unwrap();
    let lines = "file = \"lens.yaml\"\nposition = [0, 1.6, 4]\npitch_deg = -8";
    let camera = loaded(folder.path(), "", lines, "").scene.camera;
    assert_eq!(
        (camera.focal_px, camera.principal_px),
        (Vec2::new(250.0, 251.0), Vec2::new(160.0, 95.0))
    );
    assert_eq!(camera.position, Vec3::new(0.0, 1.6, 4.0));
    let error = scene(folder.path(), "", "file = \"lens.yaml\"", "").unwrap_err();
    assert!(
        error.contains("scene.camera.position is missing"),
        "{error}"
    );
}

#[test]
fn a_bent_photograph_is_worked_on_straight_and_kept_as_it_was() {
    let folder = folder();
    let lens = "[camera.distortion]\nk1 = -0.2\nk2 = 0.03";
    let plane = "[proxy]\nplane = {}";
    let bent = loaded(
        folder.path(),
        "at_pixel = [60, 170]",
        STANDS,
        &format!("{lens}\n{plane}"),
    );
    let original = bent.original.as_ref().expect("bent");
    assert_eq!(
        (
            original.photo.image.0.width(),
            original.photo.image.0.height()
        ),
        (300, 200)
    );
    let [w, h] = bent.scene.camera.resolution;
    assert_eq!(
        (bent.photo.image.0.width(), bent.photo.image.0.height()),
        (w as usize, h as usize)
    );
    assert!(w > 310 && h > 205, "{w} x {h}");
    // The foot is seen at its pixel of the photograph.
    let rows = bent.description.objects[0].transform;
    let foot = [0, 1, 2].map(|i| rows[i][3] as f32);
    let seen = bent.scene.camera.project(Vec3::from_array(foot)).unwrap();
    let there = original.undistortion.to_photo(seen.as_dvec2()).unwrap();
    assert!(there.distance(DVec2::new(60.0, 170.0)) < 0.01, "{there}");
    // The same from scene.json.
    let path = folder.path().join("scene.json");
    bent.description.write(&path).unwrap();
    let again = SceneDescription::read(&path)
        .unwrap()
        .load(folder.path())
        .unwrap();
    assert_eq!(again.photo.image, bent.photo.image);
    assert_eq!(again.scene.camera, bent.scene.camera);
    // A lens without distortion is none.
    let straight = loaded(folder.path(), "", STANDS, "[camera.distortion]\nk1 = 0.0");
    assert!(straight.original.is_none() && straight.description.lens.is_none());
    let text = serde_json::to_string(&straight.description).unwrap();
    assert!(!text.contains("\"lens\""));
}

#[test]
fn pixels_of_the_ground_and_a_length_give_its_height() {
    let folder = folder();
    let with = |rest: &str| loaded(folder.path(), "", STANDS, rest).scene;
    let level = with("[proxy]\ncamera_height_m = 1.2");
    let Proxy::Plane(plane) = &level.proxy else {
        panic!("a plane");
    };
    assert!((plane.point.y - 0.4).abs() < 1e-6 && plane.normal == Vec3::Y);
    // Two points of the ground at y = 0.4, and how far they are apart.
    let points = [Vec3::new(-0.8, 0.4, 0.0), Vec3::new(0.9, 0.4, 0.5)];
    let [a, b] = points.map(|p| level.camera.project(p).unwrap());
    let metres = points[0].distance(points[1]);
    let by_length = with(&format!(
        "[proxy]\npixels = [[{}, {}], [{}, {}]]\nlengths_m = [[0, 1, {metres}]]",
        a.x, a.y, b.x, b.y
    ));
    let Proxy::Plane(plane) = &by_length.proxy else {
        panic!("a plane");
    };
    assert!((plane.point.y - 0.4).abs() < 1e-4, "{}", plane.point);
    for (rest, want) in [
        ("pixels = [[1, 2]]", "scene.proxy.lengths_m is missing"),
        (
            "pixels = [[1, 2]]\nlengths_m = [[0, 1, 2]]",
            "numbers of two of the 1 pixels",
        ),
        (
            "plane = {}\npixels = [[1, 2]]",
            "scene.proxy.plane and scene.proxy.pixels cannot both",
        ),
        (
            "plane = {}\npoints_up = \"z\"",
            "scene.proxy.points is missing",
        ),
        (
            "pixels = [[1, 2]]\ncamera_height_m = 1\nrectangle = true",
            "four pixels",
        ),
    ] {
        let error = scene(folder.path(), "", STANDS, &format!("[proxy]\n{rest}")).unwrap_err();
        assert!(error.contains(want), "{error}");
    }
}

/// A scan of level ground at y = -0.5 in a file with +z up, with a post at x = 0, z = -1.
fn scan(folder: &Path, bend: f64) {
    let mut text = String::new();
    let mut count = 0;
    let mut add = |x: f64, y: f64, z: f64| {
        text += &format!("{x} {} {y}\n", -z);
        count += 1;
    };
    for i in 0..90 {
        for j in 0..120 {
            let (x, z) = (-4.5 + 0.1 * f64::from(i), 2.5 - 0.1 * f64::from(j));
            let noise = 0.01 * f64::from((i * 7919 + j * 104_729) % 201 - 100) / 100.0;
            add(x, -0.5 + noise + bend * (-z - 2.0).max(0.0), z);
        }
    }
    for i in 0..300 {
        let angle = f64::from(i);
        add(
            0.25 * angle.sin(),
            -0.5 + 0.01 * f64::from(i % 150),
            -1.0 + 0.25 * angle.cos(),
        );
    }
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    );
    std::fs::write(folder.join("scan.ply"), header + &text).unwrap();
}

#[test]
fn the_ground_of_points_is_in_scene_json_and_objects_find_a_free_place_on_it() {
    let folder = folder();
    scan(folder.path(), 0.0);
    let proxy = "[proxy]\npoints = \"scan.ply\"\npoints_up = \"z\"";
    let found = loaded(
        folder.path(),
        "place = \"auto\"\nheight_m = 0.5",
        STANDS,
        proxy,
    );
    let ProxyRecord::Ground(ground) = &found.description.proxy else {
        panic!("the ground of the points");
    };
    assert!((ground.point.y + 0.5).abs() < 2e-3 && ground.normal.y > 0.99999);
    assert!(ground.inliers > 5000 && ground.residual_m < 0.01 && ground.relief.is_none());
    assert!(found.inputs.iter().any(|i| i.role == "points"));
    let foot = |scene: &LoadedScene| {
        let rows = scene.description.objects[0].transform;
        Vec3::from_array([0, 1, 2].map(|i| rows[i][3] as f32))
    };
    let at = foot(&found);
    // A cube of half a metre, and the air around it, beside the post.
    assert!(Vec2::new(at.x, at.z + 1.0).length() > 0.25 + 0.35, "{at}");
    assert!((at.y + 0.5).abs() < 3e-3, "{at}");
    let other = loaded(
        folder.path(),
        "place = \"auto\"\nplace_draw = 2\nheight_m = 0.5",
        STANDS,
        proxy,
    );
    assert_ne!(foot(&other), at);
    let path = folder.path().join("scene.json");
    found.description.write(&path).unwrap();
    // Later stages need no points.
    std::fs::remove_file(folder.path().join("scan.ply")).unwrap();
    let again = SceneDescription::read(&path)
        .unwrap()
        .load(folder.path())
        .unwrap();
    assert_eq!(again.scene.mesh, found.scene.mesh);
    let error = scene(folder.path(), "place = \"auto\"", STANDS, "").unwrap_err();
    assert!(error.contains("scene.proxy.points is missing"), "{error}");
}

#[test]
fn points_of_which_another_axis_points_up_are_told_with_the_key() {
    let folder = folder();
    scan(folder.path(), 0.0);
    let of = |object: &str, proxy: &str| {
        let proxy = format!("[proxy]\npoints = \"scan.ply\"\n{proxy}");
        scene(folder.path(), object, STANDS, &proxy)
    };
    let want =
        "if z of their world points up, and y is taken: write points_up = \"z\" into [scene.proxy]";
    let error = of("place = \"auto\"\nheight_m = 0.5", "").unwrap_err();
    assert!(error.contains(want), "{error}");
    let right = of("", "points_up = \"z\"").unwrap();
    assert!(!right.warnings.iter().any(|w| w.contains("points_up")));
    let error = of("", "points_up = \"y\"").err().unwrap_or_default();
    assert!(!error.contains(want), "{error}");
}

#[test]
fn a_place_that_is_looked_for_is_apart_from_objects_that_have_one() {
    let folder = folder();
    let auto = "height_m = 0.4\nplace = \"auto\"";
    let at = |scene: &LoadedScene, object: usize| {
        let rows = scene.description.objects[object].transform;
        Vec3::from_array([0, 1, 2].map(|i| rows[i][3] as f32))
    };
    let proxy = "[proxy]\nplane = {}";
    let alone = loaded(folder.path(), auto, STANDS, proxy);
    let place = at(&alone, 0);
    let fixed = format!(
        "height_m = 0.4\nposition = [{}, {}, {}]",
        place.x, place.y, place.z
    );
    let next = "\n[[objects]]\npath = \"cube.obj\"\n";
    for (order, objects) in [(fixed.as_str(), auto), (auto, fixed.as_str())]
        .iter()
        .enumerate()
    {
        let both = [objects.0, next, objects.1].concat();
        let found = loaded(folder.path(), &both, STANDS, proxy);
        let (stands, looked_for) = (at(&found, order), at(&found, 1 - order));
        assert_eq!(stands, place, "{order}");
        // Radii of 0.28 m.
        assert!(looked_for.distance(place) > 0.56, "{order}: {looked_for}");
        let column = |p: Vec3| found.scene.camera.project(p).unwrap().x;
        let apart = (column(looked_for) - column(place)).abs();
        // A cube of .4 m at 4 m is 21 pixels wide.
        assert!(apart > 20.0, "{order}: {apart} pixels");
    }
}

#[test]
fn ground_that_is_not_flat_becomes_a_mesh_on_which_pixels_are_points() {
    let folder = folder();
    scan(folder.path(), 0.15);
    let proxy = "[proxy]\npoints = \"scan.ply\"\npoints_up = \"z\"";
    let found = loaded(folder.path(), "at_pixel = [150, 160]", STANDS, proxy);
    assert!(matches!(&found.scene.proxy, Proxy::Mesh(mesh) if mesh.indices.len() > 1000));
    let rows = found.description.objects[0].transform;
    let foot = Vec3::from_array([0, 1, 2].map(|i| rows[i][3] as f32));
    let seen = found.scene.camera.project(foot).unwrap();
    assert!(seen.distance(Vec2::new(150.0, 160.0)) < 0.5, "{seen}");
    let flat = loaded(
        folder.path(),
        "",
        STANDS,
        &format!("{proxy}\npoints_shape = \"plane\""),
    );
    assert!(matches!(flat.scene.proxy, Proxy::Plane(_)));
}

#[test]
fn a_project_of_colmap_gives_camera_and_ground_and_its_choice_is_said_once() {
    let folder = folder();
    for model in ["0", "1"] {
        let model = folder.path().join("project/sparse").join(model);
        std::fs::create_dir_all(&model).unwrap();
        let put = |name: &str, text: &str| std::fs::write(model.join(name), text).unwrap();
        put("cameras.txt", "1 PINHOLE 300 200 250 250 150 100\n");
        put("images.txt", "1 1 0 0 0 0 0 0 1 photo.png\n\n");
        // Ground 1.6 m below the camera; y points down.
        let points =
            (0..400).map(|i| (f64::from(i % 20 - 10) * 0.4, 3.0 + f64::from(i / 20) * 0.5));
        let points = points.map(|(x, z)| format!("1 {x} 1.6 {z} 9 9 9 0.1\n"));
        put("points3D.txt", &points.collect::<String>());
    }
    let scene = loaded(
        folder.path(),
        "position = [0, -1.6, -5]",
        "file = \"project\"",
        "[proxy]\npoints = \"project\"",
    );
    let said = |w: &&String| w.starts_with("COLMAP's project has 2 models, and the one in ");
    assert_eq!(scene.warnings.iter().filter(said).count(), 1);
    let named: Vec<_> = scene
        .inputs
        .iter()
        .map(|i| i.path.to_str().unwrap())
        .collect();
    for part in ["cameras.txt", "images.txt", "points3D.txt"] {
        let path = format!("project/sparse/0/{part}");
        assert!(named.contains(&path.as_str()), "{path}: {named:?}");
    }
}

#[test]
fn a_frame_has_the_objects_of_its_shot_whatever_the_configuration_has() {
    let folder = folder();
    let second = "[[objects]]\npath = \"cube.obj\"\nposition = [2, 0, 0]";
    let shot = loaded(folder.path(), second, STANDS, "").description;
    let one =
        format!("background = \"photo.png\"\n[[objects]]\npath = \"cube.obj\"\n[camera]\n{STANDS}");
    let config: SceneConfig = toml::from_str(&one).unwrap();
    let frame = Scene::load_frame(&config, folder.path(), &shot).unwrap();
    assert_eq!(frame.description.objects, shot.objects);
    assert_eq!(frame.scene.mesh.indices.len(), 24);
}
