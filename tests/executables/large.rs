//! Objects of millions of triangles.
use serde_json::{Value, json};

use crate::project::*;

/// Vertices along each side of the sheet.
const SIDE: u32 = 1583;

/// A GLB with a bumpy sheet of two triangles per cell.
fn sheet() -> Vec<u8> {
    let mut binary = Vec::new();
    let last = (SIDE - 1) as f32;
    for n in 0..SIDE * SIDE {
        let (x, z) = ((n % SIDE) as f32 / last, (n / SIDE) as f32 / last);
        let y = 0.05 + 0.05 * (20.0 * x).sin() * (17.0 * z).cos();
        for v in [x - 0.5, y, z - 0.5] {
            binary.extend(v.to_le_bytes());
        }
    }
    let positions = binary.len();
    for row in 0..SIDE - 1 {
        for column in 0..SIDE - 1 {
            let a = row * SIDE + column;
            for v in [a, a + SIDE, a + 1, a + 1, a + SIDE, a + SIDE + 1] {
                binary.extend(v.to_le_bytes());
            }
        }
    }
    let indices = binary.len() - positions;
    let document = json!({
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}], "scene": 0,
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": binary.len()}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": positions},
            {"buffer": 0, "byteOffset": positions, "byteLength": indices},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": SIDE * SIDE, "type": "VEC3",
             "min": [-0.5, 0.0, -0.5], "max": [0.5, 0.1, 0.5]},
            {"bufferView": 1, "componentType": 5125, "count": indices / 4, "type": "SCALAR"},
        ],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut glb = Vec::with_capacity(28 + text.len() + binary.len());
    let length = 28 + text.len() + binary.len();
    for word in [
        0x4654_6c67,
        2,
        length as u32,
        text.len() as u32,
        0x4e4f_534a,
    ] {
        glb.extend(u32::to_le_bytes(word));
    }
    glb.extend(text);
    glb.extend((binary.len() as u32).to_le_bytes());
    glb.extend(0x004e_4942_u32.to_le_bytes());
    glb.extend(binary);
    glb
}

#[test]
fn five_million_triangles_are_set_up_in_bounded_memory() {
    let project = Project::new();
    project.write("object.glb", sheet());
    let run = project.run(
        SCENE,
        &["--json", "--set", r#"scene.objects=[{path="object.glb"}]"#],
    );
    run.expect_success();
    let result: Value = serde_json::from_str(&run.stdout).unwrap();
    let triangles = result["triangles"].as_f64().unwrap();
    assert_eq!(triangles, f64::from(2 * (SIDE - 1) * (SIDE - 1)));
    assert!(triangles > 5e6);
    // The file is 18 bytes a triangle, the mesh with normals 24, the hierarchy 60 and twice that
    // while it is built.
    let bytes = result["peak_rss_bytes"].as_f64().unwrap();
    assert!(bytes < 400.0 * triangles, "{bytes}");
}

/// With work that grows with the square of the objects this would take hours.
#[test]
fn one_object_listed_ten_thousand_times_is_drawn_once_and_warned_of() {
    const COPIES: usize = 10_000;
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    let object = "[[scene.objects]]\npath = \"object.obj\"\n";
    project.write(
        "pipeline.toml",
        text.replace(object, &object.repeat(COPIES)),
    );
    let run = project.run(SCENE, &["--json"]);
    run.expect_success();
    let result: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(result["triangles"], 4 * COPIES);
    let warning = format!(
        "scene.objects: {} of them stand where the same file stands already, and are drawn once",
        COPIES - 1
    );
    assert_eq!(run.stderr.matches("warning").count(), 1, "{}", run.stderr);
    assert!(run.stderr.contains(&warning), "{}", run.stderr);
    project.run(COMPOSITE, &[]).expect_success();
}
