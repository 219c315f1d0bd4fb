//! How good estimates are on places that nothing was trained on, and their calibration.
use dipir_estimator::grid::{BINS, base_texel};
use dipir_estimator::histogram::{SHARES, STOPS, Scale};
use dipir_estimator::{Calibration, LightEstimate, PeakPosterior};
use dipir_imaging::transfer::Transfer;
use dipir_light::luminance::luminance;
use dipir_numerics::stats::median;
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::examples::Example;
use crate::probes::{NORMALS, PROBES, Probes};

/// Reflectance of the surfaces that are compared.
const ALBEDO: f32 = 0.5;

/// What a stop of wrong exposure counts beside errors of display values, where a calibration is chosen.
const STOP: f64 = 0.1;

/// An estimate beside its truth.
#[derive(Clone, Debug)]
pub struct Case {
    /// The photograph and its light.
    pub example: Example,
    /// What was estimated.
    pub estimate: LightEstimate,
    /// Kind of place.
    pub kind: String,
    /// Fold that was left out.
    pub fold: usize,
    /// The networks' distributions of exposure and share, bin by bin.
    pub histograms: [Vec<f64>; 2],
}

/// Figures over some photographs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Which photographs.
    pub of: String,
    /// How many.
    pub photographs: usize,
    /// Median RMSE of 26 grey surfaces under a neutral light as bright as the photograph's mean, display values.
    pub neutral: f64,
    /// The same under neutral light times the best constant for the other folds.
    pub neutral_scaled: f64,
    /// The same under the estimate's mean light.
    pub estimate: f64,
    /// The same under the estimate at the true exposure.
    pub estimate_exposed: f64,
    /// How often the estimate is better than neutral light.
    pub better: f64,
    /// Median of the mean irradiance's error, stops.
    pub stops: f64,
    /// Photographs whose error is below half a stop.
    pub half_stop: f64,
    /// Median of the root mean square error of irradiance over its mean.
    pub relative: f64,
    /// Median angle between the vectors of light, degrees.
    pub vector_deg: f64,
    /// Median angle from the most probable direction to the strongest source, degrees.
    pub peak_deg: f64,
    /// Truths inside the 80% interval: azimuth, elevation, exposure, share.
    pub coverage: [f64; 4],
    /// Median length of those intervals: degrees, degrees, stops, share.
    pub length: [f64; 4],
}

impl Case {
    /// Probes of the estimated light, on the photograph's scale.
    pub fn found(&self, probes: &Probes) -> Vec<Vec3> {
        let e = &self.estimate;
        let texels = e.base.len();
        let peak = Vec3::from(e.peak);
        (0..PROBES)
            .map(|p| {
                let row = &probes.base[p * texels..(p + 1) * texels];
                let smooth: Vec3 = row
                    .iter()
                    .zip(&e.base)
                    .map(|(w, b)| Vec3::from(*b) * *w)
                    .sum();
                let bins = &probes.bins[p * BINS..(p + 1) * BINS];
                let spread: f32 = bins
                    .iter()
                    .zip(&e.posterior.weights)
                    .map(|(w, q)| w * q)
                    .sum();
                smooth + peak * spread
            })
            .collect()
    }

    /// Mean radiance of the estimated light over the sphere.
    fn mean(&self) -> Vec3 {
        let texel = |(k, t): (usize, &[f32; 3])| Vec3::from(*t) * base_texel(k).1;
        let base: Vec3 = self.estimate.base.iter().enumerate().map(texel).sum();
        (base + Vec3::from(self.estimate.peak)) / (4.0 * std::f32::consts::PI)
    }

    /// Probes of the true light, on the photograph's scale.
    pub fn truth(&self) -> Vec<Vec3> {
        self.example
            .truth
            .all
            .iter()
            .map(|p| *p * self.example.reference)
            .collect()
    }

