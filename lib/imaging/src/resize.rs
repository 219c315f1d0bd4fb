//! Changing the number of pixels: a linear map along columns, then along rows, and its transpose.
use crate::raster::Raster;
use dipir_numerics::resample::Taps;
use rayon::prelude::*;
use std::ops::{AddAssign, Mul, Range};

pub use dipir_numerics::resample::Filter;

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
    columns: Taps<f32>,
    rows: Taps<f32>,
    columns_transposed: Taps<f32>,
    rows_transposed: Taps<f32>,
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
        let taps = |start: usize, length: usize, output: usize| {
            let taps = Taps::new(0.0, length as f64, output, length, filter);
            taps.single().shifted(start)
        };
        let columns = taps(crop.x, crop.width, output.0);
        let rows = taps(crop.y, crop.height, output.1);
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
        let first = touched.start;
        let wide = filter_rows(image, &self.columns, touched);
        filter_columns(&wide, &self.rows, first)
    }

    /// The transpose of [`apply`](Self::apply): from the gradient with respect to the output to
    /// that with respect to the image, zero outside the box.
    pub fn apply_vjp<T: Sample>(&self, gradient: &Raster<T>) -> Raster<T> {
        assert_eq!(
            (gradient.width(), gradient.height()),
            self.output,
            "the output's size"
        );
        let tall = filter_columns(gradient, &self.rows_transposed, 0);
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

/// Those of `rows`, filtered along x.
pub(crate) fn filter_rows<T: Sample>(
    image: &Raster<T>,
    taps: &Taps<f32>,
    rows: Range<usize>,
) -> Raster<T> {
    let width = taps.outputs();
    let mut output = Raster::filled(width, rows.len(), T::default());
    let lines = output.pixels_mut().par_chunks_mut(width.max(1));
    lines.zip(rows).for_each(|(line, y)| {
        let input = image.row(y);
        for (x, pixel) in line.iter_mut().enumerate() {
            for &(i, weight) in taps.of(x) {
                *pixel += input[i] * weight;
            }
        }
    });
    output
}

/// All rows, filtered along y, of an image whose row 0 is the row `first` of the taps.
pub(crate) fn filter_columns<T: Sample>(
    image: &Raster<T>,
    taps: &Taps<f32>,
    first: usize,
) -> Raster<T> {
    let (width, height) = (image.width(), taps.outputs());
    let mut output = Raster::filled(width, height, T::default());
    let lines = output.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
    lines.for_each(|(y, line)| {
        for &(i, weight) in taps.of(y) {
            for (pixel, &value) in line.iter_mut().zip(image.row(i - first)) {
                *pixel += value * weight;
            }
        }
    });
    output
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn noise(width: usize, height: usize) -> Raster<f32> {
        let value = |i: usize| ((i * 7919 % 1009) as f32) / 1009.0;
        Raster::from_pixels(width, height, (0..width * height).map(value).collect())
    }

    #[test]
    fn the_same_size_changes_nothing() {
        let image = noise(7, 5);
        for filter in [Filter::Area, Filter::Tent] {
            assert_eq!(resize(&image, 7, 5, filter), image);
        }
    }

    #[test]
    fn a_constant_stays_constant_at_odd_sizes_and_down_to_one_pixel() {
        let image = Raster::filled(13, 9, Vec3::new(0.25, 2.0, 1e6));
        for (width, height) in [(1, 1), (5, 3), (13, 1), (17, 31), (200, 7)] {
            for filter in [Filter::Area, Filter::Tent] {
                for p in resize(&image, width, height, filter).pixels() {
                    // Up to 26 rounded weights a direction sum to 1 within 26 ulp.
                    let error = (*p / *image.get(0, 0) - Vec3::ONE).abs().max_element();
                    assert!(
                        error < 52.0 * f32::EPSILON,
                        "{filter:?} {width} x {height}: {p}"
                    );
                }
            }
        }
    }

    #[test]
    fn one_pixel_grows_to_a_constant() {
        for filter in [Filter::Area, Filter::Tent] {
            let grown = resize(&Raster::filled(1, 1, 0.7f32), 4, 3, filter);
            assert!(grown.pixels().iter().all(|&v| v == 0.7));
        }
    }

    #[test]
    fn area_takes_block_means() {
        let image = noise(6, 4);
        let small = resize(&image, 3, 2, Filter::Area);
        for y in 0..2 {
            for x in 0..3 {
                let mut sum = 0.0;
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    sum += image.get(2 * x + dx, 2 * y + dy);
                }
                assert!((small.get(x, y) - sum / 4.0).abs() < 4.0 * f32::EPSILON);
            }
        }
    }

    #[test]
    fn bilinear_interpolates_between_pixel_centres_and_holds_at_the_border() {
        let ramp = Raster::from_pixels(4, 1, vec![0.0f32, 1.0, 2.0, 3.0]);
        let double = resize(&ramp, 8, 1, Filter::Tent);
        // Output centre o + 1/2 lies at (o + 1/2) / 2 - 1/2 input pixels.
        let want = [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0];
        for (got, want) in double.pixels().iter().zip(want) {
            assert!((got - want).abs() < 4.0 * f32::EPSILON, "{got} {want}");
        }
    }

    #[test]
    fn a_crop_sees_nothing_outside_its_box() {
        let inside = PixelBox {
            x: 2,
            y: 1,
            width: 4,
            height: 3,
        };
        let mut image = noise(9, 6);
        let cut = (0..12).map(|i| *image.get(2 + i % 4, 1 + i / 4)).collect();
        let cut = Raster::from_pixels(4, 3, cut);
        for filter in [Filter::Area, Filter::Tent] {
            let want = resize(&cut, 10, 2, filter);
            let crop = CropResize::new((9, 6), inside, (10, 2), filter);
            assert_eq!(crop.apply(&image), want);
        }
        for y in 0..6 {
            for x in 0..9 {
                if !(2..6).contains(&x) || !(1..4).contains(&y) {
                    *image.get_mut(x, y) = f32::NAN;
                }
            }
        }
        let crop = CropResize::new((9, 6), inside, (10, 2), Filter::Tent);
        assert!(crop.apply(&image).pixels().iter().all(|v| v.is_finite()));
    }

    #[test]
    fn the_adjoint_is_the_transpose() {
        // <A x, y> = <x, A' y>; f32 products of order 1, some 200 of them: 200 eps of the sum's size.
        let cases = [
            (
                (9, 6),
                PixelBox {
                    x: 2,
                    y: 1,
                    width: 5,
                    height: 4,
                },
                (12, 10),
            ),
            (
                (40, 31),
                PixelBox {
                    x: 0,
                    y: 3,
                    width: 40,
                    height: 27,
                },
                (7, 5),
            ),
            (
                (3, 3),
                PixelBox {
                    x: 2,
                    y: 2,
                    width: 1,
                    height: 1,
                },
                (4, 4),
            ),
        ];
        for (source, inside, output) in cases {
            for filter in [Filter::Area, Filter::Tent] {
                let crop = CropResize::new(source, inside, output, filter);
                let (x, y) = (noise(source.0, source.1), noise(output.0, output.1));
                let dot = |a: &Raster<f32>, b: &Raster<f32>| -> f64 {
                    let pairs = a.pixels().iter().zip(b.pixels());
                    pairs.map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
                };
                let (left, right) = (dot(&crop.apply(&x), &y), dot(&x, &crop.apply_vjp(&y)));
                let tolerance = 200.0 * f64::from(f32::EPSILON) * left.abs();
                assert!(
                    (left - right).abs() < tolerance,
                    "{filter:?} {output:?}: {left} {right}"
                );
            }
        }
    }
}
