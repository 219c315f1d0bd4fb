//! Scenes of panoramas: a photograph cut out of one, a model put into it, lit by that panorama.
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::exit::Usage;
use dipir_evaluation::results::{read_json, write, write_json};
use dipir_imaging::exposure::{MID_GREY, exposure_ev_to};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_render::shapes::torus_knot;
use dipir_scene::export::to_obj;
use dipir_stages::composite::table::Tone;
use dipir_stages::scene::background::PanoramaView;
use glam::Vec3;

use crate::command_line::MakeArgs;
use crate::folder::{Drawn, EvaluationFolder, SceneInfo};

/// Vertical field of view of every photograph, degrees.
const FOV_DEG: f32 = 40.0;
/// How far the camera looks down, degrees: so that the ground in front of it fills the picture's
/// middle.
const PITCH_DEG: f32 = -14.0;
/// Height of the camera above the ground, metres.
const EYE_M: f32 = 1.75;
/// How far in front of the camera the object stands, metres.
const AWAY_M: f32 = 4.2;
/// Height of every object, metres.
const OBJECT_M: f32 = 1.1;
/// Most columns of the true light; wider panoramas are scaled down.
const MOST_COLUMNS: usize = 1024;

/// An object of the built-in ones: name, and material as an MTL file has it.
const BUILT_IN: [(&str, &str); 3] = [
    ("matte-knot", "Kd 0.7 0.65 0.6\nPr 1.0\nPm 0.0"),
    ("glossy-knot", "Kd 0.8 0.4 0.2\nPr 0.3\nPm 0.0"),
    ("metal-knot", "Kd 0.9 0.85 0.75\nPr 0.25\nPm 1.0"),
];

/// Scenes of the panoramas in `folder`; their names.
pub fn make(
    args: &MakeArgs,
    evaluation: &EvaluationFolder,
    folder: &Path,
    drawn: &Drawn,
    progress: &dyn Fn(f64),
) -> anyhow::Result<Vec<String>> {
    let kinds = args.kinds.as_deref().map(read_kinds).transpose()?;
    let panoramas = files(folder, &["hdr", "exr"], "panoramas")?;
    let models = match &args.models {
        Some(folder) => files(folder, &["glb", "gltf", "obj"], "models")?,
        None => built_in(evaluation)?,
    };
    let mut made = Vec::new();
    let mut kept: Option<(PathBuf, EnvironmentMap)> = None;
    for n in 0..args.count {
        progress(n as f64 / args.count as f64);
        let (p, m) = pair(n as usize, panoramas.len(), models.len());
        let (panorama, model) = (&panoramas[p], &models[m]);
        let name = format!("{:03}-{}-{}", n, safe_stem(panorama), safe_stem(model));
        let stem = panorama.file_stem().unwrap_or_default().to_string_lossy();
        let kind = kinds.as_ref().and_then(|k| k.get(stem.as_ref()).cloned());
        let done = evaluation.scene(&name).join("scene.json");
        if done.is_file() {
            refuse_other_kind(&done, kind)?;
        } else {
            if kept.as_ref().is_none_or(|(path, _)| path != panorama) {
                kept = Some((panorama.clone(), read_map(panorama)?));
            }
            if let Some((_, map)) = &kept {
                let source = Source {
                    panorama,
                    map,
                    model,
                    kind,
                };
                make_one(evaluation, drawn, n, &name, source)?;
            }
        }
        made.push(name);
    }
    Ok(made)
}

/// Refuses a scene that is there as of another kind than `asked`, if one is.
fn refuse_other_kind(file: &Path, asked: Option<String>) -> anyhow::Result<()> {
    let info: SceneInfo = read_json(file)?;
    match asked {
        Some(asked) if info.kind.as_ref() != Some(&asked) => {
            let had = info
                .kind
                .map_or("no kind".into(), |k| format!("the kind \"{k}\""));
            let text = format!(
                "the scene in {} has {had}, and --kinds says \"{asked}\"; name another folder with --out, or remove \
                 the scene",
                file.parent().unwrap_or(file).display()
            );
            Err(Usage(text).into())
        }
        _ => Ok(()),
    }
}

/// Panorama and model of scene number `n`. Both change from scene to scene, and every pair comes once
/// before one comes again.
fn pair(n: usize, panoramas: usize, models: usize) -> (usize, usize) {
    let (p, round) = (n % panoramas, n / panoramas);
    (p, (p + round) % models)
}

/// What a scene is made from.
struct Source<'a> {
    panorama: &'a Path,
    map: &'a EnvironmentMap,
    model: &'a Path,
    kind: Option<String>,
}

