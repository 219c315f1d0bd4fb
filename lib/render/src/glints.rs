//! Glints: images of a small, bright light in polished surfaces, smaller than a pixel.
//!
//! A sample meets such an image with a chance of one in hundreds or thousands. Until one does, neither the
//! picture nor its estimated error knows of it, and a sun in the lacquer of a small or distant car
//! is lost. What finds it is the same pixel lit as if surfaces were nearly as rough as they are curved within it:
//! the same light arrives, spread over a good part of the pixel [path mollification as in path space
//! regularization, Kaplanyan and Dachsbacher 2013]. Where that is brighter or darker than what was sampled, the
//! pixel's square is scanned in the same way, cell by cell and then the brightest cells part by part, and from then
//! on sampled more where the scans are bright ([`Focus`]). The picture itself is made of samples of the true surfaces alone,
//! divided by their density, and stays unbiased.
use std::collections::HashMap;
use std::time::{Duration, Instant};

use dipir_imaging::composite::composite_pixel;
use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::square_to_sphere;
use glam::{UVec2, Vec2, Vec3};
use rayon::prelude::*;

use crate::counters::{RayCounts, RayKind};
use crate::features::with_features;
use crate::film::{Film, Viewing};
use crate::foreground::PathContext;
use crate::light::PathLight;

/// Camera rays that look how curved a surface is within a pixel.
const RAYS_PER_PIXEL: u32 = 8;
/// Paths through a pixel that may hold a glint, and through one that seems to.
const PATHS_PER_PIXEL: [u32; 2] = [32, 128];
/// How much rougher surfaces get, as a share of the spread of normals: the lobe fills the tenth part of
/// the pixel, so that every picture of a glint is met, and remains much brighter than without.
const MOLLIFIED: f32 = 1.0 / 3.0;
/// Display values by which a pixel must differ.
const NOTICEABLE: f32 = 0.04;
/// A source this many times brighter than the rest of the light is about as bright as the rest when a dielectric
/// mirrors it.
const BRIGHT: f32 = 25.0;
/// Columns and rows of cells in a pixel, scan by scan.
const SIDES: [u32; 3] = [16, 64, 256];
/// Cells of a scan whose parts the next looks at.
const LOOKED_INTO: usize = 16;
/// Paths through every cell of a scan.
const PATHS_PER_CELL: u32 = 4;
/// Paths of all scans of a pixel.
const PATHS_PER_SCAN: u64 =
    ((SIDES[0] * SIDES[0] + 2 * LOOKED_INTO as u32 * PARTS) * PATHS_PER_CELL) as u64;
/// Of so many pixels all are looked at that are smooth enough; of more only those whose first surface may mirror a
/// source.
const MOST_INDIRECT: usize = 4096;
/// So many pixels may be scanned, however few samples the picture has taken.
const LEAST_SCANS: usize = 32;
/// Share of the samples of a pixel in focus that are spread evenly; each scan directs as many of the others.
const EVEN: f32 = 0.5;
/// The largest number below 1.
const BELOW_1: f32 = 1.0 - f32::EPSILON / 2.0;
/// The farthest place in a cell that is still told from the next one: eight bits number the cells of a row.
const WITHIN_CELL: f32 = 1.0 - f32::EPSILON * 128.0;

/// Where in a pixel its samples go: a density on the unit square, a mixture of an even one and of one for each scan,
/// constant on its cells.
#[derive(Clone, Debug, PartialEq)]
pub struct Focus {
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

impl Focus {
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

/// What looking for glints led to.
#[derive(Clone, Debug, Default)]
pub struct Found {
    /// Pixels whose samples should be drawn anew, and where in them.
    pub pixels: Vec<((u32, u32), Focus)>,
    /// Rays that it took, but for those that found a pixel too rough or too flat.
    pub counts: RayCounts,
}

/// How long is looked for glints.
#[derive(Clone, Copy, Debug)]
pub enum Patience {
    /// For a sixteenth as many paths as the picture has taken samples, and at least some.
    Samples(u64),
    /// Until then.
    Until(Instant),
}

impl Patience {
    /// How many pixels may be scanned.
    fn scans(self) -> usize {
        match self {
            Self::Samples(n) => LEAST_SCANS.max((n / 16 / PATHS_PER_SCAN) as usize),
            Self::Until(_) => usize::MAX,
        }
    }

