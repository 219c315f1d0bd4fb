//! A path tracer without any cleverness: independent random numbers, half of the directions uniform over the sphere and half
//! drawn from the BSDF, a fixed depth, no light sampling, no roulette. It shares with the renderer what rays meet, how surfaces
//! scatter and how bright the light is in a direction; nothing else.
use std::f32::consts::PI;

use dipir_imaging::raster::LinearImage;
use dipir_numerics::hashing::{hash_u64s, mix64};
use dipir_numerics::warp::{Frame, square_to_cosine_hemisphere, square_to_sphere};
use dipir_render::bsdf::Bsdf;
use dipir_render::bsdf::features::{ALL, EXTENSIONS};
use dipir_render::foreground::MIN_CAUSTIC_ROUGHNESS;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::world::{ProxyGeometry, World, is_sheet};
use dipir_scene::bvh::Hit;
use dipir_scene::camera::Ray;
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

/// All features: what a scene lacks finds nothing to do.
const F: u32 = ALL | EXTENSIONS;
/// Density of uniform directions, per steradian.
const UNIFORM: f32 = 0.25 / PI;

/// Samples of a mesh's shadow for each of a plane's.
const MESH_SAMPLES: u32 = 8;

/// Random numbers of one pixel.
pub struct Rng(u64);

impl Rng {
    /// A sequence of its own for every `key`.
    pub fn new(key: &[u64]) -> Self {
        Self(hash_u64s(key))
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix64(self.0)
    }

    /// In `[0, 1)`.
    pub fn next(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / 16_777_216.0
    }

    pub fn pair(&mut self) -> Vec2 {
        Vec2::new(self.next(), self.next())
    }

    pub fn colour(&mut self) -> Vec3 {
        Vec3::new(self.next(), self.next(), self.next())
    }
}

/// Mean of independent samples and the variance of that mean.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mean {
    pub mean: DVec3,
    pub variance: DVec3,
}

/// The layers of a picture, pixel by pixel.
pub struct Picture {
    pub object: Vec<Mean>,
    pub alpha: Vec<Mean>,
    /// Ratios without a bound at 0.
    pub shadow: Vec<Mean>,
}

#[derive(Default)]
struct Sums {
    sum: DVec3,
    squares: DVec3,
}

impl Sums {
    fn add(&mut self, x: Vec3) {
        let x = x.as_dvec3();
        self.sum += x;
        self.squares += x * x;
    }

    fn mean(&self, n: u32) -> Mean {
        let n = f64::from(n);
        let mean = self.sum / n;
        Mean {
            mean,
            variance: (self.squares / n - mean * mean).max(DVec3::ZERO) / (n - 1.0),
        }
    }
}

/// What is traced.
pub struct Tracer<'a> {
    world: World<'a>,
    light: &'a (dyn Fn(Vec3) -> Vec3 + Sync),
    photo: Option<&'a LinearImage>,
    simulation: Simulation,
}

/// Where a path begins.
#[derive(Clone, Copy, PartialEq)]
enum Start {
    Camera,
    Proxy,
}

impl<'a> Tracer<'a> {
    /// `photo` is what rays from the object see of the proxy.
    pub fn new(
        renderer: &Renderer<'a>,
        light: &'a (dyn Fn(Vec3) -> Vec3 + Sync),
        photo: Option<&'a LinearImage>,
        simulation: Simulation,
    ) -> Self {
        let world = renderer
            .world(simulation.features)
            .expect("textures are readable");
        Self {
            world,
            light,
            photo,
            simulation,
        }
    }

    /// All layers by `samples` samples in every pixel.
    pub fn picture(&self, samples: u32, seed: u64) -> Picture {
        let [width, height] = self.world.camera().resolution;
        let plane = match &self.world.geometry.proxy {
            ProxyGeometry::Plane(plane) => Some(irradiance(self.light, plane.normal)),
            _ => None,
        };
        let pixels = (0..width * height).into_par_iter().map(|pixel| {
            let corner = Vec2::new((pixel % width) as f32, (pixel / width) as f32);
            let mut rng = Rng::new(&[seed, u64::from(pixel)]);
            let (mut object, mut alpha) = (Sums::default(), Sums::default());
            for _ in 0..samples {
                let ray = self.world.camera().ray(corner + rng.pair());
                let seen = self.radiance(ray, Start::Camera, &mut rng);
                object.add(seen.unwrap_or(Vec3::ZERO));
                alpha.add(Vec3::splat(f32::from(seen.is_some())));
            }
            // A ratio of two estimates is off by one part in the number of samples that meet the light.
            let of_shadow = if plane.is_some() { 1 } else { MESH_SAMPLES } * samples;
            let shadow = self.shadow(corner, of_shadow, plane, &mut rng);
            (object.mean(samples), alpha.mean(samples), shadow)
        });
        let pixels: Vec<_> = pixels.collect();
        Picture {
            object: pixels.iter().map(|p| p.0).collect(),
            alpha: pixels.iter().map(|p| p.1).collect(),
            shadow: pixels.iter().map(|p| p.2).collect(),
        }
    }

