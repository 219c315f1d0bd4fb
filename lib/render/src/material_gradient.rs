//! Derivatives of a picture with respect to the object's materials, by replaying its paths.
//!
//! A path's contribution is a product of one weight per vertex and of the light that arrives, so
//! its derivative is a sum over the vertices: the product with one weight replaced by its
//! derivative. Every vertex carries that product along, started with the throughput before it,
//! which costs one multiplication per later vertex and never divides by a weight, so weights of 0
//! do no harm. Random numbers, directions, densities, MIS weights and roulette are those of the
//! forward render and are held constant ("detached" sampling): the estimate is unbiased, since the
//! integrand, unlike the densities, is what changes [Zeltner et al. 2021; Vicini et al. 2021].
//!
//! What it cannot do: a roughness below .02 is a mirror with derivative 0; shapes, coverage (and
//! with it alpha), coat and transmission are constants. A base colour of exactly 0 on a surface
//! without a specular lobe is not reached by BSDF sampling, and the derivative there lacks what
//! comes that way.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_numerics::sampler::Stream;
use dipir_numerics::sum::par_reduce;
use glam::{DVec3, Vec2, Vec3};

use crate::bsdf::slopes::{BsdfSlopes, MaterialSlopes};
use crate::bsdf::{Bsdf, BsdfSample, passing_coat};
use crate::counters::RayCounts;
use crate::error::RenderError;
use crate::features::with_features;
use crate::footprint::Footprint;
use crate::foreground::{Gather, PathContext, Vertex};
use crate::light::{PathLight, SceneLight};
use crate::optics::Optics;
use crate::render::{Renderer, Simulation, pixels_of, sequence};
use crate::world::World;

/// The derivatives of a scalar with respect to one material's factors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MaterialGradient {
    /// With respect to the linear base colour, which multiplies its texture.
    pub base_color: DVec3,
    /// With respect to the metalness.
    pub metallic: f64,
    /// With respect to the perceptual roughness.
    pub roughness: f64,
    /// With respect to the emitted radiance, strength multiplied in.
    pub emissive: DVec3,
}

impl MaterialGradient {
    fn add(&mut self, other: &Self) {
        self.base_color += other.base_color;
        self.metallic += other.metallic;
        self.roughness += other.roughness;
        self.emissive += other.emissive;
    }
}

/// How derivatives are estimated.
#[derive(Clone, Copy, Debug)]
pub struct GradientSettings<'a> {
    /// Seed of all random numbers. Where the picture's gradient was computed from a noisy picture,
    /// another one than that picture's: else noise in both correlates, and the product is biased.
    pub seed: u64,
    /// Paths per pixel.
    pub samples: u32,
    /// What the proxy looks like to rays from the object, if the simulation asks for it.
    pub background: Option<&'a LinearImage>,
}

/// The product of a path's weights with one replaced by its derivatives.
#[derive(Clone, Copy, Debug)]
struct Replaced {
    material: usize,
    slopes: MaterialSlopes,
}

/// Follows a path and adds up what its light says of the materials.
struct Tape<'a> {
    /// Derivative of the scalar with respect to the path's radiance.
    pixel: Vec3,
    replaced: Vec<Replaced>,
    /// Value at the vertex where light was sampled, and the product with its derivatives.
    lit: Option<(Vec3, Replaced)>,
    sums: &'a mut [MaterialGradient],
}

impl Tape<'_> {
    fn replaced<const F: u32>(
        vertex: &Vertex,
        throughput: Vec3,
        slopes: MaterialSlopes,
    ) -> Replaced {
        let hit = vertex.hit;
        let factors = vertex.surfaces.slopes::<F>(hit.triangle, hit.u, hit.v);
        Replaced {
            material: vertex.surfaces.material_index(hit.triangle) as usize,
            slopes: MaterialSlopes {
                base_color: slopes.base_color * throughput * factors.base_color,
                metallic: slopes.metallic * throughput * factors.metallic,
                roughness: slopes.roughness * throughput * factors.roughness,
            },
        }
    }

    /// Light arrives at the path's end.
    fn arrive(&mut self, incoming: Vec3) {
        let incoming = self.pixel * incoming;
        let mut add = |r: &Replaced, light: Vec3| {
            let sum = &mut self.sums[r.material];
            sum.base_color += (r.slopes.base_color * light).as_dvec3();
            sum.metallic += f64::from(r.slopes.metallic.dot(light));
            sum.roughness += f64::from(r.slopes.roughness.dot(light));
        };
        let (value, last) = match self.lit.take() {
            Some((value, last)) => (value, Some(last)),
            None => (Vec3::ONE, None),
        };
        for replaced in &self.replaced {
            add(replaced, value * incoming);
        }
        if let Some(last) = &last {
            add(last, incoming);
        }
    }
}

