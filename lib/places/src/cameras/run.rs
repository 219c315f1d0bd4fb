//! From a folder of panoramas to weights and figures.
use std::path::PathBuf;

use dipir_calibration::generated::{Built, picture};
use dipir_calibration::network::{Head, Network, soft};
use dipir_calibration::pose::Pose;
use dipir_calibration::{CameraEstimator, Evidence, KnownFocal, Terms, Trust};
use rayon::prelude::*;

use crate::cameras::figures::{Case, Row};
use crate::cameras::trainer::{Sample, train};
use crate::error::PlacesError;
use crate::place::{Place, folds, read_places};
use crate::shot::{JUDGED, LEARNED, Range, Shot};

pub use crate::cameras::trainer::Training;

/// What is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Folder of panoramas.
    pub panoramas: PathBuf,
    /// The file of weights.
    pub out: PathBuf,
    /// Folds of places; each is left out by one network.
    pub folds: usize,
    /// Networks of the weights.
    pub networks: usize,
    /// Photographs drawn of each place.
    pub views: usize,
    /// Photographs of each place that figures are made of.
    pub judged: usize,
    /// Generated streets and rooms that figures are made of.
    pub built: usize,
    /// Seed of photographs and networks.
    pub seed: u64,
    /// Of the networks.
    pub training: Training,
    /// Powers that are tried: of lines, of the network's turn and of its focal length.
    pub trusts: Vec<Trust>,
    /// One deviation of a known focal length, relative.
    pub focal_sigma: f64,
}

