//! Cameras in a glTF or GLB, as Blender exports them.
//!
//! The world has +y up and a camera looks down its own -z, as here. Nodes form a tree; a camera
//! stands where its node does. Only the document is read, no buffers.
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use serde::Deserialize;

use crate::camera::{Camera, Lens, Pose};
use crate::error::CameraError;

const FORMAT: &str = "glTF";

#[derive(Deserialize)]
struct Document {
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    cameras: Vec<GltfCamera>,
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

/// Reads all perspective cameras, in the order of their nodes. Their images have the height of `size`. Their width
/// follows from the camera's aspect ratio; without one it is that of `size`. Their names are those of the cameras, else of
/// their nodes.
///
/// # Errors
/// On a document that is damaged or without perspective cameras, and on nodes that are sheared.
pub fn read(bytes: &[u8], size: [f64; 2]) -> Result<Vec<(String, Camera)>, CameraError> {
    let document: Document = serde_json::from_slice(json(bytes)?)
        .map_err(|e| CameraError::new(FORMAT, e.to_string()))?;
    let mut parents = vec![None; document.nodes.len()];
    for (i, node) in document.nodes.iter().enumerate() {
        for &child in &node.children {
            let slot = parents.get_mut(child);
            *slot.ok_or_else(|| CameraError::new(FORMAT, "a node's child is missing"))? = Some(i);
        }
    }
    let mut cameras = Vec::new();
    for (i, node) in document.nodes.iter().enumerate() {
        let Some(camera) = node.camera else { continue };
        let camera = document.cameras.get(camera);
        let camera =
            camera.ok_or_else(|| CameraError::new(FORMAT, "a node's camera is missing"))?;
        let Some(perspective) = &camera.perspective else {
            continue;
        };
        let name = match camera.name.is_empty() {
            true => &node.name,
            false => &camera.name,
        };
        let pose = pose(&document.nodes, &parents, i)?;
        let lens = lens(perspective, size)?;
        cameras.push((name.clone(), Camera { pose, lens }));
    }
    match cameras.is_empty() {
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

/// Where node `i` stands.
fn pose(nodes: &[Node], parents: &[Option<usize>], i: usize) -> Result<Pose, CameraError> {
    let mut matrix = DMat4::IDENTITY;
    let mut at = Some(i);
    // A path without a cycle visits no node twice.
    for _ in 0..nodes.len() {
        let Some(i) = at else { break };
        matrix = nodes[i].matrix() * matrix;
        at = parents[i];
    }
    if at.is_some() {
        return Err(CameraError::new(FORMAT, "its nodes form a cycle"));
    }
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
