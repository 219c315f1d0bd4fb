//! Depth, normal, albedo and coverage of every pixel.
use dipir_imaging::error::ImagingError;
use dipir_imaging::layer_rows::LayerRows;
use dipir_imaging::layers::Precision;
use dipir_imaging::raster::Raster;
use dipir_numerics::sampler::{Sampler, Stream};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::error::RenderError;
use crate::features::{EVERYTHING, with_features};
use crate::footprint::Footprint;
use crate::render::Renderer;
use crate::world::World;

/// Geometry and albedo as the camera sees them: 36 bytes a pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct GBuffer {
    /// Distance along the optical axis to the nearest surface, object before proxy, metres;
    /// infinite where there is none. Not averaged: edges keep the nearest of their samples.
    pub depth: Raster<f32>,
    /// Unit shading normal of the object, else normal of the proxy, world space; 0 where neither.
    pub normal: Raster<Vec3>,
    /// Base colour of the object, linear, not premultiplied; 0 where there is none.
    pub albedo: Raster<Vec3>,
    /// Antialiased coverage of the object.
    pub object_alpha: Raster<f32>,
    /// Antialiased coverage of the proxy, whether the object hides it or not.
    pub proxy_alpha: Raster<f32>,
}

/// Samples per pixel: coverage in steps of a sixteenth. Fewer where rays are slow ([`affordable_share`]).
///
/// [`affordable_share`]: dipir_scene::bvh::Bvh::affordable_share
const SAMPLES: u32 = 16;
/// Samples after which a pixel of the proxy alone is done, if they all hit it or all miss it.
const FIRST_SAMPLES: u32 = 4;

#[derive(Clone, Copy)]
struct Pixel {
    depth: f32,
    normal: Vec3,
    albedo: Vec3,
    object: f32,
    proxy: f32,
}

impl GBuffer {
    /// Of the scene of `renderer`, textures included.
    pub fn new(renderer: &Renderer, seed: u64) -> Result<Self, RenderError> {
        let world = renderer.world(EVERYTHING)?;
        let [width, height] = world.camera().resolution;
        let bvh = &world.geometry.bvh;
        let footprint = Footprint::new(world.camera(), bvh.bounds(), bvh.clusters());
        let size = (width as usize, height as usize);
        let samples = (SAMPLES as f32 * bvh.affordable_share()).ceil() as u32;
        let mut all = Self {
            depth: Raster::filled(size.0, size.1, f32::INFINITY),
            normal: Raster::filled(size.0, size.1, Vec3::ZERO),
            albedo: Raster::filled(size.0, size.1, Vec3::ZERO),
            object_alpha: Raster::filled(size.0, size.1, 0.0),
            proxy_alpha: Raster::filled(size.0, size.1, 0.0),
        };
        let rows = all.depth.pixels_mut().par_chunks_mut(size.0);
        let rows = rows.zip(all.normal.pixels_mut().par_chunks_mut(size.0));
        let rows = rows.zip(all.albedo.pixels_mut().par_chunks_mut(size.0));
        let rows = rows.zip(all.object_alpha.pixels_mut().par_chunks_mut(size.0));
        let rows = rows.zip(all.proxy_alpha.pixels_mut().par_chunks_mut(size.0));
        rows.enumerate()
            .for_each(|(y, ((((depth, normal), albedo), object), proxy))| {
                for x in 0..size.0 {
                    let at = (x as u32, y as u32);
                    let held = footprint.holds(at.0, at.1);
                    let seen = with_features!(world.mask, F => pixel::<F>(&world, at, held, (seed, samples)));
                    depth[x] = seen.depth;
                    normal[x] = seen.normal;
                    albedo[x] = seen.albedo;
                    object[x] = seen.object;
                    proxy[x] = seen.proxy;
                }
            });
        Ok(all)
    }

