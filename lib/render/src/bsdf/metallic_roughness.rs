//! The glTF 2.0 metallic-roughness base: a GGX lobe over a Lambertian or transmissive
//! dielectric, mixed with a metal.
//!
//! Appendix B of the specification couples the diffuse lobe by `1 - F(wo.h)`, which neither
//! keeps energy nor is meant to: it allows any coupling that does. Here:
//! - the specular lobe gets back what single scattering loses, as a broad lobe
//!   `(1 - E(wo)) (1 - E(wi)) / (pi (1 - Eavg))` times the mean Fresnel factor of further
//!   bounces [Kulla and Conty 2017];
//! - the diffuse lobe gets what the *whole* specular lobe of the dielectric leaves over, in
//!   the same reciprocal form `(1 - Ed(wo)) (1 - Ed(wi)) / (pi (1 - Ed_avg))`
//!   [Kelemen and Szirmay-Kalos 2001].
//!
//! So a white base returns all light at any roughness, metalness and angle, up to the
//! interpolation of the energy table, and every lobe is reciprocal.
use std::f32::consts::FRAC_1_PI;

use glam::{Vec2, Vec3};

use super::energy::LobeEnergy;
use super::extended::Interface;
use super::features::{EXTENSIONS, PLAIN_GGX, SPECULAR, TRANSMISSION, has};
use super::fresnel::{f0_from_ior, schlick, schlick_weight};
use super::ggx::Ggx;
use super::lambert;
use super::slopes::MaterialSlopes;
use super::transmission::Transmitted;
use crate::surface::SurfacePoint;

/// The least cosine of `wo`: where rounding puts it at or below the horizon, it grazes.
const MIN_COSINE: f32 = 1e-7;

/// The cosine whose Schlick weight is `share`, the mean one of facets.
#[inline]
fn mean_cosine(share: f32) -> f32 {
    1.0 - share.max(0.0).powf(0.2)
}

/// The base for one `wo`, in the frame of the shading normal.
#[derive(Clone, Copy, Debug)]
pub(super) struct Base {
    /// Towards the viewer.
    pub wo: Vec3,
    /// Its length with the tangential part scaled by alpha.
    pub wo_length: f32,
    /// `None` for a mirror.
    pub ggx: Option<Ggx>,
    pub energy: LobeEnergy,
    /// Reflectance at normal incidence, dielectric and metal mixed.
    pub f0: Vec3,
    /// The dielectric's part of that.
    pub f0_dielectric: f32,
    /// Reflectance at grazing incidence: 0 where the interface is left out, else 1.
    pub f90: f32,
    /// Mean Fresnel factor of the dielectric's further bounces.
    pub further_dielectric: f32,
    /// Of the lobe of further bounces, all that does not depend on `wi`.
    pub further: Vec3,
    /// Of the diffuse lobe, all that does not depend on `wi`.
    pub diffuse: Vec3,
    /// The transmitted lobes.
    pub transmitted: Transmitted,
    /// Directional albedo of the lobes at `wo`.
    pub albedo: BaseAlbedo,
    /// What extensions change.
    pub interface: Interface,
}

/// How much light each lobe returns towards `wo` from a white sky.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BaseAlbedo {
    pub specular: Vec3,
    pub further: Vec3,
    pub diffuse: Vec3,
    pub transmitted: Vec3,
    pub transmitted_further: Vec3,
}

/// Values (cosine included) and densities of the reflecting lobes at one `wi`.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Reflected {
    /// Single and further scattering at the interface.
    pub specular: Vec3,
    pub diffuse: Vec3,
    /// Density of sampling visible normals.
    pub specular_pdf: f32,
    /// Density of sampling the cosine.
    pub cosine_pdf: f32,
    /// Density of sampling further bounces.
    pub further_pdf: f32,
}

