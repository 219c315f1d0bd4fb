//! The loss on the picture.
//!
//! A guidance gets the displayed composite, or a crop of it, and returns the gradient by which it
//! should change: of a loss where there is a reference picture, by itself where a diffusion model
//! guides.
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_numerics::sum::Neumaier;
use glam::Vec3;

use crate::crop::{CropView, Framing};
use crate::error::OptimizeError;
use crate::objective::Objective;
use crate::parameters::Parameters;

/// Where in the optimisation a gradient is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step {
    /// From 0.
    pub iteration: usize,
    /// Of this many.
    pub iterations: usize,
    /// Key of every random number.
    pub seed: u64,
}

/// Loss and gradient of a picture.
#[derive(Clone, Debug)]
pub struct Guided {
    /// The loss, or for a guidance that has only a gradient a number that measures its size.
    pub loss: f64,
    /// Derivative of the loss with respect to every display value that was shown.
    pub gradient: Raster<Vec3>,
    /// Timestep of the diffusion model, as a share of all; `None` where there is none.
    pub timestep: Option<f64>,
}

/// Gives loss and gradient of pictures. A function of its arguments alone, its random numbers keyed
/// by [`Step`], so that a resumed run gets the same gradients.
pub trait Guidance {
    /// Which part of the picture it needs.
    fn framing(&self) -> Framing;

    /// Loss and gradient of `picture`, the display values that `view` shows.
    fn gradient(
        &mut self,
        picture: &Raster<Vec3>,
        view: &CropView,
        step: Step,
    ) -> Result<Guided, OptimizeError>;
}

/// Display values within this of the reference count quadratically, beyond it linearly: the
/// difference that is asked for at the end, 2.5 steps of 8 bits.
pub const PHOTOMETRIC_SCALE: f64 = 0.01;

/// A reference picture that the composite should equal: the mean over the pixels that the object
/// or its shadow touches, and over channels, of Charbonnier's loss
/// `sqrt(1 + (d / scale)^2) - 1`, `d` being the difference in display values
/// [Charbonnier et al. 1994].
///
/// Near the reference it is half a squared error in units of [`PHOTOMETRIC_SCALE`], so that the
/// regularisers, which are of order 1, do not outweigh a difference that can be seen; far from
/// it a few wrong pixels do not outweigh all others.
#[derive(Clone, Debug)]
pub struct Reference {
    picture: DisplayImage,
    touched: Raster<Vec3>,
    framing: Framing,
}

/// A pixel counts as shadowed if the neutral light loses at least this share there.
const TOUCHED: f32 = 1e-3;

impl Reference {
    /// Compares with `picture`, display values of the size of the objective's background.
    pub fn new(
        picture: DisplayImage,
        objective: &Objective,
        framing: Framing,
    ) -> Result<Self, OptimizeError> {
        let found = (picture.0.width(), picture.0.height());
        let expected = objective.transport().size();
        if found != expected {
            return Err(OptimizeError::Size {
                what: "the reference",
                found,
                expected,
                reference: "the background",
            });
        }
        Ok(Self {
            picture,
            touched: touched(objective).map(|&t| Vec3::splat(t)),
            framing,
        })
    }
}

/// 1 where the object or its shadow under a neutral light changes the photograph, else 0.
pub fn touched(objective: &Objective) -> Raster<f32> {
    let neutral = objective.forward(&Parameters::neutral(1, 1.0), 0.0);
    let coverage = objective.transport().coverage();
    let pixels = coverage.pixels().iter().zip(neutral.ratio.0.pixels());
    let mask = pixels.map(|(&a, ratio)| {
        let changed = a > 0.0 || ratio.min_element() < 1.0 - TOUCHED;
        if changed { 1.0 } else { 0.0 }
    });
    Raster::from_pixels(coverage.width(), coverage.height(), mask.collect())
}

impl Guidance for Reference {
    fn framing(&self) -> Framing {
        self.framing
    }

    fn gradient(
        &mut self,
        picture: &Raster<Vec3>,
        view: &CropView,
        _: Step,
    ) -> Result<Guided, OptimizeError> {
        let reference = view.apply(&self.picture.0);
        let touched: Neumaier = match view.crop {
            Some(_) => view
                .apply(&self.touched)
                .pixels()
                .iter()
                .map(|t| f64::from(t.x))
                .collect(),
            None => self
                .touched
                .pixels()
                .iter()
                .map(|t| f64::from(t.x))
                .collect(),
        };
        let share = 1.0 / (3.0 * touched.total().max(1.0));
        let mut loss = Neumaier::default();
        let pixels = picture.pixels().iter().zip(reference.pixels());
        let gradient = pixels.map(|(a, b)| {
            let channel = |c: usize| {
                let d = f64::from(a[c]) - f64::from(b[c]);
                charbonnier(d, PHOTOMETRIC_SCALE)
            };
            let (x, y, z) = (channel(0), channel(1), channel(2));
            loss.add(share * (x.0 + y.0 + z.0));
            Vec3::new(
                (share * x.1) as f32,
                (share * y.1) as f32,
                (share * z.1) as f32,
            )
        });
        let gradient = Raster::from_pixels(picture.width(), picture.height(), gradient.collect());
        Ok(Guided {
            loss: loss.total(),
            gradient,
            timestep: None,
        })
    }
}

/// `sqrt(1 + (d / scale)^2) - 1` and its derivative with respect to `d`. The value is written as a
/// quotient, which keeps its digits where `d` is small.
pub fn charbonnier(d: f64, scale: f64) -> (f64, f64) {
    let q = d / scale;
    let root = (1.0 + q * q).sqrt();
    (q * q / (root + 1.0), q / (scale * root))
}

/// The root mean square difference of two pictures over the pixels where `touched` is positive; 0 if there are none.
pub fn rmse(a: &DisplayImage, b: &DisplayImage, touched: &Raster<f32>) -> f64 {
    let (mut squares, mut count) = (Neumaier::default(), 0usize);
    for y in 0..touched.height() {
        for x in 0..touched.width() {
            if *touched.get(x, y) > 0.0 {
                let d = (*a.0.get(x, y) - *b.0.get(x, y)).as_dvec3();
                squares.add(d.length_squared());
                count += 3;
            }
        }
    }
    (squares.total() / count.max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_numerics::gradcheck::{central_difference, relative_error};

    #[test]
    fn the_photometric_loss_is_quadratic_near_and_linear_far_with_the_matching_slope() {
        assert_eq!(charbonnier(0.0, 0.01), (0.0, 0.0));
        // Near: q^2 / 2 to q^4 / 8; far: q - 1 to 1 / (2 q).
        assert!(relative_error(charbonnier(1e-6, 0.01).0, 5e-9, 0.0) < 1e-8);
        assert!(relative_error(charbonnier(-100.0, 0.01).0, 1e4 - 1.0, 0.0) < 1e-8);
        for d in [-1.0, -0.01, 1e-5, 0.003, 0.4] {
            // Truncation h^2 / scale^2 / 6 and rounding eps / h, of slopes of 1 / scale.
            let numeric = central_difference(|d| charbonnier(d, 0.01).0, d, 1e-6);
            assert!(
                relative_error(charbonnier(d, 0.01).1, numeric, 1e-2) < 1e-7,
                "{d}"
            );
        }
    }
}
