//! Composites on places that the light estimator's networks were not trained on: views of panoramas with an object,
//! under the true light, neutral light, the estimate, and the estimate with parts of it replaced by the truth's.
mod lights;
mod picture;
mod scene;
mod tables;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::Context;
use dipir_cli::exit::Usage;
use dipir_estimator::Estimator;
use dipir_evaluation::results::{write, write_json};
use dipir_evaluation::scores::{PictureScores, Touched, compare_pictures};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::DisplayImage;
use dipir_places::place::Place;
use dipir_places::probes::Probes;
use dipir_places::{LeftOut, PlacesError};
use rayon::prelude::*;
use serde::Serialize;

use lights::{LIGHTS, Light};
use picture::{Curve, Layers};
use scene::{DrawnScene, Objects};
pub use tables::Row;

/// Factors of the light that are tried where the best exposure is looked for.
const FACTORS: usize = 25;
/// The first of them; each is 1.2 times the one before.
const FIRST_FACTOR: f32 = 0.3;

/// What is evaluated.
#[derive(Clone, Debug, Serialize)]
pub struct Settings {
    /// Folder of panoramas, with `panoramas.tsv`.
    pub panoramas: PathBuf,
    /// Weights, beside which the training kept `.foldN`.
    pub weights: PathBuf,
    /// Folder of models; solids alone without it.
    pub models: Option<PathBuf>,
    /// Views of each place.
    pub views: usize,
    /// Seed of what is drawn.
    pub seed: u64,
    /// Display-referred RMSE of pictures.
    pub target_error: f32,
    /// Whether the estimate is also rendered with parts replaced by the truth's.
    pub parts: bool,
    /// Where pictures are kept.
    pub cache: PathBuf,
    /// Scenes on the sheet.
    pub sheet: usize,
}

/// The scores of one scene.
#[derive(Clone, Debug, Serialize)]
pub struct Scored {
    /// Place, view and object.
    pub name: String,
    /// Kind of place.
    pub kind: String,
    /// Fold of the place.
    pub fold: usize,
    /// Whether the place has a sun.
    pub sun: bool,
    /// Each light's name and scores.
    pub scores: Vec<(String, PictureScores)>,
    /// RMSE touched of neutral light and of the estimate under each factor.
    #[serde(skip)]
    exposed: [Vec<PictureScores>; 2],
    #[serde(skip)]
    pictures: Vec<DisplayImage>,
}

/// What was found.
pub struct Outcome {
    /// Scenes with scores.
    pub scenes: Vec<Scored>,
    /// Markdown.
    pub tables: String,
    /// Rows of pictures: photograph, truth, estimate, neutral light, neutral light times a constant.
    pub sheet: DisplayImage,
}

impl Outcome {
    /// Writes `left-out.json`, `.md` and `.png` into a folder.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&self, folder: &Path) -> anyhow::Result<()> {
        write_json(&folder.join("left-out.json"), &self.scenes)?;
        write(&folder.join("left-out.md"), &self.tables)?;
        Ok(write_png(folder.join("left-out.png"), &self.sheet)?)
    }
}

/// Renders and scores all scenes; `progress` is told the share that is done.
///
/// # Errors
/// If files cannot be read, or the weights have no networks for each fold of their training.
pub fn run(settings: &Settings, progress: &(dyn Fn(f64) + Sync)) -> anyhow::Result<Outcome> {
    let left_out = left_out(settings)?;
    let LeftOut {
        places,
        networks,
        fold,
        ..
    } = &left_out;
    let objects = Objects::read(settings.models.as_deref())?;
    let probes = Probes::default();
    let done = AtomicUsize::new(0);
    let total = places.len() * settings.views;
    let one = |k: usize| {
        let (p, n) = (k / settings.views, k % settings.views);
        let scene = DrawnScene::draw(settings.seed, p, &places[p], n, &objects)?;
        let scored = score(
            settings,
            &scene,
            &places[p],
            fold[p],
            &networks[fold[p]],
            &probes,
        )
        .with_context(|| format!("scene {}", scene.name));
        progress((done.fetch_add(1, Ordering::Relaxed) + 1) as f64 / total as f64);
        scored
    };
    let mut scenes: Vec<Scored> = (0..total)
        .into_par_iter()
        .map(one)
        .collect::<anyhow::Result<_>>()?;
    let factors: Vec<f32> = (0..FACTORS)
        .map(|k| FIRST_FACTOR * 1.2f32.powi(k as i32))
        .collect();
    tables::add_constants(&mut scenes, &factors);
    Ok(Outcome {
        tables: match left_out.note() {
            Some(note) => format!("{}\n{note}\n", tables::all(&scenes)),
            None => tables::all(&scenes),
        },
        sheet: tables::sheet(&scenes, settings.sheet),
        scenes,
    })
}

/// The places with networks that have not seen them.
fn left_out(settings: &Settings) -> anyhow::Result<LeftOut> {
    LeftOut::read(&settings.panoramas, &settings.weights).map_err(|error| match error {
        PlacesError::Setting(text) => Usage(text).into(),
        other => other.into(),
    })
}

fn score(
    settings: &Settings,
    scene: &DrawnScene,
    place: &Place,
    fold: usize,
    network: &Estimator,
    probes: &Probes,
) -> anyhow::Result<Scored> {
    let render = |map: &std::sync::Arc<_>| {
        Layers::render(scene, map, settings.target_error, &settings.cache)
    };
    let layers = render(&scene.truth)?;
    let truth = layers.over(&scene.photo, Curve::Reinhard)?;
    let touched = Touched::new(&layers.alpha, &truth, &scene.shown);
    let compare = |picture: &DisplayImage| compare_pictures(picture, &truth, &touched);
    let estimate = network.estimate(&scene.photo, &scene.scene.camera);
    let mut scored = Scored {
        name: scene.name.clone(),
        kind: place.kind.clone(),
        fold,
        sun: place.sun,
        scores: Vec::new(),
        exposed: Default::default(),
        pictures: vec![scene.shown.clone(), truth.clone()],
    };
    for (light, name) in LIGHTS {
        if !settings.parts && !light.is_always() {
            continue;
        }
        let map = light.map(scene, place, &estimate, probes);
        let layers = render(&map)?;
        let picture = layers.over(&scene.photo, light.curve())?;
        scored.scores.push((name.into(), compare(&picture)));
        let exposed = match light {
            Light::Neutral => 0,
            Light::Estimate => 1,
            _ => continue,
        };
        let brighter = render(&std::sync::Arc::new(map.scaled(3.0)))?;
        for k in 0..FACTORS {
            let factor = FIRST_FACTOR * 1.2f32.powi(k as i32);
            let picture = layers
                .exposed(&brighter, factor)
                .over(&scene.photo, light.curve())?;
            scored.exposed[exposed].push(compare(&picture));
        }
        scored.pictures.push(picture);
    }
    Ok(scored)
}
