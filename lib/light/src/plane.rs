//! Light on a plane, as the shadow ratio needs it: the irradiance of an unoccluded plane in closed form,
//! and directions drawn from inside a cone.
use glam::{DVec3, Vec2, Vec3};

use crate::cone::{ConeSample, ConeSampler};
use crate::cosine::CosineWeightedMap;
use crate::gaussian::{SgMixture, SphericalGaussian};
use crate::illuminant::Illuminant;
use crate::luminance::luminance_f64;
use crate::rasterize::rasterize;

/// A distant light as seen by a plane with a fixed normal.
pub trait PlaneLight: Sync {
    /// The sampler that [`cone`](Self::cone) makes.
    type Cone<'a>: LightInCone
    where
        Self: 'a;
    /// The plane's unit normal.
    fn normal(&self) -> Vec3;
    /// Irradiance of the unoccluded plane, per channel.
    fn irradiance(&self) -> DVec3;
    /// A sampler to be restricted to one cone after another; keep one per thread.
    fn cone(&self) -> Self::Cone<'_>;
}

/// A light restricted to a cone of directions.
pub trait LightInCone {
    /// Restricts to directions within the angle `acos(cos_max)` of the unit vector `axis`.
    fn restrict(&mut self, axis: Vec3, cos_max: f32);
    /// About the luminance of the irradiance from inside the cone, never less than 0; 0 only if
    /// nothing comes from there.
    fn mass(&self) -> f64;
    /// Draws a direction from two uniform numbers in `[0, 1)`. The mean of `weight * f` is
    /// unbiased for the integral of `radiance * cosine * f` for every `f` that is zero outside
    /// the cone.
    fn sample(&self, u: Vec2) -> ConeSample;
    /// Density per steradian of [`sample`](Self::sample) at the unit vector `direction`.
    fn pdf(&self, direction: Vec3) -> f32;
}

impl PlaneLight for CosineWeightedMap {
    type Cone<'a> = ConeSampler<'a>;
    fn normal(&self) -> Vec3 {
        CosineWeightedMap::normal(self)
    }
    fn irradiance(&self) -> DVec3 {
        CosineWeightedMap::irradiance(self)
    }
    fn cone(&self) -> ConeSampler<'_> {
        CosineWeightedMap::cone(self)
    }
}

impl LightInCone for ConeSampler<'_> {
    fn restrict(&mut self, axis: Vec3, cos_max: f32) {
        ConeSampler::restrict(self, axis, cos_max);
    }
    fn mass(&self) -> f64 {
        ConeSampler::mass(self)
    }
    fn sample(&self, u: Vec2) -> ConeSample {
        ConeSampler::sample(self, u)
    }
    fn pdf(&self, direction: Vec3) -> f32 {
        ConeSampler::pdf(self, direction)
    }
}

/// Lobes narrower than this, in radians, are sampled by themselves: two texels of the map that
/// proposes directions for the wide ones.
const NARROW_SIGMA: f32 = 0.1;
/// Size of the map that proposes directions for wide lobes.
const PROPOSAL: (usize, usize) = (128, 64);
/// Share of the whole irradiance that a constant floor adds to the proposal, so that its density
/// is positive wherever any lobe, however faint there, shines.
const FLOOR: f64 = 1e-3;
/// A narrow lobe further outside the cone than this many sigma (`exp(-18)` of its peak) is left
/// to the floor.
const NARROW_REACH: f32 = 6.0;

/// Spherical Gaussians seen by a plane.
///
/// Radiance is always that of the lobes themselves. Directions come from a mixture of the wide
/// lobes' map, restricted to the cone, and of the narrow lobes that reach into it.
#[derive(Clone, Debug)]
pub struct CosineWeightedMixture {
    mixture: SgMixture,
    normal: Vec3,
    irradiance: DVec3,
    proposal: CosineWeightedMap,
    narrow: Vec<Narrow>,
}

#[derive(Clone, Copy, Debug)]
struct Narrow {
    lobe: usize,
    /// Angle from the axis that the lobe reaches, radians.
    reach: f32,
    /// Luminance of the lobe's irradiance on the plane.
    mass: f64,
    /// One over the lobe's solid angle.
    pdf_peak: f64,
}

