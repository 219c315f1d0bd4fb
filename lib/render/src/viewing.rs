//! The picture that the layers go into, and its errors.
use dipir_imaging::composite::composite_pixel;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::tone::ToneMapper;
use dipir_imaging::transfer::Transfer;
use glam::Vec3;

use crate::film::Film;
use crate::gloss;
use crate::job::{Job, Layer, REPLICATES};

/// The picture that the layers go into: decides which errors are seen.
#[derive(Clone, Copy, Debug)]
pub struct Viewing<'a> {
    /// The photograph; mid-grey (0.18) if there is none.
    pub background: Option<&'a LinearImage>,
    /// What is done to the layers before they are laid over the photograph, if anything.
    pub tone: Option<ToneMapper>,
    /// From linear to display values.
    pub transfer: Transfer,
    /// How much brighter the picture is shown than it is.
    pub gain: f32,
    /// The object is seen by way of the ground: its light is added to the photograph, and hides nothing of it.
    pub adds: bool,
    /// Lens or motion blur the object: its edges are wide, and coverage has noise.
    pub is_blurred: bool,
}

/// Sums over pixels, of one job, of the squared display-referred error.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SquaredError {
    /// Estimated squared error, averaged over the channels, summed over pixels.
    pub sum: f64,
    /// Variance of `sum`.
    pub variance: f64,
}

impl SquaredError {
    /// The error of another job adds up: jobs draw independent samples.
    pub fn merge(self, other: Self) -> Self {
        Self {
            sum: self.sum + other.sum,
            variance: self.variance + other.variance,
        }
    }
}

impl Viewing<'_> {
    /// The photograph at a pixel, linear.
    pub fn background(&self, x: usize, y: usize) -> Vec3 {
        background(self.background, x, y)
    }

    /// The picture at a pixel, linear, where the layers have these values.
    fn laid_over(&self, (x, y): (usize, usize), object: Vec3, alpha: f32, shadow: Vec3) -> Vec3 {
        if self.adds {
            return self.background(x, y) + gloss::toned(self.tone.as_ref(), object);
        }
        let (object, shadow) = match &self.tone {
            // Most of the ground is in no shadow.
            Some(tone) if shadow == Vec3::ONE => (tone.object_pixel(object, alpha), shadow),
            Some(tone) => (tone.object_pixel(object, alpha), tone.shadow_pixel(shadow)),
            None => (object, shadow),
        };
        composite_pixel(self.background(x, y), object, alpha, shadow)
    }

    /// The picture at a pixel, as it is shown, where the layers have these values.
    pub(crate) fn shown(
        &self,
        pixel: (usize, usize),
        object: Vec3,
        alpha: f32,
        shadow: Vec3,
    ) -> Vec3 {
        self.encoded(self.laid_over(pixel, object, alpha, shadow))
    }

    fn encoded(&self, linear: Vec3) -> Vec3 {
        let encode = |v: f32| {
            self.transfer
                .encode_scalar((v * self.gain).max(0.0))
                .clamp(0.0, 1.0)
        };
        Vec3::from(linear.to_array().map(encode))
    }

    /// The composite's display-referred squared error that comes from the noise of `job`,
    /// to first order: the replicates' spread of the linear composite, behind the tone curve, times the
    /// squared slope of the transfer curve.
    pub fn squared_error(&self, film: &Film, job: &Job) -> SquaredError {
        self.squared_error_where(film, job, |_| true)
    }

    /// As [`squared_error`](Self::squared_error), of the pixels for which `holds` is true.
    pub(crate) fn squared_error_where(
        &self,
        film: &Film,
        job: &Job,
        holds: impl Fn((u32, u32)) -> bool,
    ) -> SquaredError {
        let mut total = SquaredError::default();
        if job.samples == 0 {
            return total;
        }
        let pixels = job.pixels.iter().enumerate();
        for (index, pixel) in pixels.filter(|(_, pixel)| holds(*pixel)) {
            let squared = match job.density {
                Some(_) => {
                    let variance = job.colour_variance(index);
                    variance * self.weight(film, job.layer, pixel, variance)
                }
                None => {
                    let (x, y) = (pixel.0 as usize, pixel.1 as usize);
                    let (object, alpha) = (*film.object.get(x, y), *film.alpha.get(x, y));
                    let composite = |(value, coverage)| match job.layer {
                        Layer::Object => {
                            self.laid_over((x, y), value, coverage, *film.shadow.get(x, y))
                        }
                        _ => self.laid_over((x, y), object, alpha, value),
                    };
                    let mean = composite(job.estimate(index, None));
                    let variance = job.spread(mean, |k| composite(job.estimate(index, Some(k))));
                    let step = step(variance);
                    let rise = self.encoded(mean + step) - self.encoded(mean - step);
                    let slope = rise / (2.0 * step);
                    variance * slope * slope
                }
            };
            let squared = f64::from(squared.element_sum()) / 3.0;
            if squared.is_finite() {
                total.sum += squared;
                // Each is sigma^2 chi^2_{K-1} / (K - 1), so E[v^2] 2 / (K + 1) is its variance. It counts
                // twice, because the true errors of single pixels spread as well.
                total.variance += squared * squared * 4.0 / (REPLICATES as f64 + 1.0);
            }
        }
        total
    }

    /// Squared display-referred error for a squared error of the shadow ratio, or of the object's radiance, of which
    /// `variance` is the size: the squared mean slope within one standard error. Clipped values cannot be wrong.
    pub(crate) fn weight(
        &self,
        film: &Film,
        layer: Layer,
        (x, y): (u32, u32),
        variance: Vec3,
    ) -> Vec3 {
        let (x, y) = (x as usize, y as usize);
        let (object, alpha) = (*film.object.get(x, y), *film.alpha.get(x, y));
        let shadow = *film.shadow.get(x, y);
        let step = step(variance);
        let shown = |step: Vec3| match layer {
            Layer::Object => self.shown((x, y), object + step, alpha, shadow),
            _ => self.shown((x, y), object, alpha, shadow + step),
        };
        let slope = (shown(step) - shown(-step)) / (2.0 * step);
        let weight = |slope: f32| match slope.is_finite() {
            true => slope * slope,
            false => 0.0,
        };
        Vec3::from(slope.to_array().map(weight))
    }

    /// Whether the layers change the photograph at this pixel by half an 8-bit step or more, and by more
    /// than noise would: counted as touched, unshadowed pixels would make the mean error look smaller
    /// than it is.
    pub fn is_touched(&self, film: &Film, x: usize, y: usize) -> bool {
        let object = *film.object.get(x, y);
        if self.adds {
            let change =
                self.shown((x, y), object, 0.0, Vec3::ONE) - self.encoded(self.background(x, y));
            return change.abs().max_element() > 0.5 / 255.0;
        }
        if *film.alpha.get(x, y) > 0.0 {
            return true;
        }
        let shadow = *film.shadow.get(x, y);
        if shadow == Vec3::ONE {
            return false;
        }
        let before = self.encoded(self.background(x, y));
        let seen = (self.shown((x, y), Vec3::ZERO, 0.0, shadow) - before).abs();
        // Of noise alone, one in twenty is beyond two standard errors.
        let sure = (shadow - Vec3::ONE).abs() - 2.0 * film.shadow_noise(x, y);
        (0..3).any(|c| seen[c] > 0.5 / 255.0 && sure[c] > 0.0)
    }
}

