//! One clear message each: what is wrong, where, and what to do.
use dipir_scene::import::{Limits, NoFiles, load_gltf_bytes, load_obj_bytes, load_object};
use dipir_scene::texture::{Encoding, Filter, ImageSource, Texture};
use serde_json::json;

use crate::glb::{Glb, TRIANGLE, U8};

fn message(glb: &Glb) -> String {
    glb.try_load().unwrap_err().to_string()
}

fn message_of(bytes: &[u8]) -> String {
    load_gltf_bytes(bytes, &NoFiles, &Limits::default())
        .unwrap_err()
        .to_string()
}

#[test]
fn a_broken_glb_says_where_it_breaks() {
    let whole = Glb::triangle(json!({})).bytes();
    assert_eq!(
        message_of(b""),
        "the file is empty; export or copy the file again"
    );
    assert_eq!(
        message_of(&whole[..9]),
        "the GLB header has 12 bytes, the file only 9; export or copy the file again"
    );
    assert_eq!(
        message_of(&whole[..whole.len() - 20]),
        format!(
            "the GLB header announces {} bytes, the file has {}: it is cut short; export or copy the file again",
            whole.len(),
            whole.len() - 20
        )
    );
    let mut old = whole.clone();
    old[4] = 1;
    assert_eq!(
        message_of(&old),
        "the file is glTF 1.0, which is not read; convert it to glTF 2.0: gltf-pipeline -i OLD.gltf -o NEW.glb"
    );
    let mut short = whole.clone();
    short[8..12].copy_from_slice(&11u32.to_le_bytes());
    assert_eq!(
        message_of(&short),
        "the GLB file has no JSON chunk; export or copy the file again"
    );
    let mut long_chunk = whole.clone();
    long_chunk[14] = 1;
    let size = u32::from_le_bytes(long_chunk[12..16].try_into().unwrap());
    assert_eq!(
        message_of(&long_chunk),
        format!(
            "the GLB chunk at byte 12 announces {size} bytes, {} are left; export or copy the file again",
            whole.len() - 20
        )
    );
    assert_eq!(
        message_of(b"\x89PNG"),
        "neither a GLB header nor a JSON object stands at the start; use a .glb or .gltf file"
    );
    assert_eq!(
        message_of(b"{ \"nodes\": 3 }"),
        "the glTF JSON cannot be read: invalid type: integer `3`, expected a sequence at line 1 column 12; export the file again"
    );
}

#[test]
fn an_index_out_of_range_names_itself() {
    let mut glb = Glb::triangle(json!({}));
    let indices = glb.accessor(&[0, 1, 3], U8, "SCALAR", 3);
    glb.json["meshes"][0]["primitives"][0]["indices"] = json!(indices);
    assert_eq!(
        message(&glb),
        "meshes[0].primitives[0].indices, element 2, is 3, but the file has 3 vertices there; export the file again"
    );
    let mut glb = Glb::triangle(json!({}));
    glb.json["nodes"][0]["mesh"] = json!(4);
    assert_eq!(
        message(&glb),
        "nodes[0].mesh is 4, but the file has 1 meshes; export the file again"
    );
    let glb = Glb::triangle(json!({ "material": 2 }));
    assert_eq!(
        message(&glb),
        "meshes[0].primitives[0].material is 2, but the file has 0 materials; export the file again"
    );
}

#[test]
fn an_index_beyond_32_bits_does_not_pass_for_a_small_one() {
    for (path, key) in [("/nodes/0", "mesh"), ("/accessors/0", "bufferView")] {
        let mut glb = Glb::triangle(json!({}));
        glb.json.pointer_mut(path).unwrap()[key] = json!(1u64 << 32);
        let text = message(&glb);
        assert!(
            text.starts_with(
                "the glTF JSON cannot be read: 4294967296 is no index or code of 32 bits at line 1 column "
            ),
            "{text}"
        );
    }
    // What is not read may say anything.
    let mut glb = Glb::triangle(json!({}));
    glb.json["nodes"][0]["extras"] = json!({ "mesh": 1u64 << 32 });
    glb.json["extensions"] = json!({ "ACME_things": { "index": 1u64 << 40 } });
    assert!(glb.try_load().is_ok());
}

