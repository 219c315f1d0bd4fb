//! From a folder of panoramas to weights and figures.
use std::path::PathBuf;

use dipir_calibration::generated::{Built, picture};
use dipir_calibration::look::FEATURES;
use dipir_calibration::network::{Member, Network};
use dipir_calibration::pose::{Pose, fov_deg, log_focal};
use dipir_calibration::whole::MOST_BLUR;
use dipir_calibration::{CameraEstimator, Evidence, KnownFocal, SEARCHED, Scores};
use dipir_imaging::raster::LinearImage;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::stats::median;
use rayon::prelude::*;

use crate::cameras::figures::{Case, Row};
use crate::cameras::trainer::{Sample, train, train_whole};
use crate::error::PlacesError;
use crate::network::SplitMix64;
use crate::place::{Place, filled_folds, read_places};
use crate::run::write;
use crate::shot::{JUDGED, LEARNED, Range, Shot};

pub use crate::cameras::trainer::Training;

/// Powers of the scores' density that are tried.
const TRUSTS: [f64; 16] = [
    0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2.0, 2.2,
];
/// Share of intervals that should hold the truth.
const HELD: f64 = 0.9;
/// Half sides of the boxes around the true camera that other cameras are drawn from: degrees of pitch, twice those of
/// roll, and 3% of the field of view each. As many more are drawn from everywhere as from a box.
const BOXES: [f64; 6] = [0.6, 1.2, 2.5, 5.0, 10.0, 20.0];
/// Cameras drawn from each, with the true focal length and with any.
const DRAWN: usize = 4;
/// The true camera stands for a box of this half side.
const OWN_BOX: f64 = 0.3;

/// What is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Folder of panoramas.
    pub panoramas: PathBuf,
    /// The file of weights.
    pub out: PathBuf,
    /// Folds of places; each is left out by one network.
    pub folds: usize,
    /// Photographs drawn of each place.
    pub views: usize,
    /// Generated streets and rooms on which the networks are trained.
    pub learned: usize,
    /// Photographs of each place on which the networks are judged.
    pub judged: usize,
    /// Generated streets and rooms on which the networks are judged.
    pub built: usize,
    /// Seed of photographs and networks.
    pub seed: u64,
    /// Of the networks that score cameras.
    pub scorers: Training,
    /// Of the networks that see pictures as a whole.
    pub wholes: Training,
    /// One deviation of a known focal length, relative.
    pub focal_sigma: f64,
}

impl Settings {
    /// Those of the weights that are part of the program.
    pub fn new(panoramas: PathBuf, out: PathBuf) -> Self {
        Self {
            panoramas,
            out,
            folds: 6,
            views: 100,
            learned: 320,
            judged: 5,
            built: 32,
            seed: 1,
            scorers: Training::of_scorers(),
            wholes: Training::of_wholes(),
            focal_sigma: 0.02,
        }
    }
}

/// How far it is.
#[derive(Clone, Debug)]
pub enum Progress {
    /// Panoramas were read.
    Places(usize),
    /// Photographs were drawn.
    Photographs(usize),
    /// Networks see pictures as a whole.
    Wholes(usize),
    /// A network that scores is being trained: its fold, the share that is done, the mean loss of late.
    Training(usize, f64, f64),
    /// Photographs were judged.
    Judged(usize),
    /// One trust was tried: the share of intervals that hold the truth.
    Tried(f64, f64),
}

/// What it gives.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// How far the scores are trusted, chosen on all places left out.
    pub trust: f64,
    /// Figures of places left out, each under the trust that was chosen on the other folds.
    pub rows: Vec<Row>,
    /// Figures of generated streets and rooms.
    pub built: Vec<Row>,
    /// By which factor half of the panoramas' resolution changes the field of view, in the median.
    pub blurred: f64,
}

/// A photograph that is judged.
struct Judged {
    place: usize,
    pose: Pose,
    evidence: Evidence,
}

