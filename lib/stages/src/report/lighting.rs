//! The light with its lobes, the tone curves, and how both were found.
use std::path::PathBuf;

use dipir_estimator::LightEstimate;
use dipir_imaging::file::read_photo;
use dipir_imaging::spline::Knots;
use dipir_imaging::tone::ToneCurves;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::{EnvironmentMap, texel_of};
use dipir_light::gaussian::SphericalGaussian;
use dipir_light::luminance::luminance_f64;
use dipir_optimize::lighting::Lighting;
use dipir_pipeline::manifest::{Artifact, Manifest};
use dipir_plotting::chart::{Chart, Mark, Series};
use dipir_plotting::number;
use glam::Vec3;
use serde_json::Value;

use super::curves::{column, noisy, over};
use super::html::{Html, table};
use super::picture::{figure, image};
use super::{Report, Section, direction, json, outputs};
use crate::composite::table::CompositeTable;
use crate::known_light;
use crate::light::{percent, quantities};
use crate::names::LIGHT;
use crate::preview::environment;
use crate::scene::unnumbered;

/// Columns of the map as it is shown.
const MAP_WIDTH: usize = 512;
/// Lobes in the table, and drawn: the strongest.
const MOST_LOBES: usize = 12;
/// Longest side of the sheet of candidates.
const SHEET: usize = 768;
/// Longest side of a preview.
const PREVIEW: usize = 256;

/// The light that was recovered, else the one that was given.
pub fn section(report: &Report) -> Section {
    let Some(run) = report.stage(LIGHT.name)? else {
        return given(report);
    };
    if !run.1.outputs.iter().any(|o| o.role == "lighting") {
        return materials(&run);
    }
    let lighting = Lighting::read(&run.1.output(&run.0, "lighting")?)?;
    let curves = ToneCurves::read_json(run.1.output(&run.0, "tone")?)?;
    let has = |role: &str| run.1.outputs.iter().any(|o| o.role == role);
    let history: Vec<Value> = match has("history") {
        true => json(&run, "history")?,
        false => vec![],
    };
    let environment = EnvironmentMap::read(run.1.output(&run.0, "environment")?)?;
    // Where the surroundings are a map, the lobes that belong to the light are its sources.
    let mut own = lighting.exposed_lobes();
    if has("surroundings") {
        own.truncate(lighting.sources);
    }
    let own = strongest(&own);
    let truth = report.truth.and_then(|t| t.peak);
    let estimated: Option<LightEstimate> = match has("estimate") {
        true => Some(json(&run, "estimate")?),
        false => None,
    };
    // The source of a candidate, or one that is known, else the estimate's most probable direction.
    let source = own.first().map(|(lobe, _)| lobe.direction);
    let towards = match &estimated {
        Some(e) if !has("surroundings") => Some(e.mode()),
        Some(e) => source.or(Some(e.mode())),
        None => source,
    };
    let mut parts = vec![];
    if let Some(towards) = towards {
        parts.extend(direction::figure(
            report,
            towards,
            estimated.as_ref(),
            truth,
        )?);
    }
    if let Some(estimated) = &estimated {
        parts.push(estimate(&run, estimated)?);
    }
    parts.push(map(
        &environment.resampled(MAP_WIDTH, MAP_WIDTH / 2),
        &own,
        truth,
        "The recovered light: latitude and longitude, +z in the middle, +x to its left",
    )?);
    if !own.is_empty() {
        parts.push(lobes(&own));
    }
    let plots: Vec<_> = [tone(&curves)]
        .into_iter()
        .chain(losses(&history))
        .collect();
    let plots = plots.iter().filter_map(|(t, c)| Html::chart(t, c));
    parts.push(Html::element("div", &[("class", "plots")], plots));
    let mut previews = Vec::new();
    for (name, path) in outputs(&run, "preview") {
        let shown = Transfer::Srgb.encode(&read_photo(path, Transfer::Srgb)?.image);
        let iteration = name.trim_start_matches('0');
        let caption = format!(
            "iteration {}",
            if iteration.is_empty() { "0" } else { iteration }
        );
        previews.push(figure(&shown, PREVIEW, &caption)?);
    }
    parts.push(Html::element("div", &[("class", "grid-of")], previews));
    Ok(Some(Html::all(parts)))
}

