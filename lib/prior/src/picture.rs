//! Pictures of the small model's size as planes of numbers, and their latents.

use candle_core::{Device, Tensor};
use dipir_diffusion::distillation::InpaintCondition;
use dipir_diffusion::vae::{Vae, pixel_unshuffle};

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

/// The step between pictures and latents, as model folders have it in `vae/`.
const VAE: Vae = Vae::PixelUnshuffle {
    factor: LATENT_FACTOR,
    in_channels: 3,
    scaling_factor: LATENT_SCALE,
};

/// Pictures in [0, 1], one after the other, as [pictures, 3, SIZE, SIZE] in [-1, 1].
fn images(pictures: Vec<f32>) -> Result<Tensor> {
    let count = pictures.len() / (3 * PIXELS);
    let x = Tensor::from_vec(pictures, (count, 3, SIZE, SIZE), &Device::Cpu)?;
    Ok(x.affine(2.0, -1.0)?)
}

/// Scaled latents [pictures, LATENT_CHANNELS, h, w] of one or more pictures in [0, 1], one after the other.
pub fn latents_of(pictures: Vec<f32>) -> Result<Tensor> {
    Ok(VAE.encode(&images(pictures)?)?)
}

/// Weights of pixels, [SIZE, SIZE] of one or more pictures, as weights of latent values.
pub fn latent_weights(weights: Vec<f32>) -> Result<Tensor> {
    let count = weights.len() / PIXELS;
    let weights = Tensor::from_vec(weights, (count, 1, SIZE, SIZE), &Device::Cpu)?;
    let weights = pixel_unshuffle(&weights, LATENT_FACTOR)?;
    Ok(Tensor::cat(&[&weights, &weights, &weights], 1)?)
}

/// The inpainting condition of `pictures` in [0, 1], one after the other, and of `masks`, [SIZE, SIZE] for each picture.
pub fn inpainting_condition(pictures: Vec<f32>, masks: &[Vec<f32>]) -> Result<InpaintCondition> {
    let shape = (masks.len(), 1, SIZE, SIZE);
    let masks = Tensor::from_vec(masks.concat(), shape, &Device::Cpu)?;
    Ok(InpaintCondition::new(&VAE, &images(pictures)?, &masks)?)
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
    fn the_inpainting_condition_is_the_mask_and_what_is_visible() {
        let mut mask = vec![0.0; PIXELS];
        mask[0] = 1.0;
        let masks = [vec![0.0; PIXELS], mask];
        let condition = inpainting_condition(vec![1.0; 6 * PIXELS], &masks).unwrap();
        assert_eq!(condition.mask.dims(), [2, 1, 16, 16]);
        assert_eq!(
            condition.masked_latents.dims(),
            [2, LATENT_CHANNELS, 16, 16]
        );
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (mask, latents) = (flat(&condition.mask), flat(&condition.masked_latents));
        // The masked pixel of the second picture is grey, 0 in [-1, 1]; white is 1, times the scale.
        assert_eq!((mask[0], mask[256], mask[257]), (0.0, 1.0, 0.0));
        let second = LATENT_CHANNELS * 256;
        assert_eq!(
            (latents[0], latents[second], latents[second + 1]),
            (2.0, 0.0, 2.0)
        );
    }
}
