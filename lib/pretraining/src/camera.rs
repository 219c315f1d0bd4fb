//! From linear light to the display values of a photograph.

use dipir_diffusion::noise::NoiseStream;
use dipir_prior::picture::SIZE;

use crate::random::between;

/// Exposure and tone curve of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraResponse {
    /// Factor on linear light.
    pub exposure: f32,
    /// Blend of two curves: 0 clips at white, 1 is 1 - exp(-x).
    pub shoulder: f32,
}

impl CameraResponse {
    /// That of a random camera.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        Self {
            exposure: (0.35 * (2.0 * stream.uniform() - 1.0)).exp() as f32,
            shoulder: stream.uniform() as f32,
        }
    }

    /// Turns a linear picture into display values in [0, 1] (sRGB).
    pub fn apply(&self, linear: &mut [f32]) {
        for v in linear {
            let x = (*v * self.exposure).max(0.0);
            let soft = 1.0 - (-x).exp();
            let x = x.min(1.0) + (soft - x.min(1.0)) * self.shoulder;
            *v = if x <= 0.003_130_8 {
                12.92 * x
            } else {
                1.055 * x.powf(1.0 / 2.4) - 0.055
            };
        }
    }
}

/// All that happens between linear light and the pixels of a photograph's crop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CameraEffects {
    /// Factor on linear light.
    pub exposure: f32,
    tone: Curve,
    /// Exponent on display values.
    gamma: f32,
    /// Weight of each neighbour in the blur, along rows and along columns.
    blur: f32,
    /// Standard deviation of noise on display values.
    noise: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Curve {
    /// As the diffusion model is trained.
    Shoulder(CameraResponse),
    /// x / (1 + x).
    Reinhard,
}

impl CameraEffects {
    /// Those of a random camera.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        let tone = CameraResponse::draw(stream);
        let mut range = |low, high| between(stream, low, high);
        let kind = range(0.0, 1.0);
        let gamma = range(-0.15, 0.15).exp();
        let (wide, blur, noise) = (range(-0.5, 0.5), range(-0.2, 0.2), range(-0.02, 0.02));
        let exposure = tone.exposure * wide.exp();
        Self {
            exposure,
            tone: match kind < 0.25 {
                true => Curve::Reinhard,
                false => Curve::Shoulder(CameraResponse { exposure, ..tone }),
            },
            gamma,
            blur: blur.max(0.0),
            noise: noise.max(0.0),
        }
    }

    /// From a linear picture [3, SIZE, SIZE] to display values in [0, 1].
    pub fn apply(&self, picture: &mut [f32], stream: &mut NoiseStream) {
        match self.tone {
            Curve::Shoulder(tone) => tone.apply(picture),
            Curve::Reinhard => {
                for v in picture.iter_mut() {
                    let x = (*v * self.exposure).max(0.0);
                    *v = x / (1.0 + x);
                }
                let plain = CameraResponse {
                    exposure: 1.0,
                    shoulder: 0.0,
                };
                plain.apply(picture);
            }
        }
        for v in picture.iter_mut() {
            *v = v.powf(self.gamma);
        }
        if self.blur > 0.0 {
            for plane in picture.chunks_exact_mut(SIZE * SIZE) {
                blur(plane, self.blur);
            }
        }
        if self.noise > 0.0 {
            for v in picture.iter_mut() {
                // The sum of three uniform numbers has the variance 1/4 and is close to normal.
                let sum: f64 = (0..3).map(|_| stream.uniform()).sum();
                *v = (*v + 2.0 * self.noise * (sum as f32 - 1.5)).clamp(0.0, 1.0);
            }
        }
    }
}

/// Gives each neighbour the weight `share` in every pixel of [SIZE, SIZE]; edges are repeated.
fn blur(plane: &mut [f32], share: f32) {
    let mut line = [0f32; SIZE];
    for (step, other) in [(1, SIZE), (SIZE, 1)] {
        for start in (0..SIZE).map(|k| k * other) {
            for (i, v) in line.iter_mut().enumerate() {
                *v = plane[start + i * step];
            }
            for i in 0..SIZE {
                let around = line[i.saturating_sub(1)] + line[(i + 1).min(SIZE - 1)];
                plane[start + i * step] = (1.0 - 2.0 * share) * line[i] + share * around;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blur_spreads_a_point_and_loses_nothing() {
        let mut plane = vec![0.0; SIZE * SIZE];
        plane[5 * SIZE + 7] = 1.0;
        // Edges lose nothing.
        plane[0] = 1.0;
        blur(&mut plane, 0.2);
        assert!((plane.iter().sum::<f32>() - 2.0).abs() < 1e-5);
        for (at, wanted) in [
            (5 * SIZE + 7, 0.36),
            (5 * SIZE + 8, 0.12),
            (4 * SIZE + 6, 0.04),
            (0, 0.64),
        ] {
            assert!((plane[at] - wanted).abs() < 1e-6, "{at}: {}", plane[at]);
        }
    }

    #[test]
    fn pictures_stay_in_range_and_brighter_light_stays_brighter() {
        for index in 0..100 {
            let mut stream = NoiseStream::new(4, index);
            let effects = CameraEffects::draw(&mut stream);
            let apply = |value: f32, stream: &mut NoiseStream| {
                let mut picture = vec![value; 3 * SIZE * SIZE];
                effects.apply(&mut picture, stream);
                assert!(
                    picture.iter().all(|v| (0.0..=1.0).contains(v)),
                    "{effects:?}"
                );
                picture.iter().sum::<f32>() / picture.len() as f32
            };
            let values = [0.02, 0.2, 0.6].map(|v| apply(v, &mut stream));
            assert!(values.is_sorted_by(|a, b| a < b), "{values:?} {effects:?}");
        }
    }
}
