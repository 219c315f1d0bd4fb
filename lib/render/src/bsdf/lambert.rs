//! The diffuse lobe below an interface.
use std::f32::consts::FRAC_1_PI;

/// `1 / (pi (1 - mean))`: what a Lambertian lobe `(1 - E(wo)) (1 - E(wi))` needs so that a
/// white one returns `1 - E(wo)`, all that the interface lets through, where `mean < 1` is
/// the interface's cosine-weighted mean albedo [Kelemen and Szirmay-Kalos 2001, eq. 9]. 0 for an
/// interface that lets nothing through.
#[inline]
pub(super) fn coupling(mean: f32) -> f32 {
    let left = 1.0 - mean;
    if left > 0.0 { FRAC_1_PI / left } else { 0.0 }
}

/// Logarithmic derivative of [`coupling`] with respect to the mean.
#[inline]
pub(super) fn log_coupling_slope(mean: f32) -> f32 {
    let left = 1.0 - mean;
    if left > 0.0 { 1.0 / left } else { 0.0 }
}
