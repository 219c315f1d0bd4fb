//! How far a composite and a light are from the true ones.
use std::path::Path;

use dipir_imaging::error::ImagingError;
use dipir_imaging::layers::Layers;
use dipir_imaging::metrics::{rmse, si_rmse, ssim};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_light::luminance::luminance;
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// Errors of one composite; all of them of display values in `[0, 1]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PictureScores {
    /// Root mean squared error over all pixels, as papers report it.
    pub rmse: f64,
    /// Structural similarity over all pixels.
    pub ssim: f64,
    /// RMSE after the best scale, over all pixels [Grosse et al. 2009].
    pub si_rmse: f64,
    /// RMSE over the pixels that the object or its shadow touches.
    pub rmse_touched: f64,
    /// RMSE after the best scale over the pixels that show the object: what brightness does not
    /// explain.
    pub si_rmse_object: f64,
}

/// Pixels that count for [`PictureScores`].
#[derive(Clone, Debug)]
pub struct Touched {
    /// Whether the object covers at least half of each pixel.
    pub object: Vec<bool>,
    /// Whether the object or its shadow changes it by half an 8-bit step or more.
    pub any: Vec<bool>,
}

impl Touched {
    /// From the truth: the object's coverage, the picture, and the photograph without the object.
    pub fn new(coverage: &Raster<f32>, truth: &DisplayImage, photo: &DisplayImage) -> Self {
        let coverage = coverage.pixels();
        let pairs = truth.0.pixels().iter().zip(photo.0.pixels());
        let changed = pairs.map(|(a, b)| (*a - *b).abs().max_element() > 0.5 / 255.0);
        Self {
            object: coverage.iter().map(|&a| a >= 0.5).collect(),
            any: coverage
                .iter()
                .zip(changed)
                .map(|(&a, c)| a > 0.0 || c)
                .collect(),
        }
    }
}

/// A composite as it is displayed.
pub struct DisplayedComposite {
    /// The picture.
    pub picture: DisplayImage,
    /// The photograph without the object.
    pub photo: DisplayImage,
    /// Share of each pixel that the object covers.
    pub coverage: Raster<f32>,
}

impl DisplayedComposite {
    /// Reads the layers of a `composite.exr`.
    ///
    /// # Errors
    /// If the file cannot be read or lacks a layer.
    pub fn read(exr: &Path) -> Result<Self, ImagingError> {
        let layers = Layers::read_exr(exr)?;
        let displayed = |name: &str| -> Result<DisplayImage, ImagingError> {
            Ok(Transfer::Srgb.encode(&LinearImage(layers.rgb(name)?)))
        };
        Ok(Self {
            picture: displayed("")?,
            photo: displayed("background")?,
            coverage: layers.channel("object.A")?.clone(),
        })
    }

    /// The pixels that object or shadow touch, this composite being the truth.
    pub fn touched(&self) -> Touched {
        Touched::new(&self.coverage, &self.picture, &self.photo)
    }
}

/// The pixels of `image` where `mask` holds, as one row; one black pixel if there are none.
fn selected(image: &DisplayImage, mask: &[bool]) -> Raster<Vec3> {
    let pixels = image.0.pixels().iter().zip(mask);
    let mut kept: Vec<Vec3> = pixels.filter(|(_, m)| **m).map(|(p, _)| *p).collect();
    if kept.is_empty() {
        kept.push(Vec3::ZERO);
    }
    Raster::from_pixels(kept.len(), 1, kept)
}

/// RMSE of `found` against `truth` over the pixels where `mask` holds. Panics if the sizes differ.
pub fn rmse_over(found: &DisplayImage, truth: &DisplayImage, mask: &[bool]) -> f64 {
    rmse(&selected(found, mask), &selected(truth, mask))
}

/// Scores of `found` against `truth`. Panics if the sizes differ.
pub fn compare_pictures(
    found: &DisplayImage,
    truth: &DisplayImage,
    touched: &Touched,
) -> PictureScores {
    let [found_object, true_object] = [found, truth].map(|p| selected(p, &touched.object));
    PictureScores {
        rmse: rmse(&found.0, &truth.0),
        ssim: ssim(&found.0, &truth.0),
        si_rmse: si_rmse(&found.0, &truth.0),
        rmse_touched: rmse_over(found, truth, &touched.any),
        si_rmse_object: si_rmse(&found_object, &true_object),
    }
}

/// Angles between two lights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LightScores {
    /// Between the directions of most light, degrees in `[0, 180]`; absent where one of the lights
    /// is the same from everywhere.
    pub peak_deg: Option<f64>,
    /// Between the mean directions that light comes from, degrees; absent likewise.
    pub mean_deg: Option<f64>,
}

