//! The bounding volume hierarchy that finds the triangles a ray meets.
mod build;
mod cluster;
mod enclosing;
mod lanes;
mod node;
mod ray;
pub mod traverse;

use glam::{DVec3, Vec3, Vec3A};

use crate::camera::Ray;
use crate::mesh::TriangleMesh;
use crate::ray_offset::{geometric_normal, interpolate};
use crate::triangle::TriangleHit;
use enclosing::enclosing_sphere;
use ray::LocalRay;
use traverse::Tree;

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
pub struct HitPoint {
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

/// Balls that [`Bvh::clusters`] returns at most.
const MAX_CLUSTERS: usize = 16;

/// Rays that start farther than this from the centre, in half sizes of the mesh, are moved up.
const FAR: f64 = 8.0;

/// The hierarchy over one mesh. It copies the positions that it needs.
#[derive(Clone)]
pub struct Bvh {
    /// Centre of the mesh; rays and vertices are relative to it inside.
    center: DVec3,
    /// Power of two that brings the mesh into the unit cube.
    scale: f64,
    /// Its reciprocal.
    unscale: f64,
    bounds: Option<Bounds>,
    sphere: Option<Sphere>,
    clusters: Vec<Sphere>,
    tree: Tree,
}

impl Bvh {
    /// Builds the hierarchy on all threads of the current pool, in time n log n whatever the mesh.
    ///
    /// Triangles with an index out of range or a position that is not finite are left out: nothing
    /// can hit them. So are copies of a triangle: those whose corners, material, texture
    /// coordinates and colours are those of an earlier one. Every ray that met one would have to
    /// be tested against all of them, and could not tell them apart.
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
            let exponent = if half > 0.0 { -half.log2().ceil() } else { 0.0 };
            (center, exponent.exp2())
        });
        let triangles: Vec<[Vec3; 3]> = ids
            .iter()
            .map(|&t| {
                corners(t as usize)
                    .unwrap_or_default()
                    .map(|p| ((p.as_dvec3() - center) * scale).as_vec3())
            })
            .collect();
        let tree = build::build(&triangles, &ids, |a, b| {
            visible_data(mesh, ids[a as usize]).cmp(&visible_data(mesh, ids[b as usize]))
        });
        let points = |ids: &[u32]| -> Vec<Vec3> {
            ids.iter()
                .flat_map(|&t| corners(t as usize))
                .flatten()
                .collect()
        };
        Self {
            center,
            scale,
            unscale: 1.0 / scale,
            bounds,
            sphere: enclosing_sphere(points(&ids).iter().copied()),
            clusters: tree
                .parts(MAX_CLUSTERS)
                .iter()
                .filter_map(|part| enclosing_sphere(points(part).iter().copied()))
                .collect(),
            tree,
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
        let (origin, limit, skipped) = self.localize(ray, t_max)?;
        let local = LocalRay::new(origin, ray.direction.into());
        let (triangle, hit) = self.tree.closest(&local, limit, accept)?;
        Some(self.globalize(triangle, hit, skipped))
    }

    /// Whether any triangle with `0 < t <= t_max` is taken by `accept(triangle, u, v)`.
    #[inline]
    pub fn occluded(&self, ray: &Ray, t_max: f32, accept: impl Fn(u32, f32, f32) -> bool) -> bool {
        let Some((origin, limit, _)) = self.localize(ray, t_max) else {
            return false;
        };
        let local = LocalRay::new(origin, ray.direction.into());
        self.tree.occluded(&local, limit, accept)
    }

    /// A hit in world units.
    #[inline(always)]
    fn globalize(&self, triangle: u32, hit: TriangleHit, skipped: f64) -> Hit {
        Hit {
            t: ((hit.t as f64 + skipped) * self.unscale) as f32,
            triangle,
            u: hit.u,
            v: hit.v,
            back_face: hit.back_face,
        }
    }

    /// Origin and largest distance of the ray in the tree's coordinates, and how far along it
    /// that origin lies; `None` if nothing can be hit.
    #[inline(always)]
    fn localize(&self, ray: &Ray, t_max: f32) -> Option<(Vec3A, f32, f64)> {
        let exact = (ray.origin.as_dvec3() - self.center) * self.scale;
        let limit = t_max as f64 * self.scale;
        let origin = exact.as_vec3a();
        // Comparisons with NaN, wherever it came from, fail.
        if origin.abs().cmple(Vec3A::splat(FAR as f32)).all() && limit >= 0.0 {
            return Some((origin, limit as f32, 0.0));
        }
        move_up(exact, ray.direction.as_dvec3(), limit)
    }

    /// The point of `hit`, which must come from this BVH and `mesh` be what it was built from.
    #[inline]
    pub fn surface_point(&self, mesh: &TriangleMesh, hit: &Hit) -> HitPoint {
        let vertices = mesh.indices[hit.triangle as usize].map(|i| mesh.positions[i as usize]);
        let position = interpolate(vertices, hit.u, hit.v).as_vec3();
        // Half an ulp a component for the rounding of the position, and as much for vertices
        // and ray origin relative to the BVH's centre, whose coordinates are at most
        // 1 / scale: sqrt(3) (|p| 2^-24 + 2 * 2^-24 / scale), rounded up.
        let error = f32::EPSILON * (position.abs().max_element() + 2.0 * self.unscale as f32);
        HitPoint {
            position,
            geometric_normal: geometric_normal(vertices),
            error,
        }
    }
}

/// All that a ray can learn of a triangle: its material, and the bits of each corner's position,
/// colour and texture coordinates, whichever corner comes first.
fn visible_data(mesh: &TriangleMesh, triangle: u32) -> (u32, [[u32; 11]; 3]) {
    let corners = mesh.indices[triangle as usize].map(|i| {
        let i = i as usize;
        let [color, uv0, uv1] = [
            mesh.colors.get(i).map_or([1.0; 4], |c| c.to_array()),
            mesh.uvs[0]
                .get(i)
                .map_or([0.0; 4], |uv| [uv.x, uv.y, 0.0, 0.0]),
            mesh.uvs[1]
                .get(i)
                .map_or([0.0; 4], |uv| [uv.x, uv.y, 0.0, 0.0]),
        ];
        let p = mesh.positions[i];
        let all = [
            p.x, p.y, p.z, color[0], color[1], color[2], color[3], uv0[0], uv0[1], uv1[0], uv1[1],
        ];
        // The sum makes one zero of both.
        all.map(|v| (v + 0.0).to_bits())
    });
    let [a, b, c] = corners;
    let turned = [[a, b, c], [b, c, a], [c, a, b]].into_iter().min();
    let material = mesh.materials.get(triangle as usize).copied();
    (material.unwrap_or(0), turned.unwrap_or(corners))
}

/// [`Bvh::localize`] for origins so far from the mesh that f32 would round them by more than its
/// details: starts nearer.
#[cold]
fn move_up(origin: DVec3, direction: DVec3, limit: f64) -> Option<(Vec3A, f32, f64)> {
    let closest = -origin.dot(direction) / direction.length_squared();
    let skipped = (closest - 0.5 * FAR).max(0.0);
    let origin = (origin + direction * skipped).as_vec3a();
    let limit = limit - skipped;
    // The mesh lies within sqrt(3) of the centre: what is still far leads away or passes at
    // a distance of sqrt(FAR^2 - FAR^2 / 4) > sqrt(3). NaN is not near.
    let near = origin.abs().cmple(Vec3A::splat(FAR as f32)).all();
    (near && limit >= 0.0).then_some((origin, limit as f32, skipped))
}

#[cfg(test)]
mod tests;
