//! Shadows on surfaces that the photograph shows beside the proxy.
use std::f32::consts::PI;

use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::{balance_heuristic, square_to_sphere};
use glam::{Vec2, Vec3};

use super::{Block, ShadowContext};
use crate::light::PathLight;
use crate::world::ProxyPoint;

/// The light as a list of directions with weights: the light from a cone is the sum of the weights in it.
pub struct LightDirections(Vec<(Vec3, f32)>);

/// Directions drawn from the light, and as many from the whole sphere.
const DIRECTIONS: u32 = 1024;
/// About the angle between neighbouring directions of the sphere, radians.
const BETWEEN: f32 = 0.07;

impl LightDirections {
    /// Draws directions from `light`; a weight is the luminance that its direction stands for.
    pub fn new(light: &impl PathLight) -> Self {
        const UNIFORM: f32 = 1.0 / (4.0 * PI);
        let mut directions = Vec::new();
        for index in 0..DIRECTIONS {
            let mut sampler = Sampler::new(0, Stream::SHADOW, 0, index);
            let drawn = light.sample(sampler.next_2d());
            if drawn.pdf > 0.0 {
                let weight = balance_heuristic(drawn.pdf, UNIFORM) / drawn.pdf;
                directions.push((drawn.direction, luminance(drawn.radiance) * weight));
            }
            let direction = square_to_sphere(sampler.next_2d());
            let (radiance, pdf) = light.eval_with_pdf(direction);
            let weight = balance_heuristic(UNIFORM, pdf) / UNIFORM;
            directions.push((direction, luminance(radiance) * weight));
        }
        Self(directions)
    }
}

impl<L: PathLight, P> ShadowContext<'_, L, P> {
    /// The surface that a sample at `pixel` sees before the proxy.
    #[inline]
    pub(super) fn surface_at(&self, pixel: Vec2, sampler: &mut Sampler) -> Option<ProxyPoint> {
        let surfaces = self.seen_surfaces?;
        let camera = self.path.world.camera();
        let share = surfaces.share_at(camera, pixel);
        // Whole pixels draw no number: where no surface is seen, samples are the same as without surfaces.
        if share <= 0.0 || share < 1.0 && sampler.next_1d() >= share {
            return None;
        }
        let seen = surfaces.point_at(camera, pixel)?;
        let scale = seen.position.abs().max_element().max(seen.depth);
        Some(ProxyPoint {
            position: seen.position,
            normal: seen.normal,
            error: 4.0 * f32::EPSILON * scale,
        })
    }

    /// Whether `block` sees surfaces that the object could shadow noticeably or send light to.
    pub fn may_shade_surfaces(&self, block: Block, light: &LightDirections) -> bool {
        let Some(surfaces) = self.seen_surfaces else {
            return false;
        };
        let camera = self.path.world.camera();
        let (first, end) = (
            [block.x, block.y],
            [block.x + block.width, block.y + block.height],
        );
        if !surfaces.are_seen(first, end, camera.resolution) {
            return false;
        }
        let pixels = (block.y..block.y + block.height).flat_map(|y| {
            (block.x..block.x + block.width).map(move |x| Vec2::new(x as f32, y as f32) + 0.5)
        });
        let seen: Vec<_> = pixels
            .filter(|pixel| surfaces.share_at(camera, *pixel) > 0.0)
            .filter_map(|pixel| surfaces.point_at(camera, pixel))
            .collect();
        if seen.is_empty() {
            // Less than a pixel of them.
            return false;
        }
        let center = seen.iter().map(|s| s.position).sum::<Vec3>() / seen.len() as f32;
        let reach = seen
            .iter()
            .fold(0f32, |r, s| r.max(s.position.distance(center)));
        let cone = self.blocker.cone(center, reach);
        if let Some(sent) = self.light_on_proxy
            && (sent.emission || 2.0 * (1.0 - cone.cos_half_angle) > self.tolerance)
        {
            return true;
        }
        // Between the directions of the list, too.
        let least_cosine = (cone.cos_half_angle.clamp(-1.0, 1.0).acos() + BETWEEN)
            .min(PI)
            .cos();
        let in_cone = (light.0.iter()).filter(|(d, _)| d.dot(cone.axis) >= least_cosine);
        let blocked: f32 = in_cone.map(|(_, weight)| weight).sum();
        if blocked == 0.0 {
            return false;
        }
        let arriving = |normal: Vec3| -> f32 {
            (light.0.iter())
                .map(|(d, weight)| weight * d.dot(normal).max(0.0))
                .sum()
        };
        let least = (seen.iter().step_by(21))
            .map(|s| arriving(s.normal))
            .fold(f32::INFINITY, f32::min);
        blocked > self.tolerance * least
    }
}

#[cfg(test)]
mod tests;
