//! What the photograph shows of the light: its visible part, placed into an environment map by its camera.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::{Filter, resize};
use dipir_light::environment::EnvironmentMap;
use dipir_light::luminance::luminance;
use dipir_scene::camera::Camera;
use glam::{Vec2, Vec3};

use crate::features::{CLIPPED, unframed};

/// Width of the soft border of a photograph in a map, degrees.
pub const BORDER_DEG: f32 = 6.0;
/// Directions along each side of a texel at which the photograph is looked up.
const SAMPLES: usize = 4;
/// Columns and rows on which the two parts are compared at their border.
const COARSE: [usize; 2] = [32, 16];
/// How far the border's ratio reaches into the estimate, radians (15 degrees).
const REACH: f32 = 0.26;
/// The border's ratio is kept within this many stops either way.
const MOST_STOPS: f32 = 2.0;
/// Weight of the estimate's own exposure where the border is far.
const FAR: f32 = 0.02;

/// The part of the sphere that a photograph shows.
#[derive(Clone, Debug)]
pub struct Visible {
    /// Linear radiance of what is seen; black elsewhere.
    pub map: EnvironmentMap,
    /// How much of each texel is seen, falling to 0 at the photograph's border.
    pub alpha: Vec<f32>,
    /// Share of each texel's seen part that is clipped: its radiance is a lower bound there.
    pub clipped: Vec<f32>,
}

impl Visible {
    /// Places a decoded photograph without the frame around it into a map of `width` x `height` texels, fading over the
    /// outer `border_deg` degrees of the picture. Every texel is the mean over its cell.
    pub fn new(
        photo: &LinearImage,
        camera: &Camera,
        width: usize,
        height: usize,
        border_deg: f32,
    ) -> Self {
        Self::up_to(1.0, photo, camera, [width, height], border_deg)
    }

    /// As [`new`](Self::new), of a photograph that is clipped at `most` in place of 1: one with a gain map, which knows what is
    /// brighter than white.
    pub fn up_to(
        most: f32,
        photo: &LinearImage,
        camera: &Camera,
        [width, height]: [usize; 2],
        border_deg: f32,
    ) -> Self {
        let view = match unframed(photo, camera) {
            Some((photo, camera)) => View::new(&photo, &camera, height, border_deg),
            None => View::new(photo, camera, height, border_deg),
        };
        let (mut texels, mut alpha, mut clipped) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..height {
            for j in 0..width {
                let (mut light, mut weight, mut white) = (Vec3::ZERO, 0.0, 0.0);
                for s in 0..SAMPLES * SAMPLES {
                    let u =
                        (j as f32 + (s % SAMPLES) as f32 / SAMPLES as f32 + 0.5 / SAMPLES as f32)
                            / width as f32;
                    let v =
                        (i as f32 + (s / SAMPLES) as f32 / SAMPLES as f32 + 0.5 / SAMPLES as f32)
                            / height as f32;
                    let towards = dipir_light::environment::direction_at(u, v);
                    if let Some((value, seen)) = view.sample(towards) {
                        light += value * seen;
                        weight += seen;
                        white += if value.max_element() >= CLIPPED * most {
                            seen
                        } else {
                            0.0
                        };
                    }
                }
                let seen = weight > 0.0;
                texels.push(if seen { light / weight } else { Vec3::ZERO });
                clipped.push(if seen { white / weight } else { 0.0 });
                alpha.push(weight / (SAMPLES * SAMPLES) as f32);
            }
        }
        let black = EnvironmentMap::constant(width, height, Vec3::ZERO);
        Self {
            map: EnvironmentMap::new(width, height, texels).unwrap_or(black),
            alpha,
            clipped,
        }
    }

    /// The same part of a photograph in which nothing is clipped.
    pub fn unclipped(mut self) -> Self {
        self.clipped.fill(0.0);
        self
    }

    /// The same part with all radiance times a factor; a smaller one, if it took radiance beyond all numbers.
    pub fn scaled(self, factor: f32) -> Self {
        let texels = self.map.texels().iter();
        let brightest = texels.map(|t| t.max_element()).fold(0.0, f32::max);
        let most = 0.99 * f32::MAX / brightest.max(1.0);
        Self {
            map: self.map.scaled(factor.min(most)),
            ..self
        }
    }
}