impl CosineWeightedMixture {
    /// The light of `mixture` on a plane with the unit vector `normal`.
    pub fn new(mixture: SgMixture, normal: Vec3) -> Self {
        let irradiance = mixture.irradiance(normal);
        let is_narrow = |g: &SphericalGaussian| g.sigma < NARROW_SIGMA;
        let narrow = mixture.lobes().iter().enumerate();
        let narrow = narrow
            .filter(|(_, g)| is_narrow(g))
            .map(|(lobe, g)| Narrow {
                lobe,
                reach: NARROW_REACH * g.sigma,
                mass: luminance_f64(g.irradiance(normal)),
                pdf_peak: 1.0 / g.solid_angle(),
            })
            .filter(|n| n.mass > 0.0)
            .collect();
        let mut wide: Vec<_> = mixture.lobes().to_vec();
        wide.retain(|g| !is_narrow(g));
        let floor = FLOOR * luminance_f64(irradiance) / std::f64::consts::PI;
        // A lobe of sigma 1000 is constant to 2e-6.
        wide.push(SphericalGaussian {
            direction: Vec3::Y,
            radiance: Vec3::splat(floor as f32),
            sigma: 1000.0,
        });
        let map = rasterize(&wide, PROPOSAL.0, PROPOSAL.1);
        Self {
            proposal: CosineWeightedMap::new(map, normal),
            mixture,
            normal,
            irradiance,
            narrow,
        }
    }

    /// The lobes.
    pub fn mixture(&self) -> &SgMixture {
        &self.mixture
    }
}

impl PlaneLight for CosineWeightedMixture {
    type Cone<'a> = MixtureInCone<'a>;
    fn normal(&self) -> Vec3 {
        self.normal
    }
    fn irradiance(&self) -> DVec3 {
        self.irradiance
    }
    fn cone(&self) -> MixtureInCone<'_> {
        MixtureInCone {
            light: self,
            wide: self.proposal.cone(),
            narrow: Vec::with_capacity(self.narrow.len()),
            mass: 0.0,
        }
    }
}

/// Samples a [`CosineWeightedMixture`] inside one cone after another.
#[derive(Clone, Debug)]
pub struct MixtureInCone<'a> {
    light: &'a CosineWeightedMixture,
    wide: ConeSampler<'a>,
    narrow: Vec<Narrow>,
    mass: f64,
}

