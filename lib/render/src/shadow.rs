//! The shadow ratio: light that reaches the proxy with the object, over light without it.
//!
//! On a plane with nothing but the object above it the denominator is a closed-form sum over the
//! light, the same for every pixel. The numerator is that sum minus what the object blocks, so
//! only directions inside the object's bounding cone are sampled, in proportion to
//! luminance times cosine *within the cone*: pixels whose cone holds no light, or too little to
//! matter, are known without a ray, and an achromatic estimate lies in [0, 1] by construction.
//! A proxy mesh that shadows itself has no closed form: numerator and denominator are estimated
//! over the same samples, whose errors cancel in the ratio.
//!
//! Light that the object sends to the proxy (emitted or reflected) is optional and is added to the
//! numerator.
use dipir_light::plane::{LightInCone, PlaneLight};
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::Sampler;
use dipir_numerics::warp::{
    Frame, balance_heuristic, cone_pdf, cosine_hemisphere_pdf, square_to_cone,
    square_to_cosine_hemisphere,
};
use dipir_scene::surfaces::SeenSurfaces;
use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::blocker::{Blocker, Cone};
use crate::contribution::Carried;
use crate::counters::{RayCounts, RayKind};
use crate::features::{ALPHA, TRANSMISSION, has};
use crate::foreground::{Gather, MIN_CAUSTIC_ROUGHNESS, PathContext, PathStart};
use crate::light::PathLight;
use crate::world::{ProxyGeometry, ProxyPoint};

mod surfaces;

pub use self::surfaces::LightDirections;

/// Which light of the object counts on the proxy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightOnProxy {
    /// Light that the object emits.
    pub emission: bool,
    /// Light that the object reflects or lets pass.
    pub bounce: bool,
}

/// What a shadow kernel needs beside the scene.
pub struct ShadowContext<'a, L, P> {
    /// Object, light and depth; also traces the light that the object sends to the proxy.
    pub path: PathContext<'a, L>,
    /// Where the object is.
    pub blocker: &'a Blocker,
    /// The parts of the plane's light; empty for a proxy mesh.
    pub plane: &'a [P],
    /// Luminance of the plane's irradiance without the object.
    pub irradiance: f64,
    /// What of the photograph beside the proxy catches shadows.
    pub seen_surfaces: Option<&'a SeenSurfaces>,
    /// Whether a proxy mesh shadows itself.
    pub proxy_occlusion: bool,
    /// Light of the object on the proxy, if it counts.
    pub light_on_proxy: Option<LightOnProxy>,
    /// Where the object can block at most this share of the plane's light, nothing is sampled.
    pub tolerance: f32,
}

impl<L, P> Clone for ShadowContext<'_, L, P> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<L, P> Copy for ShadowContext<'_, L, P> {}

/// Sums over the samples of one pixel, from which the ratio follows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ShadowSums {
    /// Light that is missing because of the object, minus what it adds.
    pub blocked: Vec3,
    /// Light without the object; unused on planes, whose sum is known.
    pub arriving: Vec3,
    /// Samples that meet the proxy.
    pub hits: f32,
    /// What the object adds, which `blocked` holds with it.
    pub sent: Carried,
}

/// What becomes of the samples of a pixel on the proxy: sums, or a record of where the light came
/// from. One loop serves both, so that they cannot drift.
pub trait ShadowGather: Default {
    /// Follows a path of light that the object sends to the proxy.
    type Path: Gather + Default;
    /// A sample meets the proxy.
    fn hit(&mut self);
    /// Radiance times cosine over density, from the unit vector `direction`, that arrives without
    /// the object; only told on proxy meshes.
    fn arriving(&mut self, direction: Vec3, light: Vec3);
    /// As much light from `direction` is blocked.
    fn blocked(&mut self, direction: Vec3, light: Vec3);
    /// The object sends the light of `path` to the proxy; times `weight`, it is irradiance.
    fn sent(&mut self, path: Self::Path, weight: f32);
}

impl ShadowGather for ShadowSums {
    type Path = Carried;

    #[inline(always)]
    fn hit(&mut self) {
        self.hits += 1.0;
    }

    #[inline(always)]
    fn arriving(&mut self, _: Vec3, light: Vec3) {
        self.arriving += light;
    }

    #[inline(always)]
    fn blocked(&mut self, _: Vec3, light: Vec3) {
        self.blocked += light;
    }

    #[inline(always)]
    fn sent(&mut self, path: Carried, weight: f32) {
        self.blocked -= path.sum * weight;
        self.sent.add(&path, weight);
    }
}

