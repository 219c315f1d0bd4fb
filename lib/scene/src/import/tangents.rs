//! Tangents for normal maps whose mesh brings none.
//!
//! As Mikkelsen's tangent space [Mikkelsen 2008, section 2.6] they follow the derivative of the
//! position along u, weighted by each corner's angle, and vertices at which mirrored texture
//! coordinates meet are split; unlike it, vertices are not welded first.
use std::collections::HashMap;

use glam::{DVec2, DVec3, Mat3, Vec2, Vec4};

use crate::mesh::TriangleMesh;

/// Fills `mesh.tangents` from texture coordinate set `uv_set` after the transform that `map` gives for a triangle's
/// material, the way its normal map is read; triangles without one are passed over. The mesh must have normals, that
/// set and materials. A vertex whose triangles all collapse in texture space gets the zero tangent.
pub fn generate(mesh: &mut TriangleMesh, uv_set: usize, map: &dyn Fn(u32) -> Option<Mat3>) {
    let turns = split_turned(mesh, uv_set, map);
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    let mut signs = vec![1.0f32; mesh.positions.len()];
    for (t, corners) in mesh.indices.iter().enumerate() {
        let (Some(turn), Some(transform)) = (turns[t], map(mesh.materials[t])) else {
            continue;
        };
        // v points down and tangent space's y up: a positive area in (u, v) is a mirrored map.
        let orientation = if turn.is_mirrored { 1.0 } else { -1.0 };
        let p = corners.map(|i| mesh.positions[i as usize].as_dvec3());
        let [d1, d2] = uv_edges(mesh, t, uv_set, &transform);
        let direction = ((p[1] - p[0]) * d2.y - (p[2] - p[0]) * d1.y) * orientation;
        let direction = direction.normalize_or_zero();
        for k in 0..3 {
            let (a, b) = (p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]);
            let angle = a.cross(b).length().atan2(a.dot(b));
            let vertex = corners[k] as usize;
            sums[vertex] += direction * angle;
            signs[vertex] = -orientation as f32;
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

/// How a normal map lies on a triangle. Triangles that differ in it share no tangent.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Turn {
    /// Whether the area in texture space is positive.
    is_mirrored: bool,
    /// Whether the transform of the map reverses u: of two materials on one surface, one can.
    is_reversed: bool,
}

/// The turn of each triangle, `None` of those without a map or an area in texture space. A vertex that triangles of
/// several turns share is given a twin for each that comes later.
fn split_turned(
    mesh: &mut TriangleMesh,
    uv_set: usize,
    map: &dyn Fn(u32) -> Option<Mat3>,
) -> Vec<Option<Turn>> {
    let mut turns = Vec::with_capacity(mesh.indices.len());
    let mut first: Vec<Option<Turn>> = vec![None; mesh.positions.len()];
    let mut twins: HashMap<(u32, Turn), u32> = HashMap::new();
    for t in 0..mesh.indices.len() {
        let turn = map(mesh.materials[t]).and_then(|transform| {
            let [d1, d2] = uv_edges(mesh, t, uv_set, &transform);
            let area = d1.perp_dot(d2);
            (area.abs() > 0.0).then_some(Turn {
                is_mirrored: area > 0.0,
                is_reversed: transform.x_axis.x < 0.0,
            })
        });
        turns.push(turn);
        let Some(turn) = turn else {
            continue;
        };
        for k in 0..3 {
            let vertex = mesh.indices[t][k];
            if *first[vertex as usize].get_or_insert(turn) != turn {
                mesh.indices[t][k] = *twins.entry((vertex, turn)).or_insert_with(|| {
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
    turns
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