#[test]
fn unknown_codes_are_quoted() {
    let mut component = Glb::triangle(json!({}));
    component.json["accessors"][0]["componentType"] = json!(5124);
    let mut kind = Glb::triangle(json!({}));
    kind.json["accessors"][0]["type"] = json!("VEC7");
    let mode = Glb::triangle(json!({ "mode": 7 }));
    let mut alpha = Glb::triangle(json!({ "material": 0 }));
    alpha.push("materials", json!({ "alphaMode": "GLASS" }));
    for (glb, expected) in [
        (
            component,
            "accessors[0].componentType is 5124; accepted: 5120 to 5123, 5125, 5126; export the file again",
        ),
        (
            kind,
            "accessors[0].type is \"VEC7\"; accepted: SCALAR, VEC2, VEC3, VEC4, MAT4; export the file again",
        ),
        (
            mode,
            "meshes[0].primitives[0].mode is 7; accepted: 0 to 6; export the file again",
        ),
        (
            alpha,
            "materials[0].alphaMode is \"GLASS\"; accepted: OPAQUE, MASK, BLEND; export the file again",
        ),
    ] {
        assert_eq!(message(&glb), expected);
    }
}

#[test]
fn an_accessor_that_overruns_its_view_is_refused() {
    let mut glb = Glb::triangle(json!({}));
    glb.json["accessors"][0]["count"] = json!(4);
    assert_eq!(
        message(&glb),
        "accessors[0] reads 4 elements of 12 bytes every 12 bytes from byte 0, but bufferViews[0] has 36 bytes; export the file again"
    );
    let mut glb = Glb::triangle(json!({}));
    glb.json["bufferViews"][0]["byteLength"] = json!(u64::MAX);
    assert_eq!(
        message(&glb),
        "bufferViews[0] wants 18446744073709551615 bytes from byte 0, but buffers[0] has 36; export the file again"
    );
    let mut glb = Glb::triangle(json!({}));
    glb.json["accessors"][0]["count"] = json!(1u64 << 40);
    assert_eq!(
        message(&glb),
        "there are 366503875925 triangles: more than the limit of 20000000; simplify the object, or raise scene.limits.triangles"
    );
}

#[test]
fn lengths_without_bytes_behind_them_are_refused_before_memory_is_taken() {
    let huge = |kind: &str| json!({ "componentType": 5126, "type": kind, "count": 700_000_000 });
    let mut color = Glb::triangle(json!({}));
    let accessor = color.push("accessors", huge("VEC4"));
    color.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(accessor);
    assert_eq!(
        message(&color),
        "meshes[0].primitives[0].attributes.COLOR_0 has 700000000 elements, but there are 3 positions; export the file again"
    );
    let mut skin = Glb::triangle(json!({}));
    let accessor = skin.push("accessors", huge("MAT4"));
    skin.push(
        "skins",
        json!({ "joints": [0], "inverseBindMatrices": accessor }),
    );
    skin.json["nodes"][0]["skin"] = json!(0);
    assert_eq!(
        message(&skin),
        "skins[0].inverseBindMatrices refers to accessors[1], which has no bufferView; export the file again"
    );
}

#[test]
fn a_nan_position_names_its_vertex() {
    let mut glb = Glb::new();
    let mut corners = TRIANGLE;
    corners[4] = f32::NAN;
    let position = glb.floats("VEC3", &corners);
    glb.mesh(json!({ "attributes": { "POSITION": position } }));
    glb.push("nodes", json!({ "mesh": 0 }));
    assert_eq!(
        message(&glb),
        "meshes[0].primitives[0].attributes.POSITION, element 1 is (1, NaN, 0), which is not finite; repair the mesh and export it again"
    );
}

