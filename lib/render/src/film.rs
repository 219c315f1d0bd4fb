//! The pictures that follow from sums over image samples.
use dipir_imaging::raster::Raster;
use glam::Vec3;
use rayon::prelude::*;

use crate::job::{Developed, Job, Layer};
use crate::tiles::Tiles;

/// The layers as estimated so far.
///
/// Takes 28 bytes for every pixel of the frame, and 12 more wherever the object or its shadow is
/// sampled.
#[derive(Clone, Debug)]
pub struct Film {
    /// Premultiplied radiance of the object, linear.
    pub object: Raster<Vec3>,
    /// Coverage of the object.
    pub alpha: Raster<f32>,
    /// Shadow ratio; 1 where nothing is shadowed.
    pub shadow: Raster<Vec3>,
    /// Light of the object by way of polished ground, linear, which is added to the photograph; if there is such ground.
    pub mirrored: Option<Raster<Vec3>>,
    object_variance: Tiles<Vec3>,
    shadow_variance: Tiles<Vec3>,
}

/// Jobs that are developed at a time, side by side: bounds the memory that holds what they found.
const DEVELOPED_AT_ONCE: usize = 4096;

impl Film {
    /// No object and no shadow.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            object: Raster::filled(width, height, Vec3::ZERO),
            alpha: Raster::filled(width, height, 0.0),
            shadow: Raster::filled(width, height, Vec3::ONE),
            mirrored: None,
            object_variance: Tiles::new(width, height),
            shadow_variance: Tiles::new(width, height),
        }
    }

    /// Variance of the object's radiance. One degree of freedom a pixel: average over pixels before use.
    pub fn object_variance(&self, x: usize, y: usize) -> Vec3 {
        self.object_variance.get(x, y)
    }

    /// Variance of the shadow ratio. One degree of freedom a pixel: average over pixels before use.
    pub fn shadow_variance(&self, x: usize, y: usize) -> Vec3 {
        self.shadow_variance.get(x, y)
    }

    /// Removes the object where `mask` is 1, the shadow where `of_shadow` is, and so much of them where these are between.
    pub fn hide_behind(&mut self, mask: &Raster<f32>, of_shadow: &Raster<f32>) {
        let n = mask.pixels().len();
        for i in 0..n {
            let [seen, lit] = [mask, of_shadow].map(|m| 1.0 - m.pixels()[i].clamp(0.0, 1.0));
            self.object.pixels_mut()[i] *= seen;
            self.alpha.pixels_mut()[i] *= seen;
            let shadow = &mut self.shadow.pixels_mut()[i];
            *shadow = Vec3::ONE + (*shadow - Vec3::ONE) * lit;
            if let Some(mirrored) = &mut self.mirrored {
                mirrored.pixels_mut()[i] *= lit;
            }
            let (x, y) = (i % mask.width(), i / mask.width());
            let variances = [
                (&mut self.object_variance, seen),
                (&mut self.shadow_variance, lit),
            ];
            for (variance, left) in variances {
                let before = variance.get(x, y);
                if before != Vec3::ZERO {
                    variance.set(x, y, before * (left * left));
                }
            }
        }
    }

    /// Standard error of the shadow, pooled over a pixel and its neighbours.
    pub(crate) fn shadow_noise(&self, x: usize, y: usize) -> Vec3 {
        let (width, height) = (self.shadow.width(), self.shadow.height());
        let (mut sum, mut count) = (Vec3::ZERO, 0.0);
        for y in y.saturating_sub(1)..(y + 2).min(height) {
            for x in x.saturating_sub(1)..(x + 2).min(width) {
                sum += self.shadow_variance(x, y);
                count += 1.0;
            }
        }
        Vec3::from((sum / count).to_array().map(f32::sqrt))
    }

    /// Takes over what `jobs` have found so far, later ones over earlier ones; those without
    /// samples change nothing.
    pub fn develop(&mut self, jobs: &[Job]) {
        self.develop_more(jobs, &vec![0; jobs.len()]);
    }

    /// As [`develop`](Self::develop), of those jobs that have more samples than `before`.
    pub(crate) fn develop_more(&mut self, jobs: &[Job], before: &[u32]) {
        let chunks = jobs.chunks(DEVELOPED_AT_ONCE);
        for (jobs, before) in chunks.zip(before.chunks(DEVELOPED_AT_ONCE)) {
            let develop = |(job, &before): (&Job, &u32)| match job.samples > before {
                true => job.developed(),
                false => vec![],
            };
            let developed: Vec<Vec<Developed>> = jobs.par_iter().zip(before).map(develop).collect();
            for (job, developed) in jobs.iter().zip(developed) {
                for ((x, y), (colour, coverage, variance)) in job.pixels.iter().zip(developed) {
                    let (x, y) = (x as usize, y as usize);
                    if job.layer == Layer::Object {
                        *self.object.get_mut(x, y) = colour;
                        *self.alpha.get_mut(x, y) = coverage;
                        self.object_variance.set(x, y, variance);
                    } else {
                        *self.shadow.get_mut(x, y) = colour;
                        self.shadow_variance.set(x, y, variance);
                    }
                }
            }
        }
    }

    /// Replaces radiance of the object or shadow ratios, and their variances. Coverage stays.
    pub(crate) fn replace(
        &mut self,
        layer: Layer,
        pixels: impl Iterator<Item = ((u32, u32), (Vec3, Vec3))>,
    ) {
        let (values, variances) = self.layer_mut(layer);
        for ((x, y), (value, variance)) in pixels {
            let (x, y) = (x as usize, y as usize);
            *values.get_mut(x, y) = value;
            variances.set(x, y, variance);
        }
    }

    /// Raises the variances of radiance or of shadow ratios to `least`.
    pub(crate) fn raise_variance(
        &mut self,
        layer: Layer,
        pixels: impl Iterator<Item = (u32, u32)>,
        least: f32,
    ) {
        let (_, variances) = self.layer_mut(layer);
        for (x, y) in pixels {
            let (x, y) = (x as usize, y as usize);
            let variance = variances.get(x, y).max(Vec3::splat(least));
            variances.set(x, y, variance);
        }
    }

    fn layer_mut(&mut self, layer: Layer) -> (&mut Raster<Vec3>, &mut Tiles<Vec3>) {
        match layer {
            Layer::Object => (&mut self.object, &mut self.object_variance),
            _ => (&mut self.shadow, &mut self.shadow_variance),
        }
    }

    /// Takes the pixels of the jobs that have no samples from `coarse`, the same picture at a lower
    /// resolution.
    pub fn fill_in(&mut self, jobs: &[Job], coarse: &Film) {
        let size = (self.alpha.width(), self.alpha.height());
        for job in jobs.iter().filter(|job| job.samples == 0) {
            for (x, y) in job.pixels.iter() {
                let (x, y) = (x as usize, y as usize);
                let between = Between::new(size, (x, y), coarse);
                if job.layer == Layer::Object {
                    *self.object.get_mut(x, y) = between.mix(|x, y| *coarse.object.get(x, y));
                    *self.alpha.get_mut(x, y) = between.mix(|x, y| *coarse.alpha.get(x, y));
                } else {
                    *self.shadow.get_mut(x, y) = between.mix(|x, y| *coarse.shadow.get(x, y));
                }
            }
        }
    }

    /// The layers at a higher resolution, interpolated between the centres of pixels.
    pub fn enlarged(&self, width: usize, height: usize) -> Self {
        let mut film = Self::new(width, height);
        let rows = film.object.pixels_mut().par_chunks_mut(width);
        let rows = rows.zip(film.alpha.pixels_mut().par_chunks_mut(width));
        let rows = rows.zip(film.shadow.pixels_mut().par_chunks_mut(width));
        rows.enumerate().for_each(|(y, ((object, alpha), shadow))| {
            for x in 0..width {
                let between = Between::new((width, height), (x, y), self);
                object[x] = between.mix(|x, y| *self.object.get(x, y));
                alpha[x] = between.mix(|x, y| *self.alpha.get(x, y));
                shadow[x] = between.mix(|x, y| *self.shadow.get(x, y));
            }
        });
        film
    }

    /// Bytes that the layers take.
    pub fn bytes(&self) -> usize {
        self.object.pixels().len() * (2 * size_of::<Vec3>() + size_of::<f32>())
            + self.object_variance.bytes()
            + self.shadow_variance.bytes()
    }
}

/// The four pixels of a smaller picture around a pixel of a larger one.
struct Between {
    x: [usize; 2],
    y: [usize; 2],
    /// How far from the first to the second.
    fraction: [f32; 2],
}

impl Between {
    fn new((width, height): (usize, usize), (x, y): (usize, usize), small: &Film) -> Self {
        let along = |k: usize, large: usize, small: usize| {
            let at = (k as f32 + 0.5) * (small as f32 / large as f32) - 0.5;
            let at = at.clamp(0.0, (small - 1) as f32);
            let first = at as usize;
            ([first, (first + 1).min(small - 1)], at - first as f32)
        };
        let (x, u) = along(x, width, small.alpha.width());
        let (y, v) = along(y, height, small.alpha.height());
        Self {
            x,
            y,
            fraction: [u, v],
        }
    }

    fn mix<T>(&self, get: impl Fn(usize, usize) -> T) -> T
    where
        T: std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
    {
        let [u, v] = self.fraction;
        let row = |y| get(self.x[0], y) * (1.0 - u) + get(self.x[1], y) * u;
        row(self.y[0]) * (1.0 - v) + row(self.y[1]) * v
    }
}
