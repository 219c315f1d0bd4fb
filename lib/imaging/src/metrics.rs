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

/// Mean absolute error over all pixels and the three channels.
pub fn mae(a: &Raster<Vec3>, b: &Raster<Vec3>) -> f64 {
    mean(a, b, |a, b| (a - b).abs().element_sum() / 3.0)
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

/// The window at every position along a dimension that counts.
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
