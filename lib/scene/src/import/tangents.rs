//! Tangents for normal maps whose mesh brings none.
//!
//! As Mikkelsen's tangent space [Mikkelsen 2008, section 2.6] they follow the derivative of the
//! position along u, weighted by each corner's angle, and vertices at which mirrored texture
//! coordinates meet are split; unlike it, vertices are not welded first.
use std::collections::HashMap;

use glam::{DVec2, DVec3, Mat3, Vec2, Vec4};

use crate::mesh::TriangleMesh;

/// Fills `mesh.tangents` from texture coordinate set `uv_set` after `transform`, the way the normal
/// map is read. The mesh must have normals and that set. A vertex whose triangles all collapse in
/// texture space gets the zero tangent.
pub fn generate(mesh: &mut TriangleMesh, uv_set: usize, transform: &Mat3) {
    let orientation = split_mirrored(mesh, uv_set, transform);
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    let mut signs = vec![1.0f32; mesh.positions.len()];
    for (t, corners) in mesh.indices.iter().enumerate() {
        if orientation[t] == 0 {
            continue;
        }
        let p = corners.map(|i| mesh.positions[i as usize].as_dvec3());
        let [d1, d2] = uv_edges(mesh, t, uv_set, transform);
        // v points down and tangent space's y up: a positive area in (u, v) is a mirrored map.
        let direction = ((p[1] - p[0]) * d2.y - (p[2] - p[0]) * d1.y) * f64::from(orientation[t]);
        let direction = direction.normalize_or_zero();
        for k in 0..3 {
            let (a, b) = (p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]);
            let angle = a.cross(b).length().atan2(a.dot(b));
            let vertex = corners[k] as usize;
            sums[vertex] += direction * angle;
            signs[vertex] = -f32::from(orientation[t]);
        }
    }
    mesh.tangents = sums
        .iter()
        .zip(&mesh.normals)
        .zip(signs)
        .map(|((sum, normal), sign)| {
            let n = normal.as_dvec3();
            let tangent = (sum - n * n.dot(*sum)).normalize_or_zero().as_vec3();
            if tangent == glam::Vec3::ZERO {
                Vec4::ZERO
            } else {
                tangent.extend(sign)
            }
        })
        .collect();
}

/// Edges from a triangle's first corner in transformed texture space.
fn uv_edges(mesh: &TriangleMesh, triangle: usize, uv_set: usize, transform: &Mat3) -> [DVec2; 2] {
    let [a, b, c] = mesh.indices[triangle].map(|i| mesh.uvs[uv_set][i as usize]);
    [b - a, c - a].map(|d: Vec2| transform.transform_vector2(d).as_dvec2())
}

/// Sign of each triangle's area in texture space; a vertex that triangles of both signs share is
/// given a twin for the sign that comes later.
fn split_mirrored(mesh: &mut TriangleMesh, uv_set: usize, transform: &Mat3) -> Vec<i8> {
    let mut orientation = Vec::with_capacity(mesh.indices.len());
    let mut vertex_sign = vec![0i8; mesh.positions.len()];
    let mut twins: HashMap<u32, u32> = HashMap::new();
    for t in 0..mesh.indices.len() {
        let [d1, d2] = uv_edges(mesh, t, uv_set, transform);
        let area = d1.perp_dot(d2);
        let sign = (area > 0.0) as i8 - (area < 0.0) as i8;
        orientation.push(sign);
        if sign == 0 {
            continue;
        }
        for k in 0..3 {
            let vertex = mesh.indices[t][k];
            let known = &mut vertex_sign[vertex as usize];
            if *known == 0 {
                *known = sign;
            } else if *known != sign {
                mesh.indices[t][k] = *twins.entry(vertex).or_insert_with(|| {
                    mesh_twin(
                        &mut mesh.positions,
                        &mut mesh.normals,
                        &mut mesh.colors,
                        &mut mesh.uvs,
                        vertex,
                    )
                });
            }
        }
    }
    orientation
}

/// Copies a vertex and returns the copy's index.
fn mesh_twin(
    positions: &mut Vec<glam::Vec3>,
    normals: &mut Vec<glam::Vec3>,
    colors: &mut Vec<Vec4>,
    uvs: &mut [Vec<Vec2>; 2],
    vertex: u32,
) -> u32 {
    fn copy<T: Copy>(values: &mut Vec<T>, vertex: u32) {
        if let Some(&value) = values.get(vertex as usize) {
            values.push(value);
        }
    }
    let twin = positions.len() as u32;
    copy(positions, vertex);
    copy(normals, vertex);
    copy(colors, vertex);
    uvs.iter_mut().for_each(|uv| copy(uv, vertex));
    twin
}
