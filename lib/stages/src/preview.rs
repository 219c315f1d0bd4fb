//! Depths, normals and environment maps as pictures.
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;

/// A scalar from least (black) to largest (white); what is not finite is black.
pub fn stretched(raster: &Raster<f32>) -> DisplayImage {
    let finite = || raster.pixels().iter().copied().filter(|v| v.is_finite());
    let low = finite().fold(f32::INFINITY, f32::min);
    let high = finite().fold(f32::NEG_INFINITY, f32::max);
    let scale = if high > low { 1.0 / (high - low) } else { 0.0 };
    DisplayImage(raster.map(|v| match v.is_finite() {
        true => Vec3::splat((v - low) * scale),
        false => Vec3::ZERO,
    }))
}

/// Unit vectors in the usual colours of normal maps.
pub fn normals(raster: &Raster<Vec3>) -> DisplayImage {
    DisplayImage(raster.map(|n| (*n + 1.0) * 0.5))
}

/// Luminance to which the log-average of an environment map is exposed: photographic mid-grey.
const MID_GREY: f32 = 0.18;

/// An environment map exposed for its log-average times `gain`, and compressed by `x / (1 + x)` on
/// luminance.
pub fn environment(map: &EnvironmentMap, gain: f32) -> DisplayImage {
    let luminance = map.luminance();
    // Texels are weighted by their solid angle; black ones say nothing of exposure.
    let (mut log_sum, mut weight) = (0.0, 0.0);
    for (k, &l) in luminance.iter().enumerate().filter(|(_, l)| **l > 0.0) {
        let w = map.solid_angle(k / map.width());
        log_sum += w * f64::from(l).ln();
        weight += w;
    }
    let average = match weight > 0.0 {
        true => (log_sum / weight).exp() as f32,
        false => 1.0,
    };
    let exposure = gain * MID_GREY / average;
    let texels = map.texels().iter().zip(&luminance);
    let mapped = texels.map(|(&t, l)| t * exposure / (1.0 + l * exposure));
    let mapped = Raster::from_pixels(map.width(), map.height(), mapped.collect());
    Transfer::Srgb.encode(&LinearImage(mapped))
}