impl Base {
    pub fn new<const F: u32>(surface: &SurfacePoint, wo: Vec3) -> Self {
        let glossy = has(F, SPECULAR);
        let plain = has(F, PLAIN_GGX);
        let transmissive = has(F, TRANSMISSION);
        let wo = Vec3::new(wo.x, wo.y, wo.z.max(MIN_COSINE));
        let (color, metallic) = (surface.base_color, surface.metallic);
        let passing = if transmissive {
            surface.transmission
        } else {
            0.0
        };
        let diffuse_color = color * ((1.0 - metallic) * (1.0 - passing));
        if !(glossy || transmissive && passing > 0.0) {
            return Self::lambertian(wo, diffuse_color);
        }

        if has(F, EXTENSIONS) && glossy {
            return Self::extended::<F>(surface, wo, diffuse_color, passing);
        }

        let energy = LobeEnergy::new(surface.roughness);
        let ggx = Ggx::new(surface.roughness);
        let f0_dielectric = if glossy {
            f0_from_ior(surface.ior)
        } else {
            0.0
        };
        let f0 = Vec3::splat(f0_dielectric).lerp(color, metallic) * f32::from(glossy);
        let (loss, share) = (energy.loss(wo.z), energy.share(wo.z));
        let mut base = Self {
            wo,
            wo_length: ggx.map_or(wo.z, |g| g.stretched_length(wo)),
            ggx,
            energy,
            f0,
            f0_dielectric,
            f90: f32::from(glossy),
            further_dielectric: 0.0,
            further: Vec3::ZERO,
            diffuse: diffuse_color * FRAC_1_PI,
            transmitted: Transmitted::default(),
            albedo: BaseAlbedo::default(),
            interface: Interface::PLAIN,
        };
        if plain {
            base.albedo.specular = f0 * (1.0 - loss);
            base.albedo.diffuse = diffuse_color;
            return base;
        }

        let mut further = Vec3::ZERO;
        if glossy {
            base.further_dielectric = energy.further_fresnel(f0_dielectric);
            let metal = Vec3::from(color.to_array().map(|c| energy.further_fresnel(c)));
            further = Vec3::splat(base.further_dielectric).lerp(metal, metallic);
            base.albedo.specular = schlick(f0, share) * (1.0 - loss);
            base.albedo.further = further * loss;
            let left = 1.0 - base.dielectric_albedo(loss, share);
            base.albedo.diffuse = diffuse_color * left;
            base.diffuse =
                diffuse_color * (left * lambert::coupling(base.mean_dielectric_albedo()));
        } else {
            base.albedo.diffuse = diffuse_color;
        }
        let broad = loss * energy.inverse_mean_loss() * FRAC_1_PI;
        base.further = further * broad;
        if transmissive {
            let color = color * ((1.0 - metallic) * passing);
            let below = 1.0 - base.further_dielectric;
            base.transmitted = Transmitted {
                color,
                further: color * (below * broad),
            };
            base.albedo.transmitted =
                color * ((1.0 - base.dielectric_fresnel(share)) * (1.0 - loss));
            base.albedo.transmitted_further = color * (below * loss);
        }
        base
    }

    fn lambertian(wo: Vec3, color: Vec3) -> Self {
        Self {
            wo,
            wo_length: wo.z,
            ggx: None,
            energy: LobeEnergy::MIRROR,
            f0: Vec3::ZERO,
            f0_dielectric: 0.0,
            f90: 0.0,
            further_dielectric: 0.0,
            further: Vec3::ZERO,
            diffuse: color * FRAC_1_PI,
            transmitted: Transmitted::default(),
            albedo: BaseAlbedo {
                diffuse: color,
                ..BaseAlbedo::default()
            },
            interface: Interface::PLAIN,
        }
    }

