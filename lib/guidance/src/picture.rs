//! Pictures as tensors and back.
use candle_core::{DType, Device, Tensor};
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;

use crate::error::Result;

/// Display values of an image tensor [1, 3, h, w] in [-1, 1].
pub fn to_display(image: &Tensor) -> Result<DisplayImage> {
    let (_, _, height, width) = image.dims4()?;
    let planes = image
        .to_device(&Device::Cpu)?
        .to_dtype(DType::F32)?
        .flatten_all()?
        .to_vec1::<f32>()?;
    let n = height * width;
    let at = |i: usize| (planes[i] * 0.5 + 0.5).clamp(0.0, 1.0);
    let pixels = (0..n)
        .map(|i| Vec3::new(at(i), at(n + i), at(2 * n + i)))
        .collect();
    Ok(DisplayImage(Raster::from_pixels(width, height, pixels)))
}

/// Display values as an image tensor [3, h, w] in [-1, 1].
pub fn from_display(image: &DisplayImage) -> Result<Tensor> {
    let raster = &image.0;
    let mut planes = Vec::with_capacity(3 * raster.pixels().len());
    for channel in 0..3 {
        planes.extend(raster.pixels().iter().map(|p| p[channel] * 2.0 - 1.0));
    }
    let shape = (3, raster.height(), raster.width());
    Ok(Tensor::from_vec(planes, shape, &Device::Cpu)?)
}