/// The photograph at a pixel, linear; mid-grey (0.18) if there is none.
pub(crate) fn background(photo: Option<&LinearImage>, x: usize, y: usize) -> Vec3 {
    photo.map_or(Vec3::splat(0.18), |image| *image.0.get(x, y))
}

/// Half of the step over which slopes are taken.
fn step(variance: Vec3) -> Vec3 {
    Vec3::from(variance.to_array().map(|v| v.sqrt().max(1e-4)))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::tone::ToneCurves;

    use super::*;

    #[test]
    fn errors_are_weighed_by_the_slope_of_curve_and_photograph() {
        let viewing = Viewing {
            background: None,
            tone: Some(ToneCurves::identity().mapper()),
            transfer: Transfer::Linear,
            gain: 1.0,
            adds: false,
            is_blurred: false,
        };
        let mut film = Film::new(1, 1);
        for (radiance, alpha) in [(0.1, 1.0), (1.5, 1.0), (0.4, 0.5), (2.0, 0.9)] {
            *film.object.get_mut(0, 0) = Vec3::splat(radiance);
            *film.alpha.get_mut(0, 0) = alpha;
            let weight = |layer| viewing.weight(&film, layer, (0, 0), Vec3::ZERO).x;
            // Reinhard's derivative at the covered part's radiance; the photograph's mid-grey where it is seen.
            let slopes = [
                (Layer::Object, (1.0 + radiance / alpha).powi(-2)),
                (Layer::PlaneShadow, 0.18 * (1.0 - alpha)),
            ];
            for (layer, slope) in slopes {
                // Two values of at most 1, each rounded to 2^-24 a few times, over a step of 2e-4.
                let off = (weight(layer).sqrt() - slope).abs();
                assert!(off < 8.0 * 2f32.powi(-24) / 2e-4, "{layer:?}: {off}");
            }
        }
    }

    #[test]
    fn noise_on_bright_ground_touches_nothing() {
        let viewing = Viewing {
            background: None,
            tone: None,
            transfer: Transfer::Srgb,
            gain: 1.0,
            adds: false,
            is_blurred: false,
        };
        let mut film = Film::new(4, 4);
        // Two 8-bit steps darker, once with less noise than that, once with more.
        *film.shadow.get_mut(1, 1) = Vec3::splat(0.95);
        let with_error = |film: &mut Film, error: f32| {
            let variance = Vec3::splat(error * error);
            let with_variance = |(i, &ratio)| ((i as u32 % 4, i as u32 / 4), (ratio, variance));
            let shadow = film.shadow.clone();
            let pixels = shadow.pixels().iter().enumerate().map(with_variance);
            film.replace(Layer::PlaneShadow, pixels);
        };
        with_error(&mut film, 0.01);
        assert!(viewing.is_touched(&film, 1, 1));
        with_error(&mut film, 0.04);
        assert!(!viewing.is_touched(&film, 1, 1));
        // Less than half a step is not seen, however sure it is.
        *film.shadow.get_mut(1, 1) = Vec3::splat(0.995);
        with_error(&mut film, 0.0);
        assert!(!viewing.is_touched(&film, 1, 1));
        // Where the object covers anything, it touches.
        *film.alpha.get_mut(2, 2) = 0.001;
        assert!(viewing.is_touched(&film, 2, 2));
    }
}
