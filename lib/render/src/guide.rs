//! Where light comes from by way of the object itself: the sun in a fold of polished metal.
//!
//! Few paths meet such a reflection, and those that do are bright: noise. Particles find it from the other end [Jensen
//! 1995, "Importance Driven Path Tracing using the Photon Map"]. They are traced from the light onto the object and on
//! along its reflections. Where a particle arrives it leaves a beacon: the place that it was reflected from, and its flux.
//! A grid collects the beacons in its cells.
//!
//! A path that comes to a cell draws a share of its directions from cones around the cell's beacons, each as often as the
//! surface reflects it. The BSDF draws the rest. Both are weighed by the density of their mixture, so the picture is
//! unbiased, whatever the guide says.
use std::f32::consts::{FRAC_1_PI, PI};

use dipir_light::luminance::luminance;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::{Frame, balance_heuristic, cone_pdf, square_to_cone, square_to_sphere};
use glam::{UVec3, Vec2, Vec3};
use rayon::prelude::*;

use crate::bsdf::features::{SPECULAR, has};
use crate::bsdf::{Bsdf, BsdfSample};
use crate::counters::{RayCounts, RayKind};
use crate::light::PathLight;
use crate::surface::SurfacePoint;
use crate::world::World;

/// Cells along the longest side of the object.
const CELLS: f32 = 40.0;
/// Most beacons of a cell; more are thinned out.
const MOST: usize = 48;
/// Reflections that a particle is followed through.
const BOUNCES: u64 = 3;
/// Largest share of directions that follow the guide.
const MOST_GUIDED: f32 = 0.85;
/// Density per steradian of reflections that leave beacons: what wider lobes reflect is found by chance.
const NARROW: f32 = 1.0;
/// Where a smaller share would follow the guide, none does.
const LEAST_GUIDED: f32 = 0.003;
/// Factor on the luminance of the light that BSDF sampling has to find: that light varies, and more samples should find
/// it than its mean asks for.
const UNEVEN: f32 = 2.0;
/// Radius of the ball around a beacon that is aimed at, in sides of a cell.
const RADIUS: f32 = 0.5;
/// Bounds on the tangent of the half angle of cones.
const TANGENTS: [f32; 2] = [0.03, 1.0];
/// Reflectance that every surface counts as having besides its lobes, for bounces between facets.
const FURTHER: f32 = 0.03;
/// Reflectance of a dielectric at normal incidence.
const DIELECTRIC: f32 = 0.04;
/// Particles for each pixel of the object, whose first samples are 8 paths.
const PARTICLES_PER_PIXEL: usize = 12;
/// Fewest pixels of the object that a guide is made for: smaller pictures take as long without.
const LEAST_PIXELS: usize = 1 << 13;
/// Particles that one task traces.
const CHUNK: usize = 4096;
/// Tasks that tell whether any particles arrive.
const FIRST: usize = 4;
/// Most tasks: half a million particles.
const MOST_CHUNKS: usize = 128;
/// Directions in which the light is looked at.
const LOOKS: u32 = 512;

/// A grid of beacons.
pub struct PathGuide {
    origin: Vec3,
    /// Side of a cell, metres.
    side: f32,
    cells: UVec3,
    /// Number of each cell's group of beacons, [`NO_GROUP`] without one.
    groups: Vec<u32>,
    beacons: Vec<Group>,
    /// Luminance of the light that BSDF sampling has to find.
    unsampled: f32,
}

const NO_GROUP: u32 = u32::MAX;

/// The beacons of a cell, component by component; unused ones have no flux.
#[derive(Clone)]
struct Group {
    x: [f32; MOST],
    y: [f32; MOST],
    z: [f32; MOST],
    /// Luminance, in units of radiance times area times solid angle.
    flux: [f32; MOST],
}

/// A particle's arrival.
struct Arrival {
    cell: u32,
    from: Vec3,
    flux: f32,
}

/// The part of a vertex's directions that follows the guide: a mixture of uniform cones.
pub struct Cones {
    direction: [[f32; MOST]; 3],
    cosine: [f32; MOST],
    /// Share of each cone in the mixture times its density.
    density: [f32; MOST],
    /// Share of each cone in the mixture.
    weight: [f32; MOST],
    /// Share of the vertex's directions that are drawn from the cones.
    share: f32,
}

