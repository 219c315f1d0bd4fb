//! What rays meet: the object, its surfaces, and the proxy.
use std::cell::RefCell;
use std::sync::Arc;

use dipir_numerics::hashing::mix64;
use dipir_numerics::sampler::Sampler;
use dipir_scene::bvh::{Bvh, Hit, Sphere};
use dipir_scene::camera::{Camera, Ray};
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::ray_offset::spawn_origin;
use dipir_scene::scene::Scene;
use glam::{Vec2, Vec3};

use crate::bsdf::Bsdf;
use crate::bsdf::features::{ALPHA, EXTENSIONS, SPECULAR, TRANSMISSION, has};
use crate::convexity::is_convex;
use crate::counters::{RayCounts, RayKind};
use crate::error::RenderError;
use crate::gloss::Polished;
use crate::optics::Optics;
use crate::surface::{ExtensionPoint, SurfacePoint, Surfaces};

/// The proxy, ready for rays.
pub enum ProxyGeometry {
    /// Nothing catches a shadow.
    None,
    /// An infinite plane with a unit normal.
    Plane(Plane),
    /// A mesh that may shadow itself.
    Mesh {
        /// Its triangles.
        mesh: TriangleMesh,
        /// Their hierarchy.
        bvh: Box<Bvh>,
    },
}

/// A point on the proxy as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProxyPoint {
    /// World space, metres.
    pub position: Vec3,
    /// Unit normal on the side of the camera.
    pub normal: Vec3,
    /// Bound on the distance of `position` from the surface, metres.
    pub error: f32,
}

/// Shapes and hierarchies of a scene: what does not depend on the effects that are on.
pub struct Geometry {
    /// Hierarchy over the object.
    pub bvh: Bvh,
    /// The proxy.
    pub proxy: ProxyGeometry,
    /// Largest extent of the object, metres.
    pub extent: f32,
    /// The object is one closed convex surface: no ray that leaves it outwards meets it again.
    pub convex: bool,
}

impl Geometry {
    /// Builds the hierarchies.
    pub fn new(scene: &Scene) -> Self {
        let proxy = match &scene.proxy {
            Proxy::None => ProxyGeometry::None,
            Proxy::Plane(plane) => match plane.normal.try_normalize() {
                Some(normal) => ProxyGeometry::Plane(Plane { normal, ..*plane }),
                None => ProxyGeometry::None,
            },
            Proxy::Mesh(mesh) => ProxyGeometry::Mesh {
                bvh: Box::new(Bvh::build(mesh)),
                mesh: mesh.clone(),
            },
        };
        let bvh = Bvh::build(&scene.mesh);
        Self {
            extent: bvh.bounds().map_or(0.0, |b| (b.max - b.min).max_element()),
            bvh,
            proxy,
            convex: is_convex(&scene.mesh),
        }
    }
}

impl Geometry {
    /// Whether no part of the object rises above `plane`, on whose other side it blocks nothing.
    pub fn is_below(&self, plane: &Plane) -> bool {
        let Some(bounds) = self.bvh.bounds() else {
            return true;
        };
        // The corner of the bounding box that lies farthest along the normal.
        let top = Vec3::select(plane.normal.cmpgt(Vec3::ZERO), bounds.max, bounds.min);
        (top - plane.point).dot(plane.normal) <= 0.0
    }
}

/// What a path runs through since it entered the object by a front face.
#[derive(Clone, Copy)]
pub(crate) struct Filling {
    /// Per metre; 0 outside the object, and where it is clear.
    attenuation: Vec3,
    /// Metres, which count if there is no inner side.
    thickness: f32,
    /// Index into [`Scene::materials`].
    material: u32,
}

impl Filling {
    /// Outside the object.
    pub const NONE: Self = Self {
        attenuation: Vec3::ZERO,
        thickness: 0.0,
        material: 0,
    };

    /// What an open sheet at `surface` leaves of light from `direction` on its other side.
    #[inline]
    pub fn left_by_sheet(&self, surface: &SurfacePoint, direction: Vec3) -> Vec3 {
        let ExtensionPoint {
            attenuation,
            thickness,
            ..
        } = surface.extension;
        let behind = direction.dot(surface.geometric_normal) < 0.0;
        match behind && (surface.front_face || self.attenuation == Vec3::ZERO) {
            true => ExtensionPoint::left_after(attenuation, thickness),
            false => Vec3::ONE,
        }
    }