#[test]
fn required_extensions_that_cannot_be_ignored_are_refused_by_name() {
    for (extension, remedy) in [
        (
            "KHR_draco_mesh_compression",
            "convert the file: gltf-transform copy IN.glb OUT.glb",
        ),
        (
            "KHR_texture_basisu",
            "convert the textures to PNG: gltf-transform ktxdecompress IN.glb OUT.glb",
        ),
        (
            "EXT_texture_avif",
            "convert the textures to PNG: gltf-transform png IN.glb OUT.glb",
        ),
        ("MSFT_texture_dds", "export the textures as PNG or JPEG"),
        ("ACME_shapes", "export the object without it"),
        ("EXT_texture_transform", "export the object without it"),
        ("KHR_materials_variants", "export the object without it"),
        (
            "KHR_materials_diffuse_transmission",
            "export the object without it",
        ),
    ] {
        let mut glb = Glb::triangle(json!({}));
        glb.json["extensionsRequired"] = json!([extension]);
        assert_eq!(
            message(&glb),
            format!(
                "the file requires the glTF extension {extension}, which is not supported; {remedy}"
            )
        );
    }
    for harmless in [
        "KHR_materials_specular",
        "KHR_materials_volume",
        "KHR_materials_sheen",
    ] {
        let mut glb = Glb::triangle(json!({}));
        glb.json["extensionsRequired"] = json!([harmless]);
        assert!(glb.try_load().is_ok(), "{harmless}");
    }
}

#[test]
fn a_missing_texture_is_warned_of_and_the_factors_alone_are_used() {
    let folder = tempfile::tempdir().unwrap();
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push("images", json!({ "uri": "no%20paint.png" }));
    glb.push("textures", json!({ "source": 0 }));
    let texture = json!({ "index": 0 });
    glb.push(
        "materials",
        json!({
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 0.25, 0.125, 1.0], "baseColorTexture": texture,
            },
            "normalTexture": texture, "emissiveTexture": texture, "emissiveFactor": [1.0, 1.0, 1.0],
        }),
    );
    let path = folder.path().join("car.glb");
    std::fs::write(&path, glb.bytes()).unwrap();
    let imported = load_object(&path).unwrap();
    assert_eq!(
        imported.warnings,
        [
            "the texture images[0] \"no paint.png\" cannot be read (No such file or directory); the material's factors alone are used",
            "materials[0]: without emissiveTexture it does not emit light",
        ]
    );
    let material = &imported.materials[0];
    assert_eq!(material.base_color.to_array(), [0.5, 0.25, 0.125, 1.0]);
    assert!(material.base_color_texture.is_none() && material.normal_texture.is_none());
    assert_eq!(material.emissive.to_array(), [0.0; 3]);
    assert!(imported.textures.is_empty() && imported.dependencies.is_empty());
    let looked_for = ["no paint.png", "no%20paint.png"].map(|name| folder.path().join(name));
    assert_eq!(imported.missing, looked_for);
}

#[test]
fn a_png_of_zero_bytes_is_refused_when_it_is_decoded() {
    let texture = Texture {
        image: ImageSource::Bytes {
            name: "images[0] (paint)".into(),
            bytes: [].into(),
        },
        encoding: Encoding::Srgb,
        wrap: Default::default(),
        filter: Filter::Linear,
    };
    assert_eq!(
        texture.decode().unwrap_err().to_string(),
        "`images[0] (paint)` is empty (0 bytes); expected a PNG or JPEG image: export the file again"
    );
}

