//! Latitude-longitude environment maps, piecewise constant.
//!
//! OpenEXR's convention: the top row looks to +y, the centre column to +z, and +x lies to the
//! left of the centre. Texel `(i, j)` (row, column) is the cell between the polar angles
//! `pi i / H` and `pi (i + 1) / H` and the azimuths `2 pi j / W` and `2 pi (j + 1) / W`, where
//! a direction is `(sin phi sin theta, cos theta, -cos phi sin theta)`. Its radiance is one
//! colour: evaluation, sampling and transport all use that one definition.
use std::f64::consts::{PI, TAU};
use std::path::Path;

use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

use dipir_imaging::file::read_linear;
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::{LinearImage, Raster};

use crate::error::LightError;
use crate::luminance::luminance;
use crate::trigonometry::{atan2_turns, sin_cos_turns};

pub use crate::environment_sampler::EnvironmentSampler;

/// Radiance from every direction, constant over each cell of a latitude-longitude grid.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentMap {
    width: usize,
    height: usize,
    texels: Vec<Vec3>,
}

impl EnvironmentMap {
    /// A map of `width * height` texels, row by row from the top. Errors name the first texel
    /// that is negative or not finite.
    pub fn new(width: usize, height: usize, texels: Vec<Vec3>) -> Result<Self, LightError> {
        if width == 0 || height == 0 {
            return Err(LightError::Empty { width, height });
        }
        if texels.len() != width * height {
            return Err(LightError::TexelCount {
                found: texels.len(),
                width,
                height,
            });
        }
        let bad = |t: &Vec3| !t.is_finite() || t.min_element() < 0.0;
        if let Some(k) = texels.iter().position(bad) {
            return Err(LightError::Texel {
                column: k % width,
                row: k / width,
                value: texels[k],
            });
        }
        Ok(Self {
            width,
            height,
            texels,
        })
    }

    /// A map of texels that are known to be finite and not negative.
    pub(crate) fn from_trusted(width: usize, height: usize, texels: Vec<Vec3>) -> Self {
        debug_assert!(texels.len() == width * height && !texels.is_empty());
        Self {
            width,
            height,
            texels,
        }
    }

    /// The same radiance from everywhere. Panics on an empty size or a negative or non-finite
    /// radiance.
    pub fn constant(width: usize, height: usize, radiance: Vec3) -> Self {
        assert!(width > 0 && height > 0, "{width} x {height} texels");
        assert!(
            radiance.is_finite() && radiance.min_element() >= 0.0,
            "radiance {radiance}"
        );
        Self {
            width,
            height,
            texels: vec![radiance; width * height],
        }
    }

    /// A map from an image in latitude-longitude layout: twice as wide as high, or it is an
    /// error, because a crop or a cube map would put the light elsewhere.
    fn from_image(image: &LinearImage) -> Result<Self, LightError> {
        let (width, height) = (image.0.width(), image.0.height());
        if width != 2 * height {
            return Err(LightError::Aspect { width, height });
        }
        Self::new(width, height, image.0.pixels().to_vec())
    }

