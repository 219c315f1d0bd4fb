//! Which pixels can show the object.
use dipir_scene::bvh::{Bounds, Sphere};
use dipir_scene::camera::Camera;
use glam::{Vec2, Vec3};

use crate::optics::Optics;

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
/// Times of the way of a camera that moves, as [`Shutter::camera`](crate::shutter::Shutter::camera) has them.
const MOMENTS: [f32; 9] = [-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0];

impl Footprint {
    /// Of an object inside `bounds`, and inside the balls `parts`, blurred by `optics`.
    pub fn new(camera: &Camera, optics: Optics, bounds: Option<Bounds>, parts: &[Sphere]) -> Self {
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
            whole: Some(rectangle(camera, optics, &corners(bounds))),
            parts: parts
                .iter()
                .map(|ball| {
                    let r = Vec3::splat(ball.radius);
                    let around = Bounds {
                        min: (ball.center - r).max(bounds.min),
                        max: (ball.center + r).min(bounds.max),
                    };
                    rectangle(camera, optics, &corners(around))
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

/// The image of the convex hull of `corners`, blurred; everything if it reaches behind the camera.
fn rectangle(camera: &Camera, optics: Optics, corners: &[Vec3; 8]) -> Rectangle {
    let times: &[f32] = match optics.shutter {
        None => &[0.0],
        Some(_) => &MOMENTS,
    };
    let mut r = Rectangle {
        min: Vec2::INFINITY,
        max: Vec2::NEG_INFINITY,
    };
    let (mut most_blur, mut longest) = (Vec2::ZERO, 0f32);
    let mut before: Option<[Vec2; 8]> = None;
    for time in times {
        let camera = match optics.shutter {
            None => *camera,
            Some(shutter) => shutter.camera(camera, *time),
        };
        let Some((images, blur)) = images(&camera, optics, corners) else {
            return Rectangle {
                min: Vec2::NEG_INFINITY,
                max: Vec2::INFINITY,
            };
        };
        for (i, p) in images.into_iter().enumerate() {
            // A thousandth of a pixel covers the rounding of the projection.
            r.min = r.min.min(p - 1e-3 * (1.0 + p.abs()));
            r.max = r.max.max(p + 1e-3 * (1.0 + p.abs()));
            longest = before.map_or(longest, |b| longest.max(p.distance(b[i])));
        }
        before = Some(images);
        most_blur = most_blur.max(blur);
    }
    // The arc of a quarter of a circle leaves its chord by a fifth of that; no corner turns farther from one moment to the next.
    let around = most_blur * (1.0 + 1e-3) + 0.25 * longest;
    Rectangle {
        min: r.min - around,
        max: r.max + around,
    }
}

/// Where `corners` are seen, and how far what lies between them is blurred by the lens at most; `None` if they reach behind the
/// camera.
fn images(camera: &Camera, optics: Optics, corners: &[Vec3; 8]) -> Option<([Vec2; 8], Vec2)> {
    // Of all depths between those of the corners, one of these is blurred most.
    let mut most_blur = Vec2::ZERO;
    let mut images = [Vec2::ZERO; 8];
    let forward = -camera.rotation.z_axis;
    for (image, corner) in images.iter_mut().zip(corners) {
        let offset = *corner - camera.position;
        let depth = offset.dot(forward);
        let in_front = depth > NEAR * offset.length();
        *image = camera.project(*corner).filter(|_| in_front)?;
        let blur = optics.lens.map(|lens| lens.blur_px(camera, depth));
        most_blur = most_blur.max(blur.unwrap_or_default());
    }
    Some((images, most_blur))
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
        let f = Footprint::new(&camera(), Optics::default(), Some(bounds), &[]);
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
        let f = Footprint::new(&camera(), Optics::default(), Some(bounds), &[]);
        assert!(f.holds(0, 0) && f.holds(99, 50));
    }

    #[test]
    fn nothing_is_seen_nowhere() {
        assert!(!Footprint::new(&camera(), Optics::default(), None, &[]).holds(3, 3));
    }
}
