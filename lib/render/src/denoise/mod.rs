//! Layers without most of their noise: non-local means between the two halves of the samples.
//!
//! A shadow ratio has no texture: pixels whose surroundings look alike have nearly the same value. On the object, normals
//! and base colours ([`auxiliary`]) also tell which pixels may differ; its edges, and pixels with highlights of their own,
//! are left as they are. Out of focus, edges are wide and their coverage is as noisy as light: both are filtered. Each half of the samples is filtered with weights that the other half gives, so that weights do not
//! follow the noise that they average [Rousselle et al. 2012, "Adaptive rendering with non-local means filtering"]. What is
//! left of the error is measured, bias included: a filtered half differs from the other half as drawn by the error of the
//! one and the noise of the other, and the noise is known. Where the filter does not help, the samples stay as they are.
pub(crate) mod auxiliary;
mod window;

use dipir_light::luminance::luminance;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

use self::auxiliary::Auxiliary;
use self::window::{BLOCK, Comparison, Halves, Window};
use crate::film::Film;
use crate::job::{Job, Layer, REPLICATES};
use crate::viewing::{SquaredError, Viewing};

/// Tiles to each side whose noise is averaged for that of a tile, and whose errors for its bias and for whether its pixels
/// are filtered.
const NOISE_POOL: usize = 1;
const BIAS_POOL: usize = 2;
/// Tiles to each side whose samples decide about a tile's pixels, and about what its noise is averaged with.
const AFFECTED: usize = 1 + NOISE_POOL;
/// Jobs that are filtered at a time: bounds the memory that holds their pixels.
const AT_ONCE: usize = 4096;

/// Sums over pixels.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    pixels: f64,
    /// Squared error of the filtered pixels, as measured: may come out negative. Display-referred.
    error: f64,
    /// The same of radiance or shadow ratio, linear.
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

/// Squared error of a job that is filtered, display-referred.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Error {
    /// What is left.
    pub left: SquaredError,
    /// That of its samples.
    pub drawn: f64,
}

/// What is filtered as one.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Object,
    /// The object, blurred by lens or motion: coverage is as noisy as light, and filtered with it.
    Blurred,
    Shadow,
    /// Light of the object by way of the ground, which has no edges.
    Mirrored,
}

impl Kind {
    /// Pixels with a density of samples hold a highlight, and what their neighbours do not.
    fn holds(self, job: &Job) -> bool {
        match self {
            Kind::Object | Kind::Blurred => job.layer == Layer::Object && job.density.is_none(),
            Kind::Shadow => job.layer != Layer::Object,
            Kind::Mirrored => true,
        }
    }
}

/// Shadow ratios and mirrored light are compared by luminance.
const SHADOW: Comparison<1, 2> = Comparison {
    with_own: true,
    channels: |ratio| [luminance(ratio.truncate())],
};
/// Radiance by all channels: what differs in colour alone stays apart.
const OBJECT: Comparison<3, 1> = Comparison {
    with_own: false,
    channels: |radiance| radiance.truncate().to_array(),
};
/// By coverage, too.
const BLURRED: Comparison<4, 1> = Comparison {
    with_own: false,
    channels: |value| value.to_array(),
};

/// The jobs of a kind by the tile of the frame that they cover.
struct Tiles<'a> {
    kind: Kind,
    jobs: &'a [Job],
    auxiliary: &'a Auxiliary,
    size: [usize; 2],
    columns: usize,
    /// Per tile 0, or one more than its job.
    places: Vec<u32>,
}

impl<'a> Tiles<'a> {
    fn new(kind: Kind, jobs: &'a [Job], auxiliary: &'a Auxiliary, film: &Film) -> Self {
        let size = [film.alpha.width(), film.alpha.height()];
        let columns = size[0].div_ceil(BLOCK);
        let mut places = vec![0; columns * size[1].div_ceil(BLOCK)];
        for (index, job) in jobs.iter().enumerate() {
            if kind.holds(job) {
                let tile = [job.block.x, job.block.y].map(|n| n as usize / BLOCK);
                places[tile[1] * columns + tile[0]] = index as u32 + 1;
            }
        }
        Self {
            kind,
            jobs,
            auxiliary,
            size,
            columns,
            places,
        }
    }

