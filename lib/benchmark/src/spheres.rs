//! What three spheres show of two lights: a mirror, a glossy and a diffuse one, all of reflectance .8, seen
//! from +z without perspective.
//!
//! The protocol is StyleLight's [Wang et al. 2022], which DiffusionLight and LuxDiT report: maps of
//! 256 x 128 texels, raised to 1/2.4 and scaled so that their median is .5, light the spheres. The
//! same errors are given under the maps as they are, where exposure counts. Two things differ from
//! renders with a path tracer: the lobe of the glossy sphere is normalised, so that it reflects .8 of
//! a constant light at every angle, and the diffuse sphere has no coat.
use std::f32::consts::PI;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context;
use dipir_imaging::marked_png::{Kind, write_display};
use dipir_imaging::metrics::{rmse, si_rmse};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Columns and rows of the maps that light the spheres.
const MAP: [usize; 2] = [256, 128];
/// Columns and rows of the maps that glossy and diffuse spheres reflect: 2.8 degrees, a fraction of their
/// lobes.
const COARSE_MAP: [usize; 2] = [128, 64];
/// Pixels across a sphere.
const SIZE: usize = 64;
/// Samples along each side of a pixel of the mirror: half a degree apart in its middle.
const MIRROR_SAMPLES: usize = 8;
/// Share of light that every sphere reflects.
const REFLECTANCE: f32 = 0.8;
/// GGX width of the glossy sphere: the square of a roughness of .35.
const GLOSSY_ALPHA: f32 = 0.1225;
/// Share that a sphere covers of the protocol's pictures, which are black around it: 16:9, 85 mm on a width of 36 mm, a
/// sphere of radius 1 seen from (16, 2) away.
const COVERED: f32 = 0.12;
/// Towards the viewer.
const VIEW: Vec3 = Vec3::Z;

/// What a sphere is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SphereMaterial {
    /// A perfect mirror.
    Mirror,
    /// Matte silver.
    Glossy,
    /// Lambertian grey.
    Diffuse,
}

/// All of them.
pub const MATERIALS: [SphereMaterial; 3] = [
    SphereMaterial::Mirror,
    SphereMaterial::Glossy,
    SphereMaterial::Diffuse,
];

/// Errors of one sphere. Errors of a pixel are lengths of RGB vectors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SphereErrors {
    /// Root mean square over the sphere.
    pub rmse: f64,
    /// The same after the best scale of the estimate.
    pub si_rmse: f64,
    /// The same after both were mapped from the .01st and 99.9th percentile of their pictures to 0 and 1.
    pub normalized_rmse: f64,
    /// Mean angle between RGB vectors, degrees.
    pub rgb_angle_deg: f64,
}

/// What one sphere shows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SphereScores {
    /// The sphere.
    pub material: SphereMaterial,
    /// Under the compressed maps, as papers report it.
    pub compressed: SphereErrors,
    /// Under the maps as they are.
    pub linear: SphereErrors,
}

/// Scores of the map in the file `estimate` against that in `truth`. Writes the spheres under both to
/// `png`, if it is given.
///
/// # Errors
/// If a map cannot be read or the picture not be written.
pub fn compare_files(
    truth: &Path,
    estimate: &Path,
    png: Option<&Path>,
) -> anyhow::Result<Vec<SphereScores>> {
    let (truth, estimate) = (
        EnvironmentMap::read(truth)?,
        EnvironmentMap::read(estimate)?,
    );
    if let Some(png) = png {
        write_display(png, &sheet(&truth, &estimate), Kind::Comparison)
            .with_context(|| format!("cannot write {}", png.display()))?;
    }
    Ok(compare(&truth, &estimate))
}

/// Scores of `estimate` against `truth`, a sphere each.
pub fn compare(truth: &EnvironmentMap, estimate: &EnvironmentMap) -> Vec<SphereScores> {
    let [truth, estimate] = [truth, estimate].map(|m| m.resampled(MAP[0], MAP[1]));
    let [true_compressed, compressed] = [&truth, &estimate].map(compressed);
    let score = |material| SphereScores {
        material,
        compressed: errors(
            &sphere(&true_compressed, material),
            &sphere(&compressed, material),
        ),
        linear: errors(&sphere(&truth, material), &sphere(&estimate, material)),
    };
    MATERIALS.map(score).to_vec()
}

