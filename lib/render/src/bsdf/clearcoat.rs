//! The clearcoat (`KHR_materials_clearcoat`): a colourless dielectric layer with index 1.5.
//!
//! Below a coat with directional albedo `C(w)`, lobes are attenuated by
//! - `min(1 - C(wo), 1 - C(wi))` where they are specular or transmitted: reciprocal, exact for
//!   smooth layers, and never more than the coat lets through towards `wo`;
//! - `(1 - C(wo)) (1 - C(wi))` over its mean where they are diffuse, so that a white diffuse
//!   base stays white. With a normal of its own the coat's mean over the base's hemisphere is
//!   unknown and the minimum is used there too.
//!
//! The specification's one-sided factor `1 - C(wo)` is not reciprocal.
use std::cell::Cell;
use std::f32::consts::FRAC_1_PI;

use dipir_numerics::warp::Frame;
use glam::Vec3;

use super::energy::LobeEnergy;
use super::fresnel::schlick_weight;
use super::ggx::Ggx;
use super::metallic_roughness::{Base, BaseSlopes, Facet};
use crate::surface::CoatPoint;

/// Reflectance of the coat at normal incidence: index of refraction 1.5.
const F0: f32 = 0.04;

/// Nodes and weights on [0, 1] of Gauss and Legendre's rule with six points.
pub(super) const GAUSS: [(f32, f32); 6] = [
    (0.033_765_243, 0.085_662_25),
    (0.169_395_31, 0.180_380_79),
    (0.380_690_41, 0.233_956_97),
    (0.619_309_59, 0.233_956_97),
    (0.830_604_69, 0.180_380_79),
    (0.966_234_76, 0.085_662_25),
];

/// Share of the light from below, emission for one, that passes the coat at `point` towards the unit
/// vector `wo`, in world space: `1 - C(wo)`.
pub(crate) fn passing_coat(point: &CoatPoint, wo: Vec3) -> f32 {
    if point.factor <= 0.0 {
        return 1.0;
    }
    let energy = LobeEnergy::new(point.roughness);
    let cosine = point.normal.dot(wo).clamp(0.0, 1.0);
    left_by(&energy, energy.further_fresnel(F0), point.factor, cosine)
}

/// `1 - C` at a cosine to the coat's normal.
#[inline]
fn left_by(energy: &LobeEnergy, further_fresnel: f32, factor: f32, cosine: f32) -> f32 {
    let (loss, share) = (energy.loss(cosine), energy.share(cosine));
    let fresnel = F0 + (1.0 - F0) * share;
    1.0 - factor * (fresnel * (1.0 - loss) + further_fresnel * loss)
}

/// A coat for one `wo`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Coat {
    pub frame: Frame,
    /// In the coat's frame.
    pub wo: Vec3,
    pub wo_length: f32,
    /// `None` for a mirror.
    pub ggx: Option<Ggx>,
    /// Weight of the layer where it attenuates, and where it is seen.
    factor: f32,
    shown: f32,
    pub energy: LobeEnergy,
    further_fresnel: f32,
    further: f32,
    /// `1 - C(wo)`.
    pub passing_o: f32,
    /// Multiplies the diffuse lobe below instead of a minimum, if positive.
    diffuse: f32,
    /// Directional albedo of the lobe of visible normals and of that of further bounces.
    pub albedo: [f32; 2],
}

/// All that [`Coat::diffuse_coupling`] depends on.
#[derive(Clone, Copy, PartialEq)]
struct Layers {
    base: LobeEnergy,
    /// Of the base: at normal and at grazing incidence, and of further bounces.
    fresnel: [f32; 3],
    coat: LobeEnergy,
    factor: f32,
}

/// Values (cosine included) and densities of the coat's lobes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CoatReflected {
    pub value: f32,
    pub specular_pdf: f32,
    pub further_pdf: f32,
}

impl Coat {
    /// `None` where there is no coat. `wo` is in world space.
    pub fn new(point: &CoatPoint, wo: Vec3, base: &Base) -> Option<Self> {
        if point.factor <= 0.0 {
            return None;
        }
        let frame = Frame::from_normal(point.normal);
        let wo = frame.to_local(wo);
        let seen = wo.z > 0.0;
        let wo = Vec3::new(wo.x, wo.y, wo.z.max(1e-7));
        let ggx = Ggx::new(point.roughness);
        let energy = LobeEnergy::new(point.roughness);
        let further_fresnel = energy.further_fresnel(F0);
        let (loss, share) = (energy.loss(wo.z), energy.share(wo.z));
        let mut coat = Self {
            frame,
            wo,
            wo_length: ggx.map_or(wo.z, |g| g.stretched_length(wo)),
            ggx,
            factor: point.factor,
            shown: point.factor,
            energy,
            further_fresnel,
            further: further_fresnel * loss * energy.inverse_mean_loss() * FRAC_1_PI,
            passing_o: 1.0,
            diffuse: 0.0,
            albedo: [
                (F0 + (1.0 - F0) * share) * (1.0 - loss) * point.factor,
                further_fresnel * loss * point.factor,
            ],
        };
        coat.passing_o = coat.passing(wo.z);
        if !point.own_normal {
            coat.diffuse = coat.passing_o * coat.diffuse_coupling(base);
        }
        if !seen {
            // Rounding, or an unbent normal: the coat attenuates but shows nothing.
            coat.albedo = [0.0; 2];
            coat.shown = 0.0;
        }
        Some(coat)
    }