/// Trains a network for each fold, chooses how far they are trusted, writes the weights, and tells how well cameras of
/// places left out are found.
///
/// # Errors
/// If settings cannot be worked with, panoramas cannot be read or are too few, a training diverges, or weights cannot be
/// written.
pub fn run(
    settings: &Settings,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Outcome, PlacesError> {
    checked(settings)?;
    let places = read_places(&settings.panoramas)?;
    progress(Progress::Places(places.len()));
    let fold = filled_folds(&settings.panoramas, &places, settings.folds)?;
    let trained = networks(&places, &fold, settings, progress)?;
    let photographs = judged(&places, settings);
    let scores = scores(&trained, &photographs, &fold, settings);
    progress(Progress::Judged(photographs.len()));
    let (by_fold, trust) = chosen(&scores, &photographs, &fold, settings, progress);
    let rows = rows(&scores, &by_fold, &photographs, &places, &fold);
    let blurred = blurred(&trained, &scores, &by_fold, &places, &fold, settings);
    let whole = CameraEstimator {
        members: trained,
        trust,
    };
    write(&settings.out, &whole.to_bytes()?)?;
    Ok(Outcome {
        trust,
        rows,
        built: built_rows(&whole, settings),
        blurred,
    })
}

fn checked(s: &Settings) -> Result<(), PlacesError> {
    let sound = |t: &Training| {
        let counts = t.hidden > 0 && t.epochs > 0 && t.batch > 0;
        let rate = t.learning_rate > 0.0 && t.learning_rate.is_finite();
        let decay = t.weight_decay >= 0.0 && t.weight_decay.is_finite();
        let shares = [t.dropout, t.feature_dropout];
        counts && rate && decay && shares.iter().all(|d| (0.0..1.0).contains(d))
    };
    match s.folds >= 2 && s.views > 0 && s.judged > 0 && sound(&s.scorers) && sound(&s.wholes) {
        true => Ok(()),
        false => Err(PlacesError::Setting(
            "training needs at least 2 folds, 1 view, 1 judged view, 1 hidden unit, 1 epoch, a batch of 1, a rate above 0, a decay of 0 or more, and dropouts in [0, 1)".into(),
        )),
    }
}

/// Two networks for each fold, which they leave out.
fn networks(
    places: &[Place],
    fold: &[usize],
    settings: &Settings,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Vec<Member>, PlacesError> {
    let (count, folds) = (settings.views, settings.folds);
    let of_place = |k: usize| {
        let (place, pose, image) = taken(places, &LEARNED, settings.seed, k, count);
        let seed = hash_u64s(&[settings.seed, 1, k as u64]);
        (fold[place], sample(&pose, &image, seed))
    };
    let generated = |n: usize| {
        let (pose, image) = built(&LEARNED, settings.seed, n, [320, 256]);
        let seed = hash_u64s(&[settings.seed, 2, n as u64]);
        (n / 2 % folds, sample(&pose, &image, seed))
    };
    let of_places = (0..places.len() * count).into_par_iter().map(of_place);
    let generated = (0..settings.learned).into_par_iter().map(generated);
    let samples: Vec<(usize, Sample)> = of_places.chain(generated).collect();
    progress(Progress::Photographs(samples.len()));
    // The networks that score learn from what networks say that did not see the photographs either.
    let pairs: Vec<[usize; 2]> = (0..folds)
        .flat_map(|a| (a..folds).map(move |b| [a, b]))
        .collect();
    let whole = |without: &[usize; 2]| {
        let learned = samples.iter().filter(|s| !without.contains(&s.0));
        let learned: Vec<&Sample> = learned.map(|s| &s.1).collect();
        let seed = settings.seed + 1000 + (without[0] * folds + without[1]) as u64;
        train_whole(&learned, &settings.wholes, seed)
    };
    let wholes = pairs.par_iter().map(whole);
    let wholes = wholes.collect::<Result<Vec<Network>, _>>()?;
    progress(Progress::Wholes(wholes.len()));
    let without = |a: usize, b: usize| {
        let pair = [a.min(b), a.max(b)];
        let at = pairs.iter().position(|p| *p == pair);
        &wholes[at.expect("all pairs are there")]
    };
    let member = |left_out: usize| -> Result<Member, PlacesError> {
        let learned = samples.iter().filter(|s| s.0 != left_out);
        let learned = learned.map(|s| (&s.1, s.1.told(without(left_out, s.0))));
        let learned: Vec<(&Sample, Vec<f32>)> = learned.collect();
        let seed = settings.seed + left_out as u64;
        let scorer = train(&learned, &settings.scorers, seed, &mut |done, loss| {
            progress(Progress::Training(left_out, done, loss));
        })?;
        Ok(Member {
            whole: without(left_out, left_out).clone(),
            scorer,
        })
    };
    (0..folds).into_par_iter().map(member).collect()
}

fn taken(
    places: &[Place],
    range: &Range,
    seed: u64,
    k: usize,
    count: usize,
) -> (usize, Pose, LinearImage) {
    let (place, n) = (k / count, k % count);
    let shot = Shot::drawn(range, seed, place, n);
    let image = shot.take(&places[place], seed ^ (k as u64) << 20);
    (place, shot.pose, image)
}

/// A generated street or room.
fn built(range: &Range, seed: u64, n: usize, longest: [usize; 2]) -> (Pose, LinearImage) {
    let kind = [Built::Street, Built::Room][n % 2];
    let shot = Shot::drawn(range, seed + 104_729, 0, n);
    let size = shot.size.map(|side| side * longest[0] / longest[1]);
    let look = hash_u64s(&[seed, n as u64]);
    (shot.pose, picture(kind, look, &shot.pose, size))
}

/// Draws a camera, from a box around `pose` or from all cameras. Also returns the logarithm of the share of all cameras
/// that the draw represents.
fn drawn(pose: &Pose, any_focal: bool, side: Option<f64>, random: &mut SplitMix64) -> (Pose, f32) {
    let limits = |side: Option<f64>| limits(pose, side);
    let [pitch, roll, fov] =
        limits(side).map(|[low, high]| low + (high - low) * f64::from(random.unit()));
    let fov = if any_focal {
        fov
    } else {
        fov_deg(pose.log_focal)
    };
    let inside = |side: Option<f64>| {
        let own = limits(side);
        let axes = if any_focal { 3 } else { 2 };
        let at = [pitch, roll, fov];
        let all = (0..axes).all(|k| (own[k][0]..=own[k][1]).contains(&at[k]));
        let volume: f64 = (0..axes).map(|k| own[k][1] - own[k][0]).product();
        if all { volume.recip() } else { 0.0 }
    };
    // Over the density of the mixture that all are drawn from.
    let boxes: f64 = BOXES.iter().map(|side| inside(Some(*side))).sum();
    let share = inside(None) / (boxes + inside(None)) / DRAWN as f64;
    let pose = Pose {
        pitch_deg: pitch,
        roll_deg: roll,
        log_focal: log_focal(fov),
    };
    (pose, share.ln() as f32)
}

/// A box around a camera within what is searched; all of it without a side.
fn limits(pose: &Pose, side: Option<f64>) -> [[f64; 2]; 3] {
    let Some(side) = side else { return SEARCHED };
    let fov = fov_deg(pose.log_focal);
    let at = [pose.pitch_deg, pose.roll_deg, fov];
    let half = [side, 0.5 * side, 0.03 * side * fov];
    std::array::from_fn(|k| {
        let [low, high] = SEARCHED[k];
        [(at[k] - half[k]).max(low), (at[k] + half[k]).min(high)]
    })
}

/// A photograph under its own and other cameras.
fn sample(pose: &Pose, image: &LinearImage, seed: u64) -> Sample {
    let mut random = SplitMix64::new(seed);
    let blur = (random.unit() * (MOST_BLUR + 1) as f32) as usize;
    let evidence = Evidence::blurred(image, blur.min(MOST_BLUR));
    let mut features = evidence.features(pose);
    let mut poses = vec![*pose];
    let sides: Vec<Option<f64>> = BOXES.iter().map(|b| Some(*b)).chain([None]).collect();
    let sets = [false, true].map(|any_focal| {
        let own = limits(pose, Some(OWN_BOX));
        let axes = if any_focal { 3 } else { 2 };
        let part = |k: usize| (own[k][1] - own[k][0]) / (SEARCHED[k][1] - SEARCHED[k][0]);
        let own = (0..axes).map(part).product::<f64>().ln() as f32;
        let mut shares = Vec::new();
        for side in sides.iter().flat_map(|s| [*s; DRAWN]) {
            let (other, share) = drawn(pose, any_focal, side, &mut random);
            features.extend(evidence.features(&other));
            poses.push(other);
            shares.push(share);
        }
        (shares, own)
    });
    debug_assert!(features.len().is_multiple_of(FEATURES));
    Sample {
        whole: evidence.whole,
        poses,
        features,
        own: [sets[0].1, sets[1].1],
        shares: sets.map(|s| s.0),
    }
}

fn judged(places: &[Place], settings: &Settings) -> Vec<Judged> {
    let one = |k: usize| {
        let (place, pose, image) = taken(places, &JUDGED, settings.seed + 7919, k, settings.judged);
        Judged {
            place,
            pose,
            evidence: Evidence::new(&image),
        }
    };
    let count = places.len() * settings.judged;
    (0..count).into_par_iter().map(one).collect()
}

/// A focal length that is known but for its error, which is drawn.
fn known(pose: &Pose, settings: &Settings, n: usize) -> KnownFocal {
    let mut random = SplitMix64::new(hash_u64s(&[settings.seed, 3, n as u64]));
    // Nearly normal, of deviation 1.
    let error: f64 = (0..12).map(|_| f64::from(random.unit())).sum::<f64>() - 6.0;
    KnownFocal {
        relative: pose.focal() * (settings.focal_sigma * error).exp(),
        sigma: settings.focal_sigma,
    }
}

/// The networks that left a fold out.
fn without(trained: &[Member], fold: usize) -> CameraEstimator {
    CameraEstimator {
        members: vec![trained[fold].clone()],
        trust: 1.0,
    }
}

/// By the networks that left the place out, with the focal length and without.
fn scores(
    trained: &[Member],
    judged: &[Judged],
    fold: &[usize],
    settings: &Settings,
) -> Vec<[Scores; 2]> {
    let both = |(n, j): (usize, &Judged)| {
        let estimator = without(trained, fold[j.place]);
        [Some(known(&j.pose, settings, n)), None].map(|k| estimator.grid(&j.evidence, k))
    };
    judged.par_iter().enumerate().map(both).collect()
}

/// The trust under which 90% intervals of pitch, roll (focal length given) and field of view (not given) hold 90% on the
/// other folds, for each fold, and on all of them.
fn chosen(
    scores: &[[Scores; 2]],
    judged: &[Judged],
    fold: &[usize],
    settings: &Settings,
    progress: &(dyn Fn(Progress) + Sync),
) -> (Vec<f64>, f64) {
    let mut held = Vec::new();
    for trust in TRUSTS {
        let each = judged.iter().zip(scores).map(|(j, scores)| {
            let [given, open] = [0, 1].map(|k| scores[k].posterior(trust));
            let pitch = given.interval(0).holds(j.pose.pitch_deg);
            let roll = given.interval(1).holds(j.pose.roll_deg);
            let fov = open.interval(2).holds(j.pose.log_focal);
            [pitch, roll, fov].iter().filter(|h| **h).count() as f64 / 3.0
        });
        let each: Vec<f64> = each.collect();
        progress(Progress::Tried(trust, mean(each.iter().copied())));
        held.push(each);
    }
    let best = |without: Option<usize>| {
        let off = |k: usize| {
            let own = judged.iter().zip(&held[k]);
            let own = own.filter(|(j, _)| Some(fold[j.place]) != without);
            (mean(own.map(|(_, h)| *h)) - HELD).abs()
        };
        let order = (0..TRUSTS.len()).min_by(|a, b| off(*a).total_cmp(&off(*b)));
        TRUSTS[order.unwrap_or(0)]
    };
    let by_fold = (0..settings.folds).map(|f| best(Some(f))).collect();
    (by_fold, best(None))
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0), |(s, n), v| (s + v, n + 1));
    sum / f64::from(count.max(1))
}

