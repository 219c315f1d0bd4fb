//! How the renderer samples a light: for paths over the object, and for the proxy's plane.
//!
//! An environment map is split at its mean luminance into what lies above (a sun, a window) and
//! the rest. Paths draw light samples from what lies above alone: the rest is dim and wide, and
//! BSDF sampling, which paths do anyway, finds it better ("MIS compensation", Karlík et al. 2019).
//! A plane receives both parts, but each is sampled by itself: how many samples fall into the sun
//! is then no longer left to chance, which is most of a shadow's noise at low sample counts.
mod map_with_lobes;

use std::sync::Arc;

use dipir_light::cosine::CosineWeightedMap;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_light::gaussian::SgMixture;
use dipir_light::illuminant::{Illuminant, LightSample};
use dipir_light::luminance::{luminance, luminance_f64};
use dipir_light::plane::{CosineWeightedMixture, PlaneLight};
use glam::{DVec3, Vec2, Vec3};

use crate::adaptive::Watch;
use crate::error::RenderError;
use crate::render::{Rendered, Renderer, Settings, Simulation};
use crate::world::World;

/// A light as paths over the object meet it.
pub trait PathLight: Sync {
    /// Radiance from the unit vector `direction`, and the density of [`Self::sample`] there: 0
    /// where the light is left to BSDF sampling.
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32);
    /// Draws a direction; a density of 0 means that there is none.
    fn sample(&self, u: Vec2) -> LightSample;
}

/// A light that can light an object and a plane. Preparing it takes about as long as a picture of a few thousand pixels.
pub trait SceneLight: Sync {
    /// The light as paths meet it; cheap to clone.
    type OnObject: PathLight + Clone;
    /// A part of the light as a plane receives it; cheap to clone.
    type OnPlane: PlaneLight + Clone;
    /// Prepares the light for paths.
    fn on_object(&self) -> Self::OnObject;
    /// Prepares the light for a plane with the unit normal `normal`: its parts add up.
    fn on_plane(&self, normal: Vec3) -> Vec<Self::OnPlane>;
    /// As [`Renderer::render`], which calls this, in a world that [`Renderer::world`] made ready for the features of
    /// `simulation`: for many pictures under changing lights. Every light implements it by [`Renderer::render_under`], so
    /// that the kernels are compiled here, once for each light, and not in each crate that renders.
    fn render(
        &self,
        renderer: &Renderer,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError>;
}

/// [`SceneLight::render`] of a light.
macro_rules! compiled_here {
    () => {
        fn render(
            &self,
            renderer: &crate::render::Renderer,
            world: &mut crate::world::World,
            simulation: &crate::render::Simulation,
            settings: &crate::render::Settings,
            progress: &mut crate::adaptive::Watch,
        ) -> Result<crate::render::Rendered, crate::error::RenderError> {
            renderer.render_under(world, self, simulation, settings, progress)
        }
    };
}
use compiled_here;

/// A part of a light on a plane, behind a counted reference.
#[derive(Debug)]
pub struct SharedPlane<P>(Arc<P>);

impl<P> Clone for SharedPlane<P> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<P: PlaneLight + Send> PlaneLight for SharedPlane<P> {
    type Cone<'a>
        = P::Cone<'a>
    where
        Self: 'a;

    fn normal(&self) -> Vec3 {
        self.0.normal()
    }

    fn irradiance(&self) -> DVec3 {
        self.0.irradiance()
    }

    fn cone(&self) -> P::Cone<'_> {
        self.0.cone()
    }
}

/// A light that was prepared once for pictures of several resolutions.
pub(crate) struct PreparedLight<L: SceneLight> {
    /// As paths meet it.
    pub on_object: L::OnObject,
    /// Its parts as the proxy's plane receives them; none without a plane or a shadow.
    pub on_plane: Vec<L::OnPlane>,
}

/// Luminance above the mean by less than this share counts as the mean itself: rounding.
const LEAST_EXCESS: f32 = 1e-3;

/// Splits light at the mean luminance of a map.
#[derive(Clone, Copy, Debug)]
struct Split {
    mean: f32,
}

impl Split {
    fn of(map: &EnvironmentMap) -> Self {
        let mean = luminance_f64(map.integral()) / (4.0 * std::f64::consts::PI);
        Self { mean: mean as f32 }
    }

    /// Luminance of the bright part of light of `luminance`.
    #[inline]
    fn excess(self, luminance: f32) -> f32 {
        let excess = luminance - self.mean;
        if excess > LEAST_EXCESS * self.mean {
            excess
        } else {
            0.0
        }
    }

    /// What of `map` is bright, colours kept; the rest is the difference.
    fn bright_part(self, map: &EnvironmentMap) -> EnvironmentMap {
        let texels = map.texels().iter().map(|&t| {
            let luminance = luminance(t);
            match self.excess(luminance) {
                0.0 => Vec3::ZERO,
                excess => t * (excess / luminance),
            }
        });
        part_of(map, texels.collect())
    }
}

/// A map of the same size; `texels` are not negative and not larger than those of `map`.
fn part_of(map: &EnvironmentMap, texels: Vec<Vec3>) -> EnvironmentMap {
    EnvironmentMap::new(map.width(), map.height(), texels)
        .unwrap_or_else(|_| EnvironmentMap::constant(map.width(), map.height(), Vec3::ZERO))
}

