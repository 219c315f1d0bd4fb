//! Motion blur: a camera that moves while its shutter is open.
//!
//! Objects and ground stand still, so each of their points is seen along a line. The object is seen by rays of cameras along
//! the way, so what it hides of itself and of the photograph behind it blurs as it does in a camera. The photograph was blurred
//! when it was taken; only the shadow on it is new. Its ratio is averaged along the line that the pixel has seen.
use dipir_imaging::raster::Raster;
use dipir_scene::camera::Camera;
use glam::{Mat3, Quat, Vec2, Vec3, Vec4};
use rayon::prelude::*;

/// Where a camera stands, and how it is turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraPose {
    /// Centre of projection, metres.
    pub position: Vec3,
    /// Turns the camera's right, up and backward axes into the world.
    pub rotation: Quat,
}

/// The way of a camera while its shutter is open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shutter {
    /// Where it opens.
    pub opens: CameraPose,
    /// In the middle of that time: where the camera of the picture stands.
    pub middle: CameraPose,
    /// Where it closes.
    pub closes: CameraPose,
}

/// Least reach of a line that changes a shadow, pixels.
const LEAST_PX: f32 = 0.25;
/// Least share of a line that has to be seen beside the objects for its ratios to be averaged.
const LEAST_SEEN: f32 = 1e-3;

impl CameraPose {
    /// Of this camera.
    pub fn of(camera: &Camera) -> Self {
        Self {
            position: camera.position,
            rotation: Quat::from_mat3(&camera.rotation).normalize(),
        }
    }

    /// The pose at this share of the way to `end`: a straight line, and the shortest turn.
    pub fn towards(&self, end: &Self, share: f32) -> Self {
        Self {
            position: self.position.lerp(end.position, share),
            rotation: self.rotation.slerp(end.rotation, share),
        }
    }
}

impl Shutter {
    /// `camera`, that of the picture, at a `time` from -1, where the shutter opens, to 1, where it closes.
    pub fn camera(&self, camera: &Camera, time: f32) -> Camera {
        let end = if time < 0.0 {
            &self.opens
        } else {
            &self.closes
        };
        let pose = self.middle.towards(end, time.abs());
        Camera {
            position: pose.position,
            rotation: Mat3::from_quat(pose.rotation),
            ..*camera
        }
    }

    /// Offsets from `pixel`, in pixels, of the point that it shows, when the shutter opens and when it closes. `depth` is the
    /// point's distance along the optical axis, metres; it may be infinite. `None` where the point is then behind the camera.
    pub fn ends_px(&self, camera: &Camera, pixel: Vec2, depth: f32) -> [Option<Vec2>; 2] {
        let d = (pixel - camera.principal_px) / camera.focal_px;
        let ray = camera.rotation * Vec3::new(d.x, -d.y, -1.0);
        [&self.opens, &self.closes].map(|end| {
            let offset = ray + (camera.position - end.position) / depth;
            let seen = Mat3::from_quat(end.rotation).transpose() * offset;
            let image = || Vec2::new(seen.x, -seen.y) / -seen.z;
            (seen.z < 0.0).then(|| camera.principal_px + camera.focal_px * image() - pixel)
        })
    }

    /// The shadow ratios, averaged over the time that the shutter is open. `seen` is the share of each pixel that shows ground, and
    /// `depth` the ground's distance along the optical axis in a column and row, metres, if there is any.
    pub(crate) fn blurred(
        &self,
        camera: &Camera,
        shadow: &Raster<Vec3>,
        seen: &Raster<f32>,
        depth: impl Fn(usize, usize) -> Option<f32> + Sync,
    ) -> Raster<Vec3> {
        let width = shadow.width();
        let mut output = shadow.clone();
        let Some([low, high]) = shaded(shadow) else {
            return output;
        };
        let rows = output.pixels_mut().par_chunks_mut(width).enumerate();
        rows.for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let at = Vec2::new(x as f32, y as f32) + 0.5;
                let ends = depth(x, y).map(|depth| self.ends_px(camera, at, depth));
                // A point that is behind the camera at either end has no place in the picture then.
                let Some([Some(opens), Some(closes)]) = ends else {
                    continue;
                };
                let first = at.min(at - opens).min(at - closes);
                let last = at.max(at - opens).max(at - closes);
                let meets = last.cmpge(low).all() && first.cmple(high).all();
                if meets && opens.length().max(closes.length()) >= LEAST_PX {
                    let sum = mean(shadow, seen, at, -opens) + mean(shadow, seen, at, -closes);
                    if sum.w > LEAST_SEEN {
                        *pixel = sum.truncate() / sum.w;
                    }
                }
            }
        });
        output
    }
}

/// Corners of a box that holds all that is not 1, and a pixel around it; `None` if everything is.
fn shaded(shadow: &Raster<Vec3>) -> Option<[Vec2; 2]> {
    let columns = |row: &[Vec3]| {
        let first = row.iter().position(|s| *s != Vec3::ONE)?;
        let last = row.iter().rposition(|s| *s != Vec3::ONE)?;
        Some((first, last))
    };
    let rows = (0..shadow.height()).filter_map(|y| Some((y, columns(shadow.row(y))?)));
    rows.fold(None, |all, (y, (first, last))| {
        let low = Vec2::new(first as f32, y as f32) - 1.0;
        let high = Vec2::new(last as f32, y as f32) + 2.0;
        let [l, h] = all.unwrap_or([low, high]);
        Some([l.min(low), h.max(high)])
    })
}

/// The mean of ratios along a line from `start`, in the picture, each weighed by how far it is `seen`; last the mean of that.
fn mean(ratios: &Raster<Vec3>, seen: &Raster<f32>, start: Vec2, along: Vec2) -> Vec4 {
    let size = Vec2::new(ratios.width() as f32, ratios.height() as f32);
    let along = clipped(start, along, size);
    let count = 1 + (2.0 * along.length()) as u32;
    let value = |x: usize, y: usize| ratios.get(x, y).extend(1.0) * *seen.get(x, y);
    let sum: Vec4 = (0..count)
        .map(|i| {
            let at = start + along * ((i as f32 + 0.5) / count as f32) - 0.5;
            let at = at.clamp(Vec2::ZERO, size - 1.0);
            let low = at.floor();
            let (x, y) = (low.x as usize, low.y as usize);
            let (right, below) = (
                (x + 1).min(ratios.width() - 1),
                (y + 1).min(ratios.height() - 1),
            );
            let rest = at - low;
            let row = |y: usize| value(x, y).lerp(value(right, y), rest.x);
            row(y).lerp(row(below), rest.y)
        })
        .sum();
    sum / count as f32
}

/// What of the line `along` from `start`, a place in a picture of `size`, lies in that.
fn clipped(start: Vec2, along: Vec2, size: Vec2) -> Vec2 {
    let share = |from: f32, by: f32, most: f32| {
        let room = if by > 0.0 { most - from } else { from };
        if by.abs() > room {
            room / by.abs()
        } else {
            1.0
        }
    };
    along * share(start.x, along.x, size.x).min(share(start.y, along.y, size.y))
}

#[cfg(test)]
mod tests;
