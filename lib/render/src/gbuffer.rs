//! Depth, normal, albedo and coverage of every pixel.
use dipir_imaging::error::ImagingError;
use dipir_imaging::layer_rows::LayerRows;
use dipir_imaging::layers::Precision;
use dipir_imaging::raster::Raster;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::camera::Ray;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::denoise::auxiliary::{self, Auxiliary};
use crate::error::RenderError;
use crate::features::{EVERYTHING, with_features};
use crate::footprint::Footprint;
use crate::gloss::Gloss;
use crate::job::{Job, Layer};
use crate::render::Renderer;
use crate::world::World;

/// Geometry and albedo as the camera sees them: 36 bytes a pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct GBuffer(pub Raster<Pixel>);

/// What one pixel shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel {
    /// Distance along the optical axis to the nearest surface, object before proxy, metres;
    /// infinite where there is none. Not averaged: edges keep the nearest of their samples.
    pub depth: f32,
    /// Unit shading normal of the object, else normal of the proxy, world space; 0 where neither.
    pub normal: Vec3,
    /// Base colour of the object, linear, not premultiplied; 0 where there is none.
    pub albedo: Vec3,
    /// Antialiased coverage of the object.
    pub object_alpha: f32,
    /// Antialiased coverage of the proxy, whether the object hides it or not.
    pub proxy_alpha: f32,
}

/// Samples of a pixel that shows an edge: coverage in steps of a sixteenth. Fewer where rays are slow
/// ([`affordable_share`]).
///
/// [`affordable_share`]: dipir_scene::bvh::Bvh::affordable_share
const SAMPLES: u32 = 16;
/// Samples of a pixel that may show the object. It takes the others if these differ among themselves, or from those of
/// the pixels around it.
const FIRST_SAMPLES: u32 = 4;
/// Cosine between normals, and difference of base colours, from which samples differ.
const SAME_NORMAL: f32 = 0.99;
const SAME_COLOUR: f32 = 0.02;
/// Rows that are computed together, and share the corners of their pixels.
const BAND: usize = 16;

/// What the first samples of a pixel say of the object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum First {
    /// None of them meets it.
    Missed,
    /// All meet it and are alike.
    Even,
    /// All meet it, and normals or colours differ.
    Uneven,
    /// Some meet it.
    Edge,
}

impl GBuffer {
    /// Of the scene of `renderer`, textures included.
    pub fn new(renderer: &Renderer, seed: u64) -> Result<Self, RenderError> {
        let world = renderer.world(EVERYTHING)?;
        let share = world.geometry.bvh.affordable_share();
        let samples = (SAMPLES as f32 * share).ceil() as u32;
        let view = View::new(&world, seed);
        let (mut pixels, first) = view.first(samples);
        if samples > FIRST_SAMPLES {
            let width = pixels.width();
            let rows = pixels.pixels_mut().par_chunks_mut(width);
            rows.enumerate().for_each(|(y, row)| {
                for (x, pixel) in row.iter_mut().enumerate() {
                    if needs_more(&first, x, y) {
                        view.object(pixel, (x, y), samples);
                    }
                }
            });
        }
        Ok(Self(pixels))
    }

    /// As the channels `depth.Z normal.X/Y/Z albedo.R/G/B object.A proxy.A`; depth in full
    /// precision, the rest in half.
    pub fn to_rows(&self) -> Result<LayerRows<'_>, ImagingError> {
        let pixels = self.0.pixels();
        let mut rows = LayerRows::new(self.0.width(), self.0.height());
        let half = Precision::Half;
        rows.insert_pixels(["depth.Z"], Precision::Full, |i| [pixels[i].depth])?;
        let normals = ["normal.X", "normal.Y", "normal.Z"];
        rows.insert_pixels(normals, half, |i| pixels[i].normal)?;
        let colours = ["albedo.R", "albedo.G", "albedo.B"];
        rows.insert_pixels(colours, half, |i| pixels[i].albedo)?;
        rows.insert_pixels(["object.A"], half, |i| [pixels[i].object_alpha])?;
        rows.insert_pixels(["proxy.A"], half, |i| [pixels[i].proxy_alpha])?;
        Ok(rows)
    }
}