#[test]
fn a_damaged_texture_inside_a_model_is_told_with_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("car.glb");
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push(
        "images",
        json!({ "uri": "data:image/png;base64,iVBORw0KGgo=" }),
    );
    glb.push("images", json!({ "uri": "data:image/png;base64,AAAA" }));
    for image in 0..2 {
        glb.push("textures", json!({ "source": image }));
    }
    glb.push(
        "materials",
        json!({ "normalTexture": { "index": 0 }, "emissiveTexture": { "index": 1 }, "emissiveFactor": [1, 1, 1] }),
    );
    std::fs::write(&path, glb.bytes()).unwrap();
    let imported = load_object(&path).unwrap();
    assert_eq!(imported.textures.len(), 2);
    for texture in &imported.textures {
        let error = texture.decode().unwrap_err().to_string();
        assert!(error.contains("car.glb: images["), "{error}");
    }
}

#[test]
fn a_node_with_two_parents_or_a_cycle_is_refused() {
    let mut glb = Glb::triangle(json!({}));
    glb.json["scenes"] = json!([{ "nodes": [0] }]);
    glb.json["nodes"] = json!([{ "children": [1] }, { "children": [0], "mesh": 0 }]);
    assert_eq!(
        message(&glb),
        "nodes[0] is reached twice; a node has one parent; export the file again"
    );
}

