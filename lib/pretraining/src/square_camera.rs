//! The camera of generated scenes, in two numbers.

use dipir_prior::caption::ViewDirection;
use glam::Vec3;

use crate::scene::GeneratedScene;

/// An upright camera that looks straight at the middle of its square picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SquareCamera {
    /// Angle below the horizon, radians.
    pub pitch: f32,
    /// Tangent of half the field of view.
    pub tan_half_fov: f32,
}

impl SquareCamera {
    /// Direction of a point of the picture; coordinates run from -1 to 1, to the right and down.
    pub fn direction(&self, x: f32, y: f32) -> ViewDirection {
        let (s, c) = self.pitch.sin_cos();
        let (x, y) = (x * self.tan_half_fov, y * self.tan_half_fov);
        ViewDirection::along(Vec3::new(x, -s - y * c, -c + y * s), Vec3::NEG_Z, Vec3::X)
    }
}

impl GeneratedScene {
    /// Its camera.
    pub fn square_camera(&self) -> SquareCamera {
        SquareCamera {
            pitch: self.camera.rotation.z_axis.y.asin(),
            tan_half_fov: 0.5 * self.camera.resolution[1] as f32 / self.camera.focal_px.y,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Framing, ObjectSet, SceneKind, Setting};
    use glam::Vec2;

    #[test]
    fn directions_of_pixels_are_those_of_the_cameras_rays() {
        for (index, setting) in [(0, Setting::Open), (1, Setting::Street)] {
            let kind = SceneKind {
                objects: ObjectSet::HeldOut,
                setting,
                framing: Framing::Wide,
            };
            let scene = GeneratedScene::draw(7, index, 40, kind);
            for (x, y) in [(0.0, 0.0), (-1.0, 0.5), (0.7, -1.0), (1.0, 1.0)] {
                let ray = scene
                    .camera
                    .ray(Vec2::new(20.0 + 20.0 * x, 20.0 + 20.0 * y));
                let wanted = ViewDirection::along(ray.direction, Vec3::NEG_Z, Vec3::X);
                let found = scene.square_camera().direction(x, y);
                let off = (found.heading - wanted.heading).hypot(found.pitch - wanted.pitch);
                assert!(off < 1e-5, "{found:?} {wanted:?}");
            }
        }
    }

    #[test]
    fn points_to_the_right_have_a_heading_and_low_points_more_pitch() {
        let camera = SquareCamera {
            pitch: 0.3,
            tan_half_fov: 0.5,
        };
        assert!((camera.direction(0.0, 0.0).pitch - 0.3).abs() < 1e-6);
        // The lower edge is half the field of view below the middle.
        assert!((camera.direction(0.0, 1.0).pitch - 0.3 - 0.5f32.atan()).abs() < 1e-6);
        assert_eq!(camera.direction(0.0, -1.0).heading, 0.0);
        // Level with the camera's right, half as far as what lies ahead.
        let level = SquareCamera {
            pitch: 0.0,
            ..camera
        };
        assert!((level.direction(1.0, 0.0).heading - 0.5f32.atan()).abs() < 1e-6);
    }
}
