//! How long it takes to recover a light, by a run of it with other settings.
use dipir_cli::session::Session;
use dipir_optimize::settings::{LightPreset, Settings};
use dipir_pipeline::manifest::Manifest;
use serde_json::Value;

use crate::light::request::{Guide, Request};
use crate::names::SCENE;
use crate::presets::LightRun;

/// Seconds of a run under the session's configuration, by the `earlier` one; `None` if that did something else.
pub fn seconds(session: &Session, earlier: &Manifest) -> Option<f64> {
    let request = Request::of(session).ok()?;
    let guidance = &request.params()["guidance"];
    if guidance.is_null() || *guidance != earlier.params["guidance"] {
        return None;
    }
    let was: Settings = serde_json::from_value(earlier.params["light"].clone()).ok()?;
    let scene = dipir_files::read(SCENE.folder(session).join("scene.json")).ok()?;
    let scene: Value = serde_json::from_slice(&scene).ok()?;
    let resolution = serde_json::from_value(scene["camera"]["resolution"].clone()).ok()?;
    let now = &request.settings;
    let run = LightRun {
        iterations: Some(was.iterations),
        ..light_run(resolution, &was, &request.guide, earlier)
    };
    let seconds = run.seconds_with(&LightPreset {
        iterations: now.iterations,
        lobes: now.lobes,
        environment: now.environment,
        samples: now.samples,
        size: now.size,
    });
    Some(seconds.min(now.time_budget_s.unwrap_or(f64::INFINITY)))
}

/// What took how long.
pub(super) fn light_run(
    resolution: [u32; 2],
    settings: &Settings,
    guide: &Guide,
    manifest: &Manifest,
) -> LightRun {
    let seconds = |name: &str| manifest.timings_s.get(name).copied().unwrap_or(0.0);
    let photo_side = resolution[0].max(resolution[1]) as usize;
    let (by_model, refines) = match guide {
        Guide::Reference { .. } | Guide::None => (false, false),
        Guide::Model { reading, .. } => (true, reading.is_some()),
    };
    let [record_s, optimization_s, guidance_s, records_s] =
        ["transport", "optimization", "guidance", "records"].map(seconds);
    LightRun {
        iterations: (!refines).then_some(settings.iterations),
        samples: settings.samples,
        side: settings.size.min(photo_side),
        photo_side,
        environment: settings.environment,
        record_s: record_s + records_s,
        guidance_s,
        replay_s: (optimization_s - guidance_s - records_s).max(0.0),
        rest_s: (manifest.elapsed_s - record_s - optimization_s).max(0.0),
        by_model,
    }
}
