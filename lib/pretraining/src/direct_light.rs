//! Images of a generated scene under each light of a small basis, for training: [`DirectLightImages`].
//!
//! This is a second tracer beside the recorder of `dipir-render`. It computes direct light only, by Lambert's cosine and a
//! GGX highlight that is added to it. Training needs more and less than the recorder makes: pictures of the ground and of
//! the whole scene, but only for a basis of [`BASIS`] lights. `cargo run -p dipir-pretraining --example tracer-cost` compares
//! time and variance of the two; `tests/training_pictures.rs` compares their pictures.

use dipir_diffusion::noise::NoiseStream;
use dipir_scene::bvh::Bvh;
use dipir_scene::camera::Ray;
use glam::{Vec2, Vec3};

use crate::lighting::{Sun, SunSkyLight, sun_direction};
use crate::scene::{GeneratedScene, Paint, SUNS};

/// Pictures of a layer: one for each sun, then horizon, zenith and light from below.
pub const BASIS: usize = SUNS + 3;
/// Planes of the shadow: visible share of each sun, of the horizon and of the zenith.
pub const SHADOW_PLANES: usize = SUNS + 2;
/// First plane of the shadow, after three layers of RGB pictures.
pub const FIRST_SHADOW_PLANE: usize = 3 * 3 * BASIS;
/// All planes: three layers of RGB pictures, shadow, coverage.
pub const PLANES: usize = FIRST_SHADOW_PLANE + SHADOW_PLANES + 1;

/// Rays to each sun from each quarter of a pixel.
const SUN_RAYS: usize = 2;
/// Rays to the sky from each quarter of a pixel.
const SKY_RAYS: usize = 10;
/// Distance at which the ground ends, metres.
const HORIZON: f32 = 60.0;
/// Distance from the surface at which rays start, metres.
const OFFSET: f32 = 8e-3;

/// The layers, in the order of their planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layer {
    /// The scene without the main object.
    Background,
    /// The main object alone over black, as it is composited: only the object itself shadows it.
    Object,
    /// The whole scene.
    Whole,
}

/// Planes [PLANES, size, size] of one scene, row by row.
#[derive(Debug, Clone)]
pub struct DirectLightImages {
    /// The planes.
    pub planes: Vec<f32>,
    /// Pixels on a side.
    pub size: usize,
}

/// First plane of `layer`.
pub fn first_plane(layer: Layer) -> usize {
    layer as usize * 3 * BASIS
}

/// Weights of a layer's pictures under `light`, RGB.
pub fn weights(light: &SunSkyLight) -> [Vec3; BASIS] {
    let mut w = [Vec3::ZERO; BASIS];
    w[light.sun] = light.sun_color;
    w[SUNS] = light.horizon;
    w[SUNS + 1] = light.zenith;
    w[SUNS + 2] = light.bounce;
    w
}

/// Weights of the shadow's planes under `light`: shares of the irradiance of open ground, RGB.
pub fn shadow_weights(light: &SunSkyLight, suns: &[Sun]) -> [Vec3; SHADOW_PLANES] {
    let third = std::f32::consts::PI / 3.0;
    let mut w = [Vec3::ZERO; SHADOW_PLANES];
    w[light.sun] = light.sun_color * suns[light.sun].elevation.sin();
    w[SUNS] = light.horizon * third;
    w[SUNS + 1] = light.zenith * (2.0 * third);
    let total: Vec3 = w.iter().sum();
    w.map(|v| v / total.max(Vec3::splat(1e-9)))
}

/// A point to be lit.
struct Point {
    position: Vec3,
    normal: Vec3,
    viewer: Vec3,
    diffuse: Vec3,
    specular: Vec3,
    roughness: f32,
}

impl Point {
    fn new(position: Vec3, normal: Vec3, viewer: Vec3, paint: &Paint) -> Self {
        let normal = if normal.dot(viewer) < 0.0 {
            -normal
        } else {
            normal
        };
        let (diffuse, specular) = if paint.metallic {
            (Vec3::ZERO, paint.color)
        } else {
            (paint.color, Vec3::splat(0.04))
        };
        Self {
            position,
            normal,
            viewer,
            diffuse,
            specular,
            roughness: paint.roughness,
        }
    }

