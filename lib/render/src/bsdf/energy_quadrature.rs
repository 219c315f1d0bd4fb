//! The directional albedo of a GGX microsurface by f64 quadrature: what the committed table
//! of [`energy`](super::energy) was made from, and what tests hold it against.
//!
//! Single scattering, height-correlated Smith masking and shadowing, Fresnel factor 1 or
//! `(1 - wo.h)^5`. The integral over visible normals [Heitz 2018] is taken over the
//! spherical cap of [Dupuy and Benyoub 2023], where the integrand is the bounded `G2 / G1`.
use std::f64::consts::PI;

/// Smith's Lambda of GGX, without cancellation for small alpha.
fn lambda(cos_theta: f64, alpha: f64) -> f64 {
    let c2 = (cos_theta * cos_theta).max(1e-300);
    let t = alpha * alpha * (1.0 - c2).max(0.0) / c2;
    0.5 * t / ((1.0 + t).sqrt() + 1.0)
}

/// `(1 - E, E5)`: the share of light from `wo` with cosine `mu` that does not leave after one
/// bounce with Fresnel factor 1, and the share that does with Fresnel factor `(1 - wo.h)^5`.
///
/// The loss is a sum of positive terms, so it keeps its digits where almost nothing is lost.
/// `steps`^2 midpoints; 384 give four digits, 128 three.
pub fn directional_albedo(mu: f64, alpha: f64, steps: usize) -> (f64, f64) {
    let mu = mu.clamp(1e-12, 1.0);
    let sin = (1.0 - mu * mu).max(0.0).sqrt();
    let stretched = (alpha * sin).hypot(mu);
    let (vx, vz) = (alpha * sin / stretched, mu / stretched);
    let lambda_o = lambda(mu, alpha);
    let (mut loss, mut e5) = (0.0, 0.0);
    for i in 0..steps {
        // Graded towards the far end, where GGX's long tail sends light below the horizon.
        let w = 1.0 - (i as f64 + 0.5) / steps as f64;
        let weight = 4.0 * w * w * w;
        let rise = w.powi(4) * (1.0 + vz);
        let z = rise - vz;
        let r = (1.0 - z * z).max(0.0).sqrt();
        for j in 0..steps {
            // Half a turn: the integrand is even in y.
            let (s, c) = (PI * (j as f64 + 0.5) / steps as f64).sin_cos();
            let (hx, hy, hz) = (alpha * (r * c + vx), alpha * r * s, rise);
            let length = (hx * hx + hy * hy + hz * hz).sqrt();
            let (hx, hz) = (hx / length, hz / length);
            let o_dot_h = hx * sin + hz * mu;
            let wi_z = 2.0 * o_dot_h * hz - mu;
            if wi_z > 0.0 {
                let lambda_i = lambda(wi_z, alpha);
                let all = 1.0 + lambda_o + lambda_i;
                loss += weight * lambda_i / all;
                e5 += weight * (1.0 + lambda_o) / all * (1.0 - o_dot_h).max(0.0).powi(5);
            } else {
                loss += weight;
            }
        }
    }
    let n = (steps * steps) as f64;
    (loss / n, e5 / n)
}

/// `(1 - Eavg, E5avg)`: cosine-weighted means over the hemisphere of what
/// [`directional_albedo`] returns.
pub fn mean_albedo(alpha: f64, steps: usize, cosines: usize) -> (f64, f64) {
    let (mut loss, mut e5) = (0.0, 0.0);
    for i in 0..cosines {
        let t = (i as f64 + 0.5) / cosines as f64;
        // Graded towards grazing angles: the loss peaks near mu = alpha.
        let mu = t.powi(6);
        let weight = 2.0 * mu * 6.0 * t.powi(5) / cosines as f64;
        let (a, b) = directional_albedo(mu, alpha, steps);
        loss += a * weight;
        e5 += b * weight;
    }
    (loss, e5)
}
