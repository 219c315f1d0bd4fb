//! The bounding volume hierarchy that finds the triangles a ray meets.
use glam::{DVec3, Vec3};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::ploc::{PlocBuilder, PlocSearchDistance, SortPrecision};

use crate::camera::Ray;
use crate::mesh::TriangleMesh;
use crate::ray_offset::{geometric_normal, interpolate};
use crate::triangle::Shear;

/// Where a ray meets the mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray, metres.
    pub t: f32,
    /// Index into [`TriangleMesh::indices`].
    pub triangle: u32,
    /// Barycentric weight of the triangle's vertex 1.
    pub u: f32,
    /// Barycentric weight of the triangle's vertex 2.
    pub v: f32,
    /// Whether the triangle is seen from behind.
    pub back_face: bool,
}

/// A hit's point and what a ray that leaves it needs to know.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// World position, metres.
    pub position: Vec3,
    /// Unit normal of the triangle's plane, on the side of its front face.
    pub geometric_normal: Vec3,
    /// Bound on the distance of `position` from the surface as the BVH sees it, metres: the
    /// last argument of [`spawn_origin`](crate::ray_offset::spawn_origin).
    pub error: f32,
}

/// An axis-aligned box, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Smallest coordinates.
    pub min: Vec3,
    /// Largest coordinates.
    pub max: Vec3,
}

/// A ball, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Its centre.
    pub center: Vec3,
    /// Its radius, rounded up.
    pub radius: f32,
}

/// The hierarchy over one mesh. It copies the positions that it needs.
#[derive(Clone)]
pub struct Bvh {
    /// Centre of the mesh; rays and vertices are relative to it inside.
    center: DVec3,
    /// Power of two that brings the mesh into the unit cube.
    scale: f32,
    bounds: Option<Bounds>,
    sphere: Option<Sphere>,
    clusters: Vec<Sphere>,
    tree: Bvh2,
    triangles: Vec<[Vec3; 3]>,
    ids: Vec<u32>,
}

impl Bvh {
    /// Builds the hierarchy. Triangles with an index out of range or a position that is not
    /// finite are left out: nothing can hit them.
    pub fn build(mesh: &TriangleMesh) -> Self {
        let corners = |t: usize| -> Option<[Vec3; 3]> {
            let [a, b, c] = mesh.indices[t];
            let get = |i: u32| {
                mesh.positions
                    .get(i as usize)
                    .filter(|p| p.is_finite())
                    .copied()
            };
            Some([get(a)?, get(b)?, get(c)?])
        };
        let mut bounds = Bounds {
            min: Vec3::INFINITY,
            max: Vec3::NEG_INFINITY,
        };
        let mut ids = Vec::with_capacity(mesh.indices.len());
        for t in 0..mesh.indices.len() {
            if let Some(v) = corners(t) {
                ids.push(t as u32);
                bounds.min = v.iter().fold(bounds.min, |m, p| m.min(*p));
                bounds.max = v.iter().fold(bounds.max, |m, p| m.max(*p));
            }
        }
        let bounds = (!ids.is_empty()).then_some(bounds);
        let (center, scale) = bounds.map_or((DVec3::ZERO, 1.0), |b| {
            let center = (b.min.as_dvec3() + b.max.as_dvec3()) * 0.5;
            let half = (b.max.as_dvec3() - b.min.as_dvec3()).max_element() * 0.5;
            // Clamped so that the scale and its reciprocal stay normal numbers.
            let exponent = if half > 0.0 { -half.log2().ceil() } else { 0.0 };
            (center, exponent.clamp(-100.0, 100.0).exp2() as f32)
        });
        let triangles: Vec<[Vec3; 3]> = ids
            .iter()
            .map(|&t| {
                corners(t as usize)
                    .unwrap_or_default()
                    .map(|p| ((p.as_dvec3() - center) * scale as f64).as_vec3())
            })
            .collect();
        let boxes: Vec<Aabb> = triangles
            .iter()
            .map(|[a, b, c]| {
                let (min, max) = (a.min(*b).min(*c), a.max(*b).max(*c));
                // By way of arrays: obvhs may use another version of glam.
                Aabb::new(min.to_array().into(), max.to_array().into())
            })
            .collect();
        let tree = PlocBuilder::with_capacity(boxes.len()).build(
            PlocSearchDistance::Medium,
            &boxes,
            (0..boxes.len() as u32).collect(),
            SortPrecision::U64,
            3,
        );
        let sphere = bounds.map(|b| Sphere {
            center: center.as_vec3(),
            radius: (center.as_vec3() - b.min)
                .max(b.max - center.as_vec3())
                .length()
                .next_up(),
        });
        Self {
            center,
            scale,
            bounds,
            sphere,
            clusters: sphere.into_iter().collect(),
            tree,
            triangles,
            ids,
        }
    }

    /// The mesh's bounding box; `None` without triangles.
    pub fn bounds(&self) -> Option<Bounds> {
        self.bounds
    }

    /// A ball that holds every triangle, within a few per cent of the smallest; `None` without
    /// triangles.
    pub fn bounding_sphere(&self) -> Option<Sphere> {
        self.sphere
    }

