//! Which axis of a file's world is up in its pictures.
use dipir_cameras::file;
use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};

/// Rotations of pictures all around, of which +y is up, looked down at by 20 degrees.
fn around(count: u32) -> impl Iterator<Item = DMat3> {
    (0..count).map(|i| DMat3::from_rotation_y(f64::from(i)) * DMat3::from_rotation_x(-0.35))
}

/// What is said of `transforms.json` with these rotations, as lists of rows.
fn said(rotations: impl Iterator<Item = DMat3>) -> Option<String> {
    let rows = |r: DMat3| [0, 1, 2].map(|i| r.row(i).extend(0.0).to_array());
    let frame = |r| json!({ "file_path": "a.png", "transform_matrix": rows(r) });
    let frames: Vec<Value> = rotations.map(frame).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    std::fs::write(&path, json!({ "fl_x": 500, "frames": frames }).to_string()).unwrap();
    file::doubt(&path, 0)
}

#[test]
fn pictures_that_are_upright_by_another_axis_are_told() {
    // Record3D's world has +y up, where nerfstudio's has +z.
    let told = said(around(12)).unwrap();
    let want = "the pictures of \"transforms.json\" are upright if y of its world points up, and z is taken: write \
                file_up = \"y\" (dipir init: --camera-up), or file_up = \"z\" if that is right";
    assert_eq!(told, want);
    let z_up = DMat3::from_rotation_x(std::f64::consts::FRAC_PI_2);
    assert_eq!(said(around(12).map(|r| z_up * r)), None);
    // Too few, and held in every way.
    assert_eq!(said(around(4)), None);
    let rolled = around(12).zip(0..);
    let rolled = rolled.map(|(r, i)| r * DMat3::from_rotation_z(f64::from(i) * 1.6));
    assert_eq!(said(rolled), None);
}

#[test]
fn a_model_of_colmap_s_that_was_turned_to_the_earth_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let put = |turn: DMat3, is_stored_turned: bool| {
        let image = |r: DMat3| {
            let upright = turn * r;
            // Turned by a quarter clockwise it is upright.
            let stored = match is_stored_turned {
                true => DMat3::from_cols(-upright.y_axis, upright.x_axis, upright.z_axis),
                false => upright,
            };
            // World to camera, in image axes.
            let to_image = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
            let q = DQuat::from_mat3(&(to_image * stored.transpose()));
            format!("1 {} {} {} {} 0 0 0 1 a.png\n\n", q.w, q.x, q.y, q.z)
        };
        let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        put("cameras.txt", "1 PINHOLE 300 200 250 250 150 100\n");
        put("images.txt", &around(12).map(image).collect::<String>());
        file::doubt(folder.path(), is_stored_turned.into())
    };
    let by = DMat3::from_rotation_x;
    assert_eq!(put(by(std::f64::consts::PI), false), None);
    let told = put(by(std::f64::consts::FRAC_PI_2), false).unwrap();
    assert!(
        told.contains("z of its world points up, and -y is taken"),
        "{told}"
    );
    // The first camera as it is stored has -y up, the picture of it -x.
    assert_eq!(put(by(std::f64::consts::PI), true), None);
    let sideways = DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2);
    let told = put(sideways, true).unwrap();
    assert!(
        told.contains("-x of its world points up, and -y is taken"),
        "{told}"
    );
}