    fn covered(&self) -> [bool; 4] {
        let (e, t) = (&self.estimate, &self.example.truth);
        let azimuth = f64::from(t.peak.x.atan2(-t.peak.z).to_degrees());
        let elevation = f64::from(t.peak.y.clamp(-1.0, 1.0).asin().to_degrees());
        [
            [-360.0, 0.0, 360.0]
                .iter()
                .any(|turn| e.azimuth_deg.holds(azimuth + turn)),
            e.elevation_deg.holds(elevation),
            e.exposure_stops.holds(f64::from(t.stops)),
            e.share.holds(f64::from(t.share)),
        ]
    }
}

/// RMSE of grey surfaces between two lights, given by their probes, in display values.
pub fn picture_error(found: &[Vec3], truth: &[Vec3], probes: &Probes) -> f64 {
    let shown = |v: f32| f64::from(Transfer::Srgb.encode_scalar(ALBEDO * v));
    let (mut sum, mut total) = (0.0, 0.0);
    for ((a, b), strength) in found.iter().zip(truth).zip(&probes.strength).take(NORMALS) {
        for c in 0..3 {
            sum += f64::from(*strength) * (shown(a[c]) - shown(b[c])).powi(2);
            total += f64::from(*strength);
        }
    }
    (sum / total).sqrt()
}

fn mean_irradiance(probes: &[Vec3]) -> f64 {
    probes[..NORMALS]
        .iter()
        .map(|p| f64::from(luminance(*p)))
        .sum::<f64>()
        / NORMALS as f64
}

fn vector(light: &[Vec3], probes: &Probes) -> Vec3 {
    let sum: Vec3 = light[..NORMALS]
        .iter()
        .zip(&probes.normals)
        .map(|(l, n)| *n * luminance(*l))
        .sum();
    sum.normalize_or_zero()
}

fn angle_deg(a: Vec3, b: Vec3) -> f64 {
    f64::from(a.dot(b).clamp(-1.0, 1.0).acos().to_degrees())
}

/// Errors of one photograph.
struct Errors {
    neutral: f64,
    scaled: f64,
    estimate: f64,
    exposed: f64,
    stops: f64,
    relative: f64,
    vector: f64,
    peak: f64,
    covered: [bool; 4],
    length: [f64; 4],
}

fn errors(case: &Case, constant: f32, probes: &Probes) -> Errors {
    let (found, truth) = (case.found(probes), case.truth());
    let grey = |scale: f32| vec![Vec3::splat(case.example.reference * scale); PROBES];
    let (here, there) = (mean_irradiance(&found), mean_irradiance(&truth).max(1e-9));
    let matched: Vec<Vec3> = found.iter().map(|p| *p * (there / here) as f32).collect();
    let square = |(a, b): (&Vec3, &Vec3)| f64::from(luminance(*a) - luminance(*b)).powi(2);
    let mean_square = found[..NORMALS].iter().zip(&truth).map(square).sum::<f64>() / NORMALS as f64;
    let e = &case.estimate;
    Errors {
        neutral: picture_error(&grey(1.0), &truth, probes),
        scaled: picture_error(&grey(constant), &truth, probes),
        estimate: picture_error(&found, &truth, probes),
        exposed: picture_error(&matched, &truth, probes),
        stops: (here / there).log2().abs(),
        relative: mean_square.sqrt() / there,
        vector: angle_deg(vector(&found, probes), vector(&truth, probes)),
        peak: angle_deg(e.posterior.mode(), case.example.truth.peak),
        covered: case.covered(),
        length: [e.azimuth_deg, e.elevation_deg, e.exposure_stops, e.share].map(|i| i.high - i.low),
    }
}

fn best_constant(cases: &[&Case], probes: &Probes) -> f32 {
    let error = |scale: f32| -> f64 {
        let one = |c: &&Case| {
            picture_error(
                &vec![Vec3::splat(c.example.reference * scale); PROBES],
                &c.truth(),
                probes,
            )
        };
        cases.iter().map(one).sum()
    };
    (0..30)
        .map(|k| 0.5 * 1.08f32.powi(k))
        .min_by(|a, b| error(*a).total_cmp(&error(*b)))
        .unwrap_or(1.0)
}

