//! Grain: the noise of a photograph, as its flat areas show it, and more of the same for what is laid over it.
//!
//! The *residual* of a patch of 16 x 16 pixels is what is left without its plane of best fit. In a flat area, one without
//! detail, the residual is noise. Three properties tell noise from faint detail: it is equally strong in all four quarters of
//! a patch, few of its values lie far out, and neighbours differ.
use crate::raster::LinearImage;
use crate::resize::PixelBox;
use crate::squares::squares;
use dipir_numerics::hashing::hash_u64s;
use glam::Vec3;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Side of a patch, pixels.
const SIDE: usize = 16;
const PIXELS: usize = SIDE * SIDE;
/// From one patch to the next, pixels. Patches of new grain overlap by as much.
const STEP: usize = SIDE / 2;
/// Ranges of brightness in which noise is measured apart.
const LEVELS: usize = 8;
/// Least number of flat patches from which the noise of a level is taken.
const LEAST_PATCHES: usize = 16;
/// Share of a level's patches, those with the weakest residual, whose strongest is the measure of a flat one.
const WEAKEST: f32 = 0.02;
/// A patch counts as flat up to this many times that one's variance.
const FLAT: f32 = 2.0;
/// Most spread of the variances of a patch's quarters, over their mean: .10 for white noise, .19 to .28 for noise behind a JPEG,
/// .31 and more for foliage, water, and what the encoder of a video leaves (eight photographs, with and without noise).
const MOST_SPREAD: f32 = 0.29;
/// Most kurtosis: 3 for noise, more where there are edges.
const MOST_KURTOSIS: f32 = 3.3;
/// Least mean square of the differences of neighbours, over that of two values far apart: 1 for white noise, a third for noise
/// that is smoothed over 3 x 3 pixels, a tenth and less for soft edges and the blotches that telephones leave of noise.
const LEAST_ROUGHNESS: f32 = 0.2;
/// Display values within this of black and white may be clipped.
const CLIPPED: f32 = 2e-3;
/// Least standard deviation of grain that is worth adding, display values: two steps of 8 bits. What a picture of 8 bits is
/// rounded by has a third of a step.
const LEAST_DEVIATION: f32 = 2.0 / 255.0;
/// Most patches that are kept.
const MOST_KEPT: usize = 512;
/// Residuals further out than this many standard deviations are cut.
const FAR_OUT: f32 = 4.0;

/// The noise of a photograph.
#[derive(Clone, Debug)]
pub struct Grain {
    /// Standard deviation of each channel's display values, at the middle of each level of brightness.
    deviations: [Vec3; LEVELS],
    /// Residuals of flat patches, each channel divided by its standard deviation.
    patches: Vec<[Vec3; PIXELS]>,
}

/// What a patch of a photograph is like.
struct Patch {
    /// Its leftmost column and topmost row.
    corner: [usize; 2],
    /// Mean of all channels, display values.
    brightness: f32,
    /// Of the residual of each channel.
    variance: Vec3,
    /// Standard deviation of the variances of its quarters, over their mean.
    spread: f32,
    kurtosis: f32,
    roughness: f32,
}

impl Grain {
    /// The noise of `image`, if its flat areas show some that is worth adding. `display` leads to display values, in
    /// `[0, 1]`.
    pub fn of(image: &LinearImage, display: impl Fn(Vec3) -> Vec3 + Sync) -> Option<Self> {
        let squares = squares(image.0.width(), image.0.height());
        let patches = squares.par_iter().map(|b| patches_of(image, *b, &display));
        let mut levels: [Vec<Patch>; LEVELS] = Default::default();
        for patch in patches.collect::<Vec<_>>().into_iter().flatten() {
            levels[level_of(patch.brightness)].push(patch);
        }
        let told = levels.map(flat);
        let deviations = told.each_ref().map(|flat| deviation(flat));
        let nearest = |k: usize| {
            let known = (0..LEVELS).filter_map(|j| Some((j.abs_diff(k), deviations[j]?)));
            known.min_by_key(|(far, _)| *far).map(|(_, d)| d)
        };
        let filled: Vec<Vec3> = (0..LEVELS).map_while(nearest).collect();
        let filled: [Vec3; LEVELS] = filled.try_into().ok()?;
        let mean = filled.iter().sum::<Vec3>() / LEVELS as f32;
        if mean.element_sum() / 3.0 < LEAST_DEVIATION {
            return None;
        }
        let all: Vec<&Patch> = told.iter().flatten().collect();
        let kept = all.len().min(MOST_KEPT);
        let unit = |i: usize| {
            let patch = all[i * all.len() / kept];
            let deviation = filled[level_of(patch.brightness)].max(Vec3::splat(f32::EPSILON));
            let values = values_at(patch.corner, |x, y| display(*image.0.get(x, y)));
            let most = Vec3::splat(FAR_OUT);
            without_plane(&values)
                .1
                .map(|r| (r / deviation).clamp(-most, most))
        };
        Some(Self {
            deviations: filled,
            patches: (0..kept).map(unit).collect(),
        })
    }

