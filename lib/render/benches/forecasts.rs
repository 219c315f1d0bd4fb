//! What other presets are foreseen to cost, beside what they cost, as a table in Markdown. Cost is counted in rays and
//! samples, so the table is the same on every machine.
//! `cargo test -p dipir-render --bench forecasts -- --bench [size=PIXELS] [seed=N] [NAME]`: only scenes whose name holds NAME.
//! Without `--bench`, as tests run it, one small scene proves that it works.
mod gallery;

use std::ops::ControlFlow;

use dipir_render::adaptive::Stop;
use dipir_render::effects::EffectsPlan;
use dipir_render::render::{Rendered, Renderer, Settings};

/// Target and whether noise is removed: the presets `draft`, `standard` and `high`.
const PRESETS: [(f32, bool); 3] = [(0.02, true), (0.004, true), (0.001, false)];
/// From which preset which other one is foreseen.
const PAIRS: [(usize, usize); 4] = [(0, 1), (1, 0), (1, 2), (2, 1)];

fn cost(rendered: &Rendered) -> f64 {
    (rendered.counts.total() + rendered.samples) as f64
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |key: &str, default: u32| {
        let mut pairs = arguments.iter().filter_map(|a| a.split_once('='));
        pairs
            .rfind(|(k, _)| *k == key)
            .map_or(default, |(_, v)| v.parse().expect("a whole number"))
    };
    let whole = arguments.iter().any(|a| a == "--bench");
    let size = value("size", if whole { 96 } else { 12 });
    let seed = u64::from(value("seed", 1));
    let name = arguments
        .iter()
        .find(|a| !a.contains('=') && !a.starts_with("--"));
    let light = gallery::sky();
    println!(
        "| scene | draft, million rays | standard | high | draft foretells standard | standard foretells draft | standard foretells high | high foretells standard |"
    );
    println!("|---|--:|--:|--:|--:|--:|--:|--:|");
    let (mut within, mut count) = ([0; 2], 0);
    let mut guesses = vec![];
    for (name, scene) in gallery::scenes(size)
        .into_iter()
        .chain(gallery::with_highlights(size))
        .filter(|(n, _)| name.is_none_or(|name| n.contains(name.as_str())))
        .take(if whole { usize::MAX } else { 1 })
    {
        let renderer = Renderer::new(&scene);
        let simulation = EffectsPlan::everything(&scene, &Settings::default()).simulation();
        let runs = PRESETS.map(|(target, denoise)| {
            let settings = Settings {
                stop: Stop::TargetError(if whole { target } else { 10.0 * target }),
                denoise,
                seed,
                ..Settings::default()
            };
            let mut silent = |_: &_| ControlFlow::Continue(());
            renderer
                .render(&light, &simulation, &settings, &mut silent)
                .expect("renders")
        });
        let millions = runs.each_ref().map(|r| r.counts.total() as f64 * 1e-6);
        let ratios = PAIRS.map(|(from, to)| {
            let (foresight, target) = (&runs[from].foresight, PRESETS[to].0.into());
            let foreseen = foresight.cost_with(target, PRESETS[to].1);
            let ratio = foreseen * cost(&runs[from]) / cost(&runs[to]);
            (ratio, foresight.guess(target, PRESETS[to].1).is_some())
        });
        let told = ratios.map(|(ratio, guess)| match guess {
            true => format!("{ratio:.2} (guess)"),
            false => format!("{ratio:.2}"),
        });
        println!(
            "| {name} | {:.2} | {:.2} | {:.2} | {} |",
            millions[0],
            millions[1],
            millions[2],
            told.join(" | ")
        );
        for (ratio, guess) in ratios {
            if guess {
                guesses.push(ratio);
                continue;
            }
            count += 1;
            for (k, most) in [1.25, 1.3].into_iter().enumerate() {
                within[k] += usize::from((1.0 / most..most).contains(&ratio));
            }
        }
    }
    println!(
        "\nWithin 25%: {} of {count}, within 30%: {}. Guesses: {}, of {:.2} to {:.2}.",
        within[0],
        within[1],
        guesses.len(),
        guesses.iter().copied().fold(f64::INFINITY, f64::min),
        guesses.iter().copied().fold(0.0, f64::max),
    );
}