    /// A base whose interface has extensions; `passing` is the share of light that is transmitted
    /// instead of diffusely reflected.
    fn extended<const F: u32>(
        surface: &SurfacePoint,
        wo: Vec3,
        diffuse_color: Vec3,
        passing: f32,
    ) -> Self {
        let interface = Interface::new(surface);
        let energy = LobeEnergy::new(interface.roughness);
        let ggx = Ggx::new(interface.roughness);
        let (f0_dielectric, f90) = interface.dielectric;
        let (loss, share) = (energy.loss(wo.z), energy.share(wo.z));
        let broad = loss * energy.inverse_mean_loss() * FRAC_1_PI;
        let (f0, grazing) = (interface.f0_bound, interface.f90);
        let further = |c: usize| energy.further_fresnel_between(f0[c], grazing[c]);
        let further = Vec3::new(further(0), further(1), further(2));
        let mut base = Self {
            wo,
            wo_length: ggx.map_or(wo.z, |g| g.stretched_length(interface.stretched(wo))),
            ggx,
            energy,
            f0,
            f0_dielectric,
            f90,
            further_dielectric: energy.further_fresnel_between(f0_dielectric, f90),
            further: further * broad,
            diffuse: Vec3::ZERO,
            transmitted: Transmitted::default(),
            albedo: BaseAlbedo {
                specular: interface.fresnel(share, mean_cosine(share)) * (1.0 - loss),
                further: further * loss,
                ..BaseAlbedo::default()
            },
            interface,
        };
        let left = base.left_by_dielectric::<F>(loss, share);
        base.albedo.diffuse = diffuse_color * left;
        base.diffuse = diffuse_color * (left * lambert::coupling(base.mean_dielectric_albedo()));
        if has(F, TRANSMISSION) {
            let color = surface.base_color * ((1.0 - surface.metallic) * passing);
            let below = 1.0 - base.further_dielectric;
            base.transmitted = Transmitted {
                color,
                further: color * (below * broad),
            };
            // Without the film, which may reflect all at the mean cosine and not at those around it.
            base.albedo.transmitted =
                color * ((1.0 - base.dielectric_fresnel(share)) * (1.0 - loss));
            base.albedo.transmitted_further = color * (below * loss);
        }
        base
    }

    /// Reflectance of a facet at Schlick's `weight` for its `cosine`.
    #[inline]
    pub fn fresnel<const F: u32>(&self, weight: f32, cosine: f32) -> Vec3 {
        match has(F, EXTENSIONS) {
            true => self.interface.fresnel(weight, cosine),
            false => schlick(self.f0, weight),
        }
    }

    /// A normal of `ggx` that is visible from `wo`.
    #[inline]
    pub fn visible_normal<const F: u32>(&self, ggx: &Ggx, u: Vec2) -> Vec3 {
        if !has(F, EXTENSIONS) {
            return ggx.sample(self.wo, u);
        }
        // Normals of the stretched surface, seen from the stretched direction.
        let h = ggx.sample(self.interface.stretched(self.wo), u);
        self.interface.stretched(h).normalize()
    }

    /// The microfacet that reflects `wo` to `wi`; see [`Facet::new`].
    #[inline]
    pub fn facet<const F: u32>(&self, ggx: &Ggx, wi: Vec3, sum: Vec3) -> Facet {
        if !has(F, EXTENSIONS) {
            return Facet::new(ggx, wi, sum);
        }
        let length = sum.length();
        Facet {
            cosine: (0.5 * length).min(1.0),
            d: self.interface.d(ggx, sum / length),
            wi_length: ggx.stretched_length(self.interface.stretched(wi)),
        }
    }

    /// All that the dielectric's interface reflects towards a direction with these
    /// [`LobeEnergy::loss`] and [`LobeEnergy::share`].
    #[inline]
    pub fn dielectric_albedo(&self, loss: f32, share: f32) -> f32 {
        self.dielectric_fresnel(share) * (1.0 - loss) + self.further_dielectric * loss
    }

    /// The dielectric's Fresnel factor for a Schlick weight or its mean.
    #[inline]
    pub fn dielectric_fresnel(&self, weight: f32) -> f32 {
        self.f0_dielectric + (self.f90 - self.f0_dielectric) * weight
    }

    /// [`Self::dielectric_fresnel`] of a facet at `cosine`, or all that a film reflects there if that is more.
    #[inline]
    pub fn dielectric_fresnel_at<const F: u32>(&self, weight: f32, cosine: f32) -> f32 {
        let bound = self.dielectric_fresnel(weight);
        match has(F, EXTENSIONS) {
            true => bound.max(self.interface.below_film(weight, cosine)),
            false => bound,
        }
    }

