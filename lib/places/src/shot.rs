//! A photograph of a place whose camera is known: what pitch, roll and field of view are learned from.
use std::f32::consts::TAU;

use dipir_calibration::SEARCHED;
use dipir_calibration::pose::Pose;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use glam::{DVec3, Vec3};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

use crate::place::Place;
use crate::view::{View, bilinear};

/// Pixels along the longer side: at 60 degrees a panorama of 1024 columns has 170, so that one ray a pixel is enough.
const LONGEST: usize = 256;
/// Log-average of a photograph before its curve, as [`View`] exposes it.
const AVERAGE: f32 = 0.18 / 0.82;
/// Width over height of pictures.
const SHAPES: [f64; 7] = [1.5, 4.0 / 3.0, 16.0 / 9.0, 1.0, 0.75, 2.0 / 3.0, 9.0 / 16.0];

/// What cameras are drawn from, evenly; degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Upwards.
    pub pitch: [f64; 2],
    /// Clockwise.
    pub roll: [f64; 2],
    /// Along the longer side.
    pub fov: [f64; 2],
}

/// What networks learn from: all that is searched, a little more than they are judged on.
pub const LEARNED: Range = Range {
    pitch: SEARCHED[0],
    roll: SEARCHED[1],
    fov: SEARCHED[2],
};
/// What they are judged on.
pub const JUDGED: Range = Range {
    pitch: [-40.0, 20.0],
    roll: [-5.0, 5.0],
    fov: [30.0, 90.0],
};

/// How a photograph is taken and developed.
#[derive(Clone, Debug, PartialEq)]
pub struct Shot {
    /// The camera.
    pub pose: Pose,
    /// Pixels.
    pub size: [usize; 2],
    /// Turn about the vertical, radians.
    pub heading: f32,
    /// Curve, exposure, white balance and noise; its camera is not used.
    pub development: View,
    /// Quality of the JPEG.
    pub quality: u8,
    /// How often neighbours are averaged: cameras are not equally sharp.
    pub blur: usize,
}

impl Shot {
    /// Photograph `n` of a place.
    pub fn drawn(range: &Range, seed: u64, place: usize, n: usize) -> Self {
        let development = View::drawn(seed, place, n);
        let mut s = Sampler::new(seed ^ 0xca3e_4a00, Stream::CONTENT, place as u32, n as u32);
        let mut between = |[low, high]: [f64; 2]| low + (high - low) * f64::from(s.next_1d());
        let pose = Pose::new(
            between(range.pitch),
            between(range.roll),
            between(range.fov),
        );
        let shape = SHAPES[(between([0.0, SHAPES.len() as f64]) as usize).min(SHAPES.len() - 1)];
        let longest = LONGEST as f64;
        let size = match shape >= 1.0 {
            true => [longest, longest / shape],
            false => [longest * shape, longest],
        };
        Self {
            pose,
            size: size.map(|n| n.round() as usize),
            heading: between([0.0, 1.0]) as f32 * TAU,
            development,
            quality: between([55.0, 97.0]) as u8,
            blur: between([0.0, 2.5]) as usize,
        }
    }

    /// The photograph, as it is read from its file.
    pub fn take(&self, place: &Place, seed: u64) -> LinearImage {
        let [w, h] = self.size;
        let rotation = self.pose.rotation();
        let focal = self.pose.focal() * w.max(h) as f64;
        let seen = |k: usize| {
            let x = ((k % w) as f64 + 0.5 - 0.5 * w as f64) / focal;
            let y = (0.5 * h as f64 - (k / w) as f64 - 0.5) / focal;
            let d = (rotation * DVec3::new(x, y, -1.0).normalize()).as_vec3();
            bilinear(&place.panorama, d.x.atan2(-d.z) + self.heading, d.y)
        };
        let mut picture = Raster::from_pixels(w, h, (0..w * h).map(seen).collect());
        for _ in 0..self.blur {
            picture = blurred(&picture);
        }
        self.developed(&picture, seed)
    }

    /// From light to the light that the file of 8 bits says it was.
    fn developed(&self, picture: &Raster<Vec3>, seed: u64) -> LinearImage {
        let how = &self.development;
        let log = |p: &Vec3| f64::from(luminance(*p).max(1e-6).ln());
        let mean = picture.pixels().iter().map(log).sum::<f64>() / picture.pixels().len() as f64;
        let gain = how.white * (AVERAGE / mean.exp() as f32 * how.stops.exp2());
        let mut s = Sampler::new(seed, Stream::TEST, self.quality.into(), 0);
        let mut bytes = Vec::with_capacity(3 * picture.pixels().len());
        for p in picture.pixels() {
            let even = 2.0 * (s.next_u64() >> 40) as f32 / 16_777_216.0 - 1.0;
            let noise = 1.0 + how.noise * 1.73 * even;
            for v in (*p * gain * noise).to_array() {
                let display = Transfer::Srgb.encode_scalar(how.develop(v));
                bytes.push((display * 255.0).round() as u8);
            }
        }
        let (w, h) = (picture.width(), picture.height());
        let bytes = through_jpeg(&bytes, [w as u32, h as u32], self.quality).unwrap_or(bytes);
        let decoded: [f32; 256] =
            std::array::from_fn(|k| Transfer::Srgb.decode_scalar(k as f32 / 255.0));
        let pixel = |p: &[u8]| Vec3::new(p[0].into(), p[1].into(), p[2].into()).to_array();
        let light = |p: &[u8]| Vec3::from_array(pixel(p).map(|v| decoded[v as usize]));
        LinearImage(Raster::from_pixels(
            w,
            h,
            bytes.chunks_exact(3).map(light).collect(),
        ))
    }
}

fn through_jpeg(bytes: &[u8], [w, h]: [u32; 2], quality: u8) -> Option<Vec<u8>> {
    let mut file = Vec::new();
    JpegEncoder::new_with_quality(&mut file, quality)
        .encode(bytes, w, h, ExtendedColorType::Rgb8)
        .ok()?;
    let read = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg);
    Some(read.ok()?.into_rgb8().into_raw())
}

/// By 1 2 1 along rows and columns.
fn blurred(picture: &Raster<Vec3>) -> Raster<Vec3> {
    let (w, h) = (picture.width(), picture.height());
    let pixel = |k: usize| {
        let (x, y) = (k % w, k / w);
        let row = |y: usize| {
            let at = |x: usize| *picture.get(x, y);
            0.25 * at(x.saturating_sub(1)) + 0.5 * at(x) + 0.25 * at((x + 1).min(w - 1))
        };
        0.25 * row(y.saturating_sub(1)) + 0.5 * row(y) + 0.25 * row((y + 1).min(h - 1))
    };
    Raster::from_pixels(w, h, (0..w * h).map(pixel).collect())
}
