//! The light of panoramas, recovered from a picture through the executables, for `docs/recovery.md`.
//!
//! Of every panorama a photograph is cut out, three objects are put into it under the panorama itself, and
//! `dipir-light` sees the composite alone. The same is done under lobes that were fitted to the
//! panorama, because a sum of lobes can be found and a panorama cannot.
//!
//! Truth and result are each rendered twice, with other seeds. The product of the two differences has
//! the light's error for its mean, and no noise. The truth that the optimiser sees is a third render.
//!
//! Run with `cargo test --bench hdri_recovery -- --bench MAP... [yaw=DEG] [iterations=N] [samples=N]
//! [columns=N]`, maps as HDR or EXR. Without `--bench`, as tests run it, one object under a small generated
//! map proves that it works.
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use dipir_evaluation::scores::compare_lights;
use dipir_imaging::exposure::automatic_exposure_ev;
use dipir_imaging::file::write_png;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_light::fit::fit;
use dipir_light::rasterize::rasterize;
use dipir_render::shapes::torus_knot;
use dipir_scene::export::to_obj;
use dipir_stages::scene::background::PanoramaView;
use glam::Vec3;
use serde_json::Value;

/// Lobes that are fitted to a panorama: as many as the optimiser has.
const LOBES: usize = 32;
/// Vertical field of view of the photographs, degrees.
const FOV_DEG: f32 = 40.0;

/// Name, and the material as an MTL file has it.
const OBJECTS: [(&str, &str); 3] = [
    ("matte knot", "Kd 0.7 0.65 0.6\nPr 1.0\nPm 0.0"),
    ("glossy knot", "Kd 0.8 0.4 0.2\nPr 0.3\nPm 0.0"),
    ("metal knot", "Kd 0.9 0.85 0.75\nPr 0.25\nPm 1.0"),
];

struct Knobs {
    yaw_deg: f32,
    iterations: u32,
    size: [usize; 2],
    target_error: f64,
    /// Further lines of `[light]`.
    more: String,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |key: &str| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        pairs.rfind(|(k, _)| *k == key).map(|(_, v)| {
            v.parse::<f64>()
                .unwrap_or_else(|_| panic!("{key}={v} is no number"))
        })
    };
    println!(
        "| map | truth | object | peak, degrees | RMSE touched | with noise | RMSE all | recorded RMSE | optimise, s |"
    );
    println!("|---|---|---|--:|--:|--:|--:|--:|--:|");
    if !arguments.iter().any(|a| a == "--bench") {
        let knobs = Knobs {
            yaw_deg: 0.0,
            iterations: 20,
            size: [36, 24],
            target_error: 0.02,
            more: "environment = [32, 16]\nlobes = 8\nsamples = 8\n".into(),
        };
        return recover_all("generated", &generated(), &OBJECTS[..1], &knobs);
    }
    let mut more = String::new();
    if let Some(samples) = value("samples") {
        more += &format!("samples = {samples}\n");
    }
    if let Some(columns) = value("columns") {
        more += &format!("environment = [{columns}, {}]\n", columns / 2.0);
    }
    let knobs = Knobs {
        yaw_deg: value("yaw").unwrap_or(0.0) as f32,
        iterations: value("iterations").unwrap_or(600.0) as u32,
        size: [192, 128],
        target_error: 0.002,
        more,
    };
    for path in arguments
        .iter()
        .filter(|a| !a.starts_with("--") && !a.contains('='))
    {
        let map = EnvironmentMap::read(path).unwrap_or_else(|e| panic!("{e}"));
        let name = Path::new(path).file_stem().unwrap_or_default();
        recover_all(&name.to_string_lossy(), &map, &OBJECTS, &knobs);
    }
}

/// A bright patch in a sky over a darker ground.
fn generated() -> EnvironmentMap {
    let texels = (0..64 * 32).map(|k| match (k / 64, k % 64) {
        (8..=9, 20..=22) => Vec3::splat(30.0),
        (0..=15, _) => Vec3::new(0.4, 0.5, 0.7),
        _ => Vec3::new(0.3, 0.25, 0.2),
    });
    EnvironmentMap::new(64, 32, texels.collect()).expect("a map")
}