    /// What the dielectric's interface leaves to the diffuse lobe in a direction with these
    /// [`LobeEnergy::loss`] and [`LobeEnergy::share`].
    #[inline]
    fn left_by_dielectric<const F: u32>(&self, loss: f32, share: f32) -> f32 {
        if !(has(F, EXTENSIONS) && self.interface.has_film()) {
            return 1.0 - self.dielectric_albedo(loss, share);
        }
        let fresnel = self.dielectric_fresnel_at::<F>(share, mean_cosine(share));
        1.0 - (fresnel * (1.0 - loss) + self.further_dielectric * loss)
    }

    /// Cosine-weighted mean of [`Self::dielectric_albedo`].
    fn mean_dielectric_albedo(&self) -> f32 {
        self.energy.mean_albedo(self.f0_dielectric, self.f90)
            + self.further_dielectric * self.energy.mean_loss
    }

    /// Derivatives of what [`Self::new`] prepares, for the `surface` that it was given.
    pub fn slopes<const F: u32>(&self, surface: &SurfacePoint) -> BaseSlopes {
        let glossy = has(F, SPECULAR);
        let passing = match has(F, TRANSMISSION) {
            true => surface.transmission,
            false => 0.0,
        };
        let (color, metallic) = (surface.base_color, surface.metallic);
        let diffuse_share = (1.0 - metallic) * (1.0 - passing);
        if !(glossy || has(F, TRANSMISSION) && passing > 0.0) {
            return BaseSlopes {
                diffuse: MaterialSlopes {
                    base_color: Vec3::splat(diffuse_share * FRAC_1_PI),
                    metallic: color * (-(1.0 - passing) * FRAC_1_PI),
                    roughness: Vec3::ZERO,
                },
                ..BaseSlopes::default()
            };
        }
        let energy = &self.energy;
        let (loss, share) = (energy.loss(self.wo.z), energy.share(self.wo.z));
        let (loss_slope, share_slope) =
            (energy.loss_slope(self.wo.z), energy.share_slope(self.wo.z));
        let (mean_loss_slope, mean_e5_slope) = energy.mean_slopes();
        let mut slopes = BaseSlopes {
            alpha: self.ggx.map_or(0.0, |g| 2.0 * g.alpha.sqrt()),
            wo_length: self
                .ggx
                .map_or(0.0, |g| g.stretched_length_slope(self.wo, self.wo_length)),
            ..BaseSlopes::default()
        };
        let inverse = energy.inverse_mean_loss();
        let broad = loss * inverse * FRAC_1_PI;
        let broad_slope = (loss_slope - loss * mean_loss_slope * inverse) * inverse * FRAC_1_PI;
        // Coupling and left-over of the diffuse lobe; 1 / pi and constant without an interface.
        let (mut seen, mut seen_slope) = (FRAC_1_PI, 0.0);
        if glossy {
            let f0 = self.f0_dielectric;
            slopes.f0_base_color = metallic;
            slopes.f0_metallic = color - Vec3::splat(f0);
            slopes.further_dielectric = energy.further_fresnel_slopes(f0).1;
            let of_metal = color.to_array().map(|c| energy.further_fresnel_slopes(c));
            let metal = Vec3::from(color.to_array().map(|c| energy.further_fresnel(c)));
            let metal_by_f0 = Vec3::from(of_metal.map(|s| s.0));
            let metal_by_roughness = Vec3::from(of_metal.map(|s| s.1));
            let dielectric = Vec3::splat(self.further_dielectric);
            let by_roughness =
                Vec3::splat(slopes.further_dielectric).lerp(metal_by_roughness, metallic);
            slopes.further = MaterialSlopes {
                base_color: metal_by_f0 * (metallic * broad),
                metallic: (metal - dielectric) * broad,
                roughness: by_roughness * broad + dielectric.lerp(metal, metallic) * broad_slope,
            };
            let left = 1.0 - self.dielectric_albedo(loss, share);
            let left_slope =
                -self.dielectric_albedo_slope(&slopes, (loss, loss_slope), (share, share_slope));
            let mean = self.mean_dielectric_albedo();
            let mean_slope = -f0 * mean_loss_slope
                + (1.0 - f0) * mean_e5_slope
                + slopes.further_dielectric * energy.mean_loss
                + self.further_dielectric * mean_loss_slope;
            let coupling = lambert::coupling(mean);
            seen = left * coupling;
            seen_slope =
                coupling * left_slope + seen * lambert::log_coupling_slope(mean) * mean_slope;
        }
        slopes.diffuse = MaterialSlopes {
            base_color: Vec3::splat(diffuse_share * seen),
            metallic: color * (-(1.0 - passing) * seen),
            roughness: color * (diffuse_share * seen_slope),
        };
        if has(F, TRANSMISSION) {
            let below = 1.0 - self.further_dielectric;
            let share = (1.0 - metallic) * passing;
            slopes.transmitted_base_color = share;
            slopes.transmitted_metallic = color * -passing;
            slopes.transmitted_further = MaterialSlopes {
                base_color: Vec3::splat(share * below * broad),
                metallic: color * (-passing * below * broad),
                roughness: color
                    * (share * (below * broad_slope - slopes.further_dielectric * broad)),
            };
        }
        slopes
    }

