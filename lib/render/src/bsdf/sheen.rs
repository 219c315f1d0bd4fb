//! Sheen (`KHR_materials_sheen`): fibres that stand on the surface and scatter at grazing angles.
//!
//! The distribution of fibres is `D = (2 + 1 / alpha) sin^(1 / alpha) / (2 pi)`, masked and shadowed by
//! `1 / (1 + Lambda(wo) + Lambda(wi))` with a fitted Lambda [Estevez and Kulla 2017]. What lies below is
//! attenuated by `min(1 - c E(wo), 1 - c E(wi))`, with `E` the directional albedo of white sheen and `c` the largest
//! channel of its colour: reciprocal, and never more than sheen lets pass. Where the fit returns more
//! light than it receives, the lobe is divided by the larger albedo of the two directions.
use std::f32::consts::{PI, TAU};
use std::sync::LazyLock;

use glam::{Vec2, Vec3};

use crate::surface::SurfacePoint;

/// Smoothest fibres: four steps of the table of albedos.
const MIN_ROUGHNESS: f32 = 4.0 / CELLS as f32;

/// Least cosine for which the fit is evaluated, one step of the table: below, it exceeds all bounds.
const LEAST_COSINE: f32 = 1.0 / (CELLS * CELLS) as f32;

/// Cells of the table along roughness and along the square root of the cosine.
const CELLS: usize = 32;

/// Directional albedo of white sheen, by roughness, then by cosine; computed where it is first needed.
static ALBEDO: LazyLock<[[f32; CELLS + 1]; CELLS + 1]> = LazyLock::new(|| {
    std::array::from_fn(|row| {
        let fibres = Fibres::new(row as f32 / CELLS as f32);
        std::array::from_fn(|column| fibres.albedo((column as f32 / CELLS as f32).powi(2)))
    })
});

/// The scattering of white sheen of one roughness.
#[derive(Clone, Copy, Debug)]
struct Fibres {
    inverse_alpha: f32,
    /// Parameters of the fit of Lambda.
    fit: [f32; 5],
}

impl Fibres {
    fn new(roughness: f32) -> Self {
        let roughness = roughness.max(MIN_ROUGHNESS);
        let alpha = roughness * roughness;
        // Fitted at alpha 0 and 1 [Estevez and Kulla 2017, table 1].
        let smooth = [25.3245, 3.32435, 0.16801, -1.27393, -4.85967];
        let rough = [21.5473, 3.82987, 0.19823, -1.97760, -4.32054];
        let t = (1.0 - alpha) * (1.0 - alpha);
        Self {
            inverse_alpha: 1.0 / alpha,
            fit: std::array::from_fn(|k| rough[k] + (smooth[k] - rough[k]) * t),
        }
    }

    fn lambda(&self, cosine: f32) -> f32 {
        let [a, b, c, d, e] = self.fit;
        let l = |x: f32| a / (1.0 + b * x.powf(c)) + d * x + e;
        match cosine < 0.5 {
            true => l(cosine).exp(),
            // The cosine of rounded unit vectors may exceed 1, and a negative number has no power.
            false => (2.0 * l(0.5) - l((1.0 - cosine).max(0.0))).exp(),
        }
    }

    /// Density of half vectors whose squared sine is `sin2`.
    fn d(&self, sin2: f32) -> f32 {
        (2.0 + self.inverse_alpha) * sin2.powf(0.5 * self.inverse_alpha) / TAU
    }

    /// Albedo by midpoints over the hemisphere.
    fn albedo(&self, cosine: f32) -> f32 {
        const STEPS: usize = 64;
        let wo_z = cosine.max(LEAST_COSINE);
        let wo = Vec3::new((1.0 - wo_z * wo_z).sqrt(), 0.0, wo_z);
        let lambda_o = self.lambda(wo_z);
        let mut sum = 0.0;
        for i in 0..STEPS {
            // More steps towards the horizon, where sheen is.
            let t = (i as f32 + 0.5) / STEPS as f32;
            let (z, dz) = (t * t, 2.0 * t / STEPS as f32);
            let r = (1.0 - z * z).sqrt();
            let clamped = z.max(LEAST_COSINE);
            let masked = 1.0 + lambda_o + self.lambda(clamped);
            for j in 0..STEPS {
                let angle = (j as f32 + 0.5) / STEPS as f32 * PI;
                let h = (wo + Vec3::new(r * angle.cos(), r * angle.sin(), z)).normalize();
                let sin2 = h.x * h.x + h.y * h.y;
                let value = self.d(sin2) / (4.0 * wo_z * masked) * (z / clamped);
                sum += value * dz * (TAU / STEPS as f32);
            }
        }
        sum
    }
}

