//! Random crops of a picture, resampled to a model's size.

use candle_core::{Device, Tensor};
use dipir_numerics::resample::{Filter, Taps};
use rayon::prelude::*;

use crate::error::{Result, argument};
use crate::noise::NoiseStream;

/// A square region of a picture, in pixels; may be fractional.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CropBox {
    /// Left edge.
    pub x: f64,
    /// Top edge.
    pub y: f64,
    /// Side.
    pub side: f64,
}

impl CropBox {
    /// A random square inside `width` x `height`, its side uniform between
    /// `min_share` and 1 of the shorter side.
    pub fn random(width: usize, height: usize, min_share: f64, stream: &mut NoiseStream) -> Self {
        let shorter = width.min(height) as f64;
        let share = min_share.clamp(0.0, 1.0);
        let side = (shorter * (share + (1.0 - share) * stream.uniform())).max(1.0);
        let x = (width as f64 - side).max(0.0) * stream.uniform();
        let y = (height as f64 - side).max(0.0) * stream.uniform();
        Self { x, y, side }
    }
}

/// Resamples a region of `image` [channels, height, width] to [1, channels,
/// size, size]: a tent filter as wide as the larger of the two pixels, so
/// that it interpolates when enlarging and averages when shrinking.
pub fn resample(image: &Tensor, region: CropBox, size: usize) -> Result<Tensor> {
    let (channels, height, width) = image.dims3()?;
    if size == 0 || region.side.is_nan() || region.side <= 0.0 || height == 0 || width == 0 {
        return argument(format!(
            "crop: cannot resample {region:?} of {width}x{height} to {size} pixels"
        ));
    }
    let values = image
        .to_device(&Device::Cpu)?
        .contiguous()?
        .flatten_all()?
        .to_vec1::<f32>()?;
    let (rows, columns) = (
        Taps::new(region.y, region.side, size, height, Filter::Tent),
        Taps::new(region.x, region.side, size, width, Filter::Tent),
    );
    let mut out = vec![0f32; channels * size * size];
    out.par_chunks_mut(size)
        .enumerate()
        .for_each(|(line, out)| {
            let plane = &values[line / size * height * width..][..height * width];
            for (x, out) in out.iter_mut().enumerate() {
                let mut sum = 0f64;
                for &(i, row_weight) in rows.of(line % size) {
                    let row = &plane[i * width..][..width];
                    let taps = columns.of(x).iter();
                    let line: f64 = taps.map(|&(j, w)| f64::from(row[j]) * w).sum();
                    sum += line * row_weight;
                }
                *out = sum as f32;
            }
        });
    Ok(Tensor::from_vec(
        out,
        (1, channels, size, size),
        image.device(),
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Tensor {
        let values: Vec<f32> = (0..height * width).map(|i| (i % width) as f32).collect();
        Tensor::from_vec(values, (1, height, width), &Device::Cpu).expect("tensor")
    }

    #[test]
    fn the_whole_picture_at_its_own_size_is_unchanged() {
        let image = ramp(6, 6);
        let same = resample(
            &image,
            CropBox {
                x: 0.0,
                y: 0.0,
                side: 6.0,
            },
            6,
        )
        .expect("resampled");
        let difference = (same.squeeze(0).expect("one") - image)
            .and_then(|d| d.abs()?.max_all()?.to_scalar::<f32>());
        assert!(difference.expect("difference") < 1e-6);
    }

    #[test]
    fn a_ramp_stays_a_ramp_when_shrunk_or_enlarged() {
        let image = ramp(40, 40);
        for size in [5, 100] {
            let region = CropBox {
                x: 10.0,
                y: 10.0,
                side: 20.0,
            };
            let found = resample(&image, region, size)
                .expect("resampled")
                .flatten_all()
                .expect("flat");
            let found = found.to_vec1::<f32>().expect("values");
            for (i, &v) in found.iter().take(size).enumerate() {
                let centre = 10.0 + (i as f64 + 0.5) * 20.0 / size as f64 - 0.5;
                assert!(
                    (v as f64 - centre).abs() < 1e-4,
                    "size {size}, pixel {i}: {v} instead of {centre}"
                );
            }
        }
    }

    #[test]
    fn random_boxes_lie_inside_and_use_the_whole_range() {
        let mut stream = NoiseStream::new(1, 1);
        let (mut smallest, mut largest) = (f64::INFINITY, 0f64);
        for _ in 0..1000 {
            let b = CropBox::random(30, 20, 0.5, &mut stream);
            assert!(
                b.x >= 0.0
                    && b.y >= 0.0
                    && b.x + b.side <= 30.0 + 1e-9
                    && b.y + b.side <= 20.0 + 1e-9
            );
            (smallest, largest) = (smallest.min(b.side), largest.max(b.side));
        }
        assert!(
            (10.0..10.2).contains(&smallest) && (19.8..=20.0).contains(&largest),
            "{smallest} {largest}"
        );
    }

    #[test]
    fn one_pixel_pictures_can_be_resampled() {
        let image = Tensor::full(0.5f32, (3, 1, 1), &Device::Cpu).expect("tensor");
        let y = resample(
            &image,
            CropBox {
                x: 0.0,
                y: 0.0,
                side: 1.0,
            },
            4,
        )
        .expect("resampled");
        assert!(
            y.flatten_all()
                .and_then(|y| y.to_vec1::<f32>())
                .expect("values")
                .iter()
                .all(|&v| v == 0.5)
        );
    }
}
