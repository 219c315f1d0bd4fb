//! Pictures as tensors and back.
//!
//! A picture is pixels row by row; a tensor is planes, channel by channel, [3, height, width].
//! Diffusion models take display values from [-1, 1] where pictures have [0, 1].
use candle_core::{DType, Device, Error, Result, Tensor};
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;

/// Red, green and blue planes of a picture, one after the other: its values as they are.
pub fn planes(picture: &Raster<Vec3>) -> Vec<f32> {
    let channel = |c: usize| picture.pixels().iter().map(move |p| p[c]);
    (0..3).flat_map(channel).collect()
}

/// The picture of planes of `width` x `height`, values as they are. Panics unless there are three.
pub fn from_planes(planes: &[f32], width: usize, height: usize) -> Raster<Vec3> {
    let n = width * height;
    assert_eq!(planes.len(), 3 * n, "planes of {width} x {height} pixels");
    let pixel = |i: usize| Vec3::new(planes[i], planes[n + i], planes[2 * n + i]);
    Raster::from_pixels(width, height, (0..n).map(pixel).collect())
}

/// A picture's values as they are, f32 [3, height, width] on the CPU.
pub fn tensor(picture: &Raster<Vec3>) -> Result<Tensor> {
    let shape = (3, picture.height(), picture.width());
    Tensor::from_vec(planes(picture), shape, &Device::Cpu)
}

/// The values of a tensor [3, height, width] or [1, 3, height, width] of any type on any device.
pub fn picture(tensor: &Tensor) -> Result<Raster<Vec3>> {
    let tensor = match tensor.rank() {
        4 => tensor.squeeze(0)?,
        _ => tensor.clone(),
    };
    let (channels, height, width) = tensor.dims3()?;
    if channels != 3 {
        let shape = tensor.shape();
        return Err(Error::Msg(format!("{shape:?} is no picture of 3 channels")));
    }
    let tensor = tensor.to_device(&Device::Cpu)?.to_dtype(DType::F32)?;
    let values = tensor.flatten_all()?.to_vec1::<f32>()?;
    Ok(from_planes(&values, width, height))
}

/// Display values as a diffusion model takes them: `2 v - 1`, [3, height, width].
pub fn model_input(picture: &DisplayImage) -> Result<Tensor> {
    tensor(&picture.0.map(|p| *p * 2.0 - 1.0))
}

/// The output of a diffusion model as display values: `(v + 1) / 2`, clamped to [0, 1].
pub fn model_output(tensor: &Tensor) -> Result<DisplayImage> {
    let shown = |p: &Vec3| (*p * 0.5 + 0.5).clamp(Vec3::ZERO, Vec3::ONE);
    Ok(DisplayImage(picture(tensor)?.map(shown)))
}

/// A mask as f32 [1, 1, height, width]: 1 where `raster` is above `threshold`, else 0.
pub fn mask(raster: &Raster<f32>, threshold: f32) -> Result<Tensor> {
    let above = |v: &f32| f32::from(*v > threshold);
    let values: Vec<f32> = raster.pixels().iter().map(above).collect();
    let shape = (1, 1, raster.height(), raster.width());
    Tensor::from_vec(values, shape, &Device::Cpu)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Raster<Vec3> {
        let value = |i: usize| Vec3::new(i as f32, i as f32 + 0.25, i as f32 + 0.5) / 8.0;
        Raster::from_pixels(3, 2, (0..6).map(value).collect())
    }

    #[test]
    fn a_picture_comes_back_as_it_was() {
        let tensor = tensor(&ramp()).unwrap();
        assert_eq!(tensor.dims(), [3, 2, 3]);
        assert_eq!(picture(&tensor).unwrap(), ramp());
        let batch = tensor.unsqueeze(0).unwrap();
        assert_eq!(picture(&batch).unwrap(), ramp());
        // Channel 1, row 1, column 2 is pixel 5.
        let values = tensor.to_vec3::<f32>().unwrap();
        assert_eq!(values[1][1][2], 5.25 / 8.0);
    }

    #[test]
    fn a_model_sees_minus_one_to_one_and_what_it_exceeds_is_clamped() {
        // Eighths, their doubles and their halves are exact.
        let shown = DisplayImage(ramp());
        let input = model_input(&shown).unwrap();
        assert_eq!(input.to_vec3::<f32>().unwrap()[0][0][0], -1.0);
        assert_eq!(model_output(&input).unwrap(), shown);
        let bright = model_output(&(input * 3.0).unwrap()).unwrap();
        let range = |p: &Vec3| p.min_element() >= 0.0 && p.max_element() <= 1.0;
        assert!(bright.0.pixels().iter().all(range));
    }

    #[test]
    fn masks_are_yes_or_no_above_their_threshold() {
        let raster = Raster::from_pixels(2, 1, vec![0.02, 0.03]);
        let mask = mask(&raster, 0.02).unwrap();
        assert_eq!(mask.dims(), [1, 1, 1, 2]);
        let values = mask.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values, [0.0, 1.0]);
    }

    #[test]
    fn a_tensor_of_other_channels_is_refused_by_its_shape() {
        let wrong = Tensor::zeros((4, 2, 2), DType::F32, &Device::Cpu).unwrap();
        assert!(
            picture(&wrong)
                .unwrap_err()
                .to_string()
                .contains("[4, 2, 2]")
        );
    }
}
