//! The scattering model once more, in f64 and as its equations are written: what derivatives are
//! compared with. It shares the energy table with the kernels, and nothing else.
use std::f64::consts::PI;

use glam::DVec3;

use super::energy::{LOSS_SCALE, MEAN_SCHLICK, SHARE_SCALE, grid};
use super::energy_table::{
    LOSS, LOSS_COLUMNS, LOSS_ROWS, MEAN_LOSS, MEAN_ROWS, MEAN_SHARE, SHARE, SHARE_COLUMNS,
    SHARE_ROWS,
};

/// A material and its layers in f64.
#[derive(Clone, Copy, Debug)]
pub struct Reference {
    /// Base colour of one channel, linear.
    pub color: f64,
    /// Metalness.
    pub metallic: f64,
    /// Perceptual.
    pub roughness: f64,
    /// Share of light that passes instead of being diffusely reflected.
    pub passing: f64,
    /// Factor and perceptual roughness of a coat.
    pub coat: Option<(f64, f64)>,
    /// Whether there is a specular lobe at all.
    pub glossy: bool,
}

fn cell(x: f64, cells: usize) -> (usize, f64) {
    let p = x * cells as f64;
    let i = (p as usize).min(cells - 1);
    (i, p - i as f64)
}

fn bilinear<const W: usize, const H: usize>(
    table: &[[u16; W]; H],
    (row, fy): (usize, f64),
    (column, fx): (usize, f64),
) -> f64 {
    let at = |y: usize| {
        let (a, b) = (f64::from(table[y][column]), f64::from(table[y][column + 1]));
        a + (b - a) * fx
    };
    at(row) + (at(row + 1) - at(row)) * fy
}

/// The energy table in f64 at one roughness.
struct Energy(f64);

impl Energy {
    fn loss(&self, mu: f64) -> f64 {
        let alpha = self.0 * self.0;
        let ratio = mu / alpha;
        let octave = ratio.log2().floor();
        let column = octave + ratio / octave.exp2() - 1.0 - f64::from(grid::LOSS_FIRST_OCTAVE);
        let x = (column * grid::LOSS_PER_OCTAVE as f64).clamp(0.0, (LOSS_COLUMNS - 1) as f64);
        let i = (x as usize).min(LOSS_COLUMNS - 2);
        let q = bilinear(&LOSS, cell(self.0, LOSS_ROWS - 1), (i, x - i as f64));
        q * f64::from(LOSS_SCALE) * grid::loss_shape(mu, alpha)
    }

    fn share(&self, mu: f64) -> f64 {
        let column = cell(mu.min(1.0).sqrt(), SHARE_COLUMNS - 1);
        bilinear(&SHARE, cell(self.0, SHARE_ROWS - 1), column) * f64::from(SHARE_SCALE)
    }

    fn mean(&self, table: &[f32; MEAN_ROWS]) -> f64 {
        let (i, f) = cell(self.0, MEAN_ROWS - 1);
        let (a, b) = (f64::from(table[i]), f64::from(table[i + 1]));
        a + (b - a) * f
    }

    fn mean_loss(&self) -> f64 {
        self.0.powi(4) * self.mean(&MEAN_LOSS)
    }

    fn further_fresnel(&self, f0: f64) -> f64 {
        let mean = f0 + (1.0 - f0) * f64::from(MEAN_SCHLICK);
        mean * mean * (1.0 - self.mean_loss()) / (1.0 - mean * self.mean_loss())
    }

    /// All that an interface with `f0` reflects, and its mean.
    fn albedo(&self, f0: f64, mu: f64) -> f64 {
        let (loss, share) = (self.loss(mu), self.share(mu));
        (f0 + (1.0 - f0) * share) * (1.0 - loss) + self.further_fresnel(f0) * loss
    }

    fn mean_albedo(&self, f0: f64) -> f64 {
        let loss = self.mean_loss();
        f0 * (1.0 - loss) + (1.0 - f0) * self.mean(&MEAN_SHARE) + self.further_fresnel(f0) * loss
    }
}

impl Reference {
    /// Value without the coat's own lobes, which do not depend on the base; the normal is z.
    /// The index of refraction is 1.5.
    pub fn eval(&self, wo: DVec3, wi: DVec3) -> f64 {
        let (c, m, f0d) = (self.color, self.metallic, 0.04);
        let cos = wi.z.abs();
        let above = wi.z > 0.0;
        let wi = DVec3::new(wi.x, wi.y, cos);
        let energy = Energy(self.roughness);
        let alpha2 = self.roughness.powi(4);
        let h = (wo + wi).normalize();
        let schlick = |f0: f64, w: f64| f0 + (1.0 - f0) * w;
        let weight = (1.0 - wo.dot(h).min(1.0)).powi(5);
        let tan2 = |w: DVec3| w.truncate().length_squared() / (w.z * w.z);
        let lambda = |w: DVec3| 0.5 * ((1.0 + alpha2 * tan2(w)).sqrt() - 1.0);
        let d = 1.0 / (PI * alpha2 * h.z.powi(4) * (1.0 + tan2(h) / alpha2).powi(2));
        let lobe = d / (4.0 * wo.z * wi.z) / (1.0 + lambda(wo) + lambda(wi)) * cos;
        let broad = energy.loss(wo.z) * energy.loss(wi.z) / (PI * energy.mean_loss()) * cos;
        let further = energy.further_fresnel(f0d);
        let coat = |mu: f64| match self.coat {
            Some((factor, roughness)) => 1.0 - factor * Energy(roughness).albedo(0.04, mu),
            None => 1.0,
        };
        let over_specular = coat(wo.z).min(coat(wi.z));
        if !above {
            let color = c * (1.0 - m) * self.passing;
            let through = (1.0 - schlick(f0d, weight)) * lobe + (1.0 - further) * broad;
            return color * through * over_specular;
        }
        let diffuse_color = c * (1.0 - m) * (1.0 - self.passing);
        if !self.glossy {
            return diffuse_color * cos / PI;
        }
        let f0 = f0d + (c - f0d) * m;
        let metal = energy.further_fresnel(c);
        let specular = schlick(f0, weight) * lobe + (further + (metal - further) * m) * broad;
        let left = |mu: f64| 1.0 - energy.albedo(f0d, mu);
        let diffuse =
            diffuse_color * left(wo.z) * left(wi.z) * cos / (PI * (1.0 - energy.mean_albedo(f0d)));
        let over_diffuse = match self.coat {
            None => 1.0,
            Some(_) => {
                let (mut one, mut both) = (0.0, 0.0);
                for (mu, w) in super::clearcoat::GAUSS {
                    let (mu, w) = (f64::from(mu), f64::from(w));
                    one += w * mu * left(mu);
                    both += w * mu * left(mu) * coat(mu);
                }
                coat(wo.z) * coat(wi.z) * one / both
            }
        };
        specular * over_specular + diffuse * over_diffuse
    }
}
