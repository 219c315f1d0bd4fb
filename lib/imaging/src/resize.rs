//! Changing the number of pixels: a linear map along columns, then along rows, and its transpose.
use crate::raster::Raster;
use rayon::prelude::*;
use std::ops::{AddAssign, Mul, Range};

/// How an output pixel weighs the input pixels around it. Weights are positive and sum to 1, so
/// constants stay and nothing rings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// The exact mean over the output pixel's footprint: keeps the sum of light when minifying,
    /// repeats pixels when magnifying by whole numbers.
    Area,
    /// A triangle of two input pixels when magnifying (bilinear interpolation with pixel centres
    /// at half-integers), widened to two output pixels when minifying, so that nothing aliases.
    Bilinear,
}

/// A rectangle of whole pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct PixelBox {
    /// Leftmost column.
    pub x: usize,
    /// Topmost row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Values that can be weighted and added: `f32`, `Vec3`.
pub trait Sample: Copy + Default + Send + Sync + AddAssign + Mul<f32, Output = Self> {}
impl<T: Copy + Default + Send + Sync + AddAssign + Mul<f32, Output = T>> Sample for T {}

/// Cuts a box out of an image of a fixed size and resizes it. Built once, applied to many images,
/// and transposed for gradients. The result depends on pixels inside the box only.
#[derive(Clone, Debug)]
pub struct CropResize {
    source: (usize, usize),
    output: (usize, usize),
    columns: Taps,
    rows: Taps,
    columns_transposed: Taps,
    rows_transposed: Taps,
}

impl CropResize {
    /// Takes `crop` out of images of `source` width and height to `output` width and height.
    /// Panics if the box is empty or leaves the image, or the output is empty.
    pub fn new(
        source: (usize, usize),
        crop: PixelBox,
        output: (usize, usize),
        filter: Filter,
    ) -> Self {
        assert!(
            crop.width > 0 && crop.height > 0 && output.0 > 0 && output.1 > 0,
            "nothing to resize: {crop:?} to {output:?}"
        );
        assert!(
            crop.x + crop.width <= source.0 && crop.y + crop.height <= source.1,
            "{crop:?} leaves an image of {source:?}"
        );
        let columns = Taps::new(crop.x..crop.x + crop.width, output.0, filter);
        let rows = Taps::new(crop.y..crop.y + crop.height, output.1, filter);
        Self {
            source,
            output,
            columns_transposed: columns.transposed(source.0),
            rows_transposed: rows.transposed(source.1),
            columns,
            rows,
        }
    }

    /// The box, resized. Panics unless the image has the size that this was built for.
    pub fn apply<T: Sample>(&self, image: &Raster<T>) -> Raster<T> {
        assert_eq!(
            (image.width(), image.height()),
            self.source,
            "the source's size"
        );
        // Only the rows that the box touches are filtered along x; the rest are never read.
        let touched = self.rows.touched();
        let wide = filter_rows(image, &self.columns, touched);
        filter_columns(&wide, &self.rows)
    }

    /// The transpose of [`apply`](Self::apply): from the gradient with respect to the output to
    /// that with respect to the image, zero outside the box.
    pub fn apply_vjp<T: Sample>(&self, gradient: &Raster<T>) -> Raster<T> {
        assert_eq!(
            (gradient.width(), gradient.height()),
            self.output,
            "the output's size"
        );
        let tall = filter_columns(gradient, &self.rows_transposed);
        filter_rows(&tall, &self.columns_transposed, 0..self.source.1)
    }
}

/// A whole image resized.
pub fn resize<T: Sample>(
    image: &Raster<T>,
    width: usize,
    height: usize,
    filter: Filter,
) -> Raster<T> {
    let whole = PixelBox {
        x: 0,
        y: 0,
        width: image.width(),
        height: image.height(),
    };
    CropResize::new(
        (image.width(), image.height()),
        whole,
        (width, height),
        filter,
    )
    .apply(image)
}

