//! Highlights smaller than a pixel: reflections of a small, bright light in polished surfaces.
//!
//! One in hundreds or thousands of samples meets such a reflection. Until one does, it is missing from the
//! picture and from its estimated error: the sun in the lacquer of a distant car is lost. To find
//! highlights, the pixel is traced with surfaces nearly as rough as they are curved within it: the
//! same light arrives, spread over a large part of the pixel [path space regularization, Kaplanyan
//! and Dachsbacher 2013]. Where the result differs from what was sampled, the pixel's square is
//! scanned with such surfaces, first cell by cell, then the brightest cells at finer scales. From
//! then on samples are drawn in proportion to what the scans found ([`PixelDensity`]). All samples
//! of the picture use the true surfaces and are divided by their density, so it stays unbiased.
use std::collections::HashMap;
use std::time::{Duration, Instant};

use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::square_to_sphere;
use glam::{UVec2, Vec2, Vec3};
use rayon::prelude::*;

use crate::counters::{RayCounts, RayKind};
use crate::features::with_features;
use crate::film::Film;
use crate::foreground::PathContext;
use crate::light::PathLight;
use crate::viewing::Viewing;

/// Camera rays that measure how curved a surface is within a pixel.
const RAYS_PER_PIXEL: u32 = 8;
/// Paths through a pixel that may hold a highlight, and through one whose first paths found one.
const PATHS_PER_PIXEL: [u32; 2] = [32, 128];
/// Roughness that surfaces get, as a share of the spread of normals: the lobe then fills a tenth of the pixel,
/// so that paths meet every highlight, and it is still much brighter than its surroundings.
const MOLLIFIED: f32 = 1.0 / 3.0;
/// Display values by which a pixel must differ.
const NOTICEABLE: f32 = 0.04;
/// A source this many times brighter than the mean of the light is, reflected by a dielectric, about as bright as
/// that mean.
const BRIGHT: f32 = 25.0;
/// Columns and rows of cells in a pixel, scan by scan.
const SIDES: [u32; 3] = [16, 64, 256];
/// Brightest cells of a scan that the next scan refines.
const REFINED: usize = 16;
/// Paths through every cell of a scan.
const PATHS_PER_CELL: u32 = 4;
/// Paths of all scans of a pixel.
const PATHS_PER_SCAN: u64 =
    ((SIDES[0] * SIDES[0] + 2 * REFINED as u32 * PARTS) * PATHS_PER_CELL) as u64;
/// Most candidate pixels that are all tested; if there are more, only those whose first surface may mirror a source
/// are.
const MOST_INDIRECT: usize = 4096;
/// Pixels that may be scanned, however few samples the picture has taken.
const LEAST_SCANS: usize = 32;
/// Share of a pixel's samples that are uniform; the scans share the others equally.
const EVEN: f32 = 0.5;
/// The largest number below 1.
const BELOW_1: f32 = 1.0 - f32::EPSILON / 2.0;
/// The farthest place in a cell that does not round to the next one: eight bits number the cells of a row.
const WITHIN_CELL: f32 = 1.0 - f32::EPSILON * 128.0;

/// Density of the samples within a pixel, on the unit square: a mixture of a uniform one and one for each scan, which
/// is constant on its cells.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PixelDensity {
    scans: Vec<Scan>,
}

/// Cells of a square in order, with their shares.
#[derive(Clone, Debug, PartialEq)]
struct Scan {
    side: u32,
    /// Row times columns plus column of each cell, increasing.
    cells: Vec<u32>,
    /// Running sums of their shares; the last is 1.
    cumulative: Vec<f32>,
}

