//! Cameras in a glTF or GLB, as Blender exports them.
//!
//! The world has +y up and a camera looks down its own -z, as here. Nodes form a tree; a camera
//! stands where its node does. Only the document is read, no buffers, so that an animation is noticed and
//! not followed.
use std::collections::BTreeSet;

use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;

const FORMAT: &str = "glTF";
/// Most nodes that a camera hangs from: rigs have tens. It bounds the time that each camera takes.
const MOST_ABOVE: usize = 1000;

#[derive(Deserialize)]
struct Document {
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    cameras: Vec<GltfCamera>,
    #[serde(default)]
    animations: Vec<Animation>,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    name: String,
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
struct Animation {
    #[serde(default)]
    channels: Vec<Channel>,
}

#[derive(Deserialize)]
struct Channel {
    target: Target,
}

#[derive(Deserialize)]
struct Target {
    node: Option<usize>,
    #[serde(default)]
    path: String,
    #[serde(default)]
    extensions: Value,
}

/// What animations change, by index.
#[derive(Default)]
struct Animated {
    nodes: BTreeSet<usize>,
    cameras: BTreeSet<usize>,
}

impl Animated {
    fn of(animations: &[Animation]) -> Self {
        const MOVES: [&str; 4] = ["translation", "rotation", "scale", "matrix"];
        let mut all = Self::default();
        for Channel { target } in animations.iter().flat_map(|a| &a.channels) {
            // KHR_animation_pointer names a value of the document: /nodes/3/translation.
            let pointer = &target.extensions["KHR_animation_pointer"]["pointer"];
            let steps: Vec<&str> = pointer.as_str().unwrap_or_default().split('/').collect();
            let (node, camera): (Option<usize>, Option<usize>) = match steps[..] {
                ["", "nodes", node, path, ..] if MOVES.contains(&path) => (node.parse().ok(), None),
                ["", "cameras", camera, ..] => (None, camera.parse().ok()),
                _ if MOVES.contains(&target.path.as_str()) => (target.node, None),
                _ => (None, None),
            };
            all.nodes.extend(node);
            all.cameras.extend(camera);
        }
        all
    }
}

/// A camera at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct AtRest {
    /// As the document has it, whatever animations say.
    pub camera: Camera,
    /// Whether an animation moves it, or what it hangs from, or zooms.
    pub is_animated: bool,
}

/// What a camera may be called by: its own name and its node's.
pub(crate) type Names = [Option<String>; 2];

/// A camera of the file by its names, or what is wrong with it.
pub(crate) type Found = (Names, Result<AtRest, CameraError>);

/// Reads all perspective cameras, in the order of their nodes. Their images have the height of `size`. Their width
/// follows from the camera's aspect ratio; without one it is that of `size`. Their names are those of the cameras, else of
/// their nodes.
///
/// # Errors
/// On a document that is damaged or without perspective cameras, and on nodes that are sheared.
pub fn read(bytes: &[u8], size: [f64; 2]) -> Result<Vec<(String, Camera)>, CameraError> {
    let cameras = read_named(bytes, size)?.into_iter();
    let first = |(names, own): Found| {
        let name = names.into_iter().flatten().next();
        Ok((name.unwrap_or_default(), own?.camera))
    };
    cameras.map(first).collect()
}

