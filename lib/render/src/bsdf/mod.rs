//! Scattering at a surface point: the glTF 2.0 metallic-roughness model with clearcoat and
//! thin-walled transmission, energy conserving and reciprocal.
//!
//! `wo` points to the viewer, `wi` to the light; both are unit vectors that leave the surface.
//! **`eval` includes the cosine `|wi . n|`.** Everything is monomorphised over a mask of
//! [`features`]: what a mask lacks costs nothing.
mod clearcoat;
pub mod energy;
mod energy_table;
mod extended;
pub mod fresnel;
pub mod ggx;
mod lambert;
mod metallic_roughness;
mod sheen;
pub mod slopes;
mod thin_film;
mod transmission;

#[cfg(test)]
mod energy_quadrature;
#[cfg(test)]
mod harness;
#[cfg(test)]
pub mod reference;
#[cfg(test)]
mod tests;

use dipir_numerics::warp::{Frame, square_to_cosine_hemisphere};
use glam::{Vec2, Vec3};

use self::clearcoat::Coat;
pub(crate) use self::clearcoat::passing_coat;
use self::features::{CLEARCOAT, EXTENSIONS, PLAIN_GGX, SPECULAR, TRANSMISSION, has};
use self::fresnel::schlick_weight;
use self::ggx::reflect;
use self::metallic_roughness::Base;
use self::sheen::Sheen;
use crate::surface::SurfacePoint;

/// What a kernel simulates: a bit mask that is a const parameter of [`Bsdf`] and of
/// [`surface::evaluate`](crate::surface).
pub mod features {
    /// The GGX lobe of dielectrics and metals. Without it surfaces are Lambertian with albedo
    /// `base_color * (1 - metallic)`.
    pub const SPECULAR: u32 = 1;
    /// The clearcoat lobe and its attenuation of what lies below.
    pub const CLEARCOAT: u32 = 1 << 1;
    /// Thin-walled transmission.
    pub const TRANSMISSION: u32 = 1 << 2;
    /// Any texture lookup but normal maps and alpha.
    pub const TEXTURES: u32 = 1 << 3;
    /// Normal maps (of base and coat).
    pub const NORMAL_MAPPING: u32 = 1 << 4;
    /// Alpha coverage (mask and blend).
    pub const ALPHA: u32 = 1 << 5;
    /// Emitted radiance.
    pub const EMISSION: u32 = 1 << 6;
    /// What [`MaterialExtensions`](dipir_scene::material::MaterialExtensions) adds: not a part of
    /// [`ALL`], but set where a scene's materials have them.
    pub const EXTENSIONS: u32 = 1 << 7;
    /// For validation alone: separable Smith masking, constant Fresnel factor F0, no
    /// multiple-scattering compensation, an uncoupled Lambertian base.
    pub const PLAIN_GGX: u32 = 1 << 31;
    /// Everything but extensions and the validation switch.
    pub const ALL: u32 =
        SPECULAR | CLEARCOAT | TRANSMISSION | TEXTURES | NORMAL_MAPPING | ALPHA | EMISSION;

    /// Whether `mask` holds `feature`.
    pub const fn has(mask: u32, feature: u32) -> bool {
        mask & feature != 0
    }
}

/// A direction drawn from a [`Bsdf`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BsdfSample {
    /// Unit vector towards the light, world space.
    pub wi: Vec3,
    /// `eval / pdf`; for a delta lobe the lobe's reflectance over the chance of choosing it.
    pub weight: Vec3,
    /// Density per solid angle of *all* non-delta lobes at `wi`; infinite for a delta lobe.
    pub pdf: f32,
    /// Drawn from a mirror-like lobe that `eval` and `pdf` do not see: light sampling cannot
    /// find it, so its MIS weight is 1.
    pub delta: bool,
    /// `wi` lies on the other side of the surface.
    pub transmitted: bool,
}

/// How a direction is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Technique {
    /// The cosine: diffuse light.
    Diffuse,
    /// A visible normal of the base reflects.
    Specular,
    /// Further bounces between the base's facets.
    Further,
    /// A visible normal of the base transmits.
    Transmit,
    /// Further bounces of transmitted light.
    TransmitFurther,
    /// A visible normal of the coat reflects.
    Coat,
    /// Further bounces between the coat's facets.
    CoatFurther,
    /// Uniform: sheen.
    Sheen,
}

const TECHNIQUES: [Technique; 8] = [
    Technique::Diffuse,
    Technique::Specular,
    Technique::Further,
    Technique::Transmit,
    Technique::TransmitFurther,
    Technique::Coat,
    Technique::CoatFurther,
    Technique::Sheen,
];