    /// Reads a latitude-longitude OpenEXR or Radiance HDR file. NaN, infinite and negative
    /// pixels are refused by name. Light of other primaries than Rec.709's is converted; what
    /// Rec.709 cannot hold without values below 0 gets 0 for them.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, LightError> {
        let path = path.as_ref();
        let image = read_linear(path)?;
        Self::from_image(&image).map_err(|source| LightError::Map {
            path: path.to_owned(),
            source: Box::new(source),
        })
    }

    /// Writes OpenEXR with channels `R G B` in 32-bit floats and the `envmap` attribute that
    /// marks a latitude-longitude map.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), LightError> {
        let mut layers = Layers::new(self.width, self.height);
        layers.latlong = true;
        layers.insert_rgb("", Precision::Full, &self.to_image().0)?;
        Ok(layers.write_exr(path)?)
    }

    /// The map as an image.
    pub fn to_image(&self) -> LinearImage {
        LinearImage(Raster::from_pixels(
            self.width,
            self.height,
            self.texels.clone(),
        ))
    }

    /// Columns, around the horizon.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows, from +y down to -y.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// All texels, row by row from the top.
    #[inline]
    pub fn texels(&self) -> &[Vec3] {
        &self.texels
    }

    /// Radiance of texel `(i, j)`: row, column.
    #[inline]
    pub fn texel(&self, i: usize, j: usize) -> Vec3 {
        self.texels[i * self.width + j]
    }

    /// Radiance arriving from the unit vector `direction`.
    #[inline]
    pub fn eval(&self, direction: Vec3) -> Vec3 {
        let (i, j) = self.texel_of(direction);
        self.texels[i * self.width + j]
    }

    /// Row and column of the texel that `direction` points to.
    #[inline]
    pub fn texel_of(&self, direction: Vec3) -> (usize, usize) {
        texel_of(direction, self.width, self.height)
    }

    /// Unit vector to the middle (in polar angle and azimuth) of texel `(i, j)`.
    #[inline]
    pub fn direction_of(&self, i: usize, j: usize) -> Vec3 {
        direction_at(
            (j as f32 + 0.5) / self.width as f32,
            (i as f32 + 0.5) / self.height as f32,
        )
    }

    /// Solid angle of every texel of row `i`, in steradians.
    #[inline]
    pub fn solid_angle(&self, i: usize) -> f64 {
        solid_angle(self.width, self.height, i)
    }

    /// Bounds of texel `(i, j)` as `([theta_min, theta_max], [phi_min, phi_max])` in radians:
    /// the polar angle from +y, and the azimuth of the module's formula.
    pub fn bounds_rad(&self, i: usize, j: usize) -> ([f64; 2], [f64; 2]) {
        let theta = |k: usize| PI * k as f64 / self.height as f64;
        let phi = |k: usize| TAU * k as f64 / self.width as f64;
        ([theta(i), theta(i + 1)], [phi(j), phi(j + 1)])
    }

    /// Radiance integrated over the sphere, per channel.
    pub fn integral(&self) -> DVec3 {
        (0..self.height)
            .map(|i| {
                let row = &self.texels[i * self.width..(i + 1) * self.width];
                row.iter().map(|t| t.as_dvec3()).sum::<DVec3>() * self.solid_angle(i)
            })
            .sum()
    }

    /// Luminance of every texel, row by row.
    pub fn luminance(&self) -> Vec<f32> {
        self.texels.iter().map(|&t| luminance(t)).collect()
    }

    /// Direction and radiance of the texel of highest luminance (the first of equals).
    pub fn peak(&self) -> (Vec3, Vec3) {
        let mut best = 0;
        for (k, &t) in self.texels.iter().enumerate() {
            if luminance(t) > luminance(self.texels[best]) {
                best = k;
            }
        }
        let direction = self.direction_of(best / self.width, best % self.width);
        (direction, self.texels[best])
    }

    /// The map with every radiance multiplied by `exposure`. Panics if a product is negative or
    /// overflows.
    pub fn scaled(&self, exposure: f32) -> Self {
        let texels: Vec<Vec3> = self.texels.iter().map(|&t| t * exposure).collect();
        let fits = |t: &Vec3| t.is_finite() && t.min_element() >= 0.0;
        assert!(texels.iter().all(fits), "exposure {exposure}");
        Self { texels, ..*self }
    }

    /// The map turned by `angle_rad` about +y, counter-clockwise seen from above: light from +z
    /// comes from +x after a quarter turn. Exact for whole texels; between them each row's light
    /// is shared by overlap, which keeps its energy.
    pub fn rotated_y(&self, angle_rad: f64) -> Self {
        let shift = (angle_rad / TAU * self.width as f64).rem_euclid(self.width as f64);
        let (whole, fraction) = (shift.floor() as usize, shift.fract() as f32);
        // Angles meant as whole texels arrive with rounding; that must not blur.
        let (whole, fraction) = match fraction {
            f if f < 1e-6 => (whole, 0.0),
            f if f > 1.0 - 1e-6 => (whole + 1, 0.0),
            f => (whole, f),
        };
        let mut texels = Vec::with_capacity(self.texels.len());
        for i in 0..self.height {
            for j in 0..self.width {
                let near = self.texel(i, (j + whole) % self.width);
                let far = self.texel(i, (j + whole + 1) % self.width);
                texels.push(near * (1.0 - fraction) + far * fraction);
            }
        }
        Self { texels, ..*self }
    }

    /// The map on another grid: every new texel is the mean over its cell of the old map, so
    /// that energy is kept, whether there are fewer texels or more. Panics on an empty size.
    pub fn resampled(&self, width: usize, height: usize) -> Self {
        assert!(width > 0 && height > 0, "{width} x {height} texels");
        let columns = overlaps(self.width, width, |k, n| k as f64 / n as f64);
        // Rows overlap in -cos(theta), which measures area on the sphere.
        let rows = overlaps(self.height, height, |k, n| {
            let s = (0.5 * PI * k as f64 / n as f64).sin();
            s * s
        });
        let texels = rows
            .par_iter()
            .flat_map_iter(|row| {
                let mut line = vec![DVec3::ZERO; self.width];
                for &(i, weight) in row {
                    let source = &self.texels[i * self.width..(i + 1) * self.width];
                    for (l, t) in line.iter_mut().zip(source) {
                        *l += t.as_dvec3() * weight;
                    }
                }
                let mean = move |column: &Vec<(usize, f64)>| {
                    let sum: DVec3 = column.iter().map(|&(j, weight)| line[j] * weight).sum();
                    sum.as_vec3()
                };
                columns.iter().map(mean).collect::<Vec<_>>()
            })
            .collect();
        Self {
            width,
            height,
            texels,
        }
    }
}

