//! How the frames of a shot are exposed and tinted, from what they show of one place.
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use dipir_cli::interrupt;
use dipir_cli::session::Session;
use dipir_pipeline::fingerprint::Fingerprint;
use dipir_pipeline::manifest::Artifact;
use dipir_scene::config::SceneConfig;
use dipir_scene::description::SceneDescription;
use dipir_scene::exposure::{Cells, Exposure};
use dipir_scene::ground;
use dipir_scene::proxy::Plane;
use dipir_scene::views::ViewSettings;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::composite::table::{CompositeTable, Tone};
use crate::light::exposed::is_linear;
use crate::names::SCENE;
use crate::scene::with_place;

/// The file, in the folder of frames, in which exposures are kept.
const FILE: &str = "exposures.json";
/// How the file begins.
const MARK: &[u8] = b"{\"made_by\":\"dipir\",\"exposures_of\":";
/// Frames that are read at once.
const AT_ONCE: usize = 16;

/// What is kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Kept {
    made_by: String,
    /// Hash of all that decides the values.
    exposures_of: String,
    /// Of each frame, over the photograph; nothing for one that has nothing in common with the others.
    exposures: Vec<Option<Exposure>>,
}

/// How much more than the session's photograph each of `frames` is exposed, as their pictures tell. `frames` are in the
/// order in which they were taken, each with the session that makes it. What was found for the same frames earlier is
/// not looked for again; with `look` unset nothing is.
///
/// Where a frame has nothing in common with the photograph it is compared with others; the second value says of each whether
/// it has nothing in common with any, and is taken to be exposed as the one before or after it. So is the tint of a frame
/// of which nothing tells it.
///
/// # Errors
/// If the photograph or what its scene stage wrote cannot be read.
pub fn exposures(
    session: &Session,
    frames: &[(PathBuf, Session)],
    look: bool,
) -> anyhow::Result<(Vec<Exposure>, Vec<bool>)> {
    let views: Result<Vec<_>, _> = frames.iter().map(|(_, frame)| settings(frame)).collect();
    let views = views?;
    let file = kept_in(&session.out);
    let found = match fingerprint(session, frames, &views) {
        Ok(of) => match read(&file).filter(|kept| kept.exposures_of == of) {
            Some(kept) if kept.exposures.len() == frames.len() => Some(kept.exposures),
            _ if look => {
                let kept = Kept {
                    made_by: "dipir".into(),
                    exposures_of: of,
                    exposures: measured(session, &views)?,
                };
                // Without the file they are measured again.
                let _ = write(&file, &kept);
                Some(kept.exposures)
            }
            _ => None,
        },
        // The scene stage has not run.
        Err(_) if !look => None,
        Err(e) => return Err(e),
    };
    let found = found.unwrap_or_else(|| vec![Some(Exposure::SAME); frames.len()]);
    let unknown = found.iter().map(Option::is_none).collect();
    Ok((filled(&found), unknown))
}

/// Where the exposures of the shot in the folder of artifacts `out` are kept.
pub fn kept_in(out: &Path) -> PathBuf {
    out.join(super::FOLDER).join(FILE)
}

/// Whether `path` is a file that [`exposures`] wrote.
pub fn is_kept(path: &Path) -> bool {
    dipir_files::begins_with(path, MARK).unwrap_or(false)
}

/// What a killed writer of `path` left beside it.
pub fn left_of_writing(path: &Path) -> Option<PathBuf> {
    dipir_files::left_of_replacing(path, MARK)
}

fn read(path: &Path) -> Option<Kept> {
    serde_json::from_slice(&dipir_files::read(path).ok()?).ok()
}

fn write(path: &Path, kept: &Kept) -> io::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    dipir_files::replace(path, &serde_json::to_vec(kept)?, MARK)
}

/// The exposures without what is uncertain of them, and with those of neighbours where nothing is known.
fn filled(found: &[Option<Exposure>]) -> Vec<Exposure> {
    let near = |k: usize| (0..=k).rev().chain(k..found.len());
    let filled = |k| Exposure {
        stops: near(k).find_map(|k| Some(found[k]?.stops)).unwrap_or(0.0),
        tint: near(k).find_map(|k| found[k]?.tint).or(Exposure::SAME.tint),
    };
    (0..found.len()).map(|k| filled(k).certain()).collect()
}

/// The photograph of a frame and its camera.
pub(super) fn settings(session: &Session) -> anyhow::Result<ViewSettings> {
    let scene: SceneConfig = session.config.table("scene")?;
    scene.own_view().map_err(|e| with_place(e, &session.config))
}

/// Hash of all that decides exposures: the photograph and its scene, the frames and their cameras, the curve.
fn fingerprint(
    session: &Session,
    frames: &[(PathBuf, Session)],
    all: &[ViewSettings],
) -> anyhow::Result<String> {
    let scene = SCENE.manifest(session)?;
    let mut inputs = scene.inputs;
    // One that is not there is told at its turn. Exposures go by the order of frames, and so do their roles.
    let numbered = frames.iter().enumerate();
    inputs.extend(
        numbered.flat_map(|(k, (path, _))| Artifact::of(&format!("frame {k}"), path, path)),
    );
    let cameras: Vec<_> = all.iter().map(|view| &view.config.camera).collect();
    let params = json!({
        "scene": scene.params,
        "rolled_off": is_rolled_off(session)?,
        "cameras": cameras,
    });
    let parts = Fingerprint::of("exposures").version(2).params(params);
    Ok(parts.inputs(&inputs).finish().as_str().into())
}

/// Whether objects go through a curve.
fn is_rolled_off(session: &Session) -> anyhow::Result<bool> {
    let table: CompositeTable = session.config.table("composite")?;
    Ok(match table.tone {
        Some(tone) => tone == Tone::Reinhard,
        None => table.environment.is_none(),
    })
}

