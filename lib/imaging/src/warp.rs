//! Pictures drawn onto another grid of pixels, as a lens bends them.
use crate::raster::Raster;
use crate::resize::Sample;
use glam::Vec3;
use rayon::prelude::*;

/// Values that can be kept between others.
pub trait Ordered: Sample {
    /// The smaller and the larger of both, by component.
    fn ordered(self, other: Self) -> (Self, Self);

    /// Between `low` and `high`, by component.
    fn within(self, low: Self, high: Self) -> Self {
        self.ordered(low).1.ordered(high).0
    }
}

impl Ordered for f32 {
    fn ordered(self, other: Self) -> (Self, Self) {
        (self.min(other), self.max(other))
    }
}

impl Ordered for Vec3 {
    fn ordered(self, other: Self) -> (Self, Self) {
        (self.min(other), self.max(other))
    }
}

/// What there is beyond the borders of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outside<T> {
    /// The nearest pixel of the border.
    Border,
    /// This.
    Value(T),
}

/// Most samples along a side of a pixel.
const MOST_SAMPLES: usize = 8;

/// A picture of `width` x `height` pixels that shows at each position what `source` shows where `map`
/// leads to. Positions are continuous, in pixels from the top left corner; `map` gives `None` where
/// nothing is shown, which is drawn as `outside`, zero for [`Outside::Border`].
///
/// A pixel is the mean of n x n positions in it, so many that neighbours are at most a pixel of the
/// source apart; between pixels of the source it is interpolated by Catmull and Rom's cubic, kept
/// between the nearest four, so that a constant stays the same to the last bit and nothing rings.
pub fn warp<T: Ordered>(
    source: &Raster<T>,
    [width, height]: [usize; 2],
    outside: Outside<T>,
    map: impl Fn([f64; 2]) -> Option<[f64; 2]> + Sync,
) -> Raster<T> {
    let beyond = match outside {
        Outside::Border => T::default(),
        Outside::Value(value) => value,
    };
    let size = [source.width() as f64, source.height() as f64];
    let at = |p: [f64; 2]| {
        let inside = (0..2).all(|k| (0.0..=size[k]).contains(&p[k]));
        match outside {
            Outside::Value(value) if !inside => value,
            _ => cubic(source, p),
        }
    };
    let mut output = Raster::filled(width, height, beyond);
    let rows = output.pixels_mut().par_chunks_mut(width.max(1));
    rows.enumerate().for_each(|(y, row)| {
        // Of each pixel's corners; the lens is smooth, so between them positions are bilinear.
        let corners = |y: usize| -> Vec<Option<[f64; 2]>> {
            (0..=width).map(|x| map([x as f64, y as f64])).collect()
        };
        let (top, bottom) = (corners(y), corners(y + 1));
        for (x, pixel) in row.iter_mut().enumerate() {
            let cell = [top[x], top[x + 1], bottom[x], bottom[x + 1]];
            let [Some(a), Some(b), Some(c), Some(d)] = cell else {
                let middle = map([x as f64 + 0.5, y as f64 + 0.5]);
                *pixel = middle.map_or(beyond, at);
                continue;
            };
            let n = samples([a, b, c, d]);
            let weight = 1.0 / (n * n) as f32;
            let mut sum = T::default();
            for k in 0..n * n {
                let [u, v] = [k % n, k / n].map(|i| (i as f64 + 0.5) / n as f64);
                let mix = |i: usize| {
                    let (top, bottom) = (a[i] + u * (b[i] - a[i]), c[i] + u * (d[i] - c[i]));
                    top + v * (bottom - top)
                };
                sum += at([mix(0), mix(1)]);
            }
            *pixel = if n == 1 { sum } else { sum * weight };
        }
    });
    output
}

/// As [`warp`], of the single pixel of the source that lies in the middle of each pixel: for depths
/// and directions, which must not be mixed.
pub fn pick<T: Copy + Send + Sync>(
    source: &Raster<T>,
    [width, height]: [usize; 2],
    outside: T,
    map: impl Fn([f64; 2]) -> Option<[f64; 2]> + Sync,
) -> Raster<T> {
    let size = [source.width() as f64, source.height() as f64];
    let pixel = |i: usize| {
        let p = map([(i % width) as f64 + 0.5, (i / width) as f64 + 0.5])?;
        let inside = (0..2).all(|k| p[k] >= 0.0 && p[k] < size[k]);
        inside.then(|| *source.get(p[0] as usize, p[1] as usize))
    };
    let pixels = (0..width * height).into_par_iter();
    let pixels = pixels.map(|i| pixel(i).unwrap_or(outside)).collect();
    Raster::from_pixels(width, height, pixels)
}