/// The scattering function of one surface point for one `wo`.
///
/// Reflection is seen where `wi` lies above both the shading and the geometric plane,
/// transmission where it lies below both: smooth shading leaks no light.
#[derive(Clone, Copy, Debug)]
pub struct Bsdf<const F: u32> {
    frame: Frame,
    geometric_normal: Vec3,
    /// In world space.
    wo: Vec3,
    base: Base,
    coat: Option<Coat>,
    /// Between base and coat.
    sheen: Option<Sheen>,
    albedo: Vec3,
    /// Chance of each of [`TECHNIQUES`]; all 0 where nothing is reflected.
    chances: [f32; TECHNIQUES.len()],
}

/// Fewest paths that a transmissive surface reflects, as a share of those that it lets pass.
const LEAST_REFLECTED: f32 = 0.25;

impl<const F: u32> Bsdf<F> {
    /// Prepares what depends on the unit vector `wo` alone. `wo` lies on the side of
    /// `surface.geometric_normal`.
    pub fn new(surface: &SurfacePoint, wo: Vec3) -> Self {
        let frame = match has(F, EXTENSIONS) {
            true => surface.extension.frame(surface.normal),
            false => Frame::from_normal(surface.normal),
        };
        let local = frame.to_local(wo);
        let base = Base::new::<F>(surface, local);
        let coat = match has(F, CLEARCOAT) {
            true => Coat::new(&surface.coat, wo, &base),
            false => None,
        };
        let (below, coat_albedo) = match &coat {
            Some(c) => (c.passing_o, c.albedo),
            None => (1.0, [0.0; 2]),
        };
        let a = &base.albedo;
        let mut below_coat =
            a.diffuse + a.specular + a.further + a.transmitted + a.transmitted_further;
        let sheen = match has(F, EXTENSIONS) {
            true => Sheen::new(surface, base.wo.z),
            false => None,
        };
        let (mut sheen_chance, mut base_share) = (0.0, 1.0);
        let grey = |c: Vec3| c.element_sum() * (1.0 / 3.0);
        if let Some(sheen) = &sheen {
            base_share = sheen.passing_o;
            below_coat = below_coat * base_share + sheen.albedo();
            sheen_chance = grey(sheen.albedo()) * below;
        }
        let mut albedo = below_coat * below + Vec3::splat(coat_albedo[0] + coat_albedo[1]);
        // A black metal seen from above reflects nothing there, but something elsewhere.
        let least = if has(F, SPECULAR) { 1e-3 } else { 0.0 };
        // Glass reflects little, but that may be the sun by way of a second reflection: too few paths
        // would find it.
        let least = match grey(a.specular) > 0.0 {
            true => f32::max(least, LEAST_REFLECTED * grey(a.transmitted)),
            false => least,
        };
        let mut chances = [
            grey(a.diffuse) * below,
            grey(a.specular).max(least) * below,
            grey(a.further) * below,
            grey(a.transmitted) * below,
            grey(a.transmitted_further) * below,
            coat_albedo[0],
            coat_albedo[1],
            sheen_chance,
        ];
        if sheen.is_some() {
            chances[..5].iter_mut().for_each(|c| *c *= base_share);
        }
        let sum: f32 = chances.iter().sum();
        let unseen = has(F, PLAIN_GGX) && local.z <= 0.0;
        let scale = if sum > 0.0 && !unseen { 1.0 / sum } else { 0.0 };
        for chance in &mut chances {
            *chance *= scale;
        }
        if unseen {
            albedo = Vec3::ZERO;
        }
        Self {
            frame,
            geometric_normal: surface.geometric_normal,
            wo,
            base,
            coat,
            sheen,
            albedo,
            chances,
        }
    }

    /// Share of light that leaves towards `wo` under a white sky: what a path's throughput
    /// will be multiplied by on average.
    #[inline]
    pub fn albedo(&self) -> Vec3 {
        self.albedo
    }

    /// Share of the light from behind that comes through towards `wo`, as if nothing turned it aside.
    pub fn passing(&self) -> Vec3 {
        if !has(F, TRANSMISSION) {
            return Vec3::ZERO;
        }
        let albedo = &self.base.albedo;
        let mut passing = albedo.transmitted + albedo.transmitted_further;
        if has(F, EXTENSIONS)
            && let Some(fibres) = &self.sheen
        {
            passing *= fibres.over(self.base.wo.z);
        }
        let coat = self.coat_at(-self.wo);
        passing * coat.map_or(1.0, |(c, _, p)| c.over_specular(p))
    }