/// Columns and rows on which the direction of most light is looked for: 2.8 degrees, so that one
/// texel of a lamp does not outshine a sun behind clouds.
const PEAK_GRID: [usize; 2] = [128, 64];
/// A light whose mean direction is shorter than this share of all light comes from everywhere.
const LEAST_MEAN: f64 = 1e-3;

/// Angles between the light of `found` and that of `truth`.
pub fn compare_lights(found: &EnvironmentMap, truth: &EnvironmentMap) -> LightScores {
    let angle = |a: Option<DVec3>, b: Option<DVec3>| match (a, b) {
        (Some(a), Some(b)) => Some((2.0 * (0.5 * a.distance(b)).min(1.0).asin()).to_degrees()),
        _ => None,
    };
    LightScores {
        peak_deg: angle(peak(found), peak(truth)),
        mean_deg: angle(mean_direction(found), mean_direction(truth)),
    }
}

/// The direction of most light; `None` for a light that is the same from everywhere.
fn peak(map: &EnvironmentMap) -> Option<DVec3> {
    let [width, height] = PEAK_GRID;
    let coarse = map.resampled(width, height);
    let values = coarse.texels().iter().map(|t| luminance(*t));
    let (low, high) = values.fold((f32::INFINITY, 0f32), |(l, h), v| (l.min(v), h.max(v)));
    (high > low * 1.001).then(|| coarse.peak().0.as_dvec3().normalize())
}

fn mean_direction(map: &EnvironmentMap) -> Option<DVec3> {
    let (width, height) = (map.width(), map.height());
    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
    for i in 0..height {
        let size = map.solid_angle(i);
        for j in 0..width {
            let power = f64::from(luminance(map.texel(i, j))) * size;
            sum += power * map.direction_of(i, j).as_dvec3();
            total += power;
        }
    }
    (sum.length() > LEAST_MEAN * total).then(|| sum.normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(value: f32) -> DisplayImage {
        DisplayImage(Raster::filled(16, 12, Vec3::splat(value)))
    }

    #[test]
    fn a_picture_is_perfect_against_itself_and_errors_count_where_they_are() {
        let truth = picture(0.5);
        let mut found = picture(0.5);
        *found.0.get_mut(3, 2) = Vec3::splat(0.7);
        let mut coverage = Raster::filled(16, 12, 0.0);
        *coverage.get_mut(3, 2) = 1.0;
        *coverage.get_mut(4, 2) = 0.2;
        let touched = Touched::new(&coverage, &truth, &truth);
        assert_eq!(touched.any.iter().filter(|t| **t).count(), 2);
        let same = compare_pictures(&truth, &truth, &touched);
        assert_eq!((same.rmse, same.rmse_touched, same.ssim), (0.0, 0.0, 1.0));
        let scores = compare_pictures(&found, &truth, &touched);
        // One pixel differs, of 192, and of the two that are touched. A scale makes up for a single pixel.
        assert!((scores.rmse - 0.2 / 192f64.sqrt()).abs() < 1e-7);
        assert!((scores.rmse_touched - 0.2 / 2f64.sqrt()).abs() < 1e-7);
        assert!(scores.si_rmse_object < 1e-7);
    }

    #[test]
    fn shadows_count_as_touched_and_less_than_half_a_step_does_not() {
        let photo = picture(0.5);
        let mut truth = picture(0.5);
        *truth.0.get_mut(0, 0) = Vec3::splat(0.5 - 0.6 / 255.0);
        *truth.0.get_mut(1, 0) = Vec3::splat(0.5 - 0.4 / 255.0);
        let touched = Touched::new(&Raster::filled(16, 12, 0.0), &truth, &photo);
        assert_eq!(touched.any[..3], [true, false, false]);
    }

    #[test]
    fn lights_turned_by_an_angle_differ_by_it() {
        let mut texels = vec![Vec3::splat(0.1); 128 * 64];
        texels[32 * 128 + 20] = Vec3::splat(500.0);
        let map = EnvironmentMap::new(128, 64, texels).unwrap();
        let turned = map.rotated_y(45f64.to_radians());
        let scores = compare_lights(&turned, &map);
        // To the texel, which is 2.8 degrees wide.
        assert!((scores.peak_deg.unwrap() - 45.0).abs() < 2.9, "{scores:?}");
        assert!((scores.mean_deg.unwrap() - 45.0).abs() < 1.0, "{scores:?}");
        let grey = EnvironmentMap::constant(8, 4, Vec3::ONE);
        let scores = compare_lights(&grey, &map);
        assert_eq!((scores.peak_deg, scores.mean_deg), (None, None));
    }
}
