//! Derivatives of scattering with respect to the material.
//!
//! **What is differentiated** is the value for fixed directions: how a direction is drawn, its
//! density and the weights between techniques are constants ("detached" sampling), which leaves
//! a path's estimate of the derivative unbiased as long as its value is unbiased for every
//! material near by.
//!
//! **What is not**: a roughness below [`Ggx::MIN_ROUGHNESS`](super::ggx::Ggx::MIN_ROUGHNESS) is a
//! mirror, whose value does not depend on it: that derivative is 0. Index of refraction, coat and
//! share of transmission are constants, and the mask `PLAIN_GGX`, which is for validation, has
//! no derivatives.
use std::ops::AddAssign;

use dipir_numerics::warp::Frame;
use glam::Vec3;

use super::features::{TRANSMISSION, has};
use super::fresnel::schlick_weight;
use super::metallic_roughness::BaseSlopes;
use super::{Bsdf, BsdfSample, Technique};
use crate::surface::SurfacePoint;

/// Derivatives of an RGB value. Channel c of `base_color` is the derivative of channel c of the
/// value with respect to channel c of the base colour: the channels do not mix.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MaterialSlopes {
    /// With respect to the linear base colour.
    pub base_color: Vec3,
    /// With respect to the metalness.
    pub metallic: Vec3,
    /// With respect to the perceptual roughness.
    pub roughness: Vec3,
}

impl MaterialSlopes {
    /// Of what does not depend on the material.
    pub const ZERO: Self = Self {
        base_color: Vec3::ZERO,
        metallic: Vec3::ZERO,
        roughness: Vec3::ZERO,
    };

    /// Of the value times `factor`.
    #[inline]
    pub fn times(self, factor: f32) -> Self {
        self.tinted(Vec3::splat(factor))
    }

    /// Of the value times `factor`, a channel at a time.
    #[inline]
    pub fn tinted(self, factor: Vec3) -> Self {
        Self {
            base_color: self.base_color * factor,
            metallic: self.metallic * factor,
            roughness: self.roughness * factor,
        }
    }
}

impl AddAssign for MaterialSlopes {
    fn add_assign(&mut self, other: Self) {
        self.base_color += other.base_color;
        self.metallic += other.metallic;
        self.roughness += other.roughness;
    }
}

/// The derivatives of a [`Bsdf`] for one `wo`.
#[derive(Clone, Copy, Debug)]
pub struct BsdfSlopes<const F: u32> {
    bsdf: Bsdf<F>,
    base: BaseSlopes,
    /// Logarithmic derivative of the coat's attenuation of the diffuse lobe.
    coat_over_diffuse: f32,
}

impl<const F: u32> BsdfSlopes<F> {
    /// For a `bsdf` that was made for `surface`.
    pub fn new(bsdf: &Bsdf<F>, surface: &SurfacePoint) -> Self {
        let base = bsdf.base.slopes::<F>(surface);
        let coat = bsdf.coat.as_ref();
        Self {
            coat_over_diffuse: coat.map_or(0.0, |c| c.log_over_diffuse_slope(&bsdf.base, &base)),
            base,
            bsdf: *bsdf,
        }
    }

    /// Derivatives of [`Bsdf::eval`].
    pub fn eval(&self, wi: Vec3) -> MaterialSlopes {
        let bsdf = &self.bsdf;
        let local = bsdf.frame.to_local(wi);
        let side = wi.dot(bsdf.geometric_normal);
        let [diffuse, specular, _, transmit, ..] = bsdf.chances;
        // As in `Bsdf::eval_pdf`.
        let sum = bsdf.wo + wi;
        let half = |frame: &Frame, height: f32| {
            Vec3::new(frame.tangent.dot(sum), frame.bitangent.dot(sum), height)
        };
        if side > 0.0 && local.z > 0.0 && diffuse + specular > 0.0 {
            let sum = half(&bsdf.frame, bsdf.base.wo.z + local.z);
            let (specular, diffuse) = bsdf.base.reflected_slopes::<F>(&self.base, local, sum);
            let Some((coat, _, passing)) = bsdf.coat_at(wi) else {
                let mut all = specular;
                all += diffuse;
                return all;
            };
            let over_diffuse = coat.over_diffuse(passing);
            let mut all = specular.times(coat.over_specular(passing));
            all += diffuse.times(over_diffuse);
            let below = bsdf.base.reflected::<F>(local, sum).diffuse;
            all.roughness += below * (over_diffuse * self.coat_over_diffuse);
            all
        } else if has(F, TRANSMISSION) && transmit > 0.0 && local.z < 0.0 && side < 0.0 {
            let sum = half(&bsdf.frame, bsdf.base.wo.z - local.z);
            let passing = bsdf.coat_at(wi).map_or(1.0, |(c, _, p)| c.over_specular(p));
            let slopes = bsdf.base.transmitted_slopes(&self.base, local, sum);
            slopes.times(passing)
        } else {
            MaterialSlopes::ZERO
        }
    }

    /// Derivatives of the weight of a `sample` that was drawn with the number `u_lobe`.
    pub fn weight(&self, u_lobe: f32, sample: &BsdfSample) -> MaterialSlopes {
        if !sample.delta {
            return self.eval(sample.wi).times(1.0 / sample.pdf);
        }
        let bsdf = &self.bsdf;
        let fresnel = schlick_weight(bsdf.base.wo.z);
        let (slopes, chance) = match bsdf.choose(u_lobe) {
            Some(Technique::Specular) => (
                bsdf.base.mirror_slopes(&self.base, fresnel),
                bsdf.chances[1],
            ),
            Some(Technique::Transmit) => {
                let passing = 1.0 - bsdf.base.dielectric_fresnel(fresnel);
                let slopes = MaterialSlopes {
                    base_color: Vec3::splat(self.base.transmitted_base_color * passing),
                    metallic: self.base.transmitted_metallic * passing,
                    roughness: Vec3::ZERO,
                };
                (slopes, bsdf.chances[3])
            }
            _ => return MaterialSlopes::ZERO,
        };
        let attenuation = bsdf
            .coat_at(sample.wi)
            .map_or(1.0, |(c, _, p)| c.over_specular(p));
        slopes.times(attenuation / chance)
    }
}

#[cfg(test)]
#[path = "slopes_tests.rs"]
mod tests;
