//! Depth of field: what is nearer or farther than the lens is focused on is blurred.
//!
//! The object is seen by rays through all of a thin lens, so what it hides of itself and of the photograph behind it blurs
//! as it does in a camera. The photograph was blurred when it was taken; only the shadow on it is new. The ratio of a pixel
//! is averaged over the disc that its lens would have seen on a surface facing the camera, at the depth that the pixel shows.
use dipir_imaging::raster::Raster;
use dipir_numerics::warp::square_to_disk;
use dipir_scene::camera::{Camera, Ray};
use glam::{DVec4, Vec2, Vec3};
use rayon::prelude::*;

/// A lens without thickness or errors, focused on a plane that faces the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThinLens {
    /// Half of the diameter of the opening that light enters by, metres.
    pub radius: f32,
    /// Distance along the optical axis of what is sharp, metres.
    pub focus: f32,
}

/// Rows that are blurred at a time, side by side.
const BAND: usize = 32;
/// Discs of a smaller radius leave a shadow as it is, pixels: a pixel is as wide.
const LEAST_PX: f32 = 0.5;

impl ThinLens {
    /// From the point of the lens that `u` in the unit square stands for, to what is sharp at the image position `pixel`.
    pub fn ray(&self, camera: &Camera, pixel: Vec2, u: Vec2) -> Ray {
        let d = (pixel - camera.principal_px) / camera.focal_px;
        let sharp = Vec3::new(d.x, -d.y, -1.0) * self.focus;
        let on_lens = (square_to_disk(u) * self.radius).extend(0.0);
        Ray {
            origin: camera.position + camera.rotation * on_lens,
            direction: (camera.rotation * (sharp - on_lens)).normalize(),
        }
    }

    /// Horizontal and vertical radius of the disc that a point at this distance along the optical axis is seen as, pixels.
    pub fn blur_px(&self, camera: &Camera, depth: f32) -> Vec2 {
        camera.focal_px * (self.radius * (1.0 / depth - 1.0 / self.focus).abs())
    }

    /// The shadow ratios, averaged over the lens. `seen` is the share of each pixel that shows ground, and `depth` the ground's
    /// distance along the optical axis in a column and row, metres, if there is any.
    pub(crate) fn blurred(
        &self,
        camera: &Camera,
        shadow: &Raster<Vec3>,
        seen: &Raster<f32>,
        depth: impl Fn(usize, usize) -> Option<f32> + Sync,
    ) -> Raster<Vec3> {
        let (width, height) = (shadow.width(), shadow.height());
        let mut output = shadow.clone();
        let shades = |y: usize| shadow.row(y).iter().any(|s| *s != Vec3::ONE);
        let shaded: Vec<bool> = (0..height).map(shades).collect();
        let bands = output.pixels_mut().par_chunks_mut(BAND * width);
        bands.enumerate().for_each(|(band, output)| {
            let rows = output.len() / width;
            let radius = |i: usize| -> Option<Vec2> {
                let radius = self.blur_px(camera, depth(i % width, band * BAND + i / width)?);
                (radius.max_element() >= LEAST_PX).then_some(radius)
            };
            let radii: Vec<_> = (0..output.len()).map(radius).collect();
            let reach = radii.iter().flatten().map(|r| r.y).fold(0f32, f32::max) as usize + 1;
            let first = (band * BAND).saturating_sub(reach);
            let end = (band * BAND + rows + reach).min(height);
            if !shaded[first..end].contains(&true) {
                return;
            }
            let missing = Missing::new(shadow, seen, first, end);
            for (i, (pixel, radius)) in output.iter_mut().zip(&radii).enumerate() {
                if let Some(radius) = radius {
                    let center = [i % width, band * BAND + i / width];
                    if let Some(missing) = missing.mean(center, *radius, height) {
                        *pixel = Vec3::ONE - missing;
                    }
                }
            }
        });
        output
    }
}

/// What shadow ratios lack of 1, and the shares of pixels that show ground, summed along rows.
struct Missing {
    first: usize,
    width: usize,
    /// Of each row from `first` on, the sums up to each pixel's left side, and the whole. The fourth number sums the shares, by
    /// which the others are weighed.
    sums: Vec<DVec4>,
}

/// Least share of a disc that has to be seen beside the objects for its ratios to be averaged.
const LEAST_SEEN: f64 = 1e-3;

impl Missing {
    fn new(shadow: &Raster<Vec3>, seen: &Raster<f32>, first: usize, end: usize) -> Self {
        let width = shadow.width();
        let mut sums = Vec::with_capacity((end - first) * (width + 1));
        for y in first..end {
            let mut sum = DVec4::ZERO;
            sums.push(sum);
            sums.extend(shadow.row(y).iter().zip(seen.row(y)).map(|(s, w)| {
                sum += ((Vec3::ONE - *s).extend(1.0) * *w).as_dvec4();
                sum
            }));
        }
        Self { first, width, sums }
    }

    /// Of row `y` up to the position `x`.
    fn up_to(&self, y: usize, x: f64) -> DVec4 {
        let row = &self.sums[(y - self.first) * (self.width + 1)..][..self.width + 1];
        let at = x.clamp(0.0, self.width as f64);
        let left = (at as usize).min(self.width - 1);
        row[left].lerp(row[left + 1], at - left as f64)
    }

    /// The mean over what is seen of the part of an ellipse that lies in the picture, if that is anything.
    fn mean(&self, [x, y]: [usize; 2], radius: Vec2, height: usize) -> Option<Vec3> {
        let radius = radius.as_dvec2().max(glam::DVec2::splat(0.5));
        let middle = x as f64 + 0.5;
        let reach = radius.y as usize;
        let (mut sum, mut area) = (DVec4::ZERO, 0.0);
        for row in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            let off = (row as f64 - y as f64) / radius.y;
            let half = radius.x * (1.0 - off * off).max(0.0).sqrt();
            let ends = [middle - half, middle + half].map(|x| x.clamp(0.0, self.width as f64));
            sum += self.up_to(row, ends[1]) - self.up_to(row, ends[0]);
            area += ends[1] - ends[0];
        }
        (sum.w > LEAST_SEEN * area).then(|| (sum.truncate() / sum.w).as_vec3())
    }
}

#[cfg(test)]
mod tests;