/// The surfaces in the pixels of the object that `jobs` sample.
pub(crate) fn auxiliary(world: &World, jobs: &[Job], seed: u64) -> Auxiliary {
    let view = View::new(world, seed);
    let objects = jobs.iter().filter(|job| job.layer == Layer::Object);
    let pixels: Vec<_> = objects.flat_map(|job| job.pixels.iter()).collect();
    let seen = pixels.par_iter().map(|&(x, y)| {
        let mut pixel = Pixel::EMPTY;
        let at = (x as usize, y as usize);
        if view.object(&mut pixel, at, FIRST_SAMPLES) == First::Uneven {
            view.object(&mut pixel, at, SAMPLES);
        }
        let place = Vec2::new(x as f32, y as f32) + 0.5;
        let reach = world.optics.reach_px(world.camera(), place, pixel.depth);
        // Where it is blurred, neighbours hardly differ, and a few rays tell only noise.
        match reach.max_element() > 1.0 {
            true => auxiliary::Seen::default(),
            false => auxiliary::Seen::new(pixel.normal, pixel.albedo),
        }
    });
    let seen: Vec<_> = seen.collect();
    let [width, height] = world.camera().resolution.map(|n| n as usize);
    let mut auxiliary = Auxiliary::new(width, height);
    for ((x, y), seen) in pixels.into_iter().zip(seen) {
        auxiliary.set(x as usize, y as usize, seen);
    }
    auxiliary
}

impl Pixel {
    const EMPTY: Self = Self {
        depth: f32::INFINITY,
        normal: Vec3::ZERO,
        albedo: Vec3::ZERO,
        object_alpha: 0.0,
        proxy_alpha: 0.0,
    };
}

/// Whether the first samples of the pixel at `(x, y)` are too few.
fn needs_more(first: &Raster<First>, x: usize, y: usize) -> bool {
    let mine = *first.get(x, y);
    let hit = |f: First| f != First::Missed;
    let around = |n: usize, end: usize| n.saturating_sub(1)..(n + 2).min(end);
    matches!(mine, First::Uneven | First::Edge)
        || around(y, first.height()).any(|v| {
            let row = first.row(v);
            around(x, first.width()).any(|u| row[u] == First::Edge || hit(row[u]) != hit(mine))
        })
}

/// A scene as it is sampled.
struct View<'a> {
    world: &'a World<'a>,
    footprint: Footprint,
    seed: u64,
}

impl<'a> View<'a> {
    fn new(world: &'a World, seed: u64) -> Self {
        let bvh = &world.geometry.bvh;
        Self {
            world,
            footprint: Footprint::new(world.camera(), world.optics, bvh.bounds(), bvh.clusters()),
            seed,
        }
    }

    /// All pixels with the proxy and the first samples of the object.
    fn first(&self, samples: u32) -> (Raster<Pixel>, Raster<First>) {
        let [width, height] = self.world.camera().resolution.map(|n| n as usize);
        let mut pixels = Raster::filled(width, height, Pixel::EMPTY);
        let mut first = Raster::filled(width, height, First::Missed);
        let bands = pixels.pixels_mut().par_chunks_mut(BAND * width);
        bands
            .zip(first.pixels_mut().par_chunks_mut(BAND * width))
            .enumerate()
            .for_each(|(i, (pixels, first))| self.band(i * BAND, pixels, first, samples));
        (pixels, first)
    }

    /// The rows from `top` on.
    fn band(&self, top: usize, pixels: &mut [Pixel], first: &mut [First], samples: u32) {
        let width = self.world.camera().resolution[0] as usize;
        let mut above = self.corners(top, width);
        let rows = pixels.chunks_mut(width).zip(first.chunks_mut(width));
        for (y, (pixels, first)) in (top..).zip(rows) {
            let below = self.corners(y + 1, width);
            for (x, pixel) in pixels.iter_mut().enumerate() {
                self.proxy(
                    pixel,
                    (x, y),
                    [above[x], above[x + 1], below[x], below[x + 1]],
                );
                if self.footprint.holds(x as u32, y as u32) {
                    first[x] = self.object(pixel, (x, y), samples.min(FIRST_SAMPLES));
                }
            }
            above = below;
        }
    }

    /// The proxy at the upper corners of the pixels of row `y`, and at the last one's right.
    fn corners(&self, y: usize, width: usize) -> Vec<Option<Seen>> {
        let corner =
            |x: usize| self.proxy_at(&self.world.camera().ray(Vec2::new(x as f32, y as f32)));
        (0..=width).map(corner).collect()
    }

