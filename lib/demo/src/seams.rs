//! Gaps between sheets of metal, as narrow dark ribbons on the body's surface: finer than the
//! cells that the body is meshed with.
use dipir_scene::mesh::TriangleMesh;
use glam::Vec3;

use crate::mesher::{Field, normal};

/// Half the width of a gap, metres.
const HALF_WIDTH_M: f32 = 0.0032;
/// Height above the surface, metres: above the chords of its triangles.
const LIFT_M: f32 = 0.0022;
/// Distance between the points of a ribbon, metres.
const SPACING_M: f32 = 0.02;

/// A ribbon along the curve through `corners`, each seen from outside along `from` and moved onto
/// the surface of `field`.
pub fn ribbon(field: Field, corners: &[Vec3], from: Vec3) -> TriangleMesh {
    let mut points = Vec::new();
    for leg in 0..corners.len() - 1 {
        let length = corners[leg].distance(corners[leg + 1]);
        let count = (length / SPACING_M).ceil().max(1.0) as usize;
        for k in 0..count {
            let t = k as f32 / count as f32;
            points.extend(land(field, spline(corners, leg, t), from));
        }
    }
    points.extend(land(field, corners[corners.len() - 1], from));
    let mut mesh = TriangleMesh::default();
    let last = points.len().saturating_sub(1);
    for (i, &p) in points.iter().enumerate() {
        let along = (points[(i + 1).min(last)] - points[i.saturating_sub(1)]).normalize_or(Vec3::Y);
        let up = normal(field, p, 0.02);
        let side = up.cross(along).normalize_or(Vec3::X);
        let first = mesh.positions.len() as u32;
        for sign in [-1.0, 1.0] {
            mesh.positions
                .push(p + LIFT_M * up + sign * HALF_WIDTH_M * side);
            mesh.normals.push(up);
        }
        if i < last {
            mesh.indices
                .extend([[first, first + 2, first + 3], [first, first + 3, first + 1]]);
        }
    }
    for t in &mut mesh.indices {
        let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
        if (b - a).cross(c - a).dot(mesh.normals[t[0] as usize]) < 0.0 {
            t.swap(1, 2);
        }
    }
    mesh.materials = vec![0; mesh.indices.len()];
    mesh
}

/// Catmull and Rom's curve through the corners.
fn spline(corners: &[Vec3], leg: usize, t: f32) -> Vec3 {
    let at = |i: isize| corners[i.clamp(0, corners.len() as isize - 1) as usize];
    let i = leg as isize;
    let [a, b, c, d] = [at(i - 1), at(i), at(i + 1), at(i + 2)];
    0.5 * (2.0 * b
        + t * (c - a)
        + t * t * (2.0 * a - 5.0 * b + 4.0 * c - d)
        + t * t * t * (3.0 * b - a - 3.0 * c + d))
}

/// Where a point that comes in along `-from` first touches the solid.
fn land(field: Field, point: Vec3, from: Vec3) -> Option<Vec3> {
    const REACH_M: f32 = 1.5;
    let start = point - point.dot(from) * from + REACH_M * from;
    let mut travelled = 0.0;
    while travelled < 2.0 * REACH_M {
        let p = start - travelled * from;
        let d = field(p);
        if d < 1e-4 {
            return Some(p);
        }
        // Half steps: the fields are not exact distances.
        travelled += (0.5 * d).max(5e-5);
    }
    None
}
