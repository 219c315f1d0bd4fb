//! Generated meshes: what tests, benches and demonstration scenes render.
use std::collections::HashMap;
use std::f32::consts::TAU;

use dipir_scene::mesh::TriangleMesh;
use glam::{Vec2, Vec3};

/// A sphere of `20 * 4^subdivisions` triangles whose vertices lie on the sphere, with its smooth
/// normals. Convex.
pub fn icosphere(center: Vec3, radius: f32, subdivisions: u32) -> TriangleMesh {
    let phi = (1.0 + 5f32.sqrt()) / 2.0;
    let mut directions: Vec<Vec3> = [
        (-1.0, phi, 0.0),
        (1.0, phi, 0.0),
        (-1.0, -phi, 0.0),
        (1.0, -phi, 0.0),
        (0.0, -1.0, phi),
        (0.0, 1.0, phi),
        (0.0, -1.0, -phi),
        (0.0, 1.0, -phi),
        (phi, 0.0, -1.0),
        (phi, 0.0, 1.0),
        (-phi, 0.0, -1.0),
        (-phi, 0.0, 1.0),
    ]
    .into_iter()
    .map(|(x, y, z)| Vec3::new(x, y, z).normalize())
    .collect();
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut midpoints = HashMap::new();
        let mut midpoint = |a: u32, b: u32| {
            *midpoints.entry((a.min(b), a.max(b))).or_insert_with(|| {
                directions.push((directions[a as usize] + directions[b as usize]).normalize());
                directions.len() as u32 - 1
            })
        };
        triangles = triangles
            .iter()
            .flat_map(|&[a, b, c]| {
                let (ab, bc, ca) = (midpoint(a, b), midpoint(b, c), midpoint(c, a));
                [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
            })
            .collect();
    }
    TriangleMesh {
        positions: directions.iter().map(|d| center + radius * d).collect(),
        materials: vec![0; triangles.len()],
        indices: triangles,
        normals: directions,
        ..TriangleMesh::default()
    }
}

/// An axis-aligned box from `min` to `max`, 12 triangles, flat shaded. Convex.
pub fn cuboid(min: Vec3, max: Vec3) -> TriangleMesh {
    let positions = (0..8)
        .map(|i| {
            Vec3::new(
                if i & 1 == 0 { min.x } else { max.x },
                if i & 2 == 0 { min.y } else { max.y },
                if i & 4 == 0 { min.z } else { max.z },
            )
        })
        .collect();
    let quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let indices: Vec<[u32; 3]> = quads
        .into_iter()
        .flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]])
        .collect();
    TriangleMesh {
        positions,
        materials: vec![0; indices.len()],
        indices,
        ..TriangleMesh::default()
    }
}

/// The parallelogram `corner + s edge_u + t edge_v`, two triangles facing
/// `edge_u x edge_v`, with texture coordinates `(s, t)`.
pub fn quad(corner: Vec3, edge_u: Vec3, edge_v: Vec3) -> TriangleMesh {
    TriangleMesh {
        positions: vec![
            corner,
            corner + edge_u,
            corner + edge_u + edge_v,
            corner + edge_v,
        ],
        indices: vec![[0, 1, 2], [0, 2, 3]],
        uvs: [vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y], Vec::new()],
        materials: vec![0; 2],
        ..TriangleMesh::default()
    }
}

