//! Shadows without most of their noise: non-local means between the two halves of the samples.
//!
//! A shadow ratio has no texture: pixels whose surroundings look alike have nearly the same value. Each half of the
//! samples is filtered with weights that the other half gives, so that weights do not follow the noise that they
//! average [Rousselle et al. 2012, "Adaptive rendering with non-local means filtering"]. What is left of the error is
//! measured, bias included: a filtered half differs from the other half as drawn by the error of the one and the noise
//! of the other, and the noise is known. Where the filter does not help, the samples stay as they are.
use dipir_light::luminance::luminance;
use glam::Vec3;
use rayon::prelude::*;

use crate::film::{Film, SquaredError, Viewing};
use crate::job::{Job, Layer, REPLICATES};

/// Pixels to each side that a pixel may be averaged with.
const REACH: usize = 3;
/// Pixels to each side that are compared.
const PATCH: usize = 2;
/// Pixels to each side over which variances are averaged: a pixel's own has one degree of freedom.
const POOL: usize = 2;
/// Differences, in standard deviations, that are taken for noise: less keeps more of both noise and detail.
const STRENGTH: f32 = 0.7;
/// Added to variances, squared ratios: a ratio's rounding.
const LEAST_VARIANCE: f32 = 1e-10;
/// Weights below exp(-this) are 0.
const LARGEST_DISTANCE: f32 = 16.0;

/// Side of a block of pixels.
const BLOCK: usize = 8;
/// Pixels around a block that decide about it.
const MARGIN: usize = REACH + PATCH + POOL;
/// Side of a block with its margin.
const SIDE: usize = BLOCK + 2 * MARGIN;
/// Side of a block with what is compared around its pixels.
const COMPARED: usize = BLOCK + 2 * PATCH;

/// Tiles to each side whose errors are averaged for the error of a tile, and for whether its pixels are filtered.
const ERROR_POOL: usize = 1;
const CHOICE_POOL: usize = 2;
/// Jobs that are filtered at a time: bounds the memory that holds their pixels.
const AT_ONCE: usize = 4096;

/// Sums over pixels.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    pixels: f64,
    /// Squared error of the filtered pixels, as measured: may come out negative. Display-referred.
    error: f64,
    /// The same of the ratio itself.
    linear: f64,
    /// Variance of `error`.
    variance: f64,
    /// Squared error that the halves, filtered, differ by.
    residual: f64,
    /// Squared error of the samples.
    noise: f64,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.error += other.error;
        self.linear += other.linear;
        self.variance += other.variance;
        self.residual += other.residual;
        self.noise += other.noise;
    }
}

/// The jobs of shadows by the tile of the frame that they cover.
struct Tiles<'a> {
    jobs: &'a [Job],
    size: [usize; 2],
    columns: usize,
    /// Per tile 0, or one more than its job.
    places: Vec<u32>,
}

impl<'a> Tiles<'a> {
    fn new(jobs: &'a [Job], film: &Film) -> Self {
        let size = [film.alpha.width(), film.alpha.height()];
        let columns = size[0].div_ceil(BLOCK);
        let mut places = vec![0; columns * size[1].div_ceil(BLOCK)];
        for (index, job) in jobs.iter().enumerate() {
            if job.layer != Layer::Object {
                let tile = [job.block.x, job.block.y].map(|n| n as usize / BLOCK);
                places[tile[1] * columns + tile[0]] = index as u32 + 1;
            }
        }
        Self {
            jobs,
            size,
            columns,
            places,
        }
    }

    fn job(&self, column: usize, row: usize) -> Option<usize> {
        let place = self.places[row * self.columns + column];
        (place > 0).then(|| place as usize - 1)
    }

    /// The part of the light that is missing at a pixel, from each half.
    fn halves(&self, x: usize, y: usize) -> [Vec3; REPLICATES] {
        let Some(job) = self.job(x / BLOCK, y / BLOCK) else {
            return [Vec3::ZERO; REPLICATES];
        };
        let job = &self.jobs[job];
        let (x, y) = (x - job.block.x as usize, y - job.block.y as usize);
        let index = y * job.block.width as usize + x;
        std::array::from_fn(|k| Vec3::ONE - job.estimate(index, Some(k)).0)
    }