    fn job(&self, column: usize, row: usize) -> Option<usize> {
        let place = self.places[row * self.columns + column];
        (place > 0).then(|| place as usize - 1)
    }

    /// What is filtered at a pixel: radiance of the object where it covers all of the pixel, or the part of the light that
    /// is missing on the ground.
    fn halves(&self, x: usize, y: usize) -> Halves {
        let mut halves = Halves {
            values: [Vec4::ZERO; REPLICATES],
            is_inside: self.kind != Kind::Object,
            seen: self.auxiliary.get(x, y),
        };
        let Some(job) = self.job(x / BLOCK, y / BLOCK) else {
            return halves;
        };
        let job = &self.jobs[job];
        let Some(index) = job.pixels.index_of(x as u32, y as u32) else {
            return halves;
        };
        let estimates: [_; REPLICATES] = std::array::from_fn(|k| job.estimate(index, Some(k)));
        match self.kind {
            Kind::Object => {
                halves.values = estimates.map(|e| e.0.extend(0.0));
                halves.is_inside = estimates.iter().all(|e| e.1 >= 1.0);
            }
            Kind::Blurred => halves.values = estimates.map(|e| e.0.extend(e.1)),
            Kind::Shadow => halves.values = estimates.map(|e| (Vec3::ONE - e.0).extend(0.0)),
            Kind::Mirrored => halves.values = estimates.map(|e| e.0.extend(0.0)),
        }
        halves
    }

    /// Whether the filter changes a pixel of its jobs.
    fn is_filtered(&self, (x, y): (u32, u32)) -> bool {
        self.kind != Kind::Object || self.halves(x as usize, y as usize).is_inside
    }

    /// The jobs of the tiles up to `reach` away from that of `job`.
    fn near(&self, job: &Job, reach: usize) -> impl Iterator<Item = usize> {
        let rows = self.places.len() / self.columns;
        let [column, row] = [job.block.x, job.block.y].map(|n| n as usize / BLOCK);
        let along =
            move |at: usize, end: usize| at.saturating_sub(reach)..(at + reach + 1).min(end);
        along(row, rows).flat_map(move |row| {
            along(column, self.columns).filter_map(move |column| self.job(column, row))
        })
    }

    /// Their sums.
    fn around(&self, job: &Job, reach: usize, known: &[Known]) -> Sums {
        let mut all = Sums::default();
        self.near(job, reach)
            .for_each(|other| all.add(&known[other].sums));
        all
    }
}

/// A job's pixels, filtered, with the variance of each, and what its halves differ by.
struct Filtered {
    pixels: Vec<((u32, u32), (Vec3, Vec3))>,
    /// Coverage of the pixels, where it is filtered.
    coverage: Vec<f32>,
    sums: Sums,
}

