//! Cameras in a glTF or GLB, as Blender exports them.
//!
//! The world has +y up and a camera looks down its own -z, as here. Nodes form a tree; a camera
//! stands where its node does. How animations move it is in [`crate::moving`].
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;

pub(crate) const FORMAT: &str = "glTF";
/// Most nodes that a camera hangs from: rigs have tens. It bounds the time that each camera takes.
const MOST_ABOVE: usize = 1000;

/// What of a document tells of cameras. Of buffers and what describes them only what a camera needs is looked at: a wrong
/// accessor of something else keeps no camera from being read.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Document {
    #[serde(default)]
    pub nodes: Vec<Node>,
    #[serde(default)]
    cameras: Vec<GltfCamera>,
    #[serde(default)]
    pub animations: Vec<Animation>,
    #[serde(default)]
    pub accessors: Vec<Value>,
    #[serde(default)]
    pub buffer_views: Vec<Value>,
    #[serde(default)]
    pub buffers: Vec<Value>,
}

#[derive(Deserialize)]
pub(crate) struct Node {
    #[serde(default)]
    pub name: String,
    camera: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct GltfCamera {
    #[serde(default)]
    name: String,
    perspective: Option<Perspective>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Perspective {
    yfov: f64,
    aspect_ratio: Option<f64>,
}

#[derive(Deserialize)]
pub(crate) struct Animation {
    #[serde(default)]
    pub channels: Vec<Channel>,
    #[serde(default)]
    pub samplers: Vec<Value>,
}

#[derive(Deserialize)]
pub(crate) struct Channel {
    #[serde(default)]
    pub sampler: Value,
    pub target: Target,
}

#[derive(Deserialize)]
pub(crate) struct Target {
    pub node: Option<usize>,
    #[serde(default)]
    pub path: String,
    #[serde(default)]
    pub extensions: Value,
}

/// A document, and the buffer that a GLB has behind it.
pub(crate) struct File<'a> {
    pub document: Document,
    pub binary: Option<&'a [u8]>,
    /// The node that each hangs from.
    parents: Vec<Option<usize>>,
}

/// A camera of the document.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Seat {
    /// Its node.
    pub node: usize,
    /// Which of the document's cameras.
    pub camera: usize,
    pub lens: Lens,
}

/// What a camera may be called by: its own name and its node's.
pub(crate) type Names = [Option<String>; 2];

/// A camera of the file by its names, or what is wrong with it.
pub(crate) type Found = (Names, Result<Seat, CameraError>);

/// Reads all perspective cameras at rest, in the order of their nodes. Their images have the height of `size`. Their width
/// follows from the camera's aspect ratio; without one it is that of `size`. Their names are those of the cameras, else of
/// their nodes. Animations are not read.
///
/// # Errors
/// On a document that is damaged or without perspective cameras, and on nodes that are sheared.
pub fn read(bytes: &[u8], size: [f64; 2]) -> Result<Vec<(String, Camera)>, CameraError> {
    let file = File::parse(bytes)?;
    let first = |(names, seat): Found| {
        let (name, seat) = (names.into_iter().flatten().next(), seat?);
        let nodes = file.above(seat.node)?;
        let pose = pose(nodes.iter().map(|&i| file.document.nodes[i].matrix()))?;
        let lens = seat.lens;
        Ok((name.unwrap_or_default(), Camera { pose, lens }))
    };
    file.cameras(size)?.into_iter().map(first).collect()
}

impl<'a> File<'a> {
    pub fn parse(bytes: &'a [u8]) -> Result<Self, CameraError> {
        let (json, binary) = chunks(bytes)?;
        let document: Document =
            serde_json::from_slice(json).map_err(|e| CameraError::new(FORMAT, e.to_string()))?;
        let mut parents = vec![None; document.nodes.len()];
        for (i, node) in document.nodes.iter().enumerate() {
            for &child in &node.children {
                let slot = parents.get_mut(child);
                *slot.ok_or_else(|| CameraError::new(FORMAT, "a node's child is missing"))? =
                    Some(i);
            }
        }
        Ok(Self {
            document,
            binary,
            parents,
        })
    }

    /// All perspective cameras with all names, and what is wrong with each, for images as [`read`] has them.
    pub fn cameras(&self, size: [f64; 2]) -> Result<Vec<Found>, CameraError> {
        let document = &self.document;
        let mut cameras = Vec::new();
        for (i, node) in document.nodes.iter().enumerate() {
            let Some(index) = node.camera else { continue };
            let camera = document.cameras.get(index);
            let camera =
                camera.ok_or_else(|| CameraError::new(FORMAT, "a node's camera is missing"))?;
            let Some(perspective) = &camera.perspective else {
                continue;
            };
            self.above(i)?;
            let names = [&camera.name, &node.name].map(|n| (!n.is_empty()).then(|| n.clone()));
            let seat = lens(perspective, size).map(|lens| Seat {
                node: i,
                camera: index,
                lens,
            });
            cameras.push((names, seat));
        }
        let is_flat = |camera: &GltfCamera| camera.perspective.is_none();
        match cameras.is_empty() {
            true if document.cameras.iter().any(is_flat) => Err(CameraError::with_remedy(
                FORMAT,
                "its cameras are orthographic, and photographs are taken with perspective ones",
                "make the camera perspective (in Blender: Camera, Lens, Type), and export it again",
            )),
            true => Err(CameraError::with_remedy(
                FORMAT,
                "it has no perspective camera",
                "export it with cameras (in Blender: Data, Scene, Cameras)",
            )),
            false => Ok(cameras),
        }
    }

