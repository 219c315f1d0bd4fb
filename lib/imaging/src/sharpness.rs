//! Sharpness: how wide the sharpest edges of a photograph are, and the same blur for what is laid over it.
use crate::metrics::LUMA;
use crate::raster::{LinearImage, Raster};
use crate::resize::{Filter, PixelBox, Sample, filter_columns, filter_rows, resize};
use crate::squares::squares;
use dipir_numerics::resample::Taps;
use rayon::prelude::*;

/// Standard deviations of the two Gaussians whose gradients are compared, pixels: about the least of which pixels can be
/// samples, and one that reaches over few neighbours.
const SCALES: [f32; 2] = [0.7, 1.4];
/// Least gradient of an edge that is measured, in a pixel, as a share of white. Noise and faint detail have less.
const LEAST_GRADIENT: f32 = 0.06;
/// The photograph is looked at at one over these of its resolution, until enough edges are steep enough.
const DIVISORS: [usize; 3] = [1, 2, 4];
/// Least blur that is believed at a lower resolution, pixels there: sharper edges were missed because they are faint, not soft.
const LEAST_BELOW: f32 = 0.7;
/// Least number of edges that tell anything, and the share of all that is listened to: those with the steepest gradients.
const LEAST_EDGES: usize = 100;
const STEEPEST: usize = 10;
/// Of these, one in so many is sharper than what counts as the photograph's sharpness: thin lines look sharper than they are.
const SHARPER: usize = 5;
/// What is measured where there is no blur but that of square pixels, .29: a sampled Gaussian of .7 adds to it.
pub const OF_PIXELS: f32 = 0.4;
/// Further than this from an edge's middle its gradient is not looked at, standard deviations.
const REACH: f32 = 4.0;

/// Blur of the sharpest edges of `image`, pixels: the standard deviation of the Gaussian that a step was blurred by, and
/// [`OF_PIXELS`] or less where there is none but that of pixels. `white` is the light that shows white. `None` where too few
/// edges tell.
///
/// A step blurred by `s` has after another Gaussian of `t` a gradient in proportion to `1 / sqrt(s^2 + t^2)`: the ratio of
/// the gradients at two `t` gives `s` [Zhuo and Sim 2011]. From two pixels on the ratio tells little, and edges are hardly
/// steep enough: then they are measured at a lower resolution.
pub fn edge_blur_px(image: &LinearImage, white: f32) -> Option<f32> {
    DIVISORS.into_iter().find_map(|divisor| {
        let found = blur_at(image, white, divisor)?;
        // Pixels there are boxes of `divisor` pixels: their blur is not the photograph's, but that of its own pixels is.
        let of_box = |width: f32| width * width / 12.0;
        let own = of_box(1.0) - of_box(1.0 / divisor as f32);
        match divisor {
            1 => Some(found),
            _ => (found >= LEAST_BELOW).then(|| divisor as f32 * (found * found - own).sqrt()),
        }
    })
}

/// Blur of the sharpest edges at one over `divisor` of the resolution, pixels there.
fn blur_at(image: &LinearImage, white: f32, divisor: usize) -> Option<f32> {
    let [width, height] = [image.0.width(), image.0.height()].map(|n| n / divisor);
    if width.min(height) <= 2 * BORDER {
        return None;
    }
    let squares = squares(width, height);
    let edges = squares.par_iter().map(|b| {
        let luma = luma_of(image, *b, divisor);
        edges_of(&luma, LEAST_GRADIENT * white)
    });
    let mut edges: Vec<Edge> = edges.collect::<Vec<_>>().into_iter().flatten().collect();
    if edges.len() < LEAST_EDGES {
        return None;
    }
    edges.sort_by(|a, b| b.gradient.total_cmp(&a.gradient));
    edges.truncate((edges.len() / STEEPEST).max(LEAST_EDGES));
    edges.sort_by(|a, b| a.blur_px.total_cmp(&b.blur_px));
    Some(edges[edges.len() / SHARPER].blur_px)
}

