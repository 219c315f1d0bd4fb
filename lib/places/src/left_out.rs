//! Places beside the networks that were trained without them, as the training dealt them.
use std::collections::BTreeMap;
use std::path::Path;

use dipir_estimator::{Calibration, Estimator};
use serde::Deserialize;

use crate::error::PlacesError;
use crate::place::{Place, group_of, read_places};

/// Places, each with a network that has not seen it.
pub struct LeftOut {
    /// All panoramas of a folder.
    pub places: Vec<Place>,
    /// For each fold the networks that it was left out of.
    pub networks: Vec<Estimator>,
    /// The number of each place's networks.
    pub fold: Vec<usize>,
    /// Names of places that were not there at the training: all networks have left them out, and those of any fold
    /// judge them.
    pub added: Vec<String>,
}

/// What is read of a training's figures.
#[derive(Deserialize)]
struct Trained {
    places: Vec<(String, usize)>,
    calibration: Calibration,
}

impl LeftOut {
    /// Reads the panoramas of a folder, and beside `weights` the folds of the training (`.json`) and the networks
    /// that it kept of each (`.foldN`).
    ///
    /// # Errors
    /// If a file is missing or unreadable, if there are no panoramas, and if weights, figures and networks are not of
    /// one training.
    pub fn read(panoramas: &Path, weights: &Path) -> Result<Self, PlacesError> {
        let networks = networks(weights)?;
        let trained = trained(weights)?;
        let folds = trained.places.iter().map(|p| p.1.saturating_add(1)).max();
        let own: Vec<Estimator> = networks
            .iter()
            .map(|n| n.calibrated(trained.calibration))
            .collect();
        if folds != Some(networks.len()) || Estimator::joined(&own)? != Estimator::load(weights)? {
            return Err(PlacesError::Setting(format!(
                "`{}`, the `.json` and the {} networks `.foldN` beside it are not of one training; train again with \
                 --keep-folds",
                weights.display(),
                networks.len()
            )));
        }
        let places = read_places(panoramas)?;
        if places.is_empty() {
            let text = format!(
                "`{}` holds no panoramas (*.hdr, *.exr)",
                panoramas.display()
            );
            return Err(PlacesError::Setting(text));
        }
        let (fold, added) = dealt(&places, &trained.places, networks.len());
        Ok(Self {
            places,
            networks,
            fold,
            added,
        })
    }

    /// A sentence about the places that were not there at the training; `None` if all were.
    pub fn note(&self) -> Option<String> {
        (!self.added.is_empty()).then(|| {
            format!(
                "{} of {} panoramas were not there at the training, so that networks of any fold judge them: {}",
                self.added.len(),
                self.places.len(),
                self.added.join(", ")
            )
        })
    }
}

/// The fold of each place by its name, else by that of the same place seen again, else any; with the names of the last.
fn dealt(places: &[Place], trained: &[(String, usize)], folds: usize) -> (Vec<usize>, Vec<String>) {
    let groups: BTreeMap<String, usize> = trained
        .iter()
        .map(|(name, f)| (group_of(name), *f))
        .collect();
    let mut added = Vec::new();
    let of = |place: &Place| {
        groups.get(&place.group).copied().unwrap_or_else(|| {
            added.push(place.name.clone());
            (added.len() - 1) % folds
        })
    };
    let fold = places.iter().map(of).collect();
    (fold, added)
}

/// The networks that each fold was left out of.
fn networks(weights: &Path) -> Result<Vec<Estimator>, PlacesError> {
    let file = |f: usize| weights.with_extension(format!("fold{f}"));
    let files = (0..).map(file).take_while(|path| path.is_file());
    let networks = files.map(Estimator::load).collect::<Result<Vec<_>, _>>()?;
    match networks.is_empty() {
        false => Ok(networks),
        true => Err(PlacesError::Setting(format!(
            "{}: there is no {} beside it; train with --keep-folds to have it",
            weights.display(),
            file(0).display()
        ))),
    }
}

fn trained(weights: &Path) -> Result<Trained, PlacesError> {
    let path = weights.with_extension("json");
    let refused = |why: String| {
        PlacesError::Setting(format!(
            "`{}`, in which the training says which fold each place is of: {why}",
            path.display()
        ))
    };
    let text = dipir_files::read_to_string(&path).map_err(|e| refused(e.to_string()))?;
    serde_json::from_str(&text).map_err(|e| refused(e.to_string()))
}
