//! What planning saves: ten kinds of scene with every effect simulated, whether the scene has it or
//! not, and as planned, as a table in Markdown. `cargo bench -p dipir-render --bench effects`
mod gallery;

use std::ops::ControlFlow;
use std::time::Instant;

use dipir_light::environment::EnvironmentSampler;
use dipir_render::adaptive::Stop;
use dipir_render::effects::{EffectsPlan, plan};
use dipir_render::features::ALL;
use dipir_render::render::{Rendered, Renderer, Settings, Simulation};
use dipir_render::shadow::LightOnProxy;
use dipir_scene::config::EffectsConfig;

const SIZE: u32 = 256;
const SAMPLES: u32 = 32;
const REPEATS: usize = 3;

/// The best time of a few, in seconds, and the picture.
fn render(
    renderer: &Renderer,
    light: &EnvironmentSampler,
    simulation: &Simulation,
) -> (f64, Rendered) {
    let settings = Settings {
        stop: Stop::Samples(SAMPLES),
        ..Settings::default()
    };
    let mut best = (f64::INFINITY, None);
    for _ in 0..REPEATS {
        let start = Instant::now();
        let rendered = renderer
            .render(light, simulation, &settings, &mut |_| {
                ControlFlow::Continue(())
            })
            .expect("renders");
        best = (best.0.min(start.elapsed().as_secs_f64()), Some(rendered));
    }
    (best.0, best.1.expect("rendered at least once"))
}

fn main() {
    let light = gallery::sky();
    println!(
        "| scene | D | left out, RMSE | planning, s | everything, s | planned, s | saved | rays saved |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (name, scene) in gallery::scenes(SIZE) {
        let renderer = Renderer::new(&scene);
        let settings = Settings::default();
        let start = Instant::now();
        let planned = plan(
            &renderer,
            &light,
            &EffectsConfig::default(),
            &settings,
            &mut |_| ControlFlow::Continue(()),
        )
        .expect("plans");
        let planning = start.elapsed().as_secs_f64();
        let everything = Simulation {
            features: ALL,
            shadow: true,
            proxy_occlusion: true,
            light_on_proxy: Some(LightOnProxy {
                emission: true,
                bounce: true,
            }),
            ..EffectsPlan::everything(&scene, &settings).simulation()
        };
        let (slow, all) = render(&renderer, &light, &everything);
        let (fast, few) = render(&renderer, &light, &planned.simulation());
        println!(
            "| {name} | {} | {:.5} | {planning:.2} | {slow:.3} | {fast:.3} | {:.0}% | {:.0}% |",
            planned.simulation().max_depth,
            planned.left_out.unwrap_or(0.0),
            100.0 * (1.0 - fast / slow),
            100.0 * (1.0 - few.counts.total() as f64 / all.counts.total() as f64),
        );
    }
}