fn filter<const CHANNELS: usize, const PATCH: usize>(
    comparison: Comparison<CHANNELS, PATCH>,
    tiles: &Tiles,
    job: &Job,
    film: &Film,
    viewing: &Viewing,
) -> Option<Filtered> {
    let first = [job.block.x, job.block.y].map(|n| n as usize);
    let window = Window::new(comparison, first, tiles.size, |x, y| tiles.halves(x, y))?;
    let place = |(x, y): (u32, u32)| (x as usize - first[0], y as usize - first[1]);
    let is_inside = |pixel: &(u32, u32)| {
        let (i, j) = place(*pixel);
        window.is_inside(i, j)
    };
    if !job.pixels.iter().any(|pixel| is_inside(&pixel)) {
        return None;
    }
    let filtered = window.filtered();
    let mut sums = Sums::default();
    let mut coverage = vec![];
    let pixels = job.pixels.iter().filter(is_inside).map(|pixel| {
        let (i, j) = place(pixel);
        // What is covered hides what is behind it: how far it is seen follows from both.
        let behind = match tiles.kind {
            Kind::Blurred => {
                let (x, y) = (pixel.0 as usize, pixel.1 as usize);
                viewing.background(x, y) * *film.shadow.get(x, y)
            }
            _ => Vec3::ZERO,
        };
        let laid = |v: Vec4| v.truncate() - behind * v.w;
        let [a, b] = window.drawn(i, j).map(laid);
        let both = [0, 1].map(|k| filtered[k][j * BLOCK + i]);
        let [fa, fb] = both.map(laid);
        let square = |v: Vec3| v * v;
        let half_noise = square(a - b) * 0.5;
        let residual = square(fa - fb) * 0.25;
        // The mean of two filtered halves is better than one by what they differ.
        let error = (square(fa - b) + square(fb - a)) * 0.5 - half_noise - residual;
        let seen = viewing.weight(film, job.layer, pixel, residual);
        let mean = |v: Vec3| f64::from((v * seen).element_sum()) / 3.0;
        let measured = mean(error);
        sums.add(&match measured.is_finite() && error.is_finite() {
            true => Sums {
                pixels: 1.0,
                error: measured,
                linear: f64::from(error.element_sum()) / 3.0,
                variance: measured * measured,
                residual: mean(residual),
                noise: mean(half_noise) * 0.5,
            },
            // So bright that its square is no number: nothing near is filtered.
            false => Sums {
                pixels: 1.0,
                error: f64::INFINITY,
                ..Sums::default()
            },
        });
        let value = ((both[0] + both[1]) * 0.5).truncate();
        let value = match tiles.kind {
            Kind::Object | Kind::Mirrored => value,
            Kind::Blurred => {
                coverage.push((both[0].w + both[1].w) * 0.5);
                value
            }
            Kind::Shadow => Vec3::ONE - value,
        };
        (pixel, (value, residual))
    });
    let pixels = pixels.collect();
    Some(Filtered {
        pixels,
        coverage,
        sums,
    })
}

/// Filters layers after every round, anew where samples were added.
pub(crate) struct Denoiser<'a> {
    auxiliary: &'a Auxiliary,
    /// Of every job; empty before the first round.
    known: Vec<Known>,
}

/// What is known of a job since it was filtered.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    /// Those that were filtered, per pixel and replicate; 0 before.
    samples: u32,
    sums: Sums,
    /// Whether the film has its filtered pixels.
    is_shown: bool,
}

/// What follows for a job from its sums and those around it.
struct Decision {
    /// If its filtered pixels are better than those drawn.
    error: Option<Error>,
    /// Mean squared error around it, linear.
    linear: f32,
}

impl<'a> Denoiser<'a> {
    /// Has filtered nothing.
    pub(crate) fn new(auxiliary: &'a Auxiliary) -> Self {
        Self {
            auxiliary,
            known: vec![],
        }
    }

    /// Filters the layers of `film`, which holds what `jobs` have found since, and what was filtered before; the jobs are
    /// those of the call before, with as many samples or more. Returns the error of every job that is filtered. Pixels where
    /// nothing near is shadowed stay as they are. Does nothing to a layer while any job of it has no samples.
    pub(crate) fn denoise(
        &mut self,
        film: &mut Film,
        jobs: &[Job],
        viewing: &Viewing,
    ) -> Vec<Option<Error>> {
        self.known.resize(jobs.len(), Known::default());
        let mut errors = vec![None; jobs.len()];
        let kinds: &[Kind] = match (viewing.adds, viewing.is_blurred) {
            (true, _) => &[Kind::Mirrored],
            (false, true) => &[Kind::Blurred, Kind::Shadow],
            (false, false) => &[Kind::Object, Kind::Shadow],
        };
        for &kind in kinds {
            let of_kind = || jobs.iter().filter(|job| kind.holds(job));
            if of_kind().all(|job| job.samples > 0) {
                let tiles = Tiles::new(kind, jobs, self.auxiliary, film);
                denoise_kind(film, &tiles, viewing, &mut self.known, &mut errors);
            }
        }
        errors
    }
}