/// For each of `to` cells, the cells of a grid of `from` that it overlaps, and the shares of
/// them (summing to 1) measured by `edge(k, n)`, the position of edge `k` of `n` cells.
fn overlaps(from: usize, to: usize, edge: impl Fn(usize, usize) -> f64) -> Vec<Vec<(usize, f64)>> {
    let cell = |k: usize| {
        let (low, high) = (edge(k, to), edge(k + 1, to));
        let first = (k * from) / to;
        let last = ((k + 1) * from).div_ceil(to);
        let mut shares: Vec<(usize, f64)> = (first..last)
            .map(|s| {
                let overlap = edge(s + 1, from).min(high) - edge(s, from).max(low);
                (s, overlap.max(0.0))
            })
            .collect();
        let total: f64 = shares.iter().map(|s| s.1).sum();
        shares.iter_mut().for_each(|s| s.1 /= total);
        shares
    };
    (0..to).map(cell).collect()
}

/// Solid angle in steradians of a texel in row `i` of a `width` x `height` map:
/// `(cos theta_i - cos theta_{i+1}) 2 pi / W`, as a product of sines, which keeps its digits
/// at the poles.
#[inline]
pub fn solid_angle(width: usize, height: usize, i: usize) -> f64 {
    let middle = PI * (i as f64 + 0.5) / height as f64;
    let half = 0.5 * PI / height as f64;
    2.0 * middle.sin() * half.sin() * TAU / width as f64
}

/// Unit vector at azimuth `2 pi u` and polar angle `pi v`.
#[inline]
pub fn direction_at(u: f32, v: f32) -> Vec3 {
    let (sin_phi, cos_phi) = sin_cos_turns(u);
    let (sin_theta, cos_theta) = sin_cos_turns(0.5 * v);
    Vec3::new(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta)
}

/// Row and column of the texel of a `width` x `height` map that `direction` points to.
#[inline]
pub fn texel_of(direction: Vec3, width: usize, height: usize) -> (usize, usize) {
    let u = atan2_turns(direction.x, -direction.z);
    let sin_theta = (direction.x * direction.x + direction.z * direction.z).sqrt();
    let v = 2.0 * atan2_turns(sin_theta, direction.y);
    let i = (v * height as f32) as usize;
    let j = (u * width as f32) as usize;
    (i.min(height - 1), j.min(width - 1))
}

/// How far inside a texel, as shares of its sides, directions are drawn: rounding then cannot
/// carry them over an edge, and `texel_of` finds each where it was drawn.
///
/// `texel_of` is off by 7e-8 turns, a direction by 6e-8 rad, its azimuth `(j + x) / W` by 6e-8
/// turns: together 1.4e-7 of the turn, 2.8e-7 of the half turn from pole to pole, and there an
/// area's share measures up to twice the angle's. All is taken three times; no texel gives up
/// more than a quarter. Only the place inside the texel is affected, never its probability.
#[inline]
pub(crate) fn inset(width: usize, height: usize) -> Vec2 {
    Vec2::new(4.2e-7 * width as f32, 1.7e-6 * height as f32).min(Vec2::splat(0.25))
}

/// A direction in column `j` of a map of `width` columns, at the share `x` of the column's width
/// and the height `y` (the cosine of its polar angle).
#[inline]
pub(crate) fn direction_in_column(width: usize, j: usize, x: f32, y: f64) -> Vec3 {
    let (sin_phi, cos_phi) = sin_cos_turns((j as f32 + x) / width as f32);
    let s = ((1.0 - y) * (1.0 + y)).max(0.0).sqrt() as f32;
    Vec3::new(sin_phi * s, y as f32, -cos_phi * s)
}

