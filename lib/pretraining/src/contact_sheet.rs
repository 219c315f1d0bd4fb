//! Contact sheets: many small pictures in one PNG.

use std::ops::ControlFlow;
use std::path::Path;

use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_tensors::model_output;
use glam::Vec3;

use crate::error::{Error, Result};

/// Factor by which pictures are enlarged.
const ENLARGEMENT: usize = 3;
/// Objects of the columns of a sheet of light captions.
const OBJECTS: [&str; 4] = ["red car", "white ball", "yellow box", "blue cone"];
/// Columns for each object, of different noise.
const REPEATS: usize = 2;
/// Lights of its rows.
const LIGHTS: [&str; 6] = [
    "sun at three, low, clear",
    "sun at six, middle, clear",
    "sun at nine, low, clear",
    "sun at twelve, middle, clear",
    "sun at three, high, hazy",
    "overcast",
];

/// Checks that a picture can be written to `png`, before it is computed for minutes.
pub fn check_path(png: &Path) -> Result<()> {
    let folder = png.parent().filter(|f| !f.as_os_str().is_empty());
    let fail = |why: String| {
        let png = png.display();
        Err(Error::Argument(format!("cannot write {png}: {why}")))
    };
    match folder {
        Some(folder) if !folder.is_dir() => fail(format!(
            "there is no folder {}; create it first",
            folder.display()
        )),
        _ if png.is_dir() => fail("it is a folder".into()),
        _ => Ok(()),
    }
}

/// Writes pictures of one size, with display values, side by side.
pub fn write(png: &Path, pictures: &[Raster<Vec3>], columns: usize) -> Result<()> {
    let (width, height) = pictures.first().map_or((1, 1), |p| (p.width(), p.height()));
    let pixel = |x: usize, y: usize| {
        let picture = pictures.get(y / height * columns + x / width);
        picture.map_or(Vec3::ZERO, |p| *p.get(x % width, y % height))
    };
    let rows = pictures.len().div_ceil(columns);
    let (width, height) = (ENLARGEMENT * columns * width, ENLARGEMENT * rows * height);
    let pixels =
        (0..width * height).map(|i| pixel(i % width / ENLARGEMENT, i / width / ENLARGEMENT));
    let sheet = Raster::from_pixels(width, height, pixels.collect());
    write_png(png, &DisplayImage(sheet))?;
    Ok(())
}

/// Samples pictures under captions of light and writes a sheet: a row for every light, and in each column the same object
/// and noise. `progress` is called with the share that is done, also during the sampling of a picture, and may stop it;
/// then nothing is written and the result is false.
pub fn sample_lights(
    model: &Model,
    png: &Path,
    progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
) -> Result<bool> {
    let side = model.native_size();
    let columns = OBJECTS.len() * REPEATS;
    let count = columns * LIGHTS.len();
    let mut pictures = vec![];
    for index in 0..count {
        let done = index as f64 / count as f64;
        let (light, column) = (LIGHTS[index / columns], index % columns);
        if progress(done).is_break() {
            return Ok(false);
        }
        let prompt = format!("a photo of a {}, {light}", OBJECTS[column / REPEATS]);
        let settings = GenerateSettings {
            solver: Solver::DpmSolver2M,
            steps: 30,
            guidance: 4.0,
            size: (side, side),
            seed: column as u64,
        };
        let mut goes_on = true;
        let made = generate(model, &prompt, &settings, &Pass::default(), None, |_| {
            goes_on = progress(done).is_continue();
            goes_on
        });
        if !goes_on {
            return Ok(false);
        }
        pictures.push(model_output(&made?.image)?.0);
    }
    write(png, &pictures, columns)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_imaging::file::read_photo;
    use dipir_imaging::transfer::Transfer;

    #[test]
    fn pictures_lie_side_by_side_and_enlarged() {
        let folder = tempfile::tempdir().unwrap();
        let png = folder.path().join("sheet.png");
        let grey = |k: usize| Raster::filled(2, 2, Vec3::splat(k as f32 * 0.5));
        write(&png, &[0, 1, 2].map(grey), 2).unwrap();
        let sheet = read_photo(&png, Transfer::Linear).unwrap().image.0;
        assert_eq!((sheet.width(), sheet.height()), (12, 12));
        let red = |x: usize, y: usize| sheet.get(x, y).x;
        // PNGs have steps of 1 / 255.
        assert!((red(6, 0) - 0.5).abs() < 1.0 / 255.0, "{}", red(6, 0));
        assert_eq!((red(5, 5), red(5, 6)), (0.0, 1.0));
        // The last row has one picture.
        assert_eq!(red(6, 6), 0.0);
    }

    #[test]
    fn a_path_that_cannot_be_written_is_refused_with_a_remedy() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_path(&folder.path().join("sheet.png")).is_ok());
        let error = |path: &Path| check_path(path).unwrap_err().to_string();
        assert!(error(folder.path()).ends_with("it is a folder"));
        assert!(error(&folder.path().join("none/sheet.png")).contains("create it first"));
    }
}