    /// The path passes `surface`, of `material`, to its other side. Returns what that leaves of its light where it
    /// comes to a back face from outside: the back of an open sheet.
    #[inline]
    pub fn pass(&mut self, surface: &SurfacePoint, material: u32) -> Vec3 {
        let ExtensionPoint {
            attenuation,
            thickness,
            ..
        } = surface.extension;
        let was_outside = self.attenuation == Vec3::ZERO;
        *self = Self::NONE;
        if surface.front_face {
            *self = Self {
                attenuation,
                thickness,
                material,
            };
            return Vec3::ONE;
        }
        match was_outside {
            true => ExtensionPoint::left_after(attenuation, thickness),
            false => Vec3::ONE,
        }
    }
}

/// A scene made ready for the effects of one plan.
pub struct World<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// The camera that renders.
    pub camera: Camera,
    /// Shapes and hierarchies.
    pub geometry: Arc<Geometry>,
    /// Materials and textures, stripped of what the plan leaves out.
    pub surfaces: Surfaces<'a>,
    /// The effects that `surfaces` was prepared for ([`crate::features`]).
    pub mask: u32,
    /// What blurs what the camera sees.
    pub(crate) optics: Optics,
    /// Rays from the camera go on from this ground.
    pub(crate) polished: Option<Polished>,
    /// No ray that leaves the object outwards meets it again, and none passes through.
    pub escapes: bool,
}

impl<'a> World<'a> {
    /// Prepares `scene` for the effects in `mask`, and for the extensions of its materials where it
    /// has any and `mask` has [`SPECULAR`]; decodes only the textures that they need.
    pub fn new(
        scene: &'a Scene,
        camera: Camera,
        geometry: Arc<Geometry>,
        mask: u32,
    ) -> Result<Self, RenderError> {
        let extended = scene.materials.iter().any(|m| !m.extensions.is_empty());
        let mask = match has(mask, SPECULAR) && extended {
            true => mask | EXTENSIONS,
            false => mask,
        };
        Self::without_extensions(scene, camera, geometry, mask)
    }

    /// Prepares `scene` for the effects in `mask` alone.
    pub(crate) fn without_extensions(
        scene: &'a Scene,
        camera: Camera,
        geometry: Arc<Geometry>,
        mask: u32,
    ) -> Result<Self, RenderError> {
        let surfaces = Surfaces::new(scene, mask)?;
        let transmits = scene.materials.iter().any(|m| m.transmission.is_some());
        let holes = (0..scene.mesh.indices.len() as u32).any(|t| surfaces.has_alpha(t));
        let opens = has(mask, ALPHA) && holes || has(mask, TRANSMISSION) && transmits;
        Ok(Self {
            scene,
            camera,
            escapes: geometry.convex && !opens,
            geometry,
            surfaces,
            mask,
            optics: Optics::default(),
            polished: None,
        })
    }

    /// The camera that renders.
    #[inline]
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The ray from the camera through the image position `pixel`; [`Optics`] that blur draw numbers.
    #[inline]
    pub(crate) fn view_ray(&self, pixel: Vec2, sampler: &mut Sampler) -> Ray {
        match self.optics.is_sharp() {
            true => self.camera.ray(pixel),
            false => self.optics.ray(&self.camera, pixel, sampler),
        }
    }

    /// The ray that leaves the object at `surface` towards `direction`.
    #[inline]
    pub fn leave(&self, surface: &SurfacePoint, direction: Vec3) -> Ray {
        // Rounding of the position, and of vertices relative to the hierarchy's centre, whose
        // unit is at most twice half the extent; see `Bvh::surface_point`.
        let error =
            f32::EPSILON * (surface.position.abs().max_element() + 2.0 * self.geometry.extent);
        Ray {
            origin: spawn_origin(surface.position, surface.geometric_normal, direction, error),
            direction,
        }
    }

    /// A ball around the object; `None` without triangles.
    pub fn bounding_sphere(&self) -> Option<Sphere> {
        self.geometry.bvh.bounding_sphere()
    }