/// Runs an executable in `folder` and returns what it prints as JSON.
fn run(executable: &str, folder: &Path, arguments: &[&str]) -> Value {
    let output = Command::new(executable)
        .args(arguments)
        .arg("--json")
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .unwrap_or_else(|e| panic!("{executable}: {e}"));
    assert!(
        output.status.success(),
        "{executable} {arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).expect("JSON")
}

const SCENE: &str = env!("CARGO_BIN_EXE_dipir-scene");
const LIGHT: &str = env!("CARGO_BIN_EXE_dipir-light");
const COMPOSITE: &str = env!("CARGO_BIN_EXE_dipir-composite");

/// A row of the table for every truth and object.
fn recover_all(name: &str, map: &EnvironmentMap, objects: &[(&str, &str)], knobs: &Knobs) {
    let project = tempfile::tempdir().expect("a folder");
    let folder = project.path();
    map.write(folder.join("map.exr")).expect("writes");
    // Lobes narrower than a texel of the panorama would lose their shape on its grid.
    let lobes = fit(map, LOBES).lobes;
    let fitted = rasterize(&lobes, map.width().max(512), map.height().max(256));
    fitted.write(folder.join("lobes.exr")).expect("writes");
    let view = PanoramaView {
        fov_rad: FOV_DEG.to_radians(),
        yaw_rad: knobs.yaw_deg.to_radians(),
        pitch_rad: -14f32.to_radians(),
        roll_rad: 0.0,
        width: knobs.size[0],
        height: knobs.size[1],
    };
    let photo = view.take(map);
    let exposure_ev = automatic_exposure_ev(&photo);
    let exposed = LinearImage(photo.0.map(|p| *p * exposure_ev.exp2()));
    write_png(folder.join("photo.png"), &Transfer::Srgb.encode(&exposed)).expect("writes");
    let knot = torus_knot(Vec3::Y * 0.75, 0.45, 0.17, 256, 24);
    fs::write(folder.join("knot.obj"), to_obj(&knot, "knot")).expect("writes");
    for truth in ["map", "lobes"] {
        for (object, material) in objects {
            let mtl = format!("newmtl m0\n{material}\n");
            fs::write(folder.join("knot.mtl"), mtl).expect("writes");
            let row = recover(folder, truth, &view, exposure_ev, knobs);
            println!("| {name} | {truth} | {object} | {row} |");
        }
    }
}

/// One recovery; the numbers of its row.
fn recover(
    folder: &Path,
    truth: &str,
    view: &PanoramaView,
    exposure_ev: f32,
    knobs: &Knobs,
) -> String {
    let forward = -view.rotation().z_axis;
    // Four metres in front of the object, wherever the camera looks.
    let across = forward.x.hypot(forward.z);
    let position = [-4.2 * forward.x / across, 1.75, -4.2 * forward.z / across];
    let look_at = (Vec3::from_array(position) + forward).to_array();
    let pipeline = format!(
        "[scene]\nbackground = \"photo.png\"\nclass = \"knot\"\n[[scene.objects]]\npath = \"knot.obj\"\n\
         [scene.camera]\nposition = {position:?}\nlook_at = {look_at:?}\nfov_deg = {FOV_DEG:?}\n\
         [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n\
         [light]\nguidance = \"reference\"\nreference = \"truth/composite/composite.exr\"\n\
         iterations = {}\npreview_every = 0\n{}[composite]\ntarget_error = {}\n",
        knobs.iterations, knobs.more, knobs.target_error
    );
    fs::write(folder.join("pipeline.toml"), pipeline).expect("writes");
    let environment = format!("composite.environment=\"{truth}.exr\"");
    let exposed = format!("composite.exposure_ev={exposure_ev}");
    let lit = [
        "-o",
        "truth",
        "-s",
        &environment,
        "-s",
        &exposed,
        "-s",
        "composite.tone=reinhard",
    ];
    let render = |settings: &[&str], seed: u32, target: f64| {
        let seed = format!("pipeline.seed={seed}");
        let target = format!("composite.target_error={target}");
        let sets = ["-s", &seed, "-s", &target];
        run(COMPOSITE, folder, &[settings, &sets].concat());
        let out = if settings.is_empty() { "out" } else { "truth" };
        let path = folder.join(out).join("composite/composite.exr");
        Layers::read_exr(path).expect("reads")
    };
    let fine = knobs.target_error;
    run(SCENE, folder, &lit);
    let truths = [2, 4].map(|seed| render(&lit, seed, 2.0 * fine));
    // The one that the optimiser sees.
    render(&lit, 0, fine);
    run(SCENE, folder, &[]);
    let optimized = run(LIGHT, folder, &[]);
    let found = [3, 1].map(|seed| render(&[], seed, 2.0 * fine));
    let [touched, all] = apart(&truths, &found);

    let number = |v: &Value| v.as_f64().expect("a number");
    let map = EnvironmentMap::read(folder.join(format!("{truth}.exr"))).expect("reads");
    let light = EnvironmentMap::read(folder.join("out/light/environment.exr")).expect("reads");
    let peak_deg = compare_lights(&light, &map).peak_deg;
    format!(
        "{:.2} | {:.4} | {:.4} | {:.4} | {:.4} | {:.1}",
        peak_deg.unwrap_or(f64::NAN),
        touched.free,
        touched.noisy,
        all.free,
        number(&optimized["rmse"]),
        number(&optimized["elapsed_s"]),
    )
}

/// A display-referred RMSE.
struct Apart {
    /// Without the noise of the renders.
    free: f64,
    /// Of the later pair, as it was rendered.
    noisy: f64,
}

/// Distance of two pairs of composites, over what object or shadow touch, and over all.
fn apart(truths: &[Layers; 2], found: &[Layers; 2]) -> [Apart; 2] {
    let pictures = |pair: &[Layers; 2]| {
        [0, 1].map(|i| {
            let mut picture = pair[i].rgb("").expect("a picture");
            for p in picture.pixels_mut() {
                *p = Vec3::from(p.to_array().map(|v| Transfer::Srgb.encode_scalar(v)));
            }
            picture
        })
    };
    let (a, b) = (pictures(truths), pictures(found));
    let alpha = truths[1].channel("object.A").expect("coverage");
    let shadow = truths[1].rgb("shadow").expect("a shadow");
    let difference = |i: usize, k: usize| (b[i].pixels()[k] - a[i].pixels()[k]).as_dvec3();
    let over = |counts: &dyn Fn(usize) -> bool| {
        let kept: Vec<usize> = (0..alpha.pixels().len()).filter(|k| counts(*k)).collect();
        let mean = |i: usize, j: usize| {
            let products = kept.iter().map(|&k| difference(i, k).dot(difference(j, k)));
            products.sum::<f64>() / (3 * kept.len()).max(1) as f64
        };
        Apart {
            free: mean(0, 1).max(0.0).sqrt(),
            noisy: mean(1, 1).sqrt(),
        }
    };
    [
        over(&|k| alpha.pixels()[k] > 0.0 || shadow.pixels()[k].min_element() < 0.999),
        over(&|_| true),
    ]
}
