//! One photograph of a place.
use std::f32::consts::TAU;

use dipir_estimator::features::{LOOKED, SmallPhoto};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_scene::camera::Camera;
use glam::{EulerRot, Mat3, Vec2, Vec3};

use crate::place::{Place, SMOOTH};

/// Curves that are mixed: from linear light to linear display values.
const CURVES: usize = 4;
/// The log-average of a photograph before its curve: `x / (1 + x)` shows it as .18.
const AVERAGE: f32 = 0.18 / 0.82;
/// The grey that is to look right under the light, as a share of it.
const GREY: f32 = 0.5;

/// How a photograph is taken and developed.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Columns of [`SMOOTH`] by which the view is turned.
    pub heading: usize,
    /// Radians.
    pub pitch: f32,
    /// Radians.
    pub roll: f32,
    /// Tangents of half the angles that are seen to the side and upwards.
    pub half: Vec2,
    /// Stops over the automatic exposure.
    pub stops: f32,
    /// Gains of the channels, green 1.
    pub white: Vec3,
    /// Shares of the curves.
    pub curve: [f32; CURVES],
    /// Standard deviation of noise over the signal.
    pub noise: f32,
    /// Rays along each side of a pixel: a photograph has `LOOKED / rays` pixels along each side.
    pub rays: usize,
}

impl View {
    /// Photograph `n` of a place: any camera.
    pub fn drawn(seed: u64, place: usize, n: usize) -> Self {
        let mut s = Sampler::new(seed, Stream::CONTENT, place as u32, n as u32);
        let mut between = |low: f32, high: f32| low + (high - low) * s.next_1d();
        let heading = between(0.0, SMOOTH[0] as f32) as usize % SMOOTH[0];
        let longer = (0.5 * between(25.0, 90.0).to_radians()).tan();
        let aspect = between(-0.45, 0.6).exp();
        let half = if aspect > 1.0 {
            Vec2::new(longer, longer / aspect)
        } else {
            Vec2::new(longer * aspect, longer)
        };
        let pitch = between(-40.0, 20.0).to_radians();
        // Sums of three uniform numbers are near enough to normal ones.
        let mut spread = |d: f32| d * (0..3).map(|_| between(-1.0, 1.0)).sum::<f32>();
        let (roll, stops) = (spread(2.5).to_radians(), spread(0.5));
        let white = Vec3::new(spread(0.08).exp(), 1.0, spread(0.08).exp());
        let shares: [f32; CURVES] = std::array::from_fn(|_| between(0.0, 1.0).powi(3) + 1e-3);
        let total: f32 = shares.iter().sum();
        let noise = between(0.0, 0.05);
        let rays = if between(0.0, 1.0) < 0.5 { 1 } else { 2 };
        Self {
            heading,
            pitch,
            roll,
            half,
            stops,
            white,
            curve: shares.map(|v| v / total),
            noise,
            rays,
        }
    }

    /// As the project's evaluation takes photographs: 45 degrees, 14 down, square, `x / (1 + x)`.
    pub fn standard(heading: usize) -> Self {
        Self {
            heading,
            pitch: -14f32.to_radians(),
            roll: 0.0,
            half: Vec2::splat(22.5f32.to_radians().tan()),
            stops: 0.0,
            white: Vec3::ONE,
            curve: [1.0, 0.0, 0.0, 0.0],
            noise: 0.0,
            rays: 2,
        }
    }

    fn side(&self) -> usize {
        LOOKED / self.rays
    }

    /// The camera with azimuth 0.
    pub fn camera(&self) -> Camera {
        let side = self.side() as f32;
        Camera {
            position: Vec3::ZERO,
            rotation: Mat3::from_euler(EulerRot::YXZ, 0.0, self.pitch, self.roll),
            focal_px: Vec2::splat(0.5 * side) / self.half,
            principal_px: Vec2::splat(0.5 * side),
            resolution: [self.side() as u32; 2],
        }
    }