/// Luminance of a square of the image at one over `divisor` of its resolution.
fn luma_of(image: &LinearImage, square: PixelBox, divisor: usize) -> Raster<f32> {
    let PixelBox {
        x,
        y,
        width,
        height,
    } = square;
    let [first, rows, start, columns] = [y, height, x, width].map(|n| n * divisor);
    let luma = (first..first + rows)
        .flat_map(|y| &image.0.row(y)[start..start + columns])
        .map(|v| v.dot(LUMA));
    let luma = Raster::from_pixels(columns, rows, luma.collect());
    match divisor {
        1 => luma,
        _ => resize(&luma, width, height, Filter::Area),
    }
}

struct Edge {
    gradient: f32,
    blur_px: f32,
}

/// Columns and rows of a square's border in which no edge is looked for: the filters reach beyond.
const BORDER: usize = 6;

fn edges_of(luma: &Raster<f32>, least_gradient: f32) -> Vec<Edge> {
    let whole = PixelBox {
        x: 0,
        y: 0,
        width: luma.width(),
        height: luma.height(),
    };
    let [fine, wide] = SCALES.map(|s| {
        let (smooth, slope) = (gaussian(s), slope(s));
        [
            filtered(luma, whole, &slope, &smooth),
            filtered(luma, whole, &smooth, &slope),
        ]
    });
    let inside = |length: usize| BORDER..length.saturating_sub(BORDER);
    let mut edges = Vec::new();
    for y in inside(whole.height) {
        for x in inside(whole.width) {
            let of = |g: &[Raster<f32>; 2], x: usize, y: usize| [*g[0].get(x, y), *g[1].get(x, y)];
            let g = of(&fine, x, y);
            let gradient = g[0].hypot(g[1]);
            if gradient < least_gradient {
                continue;
            }
            let along = g.map(|c| c / gradient);
            let beside = |sign: f32| {
                let to = |at: usize, by: f32| (at as f32 + sign * by).round() as usize;
                let [a, b] = of(&fine, to(x, along[0]), to(y, along[1]));
                a.hypot(b)
            };
            if gradient < beside(1.0) || gradient < beside(-1.0) {
                continue;
            }
            let w = of(&wide, x, y);
            let ratio = gradient / (w[0] * along[0] + w[1] * along[1]).abs();
            edges.push(Edge {
                gradient,
                blur_px: blur_of(ratio),
            });
        }
    }
    edges
}

/// The blur of a step whose gradient is `ratio` times as steep behind the smaller Gaussian as behind the larger.
fn blur_of(ratio: f32) -> f32 {
    let [s, t] = SCALES;
    let ratio = ratio.powi(2);
    if ratio <= 1.0 {
        return f32::INFINITY;
    }
    ((t * t - ratio * s * s) / (ratio - 1.0)).max(0.0).sqrt()
}

/// Weights of a Gaussian, from its middle to both sides.
fn gaussian(deviation: f32) -> Vec<f32> {
    let reach = (REACH * deviation).ceil() as i32;
    let at = |i: i32| (-0.5 * (i as f32 / deviation).powi(2)).exp();
    let total: f32 = (-reach..=reach).map(at).sum();
    (-reach..=reach).map(|i| at(i) / total).collect()
}

/// Weights of its derivative: a ramp that rises by 1 a pixel gives 1.
fn slope(deviation: f32) -> Vec<f32> {
    let smooth = gaussian(deviation);
    let offset = |i: usize| i as f32 - (smooth.len() / 2) as f32;
    let weight = |i: usize| offset(i) * smooth[i];
    let total: f32 = (0..smooth.len()).map(|i| offset(i) * weight(i)).sum();
    (0..smooth.len()).map(|i| weight(i) / total).collect()
}

