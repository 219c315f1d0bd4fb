//! What a camera and a file do to a picture beside exposing it.
use dipir_diffusion::noise::NoiseStream;

use crate::examples::{SIZE, Tone};

/// How linear light becomes the pixels of a photograph's crop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Look {
    /// Factor on linear light.
    pub exposure: f32,
    tone: Curve,
    /// Exponent on display values.
    gamma: f32,
    /// Share of each neighbour's value that runs into a pixel's, along rows and along columns.
    blur: f32,
    /// Standard deviation of what is added to display values.
    noise: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Curve {
    /// As in the small model's other training.
    Shoulder(Tone),
    /// x / (1 + x).
    Reinhard,
}

impl Look {
    /// Of any camera.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        let tone = Tone::draw(stream);
        let mut range = |low: f64, high: f64| (low + (high - low) * stream.uniform()) as f32;
        let kind = range(0.0, 1.0);
        let gamma = range(-0.15, 0.15).exp();
        let (wide, blur, noise) = (range(-0.5, 0.5), range(-0.2, 0.2), range(-0.02, 0.02));
        let exposure = tone.exposure * wide.exp();
        Self {
            exposure,
            tone: match kind < 0.25 {
                true => Curve::Reinhard,
                false => Curve::Shoulder(Tone { exposure, ..tone }),
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
                let plain = Tone {
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
                // Three uniform numbers are near enough to a normal one of variance 1/4.
                let sum: f64 = (0..3).map(|_| stream.uniform()).sum();
                *v = (*v + 2.0 * self.noise * (sum as f32 - 1.5)).clamp(0.0, 1.0);
            }
        }
    }
}

/// Gives each pixel of [SIZE, SIZE] this share of each neighbour, edges repeated.
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
        // At the edge what would run out stays in.
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
            let look = Look::draw(&mut stream);
            let apply = |value: f32, stream: &mut NoiseStream| {
                let mut picture = vec![value; 3 * SIZE * SIZE];
                look.apply(&mut picture, stream);
                assert!(picture.iter().all(|v| (0.0..=1.0).contains(v)), "{look:?}");
                picture.iter().sum::<f32>() / picture.len() as f32
            };
            let values = [0.02, 0.2, 0.6].map(|v| apply(v, &mut stream));
            assert!(values.is_sorted_by(|a, b| a < b), "{values:?} {look:?}");
        }
    }
}