/// The scores as lines of text.
pub fn table(scores: &[SphereScores]) -> String {
    let mut text = String::from(
        "sphere  | light      | si-RMSE | RMSE    | normalised RMSE | RGB angle, degrees",
    );
    for score in scores {
        let name = format!("{:?}", score.material).to_lowercase();
        for (light, e) in [("compressed", &score.compressed), ("linear", &score.linear)] {
            let _ = write!(
                text,
                "\n{name:7} | {light:10} | {:.4}  | {:.4}  | {:.4}          | {:.2}",
                e.si_rmse, e.rmse, e.normalized_rmse, e.rgb_angle_deg
            );
        }
    }
    text
}

/// The map to the power of 1/2.4, scaled so that the median of its positive values is .5.
fn compressed(map: &EnvironmentMap) -> EnvironmentMap {
    let texels: Vec<Vec3> = map.texels().iter().map(|t| t.powf(1.0 / 2.4)).collect();
    let mut positive: Vec<f32> = texels.iter().flat_map(|t| t.to_array()).collect();
    positive.retain(|v| *v > 0.0);
    positive.sort_by(f32::total_cmp);
    let scale = match positive.is_empty() {
        true => 1.0,
        false => 0.5 / percentile(&positive, 0.5),
    };
    let scaled = texels.iter().map(|t| *t * scale).collect();
    EnvironmentMap::new(map.width(), map.height(), scaled).unwrap_or_else(|_| map.clone())
}

/// Between the values of a sorted list, as numpy does it.
fn percentile(sorted: &[f32], share: f32) -> f32 {
    let at = share * (sorted.len() - 1) as f32;
    let (low, high) = (
        sorted[at as usize],
        sorted[(at.ceil() as usize).min(sorted.len() - 1)],
    );
    low + at.fract() * (high - low)
}

/// The normal of the sphere at (`x`, `y`) pixels from the picture's top left corner.
fn normal_at(x: f32, y: f32) -> Option<Vec3> {
    let radius = 0.5 * SIZE as f32;
    let (x, y) = (x / radius - 1.0, 1.0 - y / radius);
    let squared = 1.0 - x * x - y * y;
    (squared > 0.0).then(|| Vec3::new(x, y, squared.sqrt()))
}

/// Pixels with a centre on the sphere.
fn pixels() -> Vec<(usize, usize, Vec3)> {
    let all = (0..SIZE * SIZE).map(|n| (n % SIZE, n / SIZE));
    all.filter_map(|(x, y)| normal_at(x as f32 + 0.5, y as f32 + 0.5).map(|n| (x, y, n)))
        .collect()
}

/// Radiance of the pixels of a sphere under `map`, in one row.
fn sphere(map: &EnvironmentMap, material: SphereMaterial) -> Raster<Vec3> {
    let pixels = pixels();
    let values: Vec<Vec3> = match material {
        SphereMaterial::Mirror => pixels
            .par_iter()
            .map(|&(x, y, _)| mirrored(map, x, y))
            .collect(),
        _ => {
            let texels = coarse_texels(map);
            let reflected =
                |&(_, _, normal): &(usize, usize, Vec3)| reflected(&texels, normal, material);
            pixels.par_iter().map(reflected).collect()
        }
    };
    let values: Vec<Vec3> = values.into_iter().map(|v| REFLECTANCE * v).collect();
    Raster::from_pixels(values.len(), 1, values)
}

/// What the mirror shows in a pixel.
fn mirrored(map: &EnvironmentMap, x: usize, y: usize) -> Vec3 {
    let (mut sum, mut count) = (Vec3::ZERO, 0.0);
    for k in 0..MIRROR_SAMPLES * MIRROR_SAMPLES {
        let offset = |k: usize| (k as f32 + 0.5) / MIRROR_SAMPLES as f32;
        let (dx, dy) = (offset(k % MIRROR_SAMPLES), offset(k / MIRROR_SAMPLES));
        if let Some(normal) = normal_at(x as f32 + dx, y as f32 + dy) {
            sum += map.eval((2.0 * normal.dot(VIEW) * normal - VIEW).normalize());
            count += 1.0;
        }
    }
    sum / f32::max(count, 1.0)
}

/// Direction, radiance and solid angle of the texels of a coarse map.
fn coarse_texels(map: &EnvironmentMap) -> Vec<(Vec3, Vec3, f32)> {
    let [width, height] = COARSE_MAP;
    let map = map.resampled(width, height);
    (0..width * height)
        .map(|n| {
            let (i, j) = (n / width, n % width);
            (
                map.direction_of(i, j),
                map.texel(i, j),
                map.solid_angle(i) as f32,
            )
        })
        .collect()
}

