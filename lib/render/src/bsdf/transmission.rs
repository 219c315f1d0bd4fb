//! Thin-walled transmission (`KHR_materials_transmission` without a volume).
//!
//! A sheet without thickness: light enters and leaves in one point, so it is blurred by the
//! microfacets but not bent. The lobe is that of reflection, mirrored to the other side, with
//! `1 - F` for `F` and tinted by the base colour. Each facet thus splits light into two parts
//! that add up to 1, and both lobes lose the same share by masking, which comes back in the
//! proportion of the mean Fresnel factor: a white sheet absorbs nothing.
use glam::Vec3;

use super::fresnel::schlick_weight;
use super::ggx::Ggx;
use super::metallic_roughness::{Base, BaseSlopes, Facet};
use super::slopes::MaterialSlopes;

/// What the transmitted lobes need beside the reflected ones.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Transmitted {
    /// Tint times the share of light that is offered to transmission.
    pub color: Vec3,
    /// Of the lobe of further bounces, all that does not depend on `wi`.
    pub further: Vec3,
}

impl Base {
    /// Value (cosine included) and density of sampling visible normals, for `wi` below the
    /// surface; delta lobes left out. `sum` is `wo` plus the mirrored `wi`.
    #[inline]
    pub fn transmitted<const F: u32>(&self, wi: Vec3, sum: Vec3) -> (Vec3, f32) {
        let mirrored = Vec3::new(wi.x, wi.y, -wi.z);
        let mut value = self.transmitted.further * (self.energy.loss(mirrored.z) * mirrored.z);
        let mut pdf = 0.0;
        if let Some(ggx) = self.ggx {
            let facet = self.facet::<F>(&ggx, mirrored, sum);
            let v = Ggx::visibility(self.wo.z, self.wo_length, mirrored.z, facet.wi_length);
            let weight = schlick_weight(facet.cosine);
            let passing = 1.0 - self.dielectric_fresnel_at::<F>(weight, facet.cosine);
            value += self.transmitted.color * (passing * facet.d * v * mirrored.z);
            pdf = Ggx::reflection_pdf(facet.d, self.wo.z, self.wo_length);
        }
        (value, pdf)
    }

    /// Derivatives of the value of [`Self::transmitted`].
    pub fn transmitted_slopes(&self, slopes: &BaseSlopes, wi: Vec3, sum: Vec3) -> MaterialSlopes {
        let mirrored = Vec3::new(wi.x, wi.y, -wi.z);
        let (loss, loss_slope) = (
            self.energy.loss(mirrored.z),
            self.energy.loss_slope(mirrored.z),
        );
        let mut result = slopes.transmitted_further.times(loss * mirrored.z);
        result.roughness += self.transmitted.further * (loss_slope * mirrored.z);
        if let Some(ggx) = self.ggx {
            let facet = Facet::new(&ggx, mirrored, sum);
            let v = Ggx::visibility(self.wo.z, self.wo_length, mirrored.z, facet.wi_length);
            let passing = 1.0 - self.dielectric_fresnel(schlick_weight(facet.cosine));
            let lobe = passing * facet.d * v * mirrored.z;
            let log_slope = self.log_lobe_slope(slopes, &ggx, &facet, mirrored, sum);
            result += MaterialSlopes {
                base_color: Vec3::splat(slopes.transmitted_base_color * lobe),
                metallic: slopes.transmitted_metallic * lobe,
                roughness: self.transmitted.color * (lobe * log_slope),
            };
        }
        result
    }
}
