//! Sums over image samples, and the pictures and errors that follow from them.
use dipir_imaging::composite::composite_pixel;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;

use crate::counters::RayCounts;
use crate::glints::Focus;
use crate::shadow::{Block, ShadowSums, ratio};

/// Independently scrambled sample sequences per pixel. Their spread is an unbiased estimate of the
/// error of their mean, which the spread of samples *within* a low-discrepancy sequence is not.
/// Two, because splitting a sequence costs some of its stratification; the estimate's precision
/// comes from pooling pixels.
pub const REPLICATES: usize = 2;

/// What a job's samples measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// Premultiplied colour and coverage of the object.
    Object,
    /// Shadow ratio on a plane, whose unshadowed light is known.
    PlaneShadow,
    /// Shadow ratio on a mesh.
    MeshShadow,
}

impl Layer {
    /// Numbers that are summed per pixel and replicate.
    fn channels(self) -> usize {
        match self {
            Layer::Object => 5,
            Layer::PlaneShadow => 3,
            Layer::MeshShadow => 7,
        }
    }
}

/// The samples of one layer of one block of pixels.
#[derive(Clone, Debug)]
pub struct Job {
    /// What is measured.
    pub layer: Layer,
    /// Where.
    pub block: Block,
    /// Pixels of the block that the layer can touch, row by row.
    pub pixels: Vec<(u32, u32)>,
    /// Samples drawn so far, per pixel and replicate.
    pub samples: u32,
    /// Rays traced so far.
    pub counts: RayCounts,
    /// Where in its pixels samples are drawn, if not evenly.
    pub focus: Option<Focus>,
    /// Light per sample where the denominator of the ratio is known.
    arriving: Option<Vec3>,
    sums: Vec<f32>,
    /// Of every pixel in focus, the sum of squared samples.
    squares: Vec<Vec3>,
}

impl Job {
    /// A job without samples. `arriving` is the plane's unshadowed light.
    pub fn new(
        layer: Layer,
        block: Block,
        pixels: Vec<(u32, u32)>,
        arriving: Option<Vec3>,
    ) -> Self {
        Self {
            layer,
            block,
            samples: 0,
            counts: RayCounts::default(),
            focus: None,
            arriving,
            sums: vec![0.0; pixels.len() * REPLICATES * layer.channels()],
            squares: Vec::new(),
            pixels,
        }
    }

    /// A job without samples for one pixel of the object, whose samples go where `focus` says.
    pub fn focused((x, y): (u32, u32), focus: Focus) -> Self {
        let block = Block {
            x,
            y,
            width: 1,
            height: 1,
        };
        Self {
            focus: Some(focus),
            squares: vec![Vec3::ZERO],
            ..Self::new(Layer::Object, block, vec![(x, y)], None)
        }
    }

    /// Gives up the pixels that `is_given` names, with their samples.
    pub fn give_up(&mut self, is_given: impl Fn((u32, u32)) -> bool) {
        let size = REPLICATES * self.layer.channels();
        let kept = |index: &usize| !is_given(self.pixels[*index]);
        let kept: Vec<usize> = (0..self.pixels.len()).filter(kept).collect();
        let sums = kept
            .iter()
            .flat_map(|i| &self.sums[i * size..(i + 1) * size]);
        self.sums = sums.copied().collect();
        self.pixels = kept.iter().map(|&i| self.pixels[i]).collect();
    }

    /// The sums of one replicate of the `index`th pixel.
    fn sums(&self, index: usize, replicate: usize) -> &[f32] {
        let n = self.layer.channels();
        let first = (index * REPLICATES + replicate) * n;
        &self.sums[first..first + n]
    }

    /// Adds to the sums of one replicate of the `index`th pixel.
    pub fn add(&mut self, index: usize, replicate: usize, values: &[f32]) {
        let n = self.layer.channels();
        let first = (index * REPLICATES + replicate) * n;
        for (sum, value) in self.sums[first..first + n].iter_mut().zip(values) {
            *sum += value;
        }
    }