/// Mean of the light over the lobe of a rough material, weights normalised.
fn reflected(texels: &[(Vec3, Vec3, f32)], normal: Vec3, material: SphereMaterial) -> Vec3 {
    let (mut sum, mut total) = (Vec3::ZERO, 0.0);
    for &(light, radiance, solid_angle) in texels {
        let cos = normal.dot(light);
        if cos > 0.0 {
            let lobe = match material {
                SphereMaterial::Diffuse => cos,
                _ => ggx(normal, light),
            };
            sum += lobe * solid_angle * radiance;
            total += lobe * solid_angle;
        }
    }
    sum / total.max(f32::MIN_POSITIVE)
}

/// GGX distribution times height-correlated Smith shadowing, up to a factor that depends on the normal
/// alone [Heitz 2014].
fn ggx(normal: Vec3, light: Vec3) -> f32 {
    let a2 = GLOSSY_ALPHA * GLOSSY_ALPHA;
    let half = (light + VIEW).normalize_or(normal);
    let (n_h, n_l, n_v) = (normal.dot(half), normal.dot(light), normal.dot(VIEW));
    let t = n_h * n_h * (a2 - 1.0) + 1.0;
    let distribution = a2 / (PI * t * t);
    let root = |c: f32| (a2 + (1.0 - a2) * c * c).sqrt();
    distribution * n_l / (n_v * root(n_l) + n_l * root(n_v))
}

fn errors(truth: &Raster<Vec3>, found: &Raster<Vec3>) -> SphereErrors {
    // Of RGB vectors, not of channels.
    let vectors = 3f64.sqrt();
    SphereErrors {
        rmse: vectors * rmse(found, truth),
        si_rmse: vectors * si_rmse(found, truth),
        normalized_rmse: vectors * rmse(&normalized(found), &normalized(truth)),
        rgb_angle_deg: rgb_angle_deg(found, truth),
    }
}

/// Values from the .01st and 99.9th percentile of the picture to 0 and 1; 0 where those are the same. The first is that of
/// the black around the sphere.
fn normalized(image: &Raster<Vec3>) -> Raster<Vec3> {
    let mut values: Vec<f32> = image.pixels().iter().flat_map(|p| p.to_array()).collect();
    values.sort_by(f32::total_cmp);
    let high = percentile(&values, 1.0 - 0.001 / COVERED);
    let scale = if high > 0.0 { 1.0 / high } else { 0.0 };
    image.map(|p| *p * scale)
}

fn rgb_angle_deg(a: &Raster<Vec3>, b: &Raster<Vec3>) -> f64 {
    let pairs = a.pixels().iter().zip(b.pixels());
    let angle = |(a, b): (&Vec3, &Vec3)| match (a.try_normalize(), b.try_normalize()) {
        (Some(a), Some(b)) => 2.0 * f64::from(0.5 * a.distance(b)).min(1.0).asin(),
        _ => 0.0,
    };
    let sum: f64 = pairs.map(angle).sum();
    (sum / a.pixels().len().max(1) as f64).to_degrees()
}