    /// The sums of the tiles up to `reach` away from that of `job`.
    fn around(&self, job: &Job, reach: usize, sums: &[Sums]) -> Sums {
        let rows = self.places.len() / self.columns;
        let [column, row] = [job.block.x, job.block.y].map(|n| n as usize / BLOCK);
        let mut all = Sums::default();
        for row in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
            for column in column.saturating_sub(reach)..(column + reach + 1).min(self.columns) {
                if let Some(job) = self.job(column, row) {
                    all.add(&sums[job]);
                }
            }
        }
        all
    }
}

/// A block with its margin; pixels beyond the frame repeat its edge.
struct Window {
    halves: [[Vec3; SIDE * SIDE]; REPLICATES],
    /// Their luminance.
    guides: [[f32; SIDE * SIDE]; REPLICATES],
    /// Variance of one half's luminance, averaged over neighbours.
    variance: [f32; SIDE * SIDE],
}

impl Window {
    /// `None` if nothing is shadowed in it.
    fn new(tiles: &Tiles, job: &Job) -> Option<Self> {
        let mut window = Self {
            halves: [[Vec3::ZERO; SIDE * SIDE]; REPLICATES],
            guides: [[0.0; SIDE * SIDE]; REPLICATES],
            variance: [0.0; SIDE * SIDE],
        };
        let along =
            |first: u32, i: usize, n: usize| (first as usize + i).saturating_sub(MARGIN).min(n - 1);
        let mut is_empty = true;
        for j in 0..SIDE {
            let y = along(job.block.y, j, tiles.size[1]);
            for i in 0..SIDE {
                let halves = tiles.halves(along(job.block.x, i, tiles.size[0]), y);
                for (k, half) in halves.into_iter().enumerate() {
                    is_empty &= half == Vec3::ZERO;
                    window.halves[k][j * SIDE + i] = half;
                    window.guides[k][j * SIDE + i] = luminance(half);
                }
            }
        }
        let [a, b] = &window.guides;
        let norm = 0.5 / ((2 * POOL + 1) * (2 * POOL + 1)) as f32;
        for j in POOL..SIDE - POOL {
            for i in POOL..SIDE - POOL {
                let mut sum = 0.0;
                for y in j - POOL..=j + POOL {
                    for x in i - POOL..=i + POOL {
                        let difference = a[y * SIDE + x] - b[y * SIDE + x];
                        sum += difference * difference;
                    }
                }
                window.variance[j * SIDE + i] = sum * norm;
            }
        }
        (!is_empty).then_some(window)
    }

    /// Both halves of the block, filtered.
    fn filtered(&self) -> [[Vec3; BLOCK * BLOCK]; REPLICATES] {
        let mut sums = [[Vec3::ZERO; BLOCK * BLOCK]; REPLICATES];
        let mut weights = [[0f32; BLOCK * BLOCK]; REPLICATES];
        for dy in 0..=2 * REACH {
            for dx in 0..=2 * REACH {
                for guide in 0..REPLICATES {
                    let other = 1 - guide;
                    let near = self.weights(guide, dx, dy);
                    for (p, &weight) in near.iter().enumerate() {
                        let at = (p / BLOCK + MARGIN + dy - REACH) * SIDE + p % BLOCK + MARGIN + dx
                            - REACH;
                        sums[other][p] += self.halves[other][at] * weight;
                        weights[other][p] += weight;
                    }
                }
            }
        }
        for (sums, weights) in sums.iter_mut().zip(&weights) {
            for (sum, weight) in sums.iter_mut().zip(weights) {
                *sum /= *weight;
            }
        }
        sums
    }

    /// How much every pixel of the block resembles the one that lies `dx - REACH`, `dy - REACH` away, in one half.
    fn weights(&self, half: usize, dx: usize, dy: usize) -> [f32; BLOCK * BLOCK] {
        const FIRST: usize = MARGIN - PATCH;
        let guide = &self.guides[half];
        let mut distances = [0f32; COMPARED * COMPARED];
        for j in 0..COMPARED {
            let p = (FIRST + j) * SIDE + FIRST;
            let q = (FIRST + j + dy - REACH) * SIDE + FIRST + dx - REACH;
            for i in 0..COMPARED {
                let difference = guide[p + i] - guide[q + i];
                let (v, w) = (self.variance[p + i], self.variance[q + i]);
                let excess = difference * difference - (v + v.min(w));
                distances[j * COMPARED + i] =
                    excess / (LEAST_VARIANCE + STRENGTH * STRENGTH * (v + w));
            }
        }
        let mut rows = [0f32; COMPARED * BLOCK];
        for j in 0..COMPARED {
            for i in 0..BLOCK {
                let first = j * COMPARED + i;
                rows[j * BLOCK + i] = distances[first..=first + 2 * PATCH].iter().sum();
            }
        }
        const NORM: f32 = 1.0 / ((2 * PATCH + 1) * (2 * PATCH + 1)) as f32;
        std::array::from_fn(|p| {
            let sum: f32 = (0..=2 * PATCH).map(|j| rows[p + j * BLOCK]).sum();
            match (sum * NORM).max(0.0) {
                distance if distance < LARGEST_DISTANCE => (-distance).exp(),
                _ => 0.0,
            }
        })
    }
}

