//! The object under a distant light, by unidirectional path tracing.
//!
//! Computes, for one image sample, the radiance that reaches the camera from the object after at
//! most D interactions with it, and whether the sample meets the object at all; their averages
//! over the pixel's square (a box filter, which is what the over-compositing of coverage means)
//! are premultiplied colour and antialiased alpha. Light comes from two techniques at every
//! vertex, the light's own sampling and the BSDF's, combined by the balance heuristic [Veach and
//! Guibas 1995]; mirror-like lobes belong to the BSDF alone.
//!
//! Light that the object reflects onto the proxy is blurred where the object is polished
//! ([`MIN_CAUSTIC_ROUGHNESS`]).
//!
//! What it cannot do: caustics from light through rough glass onto the object converge slowly, as
//! in every unidirectional path tracer; refracted rays see the distant light, not the photograph.
use dipir_imaging::raster::LinearImage;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::Sampler;
use dipir_numerics::warp::balance_heuristic;
use dipir_scene::bvh::Hit;
use dipir_scene::camera::Ray;
use glam::{Vec2, Vec3};

use crate::bsdf::features::{EMISSION, EXTENSIONS, TRANSMISSION, has};
use crate::bsdf::{Bsdf, BsdfSample};
use crate::contribution::Carried;
use crate::counters::{RayCounts, RayKind};
use crate::features::PROXY_RADIANCE;
use crate::guide::PathGuide;
use crate::light::PathLight;
use crate::photo::ProxyPhoto;
use crate::render::Simulation;
use crate::surface::{SurfacePoint, Surfaces};
use crate::world::{Filling, World, is_sheet};

/// Where paths begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathStart {
    /// At the camera: everything is seen.
    Camera,
    /// On the proxy: unlit surfaces send no light there.
    Proxy {
        /// Whether light counts that the object emits and sends straight to the proxy.
        emission: bool,
        /// Whether a proxy mesh hides the object from itself.
        hidden: bool,
    },
}

/// What a path tracer needs beside the scene.
pub struct PathContext<'a, L> {
    /// Object, surfaces, proxy.
    pub world: &'a World<'a>,
    /// Where light comes from.
    pub light: &'a L,
    /// What the proxy looks like to rays that leave the object.
    pub photo: Option<ProxyPhoto<'a>>,
    /// Most interactions with the object, D; 0 leaves emission alone.
    pub max_depth: u32,
    /// Where paths begin, which decides what emission they see.
    pub start: PathStart,
    /// Interactions after which Russian roulette may end a path.
    pub roulette_depth: u32,
    /// Surfaces count as at least this rough; 0 leaves them as they are.
    pub min_roughness: f32,
    /// The same, but only for light that reaches them from where the light is sampled: a small source is then met by
    /// many paths, and shown blurred.
    pub min_lit_roughness: f32,
    /// Whether surfaces that a path meets after a wide reflection count as at least as rough as `BLURRED`.
    pub blur_caustics: bool,
    /// What is known of where light comes from by way of the object.
    pub guide: Option<&'a PathGuide>,
}

/// Interactions after which Russian roulette may end a path. Earlier, the rays that it saves
/// are outweighed by its variance: most paths of opaque objects have left by then.
const ROULETTE_DEPTH: u32 = 4;

impl<'a, L> PathContext<'a, L> {
    /// Paths from the camera; `background` is the photograph, which the proxy looks like where that is simulated.
    pub fn from_camera(
        world: &'a World<'a>,
        light: &'a L,
        simulation: &Simulation,
        background: Option<&'a LinearImage>,
    ) -> Self {
        Self {
            world,
            light,
            photo: background
                .filter(|_| has(simulation.features, PROXY_RADIANCE))
                .map(|image| ProxyPhoto { image }),
            max_depth: simulation.max_depth,
            start: PathStart::Camera,
            roulette_depth: ROULETTE_DEPTH,
            min_roughness: 0.0,
            min_lit_roughness: 0.0,
            blur_caustics: false,
            guide: None,
        }
    }
}