    /// From linear light to linear display values.
    pub fn develop(&self, x: f32) -> f32 {
        let x = x.max(0.0);
        let y = 0.6 * x;
        let film = (y * (2.51 * y + 0.03) / (y * (2.43 * y + 0.59) + 0.14)).min(1.0);
        let curves = [x / (1.0 + x), 1.0 - (-1.2 * x).exp(), x.min(1.0), film];
        curves.iter().zip(self.curve).map(|(c, w)| c * w).sum()
    }

    /// The photograph at the estimator's size, the exposure of each channel, and the curve's gain: its output for grey
    /// under the place's mean light, divided by that light. A place's radiance times both is on the photograph's scale.
    pub fn take(&self, place: &Place, seed: u64) -> (SmallPhoto, Vec3, f32) {
        let (photo, gain, curve) = self.photograph(place, seed);
        (SmallPhoto::new(&photo, &self.camera()), gain, curve)
    }

    /// As [`take`](Self::take), the photograph itself.
    pub fn photograph(&self, place: &Place, seed: u64) -> (LinearImage, Vec3, f32) {
        let camera = self.camera();
        let turn = self.heading as f32 / SMOOTH[0] as f32 * TAU;
        let (side, rays) = (self.side(), self.rays);
        let seen: Vec<Vec3> = (0..LOOKED * LOOKED)
            .map(|k| {
                let at = Vec2::new((k % LOOKED) as f32 + 0.5, (k / LOOKED) as f32 + 0.5);
                let at = at / rays as f32;
                let d = camera.ray(at).direction;
                bilinear(&place.panorama, d.x.atan2(-d.z) + turn, d.y)
            })
            .collect();
        let log: f64 = seen
            .iter()
            .map(|p| f64::from(luminance(*p).max(1e-6).ln()))
            .sum();
        let average = (log / seen.len() as f64).exp() as f32;
        let exposure = AVERAGE / average * self.stops.exp2();
        let gain = self.white * exposure;
        let mut s = Sampler::new(seed, Stream::TEST, self.heading as u32, 0);
        let mut shown = |p: &Vec3| {
            let noise =
                1.0 + self.noise * 1.73 * (2.0 * (s.next_u64() >> 40) as f32 / 16_777_216.0 - 1.0);
            let channel = |v: f32| {
                let display = Transfer::Srgb.encode_scalar(self.develop(v * noise));
                Transfer::Srgb.decode_scalar((display * 255.0).round() / 255.0)
            };
            Vec3::from_array((*p * gain).to_array().map(channel))
        };
        let fine: Vec<Vec3> = seen.iter().map(&mut shown).collect();
        let mean = |k: usize| {
            let (x, y) = (k % side * rays, k / side * rays);
            (0..rays * rays)
                .map(|r| fine[(y + r / rays) * LOOKED + x + r % rays])
                .sum::<Vec3>()
                / (rays * rays) as f32
        };
        let photo = Raster::from_pixels(side, side, (0..side * side).map(mean).collect());
        let grey = (GREY * luminance(place.mean()) * exposure).max(1e-6);
        (LinearImage(photo), gain, self.develop(grey) / grey)
    }
}

/// A map between the middles of its texels at an azimuth, radians, and the sine of an elevation.
pub(crate) fn bilinear(
    map: &dipir_light::environment::EnvironmentMap,
    azimuth: f32,
    up: f32,
) -> Vec3 {
    let (width, height) = (map.width(), map.height());
    let x = (azimuth / TAU).rem_euclid(1.0) * width as f32 - 0.5;
    let v = up.clamp(-1.0, 1.0).acos() / std::f32::consts::PI;
    let y = (v * height as f32 - 0.5).clamp(0.0, (height - 1) as f32);
    let (fx, fy) = (x - x.floor(), y - y.floor());
    let column = |k: i64| (x.floor() as i64 + k).rem_euclid(width as i64) as usize;
    let row = |k: usize| (y as usize + k).min(height - 1);
    let line = |i: usize| {
        map.texel(row(i), column(0))
            .lerp(map.texel(row(i), column(1)), fx)
    };
    line(0).lerp(line(1), fy)
}
