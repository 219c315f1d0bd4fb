//! Straight edges of a picture.
//!
//! Neighbouring pixels whose brightness changes in nearly the same direction are joined; a region
//! that is long and thin is a segment [Grompone von Gioi et al. 2010, without its test of chance].
use dipir_imaging::metrics::LUMA;
use dipir_imaging::raster::{LinearImage, Raster};
use glam::DVec2;

/// A straight edge, in pixels of the photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// Its middle.
    pub middle: DVec2,
    /// Unit vector along it, either way.
    pub direction: DVec2,
    /// From end to end.
    pub length: f64,
}

/// Edges are looked for in a picture whose longer side has at most this many pixels.
const LONGEST: usize = 1024;
/// Least change of brightness a pixel, of a display's range: five steps of 255.
const LEAST_CHANGE: f32 = 0.02;
/// Most that a pixel's direction differs from its region's.
const ALIKE_RAD: f32 = 0.26;
/// Shortest segment, of the picture's diagonal, and in pixels.
const SHORTEST: f64 = 0.03;
const SHORTEST_PX: f64 = 12.0;
/// Widest segment: standard deviation across it, pixels.
const WIDEST: f64 = 1.5;
/// Most segments that are kept, the longest.
const MOST: usize = 250;

/// Finds the segments of `image`, the longest first.
pub fn segments(image: &LinearImage) -> Vec<Segment> {
    let (grey, factor) = small(image);
    let edges = Edges::of(&grey);
    let diagonal = (grey.width() as f64).hypot(grey.height() as f64);
    let shortest = SHORTEST_PX.max(SHORTEST * diagonal);
    let mut free: Vec<bool> = edges.strength.iter().map(|&s| s > 0.0).collect();
    let mut order: Vec<usize> = (0..free.len()).filter(|&i| free[i]).collect();
    order.sort_by(|&a, &b| {
        edges.strength[b]
            .total_cmp(&edges.strength[a])
            .then(a.cmp(&b))
    });
    let mut found = Vec::new();
    let mut region = Vec::new();
    for seed in order {
        if !free[seed] {
            continue;
        }
        edges.grow(seed, &mut free, &mut region);
        if region.len() as f64 >= shortest
            && let Some(segment) = edges.fit(&region)
            && segment.length >= shortest
        {
            found.push(Segment {
                middle: segment.middle * factor,
                length: segment.length * factor,
                ..segment
            });
        }
    }
    found.sort_by(|a, b| b.length.total_cmp(&a.length));
    found.truncate(MOST);
    found
}

/// Side of the blocks, pixels. Edges are found in a picture that holds the mean of each block.
pub(crate) fn block_side([w, h]: [usize; 2]) -> usize {
    w.max(h).div_ceil(LONGEST).max(1)
}

/// Brightness as displays encode it, in blocks of pixels, and the blocks' side.
fn small(image: &LinearImage) -> (Raster<f32>, f64) {
    let (w, h) = (image.0.width(), image.0.height());
    let side = block_side([w, h]);
    let (sw, sh) = ((w / side).max(1), (h / side).max(1));
    let mut pixels = Vec::with_capacity(sw * sh);
    for y in 0..sh {
        for x in 0..sw {
            let mut sum = 0.0;
            let mut count = 0.0f32;
            for row in y * side..((y + 1) * side).min(h) {
                let columns = x * side..((x + 1) * side).min(w);
                for colour in &image.0.row(row)[columns] {
                    sum += colour.dot(LUMA);
                    count += 1.0;
                }
            }
            let light = (sum / count).clamp(0.0, 1.0);
            pixels.push(light.sqrt());
        }
    }
    (Raster::from_pixels(sw, sh, pixels), side as f64)
}

/// Change of brightness at every pixel.
struct Edges {
    width: usize,
    /// Per pixel; 0 where there is no edge.
    strength: Vec<f32>,
    /// Direction of the change, radians.
    angle: Vec<f32>,
}

impl Edges {
    /// By Sobel's operator.
    fn of(grey: &Raster<f32>) -> Self {
        let (w, h) = (grey.width(), grey.height());
        let mut strength = vec![0.0; w * h];
        let mut angle = vec![0.0; w * h];
        let at = |x: usize, y: usize| *grey.get(x, y);
        for y in 1..h.saturating_sub(1) {
            for x in 1..w.saturating_sub(1) {
                let column = |x: usize| at(x, y - 1) + 2.0 * at(x, y) + at(x, y + 1);
                let row = |y: usize| at(x - 1, y) + 2.0 * at(x, y) + at(x + 1, y);
                let gx = (column(x + 1) - column(x - 1)) / 8.0;
                let gy = (row(y + 1) - row(y - 1)) / 8.0;
                let change = gx.hypot(gy);
                if change > LEAST_CHANGE {
                    strength[y * w + x] = change;
                    angle[y * w + x] = gy.atan2(gx);
                }
            }
        }
        Self {
            width: w,
            strength,
            angle,
        }
    }

