//! Procedural solids as triangle meshes, about one metre wide, centred on the y axis and resting on y = 0.

use dipir_diffusion::noise::NoiseStream;
use dipir_scene::mesh::TriangleMesh;
use glam::Vec3;

use crate::random::between;

/// A kind of solid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// A sphere.
    Ball,
    /// A cuboid.
    Box,
    /// An upright cylinder.
    Cylinder,
    /// An upright cone.
    Cone,
    /// A torus on the ground.
    Ring,
    /// Body, cabin and four wheels.
    Car,
    /// A slab on four legs.
    Table,
    /// A truncated pyramid with 3, 5 or 6 sides.
    Stump,
    /// A gabled roof on low walls.
    Roof,
    /// An irregular solid with flat faces.
    Rock,
    /// A cylinder with round ends; training never shows it.
    Capsule,
    /// A pyramid on a square; training never shows it.
    Pyramid,
}

impl Shape {
    /// Shapes that all kinds of scenes have.
    pub const COMMON: [Self; 7] = [
        Self::Ball,
        Self::Box,
        Self::Cylinder,
        Self::Cone,
        Self::Ring,
        Self::Car,
        Self::Table,
    ];
    /// Shapes of training with slanted flat faces. Under a high sun they cast little shadow, and only their shading shows
    /// the light's direction.
    pub const FACETED: [Self; 3] = [Self::Stump, Self::Roof, Self::Rock];
    /// Shapes of evaluation, which training never shows.
    pub const HELD_OUT: [Self; 2] = [Self::Capsule, Self::Pyramid];

    /// Its word in captions; "object" if the vocabulary has none.
    pub fn word(self) -> &'static str {
        match self {
            Self::Ball => "ball",
            Self::Box => "box",
            Self::Cylinder => "cylinder",
            Self::Cone => "cone",
            Self::Ring => "ring",
            Self::Car => "car",
            Self::Table => "table",
            Self::Stump | Self::Roof | Self::Rock | Self::Capsule | Self::Pyramid => "object",
        }
    }

    /// The solid with proportions `p`, each in [0, 1].
    pub fn mesh(self, p: [f32; 3]) -> TriangleMesh {
        let mix = |low: f32, high: f32, t: f32| low + (high - low) * t;
        match self {
            Self::Ball => revolve(&arc(0.5, Vec3::new(0.0, 0.5, 0.0), 16), 24),
            Self::Box => {
                let half = Vec3::new(
                    mix(0.3, 0.6, p[0]),
                    mix(0.25, 0.6, p[1]),
                    mix(0.3, 0.6, p[2]),
                );
                cuboid(Vec3::new(0.0, half.y, 0.0), half)
            }
            Self::Cylinder => {
                let (r, h) = (mix(0.25, 0.5, p[0]), mix(0.5, 1.3, p[1]));
                revolve(
                    &[(0.0, 0.0), (r, 0.0), (r, 0.0), (r, h), (r, h), (0.0, h)],
                    28,
                )
            }
            Self::Cone => {
                let (r, h) = (mix(0.35, 0.6, p[0]), mix(0.7, 1.4, p[1]));
                revolve(&[(0.0, 0.0), (r, 0.0), (r, 0.0), (0.0, h)], 28)
            }
            Self::Ring => {
                let (big, small) = (mix(0.35, 0.5, p[0]), mix(0.1, 0.2, p[1]));
                let profile: Vec<_> = (0..=12)
                    .map(|i| {
                        let a = std::f32::consts::TAU * i as f32 / 12.0;
                        (big + small * a.cos(), small + small * a.sin())
                    })
                    .collect();
                revolve(&profile, 28)
            }
            Self::Car => car(
                mix(0.85, 1.15, p[0]),
                mix(0.85, 1.15, p[1]),
                mix(-0.2, 0.05, p[2]),
            ),
            Self::Table => {
                let (w, d, h) = (
                    mix(0.4, 0.65, p[0]),
                    mix(0.3, 0.5, p[1]),
                    mix(0.5, 0.8, p[2]),
                );
                let mut mesh = cuboid(Vec3::new(0.0, h, 0.0), Vec3::new(w, 0.05, d));
                for (sx, sz) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                    let leg = Vec3::new(sx * (w - 0.06), 0.5 * h, sz * (d - 0.06));
                    mesh.append(cuboid(leg, Vec3::new(0.04, 0.5 * h, 0.04)), 0);
                }
                mesh
            }
            Self::Stump => {
                let (r, h) = (mix(0.4, 0.7, p[0]), mix(0.4, 1.1, p[1]));
                let sides = [3, 5, 6][((3.0 * p[2]) as usize).min(2)];
                let top = r * mix(0.15, 0.65, (3.0 * p[2]).fract());
                let profile = [(0.0, 0.0), (r, 0.0), (r, 0.0), (top, h), (top, h), (0.0, h)];
                revolve(&profile, sides)
            }
            Self::Roof => roof(
                mix(0.35, 0.65, p[0]),
                mix(0.35, 0.9, p[1]),
                mix(0.35, 0.6, p[2]),
                mix(0.0, 0.35, (7.0 * p[2]).fract()),
            ),
            Self::Rock => rock(p),
            Self::Capsule => {
                let (r, h) = (mix(0.22, 0.35, p[0]), mix(0.3, 0.8, p[1]));
                let mut profile = arc(r, Vec3::new(0.0, r, 0.0), 16);
                for point in profile.iter_mut().skip(9) {
                    point.1 += h;
                }
                revolve(&profile, 24)
            }
            Self::Pyramid => {
                let (r, h) = (mix(0.5, 0.8, p[0]), mix(0.6, 1.2, p[1]));
                revolve(&[(0.0, 0.0), (r, 0.0), (r, 0.0), (0.0, h)], 4)
            }
        }
    }
}