    /// Sets the pixel to what it shows of the proxy: its corners, and more samples where some of them miss it.
    fn proxy(&self, pixel: &mut Pixel, at: (usize, usize), corners: [Option<Seen>; 4]) {
        let hits = corners.iter().flatten().count();
        let mut sum = Sum::default();
        match hits {
            0 => return,
            4 => corners.iter().for_each(|seen| sum.add(*seen)),
            _ => (0..SAMPLES).for_each(|i| sum.add(self.proxy_at(&self.sample(at, i).0))),
        }
        pixel.depth = sum.depth;
        pixel.normal = sum.normal.normalize_or_zero();
        pixel.proxy_alpha = sum.alpha();
    }

    /// Lays over the pixel what `samples` samples show of the object.
    fn object(&self, pixel: &mut Pixel, at: (usize, usize), samples: u32) -> First {
        let mut sum = Sum::default();
        let mut one: Option<Seen> = None;
        let mut alike = true;
        for i in 0..samples {
            let (ray, mut sampler) = self.sample(at, i);
            let seen =
                with_features!(self.world.mask, F => self.object_at::<F>(&ray, &mut sampler));
            sum.add(seen);
            if let Some(seen) = seen {
                alike &= one.get_or_insert(seen).is_like(&seen);
            }
        }
        if sum.hits > 0 {
            pixel.depth = sum.depth;
            pixel.normal = sum.normal.normalize_or_zero();
            pixel.albedo = sum.albedo / sum.hits as f32;
        }
        pixel.object_alpha = sum.alpha();
        match sum.hits {
            0 => First::Missed,
            n if n < samples => First::Edge,
            _ if alike => First::Even,
            _ => First::Uneven,
        }
    }

    /// The ray of a pixel's sample, and the numbers that follow.
    fn sample(&self, (x, y): (usize, usize), i: u32) -> (Ray, Sampler) {
        let pixel = (y as u32) << 16 | (x as u32 & 0xffff);
        let mut sampler = Sampler::new(self.seed, Stream::FOREGROUND, pixel, i);
        let place = Vec2::new(x as f32, y as f32) + sampler.next_2d();
        let ray = self.world.view_ray(place, &mut sampler);
        (self.sent_on(ray), sampler)
    }

    /// `ray` of the camera; by way of polished ground as a mirror sends it on.
    fn sent_on(&self, ray: Ray) -> Ray {
        match self.world.polished {
            Some(_) => Gloss::MIRROR
                .ray(self.world, &ray, Vec2::ZERO)
                .map_or(ray, |r| r.0),
            None => ray,
        }
    }

    fn proxy_at(&self, ray: &Ray) -> Option<Seen> {
        self.world.proxy_point(ray).map(|point| Seen {
            depth: self.world.camera().depth(point.position),
            normal: point.normal,
            albedo: Vec3::ZERO,
        })
    }

    fn object_at<const F: u32>(&self, ray: &Ray, sampler: &mut Sampler) -> Option<Seen> {
        let hit = self.world.closest::<F>(ray, sampler.next_u64())?;
        let surfaces = &self.world.surfaces;
        let surface = surfaces.interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
        Some(Seen {
            depth: self.world.camera().depth(surface.position),
            normal: surface.normal,
            albedo: surface.base_color,
        })
    }
}

/// A surface where a ray meets it.
#[derive(Clone, Copy)]
struct Seen {
    depth: f32,
    normal: Vec3,
    albedo: Vec3,
}

impl Seen {
    fn is_like(&self, other: &Self) -> bool {
        self.normal.dot(other.normal) > SAME_NORMAL
            && (self.albedo - other.albedo).abs().max_element() < SAME_COLOUR
    }
}

/// Samples of a pixel.
struct Sum {
    taken: u32,
    hits: u32,
    depth: f32,
    normal: Vec3,
    albedo: Vec3,
}

impl Default for Sum {
    fn default() -> Self {
        Self {
            taken: 0,
            hits: 0,
            depth: f32::INFINITY,
            normal: Vec3::ZERO,
            albedo: Vec3::ZERO,
        }
    }
}

impl Sum {
    fn add(&mut self, seen: Option<Seen>) {
        self.taken += 1;
        let Some(seen) = seen else { return };
        self.hits += 1;
        self.depth = self.depth.min(seen.depth);
        self.normal += seen.normal;
        self.albedo += seen.albedo;
    }

