//! Triangles from implicit surfaces, by surface nets: one vertex in every grid cell that the
//! surface passes through, drawn onto the surface, with the field's gradient as its normal.
use std::collections::HashMap;

use dipir_scene::mesh::TriangleMesh;
use glam::Vec3;
use rayon::prelude::*;

/// A solid: negative inside, positive outside, roughly a distance in metres near the surface.
pub type Field<'a> = &'a (dyn Fn(Vec3) -> f32 + Sync);

/// Which part of a solid is meshed.
#[derive(Clone, Copy, PartialEq)]
pub enum Side {
    /// All of it.
    Whole,
    /// The half with `x >= 0` of a solid that is symmetric about `x = 0`.
    PositiveX,
}

/// Meshes the solid inside the box from `low` to `high` with cells of `step` metres.
pub fn mesh(field: Field, low: Vec3, high: Vec3, step: f32, side: Side) -> TriangleMesh {
    // A column of cells is centred on x = 0, so that its vertices lie on the plane of symmetry.
    let low = match side {
        Side::Whole => low,
        Side::PositiveX => Vec3::new(-1.5 * step, low.y, low.z),
    };
    let cells = ((high - low) / step).ceil().as_usizevec3() + 1;
    let (nx, ny, nz) = (cells.x + 1, cells.y + 1, cells.z + 1);
    let corner =
        |i: usize, j: usize, k: usize| low + step * Vec3::new(i as f32, j as f32, k as f32);
    let values: Vec<f32> = (0..nx * ny * nz)
        .into_par_iter()
        .map(|n| field(corner(n % nx, n / nx % ny, n / (nx * ny))))
        .collect();
    let value = |i: usize, j: usize, k: usize| values[i + nx * (j + ny * k)];
    let inside = |i, j, k| value(i, j, k) < 0.0;

    let mut mesh = TriangleMesh::default();
    let mut vertex_of: HashMap<[usize; 3], u32> = HashMap::new();
    for k in 0..cells.z {
        for j in 0..cells.y {
            for i in 0..cells.x {
                let count = (0..8)
                    .filter(|c| inside(i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)))
                    .count();
                if count == 0 || count == 8 || (side == Side::PositiveX && i == 0) {
                    continue;
                }
                let middle = corner(i, j, k) + 0.5 * step;
                let mut point = crossing_mean(&value, &corner, [i, j, k]);
                point = project(field, point, step).clamp(middle - 0.6 * step, middle + 0.6 * step);
                if side == Side::PositiveX && i == 1 {
                    point.x = 0.0;
                }
                vertex_of.insert([i, j, k], mesh.positions.len() as u32);
                mesh.positions.push(point);
                mesh.normals
                    .push(gradient(field, point, 0.25 * step).normalize_or(Vec3::Y));
            }
        }
    }
    // Every grid edge that crosses the surface has one quad around it, through its four cells.
    let mut quad = |ring: [[usize; 3]; 4], outward: bool| {
        let Some(v) = ring
            .iter()
            .map(|cell| vertex_of.get(cell).copied())
            .collect::<Option<Vec<u32>>>()
        else {
            return;
        };
        let (b, d) = if outward { (v[1], v[3]) } else { (v[3], v[1]) };
        // The shorter diagonal follows creases better.
        let p = |i: u32| mesh.positions[i as usize];
        if p(v[0]).distance_squared(p(v[2])) <= p(b).distance_squared(p(d)) {
            mesh.indices.extend([[v[0], b, v[2]], [v[0], v[2], d]]);
        } else {
            mesh.indices.extend([[v[0], b, d], [b, v[2], d]]);
        }
    };
    for k in 1..cells.z {
        for j in 1..cells.y {
            for i in 1..cells.x {
                let here = inside(i, j, k);
                if here != inside(i + 1, j, k) {
                    quad(
                        [[i, j - 1, k - 1], [i, j, k - 1], [i, j, k], [i, j - 1, k]],
                        here,
                    );
                }
                if here != inside(i, j + 1, k) {
                    quad(
                        [[i - 1, j, k - 1], [i - 1, j, k], [i, j, k], [i, j, k - 1]],
                        here,
                    );
                }
                if here != inside(i, j, k + 1) {
                    quad(
                        [[i - 1, j - 1, k], [i, j - 1, k], [i, j, k], [i - 1, j, k]],
                        here,
                    );
                }
            }
        }
    }
    mesh.materials = vec![0; mesh.indices.len()];
    mesh
}

/// The mean of the points where the surface crosses the edges of a cell.
fn crossing_mean(
    value: &impl Fn(usize, usize, usize) -> f32,
    corner: &impl Fn(usize, usize, usize) -> Vec3,
    [i, j, k]: [usize; 3],
) -> Vec3 {
    let (mut sum, mut count) = (Vec3::ZERO, 0.0);
    for a in 0..8usize {
        for axis in [1, 2, 4] {
            let b = a | axis;
            if a & axis != 0 {
                continue;
            }
            let at = |c: usize| (i + (c & 1), j + (c >> 1 & 1), k + (c >> 2));
            let ((ai, aj, ak), (bi, bj, bk)) = (at(a), at(b));
            let (va, vb) = (value(ai, aj, ak), value(bi, bj, bk));
            if (va < 0.0) != (vb < 0.0) {
                let t = va / (va - vb);
                sum += corner(ai, aj, ak).lerp(corner(bi, bj, bk), t);
                count += 1.0;
            }
        }
    }
    sum / count
}

/// A few Newton steps towards the surface.
pub fn project(field: Field, mut point: Vec3, step: f32) -> Vec3 {
    for _ in 0..4 {
        let g = gradient(field, point, 0.1 * step);
        let length_squared = g.length_squared();
        if length_squared < 1e-6 {
            break;
        }
        point -= (field(point) / length_squared * g).clamp_length_max(0.5 * step);
    }
    point
}

/// Unit normal at a point of the surface.
pub fn normal(field: Field, point: Vec3, step: f32) -> Vec3 {
    gradient(field, point, 0.25 * step).normalize_or(Vec3::Y)
}

/// Central differences.
fn gradient(field: Field, p: Vec3, h: f32) -> Vec3 {
    let d = |axis: Vec3| field(p + h * axis) - field(p - h * axis);
    Vec3::new(d(Vec3::X), d(Vec3::Y), d(Vec3::Z)) / (2.0 * h)
}
