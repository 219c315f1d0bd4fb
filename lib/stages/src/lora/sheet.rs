//! What the adapter changes, as one picture: the same prompts and noise without it and with it.
use std::path::Path;

use dipir_cli::interrupt;
use dipir_diffusion::Error;
use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_diffusion::text_encoder::LearnedTokens;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;

/// Longest side of a picture that is sampled, pixels: a quarter of the time of Stable Diffusion's own.
pub(crate) const LONGEST: usize = 256;
/// Shortest side of a picture on the sheet: smaller ones are enlarged, pixel by pixel.
const SHORTEST: usize = 128;
/// Pixels between pictures.
const GAP: usize = 8;

/// What the sheet shows.
pub(super) struct Sheet {
    /// One a row; without the adapter on the left, with it on the right.
    pub(super) prompts: Vec<String>,
    /// Denoising steps.
    pub(super) steps: usize,
    /// What the LoRA is called in messages.
    pub(super) of: String,
}

/// The side of a model's pictures on the sheet, a multiple of what it needs.
fn side(model: &Model) -> usize {
    // Every level of the UNet halves the latents.
    let multiple = model.vae.downscale() << (model.unet.config().levels() - 1);
    let side = model.native_size().min(LONGEST);
    (side / multiple).max(1) * multiple
}

impl Sheet {
    /// Samples the pictures and writes them. Returns the root of the mean square of the difference between both columns, of
    /// display values from 0 to 1.
    pub(super) fn write(
        &self,
        model: &Model,
        lora: &Lora,
        learned: Option<&LearnedTokens>,
        path: &Path,
        mut progress: impl FnMut(f64),
    ) -> anyhow::Result<f64> {
        let adapted = Pass {
            lora: Some(lora.constant(model.dtype())?.into()),
            ..Pass::default()
        };
        let (mut rows, mut squares) = (vec![], 0.0);
        let pictures = 2.0 * self.prompts.len() as f64;
        let mut done = 0.0;
        for (index, prompt) in self.prompts.iter().enumerate() {
            let mut row = vec![];
            for pass in [&Pass::default(), &adapted] {
                let picture = self.sample(model, learned, prompt, index, pass, |part| {
                    progress((done + part) / pictures);
                });
                // The picture without it, which comes first, is finite then: it is not the model that is wrong.
                let of_lora = |e: &anyhow::Error| {
                    pass.lora.is_some() && matches!(e.downcast_ref(), Some(Error::NotFinite { .. }))
                };
                row.push(picture.map_err(|e| match of_lora(&e) {
                    true => self.not_finite(),
                    false => e,
                })?);
                done += 1.0;
            }
            let pairs = row[0].pixels().iter().zip(row[1].pixels());
            let sum: f32 = pairs.map(|(a, b)| (*a - *b).length_squared() / 3.0).sum();
            squares += f64::from(sum) / row[0].pixels().len() as f64;
            rows.push(row);
        }
        write_png(path, &DisplayImage(arranged(&rows)))?;
        Ok((squares / self.prompts.len().max(1) as f64).sqrt())
    }

    fn not_finite(&self) -> anyhow::Error {
        anyhow::anyhow!(
            "cannot use {}: the model's pictures are finite without it and not finite with it; train the LoRA again with a \
             lower learning rate",
            self.of
        )
    }

    fn sample(
        &self,
        model: &Model,
        learned: Option<&LearnedTokens>,
        prompt: &str,
        index: usize,
        pass: &Pass,
        mut progress: impl FnMut(f64),
    ) -> anyhow::Result<Raster<Vec3>> {
        let side = side(model);
        let settings = GenerateSettings {
            solver: Solver::DpmSolver2M,
            steps: self.steps,
            guidance: 5.0,
            size: (side, side),
            seed: 1 + index as u64,
        };
        let generated = generate(model, prompt, &settings, pass, learned, |part| {
            progress(part);
            !interrupt::asked()
        });
        interrupt::check()?;
        Ok(dipir_tensors::model_output(&generated?.image)?.0)
    }
}

/// Pictures of one size in rows, on white, whole pixels enlarged to [`SHORTEST`].
fn arranged(rows: &[Vec<Raster<Vec3>>]) -> Raster<Vec3> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let first = rows.iter().flatten().next();
    let (width, height) = first.map_or((1, 1), |p| (p.width(), p.height()));
    let zoom = SHORTEST.div_ceil(width.min(height)).max(1);
    let cell = [width * zoom + GAP, height * zoom + GAP];
    let (sheet_width, sheet_height) = (columns * cell[0] + GAP, rows.len() * cell[1] + GAP);
    let pixel = |x: usize, y: usize| -> Option<Vec3> {
        let (x, y) = (x.checked_sub(GAP)?, y.checked_sub(GAP)?);
        let picture = rows.get(y / cell[1])?.get(x / cell[0])?;
        let (x, y) = (x % cell[0] / zoom, y % cell[1] / zoom);
        (x < width && y < height).then(|| picture.row(y)[x])
    };
    let pixels = (0..sheet_width * sheet_height)
        .map(|i| pixel(i % sheet_width, i / sheet_width).unwrap_or(Vec3::ONE));
    Raster::from_pixels(sheet_width, sheet_height, pixels.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_in_rows_with_white_between_and_small_ones_are_enlarged() {
        let one = |v: f32| Raster::filled(64, 32, Vec3::splat(v));
        let sheet = arranged(&[vec![one(0.1), one(0.2)], vec![one(0.3), one(0.4)]]);
        // 32 pixels are enlarged to 128, so that a cell is 256 x 128 and a gap.
        assert_eq!((sheet.width(), sheet.height()), (2 * 264 + 8, 2 * 136 + 8));
        let at = |x: usize, y: usize| sheet.row(y)[x].x;
        assert_eq!([at(0, 0), at(8, 8), at(263, 135)], [1.0, 0.1, 0.1]);
        assert_eq!(
            [at(264, 8), at(272, 8), at(8, 144), at(272, 144)],
            [1.0, 0.2, 0.3, 0.4]
        );
    }
}