    /// Adds squared samples of the `index`th pixel, which is in focus.
    pub fn add_squares(&mut self, index: usize, squares: Vec3) {
        self.squares[index] += squares;
    }

    /// Variance of the `index`th pixel's colour. Few of many samples meet a glint, and replicates may
    /// agree because both met none: in focus the spread of the samples themselves says more, which overstates that of
    /// stratified ones.
    fn colour_variance(&self, index: usize) -> Vec3 {
        let (mean, _) = self.estimate(index, None);
        match self.squares.get(index) {
            Some(&squares) => {
                let n = (self.samples * REPLICATES as u32).max(2) as f32;
                ((squares / n - mean * mean) / (n - 1.0)).max(Vec3::ZERO)
            }
            None => self.spread(mean, |k| self.estimate(index, Some(k)).0),
        }
    }

    /// Variance of the mean of what replicates say: their squared deviations over K (K - 1).
    fn spread(&self, mean: Vec3, replicate: impl Fn(usize) -> Vec3) -> Vec3 {
        let norm = 1.0 / (REPLICATES * (REPLICATES - 1)) as f32;
        (0..REPLICATES).fold(Vec3::ZERO, |sum, k| {
            let deviation = replicate(k) - mean;
            sum + deviation * deviation * norm
        })
    }

    /// The estimate of one pixel from one replicate, or from all: colour or ratio, and coverage.
    fn estimate(&self, index: usize, replicate: Option<usize>) -> (Vec3, f32) {
        let mut total = [0f32; 7];
        let range = replicate.map_or(0..REPLICATES, |k| k..k + 1);
        let samples = (self.samples as usize * range.len()) as f32;
        for k in range {
            for (t, s) in total.iter_mut().zip(self.sums(index, k)) {
                *t += s;
            }
        }
        let [a, b, c, d, e, f, g] = total;
        let blocked = Vec3::new(a, b, c);
        match self.layer {
            // Covered pixels are covered whatever the weights of their samples.
            Layer::Object if samples > 0.0 => (blocked / samples, d / e),
            Layer::Object => (Vec3::ZERO, 0.0),
            Layer::PlaneShadow | Layer::MeshShadow => {
                let sums = ShadowSums {
                    blocked,
                    arriving: Vec3::new(d, e, f),
                    hits: g,
                };
                (ratio(&sums, samples, self.arriving), 1.0)
            }
        }
    }

    /// Effort so far, in units of a ray: rays, and what a sample costs beside them.
    pub fn cost(&self) -> f64 {
        (self.counts.total() + self.samples_drawn()) as f64
    }

    /// Samples of all pixels and replicates.
    pub fn samples_drawn(&self) -> u64 {
        self.samples as u64 * (REPLICATES * self.pixels.len()) as u64
    }
}

/// The layers as estimated so far, with the variance of each estimate.
#[derive(Clone, Debug)]
pub struct Film {
    /// Premultiplied radiance of the object, linear.
    pub object: Raster<Vec3>,
    /// Coverage of the object.
    pub alpha: Raster<f32>,
    /// Shadow ratio; 1 where nothing is shadowed.
    pub shadow: Raster<Vec3>,
    /// Variance of `object`. One degree of freedom a pixel: average over pixels before use.
    pub object_variance: Raster<Vec3>,
    /// Variance of `alpha`.
    pub alpha_variance: Raster<f32>,
    /// Variance of `shadow`.
    pub shadow_variance: Raster<Vec3>,
}

