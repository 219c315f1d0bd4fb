//! Photographs of places as features, with the light that is to be learned from each.
use std::f32::consts::TAU;
use std::sync::Arc;

use dipir_backbone::Tuned;
use dipir_estimator::grid::{BASE, BASE_TEXELS};
use dipir_light::luminance::luminance;
use glam::Vec3;
use rayon::prelude::*;

use crate::place::{Place, SMOOTH};
use crate::probes::{PROBES, Probes};
use crate::view::View;

/// What is to be learned from one photograph, relative to its mean luminance.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Probes of the light without its strongest source.
    pub smooth: Vec<Vec3>,
    /// Probes of all light.
    pub all: Vec<Vec3>,
    /// Energy of the strongest source.
    pub energy: Vec3,
    /// Unit vector towards it, relative to the view.
    pub peak: Vec3,
    /// Its share of the light.
    pub share: f32,
    /// Whether it is like a sun.
    pub sun: bool,
    /// Mean radiance over the sphere, stops.
    pub stops: f32,
    /// Logarithm of the smooth part on the estimator's texels.
    pub log_base: Vec<[f32; 3]>,
}

/// How photographs and lights are looked at.
#[derive(Clone, Copy)]
pub struct Seen<'a> {
    /// The lights.
    pub probes: &'a Probes,
    /// Tunings of the backbone, one for each fold, or none.
    pub tuned: &'a [Arc<Tuned>],
}

/// One photograph.
#[derive(Clone, Debug)]
pub struct Example {
    /// Number of the place.
    pub place: usize,
    /// Features of the photograph and of its mirror image, for each tuning of the backbone; once where there is none.
    pub features: Vec<[Vec<f32>; 2]>,
    /// Mean linear luminance.
    pub reference: f32,
    /// What is to be learned.
    pub truth: Truth,
}

impl Example {
    /// The photograph that `view` takes of a place.
    pub fn new(place: &Place, number: usize, view: &View, seen: &Seen<'_>, seed: u64) -> Self {
        let probes = seen.probes;
        let (small, gain, curve) = view.take(place, seed);
        let reference = small.reference();
        let mut truth = Truth::new(place, view.heading, gain * curve / reference, probes);
        if let Some(albedo) = probes.albedo {
            truth.develop(|x| view.develop(albedo * x * reference / curve) / albedo / reference);
        }
        Self {
            place: number,
            features: small.both_sides(seen.tuned),
            reference,
            truth,
        }
    }
}

impl Example {
    /// The features that the networks of fold `f` see.
    pub fn of_fold(&self, f: usize) -> &[[Vec<f32>; 2]] {
        std::slice::from_ref(&self.features[f % self.features.len()])
    }
}

impl Truth {
    /// The light of a place for a view turned by `heading` columns, `scale` times the panorama's.
    pub fn new(place: &Place, heading: usize, scale: Vec3, probes: &Probes) -> Self {
        let smooth: Vec<Vec3> = probes
            .of_smooth(&place.smooth, heading)
            .iter()
            .map(|p| *p * scale)
            .collect();
        let turn = heading as f32 / SMOOTH[0] as f32 * TAU;
        let azimuth = place.peak.x.atan2(-place.peak.z) - turn;
        let peak = dipir_estimator::grid::direction(azimuth, place.peak.y.clamp(-1.0, 1.0).asin());
        let energy = place.energy * scale;
        let all = (0..PROBES)
            .map(|p| smooth[p] + energy * probes.weight(p, peak))
            .collect();
        let mean = (luminance(place.mean() * scale)).max(1e-6);
        let (columns, rows) = (SMOOTH[0] / BASE[0], SMOOTH[1] / BASE[1]);
        let log_base = (0..BASE_TEXELS)
            .map(|k| {
                let (i, j) = (k / BASE[0] * rows, k % BASE[0] * columns + heading);
                let cell = (0..rows * columns)
                    .map(|c| {
                        place
                            .smooth
                            .texel(i + c / columns, (j + c % columns) % SMOOTH[0])
                    })
                    .sum::<Vec3>();
                (cell * scale / (rows * columns) as f32)
                    .to_array()
                    .map(|v| (v + 1e-3).ln())
            })
            .collect();
        Self {
            smooth,
            all,
            energy,
            peak,
            share: place.share as f32,
            sun: place.sun,
            stops: mean.log2(),
            log_base,
        }
    }

    /// Makes of each probe the light under which a surface looks as the camera's curve shows it.
    fn develop(&mut self, shown: impl Fn(f32) -> f32) {
        for p in self.all.iter_mut().chain(&mut self.smooth) {
            *p = Vec3::from_array(p.to_array().map(&shown));
        }
    }

    /// What is to be learned from the photograph in a mirror.
    pub fn mirrored(&self, probes: &Probes) -> Self {
        let turned = |v: &[Vec3]| probes.mirrored.iter().map(|k| v[*k]).collect();
        let texel = |k: usize| self.log_base[dipir_estimator::grid::mirrored_texel(k)];
        Self {
            smooth: turned(&self.smooth),
            all: turned(&self.all),
            peak: Vec3::new(-self.peak.x, self.peak.y, self.peak.z),
            log_base: (0..BASE_TEXELS).map(texel).collect(),
            ..*self
        }
    }
}

/// `count` photographs of each place.
pub fn drawn(places: &[Place], count: usize, seen: &Seen<'_>, seed: u64) -> Vec<Example> {
    (0..places.len() * count)
        .into_par_iter()
        .map(|k| {
            let (place, n) = (k / count, k % count);
            let view = View::drawn(seed, place, n);
            Example::new(&places[place], place, &view, seen, seed ^ (k as u64) << 20)
        })
        .collect()
}

/// `count` photographs of each place as the evaluation takes them, around the horizon.
pub fn standard(places: &[Place], count: usize, seen: &Seen<'_>) -> Vec<Example> {
    (0..places.len() * count)
        .into_par_iter()
        .map(|k| {
            let (place, n) = (k / count, k % count);
            let view = View::standard((n * SMOOTH[0] / count + 7 * place) % SMOOTH[0]);
            Example::new(&places[place], place, &view, seen, 0)
        })
        .collect()
}
