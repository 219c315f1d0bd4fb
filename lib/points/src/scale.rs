//! Values of a depth map at any scale, brought to metres by the ground that the picture shows.
use dipir_numerics::sampler::Sampler;
use serde::{Deserialize, Serialize};

use crate::cloud::POINTS;
use crate::error::PointsError;
use crate::plane::{MAD, TUKEY};

/// What the values of a depth map are linear in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// The depth along the optical axis.
    Depth,
    /// One over that depth.
    Disparity,
}

/// How values of a map become metres: depth or disparity is `factor * value + shift`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scale {
    /// What the values are linear in.
    pub measure: Measure,
    /// Metres, or one over metres, of a unit; below 0 where values fall.
    pub factor: f64,
    /// The depth, or the disparity, of the value 0; metres, or one over metres.
    pub shift: f64,
}

/// A scale that was found on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fitted {
    /// The scale.
    pub scale: Scale,
    /// Share of the ground's values that agree, from 0 to 1.
    pub agreeing: f64,
    /// Standard deviation of the depths of these, relative to the ground's.
    pub deviation: f64,
}

/// A value of the map, and the depth of the ground there, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// As in the map.
    pub value: f64,
    /// Of the ground at the same pixel.
    pub ground_m: f64,
}

/// Draws of two values. With a quarter of them on the ground no draw hits it with a probability of
/// (1 - 1/16)^400 = 6e-12.
const DRAWS: u32 = 400;
/// Values that draws are judged by.
const JUDGES: usize = 4000;
/// Values within this of the ground, relative, agree with it.
const AGREES: f64 = 0.05;
/// Cost of what lies below the ground by more than three times that, where other misfits cost 1: nothing is under the
/// ground, but much on it.
const BELOW: f64 = 2.0;
/// Beyond so many times the depth of the nearest ground, but for a fiftieth of it, nothing is compared: distant depths are
/// less sure.
const FARTHEST: f64 = 12.0;
/// Fewest values of the ground.
const FEWEST: usize = 100;
/// Least share of them that has to agree.
const LEAST_AGREEING: f64 = 0.25;
/// The ground that agrees reaches, without its nearest and farthest tenths, over at least so many standard deviations of its
/// depths: a wall has one depth.
const LEAST_RANGE: f64 = 6.0;
/// Depths are at least this, metres, whatever a shift makes of them.
const NEAREST_M: f64 = 0.01;
/// A shift is used if it lowers the cost of a value by this in the mean, as values do that are off by a tenth of what agrees.
const WORTH_A_SHIFT: f64 = 0.01;

impl Scale {
    /// One over the metres of a value, 0 where it is infinitely far; `None` where nothing is known: for 0 as a depth, and
    /// what is not finite.
    pub fn disparity(&self, value: f32) -> Option<f64> {
        if !value.is_finite() || (value == 0.0 && self.measure == Measure::Depth) {
            return None;
        }
        let found = self.factor * f64::from(value) + self.shift;
        Some(match self.measure {
            Measure::Depth => found.max(NEAREST_M).recip(),
            Measure::Disparity => found.max(0.0),
        })
    }

    /// By how much the depth is beyond the ground's, relative; for a disparity relative to the depth itself.
    fn beyond(&self, sample: &Sample) -> f64 {
        let found = self.factor * sample.value + self.shift;
        match self.measure {
            Measure::Depth => found / sample.ground_m - 1.0,
            Measure::Disparity => 1.0 - found * sample.ground_m,
        }
    }
}