impl Film {
    /// No object and no shadow.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            object: Raster::filled(width, height, Vec3::ZERO),
            alpha: Raster::filled(width, height, 0.0),
            shadow: Raster::filled(width, height, Vec3::ONE),
            object_variance: Raster::filled(width, height, Vec3::ZERO),
            alpha_variance: Raster::filled(width, height, 0.0),
            shadow_variance: Raster::filled(width, height, Vec3::ZERO),
        }
    }

    /// Removes object and shadow where `mask` is 1, and so much of them where it is between.
    pub fn hide_behind(&mut self, mask: &Raster<f32>) {
        let n = mask.pixels().len();
        for i in 0..n {
            let seen = 1.0 - mask.pixels()[i].clamp(0.0, 1.0);
            self.object.pixels_mut()[i] *= seen;
            self.alpha.pixels_mut()[i] *= seen;
            let shadow = &mut self.shadow.pixels_mut()[i];
            *shadow = Vec3::ONE + (*shadow - Vec3::ONE) * seen;
            self.object_variance.pixels_mut()[i] *= seen * seen;
            self.alpha_variance.pixels_mut()[i] *= seen * seen;
            self.shadow_variance.pixels_mut()[i] *= seen * seen;
        }
    }

    /// Standard error of the shadow, pooled over a pixel and its neighbours.
    fn shadow_noise(&self, x: usize, y: usize) -> Vec3 {
        let (width, height) = (self.shadow.width(), self.shadow.height());
        let (mut sum, mut count) = (Vec3::ZERO, 0.0);
        for y in y.saturating_sub(1)..(y + 2).min(height) {
            for x in x.saturating_sub(1)..(x + 2).min(width) {
                sum += *self.shadow_variance.get(x, y);
                count += 1.0;
            }
        }
        Vec3::from((sum / count).to_array().map(f32::sqrt))
    }

    /// Takes over what `job` has found so far.
    pub fn develop(&mut self, job: &Job) {
        for (index, &(x, y)) in job.pixels.iter().enumerate() {
            let (x, y) = (x as usize, y as usize);
            let (colour, coverage) = job.estimate(index, None);
            let colour_variance = job.colour_variance(index);
            let coverages = |k| Vec3::splat(job.estimate(index, Some(k)).1);
            let coverage_variance = job.spread(Vec3::splat(coverage), coverages).x;
            if job.layer == Layer::Object {
                *self.object.get_mut(x, y) = colour;
                *self.alpha.get_mut(x, y) = coverage;
                *self.object_variance.get_mut(x, y) = colour_variance;
                *self.alpha_variance.get_mut(x, y) = coverage_variance;
            } else {
                *self.shadow.get_mut(x, y) = colour;
                *self.shadow_variance.get_mut(x, y) = colour_variance;
            }
        }
    }
}

/// The picture that the layers go into: decides which errors are seen.
#[derive(Clone, Copy, Debug)]
pub struct Viewing<'a> {
    /// The photograph; mid-grey (0.18) if there is none.
    pub background: Option<&'a LinearImage>,
    /// From linear to display values.
    pub transfer: Transfer,
}

/// Sums over pixels, of one job, of the squared display-referred error.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SquaredError {
    /// Estimated squared error, averaged over the channels, summed over pixels.
    pub sum: f64,
    /// Variance of `sum`.
    pub variance: f64,
}

impl SquaredError {
    /// The error of another job adds up: jobs draw independent samples.
    pub fn merge(self, other: Self) -> Self {
        Self {
            sum: self.sum + other.sum,
            variance: self.variance + other.variance,
        }
    }
}