    /// Radiance along `ray` from the object; `None` where it misses it.
    fn radiance(&self, mut ray: Ray, start: Start, rng: &mut Rng) -> Option<Vec3> {
        let world = &self.world;
        let sent = self.simulation.light_on_proxy;
        let depth = match (start, sent) {
            (Start::Proxy, Some(sent)) if !sent.bounce => 0,
            _ => self.simulation.max_depth,
        };
        let (mut sum, mut throughput) = (Vec3::ZERO, Vec3::ONE);
        // Light behind sheets alone reaches the proxy along the shadow ray.
        let mut straight = start == Start::Proxy;
        // What was entered by a front face: attenuation per metre, metres if there is no inner side, material.
        let mut inside: Option<(Vec3, f32, u32)> = None;
        let left =
            |attenuation: Vec3, way: f32| Vec3::from((attenuation * -way).to_array().map(f32::exp));
        for interactions in 0..=depth {
            let hit = world.closest::<F>(&ray, rng.bits());
            if let Some((attenuation, thickness, material)) = inside {
                let way = hit.filter(|hit| self.is_inside(&ray, hit, material));
                throughput *= left(attenuation, way.map_or(thickness, |hit| hit.t));
                inside = inside.filter(|_| way.is_some());
            }
            if let (0, Start::Proxy, Some(hit)) = (interactions, start, hit)
                && self.is_behind_proxy(&ray, hit.t)
            {
                return None;
            }
            let Some(hit) = hit else {
                if interactions == 0 {
                    return None;
                }
                if !straight {
                    sum += throughput * self.beyond(&ray, start);
                }
                break;
            };
            let surfaces = &world.surfaces;
            let mut surface = surfaces.interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
            straight &= is_sheet(&surface);
            if start == Start::Proxy {
                surface.roughness = surface.roughness.max(MIN_CAUSTIC_ROUGHNESS);
                surface.coat.roughness = surface.coat.roughness.max(MIN_CAUSTIC_ROUGHNESS);
            }
            if surface.unlit {
                if interactions > 0 || start == Start::Camera {
                    sum += throughput * surface.base_color;
                }
                break;
            }
            if interactions > 0 || start == Start::Camera || sent.is_some_and(|s| s.emission) {
                sum += throughput * surface.emission;
            }
            let bsdf = Bsdf::<F>::new(&surface, -ray.direction);
            let direction = match rng.next() < 0.5 {
                true => Some((square_to_sphere(rng.pair()), None)),
                false => bsdf
                    .sample(rng.next(), rng.pair())
                    .map(|s| (s.wi, s.delta.then_some(s.weight))),
            };
            let Some((wi, delta)) = direction else {
                break;
            };
            throughput *= match delta {
                Some(weight) => weight * 2.0,
                None => {
                    let (value, pdf) = bsdf.eval_pdf(wi);
                    value / (0.5 * (UNIFORM + pdf))
                }
            };
            if throughput == Vec3::ZERO {
                break;
            }
            let transmitted = wi.dot(surface.geometric_normal) < 0.0;
            straight &= transmitted;
            if transmitted {
                let (attenuation, thickness) =
                    (surface.extension.attenuation, surface.extension.thickness);
                if !surface.front_face && inside.is_none() {
                    throughput *= left(attenuation, thickness);
                }
                let entered = (
                    attenuation,
                    thickness,
                    surfaces.material_index(hit.triangle),
                );
                let fills = surface.front_face && attenuation != Vec3::ZERO;
                inside = fills.then_some(entered);
            }
            ray = world.leave(&surface, wi);
        }
        Some(sum)
    }

    /// Whether what `ray` meets after it entered `material` lies inside that: it leads out, or the ray goes out of the
    /// same material more often than into it.
    fn is_inside(&self, ray: &Ray, hit: &Hit, material: u32) -> bool {
        let surfaces = &self.world.surfaces;
        let leads_out = |t| surfaces.geometric_normal(t).dot(ray.direction) > 0.0;
        if surfaces.transmits(hit.triangle) && leads_out(hit.triangle) {
            return true;
        }
        let triangles = 0..self.world.scene.mesh.indices.len() as u32;
        let of_same = triangles.filter(|&t| surfaces.material_index(t) == material);
        let crossed = of_same.filter(|&t| {
            let corners = self.world.scene.mesh.indices[t as usize];
            let [a, b, c] = corners.map(|i| self.world.scene.mesh.positions[i as usize].as_dvec3());
            let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
            // Cramer's rule for origin + direction t = a + (b - a) u + (c - a) v.
            let (e1, e2) = (b - a, c - a);
            let p = direction.cross(e2);
            let (s, determinant) = (origin - a, e1.dot(p));
            let u = s.dot(p) / determinant;
            let q = s.cross(e1);
            let (v, t_hit) = (direction.dot(q) / determinant, e2.dot(q) / determinant);
            u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t_hit > 0.0
        });
        crossed
            .map(|t| if leads_out(t) { 1 } else { -1 })
            .sum::<i32>()
            > 0
    }

