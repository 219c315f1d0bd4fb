//! How the photograph was taken, where that was not through a pinhole at one moment.
use dipir_imaging::raster::Raster;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::Sampler;
use dipir_scene::camera::{Camera, Ray};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::features::with_features;
use crate::footprint::Footprint;
use crate::lens::ThinLens;
use crate::render::{Renderer, Settings};
use crate::shutter::Shutter;
use crate::world::World;

/// What blurs things of the scene in the photograph.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Optics {
    /// What the camera looks through; `None` for a pinhole, to which everything is sharp.
    pub lens: Option<ThinLens>,
    /// How it moves while the picture is taken; `None` if it stands still.
    pub shutter: Option<Shutter>,
}

impl Optics {
    /// Whether nothing is blurred.
    pub fn is_sharp(&self) -> bool {
        self.lens.is_none() && self.shutter.is_none()
    }

    /// A ray through the image position `pixel`. A lens draws two numbers, a shutter one.
    #[inline]
    pub(crate) fn ray(&self, camera: &Camera, pixel: Vec2, sampler: &mut Sampler) -> Ray {
        let moved = self.shutter.map(|shutter| {
            let time = 2.0 * sampler.next_1d() - 1.0;
            shutter.camera(camera, time)
        });
        let camera = moved.as_ref().unwrap_or(camera);
        match &self.lens {
            Some(lens) => lens.ray(camera, pixel, sampler.next_2d()),
            None => camera.ray(pixel),
        }
    }

    /// The most that blur moves a point from `pixel`, which shows it at the distance `depth` along the optical axis, metres; pixels.
    pub(crate) fn reach_px(&self, camera: &Camera, pixel: Vec2, depth: f32) -> Vec2 {
        let disc = self.lens.map_or(Vec2::ZERO, |l| l.blur_px(camera, depth));
        let Some(shutter) = &self.shutter else {
            return disc;
        };
        let ends = shutter.ends_px(camera, pixel, depth);
        let line = ends.map(|end| end.map_or(Vec2::INFINITY, Vec2::abs));
        disc + line[0].max(line[1])
    }
}

impl Renderer<'_> {
    /// Blurs shadow ratios as `settings` say that the photograph is.
    pub(crate) fn blur_shadow(
        &self,
        shadow: &mut Raster<Vec3>,
        world: &World,
        settings: &Settings,
    ) {
        if settings.optics.is_sharp() {
            return;
        }
        let camera = self.camera();
        let depth = |x: usize, y: usize| {
            let pixel = Vec2::new(x as f32, y as f32) + 0.5;
            let surfaces = settings.seen_surfaces;
            if let Some(seen) = surfaces.and_then(|s| s.seen_at(camera, pixel)) {
                return Some(seen.depth);
            }
            let point = world.proxy_point(&camera.ray(pixel))?;
            Some(camera.depth(point.position))
        };
        let seen = beside(world, camera);
        if let Some(lens) = settings.optics.lens {
            *shadow = lens.blurred(camera, shadow, &seen, depth);
        }
        if let Some(shutter) = settings.optics.shutter {
            *shadow = shutter.blurred(camera, shadow, &seen, depth);
        }
    }
}

/// The share of each pixel of `camera` that no object covers, through a pinhole that stands still.
///
/// Ground that an object hides has a ratio, too. It must not count beside the object, where it is never seen.
fn beside(world: &World, camera: &Camera) -> Raster<f32> {
    let bvh = &world.geometry.bvh;
    let footprint = Footprint::new(camera, Optics::default(), bvh.bounds(), bvh.clusters());
    let [width, height] = camera.resolution.map(|n| n as usize);
    let is_hidden = |x: usize, y: usize, place: Vec2| {
        let ray = camera.ray(Vec2::new(x as f32, y as f32) + place);
        let key = hash_u64s(&[x as u64, y as u64]);
        with_features!(world.mask, F => world.closest::<F>(&ray, key).is_some())
    };
    let mut hidden = Raster::filled(width, height, false);
    let rows = hidden.pixels_mut().par_chunks_mut(width).enumerate();
    rows.for_each(|(y, row)| {
        for (x, hidden) in row.iter_mut().enumerate() {
            *hidden = footprint.holds(x as u32, y as u32) && is_hidden(x, y, Vec2::splat(0.5));
        }
    });
    let mut seen = Raster::filled(width, height, 1.0);
    let rows = seen.pixels_mut().par_chunks_mut(width).enumerate();
    rows.for_each(|(y, row)| {
        for (x, seen) in row.iter_mut().enumerate() {
            let own = *hidden.get(x, y);
            let around = |n: usize, end: usize| n.saturating_sub(1)..(n + 2).min(end);
            let mut others = around(y, height).flat_map(|v| around(x, width).map(move |u| (u, v)));
            *seen = match others.all(|(u, v)| *hidden.get(u, v) == own) {
                true => f32::from(u8::from(!own)),
                false => {
                    let quarters = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)];
                    let free = quarters
                        .iter()
                        .filter(|q| !is_hidden(x, y, Vec2::from(**q)));
                    0.25 * free.count() as f32
                }
            };
        }
    });
    seen
}

#[cfg(test)]
mod tests;
