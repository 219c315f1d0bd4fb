//! Whether a mesh is one closed convex surface, which makes most rays needless.
use std::collections::HashMap;

use dipir_scene::mesh::TriangleMesh;
use glam::{DVec3, Vec3};

/// Meshes with more triangles are not examined: real ones are not convex, and the test's hash
/// tables would cost more than a few rays save.
const MAX_TRIANGLES: usize = 1 << 20;

/// How far, relative to the mesh's size, a vertex may lie in front of its neighbour's plane: the
/// rounding of vertices on a curved surface that was meant convex.
const TOLERANCE: f64 = 1e-6;

/// Whether `mesh` is one closed, connected, outward-facing convex surface. No ray that leaves such
/// a surface on the outer side meets it again.
///
/// Local conditions suffice: a closed connected surface of genus 0 that is convex at every edge
/// and winds once around every vertex bounds a convex body (van Heijenoort 1952). Vertices are
/// identified by position, so seams do not matter; a false "no" costs rays, never correctness.
pub fn is_convex(mesh: &TriangleMesh) -> bool {
    let n = mesh.indices.len();
    if !(4..=MAX_TRIANGLES).contains(&n) {
        return false;
    }
    let Some((triangles, points)) = weld(mesh) else {
        return false;
    };
    let Some(edges) = pair_edges(&triangles) else {
        return false;
    };
    // Euler's formula for the sphere; with the connectivity test below it means genus 0.
    if points.len() + n != edges.len() + 2 || !is_connected(&triangles, &edges) {
        return false;
    }
    let size = points
        .iter()
        .fold(DVec3::ZERO, |m, p| m.max((*p - points[0]).abs()));
    let tolerance = TOLERANCE * size.max_element();
    let edge_is_convex = |(&(a, b), &(left, right)): (&(u32, u32), &(u32, u32))| {
        let [p, q, r] = triangles[left as usize].map(|i| points[i as usize]);
        let normal = (q - p).cross(r - p).normalize_or_zero();
        let far = triangles[right as usize]
            .into_iter()
            .find(|&i| i != a && i != b);
        far.is_some_and(|i| {
            normal != DVec3::ZERO && normal.dot(points[i as usize] - p) <= tolerance
        })
    };
    edges.iter().all(edge_is_convex) && winds_once(&triangles, &points)
}

/// Triangles over distinct positions; `None` for indices out of range, positions that are not
/// finite, and triangles without area.
fn weld(mesh: &TriangleMesh) -> Option<(Vec<[u32; 3]>, Vec<DVec3>)> {
    let mut ids: HashMap<[u32; 3], u32> = HashMap::new();
    let mut points = Vec::new();
    let mut triangles = Vec::with_capacity(mesh.indices.len());
    for t in &mesh.indices {
        let mut welded = [0; 3];
        for (w, &i) in welded.iter_mut().zip(t) {
            let p = *mesh.positions.get(i as usize)?;
            if !p.is_finite() {
                return None;
            }
            // Adding 0 turns -0 into +0.
            *w = *ids
                .entry((p + Vec3::ZERO).to_array().map(f32::to_bits))
                .or_insert_with(|| {
                    points.push(p.as_dvec3());
                    points.len() as u32 - 1
                });
        }
        if welded[0] == welded[1] || welded[1] == welded[2] || welded[2] == welded[0] {
            return None;
        }
        triangles.push(welded);
    }
    Some((triangles, points))
}

/// The two triangles at every edge `(a, b)`, `a < b`: the one that runs from `a` to `b` first.
/// `None` unless every edge is run through exactly once in either direction.
fn pair_edges(triangles: &[[u32; 3]]) -> Option<HashMap<(u32, u32), (u32, u32)>> {
    const NONE: u32 = u32::MAX;
    let mut edges = HashMap::with_capacity(triangles.len() * 3 / 2);
    for (k, t) in triangles.iter().enumerate() {
        for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
            let sides = edges.entry((a.min(b), a.max(b))).or_insert((NONE, NONE));
            let side = if a < b { &mut sides.0 } else { &mut sides.1 };
            if *side != NONE {
                return None;
            }
            *side = k as u32;
        }
    }
    edges
        .values()
        .all(|&(l, r)| l != NONE && r != NONE)
        .then_some(edges)
}

fn is_connected(triangles: &[[u32; 3]], edges: &HashMap<(u32, u32), (u32, u32)>) -> bool {
    let mut parent: Vec<u32> = (0..triangles.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    let mut parts = triangles.len();
    for &(l, r) in edges.values() {
        let (a, b) = (root(&mut parent, l), root(&mut parent, r));
        if a != b {
            parent[a as usize] = b;
            parts -= 1;
        }
    }
    parts == 1
}

/// Whether the angles around every vertex add up to at most a full turn.
fn winds_once(triangles: &[[u32; 3]], points: &[DVec3]) -> bool {
    let mut turn = vec![0f64; points.len()];
    for t in triangles {
        for k in 0..3 {
            let [p, q, r] = [0, 1, 2].map(|d| points[t[(k + d) % 3] as usize]);
            turn[t[k] as usize] += (q - p).angle_between(r - p);
        }
    }
    turn.iter().all(|&a| a <= std::f64::consts::TAU + 1e-6)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes::{append, cuboid, icosphere, quad, torus_knot};

    #[test]
    fn spheres_and_boxes_are_convex() {
        assert!(is_convex(&icosphere(Vec3::new(3.0, -1.0, 7.0), 0.3, 4)));
        assert!(is_convex(&cuboid(-Vec3::ONE, Vec3::new(1.0, 20.0, 0.01))));
    }

    #[test]
    fn dents_holes_open_sheets_pairs_and_inside_out_shapes_are_not_convex() {
        let mut dented = icosphere(Vec3::ZERO, 1.0, 3);
        dented.positions[40] *= 0.9;
        assert!(!is_convex(&dented));
        assert!(!is_convex(&torus_knot(Vec3::ZERO, 1.0, 0.2, 64, 8)));
        assert!(!is_convex(&quad(Vec3::ZERO, Vec3::X, Vec3::Y)));
        let mut two = icosphere(Vec3::ZERO, 1.0, 1);
        append(&mut two, icosphere(Vec3::X * 3.0, 1.0, 1), 0);
        assert!(!is_convex(&two));
        let mut inside_out = icosphere(Vec3::ZERO, 1.0, 2);
        for t in &mut inside_out.indices {
            t.swap(1, 2);
        }
        assert!(!is_convex(&inside_out));
        let mut open = icosphere(Vec3::ZERO, 1.0, 2);
        open.indices.pop();
        assert!(!is_convex(&open));
        let mut broken = icosphere(Vec3::ZERO, 1.0, 0);
        broken.indices[0][0] = 99;
        assert!(!is_convex(&broken));
    }
}