impl PathGuide {
    /// A guide for a picture in which the object covers about `pixels`; `None` where these are few, or nothing arrives from
    /// narrow lobes of the object. `F` has the features of `world`. Adds the rays of all particles to `counts`. Does not
    /// depend on the number of threads.
    pub fn new<L: PathLight, const F: u32>(
        world: &World,
        light: &L,
        pixels: usize,
        seed: u64,
        counts: &mut RayCounts,
    ) -> Option<Self> {
        let bounds = world.geometry.bvh.bounds()?;
        let size = bounds.max - bounds.min;
        let side = size.max_element() / CELLS;
        let spread = side > 0.0 && side.is_finite();
        if !spread || !has(F, SPECULAR) || world.escapes || pixels < LEAST_PIXELS {
            return None;
        }
        let mut guide = Self {
            origin: bounds.min,
            side,
            cells: (size / side).ceil().max(Vec3::ONE).as_uvec3(),
            groups: Vec::new(),
            beacons: Vec::new(),
            unsampled: unsampled_luminance(light),
        };
        let emitter = Emitter::new(world, light, seed);
        let chunks = (pixels * PARTICLES_PER_PIXEL / CHUNK).clamp(FIRST, MOST_CHUNKS);
        let mut arrivals = Vec::new();
        for part in [0..FIRST, FIRST..chunks] {
            let trace = |chunk: usize| {
                let (mut found, mut rays) = (Vec::new(), RayCounts::default());
                for number in chunk * CHUNK..(chunk + 1) * CHUNK {
                    emitter.trace::<F>(number as u32, &mut rays, |at, from, flux| {
                        let cell = guide.cell(at);
                        found.push(Arrival { cell, from, flux });
                    });
                }
                (found, rays)
            };
            let traced: Vec<_> = part.into_par_iter().map(trace).collect();
            for (found, rays) in traced {
                arrivals.extend(found);
                counts.merge(&rays);
            }
            if arrivals.is_empty() {
                return None;
            }
        }
        // Stable: particles of a cell keep their order.
        arrivals.par_sort_by_key(|arrival| arrival.cell);
        guide.groups = vec![NO_GROUP; guide.cells.element_product() as usize];
        let each = 1.0 / (chunks * CHUNK) as f32;
        for here in arrivals.chunk_by(|a, b| a.cell == b.cell) {
            guide.groups[here[0].cell as usize] = guide.beacons.len() as u32;
            guide.beacons.push(Group::of(here, each));
        }
        Some(guide)
    }

    /// The cell that holds `point`, or the nearest one.
    fn cell(&self, point: Vec3) -> u32 {
        let at = ((point - self.origin) / self.side).max(Vec3::ZERO);
        let at = at.as_uvec3().min(self.cells - UVec3::ONE);
        (at.z * self.cells.y + at.y) * self.cells.x + at.x
    }

    /// The cones for a path that leaves `surface` towards `wo`; `None` where the guide knows of no light that is worth
    /// it.
    pub fn cones(&self, surface: &SurfacePoint, wo: Vec3) -> Option<Cones> {
        let group = self.groups[self.cell(surface.position) as usize];
        let group = self.beacons.get(group as usize)?;
        let lobes = Lobes::of(surface, wo);
        let mut cones = Cones {
            direction: [[0.0; MOST]; 3],
            cosine: [0.0; MOST],
            density: [0.0; MOST],
            weight: [0.0; MOST],
            share: 0.0,
        };
        let (position, normal) = (surface.position, surface.geometric_normal);
        let radius = RADIUS * self.side;
        for i in 0..MOST {
            let (x, y, z) = (
                group.x[i] - position.x,
                group.y[i] - position.y,
                group.z[i] - position.z,
            );
            let inverse = 1.0 / (x * x + y * y + z * z).max(f32::MIN_POSITIVE).sqrt();
            let (x, y, z) = (x * inverse, y * inverse, z * inverse);
            let tangent = (radius * inverse).clamp(TANGENTS[0], TANGENTS[1]);
            let above = x * normal.x + y * normal.y + z * normal.z > 0.0;
            let mirrored = x * lobes.mirrored.x + y * lobes.mirrored.y + z * lobes.mirrored.z;
            let reflected = lobes.towards(mirrored, tangent);
            cones.direction[0][i] = x;
            cones.direction[1][i] = y;
            cones.direction[2][i] = z;
            cones.cosine[i] = 1.0 / (1.0 + tangent * tangent).sqrt();
            cones.weight[i] = if above {
                group.flux[i] * reflected
            } else {
                0.0
            };
        }
        let sum: f32 = cones.weight.iter().sum();
        // Beacons stand for light on about one face of the cell.
        let expected = sum / (self.side * self.side);
        let other = UNEVEN * self.unsampled * lobes.reflectance;
        let share = MOST_GUIDED * expected / (expected + other);
        // Not a number where nothing is sent and nothing else arrives.
        if !(share > LEAST_GUIDED && sum.is_normal()) {
            return None;
        }
        cones.share = share;
        for i in 0..MOST {
            cones.weight[i] /= sum;
            cones.density[i] = cones.weight[i] * cone_pdf(cones.cosine[i]);
        }
        Some(cones)
    }
}