    /// Whether there is no time for so many seconds of work.
    fn is_over(self, seconds: f64) -> bool {
        match self {
            Self::Samples(_) => false,
            Self::Until(end) => Instant::now() + Duration::from_secs_f64(seconds) >= end,
        }
    }
}

/// A pixel that may hold a glint.
struct Suspect {
    pixel: (u32, u32),
    /// Spread of the normals in the pixel, radians.
    spread: f32,
    /// Whether a bright source may be mirrored by the first surface that is met.
    is_direct: bool,
    /// How far the display value is from that with rougher surfaces.
    difference: f32,
    counts: RayCounts,
}

/// Of `pixels`, those whose samples should be drawn anew, with where: glints that were not met, or by chance.
/// `film` holds what was sampled so far. Traces nothing where the light has no bright source.
pub fn find<L: PathLight>(
    path: &PathContext<L>,
    film: &Film,
    viewing: &Viewing,
    pixels: &[(u32, u32)],
    patience: Patience,
    seed: u64,
) -> Found {
    let sources = bright_sources(path.light, seed);
    if sources.is_empty() {
        return Found::default();
    }
    with_features!(path.world.mask, F => {
        let mut suspects = suspects::<_, F>(path, &sources, pixels, seed);
        if suspects.len() > MOST_INDIRECT {
            suspects.retain(|s| s.is_direct);
        }
        look_into::<_, F>(path, film, viewing, suspects, patience, seed)
    })
}

/// The sequence of `pixel`.
fn sequence(seed: u64, (x, y): (u32, u32)) -> Sampler {
    Sampler::new(seed, Stream::GLINTS, (y << 16) | (x & 0xffff), 0)
}

/// Pixels in which a surface is smoother than it is curved.
fn suspects<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    sources: &[Vec3],
    pixels: &[(u32, u32)],
    seed: u64,
) -> Vec<Suspect> {
    let suspects = pixels.par_iter().filter_map(|&pixel| {
        let mut counts = RayCounts::default();
        let sampler = sequence(seed, pixel);
        let (spread, is_direct) =
            spread_of_normals::<_, F>(path, sources, pixel, &sampler, &mut counts)?;
        Some(Suspect {
            pixel,
            spread,
            is_direct,
            difference: 0.0,
            counts,
        })
    });
    suspects.collect()
}

/// Scans those of `suspects` that rougher surfaces confirm.
fn look_into<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    film: &Film,
    viewing: &Viewing,
    mut suspects: Vec<Suspect>,
    patience: Patience,
    seed: u64,
) -> Found {
    let ask = |suspect: &mut Suspect, paths| {
        if patience.is_over(0.0) {
            suspect.difference = 0.0;
            return;
        }
        let rougher = path.at_least_as_rough_as(MOLLIFIED * suspect.spread);
        let sampler = sequence(seed, suspect.pixel);
        let found = rougher.mean::<F>(suspect.pixel, paths, &sampler, &mut suspect.counts);
        suspect.difference = noticed(film, viewing, suspect.pixel, found);
    };
    let mut counts = RayCounts::default();
    let (clock, asked) = (Instant::now(), suspects.len());
    for paths in PATHS_PER_PIXEL {
        suspects.par_iter_mut().for_each(|s| ask(s, paths));
        let clear = |s: &Suspect| s.difference <= NOTICEABLE;
        suspects
            .iter()
            .filter(|s| clear(s))
            .for_each(|s| counts.merge(&s.counts));
        suspects.retain(|s| !clear(s));
    }
    // The second question only makes this longer, and a scan seem to take longer.
    let paths = (asked as u64 * u64::from(PATHS_PER_PIXEL[0])).max(1) as f64;
    let threads = rayon::current_num_threads() as f64;
    let scan_s = clock.elapsed().as_secs_f64() * threads / paths * PATHS_PER_SCAN as f64;
    suspects.sort_by(|a, b| b.difference.total_cmp(&a.difference));
    let scanned = suspects.len().min(patience.scans());
    let found = suspects[..scanned].par_iter_mut().filter_map(|s| {
        if patience.is_over(scan_s) {
            return None;
        }
        let focus = path.scan::<F>(s.pixel, s.spread, &sequence(seed, s.pixel), &mut s.counts);
        Some((s.pixel, focus))
    });
    let pixels = found.collect();
    suspects.iter().for_each(|s| counts.merge(&s.counts));
    Found { pixels, counts }
}

/// Directions of sources that outshine the rest of the light by [`BRIGHT`].
fn bright_sources(light: &impl PathLight, seed: u64) -> Vec<Vec3> {
    let (mut drawn, mut rest) = (Vec::new(), 0.0);
    let n = 64;
    for sample in 0..n {
        let mut sampler = Sampler::new(seed, Stream::GLINTS, u32::MAX, sample);
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

/// How far normals in `pixel` lie from their mean, radians, and whether they may mirror one of `sources`; `None` where no
/// surface is smoother than that.
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
    // Corners lie farther out than the normals that were met.
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

    /// Where in `pixel`, whose normals differ by `spread`, it is brighter than in most of it: in cells that are
    /// small, in the parts of the brightest of them, and in theirs.
    fn scan<const F: u32>(
        &self,
        (x, y): (u32, u32),
        spread: f32,
        sampler: &Sampler,
        counts: &mut RayCounts,
    ) -> Focus {
        let corner = Vec2::new(x as f32, y as f32);
        let mut cells: Vec<u32> = (0..SIDES[0] * SIDES[0]).collect();
        let mut usual = None;
        let mut focus = Focus { scans: Vec::new() };
        // Behind the samples that looked for suspects.
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
            focus.scans.extend(Scan::new(side, seen.clone()));
            if let Some(&finer) = SIDES.get(number + 1) {
                seen.sort_by(|a, b| b.1.total_cmp(&a.1));
                seen.truncate(LOOKED_INTO);
                cells = seen.iter().flat_map(|s| parts(s.0, side, finer)).collect();
            }
        }
        focus
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

/// Every cell with what it and its neighbours return: paths are few, and a glint has an extent.
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
    let background = viewing.background(x, y);
    let alpha = *film.alpha.get(x, y);
    let shown = |radiance| {
        let linear = composite_pixel(background, radiance, alpha, *film.shadow.get(x, y));
        let encode = |v: f32| viewing.transfer.encode_scalar(v.max(0.0)).clamp(0.0, 1.0);
        Vec3::from(linear.to_array().map(encode))
    };
    let rescaled = radiance * (alpha / coverage.max(f32::MIN_POSITIVE));
    (shown(rescaled) - shown(*film.object.get(x, y)))
        .abs()
        .max_element()
}

#[cfg(test)]
mod tests;