/// An environment map whose bright part alone is drawn.
#[derive(Clone, Debug)]
pub struct CompensatedMap {
    map: Arc<EnvironmentMap>,
    split: Split,
    bright: Arc<EnvironmentSampler>,
    /// One over the luminance of the bright part, integrated over the sphere; 0 without one.
    inverse_total: f32,
}

impl CompensatedMap {
    /// Splits `map`.
    pub fn new(map: Arc<EnvironmentMap>) -> Self {
        let split = Split::of(&map);
        let bright = split.bright_part(&map);
        let total = luminance_f64(bright.integral());
        Self {
            map,
            split,
            bright: Arc::new(EnvironmentSampler::new(bright)),
            inverse_total: if total > 0.0 {
                (1.0 / total) as f32
            } else {
                0.0
            },
        }
    }
}

impl CompensatedMap {
    /// Luminance of the bright part, integrated over the sphere.
    pub(crate) fn bright_luminance(&self) -> f64 {
        match self.inverse_total > 0.0 {
            true => 1.0 / f64::from(self.inverse_total),
            false => 0.0,
        }
    }
}

impl PathLight for CompensatedMap {
    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let radiance = self.map.eval(direction);
        let pdf = self.split.excess(luminance(radiance)) * self.inverse_total;
        (radiance, pdf)
    }

    #[inline]
    fn sample(&self, u: Vec2) -> LightSample {
        let drawn = self.bright.sample(u);
        if drawn.pdf <= 0.0 {
            return drawn;
        }
        // From the bright part back to the whole, without another lookup.
        let excess = luminance(drawn.radiance);
        LightSample {
            radiance: drawn.radiance * ((excess + self.split.mean) / excess),
            ..drawn
        }
    }
}

impl SceneLight for EnvironmentSampler {
    type OnObject = CompensatedMap;
    type OnPlane = SharedPlane<CosineWeightedMap>;

    fn on_object(&self) -> CompensatedMap {
        CompensatedMap::new(self.map().clone())
    }

    fn on_plane(&self, normal: Vec3) -> Vec<Self::OnPlane> {
        let bright = Split::of(self.map()).bright_part(self.map());
        let texels = self.map().texels().iter().zip(bright.texels());
        let dim = texels.map(|(&all, &b)| (all - b).max(Vec3::ZERO)).collect();
        let dim = part_of(self.map(), dim);
        [dim, bright]
            .into_iter()
            .map(|part| CosineWeightedMap::new(part, normal))
            .filter(|part| part.luminance_irradiance() > 0.0)
            .map(|part| SharedPlane(Arc::new(part)))
            .collect()
    }

    compiled_here!();
}

impl PathLight for SgMixture {
    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        self.eval_pdf(direction)
    }

    #[inline]
    fn sample(&self, u: Vec2) -> LightSample {
        Illuminant::sample(self, u)
    }
}

impl SceneLight for SgMixture {
    type OnObject = SgMixture;
    type OnPlane = SharedPlane<CosineWeightedMixture>;

    fn on_object(&self) -> SgMixture {
        self.clone()
    }

    fn on_plane(&self, normal: Vec3) -> Vec<Self::OnPlane> {
        let light = CosineWeightedMixture::new(self.clone(), normal);
        vec![SharedPlane(Arc::new(light))]
    }

    compiled_here!();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{integral_of_density, sun};

    #[test]
    fn the_parts_on_a_plane_add_up_to_the_light() {
        let map = sun(Vec3::new(0.3, 0.8, 0.2).normalize(), 500.0, 0.7, 32);
        let whole = CosineWeightedMap::new(map.clone(), Vec3::Y).irradiance();
        let parts = EnvironmentSampler::new(map).on_plane(Vec3::Y);
        assert_eq!(parts.len(), 2);
        let sum = parts[0].irradiance() + parts[1].irradiance();
        // Each texel is split with f32 rounding.
        assert!((sum - whole).abs().max_element() < 1e-6 * whole.max_element());
    }

    #[test]
    fn a_constant_light_is_left_to_bsdf_sampling_and_has_one_part() {
        let map = EnvironmentMap::constant(32, 16, Vec3::new(0.3, 0.7, 0.1));
        let light = EnvironmentSampler::new(map);
        let on_object = light.on_object();
        assert_eq!(on_object.sample(Vec2::splat(0.5)).pdf, 0.0);
        assert_eq!(on_object.eval_with_pdf(Vec3::X).1, 0.0);
        assert_eq!(light.on_plane(Vec3::Y).len(), 1);
    }

    #[test]
    fn densities_and_samples_agree_and_integrate_to_one() {
        let map = sun(Vec3::new(0.3, 0.8, 0.2).normalize(), 50.0, 0.7, 8);
        let light = EnvironmentSampler::new(map).on_object();
        let integral = integral_of_density(&light, 1 << 16);
        // Stratified over a texel of 1/40 of the sphere's area.
        assert!((integral - 1.0).abs() < 0.02, "{integral}");
    }
}
