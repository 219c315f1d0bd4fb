//! Courtyards: objects of all sizes, walls on any side, and trees, some of them outside of the picture with their shadows
//! in it.
use dipir_scene::mesh::TriangleMesh;
use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

use crate::backdrop::Backdrop;
use crate::random::Draw;
use crate::shapes::{Shape, cuboid};

/// Ground that stays free: a circle around the main object, and a wedge from there to the camera.
#[derive(Debug, Clone, Copy)]
pub struct Clearing {
    /// Radius of the circle, metres.
    pub radius: f32,
    /// Position of the camera, (x, z).
    pub camera: Vec2,
    /// Width of the view at the object, metres.
    pub width: f32,
}

impl Clearing {
    /// Whether an object with this middle and radius would reach into it.
    fn is_blocked(&self, at: Vec2, radius: f32) -> bool {
        if at.length() < self.radius + radius {
            return true;
        }
        // Near the camera even a small object would fill the picture.
        let share = (at.y / self.camera.y.max(1e-3)).clamp(0.0, 1.5);
        share > 0.35 && (at.x - self.camera.x * share).abs() < radius + 0.5 * self.width * share
    }
}

impl Backdrop {
    /// A courtyard around the origin with solids of `shapes`.
    pub fn courtyard(draw: &mut Draw<'_>, shapes: &[Shape], clearing: &Clearing) -> Self {
        let mut courtyard = Self::default();
        let spread = clearing.width.clamp(2.0, 9.0);
        for _ in 0..5 + draw.below(14) {
            let at = Vec2::new(
                draw.range(-0.8, 0.8) * spread,
                -draw.range(-0.5, 1.0) * spread,
            );
            let size = draw.range(0.25f32.ln(), 1.6f32.ln()).exp();
            if !clearing.is_blocked(at, 0.8 * size) {
                courtyard.object(draw, shapes, at, size);
            }
        }
        for (chance, turn) in [(0.55, 0.0), (0.3, 0.25), (0.3, -0.25), (0.2, 0.5)] {
            if draw.chance(chance) {
                let near = match turn == 0.5 {
                    // Behind the camera, where it may block the sun.
                    true => clearing.camera.y + 4.0,
                    false => 0.6 * spread,
                };
                courtyard.wall(draw, near, turn);
            }
        }
        for _ in 0..draw.below(4) {
            let side = draw.range(0.5, 2.5) * spread;
            let (s, c) = draw.range(0.0, std::f32::consts::TAU).sin_cos();
            let at = Vec2::new(s * side, -c * side);
            if !clearing.is_blocked(at, 0.3) {
                courtyard.leafy_tree(draw, Vec3::new(at.x, 0.0, at.y));
            }
        }
        courtyard
    }

    /// A wall or a row of houses in the direction `turn`, in full turns to the right of the camera's forward direction.
    fn wall(&mut self, draw: &mut Draw<'_>, near: f32, turn: f32) {
        let mut wall = Self::default();
        let depth = near + draw.range(0.3, 8.0);
        if draw.chance(0.6) {
            wall.houses(draw, depth);
        } else {
            let paint = draw.masonry();
            let paint = wall.paint(paint);
            let half = Vec3::new(
                draw.range(1.0, 8.0),
                draw.range(0.2, 2.0),
                draw.range(0.1, 0.4),
            );
            let aside = draw.range(-4.0, 4.0);
            let middle = Vec3::new(aside, half.y, -depth - half.z);
            wall.mesh.append(cuboid(middle, half), paint);
        }
        let angle = f64::from(-turn * std::f32::consts::TAU);
        wall.mesh.transform(&DMat4::from_rotation_y(angle));
        self.add(wall);
    }

    fn add(&mut self, other: Self) {
        self.mesh.append(other.mesh, self.paints.len() as u32);
        self.paints.extend(other.paints);
    }

    /// Adds `mesh`, which is centred on the origin, at `at` with a random yaw.
    fn put(&mut self, draw: &mut Draw<'_>, mut mesh: TriangleMesh, at: Vec2, size: f32) {
        let turn = DQuat::from_rotation_y(f64::from(draw.range(0.0, std::f32::consts::TAU)));
        mesh.transform(&DMat4::from_scale_rotation_translation(
            DVec3::splat(f64::from(size)),
            turn,
            DVec3::new(f64::from(at.x), 0.0, f64::from(at.y)),
        ));
        self.mesh.append(mesh, 0);
    }

