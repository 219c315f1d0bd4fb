//! The contact sheet of the lights that the photograph allows: the object under each, to choose by eye.
use std::sync::Arc;

use dipir_estimator::{Candidate, merged};
use dipir_imaging::composite::composite;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::gaussian::SgMixture;
use dipir_light::map_with_lobes::MapWithLobes;
use dipir_render::adaptive::Stop;
use dipir_render::render::{Renderer, Settings, Simulation};
use dipir_scene::scene::LoadedScene;
use glam::Vec3;

use super::estimate::Estimated;
use super::exposed;
use super::surroundings::with_others;
use crate::interruption;
use crate::scene::transport::Frame;

/// Longest side of a picture, pixels.
const SIDE: usize = 160;
/// Pictures in a row.
const COLUMNS: usize = 4;
/// Samples of a pixel: enough to tell lights apart.
const SAMPLES: u32 = 16;
/// Columns and rows of the surroundings: texels of 2.8 degrees.
const MAP: [usize; 2] = [128, 64];
/// Pixels between pictures; under each is a bar this high, as long as its light is probable.
const GAP: usize = 6;
/// Digits 1 to 9: five rows of three bits, from the top.
const DIGITS: [u16; 9] = [
    0b010_110_010_010_111,
    0b110_001_010_100_111,
    0b110_001_010_001_110,
    0b101_101_111_001_001,
    0b111_100_110_001_110,
    0b011_100_110_101_010,
    0b111_001_010_010_010,
    0b010_101_010_101_010,
    0b010_101_011_001_110,
];
/// Pixels of a bit of a digit.
const BIT: usize = 3;

/// The object under each light with the number that chooses it, row by row. The bar under a picture is as long as its
/// light is probable.
pub(super) fn sheet(
    loaded: &LoadedScene,
    simulation: &Simulation,
    estimated: &Estimated,
    visible: bool,
) -> anyhow::Result<DisplayImage> {
    let frame = Frame::new(loaded, SIDE);
    let renderer = Renderer::new(&loaded.scene).with_camera(frame.camera);
    let settings = Settings {
        stop: Stop::Samples(SAMPLES),
        ..frame.render_settings()
    };
    let (photo, taken) = (&loaded.photo.image, loaded.taken());
    let seen = exposed::visible(taken, &loaded.radiance(), &loaded.scene.camera, MAP);
    let tone = exposed::tone(taken, ToneCurves::identity());
    let gain = exposed::gain(taken, photo);
    let picture = |c: &Candidate| -> anyhow::Result<Raster<Vec3>> {
        let (smooth, sources) = match c.direction {
            Some(_) => (estimated.estimate.base_map(), &c.lobes[..1]),
            None => (c.map.clone(), &c.lobes[..0]),
        };
        let map = match visible {
            true => merged(&seen, &with_others(&estimated.seen, &smooth)),
            false => smooth,
        };
        let sampler = EnvironmentSampler::new(Arc::new(map));
        let light = MapWithLobes::new(sampler, SgMixture::new(sources.to_vec())?);
        let film = renderer
            .render(&light, simulation, &settings, &mut |_| interruption())
            .map_err(crate::render_error)?
            .film;
        let object = LinearImage(film.object);
        let object = match &tone {
            Some(tone) => tone.apply_object(&object, &film.alpha),
            None => object,
        };
        let shadow = LinearImage(film.shadow);
        let linear = composite(&frame.background, &object, &film.alpha, &shadow)?;
        let shown = LinearImage(linear.0.map(|p| *p * gain));
        Ok(loaded.photo.transfer.encode(&shown).0)
    };
    let candidates = &estimated.lights;
    let pictures = candidates
        .iter()
        .map(picture)
        .collect::<anyhow::Result<Vec<_>>>()?;
    let chances: Vec<f64> = candidates.iter().map(|c| c.probability).collect();
    Ok(laid_out(&pictures, &chances))
}

fn laid_out(pictures: &[Raster<Vec3>], chances: &[f64]) -> DisplayImage {
    let (w, h) = pictures.first().map_or((1, 1), |p| (p.width(), p.height()));
    let columns = COLUMNS.min(pictures.len().max(1));
    let (width, height) = (
        columns * (w + GAP) + GAP,
        pictures.len().div_ceil(columns) * (h + 3 * GAP) + GAP,
    );
    let mut sheet = Raster::filled(width, height, Vec3::splat(0.2));
    for (n, picture) in pictures.iter().enumerate() {
        let left = GAP + n % columns * (w + GAP);
        let top = GAP + n / columns * (h + 3 * GAP);
        for y in 0..h {
            for x in 0..w {
                *sheet.get_mut(left + x, top + y) = *picture.get(x, y);
            }
        }
        number(&mut sheet, n, [left, top]);
        let length = (chances[n] * w as f64).round() as usize;
        for y in 0..GAP {
            for x in 0..w {
                let lit = if x < length { 0.9 } else { 0.35 };
                *sheet.get_mut(left + x, top + h + GAP / 2 + y) = Vec3::splat(lit);
            }
        }
    }
    DisplayImage(sheet)
}