impl Scan {
    /// Shares in proportion to what cells return, all of them 0 or more; `None` if nothing does.
    fn new(side: u32, mut responses: Vec<(u32, f32)>) -> Option<Self> {
        responses.retain(|r| r.1 > 0.0);
        responses.sort_by_key(|r| r.0);
        let total: f64 = responses.iter().map(|r| f64::from(r.1)).sum();
        let mut sum = 0.0;
        let cumulative = responses.iter().map(|r| {
            sum += f64::from(r.1);
            (sum / total) as f32
        });
        let cumulative: Vec<f32> = cumulative.collect();
        (!cumulative.is_empty()).then(|| Self {
            side,
            cells: responses.iter().map(|r| r.0).collect(),
            cumulative,
        })
    }

    fn share(&self, index: usize) -> f32 {
        let before = match index {
            0 => 0.0,
            _ => self.cumulative[index - 1],
        };
        self.cumulative[index] - before
    }

    fn place(&self, u: Vec2) -> Vec2 {
        // Below 1, the last of the sums, so that the cell has a share.
        let number = u.x.min(BELOW_1);
        let index = self.cumulative.partition_point(|&c| c <= number);
        let before = self.cumulative[index] - self.share(index);
        let within = Vec2::new((number - before) / self.share(index), u.y);
        let corner = corner_of(self.cells[index], self.side);
        // Rounding must not leave the cell, whose density is that of the sample.
        (corner + within.clamp(Vec2::ZERO, Vec2::splat(WITHIN_CELL))) / self.side as f32
    }

    fn density(&self, point: Vec2) -> f32 {
        let at = (point * self.side as f32)
            .as_uvec2()
            .min(UVec2::splat(self.side - 1));
        match self.cells.binary_search(&(at.y * self.side + at.x)) {
            Ok(index) => self.share(index) * (self.side * self.side) as f32,
            Err(_) => 0.0,
        }
    }
}

fn corner_of(cell: u32, side: u32) -> Vec2 {
    Vec2::new((cell % side) as f32, (cell / side) as f32)
}

impl PixelDensity {
    /// A point of the unit square from two uniform numbers, and one over its density.
    pub fn place(&self, u: Vec2) -> (Vec2, f32) {
        let each = (1.0 - EVEN) / self.scans.len() as f32;
        let even = match self.scans.len() {
            0 => 1.0,
            _ => EVEN,
        };
        let point = if u.x < even {
            Vec2::new(u.x / even, u.y)
        } else {
            let number = (u.x - even) / each;
            let index = (number as usize).min(self.scans.len() - 1);
            self.scans[index].place(Vec2::new(number - index as f32, u.y))
        };
        let directed: f32 = self.scans.iter().map(|s| s.density(point) * each).sum();
        (point, 1.0 / (even + directed))
    }
}

/// Result of the search for highlights.
#[derive(Clone, Debug, Default)]
pub struct Found {
    /// Pixels whose samples are to be drawn again, with their densities.
    pub pixels: Vec<((u32, u32), PixelDensity)>,
    /// Rays that the search traced, without those of pixels that are too rough or too flat.
    pub counts: RayCounts,
}

/// Effort that the search may take.
#[derive(Clone, Copy, Debug)]
pub enum Limit {
    /// A sixteenth as many paths as the picture has taken samples, and at least some.
    Samples(u64),
    /// All that fits before this time.
    Until(Instant),
}

impl Limit {
    /// How many pixels may be scanned.
    fn scans(self) -> usize {
        match self {
            Self::Samples(n) => LEAST_SCANS.max((n / 16 / PATHS_PER_SCAN) as usize),
            Self::Until(_) => usize::MAX,
        }
    }

    /// Whether `seconds` of work no longer fit.
    fn is_over(self, seconds: f64) -> bool {
        match self {
            Self::Samples(_) => false,
            Self::Until(end) => Instant::now() + Duration::from_secs_f64(seconds) >= end,
        }
    }
}

/// A pixel that may hold a highlight.
struct Candidate {
    pixel: (u32, u32),
    /// Spread of the normals in the pixel, radians.
    spread: f32,
    /// Whether a bright source may be mirrored by the first surface that is met.
    is_direct: bool,
    /// How far the display value is from that with rougher surfaces.
    difference: f32,
    counts: RayCounts,
}

