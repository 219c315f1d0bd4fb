#![no_main]
use dipir_estimator::Estimator;
use dipir_optimize::checkpoint::State;
use dipir_optimize::material_checkpoint::MaterialState;
use dipir_optimize::materials::MaterialSettings;
use dipir_optimize::parameters::Parameters;
use dipir_optimize::settings::LightTable;
use dipir_render::transport::Transport;
use glam::Vec3;
use libfuzzer_sys::fuzz_target;

mod preset;
use preset::PRESET;

/// Texels and pixels of records that are used: more take much time.
const MOST: usize = 1 << 16;

// Files that a killed run goes on from, records of light transport, and weights of the estimator.
fuzz_target!(|bytes: &[u8]| {
    let _ = Estimator::from_bytes(bytes);
    let name = format!("dipir-fuzz-checkpoints-{}", std::process::id());
    let path = std::env::temp_dir().join(name);
    if std::fs::write(&path, bytes).is_ok() {
        if let Ok(settings) = LightTable::default().settings(&PRESET, 0) {
            let start = Parameters::neutral(settings.lobes, 1.0);
            let _ = State::read(&path, &settings, &start);
            let tensors = start.to_tensors();
            let _ = MaterialState::read(&path, &[0], &MaterialSettings::default(), &tensors);
        }
        if let Ok(record) = Transport::load(&path) {
            let [[w, h], [columns, rows]] = [record.size(), record.environment_size()];
            if w * h <= MOST && columns * rows <= MOST {
                let light = vec![Vec3::ONE; columns * rows];
                let shown = [record.foreground(&light), record.shadow(&light)];
                assert!(shown.iter().all(|s| s.pixels().len() == w * h));
                let gradient = vec![Vec3::ONE; w * h];
                let _ = record.foreground_vjp(&gradient);
                let _ = record.shadow_vjp(&light, &shown[1], &gradient);
                let _ = record.effective_sample_size(&light);
                let _ = record.light_sample_size(&light);
            }
        }
        let _ = std::fs::remove_file(&path);
    }
});