impl Settings {
    /// Those of the weights that are part of the program.
    pub fn new(panoramas: PathBuf, out: PathBuf) -> Self {
        let mut trusts = Vec::new();
        for lines in [0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55] {
            for turn in [0.3, 0.45, 0.6, 0.75, 0.9, 1.1] {
                for focal in [0.3, 0.5, 0.7, 0.9, 1.1] {
                    trusts.push(Trust { lines, turn, focal });
                }
            }
        }
        Self {
            panoramas,
            out,
            folds: 6,
            networks: 3,
            views: 240,
            judged: 8,
            built: 48,
            seed: 1,
            training: Training::default(),
            trusts,
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
    /// A network is being trained: its fold, what it tells, the share that is done, the mean loss of late.
    Training(usize, Head, f64, f64),
    /// One trust was tried: mean surprise of the truth, natural logarithms, for each fold.
    Tried(Trust, Vec<f64>),
}

/// What it gives.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// How far each source is trusted, chosen on all places left out.
    pub trust: Trust,
    /// Figures of places left out, each under the trust that was chosen on the other folds.
    pub rows: Vec<Row>,
    /// Figures of generated streets and rooms.
    pub built: Vec<Row>,
}

/// A photograph that is judged.
struct Judged {
    place: usize,
    pose: Pose,
    evidence: Evidence,
}

/// Trains a network for each fold and networks on all places, chooses how far each source is trusted, writes the
/// weights, and tells how well cameras of places left out are found.
///
/// # Errors
/// If panoramas cannot be read or weights not be written.
pub fn run(
    settings: &Settings,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Outcome, PlacesError> {
    let places = read_places(&settings.panoramas)?;
    progress(Progress::Places(places.len()));
    let fold = folds(&places, settings.folds);
    let judged = judged(&places, settings);
    let trained: Vec<CameraEstimator> = {
        let samples = samples(&places, settings);
        progress(Progress::Photographs(samples.len()));
        let networks = |left_out: Option<usize>, seed: u64| {
            let own: Vec<&Views> = samples
                .iter()
                .filter(|s| Some(fold[s.place]) != left_out)
                .collect();
            let one = |head: Head| {
                let chosen: Vec<&Sample> = own.iter().map(|s| s.of(head)).collect();
                let number = left_out.unwrap_or(settings.folds);
                train(
                    head,
                    &chosen,
                    &settings.training,
                    seed,
                    &mut |done, loss| {
                        progress(Progress::Training(number, head, done, loss));
                    },
                )
            };
            [one(Head::Turn), one(Head::Focal)]
        };
        let mut jobs: Vec<(Option<usize>, u64)> = (0..settings.folds)
            .map(|f| (Some(f), settings.seed))
            .collect();
        jobs.extend((0..settings.networks).map(|n| (None, settings.seed + n as u64)));
        let done: Vec<[Network; 2]> = jobs
            .par_iter()
            .map(|(f, seed)| networks(*f, *seed))
            .collect();
        gathered(done, settings)
    };
    let (by_fold, trust) = chosen(&trained, &judged, &fold, settings, progress);
    let rows = rows(&trained, &by_fold, &judged, &places, &fold, settings);
    let whole = CameraEstimator {
        trust,
        ..trained[settings.folds].clone()
    };
    let bytes = whole.to_bytes()?;
    std::fs::write(&settings.out, bytes).map_err(|source| PlacesError::File {
        what: "write",
        path: settings.out.clone(),
        source,
    })?;
    Ok(Outcome {
        trust,
        rows,
        built: built_rows(&whole, settings),
    })
}

/// One estimator a fold, and the one of all places.
fn gathered(done: Vec<[Network; 2]>, settings: &Settings) -> Vec<CameraEstimator> {
    let estimator = |members: &[[Network; 2]]| CameraEstimator {
        turn: members.iter().map(|m| m[0].clone()).collect(),
        focal: members.iter().map(|m| m[1].clone()).collect(),
        trust: settings.trusts[0],
    };
    let mut all: Vec<CameraEstimator> = done[..settings.folds].chunks(1).map(estimator).collect();
    all.push(estimator(&done[settings.folds..]));
    all
}

/// What both networks learn from one photograph.
struct Views {
    place: usize,
    turn: Sample,
    focal: Sample,
}

impl Views {
    fn of(&self, head: Head) -> &Sample {
        match head {
            Head::Turn => &self.turn,
            Head::Focal => &self.focal,
        }
    }
}

fn taken(
    places: &[Place],
    range: &Range,
    seed: u64,
    k: usize,
    count: usize,
) -> (usize, Pose, dipir_imaging::raster::LinearImage) {
    let (place, n) = (k / count, k % count);
    let shot = Shot::drawn(range, seed, place, n);
    let image = shot.take(&places[place], seed ^ (k as u64) << 20);
    (place, shot.pose, image)
}

/// Photographs and their mirror images.
fn samples(places: &[Place], settings: &Settings) -> Vec<Views> {
    let count = settings.views;
    let both = |k: usize| {
        let (place, pose, image) = taken(places, &LEARNED, settings.seed, k, count);
        let thumbnail = dipir_calibration::features::Thumbnail::new(&image);
        [(thumbnail.clone(), 1.0), (thumbnail.mirrored(), -1.0)].map(|(t, side)| {
            let plain = t.features();
            let mut turned = plain.clone();
            turned.extend(t.angular(pose.focal() as f32));
            let axes = Head::Turn.axes();
            let pitch = soft(&axes[0], pose.pitch_deg);
            let roll = soft(&axes[1], side * pose.roll_deg);
            Views {
                place,
                turn: Sample {
                    features: turned,
                    target: [pitch, roll].concat(),
                },
                focal: Sample {
                    features: plain,
                    target: soft(&Head::Focal.axes()[0], pose.log_focal),
                },
            }
        })
    };
    let all: Vec<[Views; 2]> = (0..places.len() * count)
        .into_par_iter()
        .map(both)
        .collect();
    all.into_iter().flatten().collect()
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

fn known(pose: &Pose, settings: &Settings) -> KnownFocal {
    KnownFocal {
        relative: pose.focal(),
        sigma: settings.focal_sigma,
    }
}

/// The trust with the least surprise on the other folds, for each fold, and on all of them.
fn chosen(
    trained: &[CameraEstimator],
    judged: &[Judged],
    fold: &[usize],
    settings: &Settings,
    progress: &(dyn Fn(Progress) + Sync),
) -> (Vec<Trust>, Trust) {
    let terms: Vec<[Terms; 2]> = judged
        .par_iter()
        .map(|j| {
            let estimator = &trained[fold[j.place]];
            [Some(known(&j.pose, settings)), None].map(|k| estimator.coarse_terms(&j.evidence, k))
        })
        .collect();
    let mut surprises = Vec::new();
    for trust in &settings.trusts {
        let each: Vec<f64> = (judged.par_iter().zip(&terms))
            .map(|(j, terms)| {
                let [given, open] = [0, 1].map(|k| terms[k].posterior(trust));
                given.surprise(0, j.pose.pitch_deg)
                    + given.surprise(1, j.pose.roll_deg)
                    + open.surprise(2, j.pose.log_focal)
            })
            .collect();
        let mean = |f: usize| {
            let own = (judged.iter().zip(&each)).filter(|(j, _)| fold[j.place] == f);
            let own: Vec<f64> = own.map(|(_, e)| *e).collect();
            own.iter().sum::<f64>() / own.len().max(1) as f64
        };
        let by_fold: Vec<f64> = (0..settings.folds).map(mean).collect();
        progress(Progress::Tried(*trust, by_fold.clone()));
        surprises.push(by_fold);
    }
    let best = |without: Option<usize>| {
        let sum = |k: usize| -> f64 {
            let folds = (0..settings.folds).filter(|f| Some(*f) != without);
            folds.map(|f| surprises[k][f]).sum()
        };
        let order = (0..settings.trusts.len()).min_by(|a, b| sum(*a).total_cmp(&sum(*b)));
        settings.trusts[order.unwrap_or(0)]
    };
    (
        (0..settings.folds).map(|f| best(Some(f))).collect(),
        best(None),
    )
}

fn rows(
    trained: &[CameraEstimator],
    by_fold: &[Trust],
    judged: &[Judged],
    places: &[Place],
    fold: &[usize],
    settings: &Settings,
) -> Vec<Row> {
    let both = |j: &Judged| {
        let f = fold[j.place];
        let estimator = CameraEstimator {
            trust: by_fold[f],
            ..trained[f].clone()
        };
        let given = estimator.posterior(&j.evidence, Some(known(&j.pose, settings)));
        let open = estimator.posterior(&j.evidence, None);
        let group = &places[j.place].kind;
        [
            Case::new(group, &j.pose, &given, true),
            Case::new(group, &j.pose, &open, false),
        ]
    };
    let cases: Vec<Case> = judged.par_iter().flat_map_iter(both).collect();
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
        let built = [Built::Street, Built::Room][n % 2];
        let shot = Shot::drawn(&JUDGED, settings.seed + 104_729, 0, n);
        let size = shot.size.map(|side| side * 5 / 2);
        let evidence = Evidence::new(&picture(built, n as u64, &shot.pose, size));
        let given = estimator.posterior(&evidence, Some(known(&shot.pose, settings)));
        let open = estimator.posterior(&evidence, None);
        let group = format!("{built:?}").to_lowercase();
        [
            Case::new(&group, &shot.pose, &given, true),
            Case::new(&group, &shot.pose, &open, false),
        ]
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