    /// BSDF times cosine: Lambert and a GGX highlight.
    fn reflect(&self, wi: Vec3) -> Vec3 {
        let (nl, nv) = (self.normal.dot(wi), self.normal.dot(self.viewer).max(1e-3));
        if nl <= 0.0 {
            return Vec3::ZERO;
        }
        let lambert = self.diffuse * (nl * std::f32::consts::FRAC_1_PI);
        if self.specular == Vec3::ZERO {
            return lambert;
        }
        let h = (wi + self.viewer).normalize_or_zero();
        let (a, nh) = (self.roughness * self.roughness, self.normal.dot(h));
        let a2 = a * a;
        let d = a2 / (std::f32::consts::PI * (nh * nh * (a2 - 1.0) + 1.0).powi(2));
        let smith = |x: f32| (x * x * (1.0 - a2) + a2).sqrt();
        let visibility = 0.5 / (nl * smith(nv) + nv * smith(nl));
        let weight = (1.0 - wi.dot(h).clamp(0.0, 1.0)).powi(5);
        let fresnel = self.specular + (Vec3::ONE - self.specular) * weight;
        lambert + fresnel * (d * visibility * nl)
    }

    fn ray(&self, direction: Vec3) -> Ray {
        Ray {
            origin: self.position + self.normal * OFFSET,
            direction,
        }
    }
}

struct Tracer<'a> {
    scene: &'a GeneratedScene,
    main: Bvh,
    others: Bvh,
}

impl Tracer<'_> {
    fn blocked(tree: &Bvh, ray: &Ray) -> bool {
        tree.occluded(ray, f32::INFINITY, |_, _, _| true)
    }

    /// The main object's first point on `ray`, and its distance.
    fn main_point(&self, ray: &Ray) -> Option<(f32, Point)> {
        let hit = self.main.closest(ray, f32::INFINITY, |_, _, _| true)?;
        let normal = shading_normal(&self.scene.main, &hit);
        let position = ray.origin + ray.direction * hit.t;
        let point = Point::new(position, normal, -ray.direction, &self.scene.main_paint);
        Some((hit.t, point))
    }

    /// The first point on `ray` without the main object, its distance, and whether it is ground.
    fn background_point(&self, ray: &Ray) -> Option<(f32, Point, bool)> {
        let hit = self.others.closest(ray, f32::INFINITY, |_, _, _| true);
        let ground = (ray.direction.y < -1e-5).then(|| -ray.origin.y / ray.direction.y);
        let ground = ground.filter(|t| *t < HORIZON && hit.is_none_or(|h| *t < h.t));
        if let Some(t) = ground {
            let position = ray.origin + ray.direction * t;
            let albedo = self.scene.ground.albedo(Vec2::new(position.x, position.z));
            let point = Point {
                position,
                normal: Vec3::Y,
                viewer: -ray.direction,
                diffuse: albedo,
                specular: Vec3::ZERO,
                roughness: 1.0,
            };
            return Some((t, point, true));
        }
        let hit = hit?;
        let position = ray.origin + ray.direction * hit.t;
        let material = self.scene.others.materials[hit.triangle as usize];
        let normal = shading_normal(&self.scene.others, &hit);
        let paint = &self.scene.paints[material as usize];
        Some((
            hit.t,
            Point::new(position, normal, -ray.direction, paint),
            false,
        ))
    }
}

fn shading_normal(mesh: &dipir_scene::mesh::TriangleMesh, hit: &dipir_scene::bvh::Hit) -> Vec3 {
    let [a, b, c] = mesh.indices[hit.triangle as usize].map(|i| mesh.normals[i as usize]);
    (a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v).normalize_or(Vec3::Y)
}

/// Directions of the shadow rays of one quarter of a pixel.
struct Directions {
    suns: [[Vec3; SUN_RAYS]; SUNS],
    sky: [Vec3; SKY_RAYS],
}

impl Directions {
    fn draw(suns: &[Sun], quarter: usize, stream: &mut NoiseStream) -> Self {
        let mut u = || stream.uniform() as f32;
        let turn = u() * std::f32::consts::TAU;
        let sky = std::array::from_fn(|j| {
            // Fibonacci points, equal areas of the upper hemisphere.
            let i = (4 * j + quarter) as f32 + 0.5;
            let y = 1.0 - i / (4 * SKY_RAYS) as f32;
            let (s, c) = (i * 2.399_963_2 + turn).sin_cos();
            let r = (1.0 - y * y).sqrt();
            Vec3::new(r * c, y, r * s)
        });
        let suns = std::array::from_fn(|k| {
            let sun = suns[k];
            let axis = sun_direction(sun.azimuth, sun.elevation);
            let (t, b) = axis.any_orthonormal_pair();
            std::array::from_fn(|r| {
                // Stratified over quarters and rays.
                let x = ((quarter * SUN_RAYS + r) as f32 + u()) / (4 * SUN_RAYS) as f32;
                let cosine = (1.0 + x.max(1e-4).ln() / sun.sharpness).max(0.0);
                let (s, c) = (u() * std::f32::consts::TAU).sin_cos();
                let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
                (axis * cosine + (t * c + b * s) * sine).normalize()
            })
        });
        Self { suns, sky }
    }
}

