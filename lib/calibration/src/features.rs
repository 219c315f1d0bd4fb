//! What is told to the networks of a picture: brightness, edges and tints of its parts, and how they change along its
//! rows. Nothing finer than a 64th of the longer side is looked at, so that how sharp a picture is tells nothing.
use dipir_imaging::metrics::LUMA;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::resize::{Filter, resize};
use glam::Vec3;

/// Pixels along the longer side.
const LONGEST: usize = 64;
/// Added to linear values before the logarithm.
const FLOOR: f32 = 0.02;
/// Deviation of the logarithm of luminance below which a picture is of one shade.
const BLANK: f32 = 0.03;
/// Parts along each side: of brightness and edges, of tints, of edge directions.
const CELLS: usize = 6;
const TINTS: usize = 4;
const TURNS: usize = 3;
/// Directions of edges in each part.
const DIRECTIONS: usize = 8;
/// Leans from level or upright that are counted finely, degrees either way, and their bins.
const LEAN_DEG: f32 = 15.0;
const LEANS: usize = 15;
/// Tilts of a level line across the picture that are tried, degrees.
const TILTS_DEG: [f32; 9] = [-10.0, -7.0, -4.0, -2.0, 0.0, 2.0, 4.0, 7.0, 10.0];
/// Bands that a tilted picture is cut into.
const BANDS: usize = 40;
/// Angles from the optical axis at which rows are told, degrees, from `-LAST` to `LAST`.
const LAST_DEG: f32 = 45.0;
const ANGLES: usize = 24;
/// Numbers told of each angle.
const PER_ANGLE: usize = 7;
const QUANTILES: [f32; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

/// How many numbers tell of a picture whose focal length is not known.
pub const FEATURES: usize = 1
    + QUANTILES.len()
    + 4 * CELLS * CELLS
    + 2 * TINTS * TINTS
    + TURNS * TURNS * DIRECTIONS
    + 4 * LEANS
    + 2 * TILTS_DEG.len();
/// How many more tell of it where it is.
pub const ANGULAR: usize = 2 + ANGLES * PER_ANGLE;

/// A small picture.
#[derive(Clone, Debug)]
pub struct Thumbnail {
    width: usize,
    height: usize,
    /// Width over height of the photograph.
    aspect: f32,
    /// Logarithm of luminance over its mean.
    log: Vec<f32>,
    /// Logarithms of red and blue over green.
    tint: Vec<[f32; 2]>,
    /// Change to the right and downwards, a pixel.
    change: Vec<[f32; 2]>,
}

impl Thumbnail {
    /// Of a photograph of any size.
    pub fn new(image: &LinearImage) -> Self {
        let (w, h) = (image.0.width().max(1), image.0.height().max(1));
        let longer = w.max(h);
        let [width, height] = [w, h].map(|n| (n * LONGEST).div_ceil(longer).max(8));
        let clean = image.0.map(|p| {
            let channel = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
            Vec3::from_array(p.to_array().map(channel))
        });
        let small = resize(&clean, width, height, Filter::Area);
        let light = small.pixels().iter().map(|p| (p.dot(LUMA) + FLOOR).ln());
        let light: Vec<f32> = light.collect();
        let mean = light.iter().sum::<f32>() / light.len() as f32;
        let tint = small.pixels().iter().map(|p| {
            let p = *p + FLOOR;
            [(p.x / p.y).ln(), (p.z / p.y).ln()]
        });
        let log: Vec<f32> = light.iter().map(|l| l - mean).collect();
        Self {
            width,
            height,
            aspect: w as f32 / h as f32,
            tint: tint.collect(),
            change: change(&log, width),
            log,
        }
    }

    /// Whether it is of one shade, and tells nothing.
    pub fn is_blank(&self) -> bool {
        let squares = self.log.iter().map(|l| l * l).sum::<f32>();
        squares < BLANK * BLANK * self.log.len() as f32
    }

    /// In a mirror.
    pub fn mirrored(&self) -> Self {
        let log = flipped(&self.log, self.width);
        Self {
            tint: flipped(&self.tint, self.width),
            change: change(&log, self.width),
            log,
            ..*self
        }
    }

    /// The [`FEATURES`] numbers that need no focal length.
    pub fn features(&self) -> Vec<f32> {
        let mut all = vec![self.aspect.ln()];
        let mut sorted = self.log.clone();
        sorted.sort_by(f32::total_cmp);
        all.extend(QUANTILES.map(|q| sorted[(q * (sorted.len() - 1) as f32) as usize]));
        let log = |k: usize| self.log[k];
        let means = self.cells(CELLS, log);
        let squares = self.cells(CELLS, |k| log(k) * log(k));
        let spread = |(m, s): (&f32, &f32)| (s - m * m).max(0.0).sqrt();
        all.extend(means.iter().zip(&squares).map(spread));
        all.extend(means);
        for k in 0..2 {
            all.extend(self.cells(CELLS, |p| self.change[p][k].abs()));
            all.extend(self.cells(TINTS, |p| self.tint[p][k]));
        }
        all.extend(self.directions());
        all.extend(self.leans());
        all.extend(self.tilts());
        debug_assert_eq!(all.len(), FEATURES);
        all
    }

    /// The [`ANGULAR`] numbers for a focal length over the longer side: means along rows, by the row's angle above the
    /// optical axis.
    pub fn angular(&self, focal: f32) -> Vec<f32> {
        let longer = self.aspect.max(1.0);
        let half = [self.aspect, 1.0].map(|side| 0.5 * side / longer / focal);
        let mut sums = vec![[0f32; PER_ANGLE]; ANGLES];
        let width = self.width as f32;
        for y in 0..self.height {
            let up = 1.0 - 2.0 * (y as f32 + 0.5) / self.height as f32;
            let angle = (up * half[1]).atan().to_degrees();
            let at = (angle + LAST_DEG) / (2.0 * LAST_DEG) * ANGLES as f32;
            let bin = (at.max(0.0) as usize).min(ANGLES - 1);
            sums[bin][0] += 1.0;
            for k in y * self.width..(y + 1) * self.width {
                let [right, down] = self.change[k];
                let l = self.log[k];
                let terms = [l, l * l, right.abs(), down.abs(), down, self.tint[k][1]];
                sums[bin][1..]
                    .iter_mut()
                    .zip(terms)
                    .for_each(|(s, t)| *s += t / width);
            }
        }
        let mut all = vec![half[0], half[1]];
        for [rows, l, squares, right, down, signed, blue] in sums {
            let n = rows.max(1.0);
            let spread = (squares / n - (l / n).powi(2)).max(0.0).sqrt();
            let seen = rows.min(1.0);
            all.extend([
                seen,
                l / n,
                spread,
                right / n,
                down / n,
                signed / n,
                blue / n,
            ]);
        }
        debug_assert_eq!(all.len(), ANGULAR);
        all
    }

    /// Means over `per_side` x `per_side` parts.
    fn cells(&self, per_side: usize, value: impl Fn(usize) -> f32) -> Vec<f32> {
        let mut sums = vec![[0f32; 2]; per_side * per_side];
        for k in 0..self.log.len() {
            let (x, y) = (k % self.width, k / self.width);
            let cell = y * per_side / self.height * per_side + x * per_side / self.width;
            sums[cell][0] += value(k);
            sums[cell][1] += 1.0;
        }
        sums.iter().map(|[s, n]| s / n.max(1.0)).collect()
    }

    /// Shares of edges by their direction in each part.
    fn directions(&self) -> Vec<f32> {
        let mut sums = vec![[1e-3f32; DIRECTIONS]; TURNS * TURNS];
        for (k, [right, down]) in self.change.iter().enumerate() {
            let (x, y) = (k % self.width, k / self.width);
            let cell = y * TURNS / self.height * TURNS + x * TURNS / self.width;
            let at = (down.atan2(*right) / std::f32::consts::PI).rem_euclid(1.0);
            let bin = ((at * DIRECTIONS as f32 + 0.5) as usize) % DIRECTIONS;
            sums[cell][bin] += right.hypot(*down);
        }
        let shares = |cell: &[f32; DIRECTIONS]| {
            let total: f32 = cell.iter().sum();
            cell.map(|v| v / total)
        };
        sums.iter().flat_map(shares).collect()
    }

    /// Shares of edges by how they lean: nearly upright ones in the left and right half, nearly level ones in the upper
    /// and lower half.
    fn leans(&self) -> Vec<f32> {
        let mut sums = [[1e-3f32; LEANS]; 4];
        for (k, [right, down]) in self.change.iter().enumerate() {
            let (x, y) = (k % self.width, k / self.width);
            let upright = right.abs() > down.abs();
            let (part, lean) = match upright {
                true => (usize::from(2 * x >= self.width), (down / right).atan()),
                false => (
                    2 + usize::from(2 * y >= self.height),
                    -(right / down.abs().max(1e-9) * down.signum()).atan(),
                ),
            };
            let at = (lean.to_degrees() + LEAN_DEG) / (2.0 * LEAN_DEG) * LEANS as f32;
            if (0.0..LEANS as f32).contains(&at) {
                sums[part][at as usize] += right.hypot(*down);
            }
        }
        let shares = |part: &[f32; LEANS]| {
            let total: f32 = part.iter().sum();
            part.map(|v| v / total)
        };
        sums.iter().flat_map(shares).collect()
    }

    /// How much of the brightness is told by the distance from a tilted level line, and from a tilted upright one, over
    /// the best tilt.
    fn tilts(&self) -> Vec<f32> {
        let mut all = Vec::with_capacity(2 * TILTS_DEG.len());
        for upright in [false, true] {
            let told = TILTS_DEG.map(|tilt| self.told(tilt.to_radians().tan(), upright));
            let best = told.iter().copied().fold(1e-6, f32::max);
            all.extend(told.map(|t| t / best));
        }
        all
    }

    fn told(&self, slope: f32, upright: bool) -> f32 {
        let (w, h) = (self.width as f32, self.height as f32);
        let mut bands = [[0f32; 2]; BANDS];
        for (k, l) in self.log.iter().enumerate() {
            let x = (k % self.width) as f32 + 0.5 - 0.5 * w;
            let y = (k / self.width) as f32 + 0.5 - 0.5 * h;
            let at = match upright {
                false => (y + slope * x) / h,
                true => (x - slope * y) / w,
            };
            let band = (((at + 0.5) * BANDS as f32).max(0.0) as usize).min(BANDS - 1);
            bands[band][0] += l;
            bands[band][1] += 1.0;
        }
        let told = |[sum, n]: &[f32; 2]| sum * sum / n.max(1.0);
        bands.iter().map(told).sum::<f32>() / self.log.len() as f32
    }
}

/// By Sobel's operator; 0 on the border.
fn change(log: &[f32], width: usize) -> Vec<[f32; 2]> {
    let height = log.len() / width;
    let mut all = vec![[0.0; 2]; log.len()];
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let at = |dx: usize, dy: usize| log[(y + dy - 1) * width + x + dx - 1];
            let column = |dx: usize| at(dx, 0) + 2.0 * at(dx, 1) + at(dx, 2);
            let row = |dy: usize| at(0, dy) + 2.0 * at(1, dy) + at(2, dy);
            all[y * width + x] = [(column(2) - column(0)) / 8.0, (row(2) - row(0)) / 8.0];
        }
    }
    all
}

fn flipped<T: Copy>(values: &[T], width: usize) -> Vec<T> {
    let turned = |row: &[T]| row.iter().rev().copied().collect::<Vec<T>>();
    values.chunks(width).flat_map(turned).collect()
}
