//! The sum of an environment map and spherical Gaussians.
use glam::{Vec2, Vec3};

use crate::environment::EnvironmentSampler;
use crate::gaussian::SgMixture;
use crate::illuminant::{Illuminant, LightSample};
use crate::luminance::luminance_f64;

/// Light that is an environment map plus a mixture of lobes.
///
/// Radiance is exactly the sum of both. One of the two is chosen by its share of the luminance
/// integrated over the sphere and sampled as it is by itself; the density is that of the mixture of
/// both techniques. With one part black it equals the other part.
#[derive(Clone, Debug)]
pub struct MapWithLobes {
    map: EnvironmentSampler,
    lobes: SgMixture,
    choice: Choice,
}

/// The largest f32 below 1.
const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// How one of two parts of a light is chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Chance of the first part; 0 if it is never drawn from.
    first: f32,
    /// Whether the second part is ever drawn from.
    has_second: bool,
}

impl Choice {
    /// Chances in proportion to `first` and `second`, neither negative.
    pub fn in_proportion(first: f64, second: f64) -> Self {
        let sum = first + second;
        Self {
            first: match sum > 0.0 {
                true => (first / sum) as f32,
                false => 0.0,
            },
            has_second: second > 0.0,
        }
    }

    /// Chance of the first part.
    #[inline]
    pub fn first(self) -> f32 {
        self.first
    }

    /// Density of the mixture where the parts have the densities `first` and `second`.
    #[inline]
    pub fn pdf(self, first: f32, second: f32) -> f32 {
        self.first * first + (1.0 - self.first) * second
    }

    /// Whether `u.x` chooses the first part, and `u` for use within the part: `u.x` is stretched
    /// over the interval that chose it, so that it is uniform again.
    #[inline]
    pub fn choose(self, u: Vec2) -> (bool, Vec2) {
        if u.x < self.first || !self.has_second {
            let x = match self.first > 0.0 {
                true => u.x / self.first,
                false => u.x,
            };
            (true, Vec2::new(x.min(BELOW_ONE), u.y))
        } else {
            let x = (u.x - self.first) / (1.0 - self.first);
            (false, Vec2::new(x.min(BELOW_ONE), u.y))
        }
    }
}

impl MapWithLobes {
    /// The sum of `map` and `lobes`.
    pub fn new(map: EnvironmentSampler, lobes: SgMixture) -> Self {
        let choice = Choice::in_proportion(
            luminance_f64(map.map().integral()),
            luminance_f64(lobes.integral()),
        );
        Self { map, lobes, choice }
    }

    /// The map, with its sampler.
    pub fn map(&self) -> &EnvironmentSampler {
        &self.map
    }

    /// The lobes.
    pub fn lobes(&self) -> &SgMixture {
        &self.lobes
    }
}

impl Illuminant for MapWithLobes {
    #[inline]
    fn eval(&self, direction: Vec3) -> Vec3 {
        self.map.eval(direction) + Illuminant::eval(&self.lobes, direction)
    }

    #[inline]
    fn sample(&self, u: Vec2) -> LightSample {
        let (from_map, u) = self.choice.choose(u);
        let drawn = match from_map {
            true => self.map.sample(u),
            false => Illuminant::sample(&self.lobes, u),
        };
        if drawn.pdf <= 0.0 {
            return drawn;
        }
        let (radiance, pdf) = self.eval_pdf(drawn.direction);
        LightSample {
            radiance,
            pdf,
            ..drawn
        }
    }

    #[inline]
    fn pdf(&self, direction: Vec3) -> f32 {
        self.eval_pdf(direction).1
    }

    #[inline]
    fn eval_pdf(&self, direction: Vec3) -> (Vec3, f32) {
        let (map, map_pdf) = self.map.eval_pdf(direction);
        let (lobes, lobes_pdf) = self.lobes.eval_pdf(direction);
        (map + lobes, self.choice.pdf(map_pdf, lobes_pdf))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::EnvironmentMap;
    use crate::testing::{chi_squared, directions, lobe, speckled, uniform};

    fn lobes() -> SgMixture {
        let lobes = vec![
            lobe(Vec3::new(0.2, 0.5, -0.9), Vec3::new(20.0, 10.0, 5.0), 0.3),
            lobe(Vec3::new(-0.7, 0.1, 0.4), Vec3::splat(2.0), 0.8),
        ];
        SgMixture::new(lobes).unwrap()
    }

    fn black_lobes() -> SgMixture {
        SgMixture::new(Vec::new()).unwrap()
    }

    fn map() -> EnvironmentSampler {
        EnvironmentSampler::new(speckled(24, 12))
    }

    fn black_map() -> EnvironmentSampler {
        EnvironmentSampler::new(EnvironmentMap::constant(4, 2, Vec3::ZERO))
    }

    #[test]
    fn radiance_is_the_sum_of_both_parts() {
        let (map, lobes) = (map(), lobes());
        let light = MapWithLobes::new(map.clone(), lobes.clone());
        for d in directions() {
            assert_eq!(light.eval(d), map.eval(d) + Illuminant::eval(&lobes, d));
            assert_eq!(light.eval_pdf(d), (light.eval(d), light.pdf(d)));
        }
    }

    #[test]
    fn samples_follow_the_density_which_integrates_to_one() {
        let light = MapWithLobes::new(map(), lobes());
        // Cells of half a texel; the tolerance is that of midpoints over the lobes.
        let p = chi_squared(
            (48, 24),
            12,
            100_000,
            |u| light.sample(u).direction,
            |d| light.pdf(d),
            2e-3,
        );
        assert!(p > 1e-4, "p = {p}");
    }

    #[test]
    fn a_sample_carries_what_eval_and_pdf_say_of_its_direction() {
        let light = MapWithLobes::new(map(), lobes());
        for k in 0..10_000 {
            let s = light.sample(uniform(k));
            assert!(s.pdf > 0.0);
            assert_eq!(light.eval_pdf(s.direction), (s.radiance, s.pdf));
        }
    }

    #[test]
    fn with_one_part_black_it_is_the_other_part() {
        let no_lobes = MapWithLobes::new(map(), black_lobes());
        let no_map = MapWithLobes::new(black_map(), lobes());
        for k in 0..1000 {
            let u = uniform(k);
            assert_eq!(no_lobes.sample(u), map().sample(u));
            assert_eq!(no_map.sample(u), Illuminant::sample(&lobes(), u));
        }
        for d in directions() {
            assert_eq!(no_lobes.eval_pdf(d), map().eval_pdf(d));
            assert_eq!(no_map.eval_pdf(d), lobes().eval_pdf(d));
        }
        let dark = MapWithLobes::new(black_map(), black_lobes());
        assert_eq!(dark.sample(Vec2::splat(0.4)).pdf, 0.0);
        assert_eq!(dark.pdf(Vec3::X), 0.0);
    }
}