    /// Whether a proxy mesh lies on `ray` within `distance` metres.
    fn is_behind_proxy(&self, ray: &Ray, distance: f32) -> bool {
        match &self.world.geometry.proxy {
            ProxyGeometry::Mesh { bvh, .. } if self.simulation.proxy_occlusion => {
                bvh.occluded(ray, distance, |_, _, _| true)
            }
            _ => false,
        }
    }

    /// What a ray that misses the object sees.
    fn beyond(&self, ray: &Ray, start: Start) -> Vec3 {
        let seen = self
            .photo
            .filter(|_| start == Start::Camera)
            .and_then(|photo| {
                let point = self.world.proxy_point(ray)?;
                let pixel = self.world.camera().project(point.position)?.floor();
                let inside = pixel.cmpge(Vec2::ZERO).all()
                    && pixel.x < photo.0.width() as f32
                    && pixel.y < photo.0.height() as f32;
                inside.then(|| *photo.0.get(pixel.x as usize, pixel.y as usize))
            });
        seen.unwrap_or_else(|| (self.light)(ray.direction))
    }

    /// The shadow ratio of a pixel, from cosine-distributed directions; `plane` is the irradiance of a plane.
    fn shadow(&self, corner: Vec2, samples: u32, plane: Option<DVec3>, rng: &mut Rng) -> Mean {
        let world = &self.world;
        let mut lost = Sums::default();
        let (mut arriving, mut cross, mut hits) = (Sums::default(), DVec3::ZERO, 0.0);
        for _ in 0..samples {
            let view = world.camera().ray(corner + rng.pair());
            let Some(point) = world.proxy_point(&view).filter(|_| self.simulation.shadow) else {
                lost.add(Vec3::ZERO);
                continue;
            };
            hits += 1.0;
            let local = square_to_cosine_hemisphere(rng.pair());
            let direction = Frame::from_normal(point.normal).to_world(local);
            let ray = point.ray(direction);
            let hidden = match &world.geometry.proxy {
                ProxyGeometry::Mesh { bvh, .. } if self.simulation.proxy_occlusion => {
                    bvh.occluded(&ray, f32::INFINITY, |_, _, _| true)
                }
                _ => false,
            };
            let light = (self.light)(direction) * PI * f32::from(!hidden);
            let mut missing = light * (Vec3::ONE - world.passing::<F>(&ray, rng.bits()));
            if self.simulation.light_on_proxy.is_some() {
                let sent = self.radiance(ray, Start::Proxy, rng).unwrap_or(Vec3::ZERO);
                missing -= sent * PI;
            }
            lost.add(missing);
            arriving.add(light);
            cross += (missing * light).as_dvec3();
        }
        let n = f64::from(samples);
        let lost = lost.mean(samples);
        if let Some(plane) = plane {
            return Mean {
                mean: 1.0 - lost.mean / plane,
                variance: lost.variance / (plane * plane),
            };
        }
        // The variance of a ratio of correlated means, to first order.
        let arriving = arriving.mean(samples);
        if arriving.mean.min_element() <= 0.0 {
            return Mean {
                mean: DVec3::ONE,
                variance: DVec3::ZERO,
            };
        }
        let share = hits / n;
        let ratio = lost.mean / arriving.mean;
        let covariance = (cross / n - lost.mean * arriving.mean) / (n - 1.0);
        let variance = lost.variance + ratio * ratio * arriving.variance - 2.0 * ratio * covariance;
        Mean {
            mean: 1.0 - share * ratio,
            variance: variance.max(DVec3::ZERO) / (arriving.mean * arriving.mean),
        }
    }
}

/// Irradiance of a plane, by the midpoints of a fine grid.
fn irradiance(light: &dyn Fn(Vec3) -> Vec3, normal: Vec3) -> DVec3 {
    const N: u32 = 1024;
    let mut sum = DVec3::ZERO;
    for i in 0..N * N {
        let u = Vec2::new((i % N) as f32 + 0.5, (i / N) as f32 + 0.5) / N as f32;
        let direction = square_to_sphere(u);
        let cosine = direction.dot(normal).max(0.0);
        sum += (light(direction) * cosine).as_dvec3();
    }
    sum * (4.0 * std::f64::consts::PI / f64::from(N * N))
}