/// The spheres under the truth above those under the estimate, mid-grey where the truth's mean is.
fn sheet(truth: &EnvironmentMap, estimate: &EnvironmentMap) -> DisplayImage {
    let mut image = Raster::filled(3 * SIZE, 2 * SIZE, Vec3::ZERO);
    let mean = (truth.integral() / (4.0 * std::f64::consts::PI)).element_sum() as f32 / 3.0;
    let exposure = 0.18 / mean.max(f32::MIN_POSITIVE);
    let places = pixels();
    for (row, map) in [truth, estimate].into_iter().enumerate() {
        let map = map.resampled(MAP[0], MAP[1]);
        for (column, material) in MATERIALS.into_iter().enumerate() {
            let values = sphere(&map, material);
            for (&(x, y, _), value) in places.iter().zip(values.pixels()) {
                *image.get_mut(column * SIZE + x, row * SIZE + y) = exposure * *value;
            }
        }
    }
    Transfer::Srgb.encode(&LinearImage(image))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bright texel in a dim blue world.
    fn lamp(column: usize) -> EnvironmentMap {
        let mut texels = vec![Vec3::new(0.1, 0.1, 0.2); 256 * 128];
        texels[40 * 256 + column] = Vec3::new(900.0, 800.0, 500.0);
        EnvironmentMap::new(256, 128, texels).unwrap()
    }

    #[test]
    fn a_constant_light_is_reflected_evenly_by_every_sphere() {
        let map = EnvironmentMap::constant(256, 128, Vec3::new(0.5, 1.0, 2.0));
        for material in MATERIALS {
            let image = sphere(&map, material);
            let expected = REFLECTANCE * Vec3::new(0.5, 1.0, 2.0);
            // Weighted means of equal values: rounding of sums over 8,192 texels.
            assert!(image.pixels().iter().all(|p| p.distance(expected) < 1e-3));
        }
    }

    #[test]
    fn a_diffuse_sphere_under_a_small_source_follows_the_cosine() {
        let mut texels = vec![Vec3::ZERO; 128 * 64];
        texels[20 * 128 + 64] = Vec3::ONE;
        let map = EnvironmentMap::new(128, 64, texels).unwrap();
        let (light, size) = (map.direction_of(20, 64), map.solid_angle(20) as f32);
        let image = sphere(&map, SphereMaterial::Diffuse);
        for (&(_, _, normal), value) in pixels().iter().zip(image.pixels()) {
            let expected = REFLECTANCE * normal.dot(light).max(0.0) * size / PI;
            // The sum of cosines over texels is pi to the width of a texel at the horizon, 1%.
            assert!(
                (value.x - expected).abs() <= 0.01 * size,
                "{} {expected}",
                value.x
            );
        }
    }

    #[test]
    fn the_middle_of_a_mirror_shows_what_is_behind_the_viewer() {
        let texels = (0..256 * 128).map(|k| {
            let black = EnvironmentMap::constant(256, 128, Vec3::ZERO);
            Vec3::splat((black.direction_of(k / 256, k % 256).z > 0.9) as u8 as f32)
        });
        let map = EnvironmentMap::new(256, 128, texels.collect()).unwrap();
        assert_eq!(mirrored(&map, SIZE / 2, SIZE / 2), Vec3::ONE);
        assert_eq!(mirrored(&map, SIZE / 2, 2), Vec3::ZERO);
    }

    #[test]
    fn percentiles_are_those_of_a_picture_that_is_black_around_the_sphere() {
        let count = 1200;
        let values: Vec<f32> = (1..=3 * count).map(|k| k as f32).collect();
        let image = Raster::from_pixels(count, 1, values.chunks(3).map(Vec3::from_slice).collect());
        let mut padded = vec![0.0; (3.0 * count as f32 * (1.0 / COVERED - 1.0)).round() as usize];
        padded.extend(&values);
        let (low, high) = (percentile(&padded, 1e-4), percentile(&padded, 0.999));
        assert_eq!(low, 0.0);
        // Values are 1 apart; ranks of the sphere and of the picture are rounded to less than 1 of 3,570.
        let shown = normalized(&image);
        assert!((shown.get(count - 1, 0).z - 3600.0 / high).abs() < 1.0 / high);
        // What the darkest pixel shows is no black.
        assert!((shown.get(0, 0).x - 1.0 / high).abs() < 1e-6);
    }

    #[test]
    fn a_light_is_perfect_against_itself_and_scale_and_colour_are_told_apart() {
        let truth = lamp(20);
        for score in compare(&truth, &truth) {
            let e = score.linear;
            assert_eq!(
                (e.rmse, e.normalized_rmse, e.rgb_angle_deg),
                (0.0, 0.0, 0.0)
            );
            assert!(e.si_rmse < 1e-6 * f64::from(truth.peak().1.x));
        }
        for score in compare(&truth, &truth.scaled(2.0)) {
            let e = score.linear;
            assert!(e.rmse > 0.01 && e.si_rmse < 1e-4 * e.rmse && e.normalized_rmse < 1e-5);
            assert!(e.rgb_angle_deg < 0.1, "{e:?}");
            // The compression takes exposure out.
            assert!(score.compressed.rmse < 1e-4, "{:?}", score.compressed);
        }
        for score in compare(&truth, &lamp(150)) {
            assert!(score.linear.si_rmse > 0.01, "{score:?}");
            // The lamp colours all of the diffuse sphere, and a few pixels of the mirror.
            let least = match score.material {
                SphereMaterial::Diffuse => 1.0,
                SphereMaterial::Glossy | SphereMaterial::Mirror => 0.0,
            };
            assert!(score.linear.rgb_angle_deg > least, "{score:?}");
        }
    }

    #[test]
    fn percentiles_lie_between_values_as_numpy_s_do() {
        // numpy.percentile([0, 1, 2, 10], [50, 99.9])
        let sorted = [0.0, 1.0, 2.0, 10.0];
        assert_eq!(percentile(&sorted, 0.5), 1.5);
        assert!((percentile(&sorted, 0.999) - 9.976).abs() < 1e-4);
    }
}
