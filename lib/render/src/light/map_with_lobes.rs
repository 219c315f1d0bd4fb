//! How the renderer samples an environment map plus lobes.
//!
//! On the object one of two techniques is chosen: the map's bright part, or the lobes, in
//! proportion to their luminance integrated over the sphere. On a plane the parts of both are
//! sampled each by itself.
use dipir_light::cone::ConeSample;
use dipir_light::gaussian::SgMixture;
use dipir_light::illuminant::LightSample;
use dipir_light::luminance::luminance_f64;
use dipir_light::map_with_lobes::{Choice, MapWithLobes};
use dipir_light::plane::{LightInCone, PlaneLight};
use glam::{DVec3, Vec2, Vec3};

use super::{CompensatedMap, PathLight, SceneLight, SharedPlane, compiled_here};
use dipir_light::environment::EnvironmentSampler;

/// A map whose bright part is drawn, and lobes.
#[derive(Clone, Debug)]
pub struct CompensatedMapWithLobes {
    map: CompensatedMap,
    lobes: SgMixture,
    choice: Choice,
}

impl PathLight for CompensatedMapWithLobes {
    #[inline]
    fn eval_with_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let (map, map_pdf) = self.map.eval_with_pdf(direction);
        let (lobes, lobes_pdf) = self.lobes.eval_with_pdf(direction);
        (map + lobes, self.choice.pdf(map_pdf, lobes_pdf))
    }

    #[inline]
    fn sample(&self, u: Vec2) -> LightSample {
        let (from_map, u) = self.choice.choose(u);
        if from_map {
            let drawn = self.map.sample(u);
            if drawn.pdf <= 0.0 {
                return drawn;
            }
            let (lobes, lobes_pdf) = self.lobes.eval_with_pdf(drawn.direction);
            LightSample {
                radiance: drawn.radiance + lobes,
                pdf: self.choice.pdf(drawn.pdf, lobes_pdf),
                ..drawn
            }
        } else {
            let drawn = PathLight::sample(&self.lobes, u);
            let (map, map_pdf) = self.map.eval_with_pdf(drawn.direction);
            LightSample {
                radiance: map + drawn.radiance,
                pdf: self.choice.pdf(map_pdf, drawn.pdf),
                ..drawn
            }
        }
    }
}

/// A part of the light of a map plus lobes on a plane.
#[derive(Clone)]
pub enum PlanePart {
    /// The map's bright or dim part.
    Map(<EnvironmentSampler as SceneLight>::OnPlane),
    /// The lobes.
    Lobes(<SgMixture as SceneLight>::OnPlane),
}

/// A [`PlanePart`] restricted to a cone.
pub enum PlanePartInCone<'a> {
    /// Of the map.
    Map(<<EnvironmentSampler as SceneLight>::OnPlane as PlaneLight>::Cone<'a>),
    /// Of the lobes.
    Lobes(<<SgMixture as SceneLight>::OnPlane as PlaneLight>::Cone<'a>),
}

impl PlaneLight for PlanePart {
    type Cone<'a> = PlanePartInCone<'a>;

    fn normal(&self) -> Vec3 {
        match self {
            Self::Map(part) => part.normal(),
            Self::Lobes(part) => part.normal(),
        }
    }

    fn irradiance(&self) -> DVec3 {
        match self {
            Self::Map(part) => part.irradiance(),
            Self::Lobes(part) => part.irradiance(),
        }
    }

    fn cone(&self) -> PlanePartInCone<'_> {
        match self {
            Self::Map(part) => PlanePartInCone::Map(part.cone()),
            Self::Lobes(part) => PlanePartInCone::Lobes(part.cone()),
        }
    }
}

impl LightInCone for PlanePartInCone<'_> {
    fn restrict(&mut self, axis: Vec3, cos_max: f32) {
        match self {
            Self::Map(part) => part.restrict(axis, cos_max),
            Self::Lobes(part) => part.restrict(axis, cos_max),
        }
    }

    fn mass(&self) -> f64 {
        match self {
            Self::Map(part) => part.mass(),
            Self::Lobes(part) => part.mass(),
        }
    }

    fn sample(&self, u: Vec2) -> ConeSample {
        match self {
            Self::Map(part) => part.sample(u),
            Self::Lobes(part) => part.sample(u),
        }
    }

    fn pdf(&self, direction: Vec3) -> f32 {
        match self {
            Self::Map(part) => part.pdf(direction),
            Self::Lobes(part) => part.pdf(direction),
        }
    }
}

impl SceneLight for MapWithLobes {
    type OnObject = CompensatedMapWithLobes;
    type OnPlane = PlanePart;

    fn on_object(&self) -> CompensatedMapWithLobes {
        let map = self.map().on_object();
        let lobes = self.lobes().clone();
        let choice = Choice::in_proportion(map.bright_luminance(), luminance_f64(lobes.integral()));
        CompensatedMapWithLobes { map, lobes, choice }
    }

    fn on_plane(&self, normal: Vec3) -> Vec<PlanePart> {
        let map = self.map().on_plane(normal).into_iter().map(PlanePart::Map);
        let lobes = self.lobes().on_plane(normal).into_iter();
        let lobes = lobes
            .filter(|part: &SharedPlane<_>| luminance_f64(part.irradiance()) > 0.0)
            .map(PlanePart::Lobes);
        map.chain(lobes).collect()
    }