/// The pixels among `pixels` with highlights that the samples in `film` missed or met by chance, and the
/// density of new samples in each. Traces nothing where the light has no bright source.
pub fn find<L: PathLight>(
    path: &PathContext<L>,
    film: &Film,
    viewing: &Viewing,
    pixels: &[(u32, u32)],
    limit: Limit,
    seed: u64,
) -> Found {
    let sources = bright_sources(path.light, seed);
    if sources.is_empty() {
        return Found::default();
    }
    with_features!(path.world.mask, F => {
        let mut candidates = candidates::<_, F>(path, &sources, pixels, seed);
        if candidates.len() > MOST_INDIRECT {
            candidates.retain(|s| s.is_direct);
        }
        scan_candidates::<_, F>(path, film, viewing, candidates, limit, seed)
    })
}

/// The sequence of `pixel`.
fn sequence(seed: u64, (x, y): (u32, u32)) -> Sampler {
    Sampler::new(seed, Stream::HIGHLIGHTS, (y << 16) | (x & 0xffff), 0)
}

/// Pixels in which a surface is smoother than it is curved.
fn candidates<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    sources: &[Vec3],
    pixels: &[(u32, u32)],
    seed: u64,
) -> Vec<Candidate> {
    let candidates = pixels.par_iter().filter_map(|&pixel| {
        let mut counts = RayCounts::default();
        let sampler = sequence(seed, pixel);
        let (spread, is_direct) =
            spread_of_normals::<_, F>(path, sources, pixel, &sampler, &mut counts)?;
        Some(Candidate {
            pixel,
            spread,
            is_direct,
            difference: 0.0,
            counts,
        })
    });
    candidates.collect()
}

/// Scans those of `candidates` that differ when traced with rougher surfaces.
fn scan_candidates<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    film: &Film,
    viewing: &Viewing,
    mut candidates: Vec<Candidate>,
    limit: Limit,
    seed: u64,
) -> Found {
    let test = |candidate: &mut Candidate, paths| {
        if limit.is_over(0.0) {
            candidate.difference = 0.0;
            return;
        }
        let rougher = path.at_least_as_rough_as(MOLLIFIED * candidate.spread);
        let sampler = sequence(seed, candidate.pixel);
        let found = rougher.mean::<F>(candidate.pixel, paths, &sampler, &mut candidate.counts);
        candidate.difference = noticed(film, viewing, candidate.pixel, found);
    };
    let mut counts = RayCounts::default();
    let (clock, tested) = (Instant::now(), candidates.len());
    for paths in PATHS_PER_PIXEL {
        candidates.par_iter_mut().for_each(|s| test(s, paths));
        let clear = |s: &Candidate| s.difference <= NOTICEABLE;
        candidates
            .iter()
            .filter(|s| clear(s))
            .for_each(|s| counts.merge(&s.counts));
        candidates.retain(|s| !clear(s));
    }
    // The second test adds to the time, which overstates that of a scan.
    let paths = (tested as u64 * u64::from(PATHS_PER_PIXEL[0])).max(1) as f64;
    let threads = rayon::current_num_threads() as f64;
    let scan_s = clock.elapsed().as_secs_f64() * threads / paths * PATHS_PER_SCAN as f64;
    candidates.sort_by(|a, b| b.difference.total_cmp(&a.difference));
    let scanned = candidates.len().min(limit.scans());
    let found = candidates[..scanned].par_iter_mut().filter_map(|s| {
        if limit.is_over(scan_s) {
            return None;
        }
        let density = path.scan::<F>(s.pixel, s.spread, &sequence(seed, s.pixel), &mut s.counts);
        Some((s.pixel, density))
    });
    let pixels = found.collect();
    candidates.iter().for_each(|s| counts.merge(&s.counts));
    Found { pixels, counts }
}