fn rows(
    scores: &[[Scores; 2]],
    by_fold: &[f64],
    judged: &[Judged],
    places: &[Place],
    fold: &[usize],
) -> Vec<Row> {
    let both = |(j, scores): (&Judged, &[Scores; 2])| {
        let trust = by_fold[fold[j.place]];
        let group = &places[j.place].kind;
        [(0, true), (1, false)]
            .map(|(k, known)| Case::new(group, &j.pose, &scores[k].posterior(trust), known))
    };
    let cases: Vec<Case> = judged.iter().zip(scores).flat_map(both).collect();
    let mut groups: Vec<&str> = places.iter().map(|p| p.kind.as_str()).collect();
    groups.sort_unstable();
    groups.dedup();
    let mut rows = Vec::new();
    for (known, word) in [(true, "given"), (false, "not given")] {
        let name = format!("focal length {word}");
        rows.push(Row::of(&name, &cases, |c| c.focal_known == known));
        for group in &groups {
            let belongs = |c: &Case| c.focal_known == known && c.group == *group;
            rows.push(Row::of(&format!("… {group}"), &cases, belongs));
        }
    }
    rows
}

/// Generated streets and rooms of 640 pixels along the longer side.
fn built_rows(estimator: &CameraEstimator, settings: &Settings) -> Vec<Row> {
    let both = |n: usize| {
        let (pose, image) = built(&JUDGED, settings.seed + 7919, n, [640, 256]);
        let evidence = Evidence::new(&image);
        let group = ["street", "room"][n % 2];
        [Some(known(&pose, settings, n)), None].map(|known| {
            let posterior = estimator.grid(&evidence, known).posterior(estimator.trust);
            Case::new(group, &pose, &posterior, known.is_some())
        })
    };
    let cases: Vec<Case> = (0..settings.built)
        .into_par_iter()
        .flat_map_iter(both)
        .collect();
    let mut rows = Vec::new();
    for (known, word) in [(true, "given"), (false, "not given")] {
        for group in ["street", "room"] {
            let belongs = |c: &Case| c.focal_known == known && c.group == group;
            rows.push(Row::of(
                &format!("{group}s, focal length {word}"),
                &cases,
                belongs,
            ));
        }
    }
    rows
}

/// By which factor the field of view of places left out changes, in the median, if their panoramas have half of the
/// resolution: 1 if sharpness tells nothing.
fn blurred(
    trained: &[Member],
    scores: &[[Scores; 2]],
    by_fold: &[f64],
    places: &[Place],
    fold: &[usize],
    settings: &Settings,
) -> f64 {
    let halved = |p: &Place| {
        let [width, height] = [p.panorama.width(), p.panorama.height()].map(|n| n / 2);
        Place {
            panorama: p.panorama.resampled(width, height),
            ..p.clone()
        }
    };
    let halved: Vec<Place> = places.iter().map(halved).collect();
    let factor = |(j, scores): (&Judged, &[Scores; 2])| {
        let fold = fold[j.place];
        let again = without(trained, fold).grid(&j.evidence, None);
        let middle = |s: &Scores| s.posterior(by_fold[fold]).fov_deg().middle;
        middle(&again) / middle(&scores[1])
    };
    let judged = judged(&halved, settings);
    let all: Vec<f64> = judged.par_iter().zip(scores).map(factor).collect();
    median(&all).unwrap_or(f64::NAN)
}
