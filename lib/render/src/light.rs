//! What the renderer asks of a light beside [`Illuminant`]: how a plane receives it.
use dipir_light::cone::ConeSampler;
use dipir_light::cosine::CosineWeightedMap;
use dipir_light::illuminant::Illuminant;
use dipir_light::luminance::luminance_f64;
use glam::{DVec3, Vec2, Vec3};

use crate::blocker::Cone;

/// Light as a plane receives it, sampled where an object can block it.
pub trait PlaneLight: Sync {
    /// Sampling restricted to one cone after another, without allocating.
    type Restriction<'a>
    where
        Self: 'a;
    /// Irradiance of the plane without the object, linear Rec.709.
    fn irradiance(&self) -> DVec3;
    /// A sampler that is restricted to nothing yet.
    fn restriction(&self) -> Self::Restriction<'_>;
    /// Restricts sampling to `cone`; returns the luminance of the irradiance from there or an
    /// upper bound of it.
    fn restrict(&self, restriction: &mut Self::Restriction<'_>, cone: &Cone) -> f32;
    /// Draws a direction inside the restriction, with radiance times cosine over density;
    /// a zero weight means that there is nothing to block.
    fn sample(&self, restriction: &Self::Restriction<'_>, u: Vec2) -> (Vec3, Vec3);
}

/// A light that can light an object and a plane.
pub trait SceneLight: Illuminant {
    /// The light as a plane receives it.
    type OnPlane: PlaneLight;
    /// Radiance from `direction` and the density of [`Illuminant::sample`] there, in one lookup.
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        (self.eval(direction), self.pdf(direction))
    }
    /// Prepares the light for a plane with the unit normal `normal`.
    fn on_plane(&self, normal: Vec3) -> Self::OnPlane;
}

impl PlaneLight for CosineWeightedMap {
    type Restriction<'a> = ConeSampler<'a>;

    fn irradiance(&self) -> DVec3 {
        self.irradiance()
    }

    fn restriction(&self) -> ConeSampler<'_> {
        self.cone()
    }

    fn restrict(&self, restriction: &mut ConeSampler<'_>, cone: &Cone) -> f32 {
        restriction.restrict(cone.axis, cone.cos_half_angle);
        restriction.mass() as f32
    }

    #[inline]
    fn sample(&self, restriction: &ConeSampler<'_>, u: Vec2) -> (Vec3, Vec3) {
        let s = restriction.sample(u);
        (s.direction, s.weight)
    }
}

impl SceneLight for dipir_light::environment::EnvironmentSampler {
    type OnPlane = CosineWeightedMap;

    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        self.eval_pdf(direction)
    }

    fn on_plane(&self, normal: Vec3) -> CosineWeightedMap {
        CosineWeightedMap::new(self.map().clone(), normal)
    }
}

/// Luminance of the irradiance of a plane.
pub(crate) fn irradiance_luminance(light: &impl PlaneLight) -> f32 {
    luminance_f64(light.irradiance()) as f32
}
