//! What planning saves: eleven kinds of scene rendered to one error, once with everything that the scene can show and once
//! with what shows, as a table in Markdown. Both are compared with one reference.
//! `cargo bench -p dipir-render --bench effects -- [size=WIDTHxHEIGHT] [target=RMSE] [repeats=N] [NAME]`
//! Times are processor seconds, the least of the repeats.
mod gallery;

use std::ops::ControlFlow;

use dipir_imaging::composite::composite_pixel;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentSampler;
use dipir_render::adaptive::Stop;
use dipir_render::contribution::LeaveOut;
use dipir_render::effects::EffectsPlan;
use dipir_render::film::Film;
use dipir_render::render::{Rendered, Renderer, Settings};
use dipir_scene::config::EffectsConfig;
use glam::Vec3;

/// Processor seconds of this process so far, in steps of 10 ms; 0 where the system does not tell.
fn processor_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields = text.rsplit(')').next().unwrap_or_default();
    let ticks = fields.split_whitespace().skip(11).take(2);
    ticks.filter_map(|t| t.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Renders, and takes the time in processor seconds.
fn render(
    renderer: &Renderer,
    light: &EnvironmentSampler,
    plan: &EffectsPlan,
    (target, seed): (f32, u64),
    leave_out: Option<LeaveOut>,
) -> (f64, Rendered) {
    let settings = Settings {
        stop: Stop::TargetError(target),
        max_samples: 1 << 18,
        seed,
        leave_out,
        ..Settings::default()
    };
    let start = processor_seconds();
    let rendered = renderer
        .render(light, &plan.simulation(), &settings, &mut |_| {
            ControlFlow::Continue(())
        })
        .expect("renders");
    (processor_seconds() - start, rendered)
}

/// Display-referred RMSE over the pixels that object or shadow touch in `reference`.
fn difference(found: &Film, reference: &Film) -> f64 {
    let shown = |film: &Film, k: usize| {
        let (object, alpha) = (film.object.pixels()[k], film.alpha.pixels()[k]);
        let linear = composite_pixel(Vec3::splat(0.18), object, alpha, film.shadow.pixels()[k]);
        let encode = |v: f32| Transfer::Srgb.encode_scalar(v.max(0.0)).clamp(0.0, 1.0);
        Vec3::from(linear.to_array().map(encode))
    };
    let bare = Vec3::splat(Transfer::Srgb.encode_scalar(0.18));
    let (mut sum, mut count) = (0.0, 0.0);
    for k in 0..reference.alpha.pixels().len() {
        let (a, b) = (shown(found, k), shown(reference, k));
        if reference.alpha.pixels()[k] > 0.0 || (b - bare).abs().max_element() > 0.5 / 255.0 {
            sum += f64::from((a - b).length_squared()) / 3.0;
            count += 1.0;
        }
    }
    (sum / f64::max(count, 1.0)).sqrt()
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |key: &str| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        pairs.rfind(|(k, _)| *k == key).map(|(_, v)| v.to_owned())
    };
    let whole = arguments.iter().any(|a| a == "--bench");
    let size = value("size").unwrap_or(if whole { "256x256" } else { "16x16" }.into());
    let size: Vec<u32> = size
        .split('x')
        .map(|n| n.parse().expect("a size"))
        .collect();
    let target = value("target").map_or(0.004, |v| v.parse().expect("a number"));
    let target = if whole { target } else { 0.05 };
    let repeats: u64 = value("repeats").map_or(3, |v| v.parse().expect("a number"));
    let name = arguments
        .iter()
        .find(|a| !a.contains('=') && !a.starts_with("--"));
    let light = gallery::sky();
    println!(
        "| scene | D | left out, RMSE | 95% bound | everything, CPU s | what shows, CPU s | saved | rays saved | true error: everything | what shows |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let scenes = gallery::scenes(size[0]).into_iter();
    let scenes = scenes.chain([gallery::black(size[0])]);
    let scenes = scenes.filter(|(n, _)| name.is_none_or(|name| n.contains(name.as_str())));
    for (name, mut scene) in scenes.take(if whole { usize::MAX } else { 1 }) {
        scene.camera.resolution[1] = size[1];
        scene.camera.principal_px.y = size[1] as f32 / 2.0;
        let config = EffectsConfig::default();
        let renderer = Renderer::new(&scene);
        let everything = EffectsPlan::everything(&scene, &Settings::default());
        let possible = EffectsPlan::new(&renderer, &config, &Settings::default());
        let leave_out = possible.leave_out(&config);
        let (_, reference) = render(
            &renderer,
            &light,
            &everything,
            (target / 4.0, 1 << 40),
            None,
        );
        let (mut times, mut errors, mut rays) = ([f64::INFINITY; 2], [0f64; 2], [0; 2]);
        let mut shown = possible.clone();
        for seed in 0..repeats {
            let (all_s, all) = render(&renderer, &light, &everything, (target, seed), None);
            let (few_s, few) = render(&renderer, &light, &possible, (target, seed), leave_out);
            times = [times[0].min(all_s), times[1].min(few_s)];
            for (k, rendered) in [&all, &few].into_iter().enumerate() {
                errors[k] += difference(&rendered.film, &reference.film).powi(2) / repeats as f64;
                rays[k] += rendered.counts.total();
            }
            shown = possible.rendered(&few);
        }
        println!(
            "| {name} | {} | {:.5} | {:.5} | {:.2} | {:.2} | {:.0}% | {:.0}% | {:.5} | {:.5} |",
            shown.simulation().max_depth,
            shown.left_out.unwrap_or(0.0),
            shown.left_out_upper_95.unwrap_or(0.0),
            times[0],
            times[1],
            100.0 * (1.0 - times[1] / times[0]),
            100.0 * (1.0 - rays[1] as f64 / rays[0] as f64),
            errors[0].sqrt(),
            errors[1].sqrt(),
        );
    }
}
