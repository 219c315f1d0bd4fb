//! The light that transport is recorded under.
use dipir_light::cone::{ConeSample, ConeSampler};
use dipir_light::cosine::CosineWeightedMap;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::illuminant::{Illuminant, LightSample};
use dipir_light::plane::{LightInCone, PlaneLight};
use glam::{DVec3, Vec2, Vec3};

use crate::light::PathLight;

/// Light of radiance 1 from everywhere, whose directions are drawn by a given density: what a
/// path carries of it is the weight of the texel that it came from.
pub struct UnitLight {
    /// Draws the directions; its map holds the density and is otherwise not looked at.
    pub sampler: EnvironmentSampler,
}

impl PathLight for UnitLight {
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        (Vec3::ONE, self.sampler.pdf(direction))
    }

    fn sample(&self, u: Vec2) -> LightSample {
        LightSample {
            radiance: Vec3::ONE,
            ..self.sampler.sample(u)
        }
    }
}

/// [`UnitLight`] on a plane.
pub struct UnitOnPlane(pub CosineWeightedMap);

impl PlaneLight for UnitOnPlane {
    type Cone<'a> = UnitInCone<'a>;

    fn normal(&self) -> Vec3 {
        self.0.normal()
    }

    fn irradiance(&self) -> DVec3 {
        // Of radiance 1.
        DVec3::splat(std::f64::consts::PI)
    }

    fn cone(&self) -> UnitInCone<'_> {
        UnitInCone(self.0.cone())
    }
}

/// [`UnitOnPlane`] in a cone.
pub struct UnitInCone<'a>(ConeSampler<'a>);

impl LightInCone for UnitInCone<'_> {
    fn restrict(&mut self, axis: Vec3, cos_max: f32) {
        self.0.restrict(axis, cos_max);
    }

    fn mass(&self) -> f64 {
        self.0.mass()
    }

    fn sample(&self, u: Vec2) -> ConeSample {
        let sample = self.0.sample(u);
        let weight = match sample.pdf > 0.0 {
            true => sample.cosine / sample.pdf,
            false => 0.0,
        };
        ConeSample {
            radiance: Vec3::ONE,
            weight: Vec3::splat(weight),
            ..sample
        }
    }

    fn pdf(&self, direction: Vec3) -> f32 {
        self.0.pdf(direction)
    }
}