impl LightInCone for MixtureInCone<'_> {
    fn restrict(&mut self, axis: Vec3, cos_max: f32) {
        self.wide.restrict(axis, cos_max);
        self.narrow.clear();
        let half_angle = cos_max.clamp(-1.0, 1.0).acos();
        for n in &self.light.narrow {
            let lobe = &self.light.mixture.lobes()[n.lobe];
            let chord = 0.5 * (lobe.direction - axis).length();
            if 2.0 * chord.min(1.0).asin() <= half_angle + n.reach {
                self.narrow.push(*n);
            }
        }
        self.mass = self.wide.mass() + self.narrow.iter().map(|n| n.mass).sum::<f64>();
    }

    fn mass(&self) -> f64 {
        self.mass
    }

    fn sample(&self, u: Vec2) -> ConeSample {
        if self.mass <= 0.0 {
            return ConeSample::NONE;
        }
        let target = f64::from(u.y) * self.mass;
        let direction = if target < self.wide.mass() || self.narrow.is_empty() {
            let v = (target / self.wide.mass()) as f32;
            self.wide.sample(Vec2::new(u.x, v.min(1.0))).direction
        } else {
            let mut rest = target - self.wide.mass();
            let mut k = 0;
            while k + 1 < self.narrow.len() && rest >= self.narrow[k].mass {
                rest -= self.narrow[k].mass;
                k += 1;
            }
            let azimuth = (rest / self.narrow[k].mass).min(1.0) as f32;
            let lobe = self.narrow[k].lobe;
            self.light
                .mixture
                .sample_lobe(lobe, Vec2::new(u.x, azimuth))
        };
        let radiance = self.light.mixture.eval(direction);
        let cosine = self.light.normal.dot(direction).max(0.0);
        let pdf = self.pdf(direction);
        ConeSample {
            direction,
            radiance,
            cosine,
            pdf,
            weight: if pdf > 0.0 {
                radiance * (cosine / pdf)
            } else {
                Vec3::ZERO
            },
        }
    }

    fn pdf(&self, direction: Vec3) -> f32 {
        if self.mass <= 0.0 {
            return 0.0;
        }
        let mut density = self.wide.mass() * f64::from(self.wide.pdf(direction));
        for n in &self.narrow {
            let lobe = SphericalGaussian {
                radiance: Vec3::X,
                ..self.light.mixture.lobes()[n.lobe]
            };
            density += n.mass * n.pdf_peak * f64::from(lobe.eval(direction).x);
        }
        (density / self.mass) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{chi_squared, lobe, uniform};
    use dipir_numerics::stats::Running;

    fn light(normal: Vec3) -> CosineWeightedMixture {
        let lobes = vec![
            lobe(Vec3::Y, Vec3::new(0.3, 0.5, 1.0), 10.0),
            lobe(Vec3::new(0.4, 0.6, 0.2), Vec3::splat(300.0), 0.05),
            lobe(Vec3::new(-0.3, 0.4, -1.0), Vec3::new(2.0, 1.0, 0.5), 0.4),
        ];
        CosineWeightedMixture::new(SgMixture::new(lobes).unwrap(), normal)
    }

    #[test]
    fn samples_follow_the_density_of_the_mixture_in_the_cone() {
        let light = light(Vec3::Y);
        let mut cone = light.cone();
        for (axis, half_angle) in [
            (Vec3::new(0.3, 0.7, 0.1), 0.4f32),
            (Vec3::new(-0.5, 0.5, 0.0), 0.3),
        ] {
            cone.restrict(axis.normalize(), half_angle.cos());
            let p = chi_squared(
                (64, 32),
                32,
                100_000,
                |u| cone.sample(u).direction,
                |d| cone.pdf(d),
                2e-3,
            );
            assert!(p > 1e-4, "{axis}: p = {p}");
        }
    }

    #[test]
    fn the_mean_weight_inside_the_cone_is_the_irradiance_from_there() {
        let normal = Vec3::Y;
        let light = light(normal);
        let mut cone = light.cone();
        for (axis, half_angle) in [
            (Vec3::new(0.3, 0.7, 0.1), 0.4f32),
            (Vec3::new(0.4, 0.6, 0.3), 0.02),
            (Vec3::Y, 3.1),
        ] {
            let axis = axis.normalize();
            cone.restrict(axis, half_angle.cos());
            let mut mean = Running::default();
            for k in 0..60_000 {
                let s = cone.sample(uniform(k));
                let inside = s.direction.dot(axis) >= half_angle.cos();
                mean.push(if inside { s.weight.x.into() } else { 0.0 });
            }
            // Rings around the axis, midpoints in both.
            let (rings, turns) = (800, 800);
            let frame = dipir_numerics::warp::Frame::from_normal(axis);
            let mut exact = 0.0;
            for a in 0..rings {
                let step = f64::from(half_angle) / f64::from(rings);
                let psi = (f64::from(a) + 0.5) * step;
                for b in 0..turns {
                    let phi = (f64::from(b) + 0.5) / f64::from(turns) * std::f64::consts::TAU;
                    let (s, c) = (psi.sin() as f32, psi.cos() as f32);
                    let d =
                        frame.to_world(Vec3::new(s * phi.cos() as f32, s * phi.sin() as f32, c));
                    let value = light.mixture().eval(d).x * d.dot(normal).max(0.0);
                    exact += f64::from(value) * psi.sin() * step * std::f64::consts::TAU
                        / f64::from(turns);
                }
            }
            let error = (mean.mean() - exact).abs();
            assert!(
                error < 5.0 * mean.std_error() + 1e-4 * exact,
                "{axis}: {} against {exact}",
                mean.mean()
            );
        }
        assert!(
            (light.irradiance() / light.mixture().irradiance(normal) - 1.0)
                .abs()
                .max_element()
                < 1e-12
        );
    }

    #[test]
    fn a_black_mixture_gives_no_sample() {
        let light = CosineWeightedMixture::new(SgMixture::new(vec![]).unwrap(), Vec3::Y);
        let mut cone = light.cone();
        cone.restrict(Vec3::Y, 0.5);
        assert_eq!(cone.mass(), 0.0);
        assert_eq!(cone.sample(Vec2::splat(0.5)), ConeSample::NONE);
    }
}