/// The ratio from sums over `samples` samples, `arriving` being the light per sample that meets
/// the proxy, if known. Samples beside the proxy count as unshadowed, and so does every channel in
/// which no light arrives at all.
pub fn ratio(sums: &ShadowSums, samples: f32, arriving: Option<Vec3>) -> Vec3 {
    if samples <= 0.0 {
        return Vec3::ONE;
    }
    let channel = |blocked: f32, arriving: f32, share: f32| {
        if arriving > 0.0 {
            (1.0 - share * (blocked / arriving)).max(0.0)
        } else {
            1.0
        }
    };
    let (arriving, share) = match arriving {
        Some(e) => (e * samples, 1.0),
        None => (sums.arriving, sums.hits / samples),
    };
    Vec3::new(
        channel(sums.blocked.x, arriving.x, share),
        channel(sums.blocked.y, arriving.y, share),
        channel(sums.blocked.z, arriving.z, share),
    )
}

/// A block of at most `2^n x 2^n` pixels may share a cone that its extent on the plane widens by
/// at most this share of the object's radius: wider cones waste samples, more cones waste time.
const MAX_REACH: f32 = 0.15;

/// A rectangle of pixels: first column and row, width and height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// The samples that a call adds to every pixel: sequence key and index range.
#[derive(Clone, Copy, Debug)]
pub struct SampleRange {
    /// Samples `first..first + count` of the sequence.
    pub first: u32,
    /// How many.
    pub count: u32,
}

impl<'p, L: PathLight, P: PlaneLight> ShadowContext<'p, L, P> {
    /// What is asked of surfaces: of those that light cannot pass, blocking alone asks nothing but their coverage.
    pub fn features(&self) -> u32 {
        let mask = self.path.world.mask;
        match self.light_on_proxy.is_some() || has(mask, TRANSMISSION) {
            true => mask,
            false => mask & ALPHA,
        }
    }

