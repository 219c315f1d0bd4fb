//! The other photographs of the place, `[[scene.views]]`.
use anyhow::Context;
use dipir_cli::session::Session;
use dipir_estimator::{Estimator, LightEstimate, ViewEstimate, Visible, combine};
use dipir_imaging::file::Photo;
use dipir_pipeline::stage::StagePlan;
use dipir_scene::camera::Camera;
use dipir_scene::config::SceneConfig;
use dipir_scene::exposure::Cells;
use dipir_scene::scene::LoadedScene;
use dipir_scene::views::{View, ViewSettings};

use super::exposed;
use super::surroundings::MAP;
use crate::scene::with_place;

/// The key of the list.
pub(super) const KEY: &str = "scene.views";

/// What the configuration says of them.
pub(super) fn settings(session: &Session) -> anyhow::Result<Vec<ViewSettings>> {
    let scene: SceneConfig = session.config.table("scene")?;
    scene.views().map_err(|e| with_place(e, &session.config))
}

/// Adds their photographs and cameras to the inputs of a plan.
pub(super) fn add_inputs(
    session: &Session,
    views: &[ViewSettings],
    plan: &mut StagePlan,
) -> anyhow::Result<()> {
    for view in views {
        let location = session.resolve(&view.background);
        plan.input("view", &view.background, &location)
            .with_context(|| cannot_use(view))?;
        for path in view.camera_files(&session.config.base_dir()) {
            if !plan.inputs.iter().any(|i| i.path == path) {
                plan.input("view's camera", &path, &session.resolve(&path))
                    .with_context(|| cannot_use(view))?;
            }
        }
    }
    Ok(())
}

fn cannot_use(view: &ViewSettings) -> String {
    format!(
        "cannot use {} = \"{}\"",
        view.key,
        view.background.display()
    )
}

/// The light of the scene's photograph and of the others together, and what of it those show that have a known exposure.
pub(super) fn estimate(
    session: &Session,
    loaded: &LoadedScene,
) -> anyhow::Result<(LightEstimate, Vec<Visible>)> {
    let estimator = Estimator::embedded().context("cannot read the embedded light estimator")?;
    let camera = &loaded.scene.camera;
    let own = exposed::estimate(&estimator, loaded.taken(), &loaded.photo.image, camera);
    let mut others = Vec::new();
    for settings in settings(session)? {
        let view = read(session, loaded, &settings)?;
        let told = between(loaded.taken(), &view.taken);
        let by_exif = by_exif(loaded.taken(), &view.taken);
        if let Some(warning) = disagreement(&settings.key, settings.exposure_stops, by_exif) {
            session.warn(&warning);
        }
        let position = match settings.is_placed {
            true => view.camera.position,
            // Far away it makes no difference.
            false => camera.position,
        };
        let placed = Camera {
            position,
            ..view.camera
        };
        others.push(Other {
            known: settings.exposure_stops.or(told),
            key: settings.key,
            cells: Cells::new(&view.image, placed, false),
            estimate: exposed::estimate(&estimator, &view.taken, &view.image, &view.camera),
            visible: exposed::visible(&view.taken, &view.radiance(), &view.camera, MAP),
        });
    }
    let exposures = exposures(loaded, &others);
    let mut all = vec![ViewEstimate {
        estimate: own,
        stops: Some(0.0),
    }];
    let mut seen = Vec::new();
    for (other, stops) in others.into_iter().zip(exposures) {
        session.remark(|| remark(&other.key, other.known, stops));
        all.push(ViewEstimate {
            estimate: other.estimate,
            stops,
        });
        seen.extend(stops.map(|stops| other.visible.scaled((-stops).exp2() as f32)));
    }
    Ok((combine(&all)?, seen))
}

/// Another photograph, and what is kept of it.
struct Other {
    key: String,
    /// Its exposure over that of the scene's photograph, stops, where it is written or a file tells.
    known: Option<f64>,
    cells: Cells,
    estimate: LightEstimate,
    visible: Visible,
}