/// Along a side, so that neighbours are at most a pixel apart.
fn samples([a, b, c, d]: [[f64; 2]; 4]) -> usize {
    let apart = |p: [f64; 2], q: [f64; 2]| (p[0] - q[0]).hypot(p[1] - q[1]);
    let longest = apart(a, b)
        .max(apart(c, d))
        .max(apart(a, c))
        .max(apart(b, d));
    // Slightly more than a pixel is still one: a photograph at its own size stays sharp.
    ((longest - 0.1).ceil() as usize).clamp(1, MOST_SAMPLES)
}

/// The source at a position, its border drawn out.
fn cubic<T: Ordered>(source: &Raster<T>, p: [f64; 2]) -> T {
    let last = [source.width() - 1, source.height() - 1];
    let axis = |k: usize| {
        let from = (p[k] - 0.5).clamp(0.0, last[k] as f64);
        let first = from.floor();
        let index = |i: i64| (first as i64 + i).clamp(0, last[k] as i64) as usize;
        (
            [index(-1), index(0), index(1), index(2)],
            catmull_rom((from - first) as f32),
        )
    };
    let ((columns, across), (rows, down)) = (axis(0), axis(1));
    let mut sum = T::default();
    for (y, down) in rows.into_iter().zip(down) {
        let mut line = T::default();
        for (x, across) in columns.into_iter().zip(across) {
            line += *source.get(x, y) * across;
        }
        sum += line * down;
    }
    let corner = |x: usize, y: usize| *source.get(columns[x], rows[y]);
    let (top, bottom) = (
        corner(1, 1).ordered(corner(2, 1)),
        corner(1, 2).ordered(corner(2, 2)),
    );
    sum.within(top.0.ordered(bottom.0).0, top.1.ordered(bottom.1).1)
}

/// Weights of four neighbours at `t` between the middle two.
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_changes_where_nothing_moves() {
        let value = |i: usize| ((i * 7919 % 1009) as f32) / 1009.0;
        let image = Raster::from_pixels(13, 9, (0..13 * 9).map(value).collect());
        assert_eq!(warp(&image, [13, 9], Outside::Border, Some), image);
        assert_eq!(pick(&image, [13, 9], 0.0, Some), image);
    }

    #[test]
    fn a_constant_stays_to_the_last_bit() {
        let image = Raster::filled(20, 20, 0.3f32);
        let bend = |p: [f64; 2]| Some([0.7 * p[0] + 0.013 * p[1] * p[1], 1.9 * p[1] - 3.0]);
        let bent = warp(&image, [30, 11], Outside::Border, bend);
        // Means of up to four times four equal values: sums of 16 round by an ulp or two.
        let worst = bent.pixels().iter().map(|v| (v - 0.3).abs());
        assert!(worst.fold(0.0, f32::max) < 1e-6);
        let ones = warp(
            &Raster::filled(20, 20, 1.0f32),
            [30, 11],
            Outside::Value(1.0),
            bend,
        );
        assert!(ones.pixels().iter().all(|&v| v == 1.0));
    }

    #[test]
    fn stripes_finer_than_pixels_become_their_mean() {
        let stripes = Raster::from_pixels(90, 4, (0..360).map(|i| (i % 2) as f32).collect());
        let small = warp(&stripes, [15, 2], Outside::Border, |p| {
            Some([6.0 * p[0], 2.0 * p[1]])
        });
        assert!(small.pixels().iter().all(|v| (v - 0.5).abs() < 1e-6));
    }

    #[test]
    fn beyond_the_borders_is_what_is_asked_for() {
        let image = Raster::filled(4, 4, 2.0f32);
        let shifted = |p: [f64; 2]| (p[1] < 3.0).then_some([p[0] + 2.0, p[1]]);
        let filled = warp(&image, [4, 4], Outside::Value(7.0), shifted);
        assert_eq!(filled.row(0), [2.0, 2.0, 7.0, 7.0]);
        assert_eq!(filled.row(3), [7.0, 7.0, 7.0, 7.0]);
        let drawn_out = warp(&image, [4, 4], Outside::Border, |p| {
            Some([p[0] + 2.0, p[1]])
        });
        assert!(drawn_out.pixels().iter().all(|&v| v == 2.0));
    }
}
