//! What the renderer asks of a light beside [`Illuminant`]: how a plane receives it.
use dipir_light::cosine::CosineWeightedMap;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::gaussian::SgMixture;
use dipir_light::illuminant::Illuminant;
use dipir_light::plane::{CosineWeightedMixture, PlaneLight};
use glam::Vec3;

/// A light that can light an object and a plane.
pub trait SceneLight: Illuminant {
    /// The light as a plane receives it.
    type OnPlane: PlaneLight;
    /// Radiance from `direction` and the density of [`Illuminant::sample`] there, in one lookup.
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32);
    /// Prepares the light for a plane with the unit normal `normal`.
    fn on_plane(&self, normal: Vec3) -> Self::OnPlane;
}

impl SceneLight for EnvironmentSampler {
    type OnPlane = CosineWeightedMap;

    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        self.eval_pdf(direction)
    }

    fn on_plane(&self, normal: Vec3) -> CosineWeightedMap {
        CosineWeightedMap::new(self.map().clone(), normal)
    }
}

impl SceneLight for SgMixture {
    type OnPlane = CosineWeightedMixture;

    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        self.eval_pdf(direction)
    }

    fn on_plane(&self, normal: Vec3) -> CosineWeightedMixture {
        CosineWeightedMixture::new(self.clone(), normal)
    }
}
