//! Whether the error that a render states is its error, whether a target is met, and whether a time
//! budget is kept, as tables in Markdown.
//!
//! Twelve kinds of scene, five seeds each unless `seeds` says another number. The true error of a render is its
//! display-referred RMSE from a reference with a tenth of the target's error, less the reference's own.
//!
//! Run with `cargo test -p dipir-render --bench calibration -- --bench [target=RMSE] [size=PIXELS]
//! [seeds=N] [samples=N] [highlights=0] [denoise=0] [blur=0] [NAME]`: `samples` draws so many in every pixel instead of
//! stopping at the target, `highlights=0` leaves highlights to chance, `denoise=0` leaves noise, `blur=0` leaves caustics
//! sharp as they are in the reference, and only scenes whose name holds NAME are rendered.
//! Without `--bench`, as tests run it, one small scene proves that it works.
mod gallery;

use std::ops::ControlFlow;
use std::time::{Duration, Instant};

use dipir_imaging::composite::composite_pixel;
use dipir_imaging::transfer::Transfer;
use dipir_numerics::stats::median;
use dipir_render::adaptive::Stop;
use dipir_render::effects::EffectsPlan;
use dipir_render::film::Film;
use dipir_render::render::{Rendered, Renderer, Settings, Simulation};
use glam::Vec3;

const MAX_SAMPLES: u32 = 1 << 20;
/// What is behind everything where there is no photograph.
const GREY: Vec3 = Vec3::splat(0.18);

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |key: &str, default: f64| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        pairs
            .rfind(|(k, _)| *k == key)
            .map_or(default, |(_, v)| v.parse().expect("a number"))
    };
    let whole = arguments.iter().any(|a| a == "--bench");
    let size = value("size", if whole { 48.0 } else { 12.0 }) as u32;
    let target = value("target", if whole { 0.008 } else { 0.03 }) as f32;
    let samples = value("samples", 0.0) as u32;
    let seeds = value("seeds", 5.0) as u64;
    let [highlights, denoise, blur_caustics] =
        ["highlights", "denoise", "blur"].map(|key| value(key, 1.0) > 0.0);
    let stop = match samples {
        0 => Stop::TargetError(target),
        n => Stop::Samples(n),
    };
    let name = arguments
        .iter()
        .find(|a| !a.contains('=') && !a.starts_with("--"));
    let scenes = gallery::scenes(size)
        .into_iter()
        .chain(gallery::with_highlights(size))
        .filter(|(n, _)| name.is_none_or(|name| n.contains(name.as_str())))
        .take(if whole { usize::MAX } else { 1 });
    let light = gallery::sky();
    println!(
        "| scene | stated, median | 95% bound, median | true, root mean square | true / target | within the bound | rays, millions |"
    );
    println!("|---|--:|--:|--:|--:|--:|--:|");
    let (mut all_within, mut count, mut ratios) = (0, 0, Vec::new());
    let mut budgets = Vec::new();
    for (name, scene) in scenes {
        let renderer = Renderer::new(&scene);
        let simulation = EffectsPlan::everything(&scene, &Settings::default()).simulation();
        let reference = Settings {
            seed: 1 << 40,
            stop: Stop::TargetError(target / 10.0),
            max_samples: MAX_SAMPLES,
            ..Settings::default()
        };
        let reference = render(&renderer, &light, &simulation, &reference);
        let (mut stated, mut bounds, mut squares, mut within) = (vec![], vec![], 0.0, 0);
        let mut rays = 0;
        for seed in 0..seeds {
            let settings = Settings {
                seed,
                stop,
                max_samples: MAX_SAMPLES,
                highlights,
                denoise,
                blur_caustics,
                ..Settings::default()
            };
            let found = render(&renderer, &light, &simulation, &settings);
            let square = squared_difference(&found.film, &reference.film)
                - reference.error.rmse * reference.error.rmse;
            squares += square.max(0.0) / seeds as f64;
            within += u32::from(square.max(0.0).sqrt() <= found.error.upper_95);
            rays += found.counts.total();
            stated.push(found.error.rmse);
            bounds.push(found.error.upper_95);
        }
        let error = squares.sqrt();
        ratios.push(error / f64::from(target));
        all_within += within;
        count += seeds;
        println!(
            "| {name} | {:.5} | {:.5} | {error:.5} | {:.2} | {within} of {seeds} | {:.2} |",
            median(&stated).expect("some"),
            median(&bounds).expect("some"),
            ratios.last().expect("one"),
            rays as f64 / (1e6 * seeds as f64),
        );
        if whole && samples == 0 {
            budgets.push((
                name,
                [0.3, 1.0, 3.0].map(|s| spent(&renderer, &light, &simulation, s)),
            ));
        }
    }
    let (least, most) = ratios
        .iter()
        .fold((f64::INFINITY, 0f64), |(l, m), &r| (l.min(r), m.max(r)));
    println!(
        "\nwithin the 95% bound: {all_within} of {count}; true over target: {least:.2} to {most:.2}\n"
    );
    if !budgets.is_empty() {
        println!("| scene | of 0.3 s | of 1 s | of 3 s |\n|---|--:|--:|--:|");
        for (name, shares) in budgets {
            let cells = shares.map(|s| format!("{:.0}%", 100.0 * s));
            println!("| {name} | {} |", cells.join(" | "));
        }
    }
}

fn render(
    renderer: &Renderer,
    light: &dipir_light::environment::EnvironmentSampler,
    simulation: &Simulation,
    settings: &Settings,
) -> Rendered {
    let go_on = &mut |_: &_| ControlFlow::Continue(());
    renderer
        .render(light, simulation, settings, go_on)
        .expect("renders")
}

/// The share of a budget that a render with it takes.
fn spent(
    renderer: &Renderer,
    light: &dipir_light::environment::EnvironmentSampler,
    simulation: &Simulation,
    seconds: f64,
) -> f64 {
    let clock = Instant::now();
    let stop = Stop::TimeBudget(Duration::from_secs_f64(seconds));
    let settings = Settings {
        stop,
        max_samples: MAX_SAMPLES,
        denoise: true,
        blur_caustics: true,
        ..Settings::default()
    };
    render(renderer, light, simulation, &settings);
    clock.elapsed().as_secs_f64() / seconds
}

/// Mean squared display-referred difference over the pixels that `reference` touches.
fn squared_difference(found: &Film, reference: &Film) -> f64 {
    let shown = |film: &Film, k: usize| {
        let (object, alpha) = (film.object.pixels()[k], film.alpha.pixels()[k]);
        let linear = composite_pixel(GREY, object, alpha, film.shadow.pixels()[k]);
        linear
            .to_array()
            .map(|v| f64::from(Transfer::Srgb.encode_scalar(v.max(0.0)).clamp(0.0, 1.0)))
    };
    let bare = Transfer::Srgb.encode_scalar(GREY.x);
    let (mut sum, mut count) = (0.0, 0.0);
    for k in 0..reference.alpha.pixels().len() {
        let (a, b) = (shown(found, k), shown(reference, k));
        let changed = b.iter().any(|v| (v - f64::from(bare)).abs() > 0.5 / 255.0);
        if reference.alpha.pixels()[k] > 0.0 || changed {
            sum += (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>() / 3.0;
            count += 1.0;
        }
    }
    sum / f64::max(count, 1.0)
}