/// The scale by which most values of `samples` lie on the ground (RANSAC, judged as MSAC, then least squares weighted by
/// Tukey's function). `measure` is what the values are, and `has_shift` whether there is a shift, if that is known.
///
/// # Errors
/// If there is too little ground, or the values do not agree with it.
pub fn fitted(
    samples: &[Sample],
    measure: Option<Measure>,
    has_shift: Option<bool>,
) -> Result<Fitted, PointsError> {
    let usable = |s: &&Sample| s.value.is_finite() && s.value != 0.0 && s.ground_m > 0.0;
    let mut depths: Vec<f64> = (samples.iter().filter(usable))
        .map(|s| s.ground_m)
        .collect();
    depths.sort_unstable_by(f64::total_cmp);
    let farthest = FARTHEST * depths.get(depths.len() / 50).copied().unwrap_or_default();
    let near: Vec<Sample> = (samples.iter().filter(usable))
        .filter(|s| s.ground_m <= farthest)
        .copied()
        .collect();
    let wrong = |detail: String| {
        let remedy = "is it of this photograph, and are camera and ground right? \
                      depth_scale says how many metres a unit is";
        PointsError::with_remedy("depth", detail, remedy)
    };
    if near.len() < FEWEST {
        return Err(wrong(format!(
            "only {} of its values are seen on the ground, which tells their scale",
            near.len()
        )));
    }
    let measures = match &measure {
        Some(known) => std::slice::from_ref(known),
        None => &[Measure::Depth, Measure::Disparity][..],
    };
    let least_cost = |measure: Measure, has_shift: bool| {
        let scale = ransac(&near, measure, has_shift)?;
        let scale = refined(&near, scale, has_shift).0;
        Some((cost_of(&near, &scale), scale))
    };
    // Disparities without a shift are among those with one.
    let may_shift = |m: &&Measure| has_shift != Some(false) || **m == Measure::Disparity;
    let shifted = measures.iter().filter(may_shift);
    let shifted = shifted.filter_map(|m| least_cost(*m, true));
    let shifted = shifted.min_by(|a, b| a.0.total_cmp(&b.0));
    let plain = match measures.contains(&Measure::Depth) && has_shift != Some(true) {
        true => least_cost(Measure::Depth, false),
        false => None,
    };
    let best = match (plain, shifted) {
        (Some(plain), Some(shifted)) => {
            let is_worth = plain.0 - shifted.0 > WORTH_A_SHIFT * near.len() as f64;
            Some(if is_worth { shifted } else { plain })
        }
        (plain, shifted) => plain.or(shifted),
    };
    let none = || wrong("its values do not follow the ground, nearer or farther".into());
    let (_, scale) = best.ok_or_else(none)?;
    let (scale, deviation) = refined(&near, scale, scale.shift != 0.0);
    let mut on: Vec<f64> = (near.iter().filter(|s| scale.beyond(s).abs() < AGREES))
        .map(|s| s.ground_m)
        .collect();
    let agreeing = on.len() as f64 / near.len() as f64;
    on.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| on[((on.len() - 1) as f64 * share) as usize];
    if agreeing >= LEAST_AGREEING && at(0.9) < (1.0 + LEAST_RANGE * deviation) * at(0.1) {
        return Err(wrong(format!(
            "the ground on which its values agree is all {:.2} to {:.2} m away, which does not tell their scale",
            at(0.1),
            at(0.9)
        )));
    }
    if agreeing < LEAST_AGREEING {
        return Err(wrong(format!(
            "only {:.0}% of its values follow the ground within {:.0}%, which tells their scale",
            100.0 * agreeing,
            100.0 * AGREES
        )));
    }
    Ok(Fitted {
        scale,
        agreeing,
        deviation,
    })
}

/// Of one value or two, on which depth or disparity is `target`.
fn through(a: &Sample, b: &Sample, measure: Measure, has_shift: bool) -> Option<Scale> {
    let target = |s: &Sample| match measure {
        Measure::Depth => s.ground_m,
        Measure::Disparity => s.ground_m.recip(),
    };
    let (factor, shift) = match has_shift {
        false => (target(a) / a.value, 0.0),
        true => {
            let factor = (target(b) - target(a)) / (b.value - a.value);
            (factor, target(a) - factor * a.value)
        }
    };
    (factor.is_finite() && factor != 0.0).then_some(Scale {
        measure,
        factor,
        shift,
    })
}

fn ransac(samples: &[Sample], measure: Measure, has_shift: bool) -> Option<Scale> {
    let every = samples.len().div_ceil(JUDGES).max(1);
    let judges: Vec<Sample> = samples.iter().step_by(every).copied().collect();
    let mut best: Option<(f64, Scale)> = None;
    for draw in 0..DRAWS {
        let mut numbers = Sampler::new(0, POINTS, 1, draw);
        let mut pick = || &judges[(numbers.next_u64() % judges.len() as u64) as usize];
        let (a, b) = (pick(), pick());
        let Some(scale) = through(a, b, measure, has_shift) else {
            continue;
        };
        let cost = cost_of(&judges, &scale);
        if best.is_none_or(|(least, _)| cost < least) {
            best = Some((cost, scale));
        }
    }
    best.map(|b| b.1)
}