/// What was estimated from the photograph, with how sure it is, and the lights to choose among.
fn estimate(run: &(PathBuf, Manifest), estimate: &LightEstimate) -> anyhow::Result<Html> {
    let is_view = |input: &&Artifact| unnumbered(&input.role) == "view";
    let photographs = match run.1.inputs.iter().filter(is_view).count() {
        0 => "the photograph".to_string(),
        others => format!("{} photographs of the place", others + 1),
    };
    let sentence = format!(
        "Estimated from {photographs}: most light {}; a sun with a probability of {}. In four of five photographs the \
         truth lies in these intervals:",
        estimate.words,
        percent(estimate.sun_probability)
    );
    let mut parts = vec![Html::of("p", sentence)];
    let rows = quantities(estimate).map(|q| {
        let cells = [q.middle, q.interval, q.words].map(Html::text);
        std::iter::once(Html::text(q.name)).chain(cells).collect()
    });
    let heads = [
        "80% intervals",
        ">median",
        ">interval",
        "the interval in words",
    ];
    parts.push(table(&heads, rows.into()));
    let how = [
        Html::text("Lights that are possible; "),
        Html::of("code", "dipir run"),
        Html::text(" with an option of these uses one:"),
    ];
    parts.push(Html::element("p", &[], how));
    let candidates: Vec<Value> = json(run, "candidates")?;
    let used = run.1.params["estimate"]["candidate"].as_u64();
    let rows = candidates.iter().map(|c| {
        let chance = c["probability"].as_f64().unwrap_or(0.0);
        let used = c["candidate"].as_u64() == used;
        vec![
            Html::text(c["candidate"].to_string()),
            Html::text(percent(chance)),
            Html::text(c["words"].as_str().unwrap_or_default()),
            match used {
                true => Html::text("used"),
                false => Html::of("code", format!("--set light.candidate={}", c["candidate"])),
            },
        ]
    });
    let heads = [">candidate", ">probability", "light", "to use it"];
    parts.push(table(&heads, rows.collect()));
    for (_, path) in outputs(run, "candidates_sheet") {
        let shown = Transfer::Srgb.encode(&read_photo(path, Transfer::Srgb)?.image);
        let caption = "The candidates by number, row by row; bars are their probabilities";
        let sheet = [figure(&shown, SHEET, caption)?];
        parts.push(Html::element("div", &[("class", "sheet")], sheet));
    }
    Ok(Html::all(parts))
}

/// The map of `[composite] environment`.
fn given(report: &Report) -> Section {
    let table = report.session.config.table("composite")?;
    let table: CompositeTable = table;
    let Some(known) = known_light::known(report.session, &table)? else {
        return Ok(None);
    };
    let shown = known.map.resampled(MAP_WIDTH, MAP_WIDTH / 2);
    Ok(Some(map(&shown, &[], None, "The light that was given")?))
}

/// What was recovered of materials.
fn materials(run: &(PathBuf, Manifest)) -> Section {
    let found: Vec<Value> = json(run, "materials")?;
    let rows = found.iter().map(|m| {
        let text = |key: &str| match &m[key] {
            Value::String(text) => text.clone(),
            Value::Array(items) => {
                let items = items.iter().filter_map(Value::as_f64).map(number);
                items.collect::<Vec<_>>().join(" ")
            }
            other => other.as_f64().map_or_else(String::new, number),
        };
        let keys = [
            "name",
            "base_color",
            "metallic",
            "roughness",
            "emissive_strength",
        ];
        keys.map(|key| Html::text(text(key))).into()
    });
    let heads = [
        "material",
        "base colour",
        ">metallic",
        ">roughness",
        ">emission",
    ];
    let losses: Vec<f64> = json(run, "history")?;
    let points = losses.iter().enumerate();
    let series = Series::line("", 0, points.map(|(k, &l)| (k as f64, l)));
    let chart = over("iteration", true, vec![series]);
    let plot = Html::chart("Loss of the materials", &chart);
    Ok(Some(Html::all(
        [table(&heads, rows.collect())].into_iter().chain(plot),
    )))
}

/// The strongest lobes by the light that they send, with their share of all of it.
fn strongest(lobes: &[SphericalGaussian]) -> Vec<(SphericalGaussian, f64)> {
    let energy = |l: &SphericalGaussian| luminance_f64(l.integral());
    let total: f64 = lobes.iter().map(energy).sum();
    let mut sorted: Vec<_> = lobes
        .iter()
        .map(|l| (*l, energy(l) / total.max(f64::MIN_POSITIVE)))
        .collect();
    sorted.sort_by(|a, b| b.1.total_cmp(&a.1));
    sorted.truncate(MOST_LOBES);
    sorted
}

/// Degrees above the horizon, and counter-clockwise from +z seen from above.
fn angles_deg(direction: Vec3) -> [f32; 2] {
    let elevation = direction.y.clamp(-1.0, 1.0).asin();
    [elevation, direction.x.atan2(direction.z)].map(f32::to_degrees)
}

/// Angle from a lobe's axis at which it has half its radiance, degrees.
fn half_width_deg(lobe: &SphericalGaussian) -> f64 {
    let sigma = f64::from(lobe.sigma);
    let cos = 1.0 - sigma * sigma * std::f64::consts::LN_2;
    cos.max(-1.0).acos().to_degrees()
}