fn denoise_kind(
    film: &mut Film,
    tiles: &Tiles,
    viewing: &Viewing,
    known: &mut [Known],
    errors: &mut [Option<Error>],
) {
    let jobs = tiles.jobs;
    let grown = |other: usize| jobs[other].samples > known[other].samples;
    let is_stale = |job: &Job| tiles.kind.holds(job) && tiles.near(job, AFFECTED).any(grown);
    let stale: Vec<bool> = jobs.par_iter().map(is_stale).collect();
    filter_where(film, tiles, viewing, known, |index| stale[index]);
    let decide = |(index, job): (usize, &Job)| {
        let is_known = tiles.kind.holds(job) && known[index].sums.pixels > 0.0;
        is_known.then(|| decision(tiles, film, viewing, (index, job), known))
    };
    let decisions: Vec<_> = jobs.par_iter().enumerate().map(decide).collect();
    // What did not help before, and does with what is around it now.
    let helps = decisions
        .iter()
        .map(|d| matches!(d, Some(Decision { error: Some(_), .. })));
    let missing: Vec<bool> = helps
        .zip(known.iter())
        .map(|(helps, known)| helps && !known.is_shown)
        .collect();
    filter_where(film, tiles, viewing, known, |index| missing[index]);
    for (index, decision) in decisions.into_iter().enumerate() {
        let Some(decision) = decision else { continue };
        let job = &jobs[index];
        errors[index] = decision.error;
        match decision.error.is_some() {
            true if stale[index] || missing[index] => {
                let filtered = job.pixels.iter().filter(|&p| tiles.is_filtered(p));
                film.raise_variance(job.layer, filtered, decision.linear);
            }
            false if known[index].is_shown => {
                film.develop(std::slice::from_ref(job));
                known[index].is_shown = false;
            }
            _ => {}
        }
    }
}

/// Filters the jobs whose number is `wanted`.
fn filter_where(
    film: &mut Film,
    tiles: &Tiles,
    viewing: &Viewing,
    known: &mut [Known],
    wanted: impl Fn(usize) -> bool,
) {
    let wanted: Vec<usize> = (0..tiles.jobs.len())
        .filter(|&index| wanted(index))
        .collect();
    for indices in wanted.chunks(AT_ONCE) {
        let filter = |&index: &usize| match tiles.kind {
            Kind::Object => filter(OBJECT, tiles, &tiles.jobs[index], film, viewing),
            Kind::Blurred => filter(BLURRED, tiles, &tiles.jobs[index], film, viewing),
            _ => filter(SHADOW, tiles, &tiles.jobs[index], film, viewing),
        };
        let filtered: Vec<_> = indices.par_iter().map(filter).collect();
        for (&index, filtered) in indices.iter().zip(filtered) {
            let job = &tiles.jobs[index];
            known[index] = Known {
                samples: job.samples,
                sums: filtered.as_ref().map(|f| f.sums).unwrap_or_default(),
                is_shown: filtered.is_some(),
            };
            if let Some(filtered) = filtered {
                for (((x, y), _), coverage) in filtered.pixels.iter().zip(&filtered.coverage) {
                    *film.alpha.get_mut(*x as usize, *y as usize) = *coverage;
                }
                film.replace(job.layer, filtered.pixels.into_iter());
            }
        }
    }
}

fn decision(
    tiles: &Tiles,
    film: &Film,
    viewing: &Viewing,
    (index, job): (usize, &Job),
    known: &[Known],
) -> Decision {
    let sums = &known[index].sums;
    let wide = tiles.around(job, BIAS_POOL, known);
    let near = tiles.around(job, NOISE_POOL, known);
    let linear = (near.linear / near.pixels) as f32;
    if wide.error > wide.noise {
        return Decision {
            error: None,
            linear,
        };
    }
    let noise = near.residual / near.pixels;
    let bias = ((wide.error - wide.residual) / wide.pixels).max(0.0);
    let left = SquaredError {
        sum: (noise + bias) * sums.pixels,
        variance: sums.variance,
    };
    let drawn = viewing.squared_error_where(film, job, |pixel| !tiles.is_filtered(pixel));
    Decision {
        error: Some(Error {
            left: left.merge(drawn),
            drawn: sums.noise + drawn.sum,
        }),
        linear,
    }
}

#[cfg(test)]
mod tests;
