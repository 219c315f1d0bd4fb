//! Two-dimensional arrays of pixels, row by row from the top left.
use glam::Vec3;

/// A `width` x `height` array of `T`, row-major, row 0 at the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster<T> {
    width: usize,
    height: usize,
    pixels: Vec<T>,
}

impl<T: Clone> Raster<T> {
    /// A raster filled with `value`.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self {
            width,
            height,
            pixels: vec![value; width * height],
        }
    }
}

impl<T> Raster<T> {
    /// Wraps `pixels`. Panics unless there are exactly `width * height` of them.
    pub fn from_pixels(width: usize, height: usize, pixels: Vec<T>) -> Self {
        assert_eq!(
            pixels.len(),
            width * height,
            "a {width} x {height} raster needs {} pixels",
            width * height
        );
        Self {
            width,
            height,
            pixels,
        }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[T] {
        &self.pixels
    }

    /// All pixels, row by row, for writing.
    pub fn pixels_mut(&mut self) -> &mut [T] {
        &mut self.pixels
    }

    /// One row.
    pub fn row(&self, y: usize) -> &[T] {
        &self.pixels[y * self.width..(y + 1) * self.width]
    }

    /// The pixel in column `x` of row `y`; panics outside.
    pub fn get(&self, x: usize, y: usize) -> &T {
        assert!(x < self.width && y < self.height);
        &self.pixels[y * self.width + x]
    }

    /// The pixel in column `x` of row `y`, for writing; panics outside.
    pub fn get_mut(&mut self, x: usize, y: usize) -> &mut T {
        assert!(x < self.width && y < self.height);
        &mut self.pixels[y * self.width + x]
    }

    /// A raster of the same size with `f` applied to every pixel.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Raster<U> {
        Raster::from_pixels(self.width, self.height, self.pixels.iter().map(f).collect())
    }
}

/// Scene-referred linear light, Rec.709 primaries, unbounded above.
#[derive(Clone, Debug, PartialEq)]
pub struct LinearImage(pub Raster<Vec3>);

/// Display-referred values in `[0, 1]`, encoded with a [`Transfer`](crate::transfer::Transfer).
#[derive(Clone, Debug, PartialEq)]
pub struct DisplayImage(pub Raster<Vec3>);