/// Root mean square over the sphere of the luminance of `light`, less what its own sampling takes of it beside even
/// directions (balance heuristic).
fn unsampled_luminance(light: &impl PathLight) -> f32 {
    const EVEN: f32 = 0.25 * FRAC_1_PI;
    let squares = (0..LOOKS).map(|k| {
        let mut sampler = Sampler::new(0, Stream::GUIDE, 0, k);
        let (radiance, pdf) = light.eval_with_pdf(square_to_sphere(sampler.next_2d()));
        (luminance(radiance) * balance_heuristic(EVEN, pdf)).powi(2)
    });
    (squares.sum::<f32>() / LOOKS as f32).sqrt()
}

impl Group {
    /// At most [`MOST`] of `arrivals`, drawn in proportion to their flux, with all of it; `each` is the share of one
    /// particle in what is sent.
    fn of(arrivals: &[Arrival], each: f32) -> Self {
        let mut group = Self {
            x: [0.0; MOST],
            y: [0.0; MOST],
            z: [0.0; MOST],
            flux: [0.0; MOST],
        };
        let mut put = |i: usize, from: Vec3, flux: f32| {
            [group.x[i], group.y[i], group.z[i]] = from.to_array();
            group.flux[i] = flux * each;
        };
        if arrivals.len() <= MOST {
            for (i, a) in arrivals.iter().enumerate() {
                put(i, a.from, a.flux);
            }
            return group;
        }
        let total: f32 = arrivals.iter().map(|a| a.flux).sum();
        let step = total / MOST as f32;
        let (mut sum, mut drawn) = (0.0, 0);
        for a in arrivals {
            sum += a.flux;
            while drawn < MOST && sum > (drawn as f32 + 0.5) * step {
                put(drawn, a.from, step);
                drawn += 1;
            }
        }
        group
    }
}

/// Where particles start: on the object's surface, evenly by area.
struct Emitter<'a, L> {
    world: &'a World<'a>,
    light: &'a L,
    /// Running sums of the areas of triangles, square metres.
    areas: Vec<f64>,
    seed: u64,
}

impl<'a, L: PathLight> Emitter<'a, L> {
    fn new(world: &'a World<'a>, light: &'a L, seed: u64) -> Self {
        let mesh = &world.scene.mesh;
        let mut area = 0.0;
        let areas = (0..mesh.indices.len()).map(|triangle| {
            area += 0.5 * mesh.scaled_normal(triangle).length();
            area
        });
        Self {
            world,
            light,
            areas: areas.collect(),
            seed,
        }
    }

    /// Follows particle `number` and tells where it arrives from a narrow lobe, where it was reflected, and its flux.
    fn trace<const F: u32>(
        &self,
        number: u32,
        counts: &mut RayCounts,
        mut arrive: impl FnMut(Vec3, Vec3, f32),
    ) {
        let world = self.world;
        let mut sampler = Sampler::new(self.seed, Stream::GUIDE, 1, number);
        let key = hash_u64s(&[self.seed, u64::from(number)]);
        let area = self.areas.last().copied().unwrap_or(0.0);
        let chosen = f64::from(sampler.next_1d()) * area;
        let triangle = self.areas.partition_point(|&a| a <= chosen) as u32;
        let place = sampler.next_2d();
        let lit = self.light.sample(sampler.next_2d());
        if lit.pdf <= 0.0 || triangle as usize >= self.areas.len() {
            return;
        }
        // Evenly on the triangle [Turk 1990].
        let root = place.x.sqrt();
        let (u, v) = (root * (1.0 - place.y), root * place.y);
        let surfaces = &world.surfaces;
        let mut surface = surfaces.interact::<F>(-lit.direction, triangle, u, v);
        if !surface.front_face && surfaces.single_sided(triangle) {
            return;
        }
        counts.add(RayKind::Guide);
        if world.hides_light::<F>(&world.leave(&surface, lit.direction), key) {
            return;
        }
        let cosine = surface.geometric_normal.dot(lit.direction).abs();
        let mut flux = lit.radiance * (area as f32 * cosine / lit.pdf);
        let mut wo = lit.direction;
        for bounce in 0..BOUNCES {
            if surface.unlit {
                return;
            }
            let bsdf = Bsdf::<F>::new(&surface, wo);
            let Some(sample) = bsdf.sample(sampler.next_1d(), sampler.next_2d()) else {
                return;
            };
            flux *= sample.weight;
            let ray = world.leave(&surface, sample.wi);
            counts.add(RayKind::Guide);
            let Some(hit) = world.closest::<F>(&ray, hash_u64s(&[key, bounce])) else {
                return;
            };
            let from = surface.position;
            surface = surfaces.interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
            wo = -ray.direction;
            let flux = luminance(flux);
            let narrow = sample.pdf > NARROW && !sample.delta;
            if narrow && flux.is_finite() {
                arrive(surface.position, from, flux);
            }
        }
    }
}