/// Half a circle of (radius, height) points from bottom to top.
fn arc(r: f32, center: Vec3, steps: usize) -> Vec<(f32, f32)> {
    (0..=steps)
        .map(|i| {
            let a = std::f32::consts::PI * (i as f32 / steps as f32 - 0.5);
            (r * a.cos().max(0.0), center.y + r * a.sin())
        })
        .collect()
}

/// A solid of revolution of a profile of (radius, height) around the y axis. A repeated point makes a sharp edge. Other
/// edges are smooth from 8 sides on.
fn revolve(profile: &[(f32, f32)], sides: usize) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for pair in profile.windows(2) {
        let [(r0, y0), (r1, y1)] = [pair[0], pair[1]];
        if (r0, y0) == (r1, y1) {
            continue;
        }
        // The middle of a flat side is closer to the axis than its edges.
        let flatness = match sides {
            8.. => 1.0,
            _ => (std::f32::consts::PI / sides as f32).cos(),
        };
        let slope = Vec3::new(y1 - y0, flatness * (r0 - r1), 0.0).normalize_or_zero();
        for side in 0..sides {
            let angle = |s: usize| std::f32::consts::TAU * s as f32 / sides as f32;
            let (a, b) = (angle(side), angle(side + 1));
            let at = |r: f32, y: f32, t: f32| Vec3::new(r * t.cos(), y, r * t.sin());
            let turn = |t: f32| Vec3::new(slope.x * t.cos(), slope.y, slope.x * t.sin());
            let corners = [at(r0, y0, a), at(r1, y1, a), at(r1, y1, b), at(r0, y0, b)];
            let middle = turn(0.5 * (a + b));
            let normals = if sides >= 8 {
                [turn(a), turn(a), turn(b), turn(b)]
            } else {
                [middle; 4]
            };
            quad(&mut mesh, corners, normals, r0 > 0.0, r1 > 0.0);
        }
    }
    mesh
}

/// Two triangles, or one where an end of the quad is a point.
fn quad(mesh: &mut TriangleMesh, p: [Vec3; 4], n: [Vec3; 4], lower: bool, upper: bool) {
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(p);
    mesh.normals.extend(n);
    if upper {
        mesh.indices.push([first, first + 1, first + 2]);
        mesh.materials.push(0);
    }
    if lower {
        mesh.indices.push([first, first + 2, first + 3]);
        mesh.materials.push(0);
    }
}

/// A flat triangle that faces away from `center`; none if it has no area.
fn facet(mesh: &mut TriangleMesh, [a, b, c]: [Vec3; 3], center: Vec3) {
    let Some(normal) = (b - a).cross(c - a).try_normalize() else {
        return;
    };
    let outwards = normal.dot((a + b + c) / 3.0 - center) > 0.0;
    let first = mesh.positions.len() as u32;
    let (corners, normal) = match outwards {
        true => ([a, b, c], normal),
        false => ([a, c, b], -normal),
    };
    mesh.positions.extend(corners);
    mesh.normals.extend([normal; 3]);
    mesh.indices.push([first, first + 1, first + 2]);
    mesh.materials.push(0);
}

/// A gabled house of half width, roof height, half depth and wall height.
fn roof(width: f32, rise: f32, depth: f32, walls: f32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let profile = [
        (-width, 0.0),
        (width, 0.0),
        (width, walls),
        (0.0, walls + rise),
        (-width, walls),
    ];
    let center = Vec3::new(0.0, 0.4 * (walls + rise), 0.0);
    let at = |i: usize, z: f32| Vec3::new(profile[i % 5].0, profile[i % 5].1, z);
    for i in 0..5 {
        let [a, b] = [i, i + 1];
        let [near, far] = [depth, -depth];
        facet(&mut mesh, [at(a, near), at(b, near), at(b, far)], center);
        facet(&mut mesh, [at(a, near), at(b, far), at(a, far)], center);
    }
    for z in [depth, -depth] {
        for i in 1..4 {
            facet(&mut mesh, [at(0, z), at(i, z), at(i + 1, z)], center);
        }
    }
    mesh
}