    /// Whether there is no lobe that light sampling could find.
    #[inline]
    pub fn is_delta(&self) -> bool {
        let smooth_base = self.base.ggx.is_none();
        let smooth_coat = self.coat.as_ref().is_none_or(|c| c.ggx.is_none());
        let [diffuse, specular, _, transmit, _, coat, _, sheen] = self.chances;
        diffuse == 0.0
            && sheen == 0.0
            && (smooth_base || (specular == 0.0 && transmit == 0.0))
            && (smooth_coat || coat == 0.0)
    }

    /// BSDF times `|wi . n|`, delta lobes left out.
    #[inline]
    pub fn eval(&self, wi: Vec3) -> Vec3 {
        self.eval_pdf(wi).0
    }

    /// Density per solid angle with which [`Self::sample`] draws `wi`, delta lobes left out.
    #[inline]
    pub fn pdf(&self, wi: Vec3) -> f32 {
        self.eval_pdf(wi).1
    }

    /// [`Self::eval`] and [`Self::pdf`] at once, for multiple importance sampling.
    #[inline]
    pub fn eval_pdf(&self, wi: Vec3) -> (Vec3, f32) {
        let local = self.frame.to_local(wi);
        let side = wi.dot(self.geometric_normal);
        let [
            diffuse,
            specular,
            further,
            transmit,
            transmit_further,
            coat,
            coat_further,
            sheen,
        ] = self.chances;
        let (mut value, mut pdf) = (Vec3::ZERO, 0.0);
        // Added in world space: see `Facet::new`.
        let sum = self.wo + wi;
        let half = |frame: &Frame, height: f32| {
            Vec3::new(frame.tangent.dot(sum), frame.bitangent.dot(sum), height)
        };
        if side > 0.0 {
            let coat_at = self.coat_at(wi);
            if local.z > 0.0 && diffuse + specular + sheen > 0.0 {
                let sum = half(&self.frame, self.base.wo.z + local.z);
                let mut r = self.base.reflected::<F>(local, sum);
                if has(F, EXTENSIONS)
                    && let Some(fibres) = &self.sheen
                {
                    let over = fibres.over(local.z);
                    r.diffuse *= over;
                    r.specular = r.specular * over + fibres.value(local.z, sum);
                }
                value = match &coat_at {
                    Some((c, _, p)) => {
                        r.specular * c.over_specular(*p) + r.diffuse * c.over_diffuse(*p)
                    }
                    None => r.specular + r.diffuse,
                };
                pdf = diffuse * r.cosine_pdf + specular * r.specular_pdf + further * r.further_pdf;
                if has(F, EXTENSIONS) {
                    pdf += sheen * Sheen::PDF;
                }
            }
            if let Some((c, wi, _)) = coat_at
                && wi.z > 0.0
            {
                let r = c.reflected(wi, half(&c.frame, c.wo.z + wi.z));
                value += Vec3::splat(r.value);
                pdf += coat * r.specular_pdf + coat_further * r.further_pdf;
            }
        } else if has(F, TRANSMISSION) && transmit > 0.0 && local.z < 0.0 && side < 0.0 {
            let sum = half(&self.frame, self.base.wo.z - local.z);
            let (mut transmitted, visible_pdf) = self.base.transmitted::<F>(local, sum);
            if has(F, EXTENSIONS)
                && let Some(fibres) = &self.sheen
            {
                transmitted *= fibres.over(-local.z);
            }
            let passing = self.coat_at(wi).map_or(1.0, |(c, _, p)| c.over_specular(p));
            value = transmitted * passing;
            pdf =
                transmit * visible_pdf + transmit_further * self.base.energy.further_pdf(-local.z);
        }
        (value, pdf)
    }

    /// The coat, `wi` in its frame, and what it lets pass from there.
    #[inline]
    fn coat_at(&self, wi: Vec3) -> Option<(&Coat, Vec3, f32)> {
        if !has(F, CLEARCOAT) {
            return None;
        }
        let coat = self.coat.as_ref()?;
        let local = coat.frame.to_local(wi);
        // A transmitted ray leaves through a coat on the other side; a ray below the horizon of
        // a tilted coat grazes it.
        let below = wi.dot(self.geometric_normal) < 0.0;
        let cosine = if below { -local.z } else { local.z };
        Some((coat, local, coat.passing(cosine.clamp(0.0, 1.0))))
    }

