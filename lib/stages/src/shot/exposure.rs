//! How the frames of a shot are exposed and tinted, from what they show of one place.
use std::collections::BTreeMap;
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
    /// Hash of what decides the values of all frames.
    exposures_of: String,
    /// By the names of their folders.
    frames: BTreeMap<String, KeptFrame>,
}

/// What is kept of a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct KeptFrame {
    /// Hash of what decides its values alone.
    of: String,
    /// How many frames it was measured with, itself among them; nothing if the photograph alone tells both values.
    among: Option<usize>,
    /// Over the photograph; nothing if it has nothing in common with the others.
    told: Option<Exposure>,
    /// The same without what is uncertain, and with a neighbour's values where nothing tells them.
    exposure: Exposure,
}

impl Kept {
    /// What is kept of a frame, if it is as good as what would be measured with `count` frames now.
    fn frame(&self, (name, of): &(String, String), count: usize) -> Option<KeptFrame> {
        let found = self.frames.get(name)?;
        let holds = found.of == *of && found.among.is_none_or(|among| among >= count);
        holds.then(|| found.clone())
    }
}

/// How much more than the session's photograph each of `frames` is exposed, as their pictures tell. `frames` are in the
/// order in which they were taken, each with the session that makes it. What was found for a frame earlier, alone by the
/// photograph or beside as many frames, is not looked for again and stays, whichever frames are asked for; with `look` unset
/// nothing is looked for.
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
    let (views, count) = (views?, frames.len());
    let file = kept_in(&session.out);
    let of = match fingerprint(session) {
        Ok(of) => of,
        // The scene stage has not run.
        Err(_) if !look => return Ok((vec![Exposure::SAME; count], vec![false; count])),
        Err(e) => return Err(e),
    };
    let kept = read(&file).filter(|kept| kept.exposures_of == of);
    let mut kept = kept.unwrap_or_else(|| Kept {
        made_by: "dipir".into(),
        exposures_of: of,
        frames: BTreeMap::new(),
    });
    let keys = frames.iter().zip(&views);
    let keys: Vec<_> = keys.map(|((path, _), view)| key(path, view)).collect();
    let mut found: Vec<_> = keys.iter().map(|key| kept.frame(key, count)).collect();
    if look && found.contains(&None) {
        let known: Vec<_> = found.iter().map(|f| f.as_ref()?.told).collect();
        let (told, by_photo) = measured(session, &views, known)?;
        let exposures = filled(&told);
        for (k, (name, of)) in keys.into_iter().enumerate() {
            let frame = found[k].get_or_insert_with(|| KeptFrame {
                of,
                among: (!by_photo[k]).then_some(count),
                told: told[k],
                exposure: exposures[k],
            });
            kept.frames.insert(name, frame.clone());
        }
        // Without the file they are measured again.
        let _ = write(&file, &kept);
    }
    let exposure = |f: &Option<KeptFrame>| f.as_ref().map_or(Exposure::SAME, |f| f.exposure);
    let is_unknown = |f: &Option<KeptFrame>| f.as_ref().is_some_and(|f| f.told.is_none());
    let unknown = found.iter().map(is_unknown).collect();
    Ok((found.iter().map(exposure).collect(), unknown))
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

/// Hash of what decides the exposures of all frames: the photograph and its scene, the curve.
fn fingerprint(session: &Session) -> anyhow::Result<String> {
    let scene = SCENE.manifest(session)?;
    let params = json!({ "scene": scene.params, "rolled_off": is_rolled_off(session)? });
    let parts = Fingerprint::of("exposures").version(3).params(params);
    Ok(parts.inputs(&scene.inputs).finish().as_str().into())
}

/// The name of a frame, and the hash of what decides its exposure alone: the picture and its camera.
fn key(path: &Path, view: &ViewSettings) -> (String, String) {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    // One that is not there is told at its turn.
    let inputs: Vec<_> = Artifact::of("frame", path, path).into_iter().collect();
    let params = json!({ "camera": view.config.camera });
    let parts = Fingerprint::of("exposure").params(params);
    let of = parts.inputs(&inputs).finish();
    (name.into_owned(), of.as_str().into())
}