    /// Nearest surface along a camera ray or a path. Back faces of single-sided surfaces are
    /// not there, and covered surfaces are by chance, keyed by `alpha_key`.
    #[inline]
    pub fn closest<const F: u32>(&self, ray: &Ray, alpha_key: u64) -> Option<Hit> {
        self.geometry.bvh.closest(ray, f32::INFINITY, |t, u, v| {
            self.is_seen(ray, t) && self.is_covered::<F>(t, u, v, alpha_key)
        })
    }

    /// Whether the object hides the light in the direction of a ray that leaves the object.
    #[inline]
    pub fn hides_light<const F: u32>(&self, ray: &Ray, alpha_key: u64) -> bool {
        self.geometry.bvh.occluded(ray, f32::INFINITY, |t, u, v| {
            self.is_seen(ray, t) && self.is_covered::<F>(t, u, v, alpha_key)
        })
    }

    /// Share of the light along `ray` that reaches the proxy past the object: [sheets](is_sheet) let some of it pass
    /// straight, all else hides it. Back faces do.
    #[inline]
    pub fn passing<const F: u32>(&self, ray: &Ray, alpha_key: u64) -> Vec3 {
        let sheets = has(F, TRANSMISSION) && has(self.mask, TRANSMISSION);
        let hidden = self.geometry.bvh.occluded(ray, f32::INFINITY, |t, u, v| {
            !(sheets && self.surfaces.transmits(t)) && self.is_covered::<F>(t, u, v, alpha_key)
        });
        match (hidden, sheets) {
            (true, _) => Vec3::ZERO,
            (false, false) => Vec3::ONE,
            (false, true) => self.through_sheets::<F>(ray, alpha_key),
        }
    }

    /// What the sheets that `ray` meets let pass.
    fn through_sheets<const F: u32>(&self, ray: &Ray, alpha_key: u64) -> Vec3 {
        let (mut ray, mut left) = (*ray, Vec3::ONE);
        let mut filling = Filling::NONE;
        for _ in 0..MOST_SHEETS {
            let hit = self.geometry.bvh.closest(&ray, f32::INFINITY, |t, u, v| {
                self.is_covered::<F>(t, u, v, alpha_key)
            });
            if has(F, EXTENSIONS) {
                left *= self.left_on_way(&mut filling, &ray, hit.as_ref());
            }
            let Some(hit) = hit else {
                return left;
            };
            let Hit { triangle, u, v, .. } = hit;
            let surface = self.surfaces.interact::<F>(ray.direction, triangle, u, v);
            if !is_sheet(&surface) {
                return Vec3::ZERO;
            }
            left *= Bsdf::<F>::new(&surface, -ray.direction).passing();
            if has(F, EXTENSIONS) {
                left *= filling.pass(&surface, self.surfaces.material_index(triangle));
            }
            if left.max_element() < LEAST_PASSING {
                break;
            }
            ray = self.leave(&surface, ray.direction);
        }
        Vec3::ZERO
    }

    /// What is left of the light on the segment `ray` up to `hit`. `filling` is emptied where the segment
    /// turns out not to run inside: the sheet before it was open.
    #[inline]
    pub(crate) fn left_on_way(&self, filling: &mut Filling, ray: &Ray, hit: Option<&Hit>) -> Vec3 {
        if filling.attenuation == Vec3::ZERO {
            return Vec3::ONE;
        }
        let way = hit.filter(|hit| self.is_inside(filling, ray, hit));
        let Filling {
            attenuation,
            thickness,
            ..
        } = *filling;
        if way.is_none() {
            *filling = Filling::NONE;
        }
        ExtensionPoint::left_after(attenuation, way.map_or(thickness, |hit| hit.t))
    }

    /// Whether the segment `ray`, which entered the object before, ends at an inner side, or at something inside: then
    /// it goes out of the same material once more often than into it.
    fn is_inside(&self, filling: &Filling, ray: &Ray, hit: &Hit) -> bool {
        let surfaces = &self.surfaces;
        let leads_out = |t| ray.direction.dot(surfaces.geometric_normal(t)) > 0.0;
        if surfaces.transmits(hit.triangle) && leads_out(hit.triangle) {
            return true;
        }
        let crossed = RefCell::new(Vec::new());
        self.geometry.bvh.occluded(ray, f32::INFINITY, |t, _, _| {
            if surfaces.material_index(t) == filling.material {
                crossed.borrow_mut().push(t);
            }
            false
        });
        // Traversal may ask twice.
        let mut crossed = crossed.into_inner();
        crossed.sort_unstable();
        crossed.dedup();
        let out = crossed.iter().filter(|&&t| leads_out(t)).count();
        2 * out > crossed.len()
    }

