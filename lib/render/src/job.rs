//! Sums over the image samples of one layer of a block of pixels.
use glam::Vec3;

use crate::contribution::Measured;
use crate::counters::RayCounts;
use crate::highlights::PixelDensity;
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

/// Some of the pixels of a block of at most 8 x 8, row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelSet {
    x: u32,
    y: u32,
    /// Bit `8 row + column` of each pixel.
    bits: u64,
}

impl PixelSet {
    /// Those pixels of `block` for which `holds` is true. Panics if a side of `block` is above 8.
    pub fn new(block: Block, holds: impl Fn((u32, u32)) -> bool) -> Self {
        assert!(
            block.width <= 8 && block.height <= 8,
            "at most 8 x 8 pixels"
        );
        let mut bits = 0;
        for row in 0..block.height {
            for column in 0..block.width {
                if holds((block.x + column, block.y + row)) {
                    bits |= 1u64 << (8 * row + column);
                }
            }
        }
        Self {
            x: block.x,
            y: block.y,
            bits,
        }
    }

    /// How many they are.
    pub fn len(self) -> usize {
        self.bits.count_ones() as usize
    }

    /// Whether there are none.
    pub fn is_empty(self) -> bool {
        self.bits == 0
    }

    /// Its number among them, row by row; `None` if it is none of them.
    pub fn index_of(self, x: u32, y: u32) -> Option<usize> {
        let (column, row) = (x.checked_sub(self.x)?, y.checked_sub(self.y)?);
        if column >= 8 || row >= 8 {
            return None;
        }
        let bit = 1u64 << (8 * row + column);
        (self.bits & bit != 0).then(|| (self.bits & (bit - 1)).count_ones() as usize)
    }

    /// Column and row of each, row by row.
    pub fn iter(self) -> impl Iterator<Item = (u32, u32)> {
        let mut bits = self.bits;
        std::iter::from_fn(move || {
            let bit = (bits != 0).then(|| bits.trailing_zeros())?;
            bits &= bits - 1;
            Some((self.x + bit % 8, self.y + bit / 8))
        })
    }
}

/// The samples of one layer of one block of pixels.
///
/// Takes 24 bytes a pixel on a plane, 40 on the object and 56 on a mesh, and 4 for what it holds once
/// for a block of 64.
#[derive(Clone, Debug)]
pub struct Job {
    /// What is measured.
    pub layer: Layer,
    /// Where.
    pub block: Block,
    /// Pixels of the block that the layer can touch.
    pub pixels: PixelSet,
    /// Samples drawn so far, per pixel and replicate.
    pub samples: u32,
    /// Rays traced so far.
    pub counts: RayCounts,
    /// Density of the samples within its pixels, if not uniform.
    pub density: Option<PixelDensity>,
    /// What effects contribute, where the first round measures it.
    pub(crate) measured: Option<Box<Measured>>,
    /// Light per sample where the denominator of the ratio is known.
    pub(crate) arriving: Option<Vec3>,
    sums: Vec<f32>,
    /// With a density of samples, the sum of their squares for every pixel.
    squares: Vec<Vec3>,
}

impl Job {
    /// A job without samples. `arriving` is the plane's unshadowed light.
    pub fn new(layer: Layer, block: Block, pixels: PixelSet, arriving: Option<Vec3>) -> Self {
        Self {
            layer,
            block,
            samples: 0,
            counts: RayCounts::default(),
            density: None,
            measured: None,
            arriving,
            sums: vec![0.0; pixels.len() * REPLICATES * layer.channels()],
            squares: Vec::new(),
            pixels,
        }
    }

    /// A job without samples for one pixel of the object, whose samples have this `density`.
    pub fn focused((x, y): (u32, u32), density: PixelDensity) -> Self {
        let block = Block {
            x,
            y,
            width: 1,
            height: 1,
        };
        Self {
            density: Some(density),
            squares: vec![Vec3::ZERO],
            ..Self::new(Layer::Object, block, PixelSet::new(block, |_| true), None)
        }
    }

    /// Removes the pixels for which `is_given` holds, with their samples.
    pub fn give_up(&mut self, is_given: impl Fn((u32, u32)) -> bool) {
        let size = REPLICATES * self.layer.channels();
        let mut kept = self.pixels.iter().map(|pixel| !is_given(pixel));
        let sums = self.sums.chunks(size);
        let sums = sums.filter(|_| kept.next() == Some(true));
        self.sums = sums.flatten().copied().collect();
        let before = self.pixels;
        self.pixels = PixelSet::new(self.block, |pixel| {
            before.iter().any(|p| p == pixel) && !is_given(pixel)
        });
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

    /// Adds squared samples of the `index`th pixel; only with a density of samples.
    pub fn add_squares(&mut self, index: usize, squares: Vec3) {
        self.squares[index] += squares;
    }

    /// Variance of the `index`th pixel's colour. Few of many samples meet a highlight, and replicates may agree
    /// because both met none: with a density of samples, the variance is that of the samples themselves, which
    /// overstates that of stratified ones.
    pub(crate) fn colour_variance(&self, index: usize) -> Vec3 {
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
    pub(crate) fn spread(&self, mean: Vec3, replicate: impl Fn(usize) -> Vec3) -> Vec3 {
        let norm = 1.0 / (REPLICATES * (REPLICATES - 1)) as f32;
        (0..REPLICATES).fold(Vec3::ZERO, |sum, k| {
            let deviation = replicate(k) - mean;
            sum + deviation * deviation * norm
        })
    }

    /// The estimate of one pixel from one replicate, or from all: colour or ratio, and coverage.
    pub(crate) fn estimate(&self, index: usize, replicate: Option<usize>) -> (Vec3, f32) {
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
                    ..ShadowSums::default()
                };
                (ratio(&sums, samples, self.arriving), 1.0)
            }
        }
    }

    /// What every pixel amounts to so far; nothing without samples.
    pub(crate) fn developed(&self) -> Vec<Developed> {
        let pixels = match self.samples {
            0 => 0,
            _ => self.pixels.len(),
        };
        (0..pixels)
            .map(|index| {
                let (colour, coverage) = self.estimate(index, None);
                (colour, coverage, self.colour_variance(index))
            })
            .collect()
    }

    /// Bytes that the job takes.
    pub fn bytes(&self) -> usize {
        size_of::<Self>()
            + self.sums.capacity() * size_of::<f32>()
            + self.squares.capacity() * size_of::<Vec3>()
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

/// What one pixel of a job amounts to: colour or ratio, coverage, variance of the former.
pub(crate) type Developed = (Vec3, f32, Vec3);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_has_its_number() {
        let block = Block {
            x: 8,
            y: 16,
            width: 8,
            height: 5,
        };
        let pixels = PixelSet::new(block, |(x, y)| (x + y) % 3 != 0);
        for (index, (x, y)) in pixels.iter().enumerate() {
            assert_eq!(pixels.index_of(x, y), Some(index));
        }
        for missing in [(9, 18), (7, 16), (16, 16), (8, 15), (10, 21)] {
            assert_eq!(pixels.index_of(missing.0, missing.1), None);
        }
    }

    #[test]
    fn pixels_that_are_not_given_up_keep_their_samples() {
        let block = Block {
            x: 2,
            y: 3,
            width: 3,
            height: 1,
        };
        let pixels = PixelSet::new(block, |_| true);
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
        assert!(job.pixels.iter().eq([(2, 3), (4, 3)]));
        for replicate in 0..REPLICATES {
            assert_eq!(job.sums(0, replicate), before.sums(0, replicate));
            assert_eq!(job.sums(1, replicate), before.sums(2, replicate));
        }
    }
}