    /// `1 - C` at a cosine to the coat's normal.
    #[inline]
    pub fn passing(&self, cosine: f32) -> f32 {
        left_by(&self.energy, self.further_fresnel, self.factor, cosine)
    }

    /// What keeps a white diffuse base white below the coat: the base's mean passing light
    /// over the mean of what passes both. It depends on the material alone, and neighbouring
    /// paths meet the same one: the last is kept.
    fn diffuse_coupling(&self, base: &Base) -> f32 {
        thread_local! {
            static LAST: Cell<Option<(Layers, f32)>> = const { Cell::new(None) };
        }
        let layers = Layers {
            base: base.energy,
            fresnel: [base.f0_dielectric, base.f90, base.further_dielectric],
            coat: self.energy,
            factor: self.factor,
        };
        match LAST.get() {
            Some((last, coupling)) if last == layers => coupling,
            _ => {
                let coupling = self.integrate_coupling(base);
                LAST.set(Some((layers, coupling)));
                coupling
            }
        }
    }

    fn integrate_coupling(&self, base: &Base) -> f32 {
        let (mut one, mut both) = (0.0, 0.0);
        for (mu, weight) in GAUSS {
            let (loss, share) = (base.energy.loss(mu), base.energy.share(mu));
            let left = weight * mu * (1.0 - base.dielectric_albedo(loss, share));
            one += left;
            both += left * self.passing(mu);
        }
        one / both
    }

    /// Logarithmic derivative of [`Self::over_diffuse`] with respect to the roughness of the base.
    pub fn log_over_diffuse_slope(&self, base: &Base, slopes: &BaseSlopes) -> f32 {
        if self.diffuse <= 0.0 {
            return 0.0;
        }
        let (mut one, mut both) = (0.0, 0.0);
        let (mut one_slope, mut both_slope) = (0.0, 0.0);
        for (mu, weight) in GAUSS {
            let (loss, share) = (base.energy.loss(mu), base.energy.share(mu));
            let left = weight * mu * (1.0 - base.dielectric_albedo(loss, share));
            let slope = -weight
                * mu
                * base.dielectric_albedo_slope(
                    slopes,
                    (loss, base.energy.loss_slope(mu)),
                    (share, base.energy.share_slope(mu)),
                );
            let passing = self.passing(mu);
            one += left;
            both += left * passing;
            one_slope += slope;
            both_slope += slope * passing;
        }
        one_slope / one - both_slope / both
    }

    /// Attenuation of specular and transmitted lobes below at a `wi` with `passing`.
    #[inline]
    pub fn over_specular(&self, passing: f32) -> f32 {
        passing.min(self.passing_o)
    }

    /// Attenuation of the diffuse lobe below at a `wi` with `passing`.
    #[inline]
    pub fn over_diffuse(&self, passing: f32) -> f32 {
        if self.diffuse > 0.0 {
            passing * self.diffuse
        } else {
            passing.min(self.passing_o)
        }
    }

    /// The coat's lobes at `wi` in its frame, above it; delta lobes left out.
    /// `sum` is `wo + wi` in that frame.
    #[inline]
    pub fn reflected(&self, wi: Vec3, sum: Vec3) -> CoatReflected {
        let mut value = self.further * self.energy.loss(wi.z);
        let mut specular_pdf = 0.0;
        if let Some(ggx) = self.ggx {
            let facet = Facet::new(&ggx, wi, sum);
            let fresnel = F0 + (1.0 - F0) * schlick_weight(facet.cosine);
            let v = Ggx::visibility(self.wo.z, self.wo_length, wi.z, facet.wi_length);
            value += fresnel * facet.d * v;
            specular_pdf = Ggx::reflection_pdf(facet.d, self.wo.z, self.wo_length);
        }
        CoatReflected {
            value: self.shown * value * wi.z,
            specular_pdf,
            further_pdf: self.energy.further_pdf(wi.z),
        }
    }
}
