//! How far apart two images are. Every metric takes two images of one size in one encoding: the
//! numbers of display-referred and of linear images do not compare. Sums run in f64.
use crate::raster::Raster;
use dipir_numerics::sum::{Neumaier, par_reduce};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Rec.709 luma weights.
pub const LUMA: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);

/// Pixels of one chunk of a parallel sum. A constant, because the chunks fix the rounding.
const CHUNK: usize = 1 << 13;

/// Root mean squared error over all pixels and the three channels. Panics if the sizes differ, or
/// without pixels, as every metric here.
pub fn rmse(a: &Raster<Vec3>, b: &Raster<Vec3>) -> f64 {
    mean(a, b, |a, b| (a - b).length_squared() / 3.0).sqrt()
}

/// Scale-invariant RMSE: `min over s of rmse(s * image, reference)`, one scale for all pixels and
/// channels [Grosse et al. 2009, for one window of the whole image]. The best scale is
/// `<image, reference> / <image, image>`, and 0 for a black image. Not symmetric.
pub fn si_rmse(image: &Raster<Vec3>, reference: &Raster<Vec3>) -> f64 {
    let cross = mean(image, reference, |a, b| a.dot(b));
    let own = mean(image, image, |a, b| a.dot(b));
    let scale = if own > 0.0 { cross / own } else { 0.0 };
    // The residual itself, not a difference of squares, which loses all digits near a match.
    mean(image, reference, |a, b| {
        (a * scale - b).length_squared() / 3.0
    })
    .sqrt()
}

/// Mean of `f` over pixels; the same bytes for any number of threads.
fn mean(a: &Raster<Vec3>, b: &Raster<Vec3>, f: impl Fn(DVec3, DVec3) -> f64 + Sync) -> f64 {
    check_sizes(a, b);
    let (a, b) = (a.pixels(), b.pixels());
    let term = |i: usize| f(a[i].as_dvec3(), b[i].as_dvec3());
    let sum = par_reduce(
        a.len(),
        CHUNK,
        |range| range.map(term).collect::<Neumaier>(),
        Neumaier::merge,
    );
    sum.expect("sizes were checked").total() / a.len() as f64
}

fn check_sizes(a: &Raster<Vec3>, b: &Raster<Vec3>) {
    assert_eq!(
        (a.width(), a.height()),
        (b.width(), b.height()),
        "a metric compares images of one size"
    );
    assert!(!a.pixels().is_empty(), "a metric needs a pixel");
}

/// Taps on each side of the centre of the SSIM window.
const SSIM_RADIUS: usize = 5;
/// Standard deviation of the SSIM window in pixels.
const SSIM_SIGMA: f64 = 1.5;
/// Constants that keep the quotients stable, `(0.01 L)^2` and `(0.03 L)^2` for a range L of 1.
const SSIM_C1: f64 = 0.01 * 0.01;
const SSIM_C2: f64 = 0.03 * 0.03;

/// Mean structural similarity of two images with values in `[0, 1]`, in `[-1, 1]`, 1 for equal
/// images [Wang et al. 2004, eq. 13]: an 11 x 11 Gaussian window of sigma 1.5 normalised to 1,
/// K1 = 0.01, K2 = 0.03, weighted (biased) variances, averaged over the positions where the whole
/// window fits, each channel by itself, then over the channels.
///
/// Along a dimension of fewer than 11 pixels no window fits: there every position counts, with
/// the window cut at the border and normalised again.
pub fn ssim(a: &Raster<Vec3>, b: &Raster<Vec3>) -> f64 {
    check_sizes(a, b);
    let channel = |c: usize| ssim_of_channel(a, b, c);
    (channel(0) + channel(1) + channel(2)) / 3.0
}

fn ssim_of_channel(a: &Raster<Vec3>, b: &Raster<Vec3>, channel: usize) -> f64 {
    let (width, height) = (a.width(), a.height());
    let columns = window_positions(width);
    let rows = window_positions(height);
    let (columns, rows) = (&columns, &rows);

    // The five moments, filtered along rows: a, b, aa, bb, ab.
    let filtered: Vec<[f64; 5]> = (0..height)
        .into_par_iter()
        .flat_map_iter(|y| {
            let (a, b) = (a.row(y), b.row(y));
            columns.iter().map(move |window| {
                let mut moments = [0.0; 5];
                for (k, &w) in window.weights.iter().enumerate() {
                    let a = f64::from(a[window.start + k][channel]);
                    let b = f64::from(b[window.start + k][channel]);
                    let terms = [a, b, a * a, b * b, a * b];
                    for (m, t) in moments.iter_mut().zip(terms) {
                        *m += w * t;
                    }
                }
                moments
            })
        })
        .collect();

    let row_sums: Vec<f64> = rows
        .par_iter()
        .map(|window| {
            let mut sum = 0.0;
            for x in 0..columns.len() {
                let mut m = [0.0; 5];
                for (k, &w) in window.weights.iter().enumerate() {
                    let row = &filtered[(window.start + k) * columns.len() + x];
                    for (m, t) in m.iter_mut().zip(row) {
                        *m += w * t;
                    }
                }
                sum += similarity(m);
            }
            sum
        })
        .collect();
    row_sums.into_iter().collect::<Neumaier>().total() / (columns.len() * rows.len()) as f64
}