/// A tube of radius `tube` around the (2, 3) torus knot of outer size about `3 scale`, centred on
/// `center`: `2 * along * around` triangles with smooth normals. Shadows and lights itself.
pub fn torus_knot(center: Vec3, scale: f32, tube: f32, along: u32, around: u32) -> TriangleMesh {
    let knot = |t: f32| {
        let r = 2.0 + (3.0 * t).cos();
        scale * 0.5 * Vec3::new(r * (2.0 * t).cos(), (3.0 * t).sin(), r * (2.0 * t).sin())
    };
    let mut mesh = TriangleMesh::default();
    for i in 0..along {
        let t = i as f32 / along as f32 * TAU;
        let tangent = (knot(t + 1e-3) - knot(t - 1e-3)).normalize();
        // The knot never runs along the line to its centre, so this frame cannot degenerate.
        let side = tangent.cross(knot(t)).normalize();
        let up = side.cross(tangent);
        for j in 0..around {
            let (s, c) = (j as f32 / around as f32 * TAU).sin_cos();
            let normal = c * side + s * up;
            mesh.positions.push(center + knot(t) + tube * normal);
            mesh.normals.push(normal);
            let (i1, j1) = ((i + 1) % along, (j + 1) % around);
            let at = |i: u32, j: u32| i * around + j;
            mesh.indices.push([at(i, j), at(i1, j), at(i1, j1)]);
            mesh.indices.push([at(i, j), at(i1, j1), at(i, j1)]);
        }
    }
    mesh.materials = vec![0; mesh.indices.len()];
    mesh
}

/// Puts the triangles of `other` behind those of `mesh`, all of them with `material`. Attributes
/// that only one of the two has are dropped.
pub fn append(mesh: &mut TriangleMesh, other: TriangleMesh, material: u32) {
    let first = mesh.positions.len() as u32;
    fn join<T>(mine: &mut Vec<T>, theirs: Vec<T>, first: u32) {
        match !mine.is_empty() && !theirs.is_empty() || first == 0 {
            true => mine.extend(theirs),
            false => mine.clear(),
        }
    }
    join(&mut mesh.normals, other.normals, first);
    join(&mut mesh.tangents, other.tangents, first);
    join(&mut mesh.colors, other.colors, first);
    for (mine, theirs) in mesh.uvs.iter_mut().zip(other.uvs) {
        join(mine, theirs, first);
    }
    mesh.positions.extend(other.positions);
    mesh.materials.extend(vec![material; other.indices.len()]);
    mesh.indices
        .extend(other.indices.into_iter().map(|t| t.map(|i| i + first)));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Signed volume by the divergence theorem; positive where triangles face outwards.
    fn volume(mesh: &TriangleMesh) -> f32 {
        mesh.indices
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn closed_shapes_face_outwards() {
        // Inscribed polyhedra: the icosphere's volume approaches 4/3 pi from below.
        let sphere = volume(&icosphere(Vec3::ONE, 1.0, 4));
        assert!((sphere - 4.18879).abs() < 0.02, "{sphere}");
        assert_eq!(volume(&cuboid(Vec3::ZERO, Vec3::new(1.0, 2.0, 3.0))), 6.0);
        assert!(volume(&torus_knot(Vec3::ZERO, 1.0, 0.3, 128, 16)) > 0.5);
    }

    #[test]
    fn attributes_that_only_one_mesh_has_are_dropped() {
        let plain = quad(Vec3::ZERO, Vec3::X, Vec3::Y);
        let mut full = plain.clone();
        full.normals = vec![Vec3::Z; 4];
        full.tangents = vec![Vec3::X.extend(1.0); 4];
        full.colors = vec![glam::Vec4::ONE; 4];
        full.uvs[1] = vec![Vec2::ONE; 4];
        for (mut first, second) in [(full.clone(), plain.clone()), (plain, full.clone())] {
            append(&mut first, second, 1);
            assert_eq!((first.positions.len(), first.uvs[0].len()), (8, 8));
            assert_eq!((first.normals.len(), first.tangents.len()), (0, 0));
            assert_eq!((first.colors.len(), first.uvs[1].len()), (0, 0));
            assert_eq!(first.materials, [0, 0, 1, 1]);
        }
        let mut both = full.clone();
        append(&mut both, full, 0);
        assert_eq!((both.normals.len(), both.tangents.len()), (8, 8));
        assert_eq!((both.colors.len(), both.uvs[1].len()), (8, 8));
    }
}