/// A job's pixels, filtered: shadow ratio, and what its halves differ by.
struct Filtered {
    pixels: Vec<(Vec3, Vec3)>,
    sums: Sums,
}

fn filter(tiles: &Tiles, job: &Job, film: &Film, viewing: &Viewing) -> Option<Filtered> {
    let window = Window::new(tiles, job)?;
    let [first, second] = window.filtered();
    let mut sums = Sums::default();
    let pixels = job.pixels.iter().map(|(x, y)| {
        let (x, y) = (x as usize, y as usize);
        let (i, j) = (x - job.block.x as usize, y - job.block.y as usize);
        let at = (j + MARGIN) * SIDE + i + MARGIN;
        let [a, b] = [window.halves[0][at], window.halves[1][at]];
        let [fa, fb] = [first[j * BLOCK + i], second[j * BLOCK + i]];
        let square = |v: Vec3| v * v;
        let half_noise = square(a - b) * 0.5;
        let residual = square(fa - fb) * 0.25;
        // The mean of two filtered halves is better than one by what they differ.
        let error = (square(fa - b) + square(fb - a)) * 0.5 - half_noise - residual;
        let seen = viewing.weight_of_shadow(film, x, y, residual);
        let mean = |v: Vec3| f64::from((v * seen).element_sum()) / 3.0;
        let measured = mean(error);
        sums.add(&Sums {
            pixels: 1.0,
            error: measured,
            linear: f64::from(error.element_sum()) / 3.0,
            variance: measured * measured,
            residual: mean(residual),
            noise: mean(half_noise) * 0.5,
        });
        (Vec3::ONE - (fa + fb) * 0.5, residual)
    });
    Some(Filtered {
        pixels: pixels.collect(),
        sums,
    })
}

/// Filters the shadows of `film`, which holds what `jobs` have found, and returns the error of the job of every shadow
/// that is filtered. Pixels where nothing near is shadowed stay as they are. Does nothing while any shadow has no samples.
pub(crate) fn shadows(
    film: &mut Film,
    jobs: &[Job],
    viewing: &Viewing,
) -> Vec<Option<SquaredError>> {
    let mut errors = vec![None; jobs.len()];
    let is_shadow = |job: &Job| job.layer != Layer::Object;
    if jobs.iter().any(|job| is_shadow(job) && job.samples == 0) {
        return errors;
    }
    let tiles = Tiles::new(jobs, film);
    let mut sums = vec![Sums::default(); jobs.len()];
    for (jobs, sums) in jobs.chunks(AT_ONCE).zip(sums.chunks_mut(AT_ONCE)) {
        let filtered: Vec<_> = jobs
            .par_iter()
            .map(|job| {
                is_shadow(job)
                    .then(|| filter(&tiles, job, film, viewing))
                    .flatten()
            })
            .collect();
        for ((job, sums), filtered) in jobs.iter().zip(sums).zip(filtered) {
            if let Some(filtered) = filtered {
                *sums = filtered.sums;
                film.set_shadow(job.pixels.iter().zip(filtered.pixels));
            }
        }
    }
    for (index, job) in jobs.iter().enumerate() {
        if sums[index].pixels == 0.0 {
            continue;
        }
        let choice = tiles.around(job, CHOICE_POOL, &sums);
        if choice.error > choice.noise {
            film.develop(std::slice::from_ref(job));
            continue;
        }
        let near = tiles.around(job, ERROR_POOL, &sums);
        film.raise_shadow_variance(job.pixels.iter(), (near.linear / near.pixels) as f32);
        errors[index] = Some(SquaredError {
            sum: near.error.max(near.residual) / near.pixels * sums[index].pixels,
            variance: sums[index].variance,
        });
    }
    errors
}