    /// Node `i` and those above it, from below.
    pub fn above(&self, i: usize) -> Result<Vec<usize>, CameraError> {
        let parents = &self.parents;
        let nodes = std::iter::successors(Some(i), |&i| parents[i]);
        // A path without a cycle visits no node twice.
        let most = parents.len().min(MOST_ABOVE + 1);
        let nodes: Vec<usize> = nodes.take(most + 1).collect();
        match nodes.len() {
            n if n <= most => Ok(nodes),
            n if n > parents.len() => Err(CameraError::new(FORMAT, "its nodes form a cycle")),
            _ => Err(CameraError::new(
                FORMAT,
                format!("a camera hangs from more than {MOST_ABOVE} nodes"),
            )),
        }
    }
}

/// The document, the first chunk of a GLB or everything, and the buffer behind it.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), CameraError> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let cut = || CameraError::new(FORMAT, "it is cut short");
    let word = |at: usize| bytes.get(at..).and_then(|b| b.first_chunk());
    let length = u32::from_le_bytes(*word(12).ok_or_else(cut)?) as usize;
    if word(16) != Some(b"JSON") {
        return Err(CameraError::new(FORMAT, "its first chunk is not JSON"));
    }
    let json = bytes.get(20..).and_then(|b| b.get(..length));
    let rest = bytes.get(20 + length..).unwrap_or_default();
    let is_binary = rest.get(4..8) == Some(b"BIN\0");
    // What is missing at its end is noticed where it is needed.
    let binary = rest.first_chunk().filter(|_| is_binary).map(|length| {
        let length = u32::from_le_bytes(*length) as usize;
        &rest[8..rest.len().min(8 + length)]
    });
    Ok((json.ok_or_else(cut)?, binary))
}

fn lens(perspective: &Perspective, size: [f64; 2]) -> Result<Lens, CameraError> {
    let angle = perspective.yfov;
    if !(angle > 0.0 && angle < std::f64::consts::PI) {
        let detail = format!("the vertical field of view of a camera is {angle} radians");
        return Err(CameraError::new(FORMAT, detail));
    }
    let focal = 0.5 * size[1] / (0.5 * angle).tan();
    let width = perspective.aspect_ratio.map_or(size[0], |a| a * size[1]);
    let lens = Lens::pinhole([width, size[1]], DVec2::splat(focal));
    lens.check(FORMAT)?;
    Ok(lens)
}

/// Where the first of nodes with these matrices stands, each of which hangs from the next.
pub(crate) fn pose(path: impl Iterator<Item = DMat4>) -> Result<Pose, CameraError> {
    let matrix = path.fold(DMat4::IDENTITY, |below, own| own * below);
    let axes = DMat3::from_mat4(matrix);
    // Only where a camera looks matters, not how its node is scaled.
    let unit = |v: DVec3| v.try_normalize();
    let axes = (unit(axes.x_axis), unit(axes.y_axis), unit(axes.z_axis));
    let position = matrix.w_axis.truncate();
    let pose = match axes {
        (Some(x), Some(y), Some(z)) => Pose::from_axes(DMat3::from_cols(x, y, z), position),
        _ => None,
    };
    pose.ok_or_else(|| {
        CameraError::new(
            FORMAT,
            "the node of a camera is sheared, mirrored or scaled to nothing",
        )
    })
}

impl Node {
    pub fn matrix(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let (scale, rotation, translation) = self.parts();
        DMat4::from_scale_rotation_translation(scale, rotation, translation)
    }

    /// Its scale, rotation and translation.
    pub fn parts(&self) -> (DVec3, DQuat, DVec3) {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix).to_scale_rotation_translation();
        }
        let rotation = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        let length = rotation.length();
        let rotation = match length > 0.0 {
            true => rotation / length,
            false => DQuat::IDENTITY,
        };
        (
            self.scale.map_or(DVec3::ONE, DVec3::from_array),
            rotation,
            self.translation.map_or(DVec3::ZERO, DVec3::from_array),
        )
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Each of the 100,000 cameras of the chain hangs from all before it: without a limit, 5e9 products of matrices.
    #[test]
    fn a_chain_of_nodes_that_no_rig_has_is_refused_before_it_takes_long() {
        let chain = |nodes: usize, last: usize| {
            let node =
                |i: usize| json!({ "camera": 0, "children": [if i == last { 0 } else { i + 1 }] });
            let mut nodes: Vec<Value> = (0..nodes).map(node).collect();
            if last >= nodes.len()
                && let Some(node) = nodes.last_mut()
            {
                *node = json!({ "camera": 0 });
            }
            let cameras = json!([{ "perspective": { "yfov": 1.0 } }]);
            let document = json!({ "nodes": nodes, "cameras": cameras }).to_string();
            read(document.as_bytes(), [600.0, 400.0]).map(|cameras| cameras.len())
        };
        let own = MOST_ABOVE + 1;
        assert_eq!(chain(own, own).unwrap(), own);
        for (nodes, last, said) in [
            (own + 1, own + 1, "a camera hangs from more than 1000 nodes"),
            (100_000, 100_000, "a camera hangs from more than 1000 nodes"),
            (3, 2, "its nodes form a cycle"),
        ] {
            let error = chain(nodes, last).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