/// The exposures of the photographs `all` over the session's.
fn measured(session: &Session, all: &[ViewSettings]) -> anyhow::Result<Vec<Option<Exposure>>> {
    let folder = SCENE.folder(session);
    let scene = SCENE.manifest(session)?.output(&folder, "scene")?;
    let scene = SceneDescription::read(&scene)?;
    let plane = scene.proxy.plane();
    let lens = ground::view(&scene.camera, None).lens;
    let (base_dir, rolled_off) = (session.config.base_dir(), is_rolled_off(session)?);
    let cells = |view: &ViewSettings| {
        let view = view.load(&base_dir, &lens)?;
        // Linear light has one scale.
        let display = !is_linear(&view.taken);
        Ok(display.then(|| Cells::new(&view.image, view.camera, rolled_off)))
    };
    let own = settings(session)?;
    let own = cells(&own).map_err(|e: dipir_scene::Error| with_place(e, &session.config))?;
    let Some(own) = own else {
        return Ok(vec![Some(Exposure::SAME); all.len()]);
    };
    let progress = session.progress("exposures");
    let mut seen = Vec::with_capacity(all.len());
    for some in all.chunks(AT_ONCE) {
        interrupt::check()?;
        // A frame that cannot be read is told at its turn; until then it is exposed as the photograph.
        seen.par_extend(some.par_iter().map(|view| cells(view).ok().flatten()));
        progress.set(seen.len() as f64 / all.len() as f64);
    }
    progress.done();
    let told = followed(&own, &seen, plane.as_ref()).into_iter().zip(&seen);
    Ok(told
        .map(|(told, cells)| match cells {
            Some(_) => told,
            None => Some(Exposure::SAME),
        })
        .collect())
}

/// The exposures of frames over the photograph. Each is compared with the photograph, else with the frame that the one
/// before it was compared with, else with the one before it; what is left, in the same way with those after it.
fn followed(
    photo: &Cells,
    frames: &[Option<Cells>],
    plane: Option<&Plane>,
) -> Vec<Option<Exposure>> {
    let mut told: Vec<Option<Exposure>> = vec![None; frames.len()];
    let forward: Vec<usize> = (0..frames.len()).collect();
    let backward: Vec<usize> = forward.iter().rev().copied().collect();
    for order in [forward, backward] {
        let (mut key, mut last): (Option<usize>, Option<usize>) = (None, None);
        for k in order {
            let Some(frame) = &frames[k] else {
                continue;
            };
            if told[k].is_none() {
                let from = |other: Option<usize>| {
                    let (cells, known) = (frames[other?].as_ref()?, told[other?]?);
                    Some(known.and(cells.exposure_to(frame, plane)?))
                };
                let known = photo.exposure_to(frame, plane).or_else(|| from(key));
                let moved_on = known.is_none();
                told[k] = known.or_else(|| from(last));
                if moved_on {
                    key = last;
                }
            }
            if told[k].is_some() {
                last = Some(k);
            }
        }
    }
    told
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::command_line::scene::Cli;

    #[test]
    fn what_is_not_told_is_as_the_neighbour() {
        let of = |stops: f64, red: Option<f64>| {
            let tint = red.map(|red| [red, 0.0, -red]);
            Some(Exposure { stops, tint })
        };
        let found = [
            None,
            of(0.04, None),
            of(-0.06, Some(0.1)),
            None,
            of(1.05, None),
        ];
        let wanted = [
            (0.0, 0.075),
            (0.0, 0.075),
            (-0.01, 0.075),
            (-0.01, 0.075),
            (1.0, 0.075),
        ];
        for (found, (stops, red)) in filled(&found).iter().zip(wanted) {
            assert!((found.stops - stops).abs() < 1e-12, "{found:?} {stops}");
            assert!(
                (found.tint.unwrap()[0] - red).abs() < 1e-12,
                "{found:?} {red}"
            );
        }
        assert_eq!(filled(&[None]), [Exposure::SAME]);
    }

    #[test]
    fn frames_that_change_places_are_measured_anew() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let text = "[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 0.0, 0.0]\n\
                    [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n";
        fs::write(at("pipeline.toml"), text).unwrap();
        let file = at("pipeline.toml").display().to_string();
        let open = || {
            let args = ["dipir-scene", "-q", "-p", file.as_str()];
            Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap()
        };
        let session = open();
        let plan = SCENE.plan(&session, json!({}));
        session.begin(plan).unwrap().finish().unwrap();
        let frames = ["a.png", "b.png"].map(|name| (at(name), open()));
        let views = [settings(&session).unwrap(), settings(&session).unwrap()];
        let of = |contents: [&str; 2]| {
            for ((path, _), content) in frames.iter().zip(contents) {
                fs::write(path, content).unwrap();
            }
            fingerprint(&session, &frames, &views).unwrap()
        };
        let first = of(["dark", "bright"]);
        assert_ne!(of(["bright", "dark"]), first);
        assert_eq!(of(["dark", "bright"]), first);
    }

    #[test]
    fn a_file_without_tints_is_measured_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(FILE);
        let head = String::from_utf8(MARK.to_vec()).unwrap();
        let stops = format!("{head}\"a\",\"stops\":[0.5,null]}}");
        fs::write(&path, stops).unwrap();
        assert_eq!(read(&path), None);
        let kept = Kept {
            made_by: "dipir".into(),
            exposures_of: "a".into(),
            exposures: vec![Some(Exposure::SAME), None],
        };
        write(&path, &kept).unwrap();
        assert!(is_kept(&path));
        assert_eq!(read(&path), Some(kept));
    }
}