    /// An object about `size` metres wide.
    fn object(&mut self, draw: &mut Draw<'_>, shapes: &[Shape], at: Vec2, size: f32) {
        let mut p = || [0; 3].map(|_| draw.range(0.0, 1.0));
        let (p, q) = (p(), p());
        let any = if draw.chance(0.5) {
            draw.masonry()
        } else {
            draw.paint()
        };
        let paint = self.paint(any);
        let mesh = match draw.below(8) {
            0 => self.planter(draw, p, paint),
            1 => bollard(p, paint),
            2 => bench(p, paint),
            3 => steps(draw, p, q, paint),
            4 => self.sign(draw, p, q, paint),
            5 => self.shrub(draw, p),
            _ => painted(shapes[draw.below(shapes.len())].mesh(p), paint),
        };
        self.put(draw, mesh, at, size);
    }

    /// A planter or a pot with leaves.
    fn planter(&mut self, draw: &mut Draw<'_>, p: [f32; 3], paint: u32) -> TriangleMesh {
        let half = Vec3::new(0.2 + 0.4 * p[0], 0.1 + 0.25 * p[1], 0.2 + 0.3 * p[2]);
        let mut mesh = painted(cuboid(Vec3::Y * half.y, half), paint);
        let leaves = draw.leaves();
        let leaves = self.paint(leaves);
        for _ in 0..3 + draw.below(8) {
            let aside = Vec3::new(draw.range(-1.0, 1.0), 0.0, draw.range(-1.0, 1.0)) * half;
            let center = aside + Vec3::Y * (2.0 * half.y + draw.range(0.0, 0.3));
            let leaf = draw.range(0.05, 0.25);
            mesh.append(draw.clump(center, leaf), leaves);
        }
        mesh
    }

    /// A sign or a figure: something wide on a thin post.
    fn sign(&mut self, draw: &mut Draw<'_>, p: [f32; 3], q: [f32; 3], paint: u32) -> TriangleMesh {
        let height = 0.6 + 0.9 * p[0];
        let post = Vec3::new(0.03 + 0.07 * p[1], 0.5 * height, 0.03 + 0.05 * p[1]);
        let mut mesh = painted(cuboid(Vec3::Y * post.y, post), paint);
        let head = Vec3::new(0.1 + 0.3 * q[0], 0.1 + 0.3 * q[1], 0.03 + 0.15 * q[2]);
        let any = draw.paint();
        let top = self.paint(any);
        mesh.append(cuboid(Vec3::Y * (height + 0.8 * head.y), head), top);
        mesh
    }

    fn shrub(&mut self, draw: &mut Draw<'_>, p: [f32; 3]) -> TriangleMesh {
        let leaves = draw.leaves();
        let leaves = self.paint(leaves);
        let mut mesh = TriangleMesh::default();
        for _ in 0..6 + draw.below(14) {
            let (s, c) = draw.range(0.0, std::f32::consts::TAU).sin_cos();
            let out = draw.range(0.0, 0.45);
            let center = Vec3::new(s * out, draw.range(0.0, 0.2 + p[0]), c * out);
            let leaf = draw.range(0.06, 0.22);
            mesh.append(draw.clump(center, leaf), leaves);
        }
        mesh
    }

    /// A tree with many small clumps of leaves and a patchy shadow.
    fn leafy_tree(&mut self, draw: &mut Draw<'_>, at: Vec3) {
        let (height, thick) = (draw.range(1.2, 5.0), draw.range(0.04, 0.2));
        let bark = draw.masonry();
        let bark = self.paint(bark);
        let trunk = Vec3::new(thick, 0.5 * height, thick);
        self.mesh
            .append(cuboid(at + Vec3::Y * trunk.y, trunk), bark);
        let leaves = draw.leaves();
        let leaves = self.paint(leaves);
        let size = height * draw.range(0.25, 0.5);
        for _ in 0..8 + draw.below(24) {
            let (s, c) = draw.range(0.0, std::f32::consts::TAU).sin_cos();
            let out = draw.range(0.0, 1.0f32).sqrt() * size;
            let up = draw.range(-0.5, 1.0) * size;
            let center = at + Vec3::new(s * out, height + up, c * out);
            let leaf = size * draw.range(0.1, 0.4);
            self.mesh.append(draw.clump(center, leaf), leaves);
        }
    }
}