    #[inline(always)]
    fn is_seen(&self, ray: &Ray, triangle: u32) -> bool {
        !self.surfaces.single_sided(triangle)
            || ray.direction.dot(self.surfaces.geometric_normal(triangle)) <= 0.0
    }

    #[inline(always)]
    fn is_covered<const F: u32>(&self, triangle: u32, u: f32, v: f32, key: u64) -> bool {
        if !has(F, ALPHA) || !self.surfaces.has_alpha(triangle) {
            return true;
        }
        // A hash of the triangle, not a running number: traversal may ask twice, in any order.
        let chance = (mix64(key ^ u64::from(triangle)) >> 40) as f32 * (1.0 / 16_777_216.0);
        chance < self.surfaces.coverage::<F>(triangle, u, v)
    }

    /// Whether a proxy mesh lies on `ray` within `distance` metres.
    #[inline]
    pub(crate) fn proxy_hides(&self, ray: &Ray, distance: f32, counts: &mut RayCounts) -> bool {
        let ProxyGeometry::Mesh { bvh, .. } = &self.geometry.proxy else {
            return false;
        };
        counts.add(RayKind::ProxyOcclusion);
        bvh.occluded(ray, distance, |_, _, _| true)
    }

    /// Where `ray`, from the camera, meets the side of the proxy that is seen.
    #[inline]
    pub fn proxy_point(&self, ray: &Ray) -> Option<ProxyPoint> {
        match &self.geometry.proxy {
            ProxyGeometry::None => None,
            ProxyGeometry::Plane(plane) => plane_point(plane, ray),
            ProxyGeometry::Mesh { mesh, bvh } => {
                let hit = bvh.closest(ray, f32::INFINITY, |_, _, _| true)?;
                let point = bvh.surface_point(mesh, &hit);
                let side = -point.geometric_normal.dot(ray.direction).signum();
                Some(ProxyPoint {
                    position: point.position,
                    normal: point.geometric_normal * side,
                    error: point.error,
                })
            }
        }
    }
}

/// Whether light passes a surface nearly straight. Light that meets such surfaces alone on its way to the proxy is counted
/// along the shadow ray, and not by paths.
#[inline]
pub fn is_sheet(surface: &SurfacePoint) -> bool {
    surface.transmission > 0.0 && surface.roughness <= SHEET_ROUGHNESS
}

/// Roughness up to which a transmissive surface is a sheet: its lobe is a few degrees wide.
const SHEET_ROUGHNESS: f32 = 0.3;

/// Sheets behind one another that light passes.
const MOST_SHEETS: usize = 32;

/// What is left of the light below which it counts as hidden.
const LEAST_PASSING: f32 = 1e-4;

/// Where `ray` meets the front of `plane`; `None` for rays that run along it, away from it or
/// come from behind.
#[inline]
pub(crate) fn plane_point(plane: &Plane, ray: &Ray) -> Option<ProxyPoint> {
    let towards = -ray.direction.dot(plane.normal);
    let height = (ray.origin - plane.point).dot(plane.normal);
    if !(towards > 0.0 && height > 0.0) {
        return None;
    }
    let t = height / towards;
    let position = ray.origin + ray.direction * t;
    // A few ulp of the largest term in that sum. Beyond 1e30 m squares overflow.
    let scale = ray.origin.abs().max_element().max(t);
    (scale < 1e15).then_some(ProxyPoint {
        position,
        normal: plane.normal,
        error: 4.0 * f32::EPSILON * scale,
    })
}

impl ProxyPoint {
    /// The ray from this point towards `direction`.
    #[inline]
    pub fn ray(&self, direction: Vec3) -> Ray {
        Ray {
            origin: spawn_origin(self.position, self.normal, direction, self.error),
            direction,
        }
    }
}