impl<L> Clone for PathContext<'_, L> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<L> Copy for PathContext<'_, L> {}

/// One image sample of the object.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PathSample {
    /// Radiance, linear; 0 where the object is missed.
    pub radiance: Vec3,
    /// 1 where the object is met, else 0.
    pub coverage: f32,
}

/// What becomes of the light that paths find: a pixel's sum, or a record of where it came from.
/// One loop serves both, so that they cannot drift.
pub trait Gather {
    /// Light of `radiance` from the unit vector `direction`, infinitely far away, that arrives
    /// with `throughput * weight`.
    fn distant(&mut self, direction: Vec3, throughput: Vec3, radiance: Vec3, weight: f32);
    /// Radiance that arrives from the scene itself: emission, unlit surfaces, the photograph.
    fn local(&mut self, radiance: Vec3);

    /// Whether a vertex that returns no light is of interest, for its derivative may not be 0.
    const DERIVATIVES: bool = false;

    /// The light that is reported next has met the object so often.
    #[inline(always)]
    fn after(&mut self, _interactions: u32) {}

    /// What the photograph shows, `seen`, that arrives with `throughput * weight`; `light` is the radiance of the light
    /// behind it.
    #[inline(always)]
    fn photographed(&mut self, throughput: Vec3, seen: Vec3, _light: Vec3, weight: f32) {
        self.local(throughput * seen * weight);
    }

    /// What the surface at `vertex` emits arrives with `throughput`.
    #[inline(always)]
    fn emitted<const F: u32>(&mut self, vertex: &Vertex, throughput: Vec3) {
        let surface = vertex.surface;
        self.local(match surface.unlit {
            true => throughput * surface.base_color,
            false => throughput * surface.emission,
        });
    }

    /// The light that is reported next was sampled at `vertex`: it arrives from `wi` there, by
    /// way of `throughput`, and is scattered by `value`.
    #[inline(always)]
    fn lit<const F: u32>(
        &mut self,
        _bsdf: &Bsdf<F>,
        _vertex: &Vertex,
        _throughput: Vec3,
        _wi: Vec3,
        _value: Vec3,
    ) {
    }

    /// The path, which came to `vertex` with `throughput`, goes on along `sample`, drawn with the
    /// number `u_lobe`.
    #[inline(always)]
    fn scattered<const F: u32>(
        &mut self,
        _bsdf: &Bsdf<F>,
        _vertex: &Vertex,
        _throughput: Vec3,
        _u_lobe: f32,
        _sample: &BsdfSample,
    ) {
    }

    /// The path survived Russian roulette, and its throughput grows by `scale`.
    #[inline(always)]
    fn survived(&mut self, _scale: f32) {}
}

/// Where a path meets the object.
#[derive(Clone, Copy)]
pub struct Vertex<'a> {
    /// All surfaces.
    pub surfaces: &'a Surfaces<'a>,
    /// Unit vector along the path.
    pub direction: Vec3,
    /// What is met.
    pub hit: &'a Hit,
    /// And its material there.
    pub surface: &'a SurfacePoint,
}

impl Gather for Vec3 {
    #[inline(always)]
    fn distant(&mut self, _: Vec3, throughput: Vec3, radiance: Vec3, weight: f32) {
        *self += throughput * radiance * weight;
    }

    #[inline(always)]
    fn local(&mut self, radiance: Vec3) {
        *self += radiance;
    }
}

/// Dimension pairs per vertex: light, lobe, direction, roulette.
const DIMENSIONS_PER_VERTEX: u32 = 4;

/// [`PathContext::min_roughness`] of paths that begin on the proxy. A light of half a degree that
/// a polished surface reflects onto the ground is found by one path in thousands, which leaves
/// specks; blurred by a lobe whose peak is no more than a few times a diffuse surface's, the same
/// energy arrives without them. Known as path regularisation [Kaplanyan and Dachsbacher 2013].
pub const MIN_CAUSTIC_ROUGHNESS: f32 = 0.6;