    /// At most 16 balls that together hold every triangle, tighter than
    /// [`bounding_sphere`](Self::bounding_sphere) where the mesh is spread out.
    pub fn clusters(&self) -> &[Sphere] {
        &self.clusters
    }

    /// The nearest hit with `0 < t <= t_max` that `accept(triangle, u, v)` takes. It may be
    /// asked about triangles that are farther than the result, in any order.
    #[inline]
    pub fn closest(
        &self,
        ray: &Ray,
        t_max: f32,
        accept: impl Fn(u32, f32, f32) -> bool,
    ) -> Option<Hit> {
        self.traverse(ray, t_max, accept, false)
    }

    /// Whether any triangle with `0 < t <= t_max` is taken by `accept(triangle, u, v)`.
    #[inline]
    pub fn occluded(&self, ray: &Ray, t_max: f32, accept: impl Fn(u32, f32, f32) -> bool) -> bool {
        self.traverse(ray, t_max, accept, true).is_some()
    }

    fn traverse(
        &self,
        ray: &Ray,
        t_max: f32,
        accept: impl Fn(u32, f32, f32) -> bool,
        any: bool,
    ) -> Option<Hit> {
        if self.tree.nodes.is_empty() || !(ray.direction.length_squared() > 0.0) {
            return None;
        }
        let origin = ((ray.origin.as_dvec3() - self.center) * self.scale as f64).as_vec3();
        let mut t_limit = t_max * self.scale;
        let shear = Shear::new(ray.direction);
        let d = ray.direction;
        let safe = |x: f32| {
            1.0 / if x.abs() < 1e-18 {
                1e-18f32.copysign(x)
            } else {
                x
            }
        };
        let inverse = Vec3::new(safe(d.x), safe(d.y), safe(d.z));
        // Covers the rounding of the slab test and of the shear, both relative to the largest
        // coordinate in play.
        let pad = Vec3::splat(16.0 * f32::EPSILON * (origin.abs().max_element() + 1.0));
        let mut best = None;
        let mut stack = vec![0usize];
        while let Some(index) = stack.pop() {
            let node = &self.tree.nodes[index];
            let low = (Vec3::from(node.aabb().min.to_array()) - pad - origin) * inverse;
            let high = (Vec3::from(node.aabb().max.to_array()) + pad - origin) * inverse;
            let near = low.min(high).max_element().max(0.0);
            let far = low.max(high).min_element().min(t_limit);
            if near > far {
                continue;
            }
            if !node.is_leaf() {
                stack.push(node.first_index as usize);
                stack.push(node.first_index as usize + 1);
                continue;
            }
            for slot in node.first_index..node.first_index + node.prim_count {
                let local = self.tree.primitive_indices[slot as usize] as usize;
                let Some(hit) = shear.intersect(origin, self.triangles[local], t_limit) else {
                    continue;
                };
                if !accept(self.ids[local], hit.u, hit.v) {
                    continue;
                }
                t_limit = hit.t;
                best = Some(Hit {
                    t: hit.t / self.scale,
                    triangle: self.ids[local],
                    u: hit.u,
                    v: hit.v,
                    back_face: hit.back_face,
                });
                if any {
                    return best;
                }
            }
        }
        best
    }

    /// The point of `hit`, which must come from this BVH and `mesh` be what it was built from.
    #[inline]
    pub fn surface_point(&self, mesh: &TriangleMesh, hit: &Hit) -> SurfacePoint {
        let vertices = mesh.indices[hit.triangle as usize].map(|i| mesh.positions[i as usize]);
        let position = interpolate(vertices, hit.u, hit.v).as_vec3();
        // Half an ulp a component for the rounding of the position, and as much for vertices
        // and ray origin relative to the BVH's centre, whose coordinates are at most
        // 1 / scale: sqrt(3) (|p| 2^-24 + 2 * 2^-24 / scale), rounded up.
        let error = f32::EPSILON * (position.abs().max_element() + 2.0 / self.scale);
        SurfacePoint {
            position,
            geometric_normal: geometric_normal(vertices),
            error,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quad() -> TriangleMesh {
        TriangleMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
            indices: vec![[0, 1, 2], [0, 2, 3]],
            ..Default::default()
        }
    }

    #[test]
    fn a_ray_from_the_front_sees_the_front_face_and_weights_of_vertices_1_and_2() {
        let bvh = Bvh::build(&quad());
        let ray = Ray {
            origin: Vec3::new(0.75, 0.25, 2.0),
            direction: Vec3::NEG_Z,
        };
        let hit = bvh.closest(&ray, f32::INFINITY, |_, _, _| true).unwrap();
        assert_eq!((hit.triangle, hit.t, hit.back_face), (0, 2.0, false));
        // (0.75, 0.25) = 0.25 v0 + 0.5 v1 + 0.25 v2.
        assert_eq!((hit.u, hit.v), (0.5, 0.25));
        let behind = Ray {
            origin: Vec3::new(0.75, 0.25, -2.0),
            direction: Vec3::Z,
        };
        assert!(bvh.closest(&behind, 3.0, |_, _, _| true).unwrap().back_face);
        assert!(bvh.occluded(&behind, 3.0, |_, _, _| true));
        assert!(!bvh.occluded(&behind, 1.9, |_, _, _| true));
        assert!(!bvh.occluded(&behind, 3.0, |_, _, _| false));
    }
}