/// Directions of sources that outshine the rest of the light by [`BRIGHT`].
fn bright_sources(light: &impl PathLight, seed: u64) -> Vec<Vec3> {
    let (mut drawn, mut rest) = (Vec::new(), 0.0);
    let n = 64;
    for sample in 0..n {
        let mut sampler = Sampler::new(seed, Stream::HIGHLIGHTS, u32::MAX, sample);
        let source = light.sample(sampler.next_2d());
        if source.pdf > 0.0 {
            drawn.push((source.direction, luminance(source.radiance)));
        }
        let direction = square_to_sphere(sampler.next_2d());
        rest += luminance(light.eval_with_pdf(direction).0) / n as f32;
    }
    let bright = drawn.iter().filter(|d| d.1 > BRIGHT * rest);
    bright.map(|d| d.0).collect()
}

/// Largest angle of the normals in `pixel` to their mean, radians, and whether they may mirror one of `sources`; `None`
/// where no surface is smoother than that.
fn spread_of_normals<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    sources: &[Vec3],
    (x, y): (u32, u32),
    sampler: &Sampler,
    counts: &mut RayCounts,
) -> Option<(f32, bool)> {
    let world = path.world;
    let corner = Vec2::new(x as f32, y as f32);
    let (mut normals, mut smoothest) = (Vec::with_capacity(RAYS_PER_PIXEL as usize), 1f32);
    for sample in 0..RAYS_PER_PIXEL {
        let mut sampler = sampler.with_sample(sample);
        let ray = world.camera().ray(corner + sampler.next_2d());
        let alpha_key = sampler.next_u64();
        counts.add(RayKind::Camera);
        if let Some(hit) = world.closest::<F>(&ray, alpha_key) {
            let surface = world
                .surfaces
                .interact::<F>(ray.direction, hit.triangle, hit.u, hit.v);
            let coat = match surface.coat.factor > 0.0 {
                true => surface.coat.roughness,
                false => 1.0,
            };
            smoothest = smoothest.min(surface.roughness.min(coat).powi(2));
            normals.push(surface.normal);
        }
    }
    let mean = normals.iter().sum::<Vec3>().try_normalize()?;
    let spread = normals
        .iter()
        .fold(0f32, |s, n| s.max(n.angle_between(mean)));
    let view = -world.camera().ray(corner + 0.5).direction;
    // The pixel's corners lie farther out than the sampled normals.
    let mirrors = |source: &Vec3| {
        let half = (view + *source).try_normalize();
        half.is_some_and(|half| half.angle_between(mean) < 2.0 * spread)
    };
    (smoothest < MOLLIFIED * spread).then(|| (spread, sources.iter().any(mirrors)))
}

