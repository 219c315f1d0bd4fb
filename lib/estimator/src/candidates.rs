//! Lights that the photograph allows, far apart from each other.
use dipir_light::environment::EnvironmentMap;
use dipir_light::fit::fit;
use dipir_light::gaussian::SphericalGaussian;
use glam::{Quat, Vec3};

use crate::estimate::LightEstimate;
use crate::grid::{BINS, bin_direction};
use crate::posterior::{soft_bins, words};

/// Candidates stand at least this far apart, degrees.
const APART_DEG: f32 = 40.0;
/// Width of a candidate's source, radians: a sun's shadows, softened by a few degrees.
const SOURCE_SIGMA: f32 = 0.03;
/// Lights that are less probable than this are not shown.
const LEAST: f64 = 1e-4;
/// Lobes of the smooth part.
const BASE_LOBES: usize = 12;

/// One light that the photograph allows.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// How probable it is; the candidates' sum to 1.
    pub probability: f64,
    /// Where its light comes from, relative to the view, in words.
    pub words: String,
    /// Unit vector towards its source in the world; `None` for soft light.
    pub direction: Option<Vec3>,
    /// The light as a map in the world.
    pub map: EnvironmentMap,
    /// The same as lobes; the source comes first.
    pub lobes: Vec<SphericalGaussian>,
}

impl LightEstimate {
    /// At most `count` lights, the most probable first: soft light without a sun, and suns that stand at least 40
    /// degrees apart, or the one sun whose direction is known.
    pub fn candidates(&self, count: usize) -> Vec<Candidate> {
        if count == 0 {
            return Vec::new();
        }
        let shining = self.shining();
        let base = fit(&shining.base_map(), BASE_LOBES).lobes;
        let mut all = vec![Candidate {
            probability: 1.0 - self.sun_probability,
            words: "soft light without a sun".into(),
            direction: None,
            map: self.map(),
            lobes: self.lobes(2 * BASE_LOBES),
        }];
        let suns = match self.source {
            Some(source) => vec![(source.direction, 1.0)],
            None => {
                let centres = self.centres(count - 1);
                let shares = self.shares(&centres);
                let to_world = Quat::from_rotation_y(-self.heading_rad as f32);
                let towards = centres.iter().map(|k| to_world * bin_direction(*k));
                towards.zip(shares).collect()
            }
        };
        for (direction, share) in suns {
            all.push(shining.sun(direction, self.sun_probability * share, &base));
        }
        all.retain(|c| c.probability > LEAST);
        all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
        all.truncate(count);
        let total: f64 = all.iter().map(|c| c.probability).sum();
        all.iter_mut()
            .for_each(|c| c.probability /= total.max(1e-12));
        all
    }

    /// The most probable bins, each far from those before.
    fn centres(&self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..BINS).collect();
        order.sort_by(|a, b| {
            self.posterior
                .around(*b)
                .total_cmp(&self.posterior.around(*a))
        });
        let mut chosen: Vec<usize> = Vec::new();
        let near = APART_DEG.to_radians().cos();
        for k in order {
            let far = chosen
                .iter()
                .all(|c| bin_direction(*c).dot(bin_direction(k)) < near);
            if far && chosen.len() < count {
                chosen.push(k);
            }
        }
        chosen
    }

    /// Each bin's probability goes to the nearest of `centres`.
    fn shares(&self, centres: &[usize]) -> Vec<f64> {
        let mut shares = vec![0.0; centres.len()];
        for (k, w) in self.posterior.weights.iter().enumerate() {
            let closeness = |c: &usize| bin_direction(centres[*c]).dot(bin_direction(k));
            let nearest = (0..centres.len()).max_by(|a, b| closeness(a).total_cmp(&closeness(b)));
            if let Some(n) = nearest {
                shares[n] += f64::from(*w);
            }
        }
        shares
    }

    /// A sun of this estimate, which takes it for granted, over its smooth part.
    fn sun(&self, direction: Vec3, probability: f64, base: &[SphericalGaussian]) -> Candidate {
        let mut source = SphericalGaussian {
            direction,
            radiance: Vec3::ONE,
            sigma: self.source_lobe().map_or(SOURCE_SIGMA, |known| known.sigma),
        };
        source.radiance = Vec3::from(self.peak) / source.solid_angle() as f32;
        let mut lobes = vec![source];
        lobes.extend_from_slice(base);
        let seen = Quat::from_rotation_y(self.heading_rad as f32) * direction;
        Candidate {
            probability,
            words: words(seen),
            direction: Some(direction),
            map: self.map_with(&soft_bins(seen)),
            lobes,
        }
    }
}
