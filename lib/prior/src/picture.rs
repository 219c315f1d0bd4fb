//! Pictures of the small model's size as planes of numbers, and their latents.

use candle_core::{Device, Tensor};
use dipir_diffusion::vae::pixel_unshuffle;

use crate::error::Result;

/// Pixels on a side of every picture that the model sees.
pub const SIZE: usize = 32;
/// Pixels of a picture.
pub const PIXELS: usize = SIZE * SIZE;
/// Pixels on a side of a latent pixel.
pub const LATENT_FACTOR: usize = 2;
/// Channels of the latents.
pub const LATENT_CHANNELS: usize = 3 * LATENT_FACTOR * LATENT_FACTOR;
/// Factor from pixels in [-1, 1] to latents of about unit variance.
pub const LATENT_SCALE: f64 = 2.0;

/// Planes [3, SIZE, SIZE] of red, green and blue, row by row.
pub type Picture = Vec<f32>;

/// Planes of rows of [`SIZE`] values with left and right swapped.
pub fn mirrored(planes: &[f32]) -> Vec<f32> {
    let rows = planes.chunks_exact(SIZE);
    rows.flat_map(|row| row.iter().rev().copied()).collect()
}

/// The largest value of a mask [SIZE, SIZE] in the square that reaches `radius` pixels from each pixel.
pub fn dilate(mask: &[f32], radius: usize) -> Vec<f32> {
    let pass = |input: &[f32], stride: usize, other: usize| -> Vec<f32> {
        let mut out = vec![0f32; PIXELS];
        for line in 0..SIZE {
            for i in 0..SIZE {
                let low = i.saturating_sub(radius);
                let high = (i + radius).min(SIZE - 1);
                out[line * other + i * stride] = (low..=high)
                    .map(|j| input[line * other + j * stride])
                    .fold(0.0, f32::max);
            }
        }
        out
    };
    pass(&pass(mask, 1, SIZE), SIZE, 1)
}

/// Scaled latents [pictures, LATENT_CHANNELS, h, w] of one or more pictures in [0, 1], one after the other.
pub fn latents_of(pictures: Vec<f32>) -> Result<Tensor> {
    let count = pictures.len() / (3 * PIXELS);
    let x = Tensor::from_vec(pictures, (count, 3, SIZE, SIZE), &Device::Cpu)?;
    let x = x.affine(2.0, -1.0)?;
    Ok((pixel_unshuffle(&x, LATENT_FACTOR)? * LATENT_SCALE)?)
}

/// Weights of pixels, [SIZE, SIZE] of one or more pictures, as weights of latent values.
pub fn latent_weights(weights: Vec<f32>) -> Result<Tensor> {
    let count = weights.len() / PIXELS;
    let weights = Tensor::from_vec(weights, (count, 1, SIZE, SIZE), &Device::Cpu)?;
    let weights = pixel_unshuffle(&weights, LATENT_FACTOR)?;
    Ok(Tensor::cat(&[&weights, &weights, &weights], 1)?)
}

/// The inpainting condition [pictures, 1 + LATENT_CHANNELS, h, w]: mask and latents of `pictures` in [0, 1], grey where
/// the mask, [SIZE, SIZE] for each picture, is at least 0.5.
pub fn inpainting_condition(pictures: Vec<f32>, masks: &[Vec<f32>]) -> Result<Tensor> {
    let mut visible = pictures;
    for (i, v) in visible.iter_mut().enumerate() {
        if masks[i / (3 * PIXELS)][i % PIXELS] >= 0.5 {
            *v = 0.5;
        }
    }
    let side = SIZE / LATENT_FACTOR;
    // A latent pixel has the mask of its top left pixel.
    let at = |mask: &Vec<f32>, i: usize| {
        let (x, y) = (i % side * LATENT_FACTOR, i / side * LATENT_FACTOR);
        f32::from(mask[y * SIZE + x] >= 0.5)
    };
    let small = masks
        .iter()
        .flat_map(|mask| (0..side * side).map(move |i| at(mask, i)));
    let small: Vec<f32> = small.collect();
    let mask = Tensor::from_vec(small, (masks.len(), 1, side, side), &Device::Cpu)?;
    Ok(Tensor::cat(&[&mask, &latents_of(visible)?], 1)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dilated_point_is_a_square_that_the_picture_cuts_off() {
        let mut mask = vec![0.0; PIXELS];
        mask[SIZE + 4] = 0.5;
        let grown = dilate(&mask, 2);
        // Rows 0 to 3 of rows -1 to 3, five columns.
        assert_eq!(grown.iter().filter(|v| **v == 0.5).count(), 4 * 5);
        assert_eq!(
            (grown[2], grown[3 * SIZE + 6], grown[4 * SIZE + 4]),
            (0.5, 0.5, 0.0)
        );
    }

    #[test]
    fn a_mirrored_row_is_read_from_its_end() {
        let planes: Vec<f32> = (0..3 * PIXELS).map(|i| i as f32).collect();
        let swapped = mirrored(&planes);
        assert_eq!((swapped[0], swapped[SIZE]), (31.0, 63.0));
        assert_eq!(mirrored(&swapped), planes);
    }

    #[test]
    fn the_inpainting_condition_is_the_mask_then_what_is_visible() {
        let mut mask = vec![0.0; PIXELS];
        mask[0] = 1.0;
        let condition = inpainting_condition(vec![1.0; 3 * PIXELS], &[mask]).unwrap();
        assert_eq!(condition.dims(), [1, 1 + LATENT_CHANNELS, 16, 16]);
        let values = condition.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        // The masked pixel is grey, 0 in [-1, 1]; white is 1, times the scale.
        assert_eq!((values[0], values[1]), (1.0, 0.0));
        assert_eq!((values[256], values[257]), (0.0, 2.0));
    }
}