/// Whether objects go through a curve.
fn is_rolled_off(session: &Session) -> anyhow::Result<bool> {
    let table: CompositeTable = session.config.table("composite")?;
    Ok(match table.tone {
        Some(tone) => tone == Tone::Reinhard,
        None => table.environment.is_none(),
    })
}

/// The exposures of the photographs `all` over the session's, beside those that are `known`, and of each whether the session's
/// alone tells both of its values.
fn measured(
    session: &Session,
    all: &[ViewSettings],
    known: Vec<Option<Exposure>>,
) -> anyhow::Result<(Vec<Option<Exposure>>, Vec<bool>)> {
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
        return Ok((vec![Some(Exposure::SAME); all.len()], vec![true; all.len()]));
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
    let plane = plane.as_ref();
    let by_photo = seen.par_iter().map(|cells| match cells {
        Some(cells) => own.exposure_to(cells, plane),
        None => Some(Exposure::SAME),
    });
    let by_photo: Vec<_> = by_photo.collect();
    let told = known.iter().zip(&by_photo);
    let told = told.map(|(known, by_photo)| known.or(*by_photo)).collect();
    let is_whole = |told: &Option<Exposure>| told.is_some_and(|told| told.tint.is_some());
    let alone = by_photo.iter().map(is_whole).collect();
    Ok((followed(told, &seen, plane), alone))
}

/// The exposures of frames over the photograph, of which those that it tells are `told`. Each other is compared with the frame
/// that the one before it was compared with, else with the one before it; what is left, in the same way with those after it.
fn followed(
    mut told: Vec<Option<Exposure>>,
    frames: &[Option<Cells>],
    plane: Option<&Plane>,
) -> Vec<Option<Exposure>> {
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
                let known = from(key);
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
        let args = ["dipir-scene", "-q", "-p", file.as_str()];
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        let view = settings(&session).unwrap();
        let of = |name: &str, content: &str| {
            fs::write(at(name), content).unwrap();
            key(&at(name), &view)
        };
        let [a, b] = [of("a.png", "dark"), of("b.png", "bright")];
        let [c, d] = [of("a.png", "bright"), of("b.png", "dark")];
        assert_eq!([&a.0, &b.0], [&c.0, &d.0]);
        assert!(a.1 != c.1 && b.1 != d.1);
        assert_eq!(of("a.png", "dark"), a);
    }

    #[test]
    fn what_is_kept_of_a_frame_holds_for_as_many_frames_as_it_was_measured_with() {
        let frame = |among| KeptFrame {
            of: "a".into(),
            among,
            told: Some(Exposure::SAME),
            exposure: Exposure::SAME,
        };
        let all = [("chained", Some(900)), ("direct", None)];
        let all = all.map(|(name, among)| (name.to_string(), frame(among)));
        let kept = Kept {
            made_by: "dipir".into(),
            exposures_of: "a".into(),
            frames: all.into(),
        };
        let holds = |name: &str, of: &str, count| {
            let key = (name.to_string(), of.to_string());
            kept.frame(&key, count).is_some()
        };
        assert!(holds("chained", "a", 1) && holds("chained", "a", 900));
        assert!(!holds("chained", "a", 901) && holds("direct", "a", 901));
        assert!(!holds("direct", "b", 1) && !holds("other", "a", 1));
    }

    #[test]
    fn a_file_of_another_layout_is_measured_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(FILE);
        let head = String::from_utf8(MARK.to_vec()).unwrap();
        for earlier in ["\"stops\":[0.5,null]", "\"exposures\":[null]"] {
            fs::write(&path, format!("{head}\"a\",{earlier}}}")).unwrap();
            assert_eq!(read(&path), None);
        }
        let kept = Kept {
            made_by: "dipir".into(),
            exposures_of: "a".into(),
            frames: BTreeMap::new(),
        };
        write(&path, &kept).unwrap();
        assert!(is_kept(&path));
        assert_eq!(read(&path), Some(kept));
    }
}
