//! From a folder of panoramas to weights and figures.
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use dipir_backbone::Tuned;
use dipir_estimator::network::Sight;
use dipir_estimator::{Calibration, Estimator};
use dipir_numerics::hashing::hash_u64s;
use rayon::prelude::*;
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};

use crate::error::PlacesError;
use crate::examples::{Example, Seen, drawn, standard};
use crate::figures::{Case, Figures, calibration, figures};
use crate::place::{Place, filled_folds, read_places};
use crate::probes::Probes;
use crate::trainer::{Training, train};

/// What `dipir-pretrain light` is asked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Folder of panoramas (*.hdr, *.exr); `panoramas.tsv` in it may name kinds.
    pub panoramas: PathBuf,
    /// The file of weights; figures are written beside it as `.json`, finished folds as `.foldN`.
    pub out: PathBuf,
    /// Folds of places; each is left out by one network.
    pub folds: usize,
    /// Networks of each fold, whose answers are averaged.
    pub networks: usize,
    /// Photographs drawn of each place.
    pub views: usize,
    /// Photographs of each place on which the networks are judged.
    pub judged: usize,
    /// Networks learn from at most this many places each; all without it.
    pub places: Option<usize>,
    /// Seed of photographs and networks.
    pub seed: u64,
    /// Share to which surfaces count by how much of them a camera sees.
    pub facing: f32,
    /// Reflectance of the surfaces that are to look as the camera's curve shows them.
    pub albedo: Option<f32>,
    /// Tunings of the backbone, one for each fold, which they leave out: `lib/estimator/weights/tune.py` makes them.
    pub tuned: Option<PathBuf>,
    /// How networks are trained.
    pub training: Training,
    /// Whether the networks of each fold stay beside the weights as `.foldN`, calibrated on the other folds: for
    /// figures on places that nothing of them has seen.
    #[serde(skip)]
    pub keep: bool,
}

impl Settings {
    /// The settings of the weights that are part of the program.
    pub fn new(panoramas: PathBuf, out: PathBuf) -> Self {
        Self {
            panoramas,
            out,
            folds: 5,
            networks: 2,
            views: 256,
            judged: 8,
            places: None,
            seed: 1,
            facing: 0.8,
            albedo: Some(0.3),
            tuned: None,
            training: Training::default(),
            keep: false,
        }
    }
}

/// How far training is.
#[derive(Clone, Debug)]
pub enum Progress {
    /// Panoramas were read.
    Places(usize),
    /// Photographs were drawn.
    Photographs(usize),
    /// A network is being trained: its fold, the share that is done, the mean loss of late.
    Training(usize, f64, f64),
    /// A finished fold was found and is kept.
    Kept(usize),
}

/// What training gives.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// What was asked for.
    pub settings: Settings,
    /// Names of the places with their folds.
    pub places: Vec<(String, usize)>,
    /// The calibration on places left out.
    pub calibration: Calibration,
    /// Photographs as the evaluation takes them, places left out.
    pub standard: Vec<Figures>,
    /// Photographs of any camera, places left out.
    pub any: Vec<Figures>,
    /// Photographs as the evaluation takes them, of places that the networks were trained on.
    pub seen: Vec<Figures>,
}

/// Trains a network for each fold, calibrates them on the places left out, writes weights and figures. The same
/// settings give the same bytes for any number of threads. `progress` returns `false` to stop.
pub fn run(
    settings: &Settings,
    progress: &(dyn Fn(Progress) -> bool + Sync),
) -> Result<Outcome, PlacesError> {
    checked(settings)?;
    let places = read_places(&settings.panoramas)?;
    let fold = filled_folds(&settings.panoramas, &places, settings.folds)?;
    if !progress(Progress::Places(places.len())) {
        return Err(PlacesError::Stopped);
    }
    let probes = Probes::seen(settings.facing, settings.albedo);
    let tuned = match &settings.tuned {
        Some(path) => tunings(path, &places, &fold, settings.folds)?,
        None => Vec::new(),
    };
    let seen = Seen {
        probes: &probes,
        tuned: &tuned,
    };
    let photographs = drawn(&places, settings.views, &seen, settings.seed);
    let judged = standard(&places, settings.judged, &seen);
    if !progress(Progress::Photographs(photographs.len() + judged.len())) {
        return Err(PlacesError::Stopped);
    }
    let asked = asked(settings, &places, &fold);
    let stopped = AtomicBool::new(false);
    let failure: Mutex<Option<PlacesError>> = Mutex::new(None);
    let members: Vec<Option<Estimator>> = (0..settings.folds)
        .into_par_iter()
        .map(|f| {
            let kept = |p: Progress| !stopped.load(Ordering::Relaxed) && progress(p);
            let member = one_fold(settings, &asked, f, &fold, &photographs, &seen, &kept);
            let failed = |e| {
                // Before the others are stopped: theirs are no causes.
                if let Ok(mut slot) = failure.lock() {
                    slot.get_or_insert(e);
                }
                stopped.store(true, Ordering::Relaxed);
            };
            member.map_err(failed).ok()
        })
        .collect();
    if let Some(error) = failure.into_inner().ok().flatten() {
        return Err(error);
    }
    let members: Vec<Estimator> = members.into_iter().flatten().collect();
    finish(
        settings,
        &places,
        &fold,
        &members,
        [&judged, &photographs],
        &probes,
    )
}