    /// Draws `wi`; `None` where the path ends (absorbed, or below the horizon). `u_lobe` and
    /// both of `u` lie in `[0, 1)`.
    pub fn sample(&self, u_lobe: f32, u: Vec2) -> Option<BsdfSample> {
        let technique = self.choose(u_lobe)?;
        let wo = self.base.wo;
        let below = |w: Vec3| Vec3::new(w.x, w.y, -w.z);
        let local = match technique {
            Technique::Diffuse => square_to_cosine_hemisphere(u),
            Technique::Further => self.base.energy.sample_further(u),
            Technique::TransmitFurther => below(self.base.energy.sample_further(u)),
            Technique::Specular | Technique::Transmit => {
                let Some(ggx) = &self.base.ggx else {
                    return self.sample_delta(technique);
                };
                let (wi, _) = reflect(wo, self.base.visible_normal::<F>(ggx, u));
                if wi.z <= 0.0 {
                    return None;
                }
                match technique {
                    Technique::Specular => wi,
                    _ => below(wi),
                }
            }
            Technique::Coat | Technique::CoatFurther => return self.sample_coat(technique, u),
            Technique::Sheen => Sheen::sample(u),
        };
        self.towards(self.frame.to_world(local))
    }

    /// The technique that `u` falls on; `None` if nothing is reflected.
    #[inline]
    fn choose(&self, u: f32) -> Option<Technique> {
        let mut rest = u;
        let mut last = None;
        for (technique, chance) in TECHNIQUES.into_iter().zip(self.chances) {
            if chance > 0.0 {
                if rest < chance {
                    return Some(technique);
                }
                rest -= chance;
                // Rounding may leave a rest: it belongs to the last one.
                last = Some(technique);
            }
        }
        last
    }

    fn sample_coat(&self, technique: Technique, u: Vec2) -> Option<BsdfSample> {
        let coat = self.coat.as_ref()?;
        let local = match (technique, &coat.ggx) {
            (Technique::CoatFurther, _) => coat.energy.sample_further(u),
            (_, Some(ggx)) => reflect(coat.wo, ggx.sample(coat.wo, u)).0,
            (_, None) => return self.sample_delta(technique),
        };
        if local.z <= 0.0 {
            return None;
        }
        self.towards(coat.frame.to_world(local))
    }

    /// A drawn direction with the value and density of all lobes; `None` where nothing is reflected.
    #[inline]
    pub(crate) fn towards(&self, wi: Vec3) -> Option<BsdfSample> {
        let (value, pdf) = self.eval_pdf(wi);
        (pdf > 0.0 && value != Vec3::ZERO).then(|| BsdfSample {
            wi,
            weight: value / pdf,
            pdf,
            delta: false,
            transmitted: wi.dot(self.geometric_normal) < 0.0,
        })
    }

    /// The direction of a smooth lobe.
    fn sample_delta(&self, technique: Technique) -> Option<BsdfSample> {
        let base = &self.base;
        let fresnel = schlick_weight(base.wo.z);
        let mirrored = |v: Vec3| Vec3::new(-v.x, -v.y, v.z);
        let (wi, value, chance) = match technique {
            Technique::Specular => {
                let f = match has(F, PLAIN_GGX) {
                    true => base.f0,
                    false => base.fresnel::<F>(fresnel, base.wo.z),
                };
                (self.frame.to_world(mirrored(base.wo)), f, self.chances[1])
            }
            Technique::Transmit => {
                let passing = 1.0 - base.dielectric_fresnel_at::<F>(fresnel, base.wo.z);
                let wi = self.frame.to_world(-base.wo);
                (wi, base.transmitted.color * passing, self.chances[3])
            }
            _ => {
                let coat = self.coat.as_ref()?;
                let wi = coat.frame.to_world(mirrored(coat.wo));
                (wi, Vec3::splat(coat.albedo[0]), self.chances[5])
            }
        };
        let transmitted = technique == Technique::Transmit;
        let side = wi.dot(self.geometric_normal);
        if transmitted != (side < 0.0) {
            return None;
        }
        let over_base = match (&self.sheen, technique) {
            (Some(fibres), Technique::Specular | Technique::Transmit) if has(F, EXTENSIONS) => {
                fibres.passing_o
            }
            _ => 1.0,
        };
        let attenuation = match (technique, self.coat_at(wi)) {
            (Technique::Specular | Technique::Transmit, Some((c, _, p))) => c.over_specular(p),
            _ => 1.0,
        };
        Some(BsdfSample {
            wi,
            weight: value * (over_base * attenuation / chance),
            pdf: f32::INFINITY,
            delta: true,
            transmitted,
        })
    }
}
