//! How the photograph was taken, where that was not through a pinhole at one moment.
use dipir_imaging::raster::Raster;
use dipir_numerics::sampler::Sampler;
use dipir_scene::camera::{Camera, Ray};
use glam::{Vec2, Vec3};

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

    /// How far from `pixel` a point that it shows at this distance along the optical axis, metres, is seen at most, pixels.
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
        if let Some(lens) = settings.optics.lens {
            *shadow = lens.blurred(camera, shadow, depth);
        }
        if let Some(shutter) = settings.optics.shutter {
            *shadow = shutter.blurred(camera, shadow, depth);
        }
    }
}

#[cfg(test)]
mod tests;