    /// Standard deviation of each channel at the brightness `display`, display values.
    pub fn deviation(&self, display: Vec3) -> Vec3 {
        let at = (brightness(display) * LEVELS as f32 - 0.5).clamp(0.0, (LEVELS - 1) as f32);
        let k = (at as usize).min(LEVELS - 2);
        self.deviations[k].lerp(self.deviations[k + 1], at - k as f32)
    }

    /// What is added to the display values `display` of the pixel in column `x` of row `y`.
    ///
    /// Patches of the photograph's own noise, chosen and mirrored at random by where they lie, overlap by half in both
    /// directions. The squares of the four weights of a pixel sum to 1, so variances stay what they are.
    pub fn at(&self, x: usize, y: usize, display: Vec3) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for (i, j) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let cell = [x / STEP + i, y / STEP + j];
            let (u, v) = (x + STEP - cell[0] * STEP, y + STEP - cell[1] * STEP);
            let draw = hash_u64s(&cell.map(|c| c as u64));
            let mirrored = |bit: u64, at: usize| match draw >> bit & 1 {
                0 => at,
                _ => SIDE - 1 - at,
            };
            let (column, row) = (mirrored(62, u), mirrored(63, v));
            let patch = &self.patches[(draw % (1 << 32)) as usize % self.patches.len()];
            sum += weight(u) * weight(v) * patch[row * SIDE + column];
        }
        sum * self.deviation(display)
    }
}

/// Weight of a patch in column or row `at` of it.
fn weight(at: usize) -> f32 {
    (PI * (at as f32 + 0.5) / SIDE as f32).sin()
}

fn brightness(display: Vec3) -> f32 {
    display.element_sum() / 3.0
}

fn level_of(brightness: f32) -> usize {
    ((brightness * LEVELS as f32) as usize).min(LEVELS - 1)
}

/// The patches of one level that show nothing but noise; none if too few do.
fn flat(mut patches: Vec<Patch>) -> Vec<Patch> {
    if patches.len() < LEAST_PATCHES {
        return Vec::new();
    }
    patches.sort_by(|a, b| brightness(a.variance).total_cmp(&brightness(b.variance)));
    let weakest = ((WEAKEST * patches.len() as f32) as usize).max(LEAST_PATCHES / 2);
    let most = FLAT * brightness(patches[weakest].variance);
    patches.truncate(patches.partition_point(|p| brightness(p.variance) <= most));
    let mid = |of: fn(&Patch) -> f32| middle(patches.iter().map(of).collect());
    let is_noise = mid(|p| p.spread) <= MOST_SPREAD
        && mid(|p| p.kurtosis) <= MOST_KURTOSIS
        && mid(|p| p.roughness) >= LEAST_ROUGHNESS;
    match is_noise && patches.len() >= LEAST_PATCHES {
        true => patches,
        false => Vec::new(),
    }
}

/// Of each channel; `None` for no patches.
fn deviation(flat: &[Patch]) -> Option<Vec3> {
    let of = |c: usize| middle(flat.iter().map(|p| p.variance[c]).collect()).sqrt();
    (!flat.is_empty()).then(|| Vec3::new(of(0), of(1), of(2)))
}