fn checked(s: &Settings) -> Result<(), PlacesError> {
    let t = &s.training;
    let sound = s.folds >= 2
        && s.networks > 0
        && s.views > 0
        && s.judged > 0
        && t.hidden > 0
        && t.epochs > 0
        && t.batch > 0;
    let rates = t.learning_rate > 0.0
        && t.learning_rate.is_finite()
        && t.weight_decay >= 0.0
        && t.weight_decay.is_finite();
    let shares = [t.dropout, t.feature_dropout, t.kind_dropout]
        .iter()
        .all(|d| (0.0..1.0).contains(d));
    if s.out.extension().is_some_and(|e| e == "json") {
        let text = format!(
            "`{}`: the figures are written there; call the weights otherwise, as in places.safetensors",
            s.out.display()
        );
        return Err(PlacesError::Setting(text));
    }
    match sound && rates && shares {
        true => Ok(()),
        false => Err(PlacesError::Setting(
            "training needs at least 2 folds, 1 network, 1 view, 1 judged view, 1 hidden unit, 1 epoch, a batch of 1, a learning rate above 0, a weight decay of 0 or more, and dropouts in [0, 1)".into(),
        )),
    }
}

/// What decides on the networks of every fold: the settings, and the places with their folds and a hash of their light.
fn asked(settings: &Settings, places: &[Place], fold: &[usize]) -> String {
    let light = |p: &Place| {
        let values = p.panorama.texels().iter().flat_map(|t| t.to_array());
        let bits: Vec<u64> = values.map(|v| u64::from(v.to_bits())).collect();
        hash_u64s(&bits)
    };
    let of = |(p, f): (&Place, &usize)| (p.name.clone(), *f, light(p));
    let places: Vec<(String, usize, u64)> = places.iter().zip(fold).map(of).collect();
    serde_json::to_string(&(settings, places)).unwrap_or_default()
}

/// The network that has not seen fold `f`: read from a finished run of which the same was asked, or trained.
fn one_fold(
    settings: &Settings,
    asked: &str,
    f: usize,
    fold: &[usize],
    photographs: &[Example],
    seen: &Seen<'_>,
    progress: &dyn Fn(Progress) -> bool,
) -> Result<Estimator, PlacesError> {
    let own: Vec<Arc<Tuned>> = seen.tuned.get(f).cloned().into_iter().collect();
    let file = settings.out.with_extension(format!("fold{f}"));
    let note = settings.out.with_extension(format!("fold{f}.json"));
    if std::fs::read_to_string(&note).is_ok_and(|text| text == asked)
        && let Ok(member) = Estimator::load(&file)
        && member.tuned() == own
    {
        progress(Progress::Kept(f));
        return Ok(member);
    }
    let places = learned(settings, f, fold);
    let examples: Vec<&Example> = photographs
        .iter()
        .filter(|e| places.contains(&e.place))
        .collect();
    let mut networks = Vec::new();
    for n in 0..settings.networks {
        let count = settings.networks as f64;
        let told =
            |done: f64, loss: f64| progress(Progress::Training(f, (n as f64 + done) / count, loss));
        let seed = settings.seed ^ (f as u64 + 1) << 32 ^ (n as u64) << 48;
        let network = |sight: Sight, told: &mut dyn FnMut(f64, f64) -> bool| {
            let seed = seed ^ (sight as u64) << 56;
            train(
                &examples,
                f,
                &settings.training,
                seen.probes,
                sight,
                seed,
                told,
            )
        };
        let parts = network(Sight::Parts, &mut |done, loss| told(0.5 * done, loss))?;
        let kind = network(Sight::Kind, &mut |done, loss| told(0.5 + 0.5 * done, loss))?;
        networks.push([parts, kind]);
    }
    let member = Estimator::new(networks, own, Calibration::default())?;
    write(&file, &member.to_bytes()?)?;
    write(&note, asked.as_bytes())?;
    Ok(member)
}

/// The places that the network of fold `f` learns from.
fn learned(settings: &Settings, f: usize, fold: &[usize]) -> Vec<usize> {
    let mut seen: Vec<usize> = (0..fold.len()).filter(|p| fold[*p] != f).collect();
    crate::network::SplitMix64::new(settings.seed ^ 0xc0de).shuffle(&mut seen);
    seen.truncate(settings.places.unwrap_or(usize::MAX));
    seen
}

