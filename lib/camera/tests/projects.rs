//! Models of COLMAP: which one a folder or a file of a project stands for.
use std::path::Path;

use dipir_cameras::file::{self, Wanted, Which};
use dipir_cameras::{WorldUp, orientation};
use glam::DVec3;

const CAMERA: &str = "1 PINHOLE 640 480 500 500 320 240\n";

/// A model of one camera, which stands at (0, 0, `z`) and took `name`.
fn put(folder: &Path, z: f64, name: &str) {
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join("cameras.txt"), CAMERA).unwrap();
    let images = format!("# comment\n1 1 0 0 0 0 0 {} 1 {name}\n\n", -z);
    std::fs::write(folder.join("images.txt"), images).unwrap();
}

fn position(path: &Path, photo: &str) -> Result<DVec3, String> {
    let wanted = Wanted {
        size: [640.0, 480.0],
        which: Which::Photo(Path::new(photo)),
        up: Some(WorldUp::Y),
        fov_deg: None,
        turns: None,
    };
    let found = file::read(path, &wanted).map_err(|e| e.to_string())?;
    Ok(found.pose.unwrap().position)
}

#[test]
fn a_project_stands_for_its_model() {
    for model in ["sparse", "sparse/0", "sparse/7"] {
        let project = tempfile::tempdir().unwrap();
        let folder = project.path().join(model);
        put(&folder, 3.0, "a.jpg");
        for path in [project.path(), &project.path().join("sparse"), &folder] {
            assert_eq!(position(path, "a.jpg").unwrap().z, 3.0, "{model}");
            assert_eq!(file::choice(path), None);
            let parts = ["cameras.txt", "images.txt"].map(|name| folder.join(name));
            assert_eq!(file::parts(path), parts);
        }
    }
}

#[test]
fn a_model_sees_pictures_as_they_are_stored() {
    let project = tempfile::tempdir().unwrap();
    put(project.path(), 3.0, "a.jpg");
    let read = |size, orientation| {
        let wanted = Wanted {
            size,
            which: Which::Photo(Path::new("a.jpg")),
            up: Some(WorldUp::Y),
            fov_deg: None,
            turns: None,
        };
        orientation::read_turned(project.path(), &wanted, orientation)
    };
    let [upright, portrait] = [[640.0, 480.0], [960.0, 1280.0]];
    for (size, orientation, quarters) in [
        (upright, 1, 0),
        (upright, 3, 2),
        (portrait, 6, 1),
        (portrait, 8, 3),
        // Of a picture that was turned before, and one that is mirrored, too.
        (upright, 6, 0),
        (upright, 2, 0),
    ] {
        let (found, turned) = read(size, orientation).unwrap();
        assert_eq!(turned, quarters, "{orientation}");
        assert_eq!(found.lens.size, size);
        let up = found.pose.unwrap().rotation.y_axis;
        // As stored, its right is +x and its up -y.
        let want = [DVec3::NEG_Y, DVec3::NEG_X, DVec3::Y, DVec3::X][quarters as usize];
        assert!(up.abs_diff_eq(want, 1e-12), "{orientation}: {up}");
    }
    assert!(read(portrait, 1).is_err());
    let doubt = |size, o| orientation::doubt_of_turn(project.path(), size, o).is_some();
    assert_eq!([1, 3, 6].map(|o| doubt(upright, o)), [false, true, false]);
    assert_eq!([1, 6].map(|o| doubt([500.0; 2], o)), [false, true]);
}

#[test]
fn of_several_models_the_first_is_read_and_how_to_take_another_is_said() {
    let project = tempfile::tempdir().unwrap();
    let sparse = project.path().join("sparse");
    // 10 comes after 2, and what has no model or no number is passed over.
    put(&sparse.join("10"), 10.0, "b.jpg");
    put(&sparse.join("2"), 2.0, "a.jpg");
    put(&sparse.join("old"), 1.0, "a.jpg");
    std::fs::create_dir(sparse.join("0")).unwrap();
    assert_eq!(position(project.path(), "a.jpg").unwrap().z, 2.0);
    let choice = format!(
        "COLMAP's project has 2 models, and the one in {:?} is read; for another write its folder, for instance {:?}",
        sparse.join("2"),
        sparse.join("10")
    );
    assert_eq!(file::choice(project.path()), Some(choice.clone()));
    put(&sparse.join("2"), 2.0, "a.jpg\n\n2 1 0 0 0 0 0 0 1 c.jpg");
    let error = position(project.path(), "b.jpg").unwrap_err();
    let want = format!("it has 2 cameras, and none for \"b.jpg\"; {choice}; say which");
    assert!(error.contains(&want), "{error}");
    assert_eq!(position(&sparse.join("10"), "b.jpg").unwrap().z, 10.0);
}

#[test]
fn a_file_of_a_model_is_no_calibration_and_is_read_with_those_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    put(folder.path(), 3.0, "a.jpg");
    // Of another model: the extension of the file that is named decides.
    std::fs::write(folder.path().join("cameras.bin"), [0; 8]).unwrap();
    for name in ["images.txt", "cameras.txt"] {
        let path = folder.path().join(name);
        assert_eq!(position(&path, "a.jpg").unwrap().z, 3.0);
        assert_eq!(file::parts(&path).len(), 2);
    }
    std::fs::remove_file(folder.path().join("cameras.txt")).unwrap();
    let error = position(&folder.path().join("images.txt"), "a.jpg").unwrap_err();
    let missing = folder.path().join("cameras.txt");
    let want = format!("cannot read the camera file \"{}\"", missing.display());
    assert_eq!(error, want);
}

