//! Compressed geometry and images.
use dipir_scene::texture::decode_textures;
use glam::{Vec2, Vec3};
use serde_json::json;

use crate::glb::{Glb, I16};

/// What the extension's encoder makes of `elements`.
fn meshopt<const N: usize>(elements: &[[u8; N]]) -> Vec<u8> {
    use meshopt_rs::vertex::VertexEncodingVersion::V0;
    use meshopt_rs::vertex::buffer::{encode_vertex_buffer, encode_vertex_buffer_bound};
    let mut buffer = vec![0; encode_vertex_buffer_bound(elements.len(), N)];
    let size = encode_vertex_buffer(&mut buffer, elements, V0).unwrap();
    buffer.truncate(size);
    buffer
}

#[test]
fn quantised_geometry_of_a_compressed_view_arrives() {
    // Positions of three 16-bit numbers and two bytes of padding, as gltfpack writes them.
    let corners = [[0i16, 0, 0, 0], [100, 0, 0, 0], [0, 200, 0, 0]];
    let elements: Vec<[u8; 8]> = corners
        .iter()
        .map(|c| std::array::from_fn(|i| c[i / 2].to_le_bytes()[i % 2]))
        .collect();
    let bytes = meshopt(&elements);
    let mut glb = Glb::new();
    glb.json["extensionsRequired"] = json!(["EXT_meshopt_compression", "KHR_mesh_quantization"]);
    let view = glb.view(&bytes);
    glb.json["bufferViews"][view] = json!({
        "buffer": 1, "byteLength": 24, "byteStride": 8,
        "extensions": { "EXT_meshopt_compression": {
            "buffer": 0, "byteLength": bytes.len(), "byteStride": 8, "count": 3, "mode": "ATTRIBUTES"
        } },
    });
    glb.json["buffers"] = json!([
        { "byteLength": bytes.len() },
        { "byteLength": 24, "extensions": { "EXT_meshopt_compression": { "fallback": true } } },
    ]);
    let position = glb.push(
        "accessors",
        json!({ "bufferView": view, "componentType": I16, "type": "VEC3", "count": 3 }),
    );
    glb.mesh(json!({ "attributes": { "POSITION": position } }));
    glb.push("nodes", json!({ "mesh": 0, "scale": [0.01, 0.01, 0.01] }));
    let imported = glb.load();
    // 0.01 in double precision, then rounded.
    let (x, y) = (Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.0, 2.0, 0.0));
    for (p, expected) in imported.mesh.positions.iter().zip([Vec3::ZERO, x, y]) {
        assert!((*p - expected).length() <= 2.0 * f32::EPSILON, "{p}");
    }
    assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);

    let extension = "/bufferViews/0/extensions/EXT_meshopt_compression";
    for (key, value, expected) in [
        (
            "count",
            json!(50_000_000),
            "bufferViews[0].extensions.EXT_meshopt_compression has a stream that is cut short; export the file again",
        ),
        (
            "mode",
            json!("ATOMS"),
            "bufferViews[0].extensions.EXT_meshopt_compression has the mode \"ATOMS\" with 3 elements, a stride of 8 and the filter \"NONE\"; export the file again",
        ),
        (
            "filter",
            json!("BLUR"),
            "bufferViews[0].extensions.EXT_meshopt_compression has the filter \"BLUR\" at a stride of 8; export the file again",
        ),
        (
            "buffer",
            json!(7),
            "bufferViews[0].extensions.EXT_meshopt_compression.buffer is 7, but the file has 2 buffers; export the file again",
        ),
    ] {
        let mut broken = glb.clone();
        broken.json.pointer_mut(extension).unwrap()[key] = value;
        assert_eq!(broken.try_load().unwrap_err().to_string(), expected);
    }
}

#[test]
fn webp_textures_are_decoded() {
    use image::{ExtendedColorType, codecs::webp::WebPEncoder};
    let mut bytes = Vec::new();
    WebPEncoder::new_lossless(&mut bytes)
        .encode(&[255, 0, 51, 128], 1, 1, ExtendedColorType::Rgba8)
        .unwrap();
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    let uv = glb.floats("VEC2", &[0.0; 6]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    glb.json["extensionsRequired"] = json!(["EXT_texture_webp"]);
    let view = glb.view(&bytes);
    glb.push(
        "images",
        json!({ "bufferView": view, "mimeType": "image/webp" }),
    );
    glb.push(
        "textures",
        json!({ "extensions": { "EXT_texture_webp": { "source": 0 } } }),
    );
    glb.push("materials", json!({ "normalTexture": { "index": 0 } }));
    let imported = glb.load();
    let decoded = decode_textures(&imported.textures, |_| true).unwrap();
    let texel = decoded[0].as_ref().unwrap().sample(Vec2::splat(0.5));
    let expected = [255.0, 0.0, 51.0, 128.0].map(|v| v / 255.0);
    assert_eq!(texel.to_array(), expected);

    let mut broken = glb.clone();
    let at = broken.json["bufferViews"][view]["byteOffset"]
        .as_u64()
        .unwrap() as usize;
    broken.binary[at + 24..at + bytes.len()].fill(0xff);
    let imported = broken.load();
    let error = decode_textures(&imported.textures, |_| true).unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("the WebP image images[0] cannot be decoded: "),
        "{error}"
    );
}

#[test]
fn compressed_geometry_without_an_uncompressed_copy_is_refused_though_it_is_not_required() {
    let mut glb = Glb::triangle(json!({
        "extensions": { "KHR_draco_mesh_compression": { "bufferView": 0, "attributes": {} } },
    }));
    assert_eq!(
        glb.try_load().unwrap().warnings,
        [
            "meshes[0].primitives[0]: KHR_draco_mesh_compression is not read, its uncompressed copy is"
        ]
    );
    let accessor = glb.json["accessors"][0].as_object_mut().unwrap();
    accessor.remove("bufferView");
    assert_eq!(
        glb.try_load().unwrap_err().to_string(),
        "the file requires the glTF extension KHR_draco_mesh_compression, which is not supported; convert the file: gltf-transform copy IN.glb OUT.glb"
    );
}
