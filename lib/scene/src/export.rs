//! Meshes as text that the importers read back.
use std::fmt::Write as _;

use crate::mesh::TriangleMesh;

/// The mesh as a Wavefront OBJ file whose materials are `m0`, `m1`, … of `library.mtl`; without texture
/// coordinates and colours.
pub fn to_obj(mesh: &TriangleMesh, library: &str) -> String {
    // Writing to a string cannot fail.
    let mut text = format!("mtllib {library}.mtl\n");
    for p in &mesh.positions {
        let _ = writeln!(text, "v {} {} {}", p.x, p.y, p.z);
    }
    for n in &mesh.normals {
        let _ = writeln!(text, "vn {} {} {}", n.x, n.y, n.z);
    }
    let mut current = None;
    for (t, triangle) in mesh.indices.iter().enumerate() {
        let material = mesh.materials.get(t).copied().unwrap_or(0);
        if current != Some(material) {
            let _ = writeln!(text, "usemtl m{material}");
            current = Some(material);
        }
        let [a, b, c] = triangle.map(|i| i + 1);
        let _ = match mesh.normals.is_empty() {
            true => writeln!(text, "f {a} {b} {c}"),
            false => writeln!(text, "f {a}//{a} {b}//{b} {c}//{c}"),
        };
    }
    text
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn corners_are_counted_from_one_and_materials_are_named_where_they_change() {
        let mesh = TriangleMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(0.1, 0.5, -2.0)],
            indices: vec![[0, 1, 2], [1, 3, 2], [0, 3, 1]],
            materials: vec![0, 0, 1],
            ..TriangleMesh::default()
        };
        let text = "mtllib toy.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.1 0.5 -2\n\
                    usemtl m0\nf 1 2 3\nf 2 4 3\nusemtl m1\nf 1 4 2\n";
        assert_eq!(to_obj(&mesh, "toy"), text);
        let smooth = TriangleMesh {
            normals: vec![Vec3::Z; 4],
            ..mesh
        };
        assert!(to_obj(&smooth, "toy").contains("vn 0 0 1\nusemtl m0\nf 1//1 2//2 3//3\n"));
    }
}