/// Radiance of a point under each light of the basis.
type Response = [Vec3; BASIS];

/// Responses of `point` if only `own` occludes light, and if both meshes do. `visible` is called for every shadow ray
/// with its plane, its direction, and whether `own` and `other` block it.
fn responses(
    point: &Point,
    directions: &Directions,
    own: &Bvh,
    other: &Bvh,
    mut visible: impl FnMut(usize, Vec3, bool, bool),
) -> (Response, Response) {
    let (mut alone, mut whole) = ([Vec3::ZERO; BASIS], [Vec3::ZERO; BASIS]);
    let mut gather = |d: Vec3, add: &mut dyn FnMut(usize, &mut Response, Vec3), plane: usize| {
        let value = point.reflect(d);
        if d.y <= 0.0 || value == Vec3::ZERO {
            return;
        }
        let ray = point.ray(d);
        let (a, b) = (Tracer::blocked(own, &ray), Tracer::blocked(other, &ray));
        visible(plane, d, a, b);
        if !a {
            add(plane, &mut alone, value);
            if !b {
                add(plane, &mut whole, value);
            }
        }
    };
    for (k, rays) in directions.suns.iter().enumerate() {
        for &d in rays {
            let mut add = |k: usize, r: &mut Response, v: Vec3| r[k] += v / SUN_RAYS as f32;
            gather(d, &mut add, k);
        }
    }
    let solid_angle = std::f32::consts::TAU / SKY_RAYS as f32;
    for &d in &directions.sky {
        let mut add = |_: usize, r: &mut Response, v: Vec3| {
            r[SUNS] += v * ((1.0 - d.y) * solid_angle);
            r[SUNS + 1] += v * (d.y * solid_angle);
        };
        gather(d, &mut add, SUNS);
    }
    let below = (point.diffuse + point.specular) * (0.5 * (1.0 - point.normal.y));
    alone[SUNS + 2] = below;
    whole[SUNS + 2] = below;
    (alone, whole)
}

impl DirectLightImages {
    /// Traces `scene` with the random numbers of (`seed`, `index`).
    pub fn trace(scene: &GeneratedScene, seed: u64, index: u64) -> Self {
        let size = scene.camera.resolution[0] as usize;
        let tracer = Tracer {
            scene,
            main: Bvh::build(&scene.main),
            others: Bvh::build(&scene.others),
        };
        let mut images = Self {
            planes: vec![0.0; PLANES * size * size],
            size,
        };
        for pixel in 0..size * size {
            let mut stream = NoiseStream::new(seed ^ 0x7ace, index << 20 | pixel as u64);
            images.pixel(&tracer, pixel, &mut stream);
        }
        images
    }

    /// Pixels of `layer` under `light`, linear, row by row.
    pub fn layer(&self, layer: Layer, light: &SunSkyLight) -> Vec<Vec3> {
        let count = self.size * self.size;
        let mut pixels = vec![Vec3::ZERO; count];
        for (b, weight) in weights(light).iter().enumerate() {
            let plane = |c: usize| &self.planes[(first_plane(layer) + 3 * b + c) * count..];
            let [red, green, blue] = [0, 1, 2].map(plane);
            for (p, pixel) in pixels.iter_mut().enumerate() {
                *pixel += *weight * Vec3::new(red[p], green[p], blue[p]);
            }
        }
        pixels
    }