    fn alpha(&self) -> f32 {
        self.hits as f32 / self.taken as f32
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
        for y in 0..buffer.0.height() {
            let row = buffer.0.row(y);
            let wanted = (y as f32 + 1.0 - horizon).clamp(0.0, 1.0);
            let mean = row.iter().map(|p| p.proxy_alpha).sum::<f32>() / row.len() as f32;
            // The deviation of 24 means of 16 is .025.
            let tolerance = if wanted.fract() == 0.0 {
                0.0
            } else {
                4.0 * 0.025
            };
            assert!(
                (mean - wanted).abs() <= tolerance,
                "row {y}: {mean}, {wanted}"
            );
        }
        let ground = buffer.0.get(0, 23).depth;
        let other = buffer.0.get(23, 23).depth;
        assert!(ground.is_finite() && (ground / other - 1.0).abs() < 0.1);
    }

    /// What every pixel shows with `samples` samples of each.
    fn reference(renderer: &Renderer, samples: u32) -> Raster<Pixel> {
        let world = renderer.world(EVERYTHING).expect("valid");
        let view = View::new(&world, 1);
        let [width, height] = world.camera().resolution.map(|n| n as usize);
        let mut pixels = Raster::filled(width, height, Pixel::EMPTY);
        for (i, pixel) in pixels.pixels_mut().iter_mut().enumerate() {
            view.object(pixel, (i % width, i / width), samples);
        }
        pixels
    }

    #[test]
    fn edges_are_covered_as_by_many_samples_and_alone_take_more_than_the_first() {
        let ball = icosphere(Vec3::new(0.0, 0.5, 0.0), 0.5, 3);
        let view = camera(Vec3::new(0.0, 1.0, 4.0), Vec3::Y * 0.5, 20.0, 96);
        let s = scene(ball, matte(Vec3::splat(0.5)), view, ground());
        let renderer = Renderer::new(&s);
        let truth = reference(&renderer, 1024);
        let buffer = GBuffer::new(&renderer, 0).expect("sizes fit");
        let (mut edges, mut sum, mut squares) = (0.0f32, 0.0, 0.0);
        for (found, truth) in buffer.0.pixels().iter().zip(truth.pixels()) {
            if truth.object_alpha == 0.0 || truth.object_alpha == 1.0 {
                assert_eq!(found.object_alpha, truth.object_alpha);
            } else {
                let error = found.object_alpha - truth.object_alpha;
                edges += 1.0;
                sum += error;
                squares += error * error;
            }
            // Normals that differ by up to 8 degrees are the mean of four, one of each quarter: 2 degrees.
            if truth.object_alpha == 1.0 {
                assert!(found.normal.dot(truth.normal) > 0.999);
                assert!((found.albedo - 0.5).abs().max_element() < 1e-6);
            }
        }
        // A straight edge crosses at most 7 of the 4 x 4 cells that hold a sample each, with a variance of at most 1/4.
        let deviation = (squares / edges).sqrt();
        assert!(deviation < (7.0f32 / 4.0).sqrt() / 16.0, "{deviation}");
        let bias = sum / edges;
        assert!(bias.abs() < 4.0 * deviation / edges.sqrt(), "{bias}");

        let world = renderer.world(EVERYTHING).expect("valid");
        let (_, first) = View::new(&world, 0).first(SAMPLES);
        let places = (0..96).flat_map(|y| (0..96).map(move |x| (x, y)));
        let more = places.filter(|(x, y)| needs_more(&first, *x, *y)).count();
        // Pixels of the edge and on either side of it.
        assert!(more as f32 <= 3.0 * edges, "{more} of {edges}");
    }

    #[test]
    fn a_texture_takes_more_samples_where_its_colours_differ() {
        let tiles = |colour: f32| Seen {
            depth: 1.0,
            normal: Vec3::Y,
            albedo: Vec3::splat(colour),
        };
        assert!(tiles(0.5).is_like(&tiles(0.51)));
        assert!(!tiles(0.5).is_like(&tiles(0.53)));
        let mut first = Raster::filled(3, 3, First::Even);
        assert!(!needs_more(&first, 0, 0));
        *first.get_mut(2, 2) = First::Uneven;
        assert!(needs_more(&first, 2, 2) && !needs_more(&first, 1, 1));
        *first.get_mut(2, 2) = First::Missed;
        assert!(needs_more(&first, 1, 1) && !needs_more(&first, 0, 1));
    }
}