/// `part` of `image`, weighed along rows, then along columns. Beyond its border the image goes on as it ends.
fn filtered<T: Sample>(
    image: &Raster<T>,
    part: PixelBox,
    across: &[f32],
    down: &[f32],
) -> Raster<T> {
    let columns = Taps::of_kernel(across, part.x..part.x + part.width, image.width());
    let rows = Taps::of_kernel(down, part.y..part.y + part.height, image.height());
    let touched = rows.touched();
    let first = touched.start;
    filter_columns(&filter_rows(image, &columns, touched), &rows, first)
}

/// Blurs `part` of `image` by a Gaussian of `deviation` pixels. `seen` is how much of each pixel counts, as of a thing that
/// something hides: what is hidden does not leak, and hides as much as before.
pub fn blur<T: Sample>(
    image: &mut Raster<T>,
    seen: Option<&Raster<f32>>,
    part: PixelBox,
    deviation: f32,
) {
    let taps = gaussian(deviation);
    let blurred = filtered(image, part, &taps, &taps);
    let counted = seen.map(|seen| filtered(seen, part, &taps, &taps));
    let width = image.width();
    for y in 0..part.height {
        let start = (part.y + y) * width + part.x;
        let row = &mut image.pixels_mut()[start..start + part.width];
        for (x, pixel) in row.iter_mut().enumerate() {
            let factor = match (seen, &counted) {
                (Some(seen), Some(counted)) => {
                    // What was hidden stays hidden: of all that counts here, as much as is seen.
                    seen.get(part.x + x, part.y + y) / counted.get(x, y).max(1e-3)
                }
                _ => 1.0,
            };
            *pixel = *blurred.get(x, y) * factor;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use statrs::function::erf::erf;

    const SIZE: usize = 256;

    /// Bars at an angle whose edges are blurred by `blur_px`, each pixel the mean over its area.
    fn bars(blur_px: f64) -> LinearImage {
        steps(blur_px, 0.7)
    }

    /// The same with edges of this height.
    fn steps(blur_px: f64, height: f64) -> LinearImage {
        const FINE: usize = 4;
        let (sin, cos) = 0.4f64.sin_cos();
        let cover = |x: f64, y: f64| {
            let along = x * cos + y * sin;
            let from_edge = (along / 32.0).rem_euclid(2.0) - 1.0;
            // A rising edge in the middle of the period, a falling one where it ends.
            let to_middle = 32.0 * from_edge;
            let to_end = 32.0 - to_middle.abs();
            let step = |d: f64| match blur_px > 0.0 {
                true => 0.5 * (1.0 + erf(d / (blur_px * 2f64.sqrt()))),
                false => f64::from(u8::from(d > 0.0)),
            };
            match to_middle.abs() < to_end {
                true => step(to_middle),
                false => step(to_middle.signum() * to_end),
            }
        };
        let pixel = |i: usize| {
            let fine = (0..FINE * FINE).map(|k| {
                let [u, v] = [k % FINE, k / FINE].map(|c| (c as f64 + 0.5) / FINE as f64);
                cover((i % SIZE) as f64 + u, (i / SIZE) as f64 + v)
            });
            let mean = fine.sum::<f64>() / (FINE * FINE) as f64;
            Vec3::splat((0.1 + height * mean) as f32)
        };
        LinearImage(Raster::from_pixels(
            SIZE,
            SIZE,
            (0..SIZE * SIZE).map(pixel).collect(),
        ))
    }

    #[test]
    fn the_blur_of_edges_is_found() {
        // The area of a pixel blurs by sqrt(1 / 12). Where nothing else does, what is found depends on how the edge crosses
        // the pixels (.4 to .6); from one pixel on it hardly does.
        let sharp = edge_blur_px(&bars(0.0), 1.0).unwrap();
        assert!((sharp - OF_PIXELS).abs() < 0.08, "{sharp}");
        for blur_px in [1.0, 1.5, 2.0, 3.0, 4.5, 6.0] {
            let found = f64::from(edge_blur_px(&bars(blur_px), 1.0).unwrap());
            let expected = blur_px.hypot((1.0f64 / 12.0).sqrt());
            assert!((found / expected - 1.0).abs() < 0.08, "{found} {expected}");
        }
        let even = LinearImage(Raster::filled(SIZE, SIZE, Vec3::splat(0.4)));
        assert_eq!(edge_blur_px(&even, 1.0), None);
        let tiny = LinearImage(Raster::filled(3, 2, Vec3::splat(0.4)));
        assert_eq!(edge_blur_px(&tiny, 1.0), None);
    }

    #[test]
    fn soft_edges_that_are_faint_are_measured_at_a_lower_resolution_and_sharp_ones_never() {
        for (blur_px, divisor) in [(2.0, 2), (4.0, 4)] {
            let image = steps(blur_px, 0.2);
            assert_eq!(blur_at(&image, 1.0, divisor / 2), None);
            let found = f64::from(edge_blur_px(&image, 1.0).unwrap());
            // That of the blur alone: the area of a pixel adds 1% to two pixels. Between steps of coarse pixels it varies.
            assert!((found / blur_px - 1.0).abs() < 0.1, "{found} {blur_px}");
        }
        // Steps too faint to be seen at the photograph's resolution are as steep at any other.
        assert_eq!(edge_blur_px(&steps(0.0, 0.08), 1.0), None);
        // A little steeper at a lower resolution, and found there: sharp.
        let between = steps(0.5, 0.13);
        assert!(blur_at(&between, 1.0, 4).unwrap() < LEAST_BELOW);
        assert_eq!(edge_blur_px(&between, 1.0), None);
    }

    #[test]
    fn the_scale_of_light_does_not_matter() {
        let image = steps(1.5, 0.5);
        let bright = LinearImage(image.0.map(|p| *p * 1024.0));
        assert_eq!(edge_blur_px(&bright, 1024.0), edge_blur_px(&image, 1.0));
    }

    #[test]
    fn a_blurred_layer_has_the_blur_that_was_asked_for() {
        let mut layer = bars(0.0).0;
        let part = PixelBox {
            x: 0,
            y: 0,
            width: SIZE,
            height: SIZE,
        };
        blur(&mut layer, None, part, 1.2);
        let found = edge_blur_px(&LinearImage(layer), 1.0).unwrap();
        let expected = 1.2f32.hypot((1.0f32 / 12.0).sqrt());
        assert!((found / expected - 1.0).abs() < 0.08, "{found} {expected}");
    }

    #[test]
    fn only_the_part_is_blurred_and_what_is_hidden_does_not_leak() {
        let original = Raster::from_pixels(40, 30, (0..1200).map(|i| (i % 7) as f32).collect());
        let part = PixelBox {
            x: 5,
            y: 6,
            width: 20,
            height: 11,
        };
        let (mut whole, mut within) = (original.clone(), original.clone());
        blur(
            &mut whole,
            None,
            PixelBox {
                x: 0,
                y: 0,
                width: 40,
                height: 30,
            },
            0.9,
        );
        blur(&mut within, None, part, 0.9);
        for y in 0..30 {
            for x in 0..40 {
                let is_inside = (5..25).contains(&x) && (6..17).contains(&y);
                let expected = if is_inside { &whole } else { &original };
                assert_eq!(within.get(x, y), expected.get(x, y), "{x} {y}");
            }
        }
        // An even object, hidden from column 20 on: it stays even, and ends where it ended.
        let seen = Raster::from_pixels(
            40,
            30,
            (0..1200)
                .map(|i| f32::from(u8::from(i % 40 < 20)))
                .collect(),
        );
        let mut object = seen.map(|s| 0.6 * s);
        blur(
            &mut object,
            Some(&seen),
            PixelBox {
                x: 0,
                y: 0,
                width: 40,
                height: 30,
            },
            1.5,
        );
        for (value, seen) in object.pixels().iter().zip(seen.pixels()) {
            assert!((value - 0.6 * seen).abs() < 1e-5, "{value} {seen}");
        }
    }
}