    fn pixel(&mut self, tracer: &Tracer, pixel: usize, stream: &mut NoiseStream) {
        let mut layers = [[Vec3::ZERO; BASIS]; 3];
        // Shadow, summed over the quarters that show the ground.
        let (mut shadow, mut open) = ([0f32; SHADOW_PLANES], 0f32);
        let mut coverage = 0.0;
        for quarter in 0..4 {
            let directions = Directions::draw(&tracer.scene.suns, quarter, stream);
            let offset = Vec2::new(
                ((quarter % 2) as f32 + stream.uniform() as f32) * 0.5,
                ((quarter / 2) as f32 + stream.uniform() as f32) * 0.5,
            );
            let corner = Vec2::new((pixel % self.size) as f32, (pixel / self.size) as f32);
            let ray = tracer.scene.camera.ray(corner + offset);
            let background = tracer.background_point(&ray);
            let main = tracer
                .main_point(&ray)
                .filter(|(t, _)| background.as_ref().is_none_or(|(b, _, _)| t < b));
            let share = 0.25;
            let mut add = |layer: Layer, response: &Response| {
                for (sum, value) in layers[layer as usize].iter_mut().zip(response) {
                    *sum += *value * share;
                }
            };
            if let Some((_, point)) = &main {
                let (alone, whole) = responses(
                    point,
                    &directions,
                    &tracer.main,
                    &tracer.others,
                    |_, _, _, _| {},
                );
                add(Layer::Object, &alone);
                add(Layer::Whole, &whole);
                coverage += share;
            }
            let Some((_, point, is_ground)) = background else {
                // The sky is visible.
                let mut seen = [Vec3::ZERO; BASIS];
                let y = ray.direction.y.max(0.0);
                let sky = &tracer.scene.sky;
                let cover = sky.cover(ray.direction);
                seen[SUNS] = Vec3::splat(cover * (1.0 - y));
                seen[SUNS + 1] = Vec3::splat(cover * y);
                for (seen, sun) in seen.iter_mut().zip(&tracer.scene.suns) {
                    let at = sun_direction(sun.azimuth, sun.elevation);
                    *seen = Vec3::splat(sky.around_sun(ray.direction, at));
                }
                add(Layer::Background, &seen);
                if main.is_none() {
                    add(Layer::Whole, &seen);
                }
                continue;
            };
            let mut seen = Vec::with_capacity(SUNS * SUN_RAYS + SKY_RAYS);
            let (alone, whole) = responses(
                &point,
                &directions,
                &tracer.others,
                &tracer.main,
                |plane, d, _, by_main| seen.push((plane, d, by_main)),
            );
            add(Layer::Background, &alone);
            if main.is_some() {
                continue;
            }
            add(Layer::Whole, &whole);
            if is_ground {
                open += 1.0;
                accumulate_shadow(&seen, &mut shadow);
            }
        }
        self.store_layers(pixel, &layers);
        self.store_shadow(pixel, &shadow, open, coverage);
    }

    fn store_layers(&mut self, pixel: usize, layers: &[[Vec3; BASIS]; 3]) {
        let count = self.size * self.size;
        for (layer, responses) in layers.iter().enumerate() {
            for (b, response) in responses.iter().enumerate() {
                for c in 0..3 {
                    self.planes[(layer * 3 * BASIS + b * 3 + c) * count + pixel] = response[c];
                }
            }
        }
    }

    /// Stores shadow and coverage of a pixel in which `open` quarters show the ground.
    fn store_shadow(
        &mut self,
        pixel: usize,
        shadow: &[f32; SHADOW_PLANES],
        open: f32,
        coverage: f32,
    ) {
        let count = self.size * self.size;
        // Quarters without ground have no shadow.
        let ground_share = if coverage < 1.0 {
            open * 0.25 / (1.0 - coverage)
        } else {
            0.0
        };
        for (b, sum) in shadow.iter().enumerate() {
            let visible = if open > 0.0 { sum / open } else { 1.0 };
            let plane = FIRST_SHADOW_PLANE + b;
            self.planes[plane * count + pixel] = 1.0 + ground_share * (visible - 1.0);
        }
        self.planes[(PLANES - 1) * count + pixel] = coverage;
    }
}

/// Adds the visible shares of one quarter, weighted by the cosine.
fn accumulate_shadow(seen: &[(usize, Vec3, bool)], shadow: &mut [f32; SHADOW_PLANES]) {
    let mut sums = [[0f32; 2]; SHADOW_PLANES];
    for &(plane, d, blocked) in seen {
        let mut add = |plane: usize, weight: f32| {
            sums[plane][1] += weight;
            if !blocked {
                sums[plane][0] += weight;
            }
        };
        if plane < SUNS {
            add(plane, d.y);
        } else {
            add(SUNS, d.y * (1.0 - d.y));
            add(SUNS + 1, d.y * d.y);
        }
    }
    for (sum, [visible, all]) in shadow.iter_mut().zip(sums) {
        *sum += if all > 0.0 { visible / all } else { 1.0 };
    }
}