fn make_one(
    evaluation: &EvaluationFolder,
    drawn: &Drawn,
    n: u64,
    name: &str,
    source: Source,
) -> anyhow::Result<()> {
    let folder = evaluation.scene(name);
    fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let map_name = format!("{}.exr", safe_stem(source.panorama));
    write_map(&evaluation.root().join("maps").join(&map_name), source.map)?;
    let mut draw = Sampler::new(drawn.seed, Stream::PILOT, n as u32, 0);
    let yaw_deg = (draw.next_1d() * 360.0).round();
    let turn_deg = (draw.next_1d() * 360.0).round();
    let view = PanoramaView {
        fov_rad: FOV_DEG.to_radians(),
        yaw_rad: yaw_deg.to_radians(),
        pitch_rad: PITCH_DEG.to_radians(),
        roll_rad: 0.0,
        width: drawn.size[0],
        height: drawn.size[1],
    };
    let image = view.take(source.map);
    let exposure_ev = exposure_ev(&image);
    let compressed = |p: &Vec3| {
        let exposed = *p * exposure_ev.exp2() as f32;
        exposed / (Vec3::ONE + exposed)
    };
    let photo = Transfer::Srgb.encode(&LinearImage(image.0.map(compressed)));
    write_png(folder.join("photo.png"), &photo)?;
    let text = pipeline_text(&view, turn_deg, source.panorama, source.model)?;
    write(&folder.join("pipeline.toml"), text)?;
    let info = SceneInfo {
        name: name.into(),
        made_from: format!(
            "{} towards {yaw_deg} degrees, {}",
            file_name(source.panorama),
            file_name(source.model)
        ),
        map: Path::new("../../maps").join(map_name),
        exposure_ev,
        tone: Tone::Reinhard,
        kind: source.kind,
        drawn: Some(drawn.clone()),
    };
    // Last: a scene is there once this file is.
    write_json(&folder.join("scene.json"), &info)
}

/// Writes the map that all scenes of a panorama share, unless it is there; refuses another panorama's of that name.
fn write_map(path: &Path, map: &EnvironmentMap) -> anyhow::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let partial = path.with_extension("partial.exr");
    map.write(&partial)?;
    if !path.is_file() {
        return fs::rename(&partial, path)
            .with_context(|| format!("cannot write {}", path.display()));
    }
    let written = EnvironmentMap::read(&partial)?;
    fs::remove_file(&partial).with_context(|| format!("cannot remove {}", partial.display()))?;
    let there = EnvironmentMap::read(path)?;
    if (there.width(), there.texels()) != (written.width(), written.texels()) {
        let text = format!(
            "{} is the map of another panorama, whose name differs in nothing that a name of a file here shows; rename \
             one of the two, or name another folder with --out",
            path.display()
        );
        return Err(Usage(text).into());
    }
    Ok(())
}

/// The scene's `pipeline.toml`: the camera above the ground, the object in front of it.
fn pipeline_text(
    view: &PanoramaView,
    turn_deg: f32,
    panorama: &Path,
    model: &Path,
) -> anyhow::Result<String> {
    let forward = -view.rotation().z_axis;
    let across = forward.x.hypot(forward.z);
    let position = Vec3::new(
        -AWAY_M * forward.x / across,
        EYE_M,
        -AWAY_M * forward.z / across,
    );
    let look_at = position + forward;
    let model_path = model
        .canonicalize()
        .with_context(|| format!("cannot find {}", model.display()))?;
    Ok(format!(
        "# Made by dipir-evaluate from {} and {}.\n\
         [scene]\nbackground = \"photo.png\"\nclass = \"object\"\n\n\
         [[scene.objects]]\npath = {}\nheight_m = {OBJECT_M}\nyaw_deg = {turn_deg}\nanchor = \"center\"\n\n\
         [scene.camera]\nposition = {:?}\nlook_at = {:?}\nfov_deg = {FOV_DEG:?}\n\n\
         [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n",
        file_name(panorama),
        file_name(model),
        toml_string(&model_path),
        position.to_array(),
        look_at.to_array(),
    ))
}

/// Kinds of places; the key is the panorama's file name without its extension.
fn read_kinds(path: &Path) -> anyhow::Result<BTreeMap<String, String>> {
    let text = dipir_files::read_to_string(path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let mut kinds = BTreeMap::new();
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.is_empty()) {
        let columns = line.split_once('\t');
        let Some((stem, kind)) = columns.filter(|(s, k)| !s.is_empty() && !k.is_empty()) else {
            let text = format!(
                "{}:{}: accepted: a panorama's name, a tab, a kind",
                path.display(),
                n + 1
            );
            return Err(Usage(text).into());
        };
        kinds.insert(stem.into(), kind.trim().into());
    }
    Ok(kinds)
}

/// Stops of exposure after which `x / (1 + x)` displays the log-average as mid-grey.
fn exposure_ev(image: &LinearImage) -> f64 {
    exposure_ev_to(image, MID_GREY / (1.0 - MID_GREY))
}