/// Two rings of five to eight random corners, and a tip.
fn rock(p: [f32; 3]) -> TriangleMesh {
    let key = p.map(f32::to_bits);
    let mut stream = NoiseStream::new(u64::from(key[0]) << 32 | u64::from(key[1]), key[2].into());
    let mut range = |low, high| between(&mut stream, low, high);
    let sides = range(5.0, 9.0) as usize;
    let height = range(0.4, 1.1);
    let (size, waist, shoulder) = (range(0.38, 0.55), range(0.35, 0.7), range(0.7, 1.1));
    let mut ring = |y: f32, radius: f32| -> Vec<Vec3> {
        (0..sides)
            .map(|k| {
                let angle = (k as f32 + range(-0.25, 0.25)) / sides as f32 * std::f32::consts::TAU;
                let (s, c) = angle.sin_cos();
                let r = radius * range(0.8, 1.15);
                Vec3::new(r * c, y, r * s)
            })
            .collect()
    };
    let foot = ring(0.0, size);
    let middle = ring(waist * height, size * shoulder);
    let tip = Vec3::new(range(-0.15, 0.15), height, range(-0.15, 0.15));
    let center = Vec3::new(0.0, 0.4 * height, 0.0);
    let mut mesh = TriangleMesh::default();
    for k in 0..sides {
        let next = (k + 1) % sides;
        let [a, b, c, d] = [foot[k], foot[next], middle[next], middle[k]];
        for corners in [[Vec3::ZERO, a, b], [a, b, c], [a, c, d], [d, c, tip]] {
            facet(&mut mesh, corners, center);
        }
    }
    mesh
}

/// A box around `center` with half sides `half`.
pub(crate) fn cuboid(center: Vec3, half: Vec3) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for axis in 0..3 {
        for sign in [-1.0f32, 1.0] {
            let mut n = Vec3::ZERO;
            n[axis] = sign;
            let (mut u, mut v) = (Vec3::ZERO, Vec3::ZERO);
            u[(axis + 1) % 3] = half[(axis + 1) % 3];
            v[(axis + 2) % 3] = half[(axis + 2) % 3] * sign;
            let c = center + n * half;
            let corners = [c - u - v, c + u - v, c + u + v, c - u + v];
            quad(&mut mesh, corners, [n; 4], true, true);
        }
    }
    mesh
}

fn car(length: f32, height: f32, cabin: f32) -> TriangleMesh {
    let (l, h, w) = (0.95 * length, 0.2 * height, 0.42);
    let mut mesh = cuboid(Vec3::new(0.0, 0.14 + h, 0.0), Vec3::new(l, h, w));
    let roof = Vec3::new(cabin * l, 0.14 + 2.0 * h + 0.15, 0.0);
    mesh.append(cuboid(roof, Vec3::new(0.5 * l, 0.15, 0.37)), 0);
    for (sx, sz) in [(-0.6, -1.0), (-0.6, 1.0), (0.6, -1.0), (0.6, 1.0)] {
        let mut wheel = revolve(
            &[
                (0.0, -0.06),
                (0.16, -0.06),
                (0.16, -0.06),
                (0.16, 0.06),
                (0.16, 0.06),
                (0.0, 0.06),
            ],
            16,
        );
        // The axle along z.
        for p in wheel.positions.iter_mut().chain(&mut wheel.normals) {
            *p = Vec3::new(p.x, p.z, -p.y);
        }
        for p in &mut wheel.positions {
            *p += Vec3::new(sx * l, 0.16, sz * 0.4);
        }
        mesh.append(wheel, 0);
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solids_rest_on_the_ground_and_face_outwards() {
        let trained = Shape::COMMON.into_iter().chain(Shape::FACETED);
        for shape in trained.chain(Shape::HELD_OUT) {
            for p in [[0.0; 3], [0.5; 3], [1.0; 3]] {
                let mesh = shape.mesh(p);
                let (low, high) = mesh.bounds().expect("triangles");
                assert!(low.y.abs() < 0.02, "{shape:?}: {low}");
                assert!(
                    high.y > 0.15 && high.max_element() < 1.6,
                    "{shape:?}: {high}"
                );
                // The enclosed volume is positive if triangles face outwards.
                let volume: f32 = mesh
                    .indices
                    .iter()
                    .map(|t| {
                        let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
                        a.dot(b.cross(c)) / 6.0
                    })
                    .sum();
                assert!(volume > 0.01, "{shape:?}: volume {volume}");
                for (t, triangle) in mesh.indices.iter().enumerate() {
                    let n = mesh.scaled_normal(t).as_vec3().normalize_or_zero();
                    for &i in triangle {
                        let shading = mesh.normals[i as usize];
                        // Flat faces have one normal, round ones those of their corners.
                        let flat = Shape::FACETED.contains(&shape) || shape == Shape::Pyramid;
                        let least = if flat { 0.999 } else { 0.5 };
                        assert!(n.dot(shading) > least, "{shape:?}: {n} against {shading}");
                    }
                }
            }
        }
    }
}