/// Writes the number of picture `n`, counted from 0, into its corner: white on black. Beyond 9 there is none.
fn number(sheet: &mut Raster<Vec3>, n: usize, [left, top]: [usize; 2]) {
    let Some(digit) = DIGITS.get(n) else { return };
    let is_lit = |column: usize, row: usize| {
        (1..4).contains(&column)
            && (1..6).contains(&row)
            && digit >> (14 - 3 * (row - 1) - (column - 1)) & 1 == 1
    };
    for (y, x) in (0..7 * BIT).flat_map(|y| (0..5 * BIT).map(move |x| (y, x))) {
        let (x_at, y_at) = (left + x, top + y);
        if x_at < sheet.width() && y_at < sheet.height() {
            let lit = if is_lit(x / BIT, y / BIT) { 1.0 } else { 0.0 };
            *sheet.get_mut(x_at, y_at) = Vec3::splat(lit);
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_cli::session::Session;
    use dipir_optimize::settings::LightTable;
    use dipir_render::effects::EffectsPlan;
    use dipir_scene::scene::Scene;

    use super::*;
    use crate::command_line::light::Cli;
    use crate::light::estimate::estimate;

    /// White above, grey below; a gain map of 3 stops on the white.
    const PHOTO: &[u8] = include_bytes!("../../../../fuzz/seeds/photograph/gain_map.jpg");

    #[test]
    fn objects_are_lit_by_what_a_gain_map_tells_of_the_sky() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("photo.jpg"), PHOTO).unwrap();
        // A plate that lies beneath the sky in the picture.
        let object = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nf 1 4 3 2\n";
        std::fs::write(at("object.obj"), object).unwrap();
        let text = "[scene]\nbackground = \"photo.jpg\"\n[[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 1.0, 2.0]\n\
                    [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 1.6, 0.0]\nfov_deg = 50.0\n";
        std::fs::write(at("pipeline.toml"), text).unwrap();
        let args = [
            "dipir-light",
            "-q",
            "-p",
            &at("pipeline.toml").display().to_string(),
        ];
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        let mut loaded =
            Scene::load(&session.config.table("scene").unwrap(), folder.path()).unwrap();
        let estimated = estimate(&session, &LightTable::default(), &loaded, 1).unwrap();
        let renderer = Renderer::new(&loaded.scene);
        let settings = Settings::of_scene(&loaded);
        let plan = EffectsPlan::new(&renderer, loaded.description.effects(), &settings);
        let simulation = plan.simulation();
        let brightness = |loaded: &LoadedScene| {
            let sheet = sheet(loaded, &simulation, &estimated, true).unwrap().0;
            sheet.pixels().iter().map(|p| p.x).sum::<f32>()
        };
        let with_gain = brightness(&loaded);
        loaded.photo.gain = None;
        let without = brightness(&loaded);
        // Most of the sheet is photograph.
        assert!(with_gain > 1.001 * without, "{with_gain} {without}");
    }

    #[test]
    fn every_picture_has_its_number() {
        let pictures = vec![Raster::filled(40, 30, Vec3::splat(0.5)); 9];
        let sheet = laid_out(&pictures, &[0.1; 9]).0;
        // The bits of a digit as they stand in the sheet.
        let read = |n: usize| {
            let (left, top) = (
                GAP + n % COLUMNS * (40 + GAP),
                GAP + n / COLUMNS * (30 + 3 * GAP),
            );
            let bits = (0..15).map(|k| {
                let (x, y) = (left + BIT + k % 3 * BIT, top + BIT + k / 3 * BIT);
                u16::from(sheet.get(x, y).x == 1.0)
            });
            bits.fold(0, |all, bit| all << 1 | bit)
        };
        assert_eq!((0..9).map(read).collect::<Vec<_>>(), DIGITS);
        // A seven: a bar above, the rest leans to the left.
        assert_eq!(read(6), 0b111_001_010_010_010);
    }

    #[test]
    fn pictures_stand_in_rows_of_four_over_bars_of_their_probability() {
        let pictures: Vec<_> = (0..6)
            .map(|n| Raster::filled(40, 30, Vec3::splat(n as f32 / 6.0)))
            .collect();
        let chances = [0.5, 0.1, 0.1, 0.1, 0.1, 0.1];
        let sheet = laid_out(&pictures, &chances).0;
        assert_eq!((sheet.width(), sheet.height()), (4 * 46 + 6, 2 * 48 + 6));
        // The sixth is the second of the second row.
        assert_eq!(sheet.get(GAP + 46 + 30, GAP + 48 + 3).x, 5.0 / 6.0);
        let bar = GAP + 30 + GAP / 2;
        let lit = (0..40).filter(|x| sheet.get(GAP + x, bar).x > 0.8).count();
        assert_eq!(lit, 20);
    }
}
