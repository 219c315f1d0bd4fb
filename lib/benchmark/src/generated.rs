//! Scenes of the project's own generator, of kinds that the small model never saw in training: a place
//! with several solids under a sun and a sky, and one more solid to be put into it.
use std::path::Path;

use dipir_evaluation::results::{write, write_json};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_pretraining::generated_photograph::GeneratedPhotograph;
use dipir_pretraining::scene::Setting;
use dipir_scene::export::to_obj;
use dipir_stages::composite::table::Tone;

use crate::folder::{Drawn, EvaluationFolder, SceneInfo};

/// Columns and rows of the true light.
const MAP: [usize; 2] = [512, 256];
/// Key of these places. Training, tuning and quality checks have others.
const SEED: u64 = 0xeba1_5ce2;

/// The kind of place, which is the set that its scenes belong to.
pub fn kind(setting: Setting) -> &'static str {
    match setting {
        Setting::Open => "generated",
        Setting::Street => "street",
        Setting::Courtyard => "yard",
    }
}

/// Makes the scene number `index`, `drawn` as asked and square, unless it is there; its name.
pub fn make(
    evaluation: &EvaluationFolder,
    drawn: &Drawn,
    index: u64,
    setting: Setting,
) -> anyhow::Result<String> {
    let side = drawn.size[1];
    let place = GeneratedPhotograph::draw(SEED ^ drawn.seed, index, side as u32, setting);
    let stage = &place.scene;
    let class = stage.shape.word();
    let kind = kind(setting);
    let name = format!("{kind}-{index:03}-{class}");
    let folder = evaluation.scene(&name);
    if folder.join("scene.json").is_file() {
        return Ok(name);
    }
    let exposure = place.response.exposure;
    let exposed = place.radiance.iter().map(|p| *p * exposure).collect();
    let photo = LinearImage(Raster::from_pixels(side, side, exposed));
    let paint = stage.main_paint;
    let metal = if paint.metallic { 1.0 } else { 0.0 };
    let [r, g, b] = paint.color.to_array();
    let material = format!(
        "newmtl m0\nKd {r} {g} {b}\nPr {}\nPm {metal}\n",
        paint.roughness
    );
    write(&folder.join("object.obj"), to_obj(&stage.main, "object"))?;
    write(&folder.join("object.mtl"), material)?;
    write_png(folder.join("photo.png"), &Transfer::Srgb.encode(&photo))?;
    place.map(MAP[0], MAP[1])?.write(folder.join("map.exr"))?;
    let camera = &stage.camera;
    let ahead = camera.position - camera.rotation.z_axis;
    let fov_deg = 2.0 * (0.5 * side as f32 / camera.focal_px.y).atan().to_degrees();
    let text = format!(
        "# Made by dipir-evaluate: a place of the generator.\n\
         [scene]\nbackground = \"photo.png\"\nclass = \"{class}\"\n\n\
         [[scene.objects]]\npath = \"object.obj\"\n\n\
         [scene.camera]\nposition = {:?}\nlook_at = {:?}\nfov_deg = {fov_deg:?}\n\n\
         [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n",
        camera.position.to_array(),
        ahead.to_array(),
    );
    write(&folder.join("pipeline.toml"), text)?;
    let info = SceneInfo {
        name: name.clone(),
        made_from: format!(
            "a place with {} solids, a {} {class}, the sun {:.0} degrees high",
            stage.paints.len(),
            paint.word,
            place.sun().elevation.to_degrees()
        ),
        map: Path::new("map.exr").into(),
        exposure_ev: f64::from(exposure.log2()),
        tone: Tone::None,
        kind: Some(kind.into()),
        drawn: Some(drawn.clone()),
    };
    // Last: a scene is there once this file is.
    write_json(&folder.join("scene.json"), &info)?;
    Ok(name)
}