/// `mesh` with the material `paint`.
fn painted(mesh: TriangleMesh, paint: u32) -> TriangleMesh {
    let mut out = TriangleMesh::default();
    out.append(mesh, paint);
    out
}

/// A bollard or a post.
fn bollard(p: [f32; 3], paint: u32) -> TriangleMesh {
    let (r, h) = (0.04 + 0.16 * p[0], 0.4 + 1.8 * p[1]);
    let mut mesh = Shape::Cylinder.mesh([0.5; 3]);
    let (x, y) = (f64::from(r / 0.375), f64::from(h / 0.9));
    mesh.transform(&DMat4::from_scale(DVec3::new(x, y, x)));
    painted(mesh, paint)
}

fn bench(p: [f32; 3], paint: u32) -> TriangleMesh {
    let (w, h) = (0.5 + 0.5 * p[0], 0.25 + 0.15 * p[1]);
    let seat = Vec3::new(w, 0.03, 0.2);
    let mut mesh = painted(cuboid(Vec3::Y * h, seat), paint);
    for side in [-0.8, 0.8] {
        let leg = Vec3::new(side * w, 0.5 * h, 0.0);
        mesh.append(cuboid(leg, Vec3::new(0.05, 0.5 * h, 0.17)), paint);
    }
    if p[2] > 0.4 {
        let back = Vec3::new(0.0, h + 0.3, -0.2);
        mesh.append(cuboid(back, Vec3::new(w, 0.16, 0.02)), paint);
    }
    mesh
}

/// Steps or stacked crates.
fn steps(draw: &mut Draw<'_>, p: [f32; 3], q: [f32; 3], paint: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let (mut y, mut half) = (0.0, Vec3::new(0.5 + 0.3 * p[0], 0.0, 0.4 + 0.3 * p[1]));
    for i in 0..2 + draw.below(3) {
        half.y = 0.07 + 0.2 * p[2];
        let middle = Vec3::new(0.1 * q[0] * i as f32, y + half.y, -0.12 * i as f32);
        mesh.append(cuboid(middle, half), paint);
        y += 2.0 * half.y;
        half.x *= 0.6 + 0.4 * q[1];
        half.z *= 0.6 + 0.35 * q[2];
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_diffusion::noise::NoiseStream;

    #[test]
    fn the_clearing_is_free_below_leaves_and_every_triangle_has_a_paint() {
        let clearing = Clearing {
            radius: 0.9,
            camera: Vec2::new(0.2, 8.0),
            width: 3.5,
        };
        let mut triangles = vec![];
        for index in 0..200 {
            let mut stream = NoiseStream::new(9, index);
            let kinds = &Shape::COMMON;
            let courtyard = Backdrop::courtyard(&mut Draw::new(&mut stream), kinds, &clearing);
            let mesh = &courtyard.mesh;
            assert!(
                mesh.materials
                    .iter()
                    .all(|m| (*m as usize) < courtyard.paints.len())
            );
            for p in &mesh.positions {
                let away = Vec2::new(p.x, p.z).length();
                assert!(p.is_finite() && (away > 0.55 || p.y > 0.4), "{index}: {p}");
            }
            triangles.push(mesh.indices.len());
        }
        triangles.sort();
        // Few courtyards are nearly empty.
        assert!(
            triangles[20] > 200 && triangles[199] < 60_000,
            "{triangles:?}"
        );
    }

    #[test]
    fn the_view_of_the_main_object_is_blocked_to_others() {
        let clearing = Clearing {
            radius: 0.9,
            camera: Vec2::new(0.2, 8.0),
            width: 3.5,
        };
        assert!(clearing.is_blocked(Vec2::new(0.1, 4.0), 0.1));
        assert!(clearing.is_blocked(Vec2::new(0.5, -0.5), 0.3));
        assert!(!clearing.is_blocked(Vec2::new(3.0, 4.0), 0.3));
        assert!(!clearing.is_blocked(Vec2::new(0.0, -3.0), 0.5));
    }
}
