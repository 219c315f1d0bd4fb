//! Scenes whose true light is known: a photograph cut out of a panorama, a model put into it, lit by
//! that panorama.
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::exit::Usage;
use dipir_cli::progress::Progress;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_pretraining::scene::Setting;
use dipir_render::shapes::torus_knot;
use dipir_scene::export::to_obj;
use dipir_stages::scene::background::{MID_GREY, View, exposure_ev_to};
use glam::Vec3;
use serde_json::json;

use crate::bench::{Bench, SceneInfo, Tone, write, write_json};
use crate::cli::{MakeArgs, Places};
use crate::generated;

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
/// Columns of the true light that are kept at most.
const MOST_COLUMNS: usize = 1024;

/// An object of the built-in ones: name, and material as an MTL file has it.
const BUILT_IN: [(&str, &str); 3] = [
    ("matte-knot", "Kd 0.7 0.65 0.6\nPr 1.0\nPm 0.0"),
    ("glossy-knot", "Kd 0.8 0.4 0.2\nPr 0.3\nPm 0.0"),
    ("metal-knot", "Kd 0.9 0.85 0.75\nPr 0.25\nPm 1.0"),
];

/// Makes scenes; those that are there already stay.
pub fn run(args: &MakeArgs) -> anyhow::Result<()> {
    let bench = Bench::new(&args.folder.out);
    if args.hdri.is_none() && args.generated == 0 {
        let text = "there is nothing to make scenes from: name a folder of panoramas with --hdri, or a \
                    number of generated places with --generated";
        return Err(Usage(text.into()).into());
    }
    if args.places != Places::Open && args.generated == 0 {
        let text = "--places is about generated places: say how many with --generated";
        return Err(Usage(text.into()).into());
    }
    let progress = Progress::new("make", args.folder.output.quiet);
    let mut made = Vec::new();
    if let Some(folder) = &args.hdri {
        made = of_panoramas(args, &bench, folder, &progress)?;
    }
    let setting = match args.places {
        Places::Open => Setting::Open,
        Places::Street => Setting::Street,
        Places::Yard => Setting::Courtyard,
    };
    for n in 0..args.generated {
        progress.set(n as f64 / args.generated as f64);
        made.push(generated::make(
            &bench,
            args.seed,
            n,
            args.size[1],
            setting,
        )?);
    }
    progress.done();
    args.folder.output.result(
        || {
            format!(
                "{} scenes in {}",
                made.len(),
                bench.root().join("scenes").display()
            )
        },
        || json!({"scenes": made, "folder": bench.root()}),
    );
    Ok(())
}

/// Scenes of the panoramas in `folder`; their names.
fn of_panoramas(
    args: &MakeArgs,
    bench: &Bench,
    folder: &Path,
    progress: &Progress,
) -> anyhow::Result<Vec<String>> {
    let panoramas = files(folder, &["hdr", "exr"], "panoramas")?;
    let models = match &args.models {
        Some(folder) => files(folder, &["glb", "gltf", "obj"], "models")?,
        None => built_in(bench)?,
    };
    let mut made = Vec::new();
    let mut kept: Option<(PathBuf, EnvironmentMap)> = None;
    for n in 0..args.count {
        progress.set(n as f64 / args.count as f64);
        let (p, m) = pair(n as usize, panoramas.len(), models.len());
        let (panorama, model) = (&panoramas[p], &models[m]);
        let name = format!("{:03}-{}-{}", n, stem(panorama), stem(model));
        let done = bench.scene(&name).join("scene.json");
        if !done.is_file() {
            if kept.as_ref().is_none_or(|(path, _)| path != panorama) {
                kept = Some((panorama.clone(), read_map(panorama)?));
            }
            if let Some((_, map)) = &kept {
                make(bench, args, n, &name, panorama, map, model)?;
            }
        }
        made.push(name);
    }
    Ok(made)
}

