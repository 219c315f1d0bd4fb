//! Writes the car as a binary glTF file.
use dipir_scene::mesh::TriangleMesh;
use serde_json::{Value, json};

use crate::car::{CarMaterial, Part, wheel_places};

const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;

#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffer {
    fn view(&mut self, bytes: &[u8], target: u32) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({
            "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len(),
            "target": target,
        }));
        self.bytes.extend_from_slice(bytes);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn primitive(&mut self, mesh: &TriangleMesh, material: usize) -> Value {
        let floats = |values: &[glam::Vec3]| -> Vec<u8> {
            values
                .iter()
                .flat_map(|v| v.to_array())
                .flat_map(f32::to_le_bytes)
                .collect()
        };
        let count = mesh.positions.len();
        let low = mesh.positions.iter().copied().reduce(|a, b| a.min(b));
        let high = mesh.positions.iter().copied().reduce(|a, b| a.max(b));
        let view = self.view(&floats(&mesh.positions), ARRAY_BUFFER);
        let position = self.accessor(json!({
            "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC3",
            "min": low, "max": high,
        }));
        let view = self.view(&floats(&mesh.normals), ARRAY_BUFFER);
        let normal = self.accessor(json!({
            "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC3",
        }));
        let indices = mesh.indices.iter().flatten();
        let short = count < usize::from(u16::MAX);
        let bytes: Vec<u8> = match short {
            true => indices.flat_map(|&i| (i as u16).to_le_bytes()).collect(),
            false => indices.flat_map(|&i| i.to_le_bytes()).collect(),
        };
        let view = self.view(&bytes, ELEMENT_ARRAY_BUFFER);
        let index = self.accessor(json!({
            "bufferView": view, "count": 3 * mesh.indices.len(), "type": "SCALAR",
            "componentType": if short { UNSIGNED_SHORT } else { UNSIGNED_INT },
        }));
        json!({
            "attributes": {"POSITION": position, "NORMAL": normal},
            "indices": index, "material": material,
        })
    }

    fn mesh(&mut self, name: &str, parts: &[&Part]) -> Value {
        let primitives: Vec<Value> = parts
            .iter()
            .map(|part| {
                let material = CarMaterial::ALL.iter().position(|m| *m == part.material);
                self.primitive(&part.mesh, material.unwrap_or(0))
            })
            .collect();
        json!({"name": name, "primitives": primitives})
    }
}

/// The file: half a body used twice, once mirrored, and one wheel used four times.
pub fn encode(body: &[Part], wheel: &[Part], paint: [f32; 3]) -> Vec<u8> {
    let mut buffer = Buffer::default();
    let meshes = vec![
        buffer.mesh("body half", &body.iter().collect::<Vec<_>>()),
        buffer.mesh("wheel", &wheel.iter().collect::<Vec<_>>()),
    ];
    let mut nodes = vec![
        json!({"name": "car", "children": [1, 2, 3, 4, 5, 6]}),
        json!({"name": "left half", "mesh": 0}),
        json!({"name": "right half", "mesh": 0, "scale": [-1.0, 1.0, 1.0]}),
    ];
    for (place, turned) in wheel_places() {
        let mut node = json!({"name": "wheel", "mesh": 1, "translation": place});
        if turned {
            node["rotation"] = json!([0.0, 1.0, 0.0, 0.0]);
        }
        nodes.push(node);
    }
    let length = buffer.bytes.len().next_multiple_of(4);
    buffer.bytes.resize(length, 0);
    let document = json!({
        "asset": {"version": "2.0", "generator": "dipir demo"},
        "extensionsUsed": ["KHR_materials_clearcoat"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": CarMaterial::ALL.map(|m| material(m, paint)),
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": length}],
    });
    container(&document.to_string(), &buffer.bytes)
}

fn container(json: &str, binary: &[u8]) -> Vec<u8> {
    let mut text = json.as_bytes().to_vec();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut file = Vec::new();
    let mut word = |w: u32| file.extend_from_slice(&w.to_le_bytes());
    word(0x4654_6c67);
    word(2);
    word((12 + 8 + text.len() + 8 + binary.len()) as u32);
    word(text.len() as u32);
    word(0x4e4f_534a);
    file.extend_from_slice(&text);
    file.extend_from_slice(&(binary.len() as u32).to_le_bytes());
    file.extend_from_slice(&0x004e_4942u32.to_le_bytes());
    file.extend_from_slice(binary);
    file
}

fn material(material: CarMaterial, paint: [f32; 3]) -> Value {
    let plain = |name: &str, color: [f32; 3], metallic: f32, roughness: f32| {
        json!({
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [color[0], color[1], color[2], 1.0],
                "metallicFactor": metallic, "roughnessFactor": roughness,
            },
        })
    };
    let coated = |mut base: Value, roughness: f32| {
        base["extensions"] = json!({"KHR_materials_clearcoat": {
            "clearcoatFactor": 1.0, "clearcoatRoughnessFactor": roughness,
        }});
        base
    };
    match material {
        CarMaterial::Paint => coated(plain("paint", paint, 0.35, 0.38), 0.02),
        CarMaterial::Glass => plain("glass", [0.012, 0.014, 0.015], 0.0, 0.03),
        CarMaterial::Trim => plain("trim", [0.018, 0.018, 0.019], 0.0, 0.55),
        CarMaterial::Lamp => coated(plain("lamp", [0.75, 0.77, 0.80], 1.0, 0.28), 0.02),
        CarMaterial::TailLamp => coated(plain("tail lamp", [0.35, 0.006, 0.006], 0.0, 0.3), 0.02),
        CarMaterial::Plate => plain("plate", [0.75, 0.75, 0.72], 0.0, 0.4),
        CarMaterial::Tyre => plain("tyre", [0.020, 0.020, 0.021], 0.0, 0.75),
        CarMaterial::Rim => plain("rim", [0.66, 0.67, 0.69], 1.0, 0.26),
    }
}
