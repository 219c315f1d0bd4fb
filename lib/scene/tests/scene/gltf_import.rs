//! What a glTF file says is what arrives.
use dipir_scene::import::{Folder, Limits, NoFiles, load_gltf_bytes, load_object};
use dipir_scene::mesh::TriangleMesh;
use glam::{DVec3, Vec3, Vec4};
use serde_json::json;

use crate::glb::{F32, Glb, I16, TRIANGLE, U8, U16, U32, merge, one_texel_png};

/// Rounding of a few single-precision operations on numbers of order one.
pub const ROUNDING: f32 = 4.0 * f32::EPSILON;

fn normal_of(mesh: &TriangleMesh, triangle: usize) -> Vec3 {
    mesh.scaled_normal(triangle).normalize().as_vec3()
}

/// A unit square facing +z whose u runs along +x and whose v runs down, with a normal map.
pub fn normal_mapped_square(uvs: &[f32]) -> Glb {
    let mut glb = Glb::new();
    let position = glb.floats(
        "VEC3",
        &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0],
    );
    let normal = glb.floats("VEC3", &[0.0, 0.0, 1.0].repeat(4));
    let uv = glb.floats("VEC2", uvs);
    let indices = glb.accessor(&[0, 1, 2, 0, 2, 3], U8, "SCALAR", 6);
    let view = glb.view(&one_texel_png([0.5, 0.5, 1.0]));
    glb.push(
        "images",
        json!({ "bufferView": view, "mimeType": "image/png" }),
    );
    glb.push("textures", json!({ "source": 0 }));
    glb.push("materials", json!({ "normalTexture": { "index": 0 } }));
    let mesh = glb.mesh(json!({
        "attributes": { "POSITION": position, "NORMAL": normal, "TEXCOORD_0": uv },
        "indices": indices,
        "material": 0,
    }));
    glb.push("nodes", json!({ "mesh": mesh }));
    glb
}

#[test]
fn nested_transforms_compose_from_the_root() {
    let mut glb = Glb::triangle(json!({}));
    glb.json["nodes"] = json!([
        { "children": [1], "translation": [10.0, 0.0, 0.0] },
        // A quarter turn about z.
        { "children": [2], "rotation": [0.0, 0.0, 0.5f64.sqrt(), 0.5f64.sqrt()] },
        { "mesh": 0, "scale": [2.0, 3.0, 4.0] },
    ]);
    let mesh = glb.load().mesh;
    let expected = [
        Vec3::new(10.0, 0.0, 0.0),
        Vec3::new(10.0, 2.0, 0.0),
        Vec3::new(7.0, 0.0, 0.0),
    ];
    for (p, e) in mesh.positions.iter().zip(expected) {
        // Coordinates of order ten.
        assert!((*p - e).length() < 10.0 * ROUNDING, "{p} instead of {e}");
    }
}