fn read_map(path: &Path) -> anyhow::Result<EnvironmentMap> {
    let map = EnvironmentMap::read(path)
        .with_context(|| format!("cannot make scenes from {}", path.display()))?;
    Ok(match map.width() > MOST_COLUMNS {
        true => map.resampled(MOST_COLUMNS, MOST_COLUMNS / 2),
        false => map,
    })
}

/// The files in `folder` with one of the extensions, sorted; an error without any.
fn files(folder: &Path, extensions: &[&str], what: &str) -> anyhow::Result<Vec<PathBuf>> {
    let failed = || format!("cannot read {}", folder.display());
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).with_context(failed)? {
        let path = entry.with_context(failed)?.path();
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if extension.is_some_and(|e| extensions.contains(&e.as_str())) {
            found.push(path);
        }
    }
    found.sort();
    if found.is_empty() {
        let text = format!(
            "there are no {what} in {}; accepted: .{}",
            folder.display(),
            extensions.join(", .")
        );
        return Err(Usage(text).into());
    }
    Ok(found)
}

/// Writes the built-in objects, unless they are there.
fn built_in(evaluation: &EvaluationFolder) -> anyhow::Result<Vec<PathBuf>> {
    let folder = evaluation.root().join("objects");
    let mut paths = Vec::new();
    for (name, material) in BUILT_IN {
        let path = folder.join(format!("{name}.obj"));
        if !path.is_file() {
            write(
                &folder.join(format!("{name}.mtl")),
                format!("newmtl m0\n{material}\n"),
            )?;
            let mesh = torus_knot(Vec3::Y * 0.75, 0.45, 0.17, 256, 24);
            write(&path, to_obj(&mesh, name))?;
        }
        paths.push(path);
    }
    Ok(paths)
}

/// The file's name without its extension, characters that a folder may not have replaced.
fn safe_stem(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let keep = |c: char| {
        if c.is_alphanumeric() || "-_.".contains(c) {
            c
        } else {
            '-'
        }
    };
    stem.chars().map(keep).collect()
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// A path as a TOML string.
fn toml_string(path: &Path) -> String {
    let text = path.to_string_lossy();
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;

    use super::*;

    #[test]
    fn kinds_are_read_and_a_line_without_a_tab_is_refused_by_its_number() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("kinds.tsv");
        fs::write(&path, "square\toutdoors, sun\nhall\tindoors\n").unwrap();
        let kinds = read_kinds(&path).unwrap();
        assert_eq!(kinds["square"], "outdoors, sun");
        assert_eq!(kinds["hall"], "indoors");
        fs::write(&path, "square\tday\nhall indoors\n").unwrap();
        let message = read_kinds(&path).unwrap_err().to_string();
        assert!(message.ends_with("kinds.tsv:2: accepted: a panorama's name, a tab, a kind"));
        let message = format!("{:#}", read_kinds(folder.path()).unwrap_err());
        assert!(message.ends_with("not a regular file"), "{message}");
    }

    #[test]
    fn a_map_is_shared_by_scenes_of_one_panorama_and_not_of_two_whose_names_are_alike() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("maps/sky.exr");
        let map = |value: f32| EnvironmentMap::constant(8, 4, Vec3::splat(value));
        write_map(&path, &map(0.3)).unwrap();
        write_map(&path, &map(0.3)).unwrap();
        let error = write_map(&path, &map(0.7)).unwrap_err();
        assert!(error.is::<Usage>(), "{error:#}");
        assert_eq!(fs::read_dir(folder.path().join("maps")).unwrap().count(), 1);
    }

    #[test]
    fn the_exposure_shows_the_average_as_mid_grey() {
        let image = LinearImage(Raster::filled(2, 2, Vec3::splat(0.5)));
        let x = 0.5 * exposure_ev(&image).exp2();
        assert!((x / (1.0 + x) - MID_GREY).abs() < 1e-6);
        let black = LinearImage(Raster::filled(2, 2, Vec3::ZERO));
        assert_eq!(exposure_ev(&black), 0.0);
    }

    #[test]
    fn every_pair_comes_before_one_comes_again() {
        for (panoramas, models) in [(3, 6), (6, 3), (4, 4), (1, 5), (5, 1)] {
            let all: std::collections::BTreeSet<_> = (0..panoramas * models)
                .map(|n| pair(n, panoramas, models))
                .collect();
            assert_eq!(all.len(), panoramas * models, "{panoramas} x {models}");
        }
        assert_eq!([0, 1, 2].map(|n| pair(n, 3, 6)), [(0, 0), (1, 1), (2, 2)]);
    }

    #[test]
    fn names_are_safe_and_paths_are_toml() {
        assert_eq!(safe_stem(Path::new("a/b c:d.hdr")), "b-c-d");
        assert_eq!(toml_string(Path::new("a\\\"b")), "\"a\\\\\\\"b\"");
    }
}
