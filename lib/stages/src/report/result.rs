//! The picture, its layers, and how it compares with the true light.
use std::path::PathBuf;

use anyhow::Context;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_plotting::number;
use dipir_scene::description::SceneDescription;
use glam::Vec3;

use super::html::{Html, table};
use super::picture::{figure, image};
use super::{Report, Section};
use crate::names::{COMPOSITE, SCENE};
use crate::preview::{normals, stretched};
use crate::truth::Truth;

/// Longest side of the large pictures: a full screen's width of page.
const LARGE: usize = 1152;
/// Longest side of a layer.
const LAYER: usize = 480;

/// How the photograph is encoded, and so the picture.
fn transfer(report: &Report) -> anyhow::Result<Transfer> {
    let scene = report.stage(SCENE.name)?;
    let (folder, manifest) = scene.context("the scene's folder is missing")?;
    let scene = SceneDescription::read(&manifest.output(&folder, "scene")?)?;
    Ok(scene.background.transfer)
}

/// The layers of the composite, small, and the folder that they lie in.
pub struct Small {
    folder: PathBuf,
    layers: Layers,
}

/// Reads what this page shows of the composite; nothing where there is none.
pub fn small(report: &Report) -> anyhow::Result<Option<Small>> {
    let Some((folder, manifest)) = report.stage(COMPOSITE.name)? else {
        return Ok(None);
    };
    let layers = Layers::read_exr_small(manifest.output(&folder, "layers")?, LARGE)?;
    Ok(Some(Small { folder, layers }))
}

/// The photograph and the picture, one over the other.
pub fn before_and_after(report: &Report, small: &Small) -> Section {
    let layers = &small.layers;
    let transfer = transfer(report)?;
    let after = transfer.encode(&LinearImage(layers.rgb("")?));
    let before = transfer.encode(&LinearImage(layers.rgb("background")?));
    let before = Html::element(
        "div",
        &[("class", "before")],
        [image(&before, LARGE, "the photograph")?],
    );
    let slider = [
        ("type", "range"),
        ("min", "0"),
        ("max", "100"),
        ("value", "15"),
        ("aria-label", "share of the photograph without the object"),
    ];
    let parts = [
        image(&after, LARGE, "the picture with the object")?,
        before,
        Html::element("div", &[("class", "edge")], []),
        Html::element("input", &slider, []),
    ];
    Ok(Some(Html::all([
        Html::element("div", &[("class", "compare")], parts),
        Html::element(
            "p",
            &[("class", "soft")],
            [Html::text(
                "Left of the line the photograph, right of it the picture: drag the line.",
            )],
        ),
    ])))
}

/// The layers that a compositor gets.
pub fn layers(report: &Report, small: &Small) -> Section {
    let Small { folder, layers } = small;
    let transfer = transfer(report)?;
    let shown = |raster: Raster<Vec3>| transfer.encode(&LinearImage(raster));
    let grey = |name: &str| -> anyhow::Result<DisplayImage> {
        Ok(DisplayImage(layers.channel(name)?.map(|&a| Vec3::splat(a))))
    };
    // Depth is infinite where there is nothing; nearer is brighter.
    let nearness = layers.channel("depth.Z")?;
    let nearness = nearness.map(|&z| match z.is_finite() && z > 0.0 {
        true => 1.0 / z,
        false => f32::NAN,
    });
    let figures = [
        figure(
            &shown(layers.rgb("object")?),
            LAYER,
            "object (premultiplied)",
        )?,
        figure(&grey("object.A")?, LAYER, "object.A (coverage)")?,
        figure(
            &DisplayImage(layers.rgb("shadow")?),
            LAYER,
            "shadow (ratio)",
        )?,
        figure(&shown(layers.rgb("albedo")?), LAYER, "albedo")?,
        figure(&normals(&layers.xyz("normal")?), LAYER, "normal")?,
        figure(&stretched(&nearness), LAYER, "depth.Z (nearer is brighter)")?,
    ];
    let formula = Html::all([
        Html::text("All in "),
        Html::of("code", folder.join("composite.exr").display().to_string()),
        Html::text(", linear: "),
        Html::of("code", "background * shadow * (1 - object.A) + object.RGB"),
        Html::text(" rebuilds the picture."),
    ]);
    Ok(Some(Html::all([
        Html::element("div", &[("class", "grid-of")], figures),
        Html::element("p", &[("class", "soft")], [formula]),
    ])))
}

/// How far the recovered light is from the true one.
pub fn truth(truth: &Truth) -> Html {
    let degrees = |angle: Option<f64>| match angle {
        Some(angle) => format!("{angle:.1}°"),
        None => "–".into(),
    };
    let row = |name: &str, angle: String, rmse: f64| {
        vec![
            Html::text(name),
            Html::text(angle),
            Html::text(number(rmse)),
        ]
    };
    let rows = vec![
        row(
            "recovered light",
            degrees(truth.sun_error_deg),
            truth.rmse_recovered,
        ),
        row("neutral light", "–".into(), truth.rmse_neutral),
    ];
    Html::all([
        table(
            &[
                "",
                ">direction of most light is off by",
                ">RMSE of the picture",
            ],
            rows,
        ),
        Html::of("p", capitalised(&truth.in_words())),
        Html::element(
            "p",
            &[("class", "soft")],
            [Html::text(
                "Display-referred RMSE against the picture under the true light, over what the \
                 object or its shadow touches, at the size at which light is optimised.",
            )],
        ),
    ])
}

/// A sentence with a capital.
fn capitalised(sentence: &str) -> String {
    let mut rest = sentence.chars();
    let first = rest.next().map(|c| c.to_ascii_uppercase());
    first.into_iter().chain(rest).collect()
}