/// Density per steradian of a reflection below which it is wide: a matt surface reflects with at most `1 / pi`.
const WIDE: f32 = 0.5;

/// Least roughness of what a path meets after a wide reflection, where caustics are blurred. One path in thousands finds the
/// sun in a coat that lights a matt surface. At this roughness a lobe is half as wide as a matt one (alpha of .25 and .5).
const BLURRED: f32 = 0.5;

/// Paths keep at least this chance of going on, so that survivors' weights stay bounded.
const MIN_SURVIVAL: f32 = 0.1;

impl<L: PathLight> PathContext<'_, L> {
    /// One path through the pixel whose top left corner is `corner`, in pixels.
    #[inline]
    pub fn camera_sample<const F: u32>(
        &self,
        corner: Vec2,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
    ) -> PathSample {
        self.image_sample::<F>(corner + sampler.next_2d(), sampler, counts)
    }

    /// Like [`camera_sample`](Self::camera_sample), with the light going to `gather`; returns the
    /// coverage.
    #[inline]
    pub fn camera_trace<const F: u32, G: Gather>(
        &self,
        corner: Vec2,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
        gather: &mut G,
    ) -> f32 {
        let point = corner + sampler.next_2d();
        self.trace_from_image::<F, G>(point, sampler, counts, gather)
            .0
    }

    /// One path through `point` of the image plane, in pixels; draws from the sampler's current
    /// dimension on.
    #[inline]
    pub fn image_sample<const F: u32>(
        &self,
        point: Vec2,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
    ) -> PathSample {
        let mut found = Carried::default();
        let (coverage, _) = self.trace_from_image::<F, _>(point, sampler, counts, &mut found);
        PathSample {
            radiance: found.sum,
            coverage,
        }
    }

    /// Coverage, and the share of the light that gets from there to the camera: 1, but by way of polished ground.
    #[inline]
    pub(crate) fn trace_from_image<const F: u32, G: Gather>(
        &self,
        point: Vec2,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
        gather: &mut G,
    ) -> (f32, f32) {
        let mut ray = self.world.view_ray(point, sampler);
        let mut share = 1.0;
        if let Some(ground) = &self.world.polished {
            let Some(mirrored) = ground.gloss.ray(self.world, &ray, sampler.next_2d()) else {
                return (0.0, 0.0);
            };
            (ray, share) = mirrored;
        }
        let alpha_key = sampler.next_u64();
        counts.add(RayKind::Camera);
        let seen = self.trace_share::<F, G>(&ray, share, alpha_key, sampler, counts, gather);
        (seen, share)
    }

    /// Radiance along `ray` from the object. Draws from the sampler's current dimension on.
    pub fn radiance<const F: u32>(
        &self,
        ray: &Ray,
        alpha_key: u64,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
    ) -> PathSample {
        let mut radiance = Vec3::ZERO;
        let coverage = self.trace::<F, _>(ray, alpha_key, sampler, counts, &mut radiance);
        PathSample { radiance, coverage }
    }

    /// Like [`radiance`](Self::radiance), with the light going to `gather`; returns the coverage.
    pub fn trace<const F: u32, G: Gather>(
        &self,
        ray: &Ray,
        alpha_key: u64,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
        gather: &mut G,
    ) -> f32 {
        self.trace_share::<F, G>(ray, 1.0, alpha_key, sampler, counts, gather)
    }

    /// [`trace`](Self::trace), with this share of the light.
    #[inline(always)]
    fn trace_share<const F: u32, G: Gather>(
        &self,
        ray: &Ray,
        share: f32,
        alpha_key: u64,
        sampler: &mut Sampler,
        counts: &mut RayCounts,
        gather: &mut G,
    ) -> f32 {
        let world = self.world;
        // Loop state.
        let mut ray = *ray; //                       the segment that is traced next
        let mut throughput = Vec3::splat(share); //  product of BSDF weights so far
        let mut sampled_pdf = f32::INFINITY; //      density of the segment's direction, infinite
        //                                           if the light could not have drawn it
        let mut leaves = false; //                   the segment is known to miss the object
        let mut filling = Filling::NONE; //          what the segment runs through
        let mut least_roughness = self.min_roughness; // that the next surfaces count as having
        // The path has met sheets alone: the shadow ray counts the light behind them.
        let mut straight = has(F, TRANSMISSION) && self.start != PathStart::Camera;
        let first_dimension = sampler.dimension();
        let emits = has(F, EMISSION) && has(world.mask, EMISSION);

        for depth in 0..=self.max_depth {
            let alpha_key = hash_u64s(&[alpha_key, u64::from(depth)]);

            // ---- Next hit -------------------------------------------------------------------
            if depth > 0 && !leaves {
                counts.add(RayKind::Bounce);
            }
            if depth == self.max_depth && depth > 0 && !leaves && !emits {
                // Nothing at the last hit could add light: any hit will do.
                leaves = true;
                if world.hides_light::<F>(&ray, alpha_key) {
                    break;
                }
            }
            let hit = match leaves {
                true => None,
                false => world.closest::<F>(&ray, alpha_key),
            };

            // ---- Escape: the light, as found by BSDF sampling -------------------------------
            if has(F, EXTENSIONS) {
                throughput *= world.left_on_way(&mut filling, &ray, hit.as_ref());
            }
            if let (0, PathStart::Proxy { hidden: true, .. }, Some(hit)) = (depth, self.start, &hit)
                && world.proxy_hides(&ray, hit.t, counts)
            {
                return 0.0;
            }
            let Some(hit) = hit else {
                if depth == 0 {
                    return 0.0;
                }
                if straight {
                    break;
                }
                let (light, light_pdf) = self.light.eval_with_pdf(ray.direction);
                let weight = balance_heuristic(sampled_pdf, light_pdf);
                gather.after(depth);
                match self.photo_beyond::<F>(&ray, counts) {
                    Some(seen) => gather.photographed(throughput, seen, light, weight),
                    None => gather.distant(ray.direction, throughput, light, weight),
                }
                break;
            };

            // ---- Emission -------------------------------------------------------------------
            let mut surface =
                world
                    .surfaces
                    .interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
            straight = straight && is_sheet(&surface);
            surface.roughness = surface.roughness.max(least_roughness);
            surface.coat.roughness = surface.coat.roughness.max(least_roughness);
            let vertex = Vertex {
                surfaces: &world.surfaces,
                direction: ray.direction,
                hit: &hit,
                surface: &surface,
            };
            if has(F, EMISSION) {
                gather.after(depth);
                if surface.unlit {
                    if depth > 0 || self.start == PathStart::Camera {
                        gather.emitted::<F>(&vertex, throughput);
                    }
                    break;
                }
                let unseen = matches!(
                    self.start,
                    PathStart::Proxy {
                        emission: false,
                        ..
                    }
                );
                if depth > 0 || !unseen {
                    gather.emitted::<F>(&vertex, throughput);
                }
            }
            if depth == self.max_depth {
                break;
            }
            let bsdf = Bsdf::<F>::new(&surface, -ray.direction);
            let blurred = (self.min_lit_roughness > 0.0).then(|| {
                let mut surface = surface;
                surface.roughness = surface.roughness.max(self.min_lit_roughness);
                surface.coat.roughness = surface.coat.roughness.max(self.min_lit_roughness);
                Bsdf::<F>::new(&surface, -ray.direction)
            });
            let lit = blurred.as_ref().unwrap_or(&bsdf);
            sampler.set_dimension(first_dimension + depth * DIMENSIONS_PER_VERTEX);
            let light_numbers = sampler.next_2d();
            let lobe_number = sampler.next_1d();
            let direction_numbers = sampler.next_2d();

            let cones = match self.guide {
                Some(guide) if depth + 1 < self.max_depth && !bsdf.is_delta() => {
                    guide.cones(&surface, -ray.direction)
                }
                _ => None,
            };

            // ---- Light sampling -------------------------------------------------------------
            if !lit.is_delta() {
                let light = self.light.sample(light_numbers);
                let (mut value, mut bsdf_pdf) = lit.eval_pdf(light.direction);
                if let Some(cones) = &cones {
                    bsdf_pdf = cones.mixed(light.direction, bsdf_pdf);
                }
                if has(F, EXTENSIONS) {
                    value *= filling.left_by_sheet(&surface, light.direction);
                }
                // Both densities may underflow to 0: then there is no such sample.
                let returns = value != Vec3::ZERO || G::DERIVATIVES;
                let behind = light.direction.dot(surface.geometric_normal) < 0.0;
                let returns = returns && !(straight && behind);
                if light.pdf > 0.0 && returns && light.radiance != Vec3::ZERO {
                    let shadow = world.leave(&surface, light.direction);
                    let known = world.escapes && is_outward(&surface, light.direction);
                    if !known {
                        counts.add(RayKind::Light);
                    }
                    if known || !world.hides_light::<F>(&shadow, !alpha_key) {
                        let weight = balance_heuristic(light.pdf, bsdf_pdf) / light.pdf;
                        let arriving = throughput * value;
                        gather.lit(lit, &vertex, throughput, light.direction, value);
                        gather.after(depth + 1);
                        match self.photo_beyond::<F>(&shadow, counts) {
                            Some(seen) => {
                                gather.photographed(arriving, seen, light.radiance, weight);
                            }
                            None => {
                                gather.distant(light.direction, arriving, light.radiance, weight);
                            }
                        }
                    }
                }
            }

            // ---- BSDF sampling --------------------------------------------------------------
            let drawn = match &cones {
                Some(cones) => cones.sample(&bsdf, lobe_number, direction_numbers),
                None => bsdf.sample(lobe_number, direction_numbers),
            };
            let Some(mut sample) = drawn else {
                break;
            };
            if self.blur_caustics && sample.pdf < WIDE {
                least_roughness = least_roughness.max(BLURRED);
            }
            if let Some(cones) = &cones {
                cones.weigh(&mut sample);
            }
            gather.scattered(&bsdf, &vertex, throughput, lobe_number, &sample);
            straight = straight && sample.transmitted;
            throughput *= sample.weight;
            if throughput.max_element() <= 0.0 {
                break;
            }
            sampled_pdf = match &blurred {
                Some(blurred) => blurred.eval_pdf(sample.wi).1,
                None if sample.delta => f32::INFINITY,
                None => sample.pdf,
            };
            if has(F, EXTENSIONS) && sample.transmitted {
                let material = world.surfaces.material_index(hit.triangle);
                throughput *= filling.pass(&surface, material);
            }
            leaves = world.escapes && is_outward(&surface, sample.wi);
            ray = world.leave(&surface, sample.wi);

            // ---- Russian roulette: only where a dim path would go on for many segments ------
            if depth + 1 >= self.roulette_depth && !leaves {
                let survival = throughput.max_element().clamp(MIN_SURVIVAL, 1.0);
                if sampler.next_1d() >= survival {
                    break;
                }
                throughput /= survival;
                gather.survived(1.0 / survival);
            }
        }
        1.0
    }

    /// What the photograph shows along a ray that is known to miss the object; `None` where it
    /// meets the light instead.
    #[inline(always)]
    fn photo_beyond<const F: u32>(&self, ray: &Ray, counts: &mut RayCounts) -> Option<Vec3> {
        if !has(F, PROXY_RADIANCE) {
            return None;
        }
        self.photo?.seen_along(self.world, ray, counts)
    }
}

/// Whether `direction` leaves `surface` on the outer side of its triangle.
#[inline(always)]
fn is_outward(surface: &crate::surface::SurfacePoint, direction: Vec3) -> bool {
    surface.front_face && direction.dot(surface.geometric_normal) > 0.0
}

#[cfg(test)]
mod tests;