/// The sheen of a surface for one `wo`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sheen {
    color: Vec3,
    strongest: f32,
    fibres: Fibres,
    row: f32,
    wo_z: f32,
    lambda_o: f32,
    /// Albedo of white sheen towards `wo`.
    albedo_o: f32,
    /// Share of light that passes to what lies below.
    pub passing_o: f32,
}

impl Sheen {
    /// `None` without sheen. `wo_z` is the positive cosine of the viewer.
    pub fn new(surface: &SurfacePoint, wo_z: f32) -> Option<Self> {
        let color = surface.extension.sheen_color;
        if color == Vec3::ZERO {
            return None;
        }
        let fibres = Fibres::new(surface.extension.sheen_roughness);
        let wo_z = wo_z.max(LEAST_COSINE);
        let mut sheen = Self {
            color,
            strongest: color.max_element(),
            fibres,
            row: surface.extension.sheen_roughness.max(MIN_ROUGHNESS) * CELLS as f32,
            wo_z,
            lambda_o: fibres.lambda(wo_z),
            albedo_o: 0.0,
            passing_o: 1.0,
        };
        sheen.albedo_o = sheen.white_albedo(wo_z);
        sheen.passing_o = sheen.passing(wo_z);
        Some(sheen)
    }

    /// Directional albedo.
    pub fn albedo(&self) -> Vec3 {
        self.color * self.albedo_o.min(1.0)
    }

    fn white_albedo(&self, cosine: f32) -> f32 {
        let cell = |p: f32| {
            let i = (p as usize).min(CELLS - 1);
            (i, p - i as f32)
        };
        let (row, fy) = cell(self.row);
        let (column, fx) = cell(cosine.clamp(0.0, 1.0).sqrt() * CELLS as f32);
        let along = |row: usize| {
            let [a, b] = [ALBEDO[row][column], ALBEDO[row][column + 1]];
            a + (b - a) * fx
        };
        let [a, b] = [along(row), along(row + 1)];
        a + (b - a) * fy
    }

    fn passing(&self, cosine: f32) -> f32 {
        1.0 - self.strongest * self.white_albedo(cosine).min(1.0)
    }

    /// Attenuation of what lies below at a `wi` with the positive `cosine`.
    #[inline]
    pub fn over(&self, cosine: f32) -> f32 {
        self.passing(cosine).min(self.passing_o)
    }

    /// Value, cosine included, at `wi` above the surface; `sum` is `wo + wi`.
    #[inline]
    pub fn value(&self, wi_z: f32, sum: Vec3) -> Vec3 {
        let h = sum.normalize();
        let clamped = wi_z.max(LEAST_COSINE);
        let masked = 1.0 + self.lambda_o + self.fibres.lambda(clamped);
        let most = self.albedo_o.max(self.white_albedo(wi_z)).max(1.0);
        let d = self.fibres.d(h.x * h.x + h.y * h.y);
        self.color * (d / (4.0 * self.wo_z * masked * most) * (wi_z / clamped))
    }

    /// Density per steradian of [`sample`](Self::sample).
    pub const PDF: f32 = 1.0 / TAU;

