//! glTF files of cameras that move.
use serde_json::{Value, json};

/// A document with keys in a buffer.
#[derive(Default)]
pub struct Scene {
    pub nodes: Vec<Value>,
    buffer: Vec<u8>,
    accessors: Vec<Value>,
    views: Vec<Value>,
    samplers: Vec<Value>,
    channels: Vec<Value>,
}

impl Scene {
    /// Without animation.
    pub fn of(nodes: Vec<Value>) -> Self {
        Self {
            nodes,
            ..Self::default()
        }
    }

    /// An accessor of floats, each of `width` components.
    pub fn floats(&mut self, values: &[f32], width: usize) -> usize {
        let start = self.buffer.len();
        let bytes = values.iter().flat_map(|v| v.to_le_bytes());
        self.buffer.extend(bytes);
        self.views
            .push(json!({ "buffer": 0, "byteOffset": start, "byteLength": 4 * values.len() }));
        let kind = ["", "SCALAR", "", "VEC3", "VEC4"][width];
        self.accessors.push(
            json!({ "bufferView": self.views.len() - 1, "componentType": 5126,
            "count": values.len() / width, "type": kind }),
        );
        self.accessors.len() - 1
    }

    /// Keys of a target: `{ "node": 0, "path": "translation" }`.
    pub fn keys(&mut self, target: Value, times: &[f32], values: &[f32], course: &str) {
        let width = if target["path"] == "rotation" { 4 } else { 3 };
        let [input, output] = [(times, 1), (values, width)].map(|(v, width)| self.floats(v, width));
        self.channels
            .push(json!({ "sampler": self.samplers.len(), "target": target }));
        self.samplers
            .push(json!({ "input": input, "output": output, "interpolation": course }));
    }

    /// The document; `uri` is that of its buffer.
    pub fn document(&self, uri: Option<&str>) -> Value {
        let mut buffer = json!({ "byteLength": self.buffer.len() });
        if let Some(uri) = uri {
            buffer["uri"] = json!(uri);
        }
        json!({
            "asset": { "version": "2.0" }, "nodes": self.nodes, "buffers": [buffer],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.8, "znear": 0.1 } }],
            "accessors": self.accessors, "bufferViews": self.views,
            "animations": [{ "samplers": self.samplers, "channels": self.channels }],
        })
    }

    pub fn buffer(&self) -> &[u8] {
        &self.buffer
    }

    /// As a GLB.
    pub fn glb(&self) -> Vec<u8> {
        glb(&self.document(None), &self.buffer)
    }
}

/// A GLB of a document and its buffer.
pub fn glb(document: &Value, buffer: &[u8]) -> Vec<u8> {
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let word = |n: usize| (n as u32).to_le_bytes();
    let length = 28 + json.len() + buffer.len();
    let head = [*b"glTF", word(2), word(length), word(json.len()), *b"JSON"].concat();
    let between = [word(buffer.len()), *b"BIN\0"].concat();
    [head, json, between, buffer.to_vec()].concat()
}

/// A camera of one node, whose x is the number of the frame, with keys from frame `first` on at `rate` a second.
pub fn numbered(first: u32, count: u32, rate: f64) -> Scene {
    let node = json!({ "name": "Camera", "camera": 0, "translation": [-9, 0, 0] });
    let mut scene = Scene::of(vec![node]);
    let frames = first..first + count;
    let times: Vec<f32> = frames
        .clone()
        .map(|k| (f64::from(k) / rate) as f32)
        .collect();
    let values: Vec<f32> = frames.flat_map(|k| [k as f32, 0.0, 0.0]).collect();
    scene.keys(
        json!({ "node": 0, "path": "translation" }),
        &times,
        &values,
        "LINEAR",
    );
    scene
}