/// Roughly what a surface reflects, as a function of the angle from the mirrored direction.
struct Lobes {
    mirrored: Vec3,
    diffuse: f32,
    /// Reflectance at normal incidence and alpha squared, of base and coat.
    glossy: [[f32; 2]; 2],
    reflectance: f32,
}

impl Lobes {
    fn of(surface: &SurfacePoint, wo: Vec3) -> Self {
        let albedo = luminance(surface.base_color);
        let diffuse = albedo * (1.0 - surface.metallic) + FURTHER;
        let base = DIELECTRIC + (albedo - DIELECTRIC) * surface.metallic;
        let coat = DIELECTRIC * surface.coat.factor;
        Self {
            mirrored: (-wo).reflect(surface.normal),
            diffuse: diffuse * FRAC_1_PI,
            glossy: [
                [base, surface.roughness.powi(4)],
                [coat, surface.coat.roughness.powi(4)],
            ],
            reflectance: base + coat + diffuse,
        }
    }

    /// Reflected radiance per irradiance from a cone whose half angle has that tangent, and whose axis has the cosine
    /// `mirrored` to the mirrored direction: GGX as a function of the half vector, widened by the cone.
    #[inline(always)]
    fn towards(&self, mirrored: f32, tangent: f32) -> f32 {
        let mut sum = self.diffuse;
        for [reflectance, alpha2] in self.glossy {
            let a2 = alpha2 + 0.125 * tangent * tangent;
            let c = 1.0 + (1.0 - mirrored) / (2.0 * a2);
            sum += reflectance / (4.0 * PI * a2 * c * c);
        }
        sum
    }
}

impl Cones {
    /// Density per steradian of the cones towards `wi`.
    fn pdf(&self, wi: Vec3) -> f32 {
        let mut sum = 0.0;
        for i in 0..MOST {
            let [x, y, z] = [0, 1, 2].map(|c| self.direction[c][i]);
            let inside = x * wi.x + y * wi.y + z * wi.z >= self.cosine[i];
            sum += if inside { self.density[i] } else { 0.0 };
        }
        sum
    }

    /// Density of all of the vertex's directions towards `wi`, where the BSDF's is `bsdf_pdf`.
    pub fn mixed(&self, wi: Vec3, bsdf_pdf: f32) -> f32 {
        bsdf_pdf + self.share * (self.pdf(wi) - bsdf_pdf)
    }

    /// A direction in a cone; `u_lobe` chooses which.
    fn direction(&self, u_lobe: f32, u: Vec2) -> Vec3 {
        let mut rest = u_lobe;
        let mut chosen = 0;
        for (i, &weight) in self.weight.iter().enumerate() {
            if weight > 0.0 {
                // Rounding may leave a rest: it belongs to the last one.
                chosen = i;
                if rest < weight {
                    break;
                }
                rest -= weight;
            }
        }
        let [x, y, z] = [0, 1, 2].map(|c| self.direction[c][chosen]);
        let axis = Frame::from_normal(Vec3::new(x, y, z));
        axis.to_world(square_to_cone(u, self.cosine[chosen]))
    }

    /// As [`Bsdf::sample`], but drawn from the mixture. [`Cones::weigh`] makes weight and density those of the mixture.
    pub fn sample<const F: u32>(&self, bsdf: &Bsdf<F>, u_lobe: f32, u: Vec2) -> Option<BsdfSample> {
        match u_lobe < self.share {
            true => bsdf.towards(self.direction(u_lobe / self.share, u)),
            false => {
                let rest = (u_lobe - self.share) / (1.0 - self.share);
                bsdf.sample(rest.min(1.0 - f32::EPSILON / 2.0), u)
            }
        }
    }

    /// Weight and density of a drawn direction, from those of the BSDF alone to those of the mixture.
    pub fn weigh(&self, sample: &mut BsdfSample) {
        if sample.delta {
            sample.weight /= 1.0 - self.share;
            return;
        }
        let pdf = self.mixed(sample.wi, sample.pdf);
        sample.weight *= sample.pdf / pdf;
        sample.pdf = pdf;
    }
}

#[cfg(test)]
mod tests;