    /// A uniform direction of the hemisphere.
    #[inline]
    pub fn sample(u: Vec2) -> Vec3 {
        let z = u.x.max(1e-7);
        let r = ((1.0 - z) * (1.0 + z)).sqrt();
        let (s, c) = (TAU * u.y).sin_cos();
        Vec3::new(r * c, r * s, z)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    #[test]
    fn the_distribution_of_fibres_projects_to_one() {
        // D cos over the hemisphere: 2 pi (2 + n) / (2 pi) int sin^(n + 1) cos = 1, n = 1 / alpha.
        for roughness in [0.2, 0.5, 1.0] {
            let fibres = Fibres::new(roughness);
            let n = 20_000;
            let sum: f64 = (0..n)
                .map(|k| {
                    // Of u = sin^2: int f sin cos = 1/2 int f du.
                    let sin2 = (k as f32 + 0.5) / n as f32;
                    f64::from(fibres.d(sin2)) * std::f64::consts::PI / f64::from(n)
                })
                .sum();
            assert!((sum - 1.0).abs() < 1e-3, "{roughness}: {sum}");
        }
    }

    #[test]
    fn the_table_of_albedos_is_what_quadrature_says_between_its_nodes() {
        let mut surface = SurfacePoint::facing(Vec3::Z);
        surface.extension.sheen_color = Vec3::ONE;
        for roughness in [0.16, 0.41, 0.72, 0.97] {
            surface.extension.sheen_roughness = roughness;
            for cosine in [0.02f32, 0.2, 0.55, 0.93] {
                let sheen = Sheen::new(&surface, cosine).unwrap();
                let exact = Fibres::new(roughness).albedo(cosine);
                // Linear in cells of a thirty-second.
                let error = (sheen.albedo_o - exact).abs();
                assert!(
                    error < 0.01,
                    "{roughness} {cosine}: {} {exact}",
                    sheen.albedo_o
                );
            }
        }
    }

    /// White sheen without the cosine of `wi`, in f64 [Estevez and Kulla 2017, eq. 2 to 4].
    pub fn textbook(roughness: f64, wo: glam::DVec3, wi: glam::DVec3) -> f64 {
        let alpha = roughness * roughness;
        let t = (1.0 - alpha).powi(2);
        let mix = |smooth: f64, rough: f64| t * smooth + (1.0 - t) * rough;
        let (a, b) = (mix(25.3245, 21.5473), mix(3.32435, 3.82987));
        let (c, d) = (mix(0.16801, 0.19823), mix(-1.27393, -1.97760));
        let e = mix(-4.85967, -4.32054);
        let l = |x: f64| a / (1.0 + b * x.powf(c)) + d * x + e;
        let lambda = |x: f64| match x < 0.5 {
            true => l(x).exp(),
            false => (2.0 * l(0.5) - l(1.0 - x)).exp(),
        };
        let h = (wo + wi).normalize();
        let sine = (1.0 - h.z * h.z).max(0.0).sqrt();
        let fibres = (2.0 + 1.0 / alpha) * sine.powf(1.0 / alpha) / std::f64::consts::TAU;
        fibres / ((1.0 + lambda(wo.z) + lambda(wi.z)) * 4.0 * wo.z * wi.z)
    }

    fn towards(cosine: f64, angle: f64) -> glam::DVec3 {
        let r = (1.0 - cosine * cosine).sqrt();
        glam::DVec3::new(r * angle.cos(), r * angle.sin(), cosine)
    }

    #[test]
    fn white_sheen_equals_the_textbook_in_f64() {
        let mut surface = SurfacePoint::facing(Vec3::Z);
        surface.extension.sheen_color = Vec3::ONE;
        for roughness in [0.2f32, 0.5, 1.0] {
            surface.extension.sheen_roughness = roughness;
            for (o, i, angle) in [(0.9, 0.6, 2.0), (0.5, 0.3, 0.7), (0.35, 0.8, 3.1)] {
                let (wo, wi) = (towards(o, 0.0), towards(i, angle));
                let sheen = Sheen::new(&surface, wo.z as f32).unwrap();
                let got = sheen.value(wi.z as f32, (wo + wi).as_vec3()).x;
                // Where the fit returns no more than it receives, nothing is divided.
                let exact = textbook(roughness.into(), wo, wi) * wi.z;
                let error = (f64::from(got) / exact - 1.0).abs();
                // The sine of the half vector, to 2^-24, is raised to up to the 25th power.
                assert!(error < 1e-4, "{roughness} {o} {i}: {got} {exact}");
            }
        }
    }

    #[test]
    fn its_directional_albedo_is_the_textbooks_integral_in_f64() {
        for roughness in [0.3f32, 0.6, 1.0] {
            for cosine in [0.15f64, 0.5, 0.9] {
                let wo = towards(cosine, 0.0);
                let n = 400;
                let mut exact = 0.0;
                for k in 0..n {
                    let t = (k as f64 + 0.5) / n as f64;
                    let (z, dz) = (t * t, 2.0 * t / n as f64);
                    for j in 0..n {
                        let angle = (j as f64 + 0.5) / n as f64 * std::f64::consts::TAU;
                        let value = textbook(roughness.into(), wo, towards(z, angle)) * z;
                        exact += value * dz * std::f64::consts::TAU / n as f64;
                    }
                }
                let got = f64::from(Fibres::new(roughness).albedo(cosine as f32));
                // 64 midpoints a side for a function that is smooth but at the horizon.
                assert!(
                    (got - exact).abs() < 3e-3,
                    "{roughness} {cosine}: {got} {exact}"
                );
            }
        }
    }
}