    /// Derivative of [`Self::dielectric_albedo`] with respect to the roughness, from `loss` and
    /// `share` with their slopes.
    #[inline]
    pub fn dielectric_albedo_slope(
        &self,
        slopes: &BaseSlopes,
        (loss, loss_slope): (f32, f32),
        (share, share_slope): (f32, f32),
    ) -> f32 {
        (self.f90 - self.f0_dielectric) * share_slope * (1.0 - loss)
            + (self.further_dielectric - self.dielectric_fresnel(share)) * loss_slope
            + slopes.further_dielectric * loss
    }

    /// The reflecting lobes at `wi`, which lies above the surface; delta lobes left out. `sum`
    /// is `wo + wi`.
    #[inline]
    pub fn reflected<const F: u32>(&self, wi: Vec3, sum: Vec3) -> Reflected {
        let cosine_pdf = wi.z * FRAC_1_PI;
        if !has(F, SPECULAR) {
            return Reflected {
                diffuse: self.diffuse * wi.z,
                cosine_pdf,
                ..Reflected::default()
            };
        }
        let mut result = Reflected {
            cosine_pdf,
            ..Reflected::default()
        };
        if let Some(ggx) = self.ggx {
            let facet = self.facet::<F>(&ggx, wi, sum);
            let visibility = match has(F, PLAIN_GGX) {
                true => Ggx::separable_visibility,
                false => Ggx::visibility,
            };
            let fresnel = match has(F, PLAIN_GGX) {
                true => self.f0,
                false => self.fresnel::<F>(schlick_weight(facet.cosine), facet.cosine),
            };
            let v = visibility(self.wo.z, self.wo_length, wi.z, facet.wi_length);
            result.specular = fresnel * (facet.d * v * wi.z);
            result.specular_pdf = Ggx::reflection_pdf(facet.d, self.wo.z, self.wo_length);
        }
        if has(F, PLAIN_GGX) {
            result.diffuse = self.diffuse * wi.z;
            return result;
        }
        let loss = self.energy.loss(wi.z);
        result.further_pdf = self.energy.further_pdf(wi.z);
        result.specular += self.further * (loss * wi.z);
        if self.diffuse != Vec3::ZERO {
            let left = self.left_by_dielectric::<F>(loss, self.energy.share(wi.z));
            result.diffuse = self.diffuse * (left * wi.z);
        }
        result
    }

