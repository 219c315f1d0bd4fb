//! Writes small glTF files in memory.
use dipir_scene::Error;
use dipir_scene::import::{Imported, Limits, NoFiles, load_gltf_bytes};
use serde_json::{Value, json};

pub const U8: u32 = 5121;
pub const I16: u32 = 5122;
pub const U16: u32 = 5123;
pub const U32: u32 = 5125;
pub const F32: u32 = 5126;

/// The positions of a triangle in the plane z = 0 that faces +z.
pub const TRIANGLE: [f32; 9] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// A document under construction.
#[derive(Clone)]
pub struct Glb {
    pub json: Value,
    pub binary: Vec<u8>,
}

impl Glb {
    pub fn new() -> Self {
        Self {
            json: json!({ "asset": { "version": "2.0" } }),
            binary: Vec::new(),
        }
    }

    /// Appends `value` to a top-level array and returns its index.
    pub fn push(&mut self, list: &str, value: Value) -> usize {
        let root = self.json.as_object_mut().unwrap();
        let array = root.entry(list).or_insert_with(|| json!([]));
        let array = array.as_array_mut().unwrap();
        array.push(value);
        array.len() - 1
    }

    pub fn view(&mut self, bytes: &[u8]) -> usize {
        while !self.binary.len().is_multiple_of(4) {
            self.binary.push(0);
        }
        let offset = self.binary.len();
        self.binary.extend_from_slice(bytes);
        self.push(
            "bufferViews",
            json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() }),
        )
    }

    pub fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        self.push(
            "accessors",
            json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }),
        )
    }

    pub fn floats(&mut self, kind: &str, values: &[f32]) -> usize {
        let per_element = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.accessor(&bytes, F32, kind, values.len() / per_element)
    }

    /// A mesh of one primitive.
    pub fn mesh(&mut self, primitive: Value) -> usize {
        self.push("meshes", json!({ "primitives": [primitive] }))
    }

    /// One triangle with these extra primitive members, shown by a node without transform.
    pub fn triangle(extra: Value) -> Self {
        let mut glb = Self::new();
        let position = glb.floats("VEC3", &TRIANGLE);
        let mut primitive = json!({ "attributes": { "POSITION": position } });
        merge(&mut primitive, extra);
        let mesh = glb.mesh(primitive);
        glb.push("nodes", json!({ "mesh": mesh }));
        glb
    }

    pub fn bytes(&self) -> Vec<u8> {
        let mut document = self.json.clone();
        if document.get("buffers").is_none() {
            document["buffers"] = json!([{ "byteLength": self.binary.len() }]);
        }
        let mut text = serde_json::to_vec(&document).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut binary = self.binary.clone();
        binary.resize(binary.len().next_multiple_of(4), 0);
        let length = 12 + 8 + text.len() + 8 + binary.len();
        let mut out = b"glTF".to_vec();
        for word in [2, length as u32, text.len() as u32, 0x4E4F_534A] {
            out.extend(word.to_le_bytes());
        }
        out.extend(text);
        out.extend((binary.len() as u32).to_le_bytes());
        out.extend(0x004E_4942u32.to_le_bytes());
        out.extend(binary);
        out
    }

    pub fn try_load(&self) -> Result<Imported, Error> {
        load_gltf_bytes(&self.bytes(), &NoFiles, &Limits::default())
    }

    pub fn load(&self) -> Imported {
        self.try_load().unwrap()
    }
}

/// Recursively adds the members of `extra` to `target`.
pub fn merge(target: &mut Value, extra: Value) {
    match (target, extra) {
        (Value::Object(target), Value::Object(extra)) => {
            for (key, value) in extra {
                merge(target.entry(key).or_insert(Value::Null), value);
            }
        }
        (target, extra) => *target = extra,
    }
}

/// A PNG of one texel with these display values in `[0, 1]`.
pub fn one_texel_png(color: [f32; 3]) -> Vec<u8> {
    use dipir_imaging::raster::{DisplayImage, Raster};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("texel.png");
    let image = DisplayImage(Raster::filled(1, 1, glam::Vec3::from_array(color)));
    dipir_imaging::file::write_png(&path, &image).unwrap();
    std::fs::read(path).unwrap()
}