fn cost_of(samples: &[Sample], scale: &Scale) -> f64 {
    let cost = |s: &Sample| match scale.beyond(s) / AGREES {
        b if b > 3.0 => BELOW,
        b if b.abs() > 1.0 => 1.0,
        b => b * b,
    };
    samples.iter().map(cost).sum()
}

/// The scale of least squares near `scale`, and the standard deviation of depths by it, relative.
fn refined(samples: &[Sample], scale: Scale, has_shift: bool) -> (Scale, f64) {
    let (mut scale, mut sigma) = (scale, AGREES);
    for _ in 0..12 {
        let reach = TUKEY * sigma;
        // Of the normal equations: value by value, value by one, one by one, and the right side.
        let (mut vv, mut v1, mut ones, mut rv, mut r1) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let mut off: Vec<f64> = Vec::new();
        for s in samples {
            let beyond = scale.beyond(s);
            if beyond.abs() >= reach {
                continue;
            }
            off.push(beyond.abs());
            let weight = (1.0 - (beyond / reach).powi(2)).powi(2);
            // The row that a scale brings to 1.
            let by = match scale.measure {
                Measure::Depth => s.ground_m.recip(),
                Measure::Disparity => s.ground_m,
            };
            let v = s.value * by;
            vv += weight * v * v;
            v1 += weight * v * by;
            ones += weight * by * by;
            rv += weight * v;
            r1 += weight * by;
        }
        let (factor, shift) = match has_shift {
            false => (rv / vv, 0.0),
            true => {
                let determinant = vv * ones - v1 * v1;
                // One value throughout tells no shift.
                if !(determinant > 1e-12 * vv * ones) {
                    break;
                }
                (
                    (rv * ones - r1 * v1) / determinant,
                    (r1 * vv - rv * v1) / determinant,
                )
            }
        };
        if off.len() < 3 || !(factor.is_finite() && shift.is_finite()) {
            break;
        }
        (scale.factor, scale.shift) = (factor, shift);
        let middle = off.len() / 2;
        let median = *off.select_nth_unstable_by(middle, f64::total_cmp).1;
        sigma = (MAD * median).clamp(1e-3 * AGREES, AGREES);
    }
    (scale, sigma)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Ground from 2 m on, of which a share is covered by things that are nearer; `value` makes the map's values of
    /// depths.
    fn samples(covered: f64, noise: f64, value: impl Fn(f64) -> f64) -> Vec<Sample> {
        (0..1000u32)
            .map(|i| {
                let mut numbers = Sampler::new(7, POINTS, 2, i);
                let mut number = || f64::from(numbers.next_1d());
                let ground_m = 2.0 / (1.0 - 0.92 * number());
                let part = match number() < covered {
                    true => 0.2 + 0.7 * number(),
                    false => 1.0 + noise * 3.46 * (number() - 0.5),
                };
                Sample {
                    value: value(ground_m * part),
                    ground_m,
                }
            })
            .collect()
    }

    proptest! {
        #[test]
        fn depths_and_disparities_at_any_scale_become_metres(
            covered in 0.0..0.6f64,
            noise in 0.0..0.02f64,
            factor in 0.01..1000f64,
            shift in 0.05..0.5f64,
            disparity in any::<bool>(),
            shifted in any::<bool>(),
            falls in any::<bool>(),
        ) {
            let shift = if shifted { shift } else { 0.0 };
            let value = |z: f64| match (disparity, falls) {
                // A shift of a depth is a part of the nearest one: depths stay above 0.
                (false, false) => (z - 2.0 * shift) / factor,
                (true, false) => (1.0 / z + shift) * factor,
                (false, true) => (50.0 - z) * factor,
                (true, true) => (10.0 - 1.0 / z) * factor,
            };
            let map = samples(covered, noise, value);
            let fitted = fitted(&map, None, None).unwrap();
            let wanted = if disparity { Measure::Disparity } else { Measure::Depth };
            prop_assert_eq!(fitted.scale.measure, wanted);
            // A shift is left out if it lowers the cost of all values by less than .01 each. At most 60% of them are covered:
            // of the others by .025 at most, which is an error of .16 x 5% = .8% in the mean, and twice that at the ends. The
            // median of uniform errors says 1.28 times their deviation.
            for z in [2.0, 5.0, 12.0] {
                let found = fitted.scale.disparity(value(z) as f32).unwrap();
                prop_assert!((found * z - 1.0).abs() < 0.016 + noise, "{} for {}", found, z);
            }
            prop_assert!(fitted.agreeing > 0.95 * (1.0 - covered));
            prop_assert!(fitted.deviation < 0.008 + 1.6 * noise, "{}", fitted.deviation);
        }
    }

    #[test]
    fn values_that_have_nothing_to_do_with_the_ground_are_refused() {
        let mut map = samples(0.0, 0.0, |z| z);
        let mut numbers = Sampler::new(3, POINTS, 3, 0);
        for s in &mut map {
            s.value = f64::from(numbers.next_1d());
        }
        let error = fitted(&map, None, None).unwrap_err().to_string();
        assert!(error.contains("depth_scale"), "{error}");
        // A wall before all of the ground.
        for s in &mut map {
            s.value = 1.5;
        }
        assert!(fitted(&map, None, None).is_err());
        let error = fitted(&map[..50], None, None).unwrap_err().to_string();
        assert!(error.contains("only 50"), "{error}");
    }

    #[test]
    fn a_kind_that_is_known_is_kept() {
        // Off by a half percent at most: too little for a shift of its own.
        let map = samples(0.3, 0.005, |z| z + 0.01);
        let found = |has_shift| fitted(&map, Some(Measure::Depth), has_shift).unwrap().scale;
        assert_eq!(found(None).shift, 0.0);
        assert_eq!(found(Some(false)), found(None));
        assert!(
            (found(Some(true)).shift + 0.01).abs() < 0.02,
            "{:?}",
            found(Some(true))
        );
        let disparities = samples(0.3, 0.005, |z| 1.0 / z);
        for has_shift in [None, Some(false), Some(true)] {
            let measure = fitted(&disparities, None, has_shift).unwrap().scale.measure;
            assert_eq!(measure, Measure::Disparity, "{has_shift:?}");
        }
    }

    #[test]
    fn ground_seen_steeply_tells_a_scale_although_its_depths_differ_little() {
        let map = |z: f64| 1.0 / z;
        let steep: Vec<Sample> = (0..500)
            .map(|i| {
                let ground_m = 1.6 + 0.0004 * f64::from(i);
                Sample {
                    value: map(ground_m),
                    ground_m,
                }
            })
            .collect();
        let fitted = fitted(&steep, None, None).unwrap();
        assert_eq!(fitted.scale.measure, Measure::Disparity);
        let found = fitted.scale.disparity(map(1.2) as f32).unwrap();
        assert!((found * 1.2 - 1.0).abs() < 1e-3, "{found}");
    }

    #[test]
    fn what_is_unknown_or_infinite_hides_nothing() {
        let metric = Scale {
            measure: Measure::Depth,
            factor: 1.0,
            shift: 0.0,
        };
        let relative = Scale {
            shift: 0.5,
            ..metric
        };
        for value in [0.0, f32::NAN, f32::INFINITY] {
            assert_eq!(metric.disparity(value), None, "{value}");
            assert_eq!(relative.disparity(value), None, "{value}");
        }
        assert_eq!(relative.disparity(0.5), Some(1.0));
        assert_eq!(relative.disparity(-0.5), Some(100.0));
        let disparity = Scale {
            measure: Measure::Disparity,
            factor: 2.0,
            shift: -0.5,
        };
        assert_eq!(disparity.disparity(0.5), Some(0.5));
        assert_eq!(disparity.disparity(0.1), Some(0.0));
        assert_eq!(disparity.disparity(f32::NAN), None);
    }
}