/// The upper median; 0 for no values.
fn middle(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

/// The patches inside of `square` in which nothing is clipped.
fn patches_of(
    image: &LinearImage,
    square: PixelBox,
    display: &(impl Fn(Vec3) -> Vec3 + Sync),
) -> Vec<Patch> {
    let columns = square.x..square.x + square.width;
    let shown: Vec<Vec<Vec3>> = (square.y..square.y + square.height)
        .map(|y| {
            image.0.row(y)[columns.clone()]
                .iter()
                .map(|v| display(*v))
                .collect()
        })
        .collect();
    let starts = |length: usize| (0..(length + 1).saturating_sub(SIDE)).step_by(STEP);
    let corners = starts(square.height).flat_map(|y| starts(square.width).map(move |x| [x, y]));
    let patch = |[x, y]: [usize; 2]| {
        let values = values_at([x, y], |x, y| shown[y][x]);
        Patch::of([square.x + x, square.y + y], values)
    };
    corners.filter_map(patch).collect()
}

/// Display values of the patch whose leftmost column and topmost row are `corner`.
fn values_at([x, y]: [usize; 2], at: impl Fn(usize, usize) -> Vec3) -> [Vec3; PIXELS] {
    std::array::from_fn(|i| at(x + i % SIDE, y + i / SIDE))
}

impl Patch {
    /// `None` where values may be clipped.
    fn of(corner: [usize; 2], values: [Vec3; PIXELS]) -> Option<Self> {
        let inside = |v: &Vec3| v.min_element() > CLIPPED && v.max_element() < 1.0 - CLIPPED;
        if !values.iter().all(inside) {
            return None;
        }
        let (mean, residual) = without_plane(&values);
        let square_sum: Vec3 = residual.iter().map(|r| r * r).sum();
        let grey = residual.map(brightness);
        let mut quarters = [0.0f32; 4];
        for (i, r) in residual.iter().enumerate() {
            quarters[i / (PIXELS / 2) * 2 + i % SIDE / STEP] += (r * r).element_sum();
        }
        let mean_quarter = quarters.iter().sum::<f32>() / 4.0;
        let off = quarters.map(|q| (q - mean_quarter).powi(2));
        let second = grey.iter().map(|g| g * g).sum::<f32>() / PIXELS as f32;
        let fourth = grey.iter().map(|g| g.powi(4)).sum::<f32>() / PIXELS as f32;
        Some(Self {
            corner,
            brightness: brightness(mean),
            // A plane takes three degrees of freedom.
            variance: square_sum / (PIXELS - 3) as f32,
            spread: (off.iter().sum::<f32>() / 3.0).sqrt() / mean_quarter.max(f32::MIN_POSITIVE),
            kurtosis: fourth / (second * second).max(f32::MIN_POSITIVE),
            roughness: 0.5 * difference(&grey) / second.max(f32::MIN_POSITIVE),
        })
    }
}

/// Mean square of the differences of neighbours in rows and columns.
fn difference(values: &[f32; PIXELS]) -> f32 {
    let rows = (0..PIXELS).filter(|i| i % SIDE > 0).map(|i| [i, i - 1]);
    let columns = (SIDE..PIXELS).map(|i| [i, i - SIDE]);
    let squares = rows
        .chain(columns)
        .map(|[a, b]| (values[a] - values[b]).powi(2));
    squares.sum::<f32>() / (2 * SIDE * (SIDE - 1)) as f32
}

/// The mean, and what is left of the values without their plane of best fit.
fn without_plane(values: &[Vec3; PIXELS]) -> (Vec3, [Vec3; PIXELS]) {
    let offset = |i: usize| i as f32 - (SIDE - 1) as f32 / 2.0;
    let moment: f32 = (0..SIDE).map(|i| offset(i).powi(2)).sum::<f32>() * SIDE as f32;
    let mean = values.iter().sum::<Vec3>() / PIXELS as f32;
    let (mut right, mut down) = (Vec3::ZERO, Vec3::ZERO);
    for (i, v) in values.iter().enumerate() {
        right += *v * (offset(i % SIDE) / moment);
        down += *v * (offset(i / SIDE) / moment);
    }
    let plane = |i: usize| mean + right * offset(i % SIDE) + down * offset(i / SIDE);
    (mean, std::array::from_fn(|i| values[i] - plane(i)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::Raster;
    use dipir_numerics::hashing::mix64;

    /// Values of mean 0 and deviation 1, nearly normal: the sum of twelve of a uniform distribution.
    fn normal(key: u64) -> f32 {
        let uniform = |k| (mix64(key * 12 + k) >> 40) as f32 / (1u64 << 24) as f32;
        (0..12).map(uniform).sum::<f32>() - 6.0
    }

    /// A picture of soft gradients from dark to bright, and noise of deviation `sigma` on it: white, or
    /// as smooth as neighbours of 3 x 3 make it.
    fn noisy(sigma: f32, smooth: bool) -> LinearImage {
        const SIZE: usize = 384;
        let white = |x: usize, y: usize, c: usize| normal(((y * 2 * SIZE + x) * 3 + c) as u64);
        let noise = |x: usize, y: usize, c: usize| match smooth {
            false => white(x, y, c),
            // The mean of nine has a third of the deviation.
            true => (0..9).map(|k| white(x + k % 3, y + k / 3, c)).sum::<f32>() / 3.0,
        };
        let pixels = (0..SIZE * SIZE).map(|i| {
            let (x, y) = (i % SIZE, i / SIZE);
            let base = 0.2 + 0.6 * x as f32 / SIZE as f32 + 0.1 * (y as f32 / 90.0).sin();
            Vec3::from_array([0, 1, 2].map(|c| base + sigma * noise(x, y, c)))
        });
        LinearImage(Raster::from_pixels(SIZE, SIZE, pixels.collect()))
    }

    /// Mean of the products of values `step` columns apart; the variance for 0.
    fn covariance(field: &Raster<Vec3>, step: usize) -> f32 {
        let (width, height) = (field.width() - step, field.height());
        let pairs = (0..width * height).map(|i| {
            let (x, y) = (i % width, i / width);
            brightness(*field.get(x, y) * *field.get(x + step, y))
        });
        pairs.sum::<f32>() / (width * height) as f32
    }

    #[test]
    fn noise_is_measured_and_its_like_is_made() {
        for smooth in [false, true] {
            let sigma = 0.03;
            let photo = noisy(sigma, smooth);
            let grain = Grain::of(&photo, |v| v).unwrap();
            // White noise: all patches count, and the median is that of some 2,000. Smooth noise has nine times its mean
            // power at the lowest frequencies, so that a plane, 3 of 256 of them, takes a tenth of the variance; and its
            // strongest patches count no more (2%): 7% of the deviation together.
            let found = grain.deviation(Vec3::splat(0.5));
            for c in 0..3 {
                assert!((found[c] / sigma - 1.0).abs() < 0.1, "{found} {smooth}");
            }
            let field = (0..256 * 256).map(|i| grain.at(i % 256, i / 256, Vec3::splat(0.5)));
            let field = Raster::from_pixels(256, 256, field.collect());
            let variance = covariance(&field, 0);
            let made = variance.sqrt() / brightness(found);
            // The mean variance of the patches that were kept, of which the deviation is the median.
            assert!((made - 1.0).abs() < 0.1, "{made} {smooth}");
            // Means over 3 x 3 of neighbours have two columns of three in common; the planes take a tenth of that.
            let beside = covariance(&field, 1) / variance;
            let expected = if smooth { 2.0 / 3.0 } else { 0.0 };
            assert!((beside - expected).abs() < 0.1, "{beside} {smooth}");
            let mean = field.pixels().iter().sum::<Vec3>() / field.pixels().len() as f32;
            assert!(mean.abs().max_element() < 0.05 * sigma, "{mean}");
        }
    }

    #[test]
    fn a_photograph_without_noise_or_without_flat_areas_has_no_grain() {
        let display = |v: Vec3| v;
        assert!(Grain::of(&noisy(0.0, false), display).is_none());
        // Half a step of 8 bits.
        assert!(Grain::of(&noisy(0.002, false), display).is_none());
        // Blades of grass: edges everywhere, as strong as heavy noise.
        let blade = |i: usize| {
            let (x, y) = (i % 384, i / 384);
            let lean = (x as f32 + 0.3 * y as f32 + 6.0 * (y as f32 / 23.0).sin()) / 3.1;
            let lit = normal(lean as u64 * 97 + (y / 19) as u64);
            Vec3::splat(0.5 + 0.08 * lit)
        };
        let grass = LinearImage(Raster::from_pixels(
            384,
            384,
            (0..384 * 384).map(blade).collect(),
        ));
        assert!(Grain::of(&grass, display).is_none());
        // Soft stripes, alike everywhere.
        let stripes =
            (0..384 * 384).map(|i| Vec3::splat(0.5 + 0.08 * ((i % 384) as f32 / 3.0).sin()));
        let stripes = LinearImage(Raster::from_pixels(384, 384, stripes.collect()));
        assert!(Grain::of(&stripes, display).is_none());
        let tiny = LinearImage(Raster::filled(7, 3, Vec3::splat(0.5)));
        assert!(Grain::of(&tiny, display).is_none());
        let white = LinearImage(Raster::filled(300, 300, Vec3::ONE));
        assert!(Grain::of(&white, display).is_none());
    }
}