/// One window's SSIM from its weighted means of a, b, aa, bb and ab.
fn similarity([a, b, aa, bb, ab]: [f64; 5]) -> f64 {
    let (var_a, var_b, cov) = (aa - a * a, bb - b * b, ab - a * b);
    let luminance = (2.0 * a * b + SSIM_C1) / (a * a + b * b + SSIM_C1);
    let structure = (2.0 * cov + SSIM_C2) / (var_a + var_b + SSIM_C2);
    luminance * structure
}

struct Window {
    start: usize,
    weights: Vec<f64>,
}

/// One window for every position along a dimension at which similarity is measured.
fn window_positions(length: usize) -> Vec<Window> {
    let fits = length > 2 * SSIM_RADIUS;
    let centres = if fits {
        SSIM_RADIUS..length - SSIM_RADIUS
    } else {
        0..length
    };
    centres
        .map(|centre| {
            let start = centre.saturating_sub(SSIM_RADIUS);
            let end = (centre + SSIM_RADIUS + 1).min(length);
            let mut weights: Vec<f64> = (start..end)
                .map(|i| {
                    let d = (i as f64 - centre as f64) / SSIM_SIGMA;
                    (-0.5 * d * d).exp()
                })
                .collect();
            let total: f64 = weights.iter().sum();
            weights.iter_mut().for_each(|w| *w /= total);
            Window { start, weights }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The picture of the reference script below.
    fn waves(width: usize, height: usize, phase: f64, scale: f32) -> Raster<Vec3> {
        let pixel = |i: usize| {
            let (x, y) = ((i % width) as f64, (i / width) as f64);
            let value = |c: f64| {
                let wave = (0.3 * x + 0.017 * y * y + c + phase).sin();
                (0.5 + 0.5 * wave) as f32 * scale
            };
            Vec3::new(value(0.0), value(1.0), value(2.0))
        };
        Raster::from_pixels(width, height, (0..width * height).map(pixel).collect())
    }

    /// The numbers are those of scikit-image 0.26:
    /// ```python
    /// structural_similarity(a, b, data_range=1.0, gaussian_weights=True, sigma=1.5,
    ///                       use_sample_covariance=False, channel_axis=2)
    /// ```
    /// which averages over the same positions, on the pictures of `waves` in f64.
    #[test]
    fn ssim_agrees_with_scikit_image() {
        for (width, height, want) in [
            (33, 21, 0.806_202_133_966_658_4),
            (11, 11, 0.738_085_003_302_474_2),
        ] {
            let (a, b) = (
                waves(width, height, 0.0, 1.0),
                waves(width, height, 0.4, 0.8),
            );
            let got = ssim(&a, &b);
            // A last bit of f32 where two sine libraries differ moves the mean by less than 1e-7.
            assert!(
                (got - want).abs() < 1e-7,
                "{width} x {height}: {got} {want}"
            );
        }
    }

    #[test]
    fn equal_images_have_no_error_and_full_similarity() {
        for (width, height) in [(1, 1), (3, 17), (40, 12)] {
            let image = waves(width, height, 1.0, 1.0);
            assert_eq!(rmse(&image, &image), 0.0);
            assert!(si_rmse(&image, &image) < 1e-15);
            assert!((ssim(&image, &image) - 1.0).abs() < 1e-12);
        }
        let black = Raster::filled(12, 12, Vec3::ZERO);
        assert_eq!(ssim(&black, &black), 1.0);
        assert_eq!(si_rmse(&black, &black), 0.0);
    }

    #[test]
    fn constant_images_have_the_closed_form_ssim() {
        // No variance: only the luminance term is left.
        let (a, b) = (
            Raster::filled(15, 13, Vec3::splat(0.25)),
            Raster::filled(15, 13, Vec3::splat(0.75)),
        );
        let want = (2.0 * 0.25 * 0.75 + SSIM_C1) / (0.0625 + 0.5625 + SSIM_C1);
        assert!((ssim(&a, &b) - want).abs() < 1e-12);
    }

    #[test]
    fn errors_are_means_over_pixels_and_channels() {
        let a = Raster::from_pixels(2, 1, vec![Vec3::ZERO, Vec3::new(0.0, 0.0, 3.0)]);
        let b = Raster::filled(2, 1, Vec3::ZERO);
        assert!((rmse(&a, &b) - (9.0f64 / 6.0).sqrt()).abs() < 1e-15);
    }

    #[test]
    fn si_rmse_forgives_exposure_and_nothing_else() {
        let reference = waves(20, 10, 0.0, 1.0);
        for scale in [1e-3, 0.5, 1024.0] {
            let scaled = reference.map(|&c| c * scale);
            // The scaled values round in f32.
            assert!(
                si_rmse(&scaled, &reference) < 2.0 * f64::from(f32::EPSILON),
                "{scale}"
            );
        }
        let other = waves(20, 10, 0.5, 1.0);
        let least = si_rmse(&other, &reference);
        for scale in [0.2, 0.9, 1.0, 1.1, 3.0] {
            assert!(
                rmse(&other.map(|&c| c * scale), &reference) >= least - 1e-6,
                "{scale}"
            );
        }
        // A black image cannot be scaled to anything: the error is the reference itself.
        let black = Raster::filled(20, 10, Vec3::ZERO);
        assert_eq!(si_rmse(&black, &reference), rmse(&black, &reference));
    }
}
