//! Any bytes end in an object or in an error, never in a panic or in unbounded memory.
use std::path::Path;

use dipir_scene::import::{
    Imported, Limits, NoFiles, Resolver, load_gltf_bytes, load_obj_bytes, load_ply_bytes,
    load_stl_bytes,
};
use dipir_scene::texture::decode_textures;
use proptest::prelude::*;
use serde_json::{Value, json};

use crate::glb::{Glb, U8, one_texel_png};

const SMALL: Limits = Limits {
    triangles: 1 << 16,
    instances: 1 << 10,
    texture_pixels: 1 << 20,
    all_texture_pixels: 1 << 20,
    file_bytes: 1 << 30,
    photo_megapixels: 200,
    allow_outside: false,
};

/// A file that uses much of the format.
fn rich() -> Glb {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    let normal = glb.floats("VEC3", &[0.0, 0.0, 1.0].repeat(3));
    let uv = glb.floats("VEC2", &[0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
    let color = glb.accessor(&[255; 12], U8, "VEC4", 3);
    let indices = glb.accessor(&[0, 1, 2], U8, "SCALAR", 3);
    let weights = glb.floats("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(3));
    let joints = glb.accessor(&[0; 12], U8, "VEC4", 3);
    let delta = glb.floats("VEC3", &[0.1; 9]);
    let bind = glb.floats(
        "MAT4",
        &[
            1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
        ],
    );
    let targets = glb.view(&[1]);
    let values = glb.view(&[0; 12]);
    let image = glb.view(&one_texel_png([0.5; 3]));
    glb.json["accessors"][0]["sparse"] = json!({
        "count": 1,
        "indices": { "bufferView": targets, "componentType": U8 },
        "values": { "bufferView": values },
    });
    glb.json["meshes"][0] = json!({
        "weights": [0.5],
        "primitives": [{
            "attributes": {
                "POSITION": 0, "NORMAL": normal, "TEXCOORD_0": uv, "COLOR_0": color,
                "JOINTS_0": joints, "WEIGHTS_0": weights,
            },
            "indices": indices, "material": 0, "mode": 4,
            "targets": [{ "POSITION": delta, "NORMAL": delta }],
        }],
    });
    glb.json["nodes"] = json!([
        { "children": [1, 2], "scale": [1.0, -1.0, 1.0] },
        { "mesh": 0, "skin": 0 },
        {
            "mesh": 0, "translation": [1.0, 2.0, 3.0], "rotation": [0.0, 0.0, 0.0, 1.0],
            "extensions": { "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": normal } } },
        },
    ]);
    glb.json["scenes"] = json!([{ "nodes": [0] }]);
    glb.push(
        "skins",
        json!({ "joints": [1], "inverseBindMatrices": bind }),
    );
    glb.push("images", json!({ "bufferView": image }));
    glb.push("samplers", json!({ "wrapS": 33071 }));
    glb.push("textures", json!({ "source": 0, "sampler": 0 }));
    glb.push(
        "materials",
        json!({
            "normalTexture": { "index": 0, "scale": 2.0, "extensions": {
                "KHR_texture_transform": { "offset": [0.1, 0.2], "rotation": 1.0, "scale": [2.0, 3.0] }
            } },
            "alphaMode": "MASK", "alphaCutoff": 0.5,
            "extensions": { "KHR_materials_clearcoat": {
                "clearcoatFactor": 1.0, "clearcoatNormalTexture": { "index": 0 }
            } },
        }),
    );
    glb
}

/// Paths of all numbers and strings of a JSON value.
fn leaves(value: &Value, at: String, out: &mut Vec<String>) {
    match value {
        Value::Array(list) => {
            for (i, v) in list.iter().enumerate() {
                leaves(v, format!("{at}/{i}"), out);
            }
        }
        Value::Object(map) => {
            for (k, v) in map {
                leaves(v, format!("{at}/{k}"), out);
            }
        }
        _ => out.push(at),
    }
}

fn survives(bytes: &[u8]) {
    if let Ok(imported) = load_gltf_bytes(bytes, &NoFiles, &SMALL) {
        is_whole(&imported);
    }
}

/// Every index of an object refers to something, and every number is finite.
fn is_whole(imported: &Imported) {
    {
        let mesh = &imported.mesh;
        let vertices = mesh.positions.len();
        assert!(mesh.first_non_finite().is_none());
        assert!(
            mesh.indices
                .iter()
                .flatten()
                .all(|i| (*i as usize) < vertices)
        );
        assert_eq!(mesh.materials.len(), mesh.indices.len());
        let materials = imported.materials.len();
        assert!(mesh.materials.iter().all(|m| (*m as usize) < materials));
        for count in [
            mesh.normals.len(),
            mesh.tangents.len(),
            mesh.colors.len(),
            mesh.uvs[0].len(),
            mesh.uvs[1].len(),
        ] {
            assert!(count == 0 || count == vertices);
        }
        for texture in imported.materials.iter().flat_map(|m| m.texture_refs()) {
            assert!((texture.texture as usize) < imported.textures.len());
        }
    }
}

#[test]
fn the_rich_file_loads() {
    let imported = rich().load();
    // One skinned triangle and three copies.
    assert_eq!(imported.mesh.indices.len(), 4);
    survives(&rich().bytes());
}

/// Every file that an OBJ names is the OBJ itself.
struct Itself<'a>(&'a [u8]);

impl Resolver for Itself<'_> {
    fn read(&self, _uri: &str) -> std::io::Result<Vec<u8>> {
        Ok(self.0.to_vec())
    }
}

