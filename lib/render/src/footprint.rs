//! Which pixels can show the object.
use dipir_scene::bvh::{Bounds, Sphere};
use dipir_scene::camera::Camera;
use glam::{Vec2, Vec3};

use crate::lens::ThinLens;

/// Rectangles of pixels that together hold the object's image.
#[derive(Clone, Debug, Default)]
pub struct Footprint {
    whole: Option<Rectangle>,
    parts: Vec<Rectangle>,
}

/// A closed rectangle of the image plane, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rectangle {
    min: Vec2,
    max: Vec2,
}

/// Points nearer to the camera's plane than this share of their distance count as behind it.
const NEAR: f32 = 1e-3;

impl Footprint {
    /// Of an object inside `bounds`, and inside the balls `parts`, seen through `lens` if there is one.
    pub fn new(
        camera: &Camera,
        lens: Option<ThinLens>,
        bounds: Option<Bounds>,
        parts: &[Sphere],
    ) -> Self {
        let Some(bounds) = bounds else {
            return Self::default();
        };
        let corners = |b: Bounds| {
            [0, 1, 2, 3, 4, 5, 6, 7].map(|i| {
                Vec3::new(
                    if i & 1 == 0 { b.min.x } else { b.max.x },
                    if i & 2 == 0 { b.min.y } else { b.max.y },
                    if i & 4 == 0 { b.min.z } else { b.max.z },
                )
            })
        };
        Self {
            whole: Some(rectangle(camera, lens, &corners(bounds))),
            parts: parts
                .iter()
                .map(|ball| {
                    let r = Vec3::splat(ball.radius);
                    let around = Bounds {
                        min: (ball.center - r).max(bounds.min),
                        max: (ball.center + r).min(bounds.max),
                    };
                    rectangle(camera, lens, &corners(around))
                })
                .collect(),
        }
    }

    /// Whether the pixel in column `x` of row `y` can show the object.
    pub fn holds(&self, x: u32, y: u32) -> bool {
        self.overlaps(x, y, 1, 1)
    }

    /// Whether any pixel of a rectangle can show the object.
    pub fn overlaps(&self, x: u32, y: u32, width: u32, height: u32) -> bool {
        let min = Vec2::new(x as f32, y as f32);
        let max = min + Vec2::new(width as f32, height as f32);
        let meets = |r: &Rectangle| r.min.cmple(max).all() && r.max.cmpge(min).all();
        self.whole.as_ref().is_some_and(meets)
            && (self.parts.is_empty() || self.parts.iter().any(meets))
    }
}

/// The image of the convex hull of `corners`; everything if it reaches behind the camera.
fn rectangle(camera: &Camera, lens: Option<ThinLens>, corners: &[Vec3; 8]) -> Rectangle {
    let mut r = Rectangle {
        min: Vec2::INFINITY,
        max: Vec2::NEG_INFINITY,
    };
    // Of all depths between those of the corners, one of these is blurred most.
    let mut most_blur = Vec2::ZERO;
    let forward = -camera.rotation.z_axis;
    for corner in corners {
        let offset = *corner - camera.position;
        let in_front = offset.dot(forward) > NEAR * offset.length();
        match camera.project(*corner).filter(|_| in_front) {
            // A thousandth of a pixel covers the rounding of the projection.
            Some(p) => {
                let blur = lens.map_or(Vec2::ZERO, |l| l.blur_px(camera, offset.dot(forward)));
                most_blur = most_blur.max(blur);
                r.min = r.min.min(p - 1e-3 * (1.0 + p.abs()));
                r.max = r.max.max(p + 1e-3 * (1.0 + p.abs()));
            }
            None => {
                return Rectangle {
                    min: Vec2::NEG_INFINITY,
                    max: Vec2::INFINITY,
                };
            }
        }
    }
    r.min -= most_blur * (1.0 + 1e-3);
    r.max += most_blur * (1.0 + 1e-3);
    r
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat3;

    fn camera() -> Camera {
        Camera {
            position: Vec3::new(0.0, 0.0, 5.0),
            rotation: Mat3::IDENTITY,
            focal_px: Vec2::splat(100.0),
            principal_px: Vec2::splat(50.0),
            resolution: [100, 100],
        }
    }

    #[test]
    fn every_pixel_that_sees_a_point_of_the_object_is_held() {
        let bounds = Bounds {
            min: Vec3::new(-1.0, -0.5, -1.0),
            max: Vec3::new(0.5, 1.0, 1.0),
        };
        let f = Footprint::new(&camera(), None, Some(bounds), &[]);
        for i in 0..1000 {
            let h = |k: u64| dipir_numerics::hashing::hash_u64s(&[i, k]) as f32 / u64::MAX as f32;
            let p = bounds.min + (bounds.max - bounds.min) * Vec3::new(h(0), h(1), h(2));
            let px = camera().project(p).expect("in front");
            assert!(f.holds(px.x as u32, px.y as u32), "{p}");
        }
        assert!(!f.holds(99, 99));
        assert!(!f.holds(0, 0));
    }

    #[test]
    fn a_camera_inside_the_object_sees_it_everywhere() {
        let bounds = Bounds {
            min: Vec3::splat(-9.0),
            max: Vec3::splat(9.0),
        };
        let f = Footprint::new(&camera(), None, Some(bounds), &[]);
        assert!(f.holds(0, 0) && f.holds(99, 50));
    }

    #[test]
    fn nothing_is_seen_nowhere() {
        assert!(!Footprint::new(&camera(), None, None, &[]).holds(3, 3));
    }
}