/// Figures for all photographs, those with a sun, and each kind of place.
pub fn figures(cases: &[Case], probes: &Probes) -> Vec<Figures> {
    let folds = cases.iter().map(|c| c.fold).max().map_or(0, |f| f + 1);
    // Places of one fold alone have no others.
    let alone = cases.windows(2).all(|w| w[0].fold == w[1].fold);
    let constants: Vec<f32> = (0..folds)
        .map(|f| {
            best_constant(
                &cases
                    .iter()
                    .filter(|c| c.fold != f || alone)
                    .collect::<Vec<_>>(),
                probes,
            )
        })
        .collect();
    let all: Vec<(&Case, Errors)> = cases
        .iter()
        .map(|c| (c, errors(c, constants[c.fold], probes)))
        .collect();
    let mut kinds: Vec<&str> = cases.iter().map(|c| c.kind.as_str()).collect();
    kinds.sort_unstable();
    kinds.dedup();
    let mut rows = vec![summary("all", all.iter())];
    rows.push(summary(
        "with a sun",
        all.iter().filter(|c| c.0.example.truth.sun),
    ));
    rows.push(summary(
        "without",
        all.iter().filter(|c| !c.0.example.truth.sun),
    ));
    for kind in kinds {
        rows.push(summary(kind, all.iter().filter(|c| c.0.kind == kind)));
    }
    rows.retain(|r| r.photographs > 0);
    rows
}

fn summary<'a>(of: &str, cases: impl Iterator<Item = &'a (&'a Case, Errors)>) -> Figures {
    let all: Vec<&Errors> = cases.map(|c| &c.1).collect();
    let middle = |value: &dyn Fn(&Errors) -> f64| {
        median(&all.iter().map(|e| value(e)).collect::<Vec<_>>()).unwrap_or(f64::NAN)
    };
    let share = |test: &dyn Fn(&Errors) -> bool| {
        all.iter().filter(|e| test(e)).count() as f64 / all.len().max(1) as f64
    };
    Figures {
        of: of.into(),
        photographs: all.len(),
        neutral: middle(&|e| e.neutral),
        neutral_scaled: middle(&|e| e.scaled),
        estimate: middle(&|e| e.estimate),
        estimate_exposed: middle(&|e| e.exposed),
        better: share(&|e| e.estimate < e.neutral),
        stops: middle(&|e| e.stops),
        half_stop: share(&|e| e.stops < 0.5),
        relative: middle(&|e| e.relative),
        vector_deg: middle(&|e| e.vector),
        peak_deg: middle(&|e| e.peak),
        coverage: std::array::from_fn(|k| share(&|e| e.covered[k])),
        length: std::array::from_fn(|k| middle(&|e| e.length[k])),
    }
}

/// A calibration from estimates that have none, each of a place that its network was not trained on.
pub fn calibration(cases: &[&Case], probes: &Probes) -> Calibration {
    let [exposure, told] = exposure_calibration(cases, probes);
    let surprise = |temperature: f64| -> f64 {
        cases
            .iter()
            .map(|c| {
                let powers = c
                    .estimate
                    .posterior
                    .weights
                    .iter()
                    .map(|w| f64::from(*w).powf(1.0 / temperature));
                -PeakPosterior::normalised(powers.collect())
                    .density(c.example.truth.peak)
                    .max(1e-9)
                    .ln()
            })
            .sum()
    };
    let temperature = (0..16)
        .map(|k| 0.7 * 1.1f64.powi(k))
        .min_by(|a, b| surprise(*a).total_cmp(&surprise(*b)));
    Calibration {
        exposure,
        told,
        temperature: temperature.unwrap_or(1.0),
        exposure_tails: {
            let all = ranks(cases, |c| {
                (&STOPS, &c.histograms[0], f64::from(c.example.truth.stops))
            });
            [outside(&all, 0.1), outside(&reversed(&all), 0.1)]
        },
        share_tails: share_tails(cases),
    }
}

/// Where each truth lies in its predicted distribution, 0 to 1.
fn ranks<'c>(
    cases: &[&'c Case],
    of: impl Fn(&'c Case) -> (&'c Scale, &'c Vec<f64>, f64),
) -> Vec<f64> {
    let rank = |c: &&'c Case| {
        let (scale, weights, value) = of(c);
        scale.rank(weights, value)
    };
    cases.iter().map(rank).collect()
}

