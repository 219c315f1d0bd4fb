//! `--png`: a picture of one layer that any viewer shows.
use std::fs;
use std::path::Path;

use anyhow::Context;
use dipir_cli::exit::{Usage, check_png, printable};
use dipir_imaging::layers::Layers;
use dipir_imaging::marked_png::{Kind, write_display};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_stages::preview;
use glam::Vec3;

use crate::command_line::ViewArgs;

impl ViewArgs {
    /// Refuses `--png` for what has no picture.
    pub fn refuse(&self, what: &str) -> Result<(), Usage> {
        match self.png {
            Some(_) => Err(Usage(format!("--png shows images, this is {what}"))),
            None => Ok(()),
        }
    }

    /// Refuses an exposure that no picture has, and a picture that is named as another format or in place of the file `path`
    /// that it shows.
    pub fn check(&self, path: &Path) -> Result<(), Usage> {
        if let Some(stops) = self.exposure_ev
            && !(-64.0..=64.0).contains(&stops)
        {
            return Err(Usage(format!("--exposure-ev {stops}: accepted: -64 to 64")));
        }
        if let Some(png) = &self.png {
            check_png(png, "the picture", "picture.png")?;
        }
        let in_full = |path: &Path| fs::canonicalize(path).ok();
        match &self.png {
            Some(png) if in_full(png).is_some_and(|png| Some(png) == in_full(path)) => {
                Err(Usage(printable(&format!(
                    "--png {}: that is the file which is shown; name another file",
                    png.display()
                ))))
            }
            _ => Ok(()),
        }
    }
}

/// Writes the picture. `displayed`: the values are display-referred already.
pub fn write(
    png: &Path,
    args: &ViewArgs,
    layers: &Layers,
    map: Option<&EnvironmentMap>,
    displayed: bool,
) -> anyhow::Result<()> {
    let name = args.layer.as_deref().unwrap_or("");
    let gain = args.exposure_ev.unwrap_or(0.0).exp2();
    let picture = if layers.contains(&channel(name, "R")) {
        let rgb = finite(layers.rgb(name)?);
        match map {
            Some(map) if name.is_empty() => environment(map, gain),
            _ if displayed => DisplayImage(rgb.map(|v| *v * gain)),
            _ => Transfer::Srgb.encode(&LinearImage(rgb.map(|v| *v * gain))),
        }
    } else if layers.contains(&channel(name, "X")) {
        preview::normals(&finite(layers.xyz(name)?))
    } else {
        let single = [channel(name, "Z"), channel(name, "A"), name.to_string()]
            .into_iter()
            .find(|c| layers.contains(c))
            .unwrap_or_else(|| channel(name, "R"));
        preview::stretched(layers.channel(&single)?)
    };
    write_display(png, &picture, Kind::View)
        .with_context(|| format!("cannot write {}", png.display()))
}

fn channel(layer: &str, suffix: &str) -> String {
    match layer {
        "" => suffix.into(),
        layer => format!("{layer}.{suffix}"),
    }
}

/// Colour of NaN and infinity: magenta, which is seen at once and which light seldom has.
fn finite(raster: Raster<Vec3>) -> Raster<Vec3> {
    raster.map(|v| {
        if v.is_finite() {
            *v
        } else {
            Vec3::new(1.0, 0.0, 1.0)
        }
    })
}

/// The map as it is shown, its peak ringed.
fn environment(map: &EnvironmentMap, gain: f32) -> DisplayImage {
    let mut shown = preview::environment(map, gain);
    let (row, column) = map.texel_of(map.peak().0);
    ring(&mut shown.0, column, row);
    shown
}

/// A red ring around a texel; it continues across the map's left and right edge.
fn ring(image: &mut Raster<Vec3>, column: usize, row: usize) {
    let (width, height) = (image.width() as i64, image.height() as i64);
    let radius = (height as f32 / 24.0).max(3.0);
    let thickness = (radius / 6.0).max(1.0);
    let reach = (radius + thickness).ceil() as i64;
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let distance = ((dx * dx + dy * dy) as f32).sqrt();
            let y = row as i64 + dy;
            if (distance - radius).abs() <= thickness * 0.5 && (0..height).contains(&y) {
                let x = (column as i64 + dx).rem_euclid(width);
                *image.get_mut(x as usize, y as usize) = Vec3::new(1.0, 0.1, 0.1);
            }
        }
    }
}
