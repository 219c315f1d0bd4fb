//! The contact sheet of the lights that the photograph allows: the object under each, to choose by eye.
use std::sync::Arc;

use dipir_estimator::{BORDER_DEG, Candidate, Visible, merged};
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

/// The object under each light in the order of their numbers, row by row. The bar under a picture is as long as its
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
    let photo = &loaded.photo.image;
    let seen = Visible::new(photo, &loaded.scene.camera, MAP[0], MAP[1], BORDER_DEG);
    let tone = ToneCurves::identity();
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
        let object = tone.apply_object(&LinearImage(film.object), &film.alpha);
        let shadow = LinearImage(film.shadow);
        let linear = composite(&frame.background, &object, &film.alpha, &shadow)?;
        Ok(loaded.photo.transfer.encode(&linear).0)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_in_rows_of_four_over_bars_of_their_probability() {
        let pictures: Vec<_> = (0..6)
            .map(|n| Raster::filled(20, 10, Vec3::splat(n as f32 / 6.0)))
            .collect();
        let chances = [0.5, 0.1, 0.1, 0.1, 0.1, 0.1];
        let sheet = laid_out(&pictures, &chances).0;
        assert_eq!((sheet.width(), sheet.height()), (4 * 26 + 6, 2 * 28 + 6));
        // The sixth is the second of the second row.
        assert_eq!(sheet.get(GAP + 26 + 3, GAP + 28 + 3).x, 5.0 / 6.0);
        let bar = GAP + 10 + GAP / 2;
        let lit = (0..20).filter(|x| sheet.get(GAP + x, bar).x > 0.8).count();
        assert_eq!(lit, 10);
    }
}