    /// Takes the pixels around `seed` that change in its direction out of `free`, into `region`.
    fn grow(&self, seed: usize, free: &mut [bool], region: &mut Vec<usize>) {
        region.clear();
        region.push(seed);
        free[seed] = false;
        let (mut sin, mut cos) = self.angle[seed].sin_cos();
        let mut next = 0;
        while let Some(&pixel) = region.get(next) {
            next += 1;
            // Edges are never on the picture's border: all eight neighbours exist.
            for dy in [self.width, 0, 2 * self.width] {
                for dx in [0, 1, 2] {
                    let neighbour = pixel + dy + dx - self.width - 1;
                    if !free[neighbour] {
                        continue;
                    }
                    let (s, c) = self.angle[neighbour].sin_cos();
                    // The region's direction is that of the sum of its pixels' directions.
                    let length = sin.hypot(cos);
                    if s * sin + c * cos > ALIKE_RAD.cos() * length {
                        free[neighbour] = false;
                        region.push(neighbour);
                        sin += s;
                        cos += c;
                    }
                }
            }
        }
    }

    /// The line through a region's pixels by their strength; `None` if they are too wide for one.
    fn fit(&self, region: &[usize]) -> Option<Segment> {
        let points = || {
            region.iter().map(|&i| {
                let middle = DVec2::new((i % self.width) as f64, (i / self.width) as f64) + 0.5;
                (middle, f64::from(self.strength[i]))
            })
        };
        let total: f64 = points().map(|(_, w)| w).sum();
        let middle = points().map(|(p, w)| p * w).sum::<DVec2>() / total;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (p, w) in points() {
            let d = p - middle;
            xx += w * d.x * d.x;
            xy += w * d.x * d.y;
            yy += w * d.y * d.y;
        }
        let (xx, xy, yy) = (xx / total, xy / total, yy / total);
        // Half the angle of the covariance's larger eigenvector, turned to the y axis.
        let angle = 0.5 * (2.0 * xy).atan2(yy - xx);
        let direction = DVec2::new(angle.sin(), angle.cos());
        let across = (0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()).max(0.0);
        let along = |p: DVec2| (p - middle).dot(direction);
        let (low, high) = points().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| {
            let t = along(p.0);
            (low.min(t), high.max(t))
        });
        (across.sqrt() < WIDEST).then(|| Segment {
            middle: middle + 0.5 * (low + high) * direction,
            direction,
            length: high - low,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use glam::Vec3;

    use super::*;

    /// A picture of dark bars on light ground: a pixel is dark where `inside` of its place holds,
    /// by 16 samples.
    pub(crate) fn picture(w: usize, h: usize, inside: impl Fn(DVec2) -> bool) -> LinearImage {
        let pixels = (0..w * h).map(|i| {
            let corner = DVec2::new((i % w) as f64, (i / w) as f64);
            let hits = (0..16)
                .filter(|k| {
                    let (x, y) = (f64::from(k % 4), f64::from(k / 4));
                    inside(corner + (DVec2::new(x, y) + 0.5) / 4.0)
                })
                .count();
            Vec3::splat(0.7 - 0.6 * hits as f32 / 16.0)
        });
        LinearImage(Raster::from_pixels(w, h, pixels.collect()))
    }

    #[test]
    fn both_sides_of_a_leaning_bar_are_found() {
        // x = 60 + 0.1 y, 20 pixels wide.
        let bar = |p: DVec2| (0.0..20.0).contains(&(p.x - 60.0 - 0.1 * p.y));
        let found = segments(&picture(200, 160, bar));
        assert_eq!(found.len(), 2, "{found:?}");
        for segment in found {
            // A quarter of a pixel over 150.
            assert!(
                (segment.direction.x / segment.direction.y - 0.1).abs() < 2e-3,
                "{segment:?}"
            );
            assert!(segment.length > 140.0, "{segment:?}");
            let x = segment.middle.x - 60.0 - 0.1 * segment.middle.y;
            assert!(x.abs() < 0.5 || (x - 20.0).abs() < 0.5, "{segment:?}");
        }
    }

    #[test]
    fn level_edges_are_found_and_empty_pictures_give_nothing() {
        let level = segments(&picture(120, 90, |p| p.y > 40.0));
        assert!(
            level.len() == 1 && level[0].direction.y.abs() < 1e-6,
            "{level:?}"
        );
        assert!(segments(&picture(120, 90, |_| false)).is_empty());
        assert!(segments(&picture(1, 1, |_| false)).is_empty());
    }
}