fn reversed(ranks: &[f64]) -> Vec<f64> {
    ranks.iter().map(|r| 1.0 - r).collect()
}

/// The tail below which `share` of the ranks lie.
fn outside(ranks: &[f64], share: f64) -> f64 {
    let mut all = ranks.to_vec();
    all.sort_by(f64::total_cmp);
    let at = (share * all.len() as f64) as usize;
    all.get(at).copied().unwrap_or(share).clamp(0.002, 0.4)
}

/// Shares are those of suns or those of everything else. The upper tail leaves out a fifth of the suns, the lower one
/// a seventh of the rest, so that either kind is held about as often.
fn share_tails(cases: &[&Case]) -> [f64; 2] {
    let of = |sun: bool| {
        let some: Vec<&Case> = cases
            .iter()
            .copied()
            .filter(|c| c.example.truth.sun == sun)
            .collect();
        ranks(&some, |c| {
            (&SHARES, &c.histograms[1], f64::from(c.example.truth.share))
        })
    };
    [
        outside(&of(false), 0.18),
        outside(&reversed(&of(true)), 0.18),
    ]
}

/// The exposure's factor and the weight of its median that make the error of surfaces, and their exposure error in
/// stops, least.
fn exposure_calibration(cases: &[&Case], probes: &Probes) -> [f64; 2] {
    let lights: Vec<(Vec<Vec3>, f64, Vec<Vec3>)> = cases
        .iter()
        .map(|c| {
            let over = f64::from(luminance(c.mean()) / c.example.reference);
            let told = c.estimate.exposure_stops.middle - over.max(1e-6).log2();
            (c.found(probes), told, c.truth())
        })
        .collect();
    let error = |[exposure, weight]: [f64; 2]| -> f64 {
        let one = |(found, told, truth): &(Vec<Vec3>, f64, Vec<Vec3>)| {
            let scale = (exposure * (weight * told).exp2()) as f32;
            let light: Vec<Vec3> = found.iter().take(NORMALS).map(|p| *p * scale).collect();
            let off = mean_irradiance(&light) / mean_irradiance(truth).max(1e-9);
            picture_error(&light, truth, probes) + STOP * off.max(1e-9).log2().abs()
        };
        lights.iter().map(one).sum()
    };
    let choices: [Vec<f64>; 2] = [
        (0..25).map(|k| 0.6 * 1.04f64.powi(k)).collect(),
        (0..6).map(|k| 0.2 * f64::from(k)).collect(),
    ];
    let mut best = [1.0, 0.0];
    for _ in 0..3 {
        for (n, choices) in choices.iter().enumerate() {
            let with = |value: f64| {
                let mut all = best;
                all[n] = value;
                (error(all), value)
            };
            let found = choices.iter().map(|v| with(*v));
            if let Some(found) = found.min_by(|a, b| a.0.total_cmp(&b.0)) {
                best[n] = found.1;
            }
        }
    }
    best
}

/// The figures as a table in Markdown.
pub fn table(rows: &[Figures]) -> String {
    let mut text = String::from(
        "| photographs | n | neutral | times a constant | estimate | at true exposure | better than neutral | stops | \
         within .5 | relative irradiance | vector, deg | peak, deg | azimuth held (arc) | elevation held | exposure held | share held |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for r in rows {
        let percent = |v: f64| format!("{:.0}%", 100.0 * v);
        text += &format!(
            "| {} | {} | {:.3} | {:.3} | {:.3} | {:.3} | {} | {:.2} | {} | {:.2} | {:.0} | {:.0} | {} ({:.0}) | {} ({:.0}) | {} ({:.1}) | {} ({:.2}) |\n",
            r.of,
            r.photographs,
            r.neutral,
            r.neutral_scaled,
            r.estimate,
            r.estimate_exposed,
            percent(r.better),
            r.stops,
            percent(r.half_stop),
            r.relative,
            r.vector_deg,
            r.peak_deg,
            percent(r.coverage[0]),
            r.length[0],
            percent(r.coverage[1]),
            r.length[1],
            percent(r.coverage[2]),
            r.length[2],
            percent(r.coverage[3]),
            r.length[3],
        );
    }
    text
}