/// As [`read`], with all names, which of them are animated, and what is wrong with each. Animations themselves are not
/// read.
pub(crate) fn read_named(bytes: &[u8], size: [f64; 2]) -> Result<Vec<Found>, CameraError> {
    let document: Document = serde_json::from_slice(json(bytes)?)
        .map_err(|e| CameraError::new(FORMAT, e.to_string()))?;
    let mut parents = vec![None; document.nodes.len()];
    for (i, node) in document.nodes.iter().enumerate() {
        for &child in &node.children {
            let slot = parents.get_mut(child);
            *slot.ok_or_else(|| CameraError::new(FORMAT, "a node's child is missing"))? = Some(i);
        }
    }
    let animated = Animated::of(&document.animations);
    let mut cameras = Vec::new();
    for (i, node) in document.nodes.iter().enumerate() {
        let Some(index) = node.camera else { continue };
        let camera = document.cameras.get(index);
        let camera =
            camera.ok_or_else(|| CameraError::new(FORMAT, "a node's camera is missing"))?;
        let Some(perspective) = &camera.perspective else {
            continue;
        };
        let names = [&camera.name, &node.name].map(|n| (!n.is_empty()).then(|| n.clone()));
        let nodes = above(&parents, i)?;
        let own = pose(&document.nodes, &nodes).and_then(|pose| {
            let lens = lens(perspective, size)?;
            Ok(AtRest {
                camera: Camera { pose, lens },
                is_animated: animated.cameras.contains(&index)
                    || nodes.iter().any(|node| animated.nodes.contains(node)),
            })
        });
        cameras.push((names, own));
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

/// The document: the first chunk of a GLB, else everything.
fn json(bytes: &[u8]) -> Result<&[u8], CameraError> {
    if !bytes.starts_with(b"glTF") {
        return Ok(bytes);
    }
    let cut = || CameraError::new(FORMAT, "it is cut short");
    let word = |at: usize| bytes.get(at..).and_then(|b| b.first_chunk());
    let length = u32::from_le_bytes(*word(12).ok_or_else(cut)?) as usize;
    if word(16) != Some(b"JSON") {
        return Err(CameraError::new(FORMAT, "its first chunk is not JSON"));
    }
    bytes
        .get(20..)
        .and_then(|b| b.get(..length))
        .ok_or_else(cut)
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

/// Node `i` and those above it, from below.
fn above(parents: &[Option<usize>], i: usize) -> Result<Vec<usize>, CameraError> {
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

/// Where the first of these nodes stands, each of which hangs from the next.
fn pose(nodes: &[Node], path: &[usize]) -> Result<Pose, CameraError> {
    let own = path.iter().map(|&i| nodes[i].matrix());
    let matrix = own.fold(DMat4::IDENTITY, |below, own| own * below);
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
    fn matrix(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let rotation = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        let length = rotation.length();
        let rotation = match length > 0.0 {
            true => rotation / length,
            false => DQuat::IDENTITY,
        };
        DMat4::from_scale_rotation_translation(
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

    /// Which of two cameras, that of a node below the first one and that of the third one, are animated.
    fn animated(target: Value) -> Vec<bool> {
        let channels = json!([{ "sampler": 0, "target": target }]);
        let document = json!({
            "nodes": [{ "children": [1] }, { "camera": 0 }, { "camera": 1 }, { "mesh": 0 }],
            "cameras": [{ "perspective": { "yfov": 1.0 } }, { "perspective": { "yfov": 1.0 } }],
            "animations": [{ "channels": channels, "samplers": [] }],
        });
        let cameras = read_named(document.to_string().as_bytes(), [600.0, 400.0]).unwrap();
        let own = cameras.into_iter().map(|(_, own)| own.unwrap().is_animated);
        own.collect()
    }

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

    #[test]
    fn a_camera_is_animated_if_it_moves_hangs_from_what_moves_or_zooms() {
        let pointer = |to: &str| {
            let extensions = json!({ "KHR_animation_pointer": { "pointer": to } });
            json!({ "path": "pointer", "extensions": extensions })
        };
        for (target, want) in [
            (json!({ "node": 0, "path": "rotation" }), [true, false]),
            (json!({ "node": 1, "path": "translation" }), [true, false]),
            (json!({ "node": 2, "path": "scale" }), [false, true]),
            (json!({ "node": 2, "path": "weights" }), [false, false]),
            (json!({ "node": 3, "path": "rotation" }), [false, false]),
            (pointer("/nodes/2/rotation"), [false, true]),
            (pointer("/nodes/2/weights"), [false, false]),
            (pointer("/cameras/0/perspective/yfov"), [true, false]),
            (pointer("/materials/0/alphaCutoff"), [false, false]),
        ] {
            assert_eq!(animated(target.clone()), want, "{target}");
        }
    }
}