impl<L: PathLight> PathContext<'_, L> {
    /// The same paths, lit as if microfacets spread by at least `angle`, radians.
    fn at_least_as_rough_as(&self, angle: f32) -> Self {
        Self {
            min_lit_roughness: angle.clamp(0.0, 1.0).sqrt(),
            guide: None,
            ..*self
        }
    }

    /// Mean radiance and coverage of `pixel` over `paths` paths.
    fn mean<const F: u32>(
        &self,
        (x, y): (u32, u32),
        paths: u32,
        sampler: &Sampler,
        counts: &mut RayCounts,
    ) -> (Vec3, f32) {
        let corner = Vec2::new(x as f32, y as f32);
        let (mut radiance, mut coverage) = (Vec3::ZERO, 0.0);
        for sample in 0..paths {
            let mut sampler = sampler.with_sample(sample);
            let found = self.camera_sample::<F>(corner, &mut sampler, counts);
            radiance += found.radiance / paths as f32;
            coverage += found.coverage / paths as f32;
        }
        (radiance, coverage)
    }

    /// Density of samples in `pixel`, whose normals differ by `spread`. All cells are scanned, then the brightest
    /// ones in smaller cells, and so on.
    fn scan<const F: u32>(
        &self,
        (x, y): (u32, u32),
        spread: f32,
        sampler: &Sampler,
        counts: &mut RayCounts,
    ) -> PixelDensity {
        let corner = Vec2::new(x as f32, y as f32);
        let mut cells: Vec<u32> = (0..SIDES[0] * SIDES[0]).collect();
        let mut usual = None;
        let mut density = PixelDensity::default();
        // After the samples that tested candidates.
        let mut index = PATHS_PER_PIXEL[1];
        for (number, side) in SIDES.into_iter().enumerate() {
            let rougher = self.at_least_as_rough_as(2.0 * spread / side as f32);
            let mut seen: Vec<(u32, f32)> = Vec::with_capacity(cells.len());
            for &cell in &cells {
                let mut sum = 0.0;
                for _ in 0..PATHS_PER_CELL {
                    let mut sampler = sampler.with_sample(index);
                    index += 1;
                    let place = corner_of(cell, side) + sampler.next_2d();
                    let point = corner + place / side as f32;
                    let found = rougher.image_sample::<F>(point, &mut sampler, counts);
                    sum += luminance(found.radiance);
                }
                seen.push((cell, sum));
            }
            let usual = *usual.get_or_insert_with(|| median(&seen));
            seen.iter_mut().for_each(|s| s.1 = (s.1 - usual).max(0.0));
            let mut seen = spread_out(&seen, side);
            density.scans.extend(Scan::new(side, seen.clone()));
            if let Some(&finer) = SIDES.get(number + 1) {
                seen.sort_by(|a, b| b.1.total_cmp(&a.1));
                seen.truncate(REFINED);
                cells = seen.iter().flat_map(|s| parts(s.0, side, finer)).collect();
            }
        }
        density
    }
}

/// Parts of a cell in the next scan.
const PARTS: u32 = (SIDES[1] / SIDES[0]).pow(2);

/// The cells of a scan with `finer` columns that make up `cell` of one with `side`.
fn parts(cell: u32, side: u32, finer: u32) -> impl Iterator<Item = u32> {
    let n = finer / side;
    let (x, y) = (cell % side * n, cell / side * n);
    (0..n * n).map(move |i| (y + i / n) * finer + x + i % n)
}

fn median(seen: &[(u32, f32)]) -> f32 {
    let mut values: Vec<f32> = seen.iter().map(|s| s.1).collect();
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

/// Every cell with the sum over it and its neighbours: paths are few, and a highlight has an extent.
fn spread_out(seen: &[(u32, f32)], side: u32) -> Vec<(u32, f32)> {
    let values: HashMap<u32, f32> = seen.iter().copied().collect();
    let around = |i: u32| i.saturating_sub(1)..(i + 2).min(side);
    seen.iter()
        .map(|&(cell, _)| {
            let rows = around(cell / side);
            let cells = rows.flat_map(|y| around(cell % side).map(move |x| y * side + x));
            (cell, cells.filter_map(|c| values.get(&c)).sum())
        })
        .collect()
}

/// By how much the display value of `pixel` would differ with the radiance of `found` in it, at most over the
/// channels; coverage is the same and would only add its noise.
fn noticed(
    film: &Film,
    viewing: &Viewing,
    (x, y): (u32, u32),
    (radiance, coverage): (Vec3, f32),
) -> f32 {
    let (x, y) = (x as usize, y as usize);
    let alpha = *film.alpha.get(x, y);
    let shown = |radiance| viewing.shown((x, y), radiance, alpha, *film.shadow.get(x, y));
    let rescaled = radiance * (alpha / coverage.max(f32::MIN_POSITIVE));
    (shown(rescaled) - shown(*film.object.get(x, y)))
        .abs()
        .max_element()
}

#[cfg(test)]
mod tests;