impl Gather for Tape<'_> {
    const DERIVATIVES: bool = true;

    fn distant(&mut self, _: Vec3, _: Vec3, radiance: Vec3, weight: f32) {
        self.arrive(radiance * weight);
    }

    fn local(&mut self, _: Vec3) {
        unreachable!("light of the scene is reported as photographed or emitted");
    }

    fn photographed(&mut self, _: Vec3, seen: Vec3, _: Vec3, weight: f32) {
        self.arrive(seen * weight);
    }

    fn emitted<const F: u32>(&mut self, vertex: &Vertex, throughput: Vec3) {
        let (hit, surface) = (vertex.hit, vertex.surface);
        let factors = vertex.surfaces.slopes::<F>(hit.triangle, hit.u, hit.v);
        let material = vertex.surfaces.material_index(hit.triangle) as usize;
        let arriving = self.pixel * throughput;
        if surface.unlit {
            self.sums[material].base_color += (arriving * factors.base_color).as_dvec3();
            return self.arrive(surface.base_color);
        }
        let passing = passing_coat(&surface.coat, -vertex.direction);
        self.sums[material].emissive += (arriving * factors.emission * passing).as_dvec3();
        self.arrive(surface.emission);
    }

    fn lit<const F: u32>(
        &mut self,
        bsdf: &Bsdf<F>,
        vertex: &Vertex,
        throughput: Vec3,
        wi: Vec3,
        value: Vec3,
    ) {
        let slopes = BsdfSlopes::new(bsdf, vertex.surface).eval(wi);
        self.lit = Some((value, Self::replaced::<F>(vertex, throughput, slopes)));
    }

    fn scattered<const F: u32>(
        &mut self,
        bsdf: &Bsdf<F>,
        vertex: &Vertex,
        throughput: Vec3,
        u_lobe: f32,
        sample: &BsdfSample,
    ) {
        for replaced in &mut self.replaced {
            replaced.slopes = replaced.slopes.tinted(sample.weight);
        }
        let slopes = BsdfSlopes::new(bsdf, vertex.surface).weight(u_lobe, sample);
        let replaced = Self::replaced::<F>(vertex, throughput, slopes);
        self.replaced.push(replaced);
    }

    fn survived(&mut self, scale: f32) {
        for replaced in &mut self.replaced {
            replaced.slopes = replaced.slopes.times(scale);
        }
    }
}

impl Renderer<'_> {
    /// The gradient of `sum over pixels of gradient . object` with respect to every material, where
    /// `object` is the premultiplied foreground that [`render`](Self::render) estimates: the
    /// adjoint of the picture. `gradient` has the camera's size; pixels where it is 0 cost nothing.
    /// The same bytes for any number of threads.
    pub fn material_gradient<L: SceneLight>(
        &self,
        light: &L,
        simulation: &Simulation,
        settings: &GradientSettings,
        gradient: &Raster<Vec3>,
    ) -> Result<Vec<MaterialGradient>, RenderError> {
        self.check_images(settings.background, None)?;
        let [camera_width, camera_height] = self.camera().resolution.map(|n| n as usize);
        let (width, height) = (gradient.width(), gradient.height());
        if (width, height) != (camera_width, camera_height) {
            return Err(RenderError::SizeMismatch {
                what: "gradient of the picture",
                width,
                height,
                camera_width,
                camera_height,
            });
        }
        let world = World::without_extensions(
            self.scene(),
            *self.camera(),
            self.geometry().clone(),
            simulation.features,
        )?;
        let on_object = light.on_object();
        let path = PathContext::from_camera(&world, &on_object, simulation, settings.background);
        let bvh = &self.geometry().bvh;
        let footprint = Footprint::new(
            self.camera(),
            Optics::default(),
            bvh.bounds(),
            bvh.clusters(),
        );
        let pixels: Vec<(u32, u32)> = self
            .blocks()
            .filter(|b| footprint.overlaps(b.x, b.y, b.width, b.height))
            .flat_map(pixels_of)
            .filter(|&(x, y)| footprint.holds(x, y))
            .filter(|&(x, y)| *gradient.get(x as usize, y as usize) != Vec3::ZERO)
            .collect();
        Ok(with_features!(world.mask, F => {
            replay::<_, F>(&path, settings, gradient, &pixels)
        }))
    }
}

/// Pixels that are summed up as one.
const CHUNK: usize = 64;

fn replay<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    settings: &GradientSettings,
    gradient: &Raster<Vec3>,
    pixels: &[(u32, u32)],
) -> Vec<MaterialGradient> {
    let none = vec![MaterialGradient::default(); path.world.scene.materials.len()];
    let share = 1.0 / settings.samples.max(1) as f32;
    let chunk = |range: std::ops::Range<usize>| {
        let mut sums = none.clone();
        let mut tape = Tape {
            pixel: Vec3::ZERO,
            replaced: Vec::new(),
            lit: None,
            sums: &mut sums,
        };
        let mut counts = RayCounts::default();
        for &(x, y) in &pixels[range] {
            tape.pixel = *gradient.get(x as usize, y as usize) * share;
            let corner = Vec2::new(x as f32, y as f32);
            let base = sequence(settings.seed, Stream::FOREGROUND, 0, (x, y));
            for sample in 0..settings.samples {
                tape.replaced.clear();
                tape.lit = None;
                let mut sampler = base.with_sample(sample);
                path.camera_trace::<F, _>(corner, &mut sampler, &mut counts, &mut tape);
            }
        }
        sums
    };
    let add = |mut a: Vec<MaterialGradient>, b: Vec<MaterialGradient>| {
        a.iter_mut().zip(&b).for_each(|(a, b)| a.add(b));
        a
    };
    par_reduce(pixels.len(), CHUNK, chunk, add).unwrap_or(none)
}

#[cfg(test)]
#[path = "material_gradient_tests.rs"]
mod tests;