#[test]
fn mirrored_nodes_keep_fronts_and_flip_the_tangents_sign() {
    let square = normal_mapped_square(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    let plain = square.load().mesh;
    let mut mirrored = square.clone();
    mirrored.json["nodes"] = json!([{ "mesh": 0, "scale": [-1.0, 1.0, 1.0] }]);
    let mirrored = mirrored.load().mesh;
    for t in 0..2 {
        assert_eq!(normal_of(&plain, t), Vec3::Z);
        assert_eq!(normal_of(&mirrored, t), Vec3::Z);
    }
    assert!(mirrored.normals.iter().all(|n| *n == Vec3::Z));
    assert!(
        plain
            .tangents
            .iter()
            .all(|t| *t == Vec4::new(1.0, 0.0, 0.0, 1.0))
    );
    assert!(
        mirrored
            .tangents
            .iter()
            .all(|t| *t == Vec4::new(-1.0, 0.0, 0.0, -1.0))
    );
}

#[test]
fn a_mesh_under_two_nodes_is_expanded_twice() {
    let mut glb = Glb::triangle(json!({}));
    glb.push(
        "nodes",
        json!({ "mesh": 0, "translation": [5.0, 0.0, 0.0] }),
    );
    let mesh = glb.load().mesh;
    assert_eq!(mesh.indices, [[0, 1, 2], [3, 4, 5]]);
    assert_eq!(mesh.positions[3], Vec3::new(5.0, 0.0, 0.0));
}

#[test]
fn gpu_instancing_places_copies_relative_to_the_node() {
    let mut glb = Glb::triangle(json!({}));
    let translation = glb.floats("VEC3", &[1.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
    let scale = glb.floats("VEC3", &[1.0, 1.0, 1.0, 3.0, 3.0, 3.0]);
    glb.json["extensionsRequired"] = json!(["EXT_mesh_gpu_instancing"]);
    merge(
        &mut glb.json["nodes"][0],
        json!({
            "translation": [0.0, 0.0, 7.0],
            "extensions": { "EXT_mesh_gpu_instancing": {
                "attributes": { "TRANSLATION": translation, "SCALE": scale }
            } },
        }),
    );
    let mesh = glb.load().mesh;
    assert_eq!(mesh.positions[0], Vec3::new(1.0, 0.0, 7.0));
    assert_eq!(mesh.positions[4], Vec3::new(5.0, 0.0, 7.0));
}

#[test]
fn index_types_and_no_indices_mean_the_same_triangles() {
    let expected = Glb::triangle(json!({})).load().mesh.indices;
    let bytes = |component| -> Vec<u8> {
        match component {
            U8 => vec![0, 1, 2],
            U16 => [0u16, 1, 2].iter().flat_map(|i| i.to_le_bytes()).collect(),
            _ => [0u32, 1, 2].iter().flat_map(|i| i.to_le_bytes()).collect(),
        }
    };
    for component in [U8, U16, U32] {
        let mut glb = Glb::triangle(json!({}));
        let indices = glb.accessor(&bytes(component), component, "SCALAR", 3);
        glb.json["meshes"][0]["primitives"][0]["indices"] = json!(indices);
        assert_eq!(glb.load().mesh.indices, expected, "component {component}");
    }
}

#[test]
fn a_stride_of_zero_means_one_element_behind_the_other() {
    let mut glb = Glb::triangle(json!({}));
    glb.json["bufferViews"][0]["byteStride"] = json!(0);
    assert_eq!(glb.load().mesh.positions[1], Vec3::X);
}

#[test]
fn strips_and_fans_face_the_same_way_as_triangles() {
    // Corners of a square facing +z, in the order of a strip and of a fan.
    let strip = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0];
    let fan = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0];
    for (mode, corners) in [(5, strip), (6, fan)] {
        let mut glb = Glb::new();
        let position = glb.floats("VEC3", &corners);
        glb.mesh(json!({ "attributes": { "POSITION": position }, "mode": mode }));
        glb.push("nodes", json!({ "mesh": 0 }));
        let mesh = glb.load().mesh;
        assert_eq!(mesh.indices.len(), 2);
        let area: f64 = (0..2).map(|t| 0.5 * mesh.scaled_normal(t).z).sum();
        assert_eq!(area, 1.0, "mode {mode}");
    }
}

#[test]
fn points_and_lines_are_named_and_left_out() {
    let mut glb = Glb::triangle(json!({}));
    let lines = json!({ "attributes": { "POSITION": 0 }, "mode": 1 });
    glb.json["meshes"][0]["primitives"]
        .as_array_mut()
        .unwrap()
        .push(lines);
    let imported = glb.load();
    assert_eq!(imported.mesh.indices.len(), 1);
    assert_eq!(
        imported.warnings,
        ["meshes[0].primitives[1] is made of lines, which are not drawn"]
    );
}

#[test]
fn vertex_colours_of_every_type_agree() {
    let expected = Vec4::new(1.0, 0.0, 51.0 / 255.0, 1.0);
    let wide: Vec<u8> = [65535u16, 0, 13107, 65535]
        .repeat(3)
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let float: Vec<u8> = [1.0f32, 0.0, 0.2]
        .repeat(3)
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let cases: [(Vec<u8>, u32, &str); 3] = [
        ([255u8, 0, 51].repeat(3), U8, "VEC3"),
        (wide, U16, "VEC4"),
        (float, F32, "VEC3"),
    ];
    for (bytes, component, kind) in cases {
        let mut glb = Glb::triangle(json!({}));
        let color = glb.accessor(&bytes, component, kind, 3);
        glb.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(color);
        for c in glb.load().mesh.colors {
            assert!((c - expected).length() < ROUNDING, "{component}: {c}");
        }
    }
}

#[test]
fn quantised_positions_are_read_normalised_or_plain() {
    for (normalized, expected) in [(false, 32767.0), (true, 1.0)] {
        let mut glb = Glb::new();
        let values = [0i16, 0, 0, 32767, 0, 0, 0, -32768, 0];
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let position = glb.accessor(&bytes, I16, "VEC3", 3);
        glb.json["accessors"][position]["normalized"] = json!(normalized);
        glb.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
        glb.mesh(json!({ "attributes": { "POSITION": position } }));
        glb.push("nodes", json!({ "mesh": 0 }));
        let mesh = glb.load().mesh;
        assert_eq!(mesh.positions[1].x, expected);
        assert_eq!(
            mesh.positions[2].y,
            if normalized { -1.0 } else { -32768.0 }
        );
    }
}

#[test]
fn sparse_accessors_replace_single_elements() {
    let mut glb = Glb::triangle(json!({}));
    let targets = glb.view(&[2]);
    let values: Vec<u8> = [9.0f32, 8.0, 7.0]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let values = glb.view(&values);
    glb.json["accessors"][0]["sparse"] = json!({
        "count": 1,
        "indices": { "bufferView": targets, "componentType": U8 },
        "values": { "bufferView": values },
    });
    let mesh = glb.load().mesh;
    assert_eq!(mesh.positions[1], Vec3::X);
    assert_eq!(mesh.positions[2], Vec3::new(9.0, 8.0, 7.0));
}

#[test]
fn the_default_scene_is_shown_and_the_others_are_not() {
    let mut glb = Glb::triangle(json!({}));
    glb.push(
        "nodes",
        json!({ "mesh": 0, "translation": [4.0, 0.0, 0.0] }),
    );
    glb.json["scenes"] = json!([{ "nodes": [0] }, { "nodes": [1] }]);
    assert_eq!(glb.load().mesh.positions[0].x, 0.0);
    glb.json["scene"] = json!(1);
    assert_eq!(glb.load().mesh.positions[0].x, 4.0);
}

#[test]
fn legal_files_with_little_in_them_are_read() {
    let mut glb = Glb::triangle(json!({}));
    // A scene needs no nodes, a channel that points elsewhere no node; extras are anything.
    glb.json["scenes"] = json!([{ "name": "empty" }, { "nodes": [0], "extras": 5 }]);
    glb.json["scene"] = json!(1);
    glb.json["extensionsRequired"] = json!(["KHR_animation_pointer"]);
    glb.json["animations"] = json!([{
        "samplers": [{ "input": 0, "output": 0 }],
        "channels": [{ "sampler": 0, "target": {
            "path": "pointer",
            "extensions": { "KHR_animation_pointer": { "pointer": "/materials/0/alphaCutoff" } },
        } }],
    }]);
    let imported = glb.load();
    assert_eq!(imported.mesh.indices, [[0, 1, 2]]);
    assert_eq!(
        imported.warnings,
        ["animations are ignored: the object stands still in its rest pose"]
    );
    // An error behind them is still the one that is reported.
    glb.json["samplers"] = json!([{ "wrapS": "wide" }]);
    assert_eq!(
        glb.try_load().unwrap_err().to_string(),
        "the glTF JSON cannot be read: invalid type: string \"wide\", expected any of: [33071, 33648, 10497]; export the file again"
    );
}

#[test]
fn chunks_of_unknown_kinds_are_passed_over() {
    let glb = Glb::triangle(json!({}));
    let mut whole = glb.bytes();
    whole.extend([4, 0, 0, 0, b'A', b'C', b'M', b'E', 1, 2, 3, 4]);
    let length = (whole.len() as u32).to_le_bytes();
    whole[8..12].copy_from_slice(&length);
    let load = |bytes: &[u8]| load_gltf_bytes(bytes, &NoFiles, &Limits::default());
    assert_eq!(load(&whole).unwrap().mesh.indices, [[0, 1, 2]]);

    // Directly behind the JSON, where only a binary chunk would be read.
    let mut alone = glb.clone();
    let payload = format!("data:application/octet-stream;base64,{}", "A".repeat(48));
    alone.json["buffers"] = json!([{ "uri": payload, "byteLength": 36 }]);
    let mut bytes = alone.bytes();
    let json_size = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    bytes[20 + json_size + 4..][..4].copy_from_slice(b"ACME");
    assert_eq!(load(&bytes).unwrap().mesh.positions, [Vec3::ZERO; 3]);
}

#[test]
fn node_transforms_keep_double_precision() {
    let mut glb = Glb::triangle(json!({}));
    // Single precision knows only multiples of 4 here.
    glb.json["nodes"] = json!([
        { "mesh": 0, "translation": [4e7 + 1.0, 0.0, 0.0] },
        { "mesh": 0, "translation": [4e7 + 2.5, 0.0, 0.0] },
    ]);
    let imported = glb.load();
    assert_eq!(imported.origin, DVec3::new(4e7 + 1.0, 0.0, 0.0));
    assert_eq!(imported.mesh.positions[3], Vec3::new(1.5, 0.0, 0.0));
}

#[test]
fn tangents_are_generated_along_u_and_split_where_maps_mirror() {
    let plain = normal_mapped_square(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    let mesh = plain.load().mesh;
    assert_eq!(mesh.positions.len(), 4);
    assert!(
        mesh.tangents
            .iter()
            .all(|t| *t == Vec4::new(1.0, 0.0, 0.0, 1.0))
    );
    // The second triangle (0, 2, 3) is read mirrored: u runs the other way there.
    let mirrored = normal_mapped_square(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 2.0, 0.0]);
    let mesh = mirrored.load().mesh;
    assert!(mesh.positions.len() > 4, "shared vertices got twins");
    let signs: Vec<[f32; 3]> = mesh
        .indices
        .iter()
        .map(|t| t.map(|i| mesh.tangents[i as usize].w))
        .collect();
    assert_eq!(signs, [[1.0; 3], [-1.0; 3]]);
}

#[test]
fn missing_normals_beside_present_ones_become_flat() {
    let mut glb = Glb::triangle(json!({}));
    let normal = glb.floats("VEC3", &[0.0, 1.0, 0.0].repeat(3));
    glb.mesh(json!({ "attributes": { "POSITION": 0, "NORMAL": normal } }));
    glb.push("nodes", json!({ "mesh": 1 }));
    let mesh = glb.load().mesh;
    assert_eq!(mesh.normals, [[Vec3::Z; 3], [Vec3::Y; 3]].concat());
}

#[test]
fn zero_and_nan_normals_are_repaired_with_a_warning() {
    let mut glb = Glb::triangle(json!({}));
    let normal = glb.floats("VEC3", &[0.0, 0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0, 2.0]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(normal);
    let imported = glb.load();
    assert_eq!(imported.mesh.normals, [Vec3::Z; 3]);
    assert_eq!(
        imported.warnings,
        [
            "meshes[0].primitives[0]: 2 normals were zero or not finite and are computed from the triangles"
        ]
    );
}

#[test]
fn skins_are_shown_in_their_rest_pose() {
    let mut glb = Glb::triangle(json!({}));
    let joints = glb.accessor(&[0u8; 12], U8, "VEC4", 3);
    let weights = glb.floats("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(3));
    merge(
        &mut glb.json["meshes"][0]["primitives"][0]["attributes"],
        json!({ "JOINTS_0": joints, "WEIGHTS_0": weights }),
    );
    glb.json["nodes"] = json!([
        // Where a skinned node stands does not matter.
        { "mesh": 0, "skin": 0, "translation": [100.0, 0.0, 0.0] },
        { "translation": [0.0, 0.0, 3.0] },
    ]);
    glb.push("skins", json!({ "joints": [1] }));
    assert_eq!(glb.load().mesh.positions[0], Vec3::new(0.0, 0.0, 3.0));
}

#[test]
fn a_skin_that_mirrors_keeps_fronts_and_flips_the_tangents_sign() {
    let mut glb = normal_mapped_square(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    let joints = glb.accessor(&[0u8; 16], U8, "VEC4", 4);
    let weights = glb.floats("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(4));
    let tangent = glb.floats("VEC4", &[1.0, 0.0, 0.0, 1.0].repeat(4));
    merge(
        &mut glb.json["meshes"][0]["primitives"][0]["attributes"],
        json!({ "JOINTS_0": joints, "WEIGHTS_0": weights, "TANGENT": tangent }),
    );
    glb.json["nodes"] = json!([{ "mesh": 0, "skin": 0 }, { "scale": [-1.0, 1.0, 1.0] }]);
    glb.push("skins", json!({ "joints": [1] }));
    let mesh = glb.load().mesh;
    assert_eq!(mesh.positions[1], Vec3::NEG_X);
    for t in 0..2 {
        assert_eq!(normal_of(&mesh, t), Vec3::Z);
    }
    assert_eq!(mesh.normals, [Vec3::Z; 4]);
    assert_eq!(mesh.tangents, [Vec4::new(-1.0, 0.0, 0.0, -1.0); 4]);
}

#[test]
fn tangents_of_an_anisotropic_surface_arrive_without_a_normal_map() {
    let mut glb = normal_mapped_square(&[0.0; 8]);
    let tangent = glb.floats("VEC4", &[0.0, 1.0, 0.0, -1.0].repeat(4));
    glb.json["meshes"][0]["primitives"][0]["attributes"]["TANGENT"] = json!(tangent);
    glb.json["materials"][0] = json!({});
    assert!(glb.load().mesh.tangents.is_empty());
    glb.json["materials"][0] = json!({ "extensions": {
        "KHR_materials_anisotropy": { "anisotropyStrength": 0.5 }
    } });
    assert_eq!(
        glb.load().mesh.tangents,
        [Vec4::new(0.0, 1.0, 0.0, -1.0); 4]
    );
    // Else the texture coordinates say where it points, though there is no texture.
    let attributes = &mut glb.json["meshes"][0]["primitives"][0]["attributes"];
    attributes.as_object_mut().unwrap().remove("TANGENT");
    assert_eq!(glb.load().mesh.uvs[0].len(), 4);
}

#[test]
fn morph_targets_are_added_by_their_default_weights() {
    let mut glb = Glb::triangle(json!({}));
    let delta = glb.floats("VEC3", &[0.0, 0.0, 2.0].repeat(3));
    glb.json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": delta }]);
    assert_eq!(glb.load().mesh.positions[0].z, 0.0);
    glb.json["meshes"][0]["weights"] = json!([0.5]);
    assert_eq!(glb.load().mesh.positions[0].z, 1.0);
    glb.json["nodes"][0]["weights"] = json!([0.25]);
    assert_eq!(glb.load().mesh.positions[0].z, 0.5);
}

#[test]
fn data_uris_and_percent_encoded_files_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let bytes: Vec<u8> = TRIANGLE.iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.path().join("a b.bin"), &bytes).unwrap();
    let mut glb = Glb::triangle(json!({}));
    glb.json["buffers"] = json!([{ "uri": "a%20b.bin", "byteLength": 36 }]);
    let path = folder.path().join("triangle.gltf");
    std::fs::write(&path, glb.json.to_string()).unwrap();
    let imported = load_object(&path).unwrap();
    assert_eq!(imported.mesh.positions[1], Vec3::X);
    assert_eq!(imported.dependencies, [folder.path().join("a b.bin")]);

    // Named as on Windows.
    std::fs::create_dir(folder.path().join("data")).unwrap();
    std::fs::rename(
        folder.path().join("a b.bin"),
        folder.path().join("data/b.bin"),
    )
    .unwrap();
    glb.json["buffers"] = json!([{ "uri": "data\\b.bin", "byteLength": 36 }]);
    std::fs::write(&path, glb.json.to_string()).unwrap();
    assert_eq!(load_object(&path).unwrap().mesh.positions[1], Vec3::X);

    // Three zero vectors, 36 bytes.
    let uri = format!("data:application/octet-stream;base64,{}", "A".repeat(48));
    glb.json["buffers"] = json!([{ "uri": uri, "byteLength": 36 }]);
    let text = glb.json.to_string();
    let imported = load_gltf_bytes(
        text.as_bytes(),
        &Folder::new(folder.path(), &Limits::default()),
        &Limits::default(),
    )
    .unwrap();
    assert_eq!(imported.mesh.positions, [Vec3::ZERO; 3]);

    // The same triangle, percent-encoded: its bytes are no UTF-8.
    let encoded: String = bytes.iter().map(|b| format!("%{b:02x}")).collect();
    let uri = format!("data:application/octet-stream,{encoded}");
    glb.json["buffers"] = json!([{ "uri": uri, "byteLength": 36 }]);
    let text = glb.json.to_string();
    let imported = load_gltf_bytes(text.as_bytes(), &NoFiles, &Limits::default()).unwrap();
    assert_eq!(imported.mesh.positions[1], Vec3::X);
}

#[test]
fn a_part_a_thousand_kilometres_out_keeps_its_micrometres() {
    let mut glb = Glb::new();
    let position = glb.floats("VEC3", &TRIANGLE.map(|v| v * 1e-6));
    glb.mesh(json!({ "attributes": { "POSITION": position } }));
    glb.push(
        "nodes",
        json!({ "mesh": 0, "translation": [1e6, 0.0, -1e6] }),
    );
    let imported = glb.load();
    assert_eq!(imported.origin, DVec3::new(1e6, 0.0, -1e6));
    let corner = imported.mesh.positions[1].as_dvec3() + imported.origin;
    // 1e6 + 1e-6 has twelve digits: a double rounds it by 1e-10.
    assert!((corner.x - (1e6 + 1e-6)).abs() < 1e-9);
    assert!((imported.mesh.scaled_normal(0).normalize() - DVec3::Z).length() < 1e-6);
}

#[test]
fn zero_area_and_duplicate_triangles_do_no_harm() {
    let mut glb = normal_mapped_square(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    // A duplicate, one that names a vertex twice, and one of three points on a line.
    let indices = glb.accessor(&[0, 1, 2, 0, 1, 2, 0, 0, 1, 0, 2, 3], U8, "SCALAR", 12);
    glb.json["meshes"][0]["primitives"][0]["indices"] = json!(indices);
    let mesh = glb.load().mesh;
    assert_eq!(mesh.indices, [[0, 1, 2], [0, 1, 2], [0, 2, 3]]);
    let line = glb.floats("VEC3", &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
    glb.mesh(json!({ "attributes": { "POSITION": line }, "material": 0 }));
    glb.push("nodes", json!({ "mesh": 1 }));
    let mesh = glb.load().mesh;
    assert_eq!(mesh.indices.len(), 4);
    assert!(mesh.normals.iter().all(|n| n.is_normalized()));
    assert!(mesh.tangents.iter().all(|t| t.is_finite()));
}