/// A sparse matrix from one line of samples to another, by output sample.
#[derive(Clone, Debug)]
struct Taps {
    /// Output `o` weighs `entries[starts[o]..starts[o + 1]]`.
    starts: Vec<usize>,
    /// Input index and weight.
    entries: Vec<(usize, f32)>,
}

impl Taps {
    fn new(input: Range<usize>, output: usize, filter: Filter) -> Self {
        let length = input.len();
        let scale = length as f64 / output as f64;
        let mut starts = vec![0];
        let mut entries = Vec::new();
        let mut weights = Vec::new();
        for o in 0..output {
            let (low, high) = match filter {
                Filter::Area => (o as f64 * scale, (o + 1) as f64 * scale),
                Filter::Bilinear => {
                    let (centre, reach) = ((o as f64 + 0.5) * scale, scale.max(1.0));
                    (centre - reach, centre + reach)
                }
            };
            let first = low.floor().max(0.0) as usize;
            let last = (high.ceil() as usize).min(length);
            weights.clear();
            for i in first..last {
                let weight = match filter {
                    Filter::Area => (high.min((i + 1) as f64) - low.max(i as f64)).max(0.0),
                    Filter::Bilinear => {
                        let (centre, reach) = (0.5 * (low + high), 0.5 * (high - low));
                        (1.0 - (i as f64 + 0.5 - centre).abs() / reach).max(0.0)
                    }
                };
                weights.push(weight);
            }
            // Cut at the border, the weights are normalised: the border pixel is not repeated.
            let total: f64 = weights.iter().sum();
            for (k, weight) in weights.iter().enumerate() {
                let weight = (weight / total) as f32;
                if weight > 0.0 {
                    entries.push((input.start + first + k, weight));
                }
            }
            starts.push(entries.len());
        }
        Self { starts, entries }
    }

    fn transposed(&self, inputs: usize) -> Self {
        let mut by_input = vec![Vec::new(); inputs];
        for o in 0..self.len() {
            for &(i, weight) in self.of(o) {
                by_input[i].push((o, weight));
            }
        }
        let mut starts = vec![0];
        let mut entries = Vec::with_capacity(self.entries.len());
        for taps in by_input {
            entries.extend(taps);
            starts.push(entries.len());
        }
        Self { starts, entries }
    }

    /// Outputs.
    fn len(&self) -> usize {
        self.starts.len() - 1
    }

    fn of(&self, output: usize) -> &[(usize, f32)] {
        &self.entries[self.starts[output]..self.starts[output + 1]]
    }

    /// The range of inputs with any weight.
    fn touched(&self) -> Range<usize> {
        let first = self.entries.iter().map(|e| e.0).min().unwrap_or(0);
        let last = self.entries.iter().map(|e| e.0 + 1).max().unwrap_or(0);
        first..last
    }
}

fn filter_rows<T: Sample>(image: &Raster<T>, taps: &Taps, rows: Range<usize>) -> Raster<T> {
    let (width, height) = (taps.len(), image.height());
    let mut output = Raster::filled(width, height, T::default());
    let lines = output.pixels_mut().par_chunks_mut(width).enumerate();
    lines
        .filter(|(y, _)| rows.contains(y))
        .for_each(|(y, line)| {
            let input = image.row(y);
            for (x, pixel) in line.iter_mut().enumerate() {
                for &(i, weight) in taps.of(x) {
                    *pixel += input[i] * weight;
                }
            }
        });
    output
}

fn filter_columns<T: Sample>(image: &Raster<T>, taps: &Taps) -> Raster<T> {
    let (width, height) = (image.width(), taps.len());
    let mut output = Raster::filled(width, height, T::default());
    let lines = output.pixels_mut().par_chunks_mut(width).enumerate();
    lines.for_each(|(y, line)| {
        for &(i, weight) in taps.of(y) {
            for (pixel, &value) in line.iter_mut().zip(image.row(i)) {
                *pixel += value * weight;
            }
        }
    });
    output
}