#[test]
fn attributes_of_different_lengths_are_refused() {
    let mut glb = Glb::triangle(json!({}));
    let normal = glb.floats("VEC3", &[0.0, 0.0, 1.0]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(normal);
    assert_eq!(
        message(&glb),
        "meshes[0].primitives[0].attributes.NORMAL has 1 elements, but there are 3 positions; export the file again"
    );
}

#[test]
fn a_file_without_triangles_is_refused() {
    let mut glb = Glb::new();
    glb.push("nodes", json!({}));
    assert_eq!(
        message(&glb),
        "the file holds no triangles; check that the file's default scene contains a visible mesh"
    );
}

#[test]
fn a_kind_of_file_that_is_not_read_says_how_to_convert_it() {
    for (name, remedy) in [
        ("car.xyz", "use a .glb, .gltf, .obj, .ply or .stl file"),
        (
            "car.FBX",
            "convert it: FBX2glTF -b -i IN.fbx -o OUT.glb, or open it in Blender and export a .glb file",
        ),
        ("car.blend", "open it in Blender and export a .glb file"),
        ("car.usdz", "open it in Blender and export a .glb file"),
        ("car.3ds", "convert it: assimp export IN OUT.glb"),
        ("car.dae", "convert it: assimp export IN OUT.glb"),
        (
            "car.3mf",
            "export it as a .glb file from the program that made it",
        ),
    ] {
        assert_eq!(
            load_object(name.as_ref()).unwrap_err().to_string(),
            format!("\"{name}\" is not a kind of object that is read; {remedy}")
        );
    }
    assert_eq!(
        load_object("nowhere.glb".as_ref()).unwrap_err().to_string(),
        "cannot read the object \"nowhere.glb\": No such file or directory (os error 2)"
    );
}

#[test]
fn gltf_1_is_named_with_how_to_convert_it() {
    let expected = "the file is glTF 1.0, which is not read; convert it to glTF 2.0: gltf-pipeline -i OLD.gltf -o NEW.glb";
    let maps = r#"{ "meshes": { "a": { "primitives": [] } }, "nodes": {}"#;
    for text in [
        format!("{maps}, \"asset\": {{ \"version\": \"1.0\" }} }}"),
        format!("{maps}, \"asset\": {{ \"version\": 1.0 }} }}"),
        format!("{maps} }}"),
        r#"{ "asset": { "version": "1.0" } }"#.to_owned(),
    ] {
        assert_eq!(message_of(text.as_bytes()), expected, "{text}");
    }
}

#[test]
fn names_in_messages_cannot_command_a_terminal() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push(
        "images",
        json!({ "name": "\u{1b}[2J", "uri": "\u{1b}]0;x\u{7}.png" }),
    );
    glb.push("textures", json!({ "source": 0 }));
    glb.push("materials", json!({ "normalTexture": { "index": 0 } }));
    assert_eq!(
        glb.load().warnings,
        [
            "the texture images[0] (\\u{1b}[2J) \"\\u{1b}]0;x\\u{7}.png\" cannot be read (no other files are read here); the material's factors alone are used"
        ]
    );
    glb.json["buffers"] = json!([{ "uri": "\u{1b}]0;x\u{7}.bin", "byteLength": 36 }]);
    let error = message_of(glb.json.to_string().as_bytes());
    assert_eq!(
        error,
        "cannot read buffers[0] \"\\u{1b}]0;x\\u{7}.bin\": no other files are read here"
    );
    let obj = "usemtl \u{1b}[31m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    let imported = load_obj_bytes(obj.as_bytes(), &NoFiles, &Limits::default()).unwrap();
    assert_eq!(
        imported.warnings,
        ["material \"\\u{1b}[31m\" is not defined; grey is used"]
    );
    let mut used = Glb::triangle(json!({}));
    used.json["extensionsUsed"] = json!(["A\u{9b}1m"]);
    assert_eq!(
        used.load().warnings,
        ["the extension A\\u{9b}1m is not read"]
    );
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_at_once_wherever_a_file_is_named() {
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    let folder = tempfile::tempdir().unwrap();
    for name in ["pipe.glb", "pipe.bin", "pipe.png", "pipe.mtl"] {
        mknodat(
            CWD,
            folder.path().join(name),
            FileType::Fifo,
            Mode::RUSR | Mode::WUSR,
            0,
        )
        .unwrap();
    }
    let message = |name: &str| {
        let path = folder.path().join(name);
        load_object(&path).unwrap_err().to_string()
    };
    assert!(message("pipe.glb").ends_with("not a regular file"));
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    let mut buffer = Glb::triangle(json!({}));
    buffer.json["buffers"] = json!([{ "uri": "pipe.bin", "byteLength": 36 }]);
    write("buffer.gltf", &buffer.json.to_string());
    assert!(message("buffer.gltf").ends_with("not a regular file"));
    const FACE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n";
    write("paint.mtl", "newmtl a\nmap_Kd pipe.png\n");
    write("paint.obj", &format!("mtllib paint.mtl\n{FACE}"));
    assert!(message("paint.obj").ends_with("not a regular file"));
    // Without its materials an object is still shown.
    write("library.obj", &format!("mtllib pipe.mtl\n{FACE}"));
    let imported = load_object(&folder.path().join("library.obj")).unwrap();
    assert_eq!(
        imported.warnings[0],
        "material library \"pipe.mtl\" cannot be read (not a regular file); grey is used"
    );
}

#[test]
fn utf_16_text_is_told_with_how_to_save_it() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        let units = text.encode_utf16().flat_map(u16::to_le_bytes);
        let bytes: Vec<u8> = [0xff, 0xfe].into_iter().chain(units).collect();
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let expected =
        |what: &str, path: &str| format!("cannot read {what} \"{path}\": {}", dipir_files::UTF_16);
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    let stl = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\nendsolid\n";
    for (name, text) in [
        ("a.obj", obj),
        ("a.gltf", "{ \"asset\": { \"version\": \"2.0\" } }"),
        ("a.stl", stl),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n"),
    ] {
        let path = write(name, text);
        let message = load_object(&path).unwrap_err().to_string();
        assert_eq!(message, expected("the object", &path.display().to_string()));
    }
    write("m.mtl", "newmtl a\nKd 1 0 0\n");
    let path = folder.path().join("b.obj");
    std::fs::write(&path, format!("mtllib m.mtl\n{obj}")).unwrap();
    let message = load_object(&path).unwrap_err().to_string();
    let inner = expected("the material library", "m.mtl");
    assert_eq!(message, format!("\"{}\": {inner}", path.display()));
}