    compiled_here!();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{Rendered, Renderer};
    use crate::shapes::icosphere;
    use crate::testing::{
        camera, carry_on, everything, ground, integral_of_density, matte, scene, settings, sun,
    };
    use dipir_light::environment::EnvironmentMap;
    use dipir_light::gaussian::SphericalGaussian;
    use dipir_scene::scene::Scene;

    fn map() -> EnvironmentSampler {
        let direction = Vec3::new(0.3, 0.8, 0.2).normalize();
        EnvironmentSampler::new(sun(direction, 200.0, 0.7, 16))
    }

    fn black_map() -> EnvironmentSampler {
        EnvironmentSampler::new(EnvironmentMap::constant(8, 4, Vec3::ZERO))
    }

    fn lobes() -> SgMixture {
        let lobe = |direction: Vec3, radiance, sigma| SphericalGaussian {
            direction: direction.normalize(),
            radiance,
            sigma,
        };
        SgMixture::new(vec![
            lobe(Vec3::new(-0.5, 0.6, 0.3), Vec3::new(40.0, 30.0, 20.0), 0.08),
            lobe(Vec3::Y, Vec3::new(0.2, 0.3, 0.5), 0.9),
        ])
        .unwrap()
    }

    fn black_lobes() -> SgMixture {
        SgMixture::new(Vec::new()).unwrap()
    }

    /// A sphere on the ground.
    fn ball() -> Scene {
        let mesh = icosphere(Vec3::Y, 1.0, 3);
        let view = camera(Vec3::new(0.0, 3.0, 7.0), Vec3::new(0.0, 0.7, 0.0), 35.0, 24);
        let mut material = matte(Vec3::new(0.6, 0.4, 0.2));
        material.roughness = 0.4;
        scene(mesh, material, view, ground())
    }

    fn render<L: SceneLight>(light: &L, samples: u32) -> Rendered {
        let scene = ball();
        Renderer::new(&scene)
            .render(light, &everything(3), &settings(samples, 5), &mut carry_on)
            .unwrap()
    }

    #[test]
    fn with_one_part_black_the_picture_is_that_of_the_other_part() {
        let same = |a: &Rendered, b: &Rendered| {
            assert_eq!(a.film.object, b.film.object);
            assert_eq!(a.film.alpha, b.film.alpha);
            assert_eq!(a.film.shadow, b.film.shadow);
            assert_eq!(a.counts, b.counts);
        };
        let no_lobes = MapWithLobes::new(map(), black_lobes());
        same(&render(&no_lobes, 8), &render(&map(), 8));
        let no_map = MapWithLobes::new(black_map(), lobes());
        same(&render(&no_map, 8), &render(&lobes(), 8));
    }

    #[test]
    fn the_object_is_as_bright_as_under_both_parts_added() {
        let both = render(&MapWithLobes::new(map(), lobes()), 256);
        let (a, b) = (render(&map(), 256), render(&lobes(), 256));
        let mean = |r: &Rendered| {
            let sum: Vec3 = r.film.object.pixels().iter().sum();
            sum / r.film.object.pixels().len() as f32
        };
        let (sum, found) = (mean(&a) + mean(&b), mean(&both));
        // 576 pixels of 256 samples, a quarter of them on the ball: samples spread about as much as
        // they are large, so a mean has an error of 1/200, less by stratification; four of three.
        assert!(
            ((found - sum) / sum).abs().max_element() < 0.02,
            "{found} {sum}"
        );
    }

    #[test]
    fn the_shadow_is_that_of_both_parts_weighed_by_their_irradiance() {
        let both = render(&MapWithLobes::new(map(), lobes()), 256);
        let (a, b) = (render(&map(), 256), render(&lobes(), 256));
        let irradiance = |parts: Vec<PlanePart>| -> Vec3 {
            let sum: DVec3 = parts.iter().map(PlaneLight::irradiance).sum();
            sum.as_vec3()
        };
        let of_map = irradiance(MapWithLobes::new(map(), black_lobes()).on_plane(Vec3::Y));
        let of_lobes = irradiance(MapWithLobes::new(black_map(), lobes()).on_plane(Vec3::Y));
        let (mut squares, mut noise, mut n) = (0.0, 0.0, 0.0);
        for i in 0..both.film.shadow.pixels().len() {
            let (x, y) = (a.film.shadow.pixels()[i], b.film.shadow.pixels()[i]);
            let expected = (x * of_map + y * of_lobes) / (of_map + of_lobes);
            let error = both.film.shadow.pixels()[i] - expected;
            squares += error.length_squared();
            // Three estimates of the same noise, of which the sum is one.
            noise += 2.0 * both.film.shadow_variance(i % 24, i / 24).element_sum();
            n += 3.0;
        }
        // Sums of squares over a few hundred shadowed pixels are known to a quarter.
        assert!(squares < 1.5 * noise, "{} {}", squares / n, noise / n);
    }

    #[test]
    fn densities_and_samples_agree_and_integrate_to_one() {
        let light = MapWithLobes::new(map(), lobes()).on_object();
        let integral = integral_of_density(&light, 1 << 17);
        // The texel of the sun is 1/163 of the sphere, the narrow lobe as small: stratified points
        // find either to a few per cent.
        assert!((integral - 1.0).abs() < 0.03, "{integral}");
    }
}
