//! An object of which nothing can be seen is warned of, with the reason.
use std::path::Path;

use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_scene::scene::Scene;
use glam::Vec3;
use serde_json::{Value, json};

use crate::glb::Glb;

/// The warnings for an object in a file of that name, six metres before the camera.
fn warnings(name: &str, bytes: &[u8], placement: &str) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let photo = DisplayImage(Raster::filled(64, 32, Vec3::splat(0.5)));
    dipir_imaging::file::write_png(folder.path().join("photo.png"), &photo).unwrap();
    std::fs::write(folder.path().join(name), bytes).unwrap();
    std::fs::write(folder.path().join("m.mtl"), "newmtl a\nd 0\nnewmtl b\n").unwrap();
    load(folder.path(), name, placement)
}

fn load(folder: &Path, name: &str, placement: &str) -> Vec<String> {
    let config = toml::from_str(&format!(
        "background = \"photo.png\"\n[[objects]]\npath = \"{name}\"\n{placement}\n\
         [camera]\nposition = [0, 0, 6]\nlook_at = [0, 0, 0]\nfov_deg = 40\n"
    ))
    .unwrap();
    Scene::load(&config, folder).unwrap().warnings
}

fn with_material(material: Value) -> Vec<u8> {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push("materials", material);
    glb.bytes()
}

const TRANSPARENT: &str = "\"o.glb\": nothing of it can be seen: its materials are fully transparent (alpha 0, in an MTL file \"d 0\")";

#[test]
fn an_object_without_extent_says_why() {
    let placed = |node: Value| {
        let mut glb = Glb::triangle(json!({}));
        glb.json["nodes"] = json!([node]);
        glb.bytes()
    };
    let zero = placed(json!({ "mesh": 0, "matrix": vec![0.0; 16] }));
    assert_eq!(
        warnings("o.glb", &zero, ""),
        [
            "\"o.glb\": nothing of it can be seen: all its vertices lie in one point (is a scale or a matrix zero?)"
        ]
    );
    let flat = placed(json!({ "mesh": 0, "scale": [1.0, 0.0, 1.0] }));
    assert_eq!(
        warnings("o.glb", &flat, ""),
        [
            "\"o.glb\": nothing of it can be seen: none of its triangles has an area (is a scale zero along an axis?)"
        ]
    );
    let whole = placed(json!({ "mesh": 0 }));
    assert_eq!(warnings("o.glb", &whole, ""), [""; 0]);
    // sqrt(2) micrometres, and 16 / tan(20 degrees) / 6 pixels a metre.
    assert_eq!(
        warnings("o.glb", &whole, "scale = 1e-6"),
        [
            "\"o.glb\": nothing of it can be seen: it is 1.4e-6 m across, 1.0e-5 of a pixel; raise its scale, or write height_m"
        ]
    );
    assert_eq!(
        warnings("o.glb", &whole, "position = [0.0, 0.0, -5000.0]"),
        [
            "\"o.glb\": nothing of it can be seen: it lies 5.01 km away; if its file has the coordinates of a map, write anchor = \"center\", else raise its scale"
        ]
    );
}

#[test]
fn a_sheet_that_is_seen_from_behind_says_why() {
    let sheet = |double: bool| with_material(json!({ "doubleSided": double }));
    let turned = "yaw_deg = 180.0";
    let found = warnings("o.glb", &sheet(false), turned);
    assert!(
        found.len() == 1 && found[0].contains("single-sided and seen from behind"),
        "{found:?}"
    );
    assert_eq!(warnings("o.glb", &sheet(true), turned), [""; 0]);
    assert_eq!(warnings("o.glb", &sheet(false), ""), [""; 0]);
}

#[test]
fn a_transparent_object_says_why() {
    let alpha = |mode: &str, alpha: f32| {
        with_material(json!({
            "alphaMode": mode, "pbrMetallicRoughness": { "baseColorFactor": [1.0, 1.0, 1.0, alpha] }
        }))
    };
    assert_eq!(warnings("o.glb", &alpha("BLEND", 0.0), ""), [TRANSPARENT]);
    assert_eq!(warnings("o.glb", &alpha("MASK", 0.4), ""), [TRANSPARENT]);
    assert_eq!(warnings("o.glb", &alpha("MASK", 0.6), ""), [""; 0]);
    assert_eq!(warnings("o.glb", &alpha("OPAQUE", 0.0), ""), [""; 0]);
    assert_eq!(warnings("o.glb", &alpha("BLEND", 0.1), ""), [""; 0]);
}

#[test]
fn an_mtl_file_with_d_0_is_warned_of() {
    const CORNERS: &str = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n";
    let all = format!("{CORNERS}usemtl a\nf 1 2 3\n");
    assert_eq!(
        warnings("o.obj", all.as_bytes(), ""),
        [TRANSPARENT.replace("o.glb", "o.obj")]
    );
    let half = format!("{all}usemtl b\nf 3 2 1\n");
    assert_eq!(
        warnings("o.obj", half.as_bytes(), ""),
        [
            "\"o.obj\": the material \"a\" is fully transparent (alpha 0, in an MTL file \"d 0\"): its triangles cannot be seen"
        ]
    );
}

#[test]
fn objects_at_the_same_place_are_said_to_be_drawn_once() {
    let again = "[[objects]]\npath = \"o.glb\"\n".repeat(3);
    let moved = "[[objects]]\npath = \"o.glb\"\nposition = [1, 0, 0]\n";
    let bytes = Glb::triangle(json!({})).bytes();
    assert_eq!(
        warnings("o.glb", &bytes, &format!("{again}{moved}")),
        ["scene.objects: 3 of them stand where the same file stands already, and are drawn once"]
    );
}

#[test]
fn a_closed_object_that_is_inside_out_is_told() {
    // A tetrahedron, its fronts outwards.
    let mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";
    let faces = [[1, 3, 2], [1, 2, 4], [1, 4, 3], [2, 3, 4]];
    let with = |turned: bool, count: usize| {
        let mut glb = Glb::triangle(json!({ "material": 0 }));
        glb.push("materials", json!({}));
        let position = |line: &str| -> Vec<f32> {
            line.split(' ')
                .skip(1)
                .map(|w| w.parse().unwrap())
                .collect()
        };
        let places: Vec<Vec<f32>> = mesh.lines().map(position).collect();
        let corners = faces[..count].iter().flat_map(|[a, b, c]| match turned {
            true => [*a, *c, *b],
            false => [*a, *b, *c],
        });
        let soup: Vec<f32> = corners.flat_map(|k: usize| places[k - 1].clone()).collect();
        let accessor = glb.floats("VEC3", &soup);
        glb.json["meshes"][0]["primitives"] =
            json!([{ "attributes": { "POSITION": accessor }, "material": 0 }]);
        glb.bytes()
    };
    let told = warnings("o.glb", &with(true, 4), "");
    let want = "\"o.glb\": its triangles are single-sided and face inwards";
    assert!(told.len() == 1 && told[0].starts_with(want), "{told:?}");
    // As it should be, and open.
    for (turned, count) in [(false, 4), (true, 3)] {
        assert_eq!(warnings("o.glb", &with(turned, count), ""), [""; 0]);
    }
}