/// Panorama and model of the scene number `n`: both change from scene to scene, and every pair comes once
/// before one comes again.
fn pair(n: usize, panoramas: usize, models: usize) -> (usize, usize) {
    let (p, round) = (n % panoramas, n / panoramas);
    (p, (p + round) % models)
}

fn make(
    bench: &Bench,
    args: &MakeArgs,
    n: u64,
    name: &str,
    panorama: &Path,
    map: &EnvironmentMap,
    model: &Path,
) -> anyhow::Result<()> {
    let folder = bench.scene(name);
    fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    // Shared by all scenes of the panorama.
    let shared = bench
        .root()
        .join("maps")
        .join(format!("{}.exr", stem(panorama)));
    if !shared.is_file() {
        fs::create_dir_all(bench.root().join("maps"))
            .with_context(|| format!("cannot create {}", bench.root().join("maps").display()))?;
        let partial = shared.with_extension("partial.exr");
        map.write(&partial)?;
        fs::rename(&partial, &shared)
            .with_context(|| format!("cannot write {}", shared.display()))?;
    }
    let mut draw = Sampler::new(args.seed, Stream::PILOT, n as u32, 0);
    let yaw_deg = (draw.next_1d() * 360.0).round();
    let turn_deg = (draw.next_1d() * 360.0).round();
    let view = View {
        fov_rad: FOV_DEG.to_radians(),
        yaw_rad: yaw_deg.to_radians(),
        pitch_rad: PITCH_DEG.to_radians(),
        roll_rad: 0.0,
        width: args.size[0],
        height: args.size[1],
    };
    let image = view.take(map);
    let exposure_ev = exposure_ev(&image);
    let tone = |p: &Vec3| {
        let exposed = *p * exposure_ev.exp2() as f32;
        exposed / (Vec3::ONE + exposed)
    };
    let photo = Transfer::Srgb.encode(&LinearImage(image.0.map(tone)));
    write_png(folder.join("photo.png"), &photo)?;
    let forward = -view.rotation().z_axis;
    let across = forward.x.hypot(forward.z);
    let stand = Vec3::new(
        -AWAY_M * forward.x / across,
        EYE_M,
        -AWAY_M * forward.z / across,
    );
    let ahead = stand + forward;
    let model_path = model
        .canonicalize()
        .with_context(|| format!("cannot find {}", model.display()))?;
    let text = format!(
        "# Made by dipir-evaluate from {} and {}.\n\
         [scene]\nbackground = \"photo.png\"\nclass = \"object\"\n\n\
         [[scene.objects]]\npath = {}\nheight_m = {OBJECT_M}\nyaw_deg = {turn_deg}\nanchor = \"center\"\n\n\
         [scene.camera]\nposition = {:?}\nlook_at = {:?}\nfov_deg = {FOV_DEG:?}\n\n\
         [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n",
        file_name(panorama),
        file_name(model),
        quoted(&model_path),
        stand.to_array(),
        ahead.to_array(),
    );
    write(&folder.join("pipeline.toml"), text)?;
    let info = SceneInfo {
        name: name.into(),
        made_from: format!(
            "{} towards {yaw_deg} degrees, {}",
            file_name(panorama),
            file_name(model)
        ),
        map: Path::new("../../maps").join(format!("{}.exr", stem(panorama))),
        exposure_ev,
        tone: Tone::Reinhard,
    };
    // Last: it stands for all of them.
    write_json(&folder.join("scene.json"), &info)
}

/// Stops after which the log-average is displayed as mid-grey, `x / (1 + x)` coming after them.
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
fn built_in(bench: &Bench) -> anyhow::Result<Vec<PathBuf>> {
    let folder = bench.root().join("objects");
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

fn stem(path: &Path) -> String {
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
fn quoted(path: &Path) -> String {
    let text = path.to_string_lossy();
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""))
}

#[cfg(test)]
mod tests {
    use dipir_imaging::raster::Raster;

    use super::*;

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
        assert_eq!(stem(Path::new("a/b c:d.hdr")), "b-c-d");
        assert_eq!(quoted(Path::new("a\\\"b")), "\"a\\\\\\\"b\"");
    }
}
