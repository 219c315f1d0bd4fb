//! Fewer triangles where the surface is flat: edge collapses in order of their quadric error
//! [Garland and Heckbert 1997], new vertices drawn onto the implicit surface.
use std::cmp::Ordering;
use std::collections::BinaryHeap;

use dipir_scene::mesh::TriangleMesh;
use glam::{DMat3, DVec3, Vec3};

use crate::mesher::{Field, normal, project};

/// Root mean square distance that a vertex may have from the planes of the faces that it stands
/// for, metres. Vertices lie on the surface, so that its error is a fraction of this.
const TOLERANCE_M: f64 = 6e-4;
/// Longest edge, metres: shading interpolates normals along it.
const LONGEST_M: f32 = 0.16;
/// Least cosine between the normals of vertices that are merged: creases stay.
const LEAST_AGREEMENT: f32 = 0.96;
/// Least cosine between a face's own normal and its vertices'.
const LEAST_FACING: f32 = 0.75;

/// Squared distance to a set of planes, and how many they are.
#[derive(Clone, Copy)]
struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
    planes: f64,
}

impl Quadric {
    const ZERO: Self = Self {
        a: DMat3::ZERO,
        b: DVec3::ZERO,
        c: 0.0,
        planes: 0.0,
    };

    fn of_plane(normal: DVec3, point: DVec3) -> Self {
        let d = -normal.dot(point);
        Self {
            a: DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z),
            b: normal * d,
            c: d * d,
            planes: 1.0,
        }
    }

    fn plus(&self, other: &Self) -> Self {
        Self {
            a: self.a + other.a,
            b: self.b + other.b,
            c: self.c + other.c,
            planes: self.planes + other.planes,
        }
    }

    /// Root mean square distance of `p`.
    fn error(&self, p: DVec3) -> f64 {
        let sum = p.dot(self.a * p) + 2.0 * self.b.dot(p) + self.c;
        (sum.max(0.0) / self.planes.max(1.0)).sqrt()
    }
}

struct Candidate {
    error: f64,
    edge: [u32; 2],
    versions: [u32; 2],
    position: Vec3,
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    /// For a max-heap: the least error compares greatest, ties by index, so that the result is always the same.
    fn cmp(&self, other: &Self) -> Ordering {
        let key = other.error.total_cmp(&self.error);
        key.then(other.edge.cmp(&self.edge))
    }
}

struct Simplifier<'a> {
    field: Field<'a>,
    step: f32,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    quadrics: Vec<Quadric>,
    versions: Vec<u32>,
    faces: Vec<Option<[u32; 3]>>,
    around: Vec<Vec<u32>>,
    heap: BinaryHeap<Candidate>,
}

/// Simplifies a mesh of `field` made with cells of `step`. Vertices on `x = 0` stay there.
pub fn simplify(mesh: TriangleMesh, field: Field, step: f32) -> TriangleMesh {
    let count = mesh.positions.len();
    let mut s = Simplifier {
        field,
        step,
        positions: mesh.positions,
        normals: mesh.normals,
        quadrics: vec![Quadric::ZERO; count],
        versions: vec![0; count],
        faces: mesh.indices.iter().copied().map(Some).collect(),
        around: vec![Vec::new(); count],
        heap: BinaryHeap::new(),
    };
    for (f, t) in mesh.indices.iter().enumerate() {
        let [a, b, c] = t.map(|i| s.positions[i as usize].as_dvec3());
        let plane = Quadric::of_plane((b - a).cross(c - a).normalize_or_zero(), a);
        for &i in t {
            s.around[i as usize].push(f as u32);
            s.quadrics[i as usize] = s.quadrics[i as usize].plus(&plane);
        }
    }
    for t in &mesh.indices {
        for k in 0..3 {
            let (u, v) = (t[k], t[(k + 1) % 3]);
            // Each inner edge has two faces that walk it in opposite directions.
            if u < v {
                s.offer(u, v);
            }
        }
    }
    while let Some(candidate) = s.heap.pop() {
        s.collapse(&candidate);
    }
    s.finish()
}

