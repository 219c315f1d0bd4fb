//! Laying the rendered object and its shadow over the photograph.
use crate::{
    error::ImagingError,
    raster::{LinearImage, Raster},
};
use glam::Vec3;
use rayon::prelude::*;

/// `background * shadow * (1 - alpha) + object`, in linear light [DiPIR, eq. 6, with the object
/// premultiplied by its antialiased coverage].
///
/// `object` is premultiplied by `alpha` (in `[0, 1]`); `shadow` is the ratio of light with the
/// object to light without it, 1 where nothing changes. Errors if the sizes differ.
pub fn composite(
    background: &LinearImage,
    object: &LinearImage,
    alpha: &Raster<f32>,
    shadow: &LinearImage,
) -> Result<LinearImage, ImagingError> {
    let size = size_of(&background.0);
    same_size("the object layer", size, size_of(&object.0))?;
    same_size("the object's alpha", size, size_of(alpha))?;
    same_size("the shadow layer", size, size_of(&shadow.0))?;
    let pixels = background
        .0
        .pixels()
        .par_iter()
        .zip(object.0.pixels())
        .zip(alpha.pixels())
        .zip(shadow.0.pixels())
        .map(|(((&bg, &rgb), &a), &beta)| composite_pixel(bg, rgb, a, beta))
        .collect();
    Ok(LinearImage(Raster::from_pixels(size.0, size.1, pixels)))
}

/// One pixel of [`composite`].
#[inline]
pub fn composite_pixel(background: Vec3, object: Vec3, alpha: f32, shadow: Vec3) -> Vec3 {
    background * shadow * (1.0 - alpha) + object
}

/// Gradients of one pixel of [`composite`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CompositeGradient {
    /// With respect to the premultiplied object.
    pub object: Vec3,
    /// With respect to the coverage.
    pub alpha: f32,
    /// With respect to the shadow ratio.
    pub shadow: Vec3,
}

/// Adjoint of [`composite_pixel`]. The background is data and has no gradient.
#[inline]
pub fn composite_pixel_vjp(
    background: Vec3,
    alpha: f32,
    shadow: Vec3,
    gradient: Vec3,
) -> CompositeGradient {
    CompositeGradient {
        object: gradient,
        alpha: -(background * shadow).dot(gradient),
        shadow: background * (1.0 - alpha) * gradient,
    }
}

fn size_of<T>(raster: &Raster<T>) -> (usize, usize) {
    (raster.width(), raster.height())
}

fn same_size(
    what: &str,
    expected: (usize, usize),
    found: (usize, usize),
) -> Result<(), ImagingError> {
    if found == expected {
        return Ok(());
    }
    Err(ImagingError::SizeMismatch {
        what: what.to_string(),
        found,
        expected,
        reference: "the background",
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_numerics::gradcheck::{central_difference, relative_error};

    fn one(value: Vec3) -> LinearImage {
        LinearImage(Raster::filled(1, 1, value))
    }

    #[test]
    fn full_coverage_hides_the_background_and_none_shows_it_shadowed() {
        let (background, object) = (Vec3::new(0.2, 0.4, 0.6), Vec3::new(0.9, 0.5, 0.1));
        let shadow = Vec3::new(0.5, 0.25, 1.0);
        let of = |rgb, alpha| {
            let alpha = Raster::filled(1, 1, alpha);
            composite(&one(background), &one(rgb), &alpha, &one(shadow)).unwrap()
        };
        assert_eq!(of(object, 1.0).0.pixels()[0], object);
        assert_eq!(of(Vec3::ZERO, 0.0).0.pixels()[0], background * shadow);
        let half = of(object * 0.5, 0.5).0.pixels()[0];
        assert_eq!(half, background * shadow * 0.5 + object * 0.5);
    }

    #[test]
    fn layers_of_another_size_are_refused_by_name() {
        let alpha = Raster::filled(2, 1, 0.0);
        let error = composite(&one(Vec3::ONE), &one(Vec3::ONE), &alpha, &one(Vec3::ONE));
        assert_eq!(
            error.unwrap_err().to_string(),
            "the object's alpha is 2 x 1 pixels; expected 1 x 1, the size of the background"
        );
    }

    #[test]
    fn the_composite_gradient_follows_central_differences() {
        let (background, shadow) = (Vec3::new(0.2, 0.4, 0.6), Vec3::new(0.5, 0.25, 1.0));
        let (object, weight) = (Vec3::new(0.3, 0.2, 0.1), Vec3::new(1.0, -2.0, 0.5));
        let got = composite_pixel_vjp(background, 0.3, shadow, weight);
        // Bilinear in every input, so central differences have no truncation error; f32 has 1e-7.
        let check = |got: f32, f: &dyn Fn(f64) -> f64, at: f32| {
            let want = central_difference(f, f64::from(at), 1e-3);
            assert!(
                relative_error(f64::from(got), want, 1e-3) < 1e-6,
                "{got} {want}"
            );
        };
        let loss = |object: glam::DVec3, alpha: f64, shadow: glam::DVec3| {
            (background.as_dvec3() * shadow * (1.0 - alpha) + object).dot(weight.as_dvec3())
        };
        let (o, b, a) = (object.as_dvec3(), shadow.as_dvec3(), f64::from(0.3f32));
        check(got.alpha, &|v| loss(o, v, b), 0.3);
        for c in 0..3 {
            let with = |mut base: glam::DVec3, v: f64| {
                base[c] = v;
                base
            };
            check(got.object[c], &|v| loss(with(o, v), a, b), object[c]);
            check(got.shadow[c], &|v| loss(o, a, with(b, v)), shadow[c]);
        }
    }
}