/// The valid files that fuzzing starts from.
fn seeds(kind: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
    let entries = std::fs::read_dir(folder.join(kind)).unwrap();
    entries
        .map(|e| std::fs::read(e.unwrap().path()).unwrap())
        .collect()
}

#[test]
fn the_seeds_of_the_fuzz_targets_load() {
    for bytes in seeds("gltf") {
        load_gltf_bytes(&bytes, &NoFiles, &SMALL).unwrap();
    }
    for kind in ["obj", "mtl"] {
        for bytes in seeds(kind) {
            load_obj_bytes(&object_of(kind, &bytes), &Itself(&bytes), &SMALL).unwrap();
        }
    }
    for bytes in seeds("ply") {
        load_ply_bytes(&bytes, &SMALL).unwrap();
    }
    for bytes in seeds("stl") {
        load_stl_bytes(&bytes, &SMALL).unwrap();
    }
}

/// The OBJ file whose libraries a seed stands for.
fn object_of(kind: &str, bytes: &[u8]) -> Vec<u8> {
    match kind {
        "mtl" => {
            b"mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n".to_vec()
        }
        _ => bytes.to_vec(),
    }
}

/// What the fuzz target of that name does.
fn drive(kind: &str, bytes: &[u8]) {
    let read = match kind {
        "gltf" => load_gltf_bytes(bytes, &NoFiles, &SMALL),
        "ply" => load_ply_bytes(bytes, &SMALL),
        "stl" => load_stl_bytes(bytes, &SMALL),
        _ => load_obj_bytes(&object_of(kind, bytes), &Itself(bytes), &SMALL),
    };
    if let Ok(imported) = read {
        is_whole(&imported);
        let _ = decode_textures(&imported.textures, |_| true);
    }
}

/// Changes bytes, and copies, swaps or removes runs of them.
fn mutated(seed: &[u8], changes: &[(u8, u16, u16, u8)]) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for &(how, from, to, value) in changes {
        if bytes.is_empty() {
            break;
        }
        let from = usize::from(from) % bytes.len();
        let to = usize::from(to) % bytes.len();
        let run = (usize::from(value) % 32).min(bytes.len() - from);
        match how % 5 {
            0 => bytes[from] = value,
            1 => bytes[from] ^= 1 << (value % 8),
            2 => {
                bytes.drain(from..from + run);
            }
            3 => {
                let copy = bytes[from..from + run].to_vec();
                bytes.splice(to..to, copy);
            }
            // Digits and signs, of which texts are made.
            _ => bytes[from] = b"0123456789-.e/\n "[usize::from(value) % 16],
        }
    }
    bytes
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_bytes_never_panic(
        mut bytes in proptest::collection::vec(any::<u8>(), 0..256),
        header in any::<bool>(),
    ) {
        if header && bytes.len() >= 20 {
            bytes[..8].copy_from_slice(b"glTF\x02\0\0\0");
            bytes[9..12].fill(0);
            bytes[16..20].copy_from_slice(b"JSON");
        }
        survives(&bytes);
    }

    #[test]
    fn damaged_files_never_panic(
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        keep in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let mut bytes = rich().bytes();
        for (at, value) in damage {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if cut {
            bytes.truncate(keep.index(bytes.len()));
        }
        survives(&bytes);
    }

    #[test]
    fn wrong_values_in_the_document_never_panic(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), 0usize..12), 1..4),
    ) {
        let mut glb = rich();
        let mut paths = Vec::new();
        leaves(&glb.json, String::new(), &mut paths);
        for (which, value) in changes {
            let values = [
                json!(0), json!(1), json!(2), json!(-1), json!(7), json!(5126), json!(u64::MAX),
                json!(1u64 << 33), json!(1e38), json!(0.5), json!("x"), json!(null),
            ];
            let path = &paths[which.index(paths.len())];
            if let Some(leaf) = glb.json.pointer_mut(path) {
                *leaf = values[value].clone();
            }
        }
        survives(&glb.bytes());
    }

    #[test]
    fn mutated_seeds_of_the_fuzz_targets_never_panic(
        which in any::<prop::sample::Index>(),
        changes in proptest::collection::vec(any::<(u8, u16, u16, u8)>(), 1..12),
    ) {
        for kind in ["gltf", "obj", "mtl", "ply", "stl"] {
            let mut all = seeds(kind);
            all.sort();
            drive(kind, &mutated(&all[which.index(all.len())], &changes));
        }
    }

    #[test]
    fn random_obj_lines_never_panic(
        lines in proptest::collection::vec(
            prop_oneof![
                Just("v 0 0 0".to_owned()),
                Just("v 1 2 3 0.5 0.5 0.5".to_owned()),
                Just("vn 0 0 1".to_owned()),
                Just("vt 0.5 0.5".to_owned()),
                "f( -?[0-9]{1,20}(/[0-9]{0,3}){0,3}){1,5}",
                "(v|vt|vn|f|usemtl|mtllib|l)[ -~]{0,20}",
                "[ -~]{0,10}\\\\",
            ],
            0..24,
        ),
    ) {
        let text = lines.join("\n");
        if let Ok(imported) = load_obj_bytes(text.as_bytes(), &NoFiles, &SMALL) {
            let vertices = imported.mesh.positions.len();
            prop_assert!(imported.mesh.indices.iter().flatten().all(|i| (*i as usize) < vertices));
            let materials = imported.materials.len();
            prop_assert!(imported.mesh.materials.iter().all(|m| (*m as usize) < materials));
        }
    }
}
