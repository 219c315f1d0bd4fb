//! `--png`: a picture of one layer that any viewer shows.
use std::path::{Path, PathBuf};

use clap::Args;
use dipir_cli::exit::Usage;
use dipir_imaging::file::write_png;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;

/// Options of the picture.
#[derive(Args, Clone, Debug, Default)]
pub struct ViewArgs {
    /// Write a PNG of the image: tone-mapped if it is an environment map, whose brightest
    /// texel gets a ring
    #[arg(long, value_name = "FILE")]
    pub png: Option<PathBuf>,

    /// Layer of an EXR file to show, as in shadow, depth or normal [default: beauty]
    #[arg(long, value_name = "NAME", requires = "png")]
    pub layer: Option<String>,

    /// Stops of exposure on top of the automatic one [default: 0]
    #[arg(
        long,
        value_name = "EV",
        requires = "png",
        allow_negative_numbers = true
    )]
    pub exposure_ev: Option<f32>,
}

impl ViewArgs {
    /// Refuses `--png` for what has no picture.
    pub fn refuse(&self, what: &str) -> Result<(), Usage> {
        match self.png {
            Some(_) => Err(Usage(format!("--png shows images, this is {what}"))),
            None => Ok(()),
        }
    }
}

/// Luminance to which the log-average of an environment map is exposed: photographic mid-grey.
const MID_GREY: f32 = 0.18;

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
            Some(map) if name.is_empty() => environment(&rgb, map, gain),
            _ if displayed => DisplayImage(rgb.map(|v| *v * gain)),
            _ => Transfer::Srgb.encode(&LinearImage(rgb.map(|v| *v * gain))),
        }
    } else if layers.contains(&channel(name, "X")) {
        // Unit vectors, in the usual colours of normal maps.
        DisplayImage(finite(layers.xyz(name)?).map(|n| (*n + 1.0) * 0.5))
    } else {
        let single = [channel(name, "Z"), channel(name, "A"), name.to_string()]
            .into_iter()
            .find(|c| layers.contains(c))
            .unwrap_or_else(|| channel(name, "R"));
        DisplayImage(stretched(layers.channel(&single)?))
    };
    Ok(write_png(png, &picture)?)
}

fn channel(layer: &str, suffix: &str) -> String {
    match layer {
        "" => suffix.into(),
        layer => format!("{layer}.{suffix}"),
    }
}

/// NaN and infinity as magenta: seen at once, and no light of that colour is likely.
fn finite(raster: Raster<Vec3>) -> Raster<Vec3> {
    raster.map(|v| {
        if v.is_finite() {
            *v
        } else {
            Vec3::new(1.0, 0.0, 1.0)
        }
    })
}

/// A scalar from least (black) to largest (white); what is not finite is black.
fn stretched(raster: &Raster<f32>) -> Raster<Vec3> {
    let finite = || raster.pixels().iter().copied().filter(|v| v.is_finite());
    let low = finite().fold(f32::INFINITY, f32::min);
    let high = finite().fold(f32::NEG_INFINITY, f32::max);
    let scale = if high > low { 1.0 / (high - low) } else { 0.0 };
    raster.map(|v| match v.is_finite() {
        true => Vec3::splat((v - low) * scale),
        false => Vec3::ZERO,
    })
}

/// Exposed for its log-average, compressed by `x / (1 + x)` on luminance, its peak ringed.
fn environment(rgb: &Raster<Vec3>, map: &EnvironmentMap, gain: f32) -> DisplayImage {
    let luminance = map.luminance();
    // Texels are weighted by their solid angle; black ones say nothing of exposure.
    let (mut log_sum, mut weight) = (0.0, 0.0);
    for (k, &l) in luminance.iter().enumerate().filter(|(_, l)| **l > 0.0) {
        let w = map.solid_angle(k / map.width());
        log_sum += w * f64::from(l).ln();
        weight += w;
    }
    let average = if weight > 0.0 {
        (log_sum / weight).exp() as f32
    } else {
        1.0
    };
    let exposure = gain * MID_GREY / average;
    let mut k = 0;
    let mapped = rgb.map(|v| {
        let l = luminance[k] * exposure;
        k += 1;
        *v * exposure / (1.0 + l)
    });
    let mut shown = Transfer::Srgb.encode(&LinearImage(mapped));
    let (row, column) = map.texel_of(map.peak().0);
    ring(&mut shown.0, column, row);
    shown
}

/// A red ring around a texel, across the seam where need be.
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