/// A direction uniform in solid angle over texel `(i, j)` of `map`, from `u` in `[0, 1]^2`;
/// `row_cos` holds `cos(pi i / H)`.
#[inline]
pub(crate) fn direction_in_texel(
    map: &EnvironmentMap,
    row_cos: &[f64],
    i: usize,
    j: usize,
    u: Vec2,
) -> Vec3 {
    let inset = inset(map.width, map.height);
    let within = inset + u * (Vec2::ONE - 2.0 * inset);
    let y = row_cos[i] + (row_cos[i + 1] - row_cos[i]) * f64::from(within.y);
    direction_in_column(map.width, j, within.x, y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::speckled;
    use proptest::prelude::*;

    #[test]
    fn directions_follow_the_convention_of_openexr() {
        // 4 x 2: the middles of texels lie between the axes, so look along the axes instead.
        let map = EnvironmentMap::new(4, 2, (0..8).map(|k| Vec3::splat(k as f32)).collect());
        let map = map.unwrap();
        let at = |x: f32, y: f32, z: f32| map.texel_of(Vec3::new(x, y, z).normalize());
        // Just right of the centre column is +z towards -x; the left half holds +x.
        assert_eq!(at(-0.1, 0.1, 1.0), (0, 2));
        assert_eq!(at(0.1, 0.1, 1.0), (0, 1));
        assert_eq!(at(1.0, -0.1, -0.1), (1, 0));
        assert_eq!(at(-1.0, -0.1, -0.1), (1, 3));
        assert!(direction_at(0.25, 0.5).distance(Vec3::X) < 1e-6);
        assert!(direction_at(0.5, 0.5).distance(Vec3::Z) < 1e-6);
        assert!(direction_at(0.5, 0.0).distance(Vec3::Y) < 1e-6);
    }

    #[test]
    fn poles_and_the_seam_have_a_texel() {
        let map = EnvironmentMap::constant(7, 3, Vec3::ONE);
        assert_eq!(map.texel_of(Vec3::Y).0, 0);
        assert_eq!(map.texel_of(Vec3::NEG_Y).0, 2);
        assert_eq!(map.texel_of(Vec3::new(1e-9, 0.0, -1.0)), (1, 0));
        assert_eq!(map.texel_of(Vec3::new(-1e-9, 0.0, -1.0)), (1, 6));
    }

    #[test]
    fn solid_angles_sum_to_the_sphere() {
        for (w, h) in [(1, 1), (2, 1), (3, 5), (128, 64), (4096, 2048)] {
            let sum: f64 = (0..h).map(|i| solid_angle(w, h, i) * w as f64).sum();
            assert!((sum / (4.0 * PI) - 1.0).abs() < 1e-12, "{w} x {h}");
        }
    }

    proptest! {
        #[test]
        fn the_middle_of_a_texel_lies_in_that_texel(
            w in 1usize..8192, h in 1usize..4096, a in 0.0f64..1.0, b in 0.0f64..1.0,
        ) {
            let (i, j) = ((a * h as f64) as usize, (b * w as f64) as usize);
            let d = direction_at((j as f32 + 0.5) / w as f32, (i as f32 + 0.5) / h as f32);
            prop_assert_eq!(texel_of(d, w, h), (i, j));
        }

        #[test]
        fn resampling_keeps_the_energy(w in 1usize..40, h in 1usize..20) {
            let map = speckled(24, 12);
            let (before, after) = (map.integral(), map.resampled(w, h).integral());
            // Texels round to f32 once: 6e-8 each.
            prop_assert!(((after - before) / before).abs().max_element() < 1e-6);
        }

        #[test]
        fn turning_keeps_the_energy_of_every_row(angle in -10.0f64..10.0) {
            let map = speckled(24, 12);
            let (before, after) = (map.integral(), map.rotated_y(angle).integral());
            prop_assert!(((after - before) / before).abs().max_element() < 1e-6);
        }

        #[test]
        fn a_file_holds_the_map_to_the_last_bit(w in 1usize..9, seed in 0u32..1000) {
            let texels = (0..2 * w * w).map(|k| {
                let u = crate::testing::uniform(seed * 1000 + k as u32);
                Vec3::new(u.x, u.y, 1e6 * u.x * u.y)
            });
            let map = EnvironmentMap::new(2 * w, w, texels.collect()).unwrap();
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("map.exr");
            map.write(&path).unwrap();
            prop_assert_eq!(EnvironmentMap::read(&path).unwrap(), map);
            prop_assert!(Layers::read_exr(&path).unwrap().latlong);
        }
    }

    #[test]
    fn a_quarter_turn_brings_the_light_from_z_to_x() {
        let mut texels = vec![Vec3::ZERO; 8 * 4];
        texels[8 + 4] = Vec3::ONE;
        let map = EnvironmentMap::new(8, 4, texels).unwrap();
        let turned = map.rotated_y(PI / 2.0);
        assert_eq!(turned.texel(1, 2), Vec3::ONE);
        assert_eq!(turned.integral(), map.integral());
        assert_eq!(turned.rotated_y(-PI / 2.0), map);
    }

    #[test]
    fn resampling_to_a_divisor_averages_by_solid_angle() {
        let map = speckled(8, 4);
        let half = map.resampled(4, 2);
        let share = |i: usize| (map.solid_angle(i) / half.solid_angle(0)) as f32;
        let mean = (map.texel(0, 2) + map.texel(0, 3)) * share(0)
            + (map.texel(1, 2) + map.texel(1, 3)) * share(1);
        assert!((half.texel(0, 1) - mean).abs().max_element() < 1e-4);
        assert_eq!(map.resampled(8, 4), map);
    }

    fn message(error: &dyn std::error::Error) -> String {
        let causes = std::iter::successors(Some(error), |e| e.source());
        causes.map(|e| e.to_string()).collect::<Vec<_>>().join(": ")
    }

    #[test]
    fn a_bad_texel_is_refused_by_place_and_value() {
        for bad in [f32::NAN, f32::INFINITY, -1e-3] {
            let mut texels = vec![Vec3::ONE; 8];
            texels[6].y = bad;
            let error = EnvironmentMap::new(4, 2, texels).unwrap_err();
            assert_eq!(
                error.to_string(),
                format!(
                    "radiance [1, {bad}, 1] at column 2, row 1 of the environment map; every channel \
                     must be finite and not negative: repair the pixel in an image editor"
                )
            );
        }
    }

    #[test]
    fn files_with_nan_or_negative_or_square_pixels_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.exr");
        let store = |w: usize, h: usize, value: f32| {
            let mut pixels = vec![Vec3::ONE; w * h];
            pixels[w + 1].z = value;
            let mut layers = Layers::new(w, h);
            let raster = Raster::from_pixels(w, h, pixels);
            layers.insert_rgb("", Precision::Full, &raster).unwrap();
            layers.write_exr(&path).unwrap();
            message(&EnvironmentMap::read(&path).unwrap_err())
        };
        let nan = store(4, 2, f32::NAN);
        assert!(
            nan.contains("NaN") && nan.contains("column 1, row 1"),
            "{nan}"
        );
        let infinite = store(4, 2, f32::INFINITY);
        assert!(
            infinite.contains("inf") && infinite.contains("column 1, row 1"),
            "{infinite}"
        );
        let name = path.display();
        assert_eq!(
            store(4, 2, -0.5),
            format!(
                "cannot light a scene with `{name}`: radiance [1, 1, -0.5] at column 1, row 1 of the \
                 environment map; every channel must be finite and not negative: repair the pixel in \
                 an image editor"
            )
        );
        assert_eq!(
            store(3, 3, 1.0),
            format!(
                "cannot light a scene with `{name}`: 3 x 3 pixels are no latitude-longitude map, \
                 which is twice as wide as high; crop or convert it to 6 x 3"
            )
        );
    }

    #[test]
    fn a_map_in_other_primaries_is_converted_and_stays_a_light() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("acescg.hdr");
        let header = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\
                      PRIMARIES=.713 .293 .165 .83 .128 .044 .32168 .33767\n\n-Y 1 +X 2\n";
        let (red, white) = ([128, 0, 0, 129], [128, 128, 128, 129]);
        std::fs::write(&path, [header.as_bytes(), &red, &white].concat()).unwrap();
        let map = EnvironmentMap::read(&path).unwrap();
        let want = Vec3::new(1.705_05, 0.0, 0.0);
        assert!(map.texel(0, 0).abs_diff_eq(want, 1e-4));
        assert!(map.texel(0, 1).abs_diff_eq(Vec3::ONE, 1e-6));
    }

    #[test]
    fn maps_without_texels_or_with_too_few_are_refused() {
        assert!(EnvironmentMap::new(0, 4, vec![]).is_err());
        let error = EnvironmentMap::new(4, 2, vec![Vec3::ONE; 7]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "7 texels were given for an environment map of 4 x 2"
        );
    }
}