impl Simplifier<'_> {
    fn on_seam(&self, i: u32) -> bool {
        self.positions[i as usize].x == 0.0
    }

    fn offer(&mut self, u: u32, v: u32) {
        let (a, b) = (self.positions[u as usize], self.positions[v as usize]);
        let agreement = self.normals[u as usize].dot(self.normals[v as usize]);
        if a.distance(b) > LONGEST_M || agreement < LEAST_AGREEMENT {
            return;
        }
        let quadric = self.quadrics[u as usize].plus(&self.quadrics[v as usize]);
        let middle = match (self.on_seam(u), self.on_seam(v)) {
            (true, false) => a,
            (false, true) => b,
            _ => 0.5 * (a + b),
        };
        let error = quadric.error(middle.as_dvec3());
        if error <= TOLERANCE_M {
            self.heap.push(Candidate {
                error,
                edge: [u, v],
                versions: [self.versions[u as usize], self.versions[v as usize]],
                position: middle,
            });
        }
    }

    fn neighbours(&self, i: u32) -> Vec<u32> {
        let mut found: Vec<u32> = self.around[i as usize]
            .iter()
            .filter_map(|&f| self.faces[f as usize])
            .flatten()
            .filter(|&j| j != i)
            .collect();
        found.sort_unstable();
        found.dedup();
        found
    }

    fn collapse(&mut self, candidate: &Candidate) {
        let [u, v] = candidate.edge;
        let current = [self.versions[u as usize], self.versions[v as usize]];
        if current != candidate.versions {
            return;
        }
        // Exactly the two faces at the edge may vanish, or the surface would pinch.
        let of_v = self.neighbours(v);
        let common: Vec<u32> = self
            .neighbours(u)
            .into_iter()
            .filter(|n| of_v.contains(n))
            .collect();
        let shared = self.around[u as usize]
            .iter()
            .filter(|&&f| self.faces[f as usize].is_some_and(|t| t.contains(&v)))
            .count();
        if common.len() != shared || (self.on_seam(u) && self.on_seam(v) && shared != 1) {
            return;
        }
        let mut p = candidate.position;
        let seam = p.x == 0.0;
        p = project(self.field, p, self.step);
        if seam {
            p.x = 0.0;
        }
        let n = normal(self.field, p, self.step);
        if !self.stays_well_shaped(u, v, p, n) || !self.stays_well_shaped(v, u, p, n) {
            return;
        }
        self.positions[u as usize] = p;
        self.normals[u as usize] = n;
        self.quadrics[u as usize] = self.quadrics[u as usize].plus(&self.quadrics[v as usize]);
        for f in std::mem::take(&mut self.around[v as usize]) {
            let Some(mut t) = self.faces[f as usize] else {
                continue;
            };
            if t.contains(&u) {
                self.faces[f as usize] = None;
            } else {
                t.iter_mut().filter(|i| **i == v).for_each(|i| *i = u);
                self.faces[f as usize] = Some(t);
                self.around[u as usize].push(f);
            }
        }
        self.versions[u as usize] += 1;
        self.versions[v as usize] = u32::MAX;
        self.around[u as usize].retain(|&f| self.faces[f as usize].is_some());
        for w in self.neighbours(u) {
            self.offer(u.min(w), u.max(w));
        }
    }

    /// Whether the faces around `moved` that do not touch `gone` still face outwards when `moved` is
    /// at `p`.
    fn stays_well_shaped(&self, moved: u32, gone: u32, p: Vec3, n: Vec3) -> bool {
        self.around[moved as usize]
            .iter()
            .filter_map(|&f| self.faces[f as usize])
            .filter(|t| !t.contains(&gone))
            .all(|t| {
                let at = |i: u32| {
                    if i == moved {
                        p
                    } else {
                        self.positions[i as usize]
                    }
                };
                let [a, b, c] = t.map(at);
                let cross = (b - a).cross(c - a);
                let longest = (b - a).length().max((c - b).length()).max((a - c).length());
                // Thinner than a tenth of its length: slivers shade badly.
                if longest > LONGEST_M || cross.length() < 0.1 * longest * longest {
                    return false;
                }
                let face = cross.normalize();
                t.iter().all(|&i| {
                    let vertex = if i == moved {
                        n
                    } else {
                        self.normals[i as usize]
                    };
                    face.dot(vertex) >= LEAST_FACING
                })
            })
    }

    fn finish(self) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let mut renamed = vec![u32::MAX; self.positions.len()];
        for t in self.faces.into_iter().flatten() {
            mesh.indices.push(t.map(|i| {
                if renamed[i as usize] == u32::MAX {
                    renamed[i as usize] = mesh.positions.len() as u32;
                    mesh.positions.push(self.positions[i as usize]);
                    mesh.normals.push(self.normals[i as usize]);
                }
                renamed[i as usize]
            }));
        }
        mesh.materials = vec![0; mesh.indices.len()];
        mesh
    }
}