impl Viewing<'_> {
    /// The photograph at a pixel, linear.
    pub fn background(&self, x: usize, y: usize) -> Vec3 {
        self.background
            .map_or(Vec3::splat(0.18), |image| *image.0.get(x, y))
    }

    /// The composite's display-referred squared error that comes from the noise of `job`,
    /// to first order: the replicates' spread of the linear composite times the squared slope of
    /// the transfer curve.
    pub fn squared_error(&self, film: &Film, job: &Job) -> SquaredError {
        let mut total = SquaredError::default();
        for (index, &(x, y)) in job.pixels.iter().enumerate() {
            let (x, y) = (x as usize, y as usize);
            let background = self.background(x, y);
            let composite = |(value, coverage): (Vec3, f32)| match job.layer {
                Layer::Object => {
                    composite_pixel(background, value, coverage, *film.shadow.get(x, y))
                }
                _ => composite_pixel(
                    background,
                    *film.object.get(x, y),
                    *film.alpha.get(x, y),
                    value,
                ),
            };
            let mean = composite(job.estimate(index, None));
            let variance = match job.focus {
                Some(_) => job.colour_variance(index),
                None => job.spread(mean, |k| composite(job.estimate(index, Some(k)))),
            };
            let squared = (0..3)
                .map(|c| {
                    let slope = self.slope(mean[c], variance[c].sqrt());
                    f64::from(variance[c]) * slope * slope
                })
                .sum::<f64>()
                / 3.0;
            if squared.is_finite() {
                total.sum += squared;
                // Each is sigma^2 chi^2_{K-1} / (K - 1), so E[v^2] 2 / (K + 1) is its variance.
                total.variance += squared * squared * 4.0 / (REPLICATES as f64 + 1.0);
            }
        }
        total
    }

    /// Mean slope of the transfer curve within one standard error: clipped values cannot be wrong.
    fn slope(&self, value: f32, std_error: f32) -> f64 {
        let step = std_error.max(1e-4);
        let encode = |x: f32| f64::from(self.transfer.encode_scalar(x.max(0.0)).clamp(0.0, 1.0));
        (encode(value + step) - encode(value - step)) / (2.0 * f64::from(step))
    }

    /// Whether the layers change the photograph at this pixel by half an 8-bit step or more, and by more
    /// than noise would: counted as touched, unshadowed pixels would make the mean error look smaller
    /// than it is.
    pub fn is_touched(&self, film: &Film, x: usize, y: usize) -> bool {
        if *film.alpha.get(x, y) > 0.0 {
            return true;
        }
        let background = self.background(x, y);
        let after = background * *film.shadow.get(x, y);
        let encode = |x: f32| self.transfer.encode_scalar(x.max(0.0)).clamp(0.0, 1.0);
        let seen = |c: usize| (encode(after[c]) - encode(background[c])).abs() > 0.5 / 255.0;
        // Of noise alone, one in twenty is beyond two standard errors.
        let is_sure = |c: usize| {
            let noise = background[c] * film.shadow_noise(x, y)[c];
            (after[c] - background[c]).abs() > 2.0 * noise
        };
        (0..3).any(|c| seen(c) && is_sure(c))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_on_bright_ground_touches_nothing() {
        let viewing = Viewing {
            background: None,
            transfer: Transfer::Srgb,
        };
        let mut film = Film::new(4, 4);
        // Two 8-bit steps darker, once with less noise than that, once with more.
        *film.shadow.get_mut(1, 1) = Vec3::splat(0.95);
        let with_error = |film: &mut Film, error: f32| {
            let variances = film.shadow_variance.pixels_mut();
            variances.fill(Vec3::splat(error * error));
        };
        with_error(&mut film, 0.01);
        assert!(viewing.is_touched(&film, 1, 1));
        with_error(&mut film, 0.04);
        assert!(!viewing.is_touched(&film, 1, 1));
        // Less than half a step is not seen, however sure it is.
        *film.shadow.get_mut(1, 1) = Vec3::splat(0.995);
        with_error(&mut film, 0.0);
        assert!(!viewing.is_touched(&film, 1, 1));
        // Where the object covers anything, it touches.
        *film.alpha.get_mut(2, 2) = 0.001;
        assert!(viewing.is_touched(&film, 2, 2));
    }

    #[test]
    fn pixels_that_are_not_given_up_keep_their_samples() {
        let block = Block {
            x: 2,
            y: 3,
            width: 3,
            height: 1,
        };
        let pixels = vec![(2, 3), (3, 3), (4, 3)];
        let channels = Layer::Object.channels();
        let mut job = Job::new(Layer::Object, block, pixels, None);
        for index in 0..3 {
            for replicate in 0..REPLICATES {
                let first = (100 * index + 10 * replicate) as f32;
                let values: Vec<f32> = (0..channels).map(|c| first + c as f32).collect();
                job.add(index, replicate, &values);
            }
        }
        let before = job.clone();
        job.give_up(|pixel| pixel == (3, 3));
        assert_eq!(job.pixels, [(2, 3), (4, 3)]);
        for replicate in 0..REPLICATES {
            assert_eq!(job.sums(0, replicate), before.sums(0, replicate));
            assert_eq!(job.sums(1, replicate), before.sums(2, replicate));
        }
    }
}