    /// Derivatives of the values of [`Self::reflected`], specular and diffuse.
    pub fn reflected_slopes<const F: u32>(
        &self,
        slopes: &BaseSlopes,
        wi: Vec3,
        sum: Vec3,
    ) -> (MaterialSlopes, MaterialSlopes) {
        if !has(F, SPECULAR) {
            return (MaterialSlopes::ZERO, slopes.diffuse.times(wi.z));
        }
        let mut specular = MaterialSlopes::ZERO;
        if let Some(ggx) = self.ggx {
            let facet = Facet::new(&ggx, wi, sum);
            let weight = schlick_weight(facet.cosine);
            let v = Ggx::visibility(self.wo.z, self.wo_length, wi.z, facet.wi_length);
            let lobe = facet.d * v * wi.z;
            let by_f0 = (1.0 - weight) * lobe;
            let log_slope = self.log_lobe_slope(slopes, &ggx, &facet, wi, sum);
            specular = MaterialSlopes {
                base_color: Vec3::splat(slopes.f0_base_color * by_f0),
                metallic: slopes.f0_metallic * by_f0,
                roughness: schlick(self.f0, weight) * (lobe * log_slope),
            };
        }
        let (loss, loss_slope) = (self.energy.loss(wi.z), self.energy.loss_slope(wi.z));
        specular += slopes.further.times(loss * wi.z);
        specular.roughness += self.further * (loss_slope * wi.z);
        let (share, share_slope) = (self.energy.share(wi.z), self.energy.share_slope(wi.z));
        let left = 1.0 - self.dielectric_albedo(loss, share);
        let left_slope =
            -self.dielectric_albedo_slope(slopes, (loss, loss_slope), (share, share_slope));
        let mut diffuse = slopes.diffuse.times(left * wi.z);
        diffuse.roughness += self.diffuse * (left_slope * wi.z);
        (specular, diffuse)
    }

    /// Logarithmic derivative with respect to the roughness of density times visibility.
    pub fn log_lobe_slope(
        &self,
        slopes: &BaseSlopes,
        ggx: &Ggx,
        facet: &Facet,
        wi: Vec3,
        sum: Vec3,
    ) -> f32 {
        let wi_slope = ggx.stretched_length_slope(wi, facet.wi_length);
        let visibility = Ggx::log_visibility_slope(
            self.wo.z,
            (self.wo_length, slopes.wo_length),
            wi.z,
            (facet.wi_length, wi_slope),
        );
        slopes.alpha * (ggx.log_d_slope(sum / sum.length()) + visibility)
    }

    /// Derivatives of the reflectance of a mirror, `schlick(f0, weight)`.
    pub fn mirror_slopes(&self, slopes: &BaseSlopes, weight: f32) -> MaterialSlopes {
        MaterialSlopes {
            base_color: Vec3::splat(slopes.f0_base_color * (1.0 - weight)),
            metallic: slopes.f0_metallic * (1.0 - weight),
            roughness: Vec3::ZERO,
        }
    }
}

/// Derivatives of [`Base`] for one `wo`.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BaseSlopes {
    /// Of alpha with respect to the roughness; 0 for a mirror.
    pub alpha: f32,
    /// Of `wo_length` with respect to alpha.
    pub wo_length: f32,
    /// Of the reflectance at normal incidence.
    pub f0_base_color: f32,
    pub f0_metallic: Vec3,
    /// Of `further_dielectric` with respect to the roughness.
    pub further_dielectric: f32,
    pub further: MaterialSlopes,
    pub diffuse: MaterialSlopes,
    /// Of `transmitted.color`.
    pub transmitted_base_color: f32,
    pub transmitted_metallic: Vec3,
    pub transmitted_further: MaterialSlopes,
}

/// The microfacet that reflects `wo` to `wi`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Facet {
    /// Cosine between the facet's normal and either direction.
    pub cosine: f32,
    /// Density of such facets, per steradian.
    pub d: f32,
    /// Stretched length of `wi`.
    pub wi_length: f32,
}

impl Facet {
    /// From `wi` and the sum `wo + wi`, which the caller forms *before* both are turned into
    /// the frame of the surface: where light grazes, the sum is short, and the rounding of two
    /// turned vectors would exceed the width of a smooth surface's lobe.
    #[inline]
    pub fn new(ggx: &Ggx, wi: Vec3, sum: Vec3) -> Self {
        // Both unit vectors lie above the surface, so their sum is not zero; its length is
        // twice the cosine, the same seen from either side.
        let length = sum.length();
        Self {
            cosine: (0.5 * length).min(1.0),
            d: ggx.d(sum / length),
            wi_length: ggx.stretched_length(wi),
        }
    }
}