/// A rig may have a camera of a model that is not read.
#[test]
fn a_camera_of_an_unknown_model_keeps_no_other_of_the_model_from_being_read() {
    let other = "2 THIN_PRISM_FISHEYE 640 480 500 500 320 240 1 2 3 4 5 6 7 8\n";
    let images = "1 1 0 0 0 0 0 -3 1 a.jpg\n\n2 1 0 0 0 0 0 -4 2 b.jpg\n\n";
    let text = tempfile::tempdir().unwrap();
    std::fs::write(text.path().join("cameras.txt"), format!("{other}{CAMERA}")).unwrap();
    std::fs::write(text.path().join("images.txt"), images).unwrap();
    let binary = tempfile::tempdir().unwrap();
    let mut cameras = 2u64.to_le_bytes().to_vec();
    let mut camera = |id: u32, model: u32, parameters: &[f64]| {
        cameras.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
        cameras.extend([640u64.to_le_bytes(), 480u64.to_le_bytes()].concat());
        parameters
            .iter()
            .for_each(|p| cameras.extend(p.to_le_bytes()));
    };
    camera(
        2,
        10,
        &[
            500.0, 500.0, 320.0, 240.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0,
        ],
    );
    camera(1, 1, &[500.0, 500.0, 320.0, 240.0]);
    let mut images = 2u64.to_le_bytes().to_vec();
    for (id, z, name) in [(1u32, -3.0, "a.jpg\0"), (2, -4.0, "b.jpg\0")] {
        images.extend(id.to_le_bytes());
        images.extend(
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, z]
                .map(f64::to_le_bytes)
                .concat(),
        );
        images.extend(id.to_le_bytes());
        images.extend([name.as_bytes(), &[0; 8]].concat());
    }
    std::fs::write(binary.path().join("cameras.bin"), cameras).unwrap();
    std::fs::write(binary.path().join("images.bin"), images).unwrap();
    for model in [text, binary] {
        assert_eq!(position(model.path(), "a.jpg").unwrap().z, 3.0);
        let error = position(model.path(), "b.jpg").unwrap_err();
        let want = "its camera model is THIN_PRISM_FISHEYE; accepted: SIMPLE_PINHOLE";
        assert!(error.contains(want), "{error}");
    }
}

#[test]
fn empty_lines_after_images_mean_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // Of each image two lines, of which the second is empty, and further ones.
    put(
        folder.path(),
        3.0,
        "a.jpg\n\n\n\n2 1 0 0 0 0 0 -4 1 b.jpg\n\n\n",
    );
    assert_eq!(position(folder.path(), "a.jpg").unwrap().z, 3.0);
    assert_eq!(position(folder.path(), "b.jpg").unwrap().z, 4.0);
}

#[test]
fn texts_of_windows_are_read_and_their_pictures_are_found_by_name() {
    const MARK: &str = "\u{feff}";
    let windows = |text: &str| format!("{MARK}{}", text.replace('\n', "\r\n"));
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let frame = |name: &str, z: f64| {
        format!(
            r#"{{"file_path": "images\\{name}", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,{z}],[0,0,0,1]]}}"#
        )
    };
    let frames = [frame("b.jpg", 1.0), frame("a.jpg", 3.0)].join(",\n");
    let transforms = format!("{{\"fl_x\": 500, \"w\": 640, \"h\": 480, \"frames\": [{frames}]}}\n");
    for (name, text) in [
        ("transforms.json", transforms.as_str()),
        ("shot.chan", "1 0 0 3 0 0 0 40\n2 0 0 4 0 0 0 40\n"),
        ("cameras.txt", &format!("# cameras\n{CAMERA}")),
        (
            "images.txt",
            "# images\n1 1 0 0 0 0 0 -1 1 right\\a1.jpg\n\n2 1 0 0 0 0 0 -3 1 left\\a1.jpg\n\n",
        ),
        ("calib.txt", "P2: 500 0 320 -1500 0 500 240 0 0 0 1 0\n"),
    ] {
        std::fs::write(at(name), windows(text)).unwrap();
    }
    assert_eq!(position(&at("transforms.json"), "c/a.jpg").unwrap().z, 3.0);
    assert_eq!(position(&at("shot.chan"), "a1.jpg").unwrap().z, 3.0);
    assert_eq!(position(&at("images.txt"), "left/a1.jpg").unwrap().z, 3.0);
    let wanted = Wanted {
        size: [640.0, 480.0],
        which: Which::Number(2),
        up: None,
        fov_deg: None,
        turns: None,
    };
    let calibrated = file::read(&at("calib.txt"), &wanted).unwrap();
    assert_eq!(calibrated.pose.unwrap().position.x, 3.0);
}

#[test]
fn images_in_another_encoding_are_told() {
    let folder = tempfile::tempdir().unwrap();
    for (images, told) in [
        (&b"\xff\xfe1\0 \0"[..], "it is UTF-16 text"),
        (b"1 1 0 0 0 0 0 0 1 b\xe4r.jpg\n\n", "it is not UTF-8"),
    ] {
        put(folder.path(), 3.0, "a.jpg");
        std::fs::write(folder.path().join("images.txt"), images).unwrap();
        let error = position(folder.path(), "a.jpg").unwrap_err();
        assert!(error.contains(told), "{error}");
    }
}