    /// As the channels `depth.Z normal.X/Y/Z albedo.R/G/B object.A proxy.A`; depth in full
    /// precision, the rest in half.
    pub fn to_rows(&self) -> Result<LayerRows<'_>, ImagingError> {
        let (normal, albedo) = (self.normal.pixels(), self.albedo.pixels());
        let mut rows = LayerRows::new(self.depth.width(), self.depth.height());
        let half = Precision::Half;
        rows.insert("depth.Z", Precision::Full, &self.depth)?;
        rows.insert_pixels(["normal.X", "normal.Y", "normal.Z"], half, |i| normal[i])?;
        rows.insert_pixels(["albedo.R", "albedo.G", "albedo.B"], half, |i| albedo[i])?;
        rows.insert("object.A", half, &self.object_alpha)?;
        rows.insert("proxy.A", half, &self.proxy_alpha)?;
        Ok(rows)
    }
}

fn pixel<const F: u32>(
    world: &World,
    (x, y): (u32, u32),
    object: bool,
    (seed, samples): (u64, u32),
) -> Pixel {
    let camera = world.camera();
    let axis = -camera.rotation.z_axis;
    let corner = Vec2::new(x as f32, y as f32);
    let (mut object_depth, mut proxy_depth) = (f32::INFINITY, f32::INFINITY);
    let (mut object_normal, mut proxy_normal) = (Vec3::ZERO, Vec3::ZERO);
    let (mut albedo, mut object_hits, mut proxy_hits) = (Vec3::ZERO, 0.0, 0.0);
    let mut taken = 0;
    for sample in 0..samples {
        let agree = proxy_hits == 0.0 || proxy_hits == taken as f32;
        if !object && taken == FIRST_SAMPLES && agree {
            break;
        }
        taken += 1;
        let mut sampler = Sampler::new(seed, Stream::FOREGROUND, (y << 16) | (x & 0xffff), sample);
        let ray = camera.ray(corner + sampler.next_2d());
        if let Some(point) = world.proxy_point(&ray) {
            proxy_hits += 1.0;
            proxy_normal += point.normal;
            proxy_depth = proxy_depth.min((point.position - ray.origin).dot(axis));
        }
        let hit = match object {
            true => world.closest::<F>(&ray, sampler.next_u64()),
            false => None,
        };
        if let Some(hit) = hit {
            let surface = world
                .surfaces
                .interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
            object_hits += 1.0;
            object_normal += surface.normal;
            albedo += surface.base_color;
            object_depth = object_depth.min((surface.position - ray.origin).dot(axis));
        }
    }
    let seen = object_hits > 0.0;
    Pixel {
        depth: if seen { object_depth } else { proxy_depth },
        normal: if seen { object_normal } else { proxy_normal }.normalize_or_zero(),
        albedo: if seen {
            albedo / object_hits
        } else {
            Vec3::ZERO
        },
        object: object_hits / taken as f32,
        proxy: proxy_hits / taken as f32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes::icosphere;
    use crate::testing::{camera, ground, matte, scene};

    #[test]
    fn the_ground_covers_what_lies_below_the_horizon() {
        let ball = icosphere(Vec3::new(0.0, 0.2, 0.0), 0.2, 2);
        let view = camera(
            Vec3::new(0.0, 1.0, 4.0),
            Vec3::new(0.0, 0.83, 0.0),
            40.0,
            24,
        );
        let far = view.position + Vec3::NEG_Z * 1e6;
        let horizon = view.project(far).expect("is ahead").y;
        let s = scene(ball, matte(Vec3::splat(0.5)), view, ground());
        let buffer = GBuffer::new(&Renderer::new(&s), 0).expect("sizes fit");
        let rows = (0..buffer.proxy_alpha.height()).map(|y| buffer.proxy_alpha.row(y));
        for (y, row) in rows.enumerate() {
            let wanted = (y as f32 + 1.0 - horizon).clamp(0.0, 1.0);
            let mean = row.iter().sum::<f32>() / row.len() as f32;
            // On the horizon the first samples alone shift the mean by up to .06, and the deviation of 24 means of 16
            // is .025.
            let tolerance = if wanted.fract() == 0.0 {
                0.0
            } else {
                0.06 + 4.0 * 0.025
            };
            assert!(
                (mean - wanted).abs() <= tolerance,
                "row {y}: {mean}, {wanted}"
            );
        }
        let ground = buffer.depth.row(23)[0];
        let other = buffer.depth.row(23)[23];
        assert!(ground.is_finite() && (ground / other - 1.0).abs() < 0.1);
    }
}
