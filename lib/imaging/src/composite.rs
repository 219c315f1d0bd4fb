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
