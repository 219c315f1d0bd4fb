#![no_main]
use std::path::Path;

use dipir_optimize::settings::LightTable;
use dipir_pipeline::config::Config;
use dipir_scene::config::SceneConfig;
use libfuzzer_sys::fuzz_target;

mod preset;
use preset::PRESET;

fuzz_target!(|text: &str| {
    if let Ok(config) = Config::parse(Path::new("pipeline.toml"), text, &[]) {
        let _ = config.pipeline();
        if let Ok(scene) = config.table::<SceneConfig>("scene") {
            let _ = scene.validate();
        }
        if let Ok(light) = config.table::<LightTable>("light") {
            let _ = light.settings(&PRESET, 0);
        }
    }
});