/// A photograph with pixels about as large as the samples of a texel.
struct View {
    pixels: Raster<Vec3>,
    camera: Camera,
    border_rad: f32,
}

impl View {
    fn new(photo: &LinearImage, camera: &Camera, rows: usize, border_deg: f32) -> Self {
        let clean = photo.0.map(|p| {
            let channel = |v: f32| if v.is_finite() { v.max(0.0) } else { 0.0 };
            Vec3::from_array(p.to_array().map(channel))
        });
        // Pixels of a sample's size: the focal length is then the number of samples in a radian.
        let wanted = (rows * SAMPLES) as f32 / std::f32::consts::PI;
        let scale = |focal: f32| (wanted / focal).min(1.0);
        let shrunk = |n: usize, full: u32, focal: f32| {
            // The camera may belong to another size of the same picture.
            let per_pixel = n as f32 / full.max(1) as f32;
            ((n as f32 * scale(focal * per_pixel)).round() as usize).clamp(1, n)
        };
        let [w, h] = camera.resolution;
        let width = shrunk(clean.width(), w, camera.focal_px.x);
        let height = shrunk(clean.height(), h, camera.focal_px.y);
        Self {
            pixels: resize(&clean, width, height, Filter::Area),
            // Light is far away. In f32 a direction added to a position far from the origin loses its digits.
            camera: Camera {
                position: Vec3::ZERO,
                ..camera.scaled([width as u32, height as u32])
            },
            border_rad: border_deg.to_radians().max(1e-4),
        }
    }

    /// Radiance from a direction and how far inside the picture it lies, 0 at the border to 1.
    fn sample(&self, towards: Vec3) -> Option<(Vec3, f32)> {
        let at = self.camera.project(towards)?;
        let size = Vec2::new(self.pixels.width() as f32, self.pixels.height() as f32);
        if !(at.cmpge(Vec2::ZERO).all() && at.cmplt(size).all()) {
            return None;
        }
        // Angles to the four edges along the picture's axes.
        let angle = |x: f32, middle: f32, focal: f32| ((x - middle) / focal).atan();
        let side = |k: usize| {
            let (m, f) = (self.camera.principal_px[k], self.camera.focal_px[k]);
            let here = angle(at[k], m, f);
            (here - angle(0.0, m, f)).min(angle(size[k], m, f) - here)
        };
        let t = (side(0).min(side(1)) / self.border_rad).clamp(0.0, 1.0);
        let value = *self.pixels.get(at.x as usize, at.y as usize);
        Some((value, t * t * (3.0 - 2.0 * t)))
    }
}

/// The visible part where it is seen, the estimate elsewhere, on the grid of `visible`. Near the border the estimate is
/// scaled to the exposure of what is seen. Where the photograph is clipped the brighter of the two stays, so that a
/// source in view keeps the energy that is estimated for it.
pub fn merged(visible: &Visible, estimate: &EnvironmentMap) -> EnvironmentMap {
    let unseen = estimate.resampled(visible.map.width(), visible.map.height());
    let ratios = border_ratios(visible, &unseen);
    joined(visible, &unseen, |k| ratios[k])
}

/// As [`merged`], the estimate as it is: for photographs whose exposure is that of the estimate.
pub fn overlaid(visible: &Visible, estimate: &EnvironmentMap) -> EnvironmentMap {
    let unseen = estimate.resampled(visible.map.width(), visible.map.height());
    joined(visible, &unseen, |_| 1.0)
}

/// Both parts, where each texel that is not seen is multiplied by `ratio`.
fn joined(
    visible: &Visible,
    unseen: &EnvironmentMap,
    ratio: impl Fn(usize) -> f32,
) -> EnvironmentMap {
    let (width, height) = (unseen.width(), unseen.height());
    let texels = (0..width * height)
        .map(|k| {
            let other = unseen.texels()[k];
            let (alpha, white) = (visible.alpha[k], visible.clipped[k]);
            if alpha == 0.0 {
                return other * ratio(k);
            }
            let seen = visible.map.texels()[k];
            let bounded = seen + (other - seen).max(Vec3::ZERO) * white;
            other * ratio(k) * (1.0 - alpha) + bounded * alpha
        })
        .collect();
    EnvironmentMap::new(width, height, texels).unwrap_or_else(|_| unseen.clone())
}

