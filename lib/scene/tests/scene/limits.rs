//! What a file may ask for: every limit names the key that raises it, and is checked before memory
//! is taken.
use dipir_scene::config::SceneConfig;
use dipir_scene::import::{Limits, NoFiles, load_gltf_bytes, load_object_within};
use serde_json::json;

use crate::glb::Glb;

fn message(glb: &Glb, limits: &Limits) -> String {
    load_gltf_bytes(&glb.bytes(), &NoFiles, limits)
        .unwrap_err()
        .to_string()
}

/// A black PNG of one bit a pixel, whose data are deflated zeros.
fn png(width: u32, height: u32) -> Vec<u8> {
    use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
    // Eight times as wide in bits as in bytes: the header is patched and its checksum with it.
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(&[0], 1, 1, ExtendedColorType::L8)
        .unwrap();
    bytes[16..20].copy_from_slice(&width.to_be_bytes());
    bytes[20..24].copy_from_slice(&height.to_be_bytes());
    let sum = crc(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&sum.to_be_bytes());
    bytes
}

/// The checksum of PNG chunks.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| {
            (sum >> 1) ^ (0xedb8_8320 & (sum & 1).wrapping_neg())
        })
    })
}

fn textured(images: &[Vec<u8>]) -> Glb {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    let uv = glb.floats("VEC2", &[0.0; 6]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    for image in images {
        let view = glb.view(image);
        let source = glb.push("images", json!({ "bufferView": view }));
        let texture = glb.push("textures", json!({ "source": source }));
        glb.push(
            "materials",
            json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": texture } } }),
        );
    }
    glb
}

#[test]
fn the_table_changes_single_limits_and_refuses_unknown_ones() {
    let config: SceneConfig =
        toml::from_str("[limits]\ntriangles = 7\nallow_outside = true\n").unwrap();
    let expected = Limits {
        triangles: 7,
        allow_outside: true,
        ..Limits::default()
    };
    assert_eq!(config.limits, expected);
    let error = toml::from_str::<SceneConfig>("[limits]\ntriangels = 7\n").unwrap_err();
    assert!(error.message().contains("triangels"), "{error}");
    // A table without limits is written without.
    assert!(
        !toml::to_string(&SceneConfig::default())
            .unwrap()
            .contains("limits")
    );
}

#[test]
fn triangles_and_copies_are_counted_before_they_are_made() {
    let two = Limits {
        triangles: 2,
        instances: 2,
        ..Limits::default()
    };
    let mut glb = Glb::triangle(json!({}));
    glb.push("nodes", json!({ "mesh": 0 }));
    assert!(load_gltf_bytes(&glb.bytes(), &NoFiles, &two).is_ok());
    glb.push("nodes", json!({ "mesh": 0 }));
    assert_eq!(
        message(&glb, &two),
        "there are 3 triangles: more than the limit of 2; simplify the object, or raise scene.limits.triangles"
    );
    let mut copies = Glb::triangle(json!({}));
    let accessor = copies.push(
        "accessors",
        json!({ "componentType": 5126, "type": "VEC3", "count": 4_000_000 }),
    );
    let extension = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "SCALE": accessor } } });
    copies.json["nodes"][0]["extensions"] = extension.clone();
    assert_eq!(
        message(&copies, &Limits::default()),
        "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes asks for 4000000 copies, those before counted: more than the limit of 1000000; simplify the object, or raise scene.limits.instances"
    );
    copies.json["accessors"][1]["count"] = json!(2);
    copies.push("nodes", json!({ "mesh": 0, "extensions": extension }));
    assert!(message(&copies, &two).contains("nodes[1]"));
}

#[test]
fn lengths_without_bytes_are_bounded_by_the_file() {
    let mut glb = Glb::triangle(json!({}));
    let zeros = |count: u64| json!({ "componentType": 5125, "type": "SCALAR", "count": count });
    let accessor = glb.push("accessors", zeros(50_000_001));
    glb.json["meshes"][0]["primitives"][0]["indices"] = json!(accessor);
    assert_eq!(
        message(&glb, &Limits::default()),
        "accessors[1] has 50000001 elements but no bufferView, and the file only 36 bytes; export the file again"
    );
    glb.json["accessors"][1] = zeros(800_000_000);
    assert_eq!(
        message(&glb, &Limits::default()),
        "there are 266666666 triangles: more than the limit of 20000000; simplify the object, or raise scene.limits.triangles"
    );
}

#[test]
fn textures_are_refused_by_their_headers() {
    let large = png(16_000, 16_000);
    assert!(large.len() < 100);
    assert_eq!(
        message(&textured(std::slice::from_ref(&large)), &Limits::default()),
        "the texture images[0] has 256000000 pixels: more than the limit of 67108864; simplify the object, or raise scene.limits.texture_pixels"
    );
    let wide = Limits {
        texture_pixels: 1 << 30,
        ..Limits::default()
    };
    assert!(load_gltf_bytes(&textured(&[large]).bytes(), &NoFiles, &wide).is_ok());
    let many: Vec<Vec<u8>> = (0..5).map(|_| png(8192, 8192)).collect();
    assert_eq!(
        message(&textured(&many), &Limits::default()),
        "the textures up to images[4] have 335544320 pixels together: more than the limit of 268435456; simplify the object, or raise scene.limits.all_texture_pixels"
    );
}

#[test]
fn files_are_measured_before_they_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hole.glb");
    // A hole: no bytes on the disk.
    std::fs::File::create(&path)
        .unwrap()
        .set_len(1 << 40)
        .unwrap();
    let error = load_object_within(&path, &Limits::default()).unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "\"{}\": the file has 1099511627776 bytes: more than the limit of 4294967296; simplify the object, or raise scene.limits.file_bytes",
            path.display()
        )
    );
}