/// Tunings of the backbone, of which fold `f`'s left out the places of fold `f`.
fn tunings(
    path: &Path,
    places: &[Place],
    fold: &[usize],
    folds: usize,
) -> Result<Vec<Arc<Tuned>>, PlacesError> {
    let refused = |why: String| PlacesError::Setting(format!("`{}`: {why}", path.display()));
    let bytes = dipir_files::read(path).map_err(|source| PlacesError::File {
        what: "read",
        path: path.to_owned(),
        source,
    })?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| refused(e.to_string()))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| refused(e.to_string()))?;
    let text = header.metadata().as_ref().and_then(|m| m.get("left_out"));
    let left_out: Vec<Vec<String>> =
        text.and_then(|t| serde_json::from_str(t).ok())
            .ok_or_else(|| {
                refused("the metadata has no `left_out`, a list of names for each fold".into())
            })?;
    let tuned = dipir_estimator::network::tunings(&file)?;
    if tuned.len() != folds || left_out.len() != folds {
        let found = tuned.len().min(left_out.len());
        return Err(refused(format!("holds {found} folds, not {folds}")));
    }
    let others = places
        .iter()
        .zip(fold)
        .find(|(p, f)| !left_out[**f].contains(&p.name));
    match others {
        Some((place, f)) => Err(refused(format!(
            "fold {f} did not leave out `{}`: it was made with other folds",
            place.name
        ))),
        None => Ok(tuned),
    }
}

/// Estimates of photographs by the networks of their place's fold, or of the fold `later` ones after it.
fn cases(
    examples: &[&Example],
    places: &[Place],
    fold: &[usize],
    members: &[Estimator],
    later: usize,
) -> Vec<Case> {
    examples
        .par_iter()
        .map(|e| {
            let f = (fold[e.place] + later) % members.len();
            let features = e.of_fold(f);
            Case {
                estimate: members[f].of_features(features, e.reference, 0.0),
                histograms: members[f].histograms(features),
                example: (*e).clone(),
                kind: places[e.place].kind.clone(),
                fold: fold[e.place],
            }
        })
        .collect()
}

/// The networks with the calibration that is for use, and with those for figures: each fold's is chosen on the others.
fn calibrations(
    members: &[Estimator],
    raw: &[Case],
    probes: &Probes,
) -> (Calibration, Vec<Estimator>) {
    let all = calibration(&raw.iter().collect::<Vec<_>>(), probes);
    let crossed = (0..members.len())
        .into_par_iter()
        .map(|f| {
            let others: Vec<&Case> = raw.iter().filter(|c| c.fold != f).collect();
            members[f].calibrated(calibration(&others, probes))
        })
        .collect();
    (all, crossed)
}

fn finish(
    settings: &Settings,
    places: &[Place],
    fold: &[usize],
    members: &[Estimator],
    [judged, photographs]: [&[Example]; 2],
    probes: &Probes,
) -> Result<Outcome, PlacesError> {
    let judged: Vec<&Example> = judged.iter().collect();
    let every = (settings.views / settings.judged).max(1);
    let any: Vec<&Example> = photographs.iter().step_by(every).collect();
    let both: Vec<&Example> = judged.iter().chain(&any).copied().collect();
    let raw = cases(&both, places, fold, members, 0);
    let (found, crossed) = calibrations(members, &raw, probes);
    let calibrated: Vec<Estimator> = members.iter().map(|m| m.calibrated(found)).collect();
    let left_out =
        |examples: &[&Example]| figures(&cases(examples, places, fold, &crossed, 0), probes);
    let seen = cases(&judged, places, fold, &calibrated, 1);
    let outcome = Outcome {
        settings: settings.clone(),
        places: places
            .iter()
            .zip(fold)
            .map(|(p, f)| (p.name.clone(), *f))
            .collect(),
        calibration: found,
        standard: left_out(&judged),
        any: left_out(&any),
        seen: figures(&seen, probes),
    };
    let ensemble = Estimator::joined(&calibrated)?;
    write(&settings.out, &ensemble.to_bytes()?)?;
    let text =
        serde_json::to_string_pretty(&outcome).map_err(|e| PlacesError::Setting(e.to_string()))?;
    write(&settings.out.with_extension("json"), text.as_bytes())?;
    for (f, member) in crossed.iter().enumerate() {
        let file = |extension: String| settings.out.with_extension(extension);
        // Only what this run made; a fold that is gone already is no loss.
        std::fs::remove_file(file(format!("fold{f}.json"))).ok();
        match settings.keep {
            true => write(&file(format!("fold{f}")), &member.to_bytes()?)?,
            false => drop(std::fs::remove_file(file(format!("fold{f}")))),
        }
    }
    // Whoever reads the folds takes all that are there: none may be left of an earlier run with more of them.
    for f in crossed.len().. {
        let earlier = settings.out.with_extension(format!("fold{f}"));
        if Estimator::load(&earlier).is_err() || std::fs::remove_file(&earlier).is_err() {
            break;
        }
    }
    Ok(outcome)
}

/// Written beside its place and renamed, so that it is there whole or not at all.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), PlacesError> {
    let failed = |source| PlacesError::File {
        what: "write",
        path: path.to_owned(),
        source,
    };
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(failed)?;
    }
    let partial = path.with_file_name(format!(
        "{}.partial",
        path.file_name()
            .map(|n| n.to_string_lossy().into_owned())
            .unwrap_or_default()
    ));
    std::fs::write(&partial, bytes).map_err(failed)?;
    std::fs::rename(&partial, path).map_err(failed)
}
