//! The photograph as a light: what rays that leave the object see of the proxy.
use dipir_imaging::raster::LinearImage;
use dipir_scene::camera::{Camera, Ray};
use glam::Vec3;

use crate::counters::{RayCounts, RayKind};
use crate::world::World;

/// The photograph projected onto the proxy.
///
/// A point of the proxy is assumed to look the same from everywhere (Lambertian), and the same with
/// the object as without it: its colour in the photograph is its radiance, on the photograph's own
/// scale. The object's shadow on it is not subtracted.
#[derive(Clone, Copy)]
pub struct ProxyPhoto<'a> {
    /// Linear radiance, of the camera's size.
    pub image: &'a LinearImage,
}

impl ProxyPhoto<'_> {
    /// The photograph's colour where `ray` meets the proxy; `None` where it meets none of it or a
    /// part that the photograph does not show.
    #[inline]
    pub fn seen_along(&self, world: &World, ray: &Ray, counts: &mut RayCounts) -> Option<Vec3> {
        counts.add(RayKind::ProxyRadiance);
        let point = world.proxy_point(ray)?;
        self.at(world.camera(), point.position)
    }

    fn at(&self, camera: &Camera, point: Vec3) -> Option<Vec3> {
        let p = camera.project(point)?.floor();
        let [width, height] = camera.resolution.map(|n| n as f32);
        let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height;
        inside.then(|| *self.image.0.get(p.x as usize, p.y as usize))
    }
}
