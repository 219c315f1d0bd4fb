//! Images: size, channels, ranges, and how many values are not numbers.
use std::path::Path;

use anyhow::Context;
use dipir_cli::output::json_path;
use dipir_imaging::file::read_photo;
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::Raster;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use serde_json::{Value, json};

use crate::Kind;
use crate::command_line::ViewArgs;
use crate::range::Range;
use crate::report::{Report, Table, number};
use crate::view;

/// One channel of an image as it is shown.
struct Shown<'a> {
    name: String,
    stored: &'static str,
    values: &'a Raster<f32>,
}

pub(crate) fn inspect(path: &Path, kind: Kind, view: &ViewArgs) -> anyhow::Result<Report> {
    let layers = match kind {
        Kind::Exr => Layers::read_exr(path)?,
        _ => layers_of_photo(path)?,
    };
    let (format, stored) = match kind {
        Kind::Png => ("PNG", Some("display")),
        Kind::Jpeg => ("JPEG", Some("display")),
        Kind::Hdr => ("Radiance HDR", Some("rgbe")),
        _ => ("OpenEXR", None),
    };
    let map = environment(path, &layers, kind);
    let mut shown: Vec<Shown> = layers
        .channels()
        .map(|(name, channel)| Shown {
            name: name.into(),
            stored: stored.unwrap_or(match channel.precision {
                Precision::Half => "f16",
                Precision::Full => "f32",
            }),
            values: &channel.samples,
        })
        .collect();
    shown.sort_by_key(|channel| usual_order(&channel.name));
    if let Some(png) = &view.png {
        let displayed = display_referred(kind);
        let map = map.as_ref().and_then(|map| map.as_ref().ok());
        view::write(png, view, &layers, map, displayed)
            .with_context(|| format!("cannot show {}", path.display()))?;
    }
    Ok(report(path, format, &layers, &shown, map.as_ref()))
}

/// Layers by name, the beauty first, and in them red before green before blue.
fn usual_order(name: &str) -> (String, usize) {
    let (layer, suffix) = name.rsplit_once('.').unwrap_or(("", name));
    let rank = "RGBAXYZ".find(suffix).unwrap_or(usize::MAX);
    (layer.into(), rank)
}

fn display_referred(kind: Kind) -> bool {
    matches!(kind, Kind::Png | Kind::Jpeg)
}

fn layers_of_photo(path: &Path) -> anyhow::Result<Layers> {
    // `Linear` leaves the stored values as they are.
    let photo = read_photo(path, Transfer::Linear)?;
    let image = &photo.image.0;
    let mut layers = Layers::new(image.width(), image.height());
    layers.insert_rgb("", Precision::Full, image)?;
    if let Some(alpha) = photo.alpha {
        layers.insert("A", Precision::Full, alpha)?;
    }
    Ok(layers)
}

/// The image as an environment map, as a run reads it, if it is meant for one: marked as latitude-longitude, or an HDR file
/// twice as wide as high. An error says why it cannot be one.
fn environment(path: &Path, layers: &Layers, kind: Kind) -> Option<anyhow::Result<EnvironmentMap>> {
    let panorama = kind == Kind::Hdr && layers.width() == 2 * layers.height();
    let is_meant = layers.latlong || panorama;
    is_meant.then(|| Ok(EnvironmentMap::read(path)?))
}

fn report(
    path: &Path,
    format: &str,
    layers: &Layers,
    shown: &[Shown],
    map: Option<&anyhow::Result<EnvironmentMap>>,
) -> Report {
    let (width, height) = (layers.width(), layers.height());
    let mut table = Table::new(&["channel", "stored", ">min", ">mean", ">max", ""]);
    let mut channels = serde_json::Map::new();
    for channel in shown {
        let range = Range::of(channel.values.pixels().iter().map(|&v| v.into()));
        table.row(
            [channel.name.clone(), channel.stored.into()]
                .into_iter()
                .chain(range.cells()),
        );
        let mut entry = range.to_json();
        entry["stored"] = channel.stored.into();
        channels.insert(channel.name.clone(), entry);
    }
    let mut text = table.render();
    let attributes: serde_json::Map<String, Value> = layers
        .attributes()
        .map(|(name, value)| (name.to_string(), value.into()))
        .collect();
    for (name, value) in layers.attributes() {
        text.push_str(&format!("  {name}: {value}\n"));
    }
    let mut json = json!({
        "path": json_path(path), "kind": "image", "format": format, "width": width, "height": height,
        "latlong": layers.latlong, "channels": channels, "attributes": attributes,
    });
    if let Some(Err(e)) = map {
        let why = format!("{e:#}");
        text.push_str(&format!("  no environment map: {why}\n"));
        json["no_environment"] = why.into();
    }
    if let Some(Ok(map)) = map {
        let (direction, radiance) = map.peak();
        let light = map.integral();
        text.push_str(&format!(
            "  environment map: brightest towards ({}), radiance ({}); all light ({}) per steradian\n",
            triple(direction.as_dvec3()),
            triple(radiance.as_dvec3()),
            triple(light / (4.0 * std::f64::consts::PI)),
        ));
        json["environment"] = json!({
            "peak_direction": direction, "peak_radiance": radiance,
            "mean_radiance": (light / (4.0 * std::f64::consts::PI)).as_vec3(),
        });
    }
    let latlong = if layers.latlong {
        ", latitude-longitude environment map"
    } else {
        ""
    };
    Report {
        title: format!(
            "{}: {format}, {width} x {height} pixels{latlong}",
            path.display()
        ),
        text,
        json,
        problems: Vec::new(),
    }
}

fn triple(v: glam::DVec3) -> String {
    format!("{}, {}, {}", number(v.x), number(v.y), number(v.z))
}