/// What each texel of the estimate is multiplied by: the mean ratio of what is seen nearby to what is estimated there,
/// 1 far away.
fn border_ratios(visible: &Visible, unseen: &EnvironmentMap) -> Vec<f32> {
    let width = unseen.width();
    let mut seen: Vec<(Vec3, f32, f32)> = Vec::new();
    let grid = EnvironmentMap::constant(COARSE[0], COARSE[1], Vec3::ZERO);
    let mut sums = vec![[0f32; 3]; COARSE[0] * COARSE[1]];
    for (k, alpha) in visible.alpha.iter().enumerate() {
        let weight = alpha * (1.0 - visible.clipped[k]) * visible.map.solid_angle(k / width) as f32;
        let (i, j) = grid.texel_of(visible.map.direction_of(k / width, k % width));
        let sum = &mut sums[i * COARSE[0] + j];
        sum[0] += weight;
        sum[1] += weight * luminance(visible.map.texels()[k]);
        sum[2] += weight * luminance(unseen.texels()[k]);
    }
    for (k, [weight, here, there]) in sums.iter().enumerate() {
        if *weight > 0.0 && *here > 0.0 && *there > 0.0 {
            let stops = (here / there).log2().clamp(-MOST_STOPS, MOST_STOPS);
            seen.push((
                grid.direction_of(k / COARSE[0], k % COARSE[0]),
                *weight,
                stops,
            ));
        }
    }
    (0..unseen.texels().len())
        .map(|k| {
            let direction = unseen.direction_of(k / width, k % width);
            let (mut total, mut sum) = (FAR, 0.0);
            for (towards, weight, stops) in &seen {
                let w = weight * ((direction.dot(*towards) - 1.0) / (REACH * REACH)).exp();
                total += w;
                sum += w * stops;
            }
            (sum / total).exp2()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use dipir_scene::camera::FieldOfView;

    use super::*;

    #[test]
    fn light_beyond_white_is_known_up_to_the_most_that_is_told() {
        let photo = LinearImage(Raster::filled(30, 20, Vec3::splat(3.0)));
        let view = FieldOfView::Vertical(0.9);
        let camera = Camera::look_at(Vec3::ZERO, Vec3::NEG_Z, Vec3::Y, view, [30, 20]);
        let dim = EnvironmentMap::constant(8, 4, Vec3::splat(7.0));
        for (most, wanted) in [(8.0, 3.0), (3.0, 7.0), (1.0, 7.0)] {
            let seen = Visible::up_to(most, &photo, &camera, [64, 32], 3.0);
            let light = overlaid(&seen, &dim);
            let (i, j) = light.texel_of(Vec3::NEG_Z);
            assert!((light.texel(i, j).x - wanted).abs() < 1e-4, "{most}");
        }
    }

    #[test]
    fn what_is_seen_of_far_light_does_not_depend_on_where_the_camera_stands() {
        let pixels = (0..60 * 40).map(|k| Vec3::splat(((k * 7919) % 1009) as f32 / 1009.0));
        let photo = LinearImage(Raster::from_pixels(60, 40, pixels.collect()));
        let ahead = Vec3::new(0.3, -0.1, -1.0);
        let view = FieldOfView::Vertical(0.9);
        let here = Camera::look_at(Vec3::ZERO, ahead, Vec3::Y, view, [60, 40]);
        // As in a map's coordinates, where f32 has steps of half a metre.
        let there = Camera {
            position: Vec3::new(500_000.0, 100.0, 5_000_000.0),
            ..here
        };
        let [a, b] = [here, there].map(|camera| Visible::new(&photo, &camera, 64, 32, 6.0));
        assert!(a.alpha.iter().any(|&seen| seen > 0.9));
        assert_eq!((a.map, a.alpha), (b.map, b.alpha));
    }
}
