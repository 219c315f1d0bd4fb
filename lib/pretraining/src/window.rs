//! Windows on recorded scenes, and what they show under any light.

use dipir_diffusion::noise::NoiseStream;
use dipir_prior::caption::{LightDescription, ViewDirection};
use dipir_prior::picture::{PIXELS, Picture, SIZE};
use glam::Vec3;
use half::f16;

use crate::dataset::{RECORD_SIZE, RecordedScene};
use crate::direct_light::{
    BASIS, FIRST_SHADOW_PLANE, Layer, PLANES, SHADOW_PLANES, first_plane, shadow_weights, weights,
};
use crate::lighting::{Sun, SunSkyLight};

/// Which part of a recorded scene is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column of the recorded pictures.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Whether left and right are swapped.
    pub mirrored: bool,
}

impl Window {
    /// The middle of the recorded pictures.
    pub const MIDDLE: Self = Self {
        x: (RECORD_SIZE - SIZE) / 2,
        y: (RECORD_SIZE - SIZE) / 2,
        mirrored: false,
    };

    /// The middle for even draws of noise and its mirror image for odd ones: the model's errors on the two differ in part
    /// (docs/prior.md).
    pub fn of_draw(draw: usize) -> Self {
        Self {
            mirrored: draw % 2 == 1,
            ..Self::MIDDLE
        }
    }

    /// A window anywhere.
    pub fn draw(stream: &mut NoiseStream) -> Self {
        Self {
            x: stream.below(RECORD_SIZE - SIZE + 1),
            y: stream.below(RECORD_SIZE - SIZE + 1),
            mirrored: stream.below(2) == 1,
        }
    }
}

/// A recorded scene through a window; it can be lit by any light.
#[derive(Debug, Clone)]
pub struct CroppedScene<'a> {
    scene: RecordedScene<'a>,
    window: Window,
}

impl<'a> CroppedScene<'a> {
    /// `scene` through `window`.
    pub fn new(scene: RecordedScene<'a>, window: Window) -> Self {
        Self { scene, window }
    }

    /// Direction of the middle of the window.
    pub fn view_direction(&self) -> ViewDirection {
        let middle = |start: usize| {
            let half = 0.5 * RECORD_SIZE as f32;
            (start as f32 + 0.5 * SIZE as f32) / half - 1.0
        };
        let camera = self.scene.camera;
        camera.direction(middle(self.window.x), middle(self.window.y))
    }

    /// The description, relative to the window's middle and mirrored as the window, of one relative to the camera.
    pub fn seen_through_window(&self, description: LightDescription) -> LightDescription {
        let seen = description.seen_from(self.view_direction().heading);
        match self.window.mirrored {
            true => seen.mirrored(),
            false => seen,
        }
    }

    /// The scene's suns.
    pub fn suns(&self) -> &[Sun] {
        &self.scene.suns
    }

    fn row(&self, plane: usize, row: usize) -> &[f16] {
        let start = (plane * RECORD_SIZE + self.window.y + row) * RECORD_SIZE + self.window.x;
        &self.scene.planes[start..start + SIZE]
    }

    /// Adds `weight` times a plane to `out`.
    pub(crate) fn add(&self, plane: usize, weight: f32, out: &mut [f32]) {
        if weight == 0.0 {
            return;
        }
        for (row, out) in out.chunks_exact_mut(SIZE).enumerate() {
            let values = self.row(plane, row);
            for (i, out) in out.iter_mut().enumerate() {
                let column = if self.window.mirrored {
                    SIZE - 1 - i
                } else {
                    i
                };
                *out += weight * values[column].to_f32();
            }
        }
    }

    /// A layer under `light`, linear.
    pub fn layer(&self, layer: Layer, light: &SunSkyLight) -> Picture {
        let mut out = vec![0.0; 3 * PIXELS];
        for (b, weight) in weights(light).iter().enumerate().take(BASIS) {
            for c in 0..3 {
                let plane = first_plane(layer) + b * 3 + c;
                self.add(plane, weight[c], &mut out[c * PIXELS..][..PIXELS]);
            }
        }
        out
    }

    /// Share of the ground's light that the main object lets through, [3, SIZE, SIZE].
    pub fn shadow(&self, light: &SunSkyLight) -> Picture {
        let mut out = vec![0.0; 3 * PIXELS];
        let weights: [Vec3; SHADOW_PLANES] = shadow_weights(light, &self.scene.suns);
        for (b, weight) in weights.iter().enumerate() {
            for c in 0..3 {
                self.add(
                    FIRST_SHADOW_PLANE + b,
                    weight[c],
                    &mut out[c * PIXELS..][..PIXELS],
                );
            }
        }
        out
    }

    /// Coverage of the main object, [SIZE, SIZE].
    pub fn coverage(&self) -> Vec<f32> {
        let mut out = vec![0.0; PIXELS];
        self.add(PLANES - 1, 1.0, &mut out);
        out
    }

    /// The main object under `light`, composited into its surroundings under `around`, linear.
    pub fn composite(&self, around: &SunSkyLight, light: &SunSkyLight) -> Picture {
        let mut out = self.layer(Layer::Background, around);
        let object = self.layer(Layer::Object, light);
        let (shadow, coverage) = (self.shadow(light), self.coverage());
        for (i, value) in out.iter_mut().enumerate() {
            *value = *value * shadow[i] * (1.0 - coverage[i % PIXELS]) + object[i];
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::square_camera::SquareCamera;

    #[test]
    fn a_description_is_relative_to_the_windows_middle_and_then_mirrored() {
        let cropped = |x: usize, mirrored: bool| {
            let scene = RecordedScene {
                planes: &[],
                class: "box",
                color: "white",
                camera: SquareCamera {
                    pitch: 0.0,
                    tan_half_fov: 0.5,
                },
                suns: vec![],
            };
            let window = Window {
                x,
                mirrored,
                ..Window::MIDDLE
            };
            CroppedScene::new(scene, window)
        };
        let light = LightDescription {
            azimuth: 0.7,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let azimuth =
            |x: usize, mirrored: bool| cropped(x, mirrored).seen_through_window(light).azimuth;
        // The last window's middle is 4 pixels to the right of 20, and the tangent at 20 pixels is .5.
        let heading = (0.5f32 * 4.0 / 20.0).atan();
        let last = RECORD_SIZE - SIZE;
        for (found, wanted) in [
            (azimuth(Window::MIDDLE.x, false), 0.7),
            (azimuth(last, false), 0.7 - heading),
            (azimuth(last, true), heading - 0.7),
            (azimuth(0, false), 0.7 + heading),
        ] {
            assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
        }
        let lower = Window {
            y: last,
            ..Window::MIDDLE
        };
        let scene = cropped(0, false).scene;
        assert!((CroppedScene::new(scene, lower).view_direction().pitch - heading).abs() < 1e-6);
    }
}