/// The map with the lobes' half widths drawn over it, and the true peak.
fn map(
    map: &EnvironmentMap,
    lobes: &[(SphericalGaussian, f64)],
    truth: Option<Vec3>,
    caption: &str,
) -> anyhow::Result<Html> {
    let around = |direction: Vec3, radius_deg: f64, class: &str, opacity: f64| {
        // Fine enough for a place in degrees to a tenth.
        let (row, column) = texel_of(direction, 3600, 1800);
        let wide = radius_deg / f64::from(direction.y.clamp(-0.999, 0.999).acos().sin());
        let values = [
            f64::from(column as u32) / 10.0,
            f64::from(row as u32) / 10.0,
            wide.min(360.0),
            radius_deg,
            opacity,
        ]
        .map(|v| format!("{v:.2}"));
        let names = ["cx", "cy", "rx", "ry", "opacity"];
        let mut attributes = vec![("class", class)];
        attributes.extend(names.into_iter().zip(values.iter().map(String::as_str)));
        Html::element("ellipse", &attributes, [])
    };
    let drawn = lobes
        .iter()
        .filter(|(lobe, _)| half_width_deg(lobe) < 60.0)
        .map(|(lobe, share)| {
            let radius = half_width_deg(lobe).max(1.0);
            around(
                lobe.direction,
                radius,
                "lobe",
                (0.25 + share.sqrt()).min(1.0),
            )
        });
    let drawn = drawn.chain(truth.map(|peak| around(peak, 4.0, "truth", 1.0)));
    let overlay = [
        ("viewBox", "0 0 360 180"),
        ("preserveAspectRatio", "none"),
        ("aria-hidden", "true"),
    ];
    let shown = [
        image(&environment(map, 1.0), MAP_WIDTH, caption)?,
        Html::element("svg", &overlay, drawn),
    ];
    let legend = match (lobes.is_empty(), truth) {
        (true, _) => String::new(),
        (false, None) => "; rings: the strongest lobes at half their radiance".into(),
        (false, Some(_)) => {
            "; rings: the strongest lobes at half their radiance; dashed: the true peak".into()
        }
    };
    Ok(Html::element(
        "figure",
        &[],
        [
            Html::of("figcaption", format!("{caption}{legend}")),
            Html::element("div", &[("class", "map")], shown),
        ],
    ))
}

fn lobes(lobes: &[(SphericalGaussian, f64)]) -> Html {
    let rows = lobes.iter().enumerate().map(|(k, (lobe, share))| {
        let [elevation, azimuth] = angles_deg(lobe.direction);
        let radiance = lobe.radiance.to_array().map(|v| number(v.into())).join(" ");
        let cells = [
            (k + 1).to_string(),
            format!("{elevation:.1}°"),
            format!("{azimuth:.1}°"),
            format!("{:.1}°", half_width_deg(lobe)),
            radiance,
            format!("{:.1}%", 100.0 * share),
        ];
        cells.map(Html::text).into()
    });
    let heads = [
        "lobe",
        ">above the horizon",
        ">from +z towards +x",
        ">half width",
        ">radiance",
        ">share of all light",
    ];
    table(&heads, rows.collect())
}

fn tone(curves: &ToneCurves) -> (&'static str, Chart) {
    let line = |name, color, knots: &Knots| {
        let curve = knots.curve();
        let inputs = (0..=64).map(|k| f64::from(k) / 64.0);
        Series::line(name, color, inputs.map(|x| (x, curve.eval(x))))
    };
    let [red, green, blue] = &curves.shadow;
    let series = vec![
        line("shadow, red", 1, red),
        line("shadow, green", 2, green),
        line("shadow, blue", 0, blue),
        line("object", 3, &curves.foreground),
    ];
    let mut chart = over("before", false, series);
    chart.y.range = Some((0.0, 1.0));
    let title = "Tone curves, on [0, 1]: object after x / (1 + x), shadow ratio by channel";
    (title, chart)
}

fn losses(history: &[Value]) -> Vec<(&'static str, Chart)> {
    let column = |key, name, color| column(history, "iteration", key, name, color);
    let noisy = |key| noisy(history, "iteration", key, "", 0).into();
    let over = |title, log_y, series| (title, over("iteration", log_y, series));
    let light = |title, key| over(title, false, vec![column(key, "", 1)]);
    let terms = vec![
        column("consistency", "consistency", 1),
        column("regularizer", "regulariser", 2),
    ];
    let timesteps = Series {
        mark: Mark::Dots,
        ..column("t", "", 3)
    };
    vec![
        over("Guidance", true, noisy("guidance")),
        over("Consistency and regulariser, weighted", true, terms),
        over("Norm of the gradient", true, noisy("gradient_norm")),
        over("Timestep of the diffusion model", false, vec![timesteps]),
        light("Irradiance on a horizontal plane", "irradiance"),
        light(
            "Height of the peak above the horizon, degrees",
            "elevation_deg",
        ),
        light("Azimuth of the peak, degrees", "azimuth_deg"),
    ]
}
