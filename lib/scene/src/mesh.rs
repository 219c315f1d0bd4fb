//! Indexed triangles with their vertex attributes.
use glam::{Vec2, Vec3, Vec4};

/// Triangles in world space. Every attribute is either empty or has one entry a vertex.
#[derive(Clone, Debug, Default)]
pub struct TriangleMesh {
    /// Vertex positions, metres.
    pub positions: Vec<Vec3>,
    /// Three vertex indices a triangle, counter-clockwise seen from the front.
    pub indices: Vec<[u32; 3]>,
    /// Unit shading normals; empty means flat shading.
    pub normals: Vec<Vec3>,
    /// Unit tangents with the bitangent's sign in `w`; a zero tangent means "none here".
    pub tangents: Vec<Vec4>,
    /// The two texture coordinate sets, glTF convention (v down).
    pub uvs: [Vec<Vec2>; 2],
    /// Linear RGBA vertex colours that multiply the base colour.
    pub colors: Vec<Vec4>,
    /// Index of each triangle's material.
    pub materials: Vec<u32>,
}