/// The exposures of the others over the scene's photograph: as is known, else as what they show beside the photograph or
/// beside each other tells.
fn exposures(loaded: &LoadedScene, others: &[Other]) -> Vec<Option<f64>> {
    let mut stops: Vec<Option<f64>> = others.iter().map(|other| other.known).collect();
    if stops.iter().all(Option::is_some) {
        return stops;
    }
    let plane = loaded.description.proxy.plane();
    let photo = Cells::new(&loaded.photo.image, loaded.scene.camera, false);
    let mut from = vec![(&photo, 0.0)];
    let told = others.iter().zip(&stops);
    from.extend(told.filter_map(|(other, stops)| Some((&other.cells, (*stops)?))));
    // Those that are found tell of the next.
    let mut k = 0;
    while let Some(&(cells, known)) = from.get(k) {
        k += 1;
        for (other, stops) in others.iter().zip(&mut stops) {
            if stops.is_none()
                && let Some(more) = cells.stops_to(&other.cells, plane.as_ref())
            {
                *stops = Some(known + more);
                from.push((&other.cells, known + more));
            }
        }
    }
    stops
}

/// What is said of an exposure, and of what the pictures show of it.
fn remark(key: &str, known: Option<f64>, stops: Option<f64>) -> String {
    match (known, stops) {
        (Some(stops), _) => {
            format!("{key}: exposed by {stops:.2} stops more than scene.background")
        }
        (None, Some(stops)) => format!(
            "{key}: exposed by {stops:.2} stops more than scene.background, as what both show tells; exposure_stops beside it \
             says otherwise"
        ),
        (None, None) => format!(
            "{key}: nothing tells how it is exposed, so that it tells where light comes from and not how bright it is; write \
             exposure_stops = 0.0 beside it if it is exposed as scene.background is"
        ),
    }
}

fn read(session: &Session, loaded: &LoadedScene, settings: &ViewSettings) -> anyhow::Result<View> {
    use dipir_scene::Error::{Config, Conflict, Missing};
    let view = settings
        .load(&session.config.base_dir(), &loaded.lens())
        .map_err(|e| match e {
            Config { .. } | Missing { .. } | Conflict { .. } => with_place(e, &session.config),
            other => anyhow::Error::new(other).context(cannot_use(settings)),
        })?;
    for warning in &view.taken.warnings {
        session.warn(warning);
    }
    Ok(view)
}

/// How much more `other` is exposed than `photo`, stops, if their files tell: those of linear light have one scale.
fn between(photo: &Photo, other: &Photo) -> Option<f64> {
    if photo.values.is_none() && other.values.is_none() {
        return Some(0.0);
    }
    by_exif(photo, other)
}

fn by_exif(photo: &Photo, other: &Photo) -> Option<f64> {
    let stops = other.facts.exposure_stops? - photo.facts.exposure_stops?;
    Some(stops.clamp(-30.0, 30.0))
}

/// What to say where the exposure that is written and that by Exif data are more than a stop apart.
fn disagreement(key: &str, written: Option<f64>, by_exif: Option<f64>) -> Option<String> {
    let (written, by_exif) = (written?, by_exif?);
    ((written - by_exif).abs() > 1.0).then(|| {
        format!(
            "{} = {written:?}, but the Exif data of this photograph and of scene.background say {by_exif:.1}: {written:?} is \
             used; remove the key to use the Exif data",
            key.replace("background", "exposure_stops")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_exposure_more_than_a_stop_off_the_exif_data_is_told() {
        let told = |written, by_exif| disagreement("scene.views[0].background", written, by_exif);
        assert_eq!(told(Some(1.0), Some(0.1)), None);
        assert_eq!(told(None, Some(9.0)), None);
        assert_eq!(told(Some(9.0), None), None);
        assert_eq!(
            told(Some(3.0), Some(-1.25)).unwrap(),
            "scene.views[0].exposure_stops = 3.0, but the Exif data of this photograph and of scene.background say -1.2: 3.0 \
             is used; remove the key to use the Exif data"
        );
    }
}