    /// Gathers `samples` samples of every pixel of `block` on a plane. `sampler(x, y)` is the
    /// pixel's sequence; `add(x, y, gathered)` takes what one pixel's new samples found.
    pub fn plane_block<const F: u32, G: ShadowGather>(
        &self,
        block: Block,
        samples: SampleRange,
        sampler: &impl Fn(u32, u32) -> Sampler,
        cones: &mut [P::Cone<'p>],
        counts: &mut RayCounts,
        add: &mut dyn FnMut(u32, u32, G),
    ) {
        let single = block.width == 1 && block.height == 1;
        let corners = self.corners_on_plane(block);
        if let Some((center, reach)) = corners {
            let cone = self.blocker.cone(center, reach);
            if !self.restrict(cones, &cone) {
                return;
            }
            if single || reach <= MAX_REACH * self.blocker.radius() {
                for y in block.y..block.y + block.height {
                    for x in block.x..block.x + block.width {
                        let base = sampler(x, y);
                        let found = self.plane_pixel::<F, G>(
                            (x, y),
                            samples,
                            &base,
                            Some(&cone),
                            cones,
                            counts,
                        );
                        add(x, y, found);
                    }
                }
                return;
            }
        }
        if single {
            // The pixel straddles the horizon: no footprint, so every sample has its own cone.
            let base = sampler(block.x, block.y);
            let found =
                self.plane_pixel::<F, G>((block.x, block.y), samples, &base, None, cones, counts);
            add(block.x, block.y, found);
            return;
        }
        if corners.is_none() && self.is_above_horizon(block) {
            return;
        }
        for part in quarters(block) {
            self.plane_block::<F, G>(part, samples, sampler, cones, counts, add);
        }
    }

    /// Whether any pixel of `block` could be shadowed noticeably, or receive light of the object.
    pub fn may_shade(&self, block: Block, cones: &mut [P::Cone<'p>]) -> bool {
        match self.corners_on_plane(block) {
            // Light of the object may arrive from any distance.
            Some(_) if self.light_on_proxy.is_some() => true,
            Some((center, reach)) => self.restrict(cones, &self.blocker.cone(center, reach)),
            None => !self.is_above_horizon(block),
        }
    }

    /// Gathers the light that is blocked in `samples` samples of the pixel `(x, y)`.
    fn plane_pixel<const F: u32, G: ShadowGather>(
        &self,
        (x, y): (u32, u32),
        samples: SampleRange,
        base: &Sampler,
        cone: Option<&Cone>,
        cones: &mut [P::Cone<'p>],
        counts: &mut RayCounts,
    ) -> G {
        let world = self.path.world;
        let corner = Vec2::new(x as f32, y as f32);
        let mut gather = G::default();
        for index in samples.first..samples.first + samples.count {
            let mut sampler = base.with_sample(index);
            let pixel = corner + sampler.next_2d();
            if self.surface_at(pixel, &mut sampler).is_some() {
                continue;
            }
            let Some(point) = world.proxy_point(&world.camera().ray(pixel)) else {
                continue;
            };
            let own;
            let cone = match cone {
                Some(cone) => cone,
                None => {
                    own = self.blocker.cone(point.position, 0.0);
                    self.restrict(cones, &own);
                    &own
                }
            };
            for part in cones.iter() {
                let light = part.sample(sampler.next_2d());
                let alpha_key = sampler.next_u64();
                if light.weight != Vec3::ZERO {
                    counts.add(RayKind::Shadow);
                    let passing = world.passing::<F>(&point.ray(light.direction), alpha_key);
                    if passing != Vec3::ONE {
                        gather.blocked(light.direction, light.weight * (Vec3::ONE - passing));
                    }
                }
            }
            if self.light_on_proxy.is_some() {
                self.light_sent::<F, G>(&point, cone, false, &mut sampler, counts, &mut gather);
            }
        }
        gather
    }

    /// Gathers `samples` samples of the pixel `(x, y)` on a proxy mesh, or on surfaces beside the proxy.
    ///
    /// Half of the directions come from the light, half from the cosine; both ratio parts use all
    /// of them with the balance heuristic's weights.
    pub fn mesh_pixel<const F: u32, G: ShadowGather>(
        &self,
        (x, y): (u32, u32),
        samples: SampleRange,
        base: &Sampler,
        counts: &mut RayCounts,
    ) -> G {
        let world = self.path.world;
        let mut gather = G::default();
        let corner = Vec2::new(x as f32, y as f32);
        for index in samples.first..samples.first + samples.count {
            let mut sampler = base.with_sample(index);
            let pixel = corner + sampler.next_2d();
            let (light_numbers, cosine_numbers) = (sampler.next_2d(), sampler.next_2d());
            counts.add(RayKind::Proxy);
            let surface = self.surface_at(pixel, &mut sampler);
            let hiding = match &world.geometry.proxy {
                ProxyGeometry::Mesh { bvh, .. } if self.proxy_occlusion && surface.is_none() => {
                    Some(bvh)
                }
                _ => None,
            };
            let of_proxy = || world.proxy_point(&world.camera().ray(pixel));
            let Some(point) = surface.or_else(of_proxy) else {
                continue;
            };
            gather.hit();
            let cone = self.blocker.cone(point.position, 0.0);
            let alpha_key = sampler.next_u64();
            for technique in 0..2 {
                let (direction, weight) =
                    self.light_at(&point, technique, light_numbers, cosine_numbers);
                if weight == Vec3::ZERO {
                    continue;
                }
                let ray = point.ray(direction);
                if let Some(bvh) = hiding {
                    counts.add(RayKind::ProxyOcclusion);
                    if bvh.occluded(&ray, f32::INFINITY, |_, _, _| true) {
                        continue;
                    }
                }
                gather.arriving(direction, weight);
                if direction.dot(cone.axis) < cone.cos_half_angle {
                    continue;
                }
                counts.add(RayKind::Shadow);
                let passing = world.passing::<F>(&ray, alpha_key);
                if passing != Vec3::ONE {
                    gather.blocked(direction, weight * (Vec3::ONE - passing));
                }
            }
            if self.light_on_proxy.is_some() {
                let hidden = hiding.is_some();
                self.light_sent::<F, G>(&point, &cone, hidden, &mut sampler, counts, &mut gather);
            }
        }
        gather
    }

    /// A direction drawn from the light (`technique` 0) or the cosine (1), with its share of
    /// radiance times cosine over density.
    fn light_at(
        &self,
        point: &ProxyPoint,
        technique: u32,
        light_numbers: Vec2,
        cosine_numbers: Vec2,
    ) -> (Vec3, Vec3) {
        let (direction, radiance, light_pdf) = if technique == 0 {
            let s = self.path.light.sample(light_numbers);
            (s.direction, s.radiance, s.pdf)
        } else {
            let direction = Frame::from_normal(point.normal)
                .to_world(square_to_cosine_hemisphere(cosine_numbers));
            let (radiance, pdf) = self.path.light.eval_with_pdf(direction);
            (direction, radiance, pdf)
        };
        let cosine = direction.dot(point.normal);
        let cosine_pdf = cosine_hemisphere_pdf(cosine);
        let (own, other) = match technique {
            0 => (light_pdf, cosine_pdf),
            _ => (cosine_pdf, light_pdf),
        };
        if !(own > 0.0 && cosine > 0.0) {
            return (direction, Vec3::ZERO);
        }
        let weight = balance_heuristic(own, other) / own;
        (direction, radiance * (cosine * weight))
    }

    /// Gathers the light that the object sends to `point`: one path through a uniform direction of
    /// the cone; far from the object only with some chance, and a larger weight. With `hidden` a proxy mesh may be in between.
    fn light_sent<const F: u32, G: ShadowGather>(
        &self,
        point: &ProxyPoint,
        cone: &Cone,
        hidden: bool,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
        gather: &mut G,
    ) {
        let Some(sent) = self.light_on_proxy else {
            return;
        };
        let chance = chance_of_sent_light(cone.cos_half_angle);
        if sampler.next_1d() >= chance {
            return;
        }
        let local = square_to_cone(sampler.next_2d(), cone.cos_half_angle);
        let direction = Frame::from_normal(cone.axis).to_world(local);
        let cosine = direction.dot(point.normal);
        if cosine <= 0.0 {
            return;
        }
        counts.add(RayKind::LightOnProxy);
        let path = PathContext {
            max_depth: if sent.bounce { self.path.max_depth } else { 0 },
            start: PathStart::Proxy {
                emission: sent.emission,
                hidden,
            },
            photo: None,
            min_roughness: MIN_CAUSTIC_ROUGHNESS,
            guide: None,
            ..self.path
        };
        let alpha_key = hash_u64s(&[sampler.next_u64(), 1]);
        let mut found = G::Path::default();
        path.trace::<F, _>(
            &point.ray(direction),
            alpha_key,
            sampler,
            counts,
            &mut found,
        );
        gather.sent(found, cosine / (chance * cone_pdf(cone.cos_half_angle)));
    }

    /// Restricts the parts of the light to `cone`, and says whether noticeable light is left.
    fn restrict(&self, cones: &mut [P::Cone<'p>], cone: &Cone) -> bool {
        let mut mass = 0.0;
        for part in cones {
            part.restrict(cone.axis, cone.cos_half_angle);
            mass += part.mass();
        }
        mass > f64::from(self.tolerance) * self.irradiance || self.light_on_proxy.is_some()
    }

    /// A point of the plane and how far from it the corners of `block` land there; `None` unless
    /// all four do.
    fn corners_on_plane(&self, block: Block) -> Option<(Vec3, f32)> {
        let world = self.path.world;
        let (x0, y0) = (block.x as f32, block.y as f32);
        let (x1, y1) = (x0 + block.width as f32, y0 + block.height as f32);
        let corners = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)];
        let mut points = [Vec3::ZERO; 4];
        for (p, (x, y)) in points.iter_mut().zip(corners) {
            *p = world
                .proxy_point(&world.camera().ray(Vec2::new(x, y)))?
                .position;
        }
        // The block's image on the plane is the convex hull of its corners'.
        let center = 0.25 * (points[0] + points[1] + points[2] + points[3]);
        let reach = points.iter().fold(0f32, |r, p| r.max(p.distance(center)));
        (reach.is_finite()).then_some((center, reach * (1.0 + 1e-6)))
    }

    /// Whether no ray through `block` meets the plane. A plane's horizon is a straight line in
    /// the image, so no corner below it means no pixel below it.
    fn is_above_horizon(&self, block: Block) -> bool {
        let world = self.path.world;
        let (x0, y0) = (block.x as f32, block.y as f32);
        let (x1, y1) = (x0 + block.width as f32, y0 + block.height as f32);
        [(x0, y0), (x1, y0), (x0, y1), (x1, y1)]
            .into_iter()
            .all(|(x, y)| {
                world
                    .proxy_point(&world.camera().ray(Vec2::new(x, y)))
                    .is_none()
            })
    }
}

/// Chance that a sample traces a path of light that the object sends through a cone. For an object as bright
/// as the plane, the irradiance from the cone is at most its solid angle over pi times the plane's.
/// Where that is little, fewer paths are traced, with larger weights: one path adds at most one part in
/// [`PATHS_OF_SENT_LIGHT`] of the plane's light.
fn chance_of_sent_light(cos_half_angle: f32) -> f32 {
    (2.0 * PATHS_OF_SENT_LIGHT * (1.0 - cos_half_angle)).min(1.0)
}

/// Paths of light from the object, times the share of a plane's light that they can bring at most.
const PATHS_OF_SENT_LIGHT: f32 = 8.0;

/// Splits a block in halves along its sides longer than one pixel.
fn quarters(block: Block) -> impl Iterator<Item = Block> {
    let halves = |first: u32, length: u32| {
        let half = length / 2;
        [(first, half), (first + half, length - half)]
    };
    let rows = halves(block.y, block.height);
    let columns = halves(block.x, block.width);
    rows.into_iter().flat_map(move |(y, height)| {
        columns
            .into_iter()
            .filter(move |&(_, width)| width > 0 && height > 0)
            .map(move |(x, width)| Block {
                x,
                y,
                width,
                height,
            })
    })
}

#[cfg(test)]
mod tests;
