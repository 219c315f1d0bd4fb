#![no_main]
use dipir_imaging::tone::ToneCurves;
use dipir_optimize::lighting::Lighting;
use glam::Vec3;
use libfuzzer_sys::fuzz_target;

// What a user may correct in the light stage's folder: `lighting.json` and `tone.json`.
fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-light-{}", std::process::id());
    let path = std::env::temp_dir().join(name);
    if std::fs::write(&path, bytes).is_ok() {
        if let Ok(light) = Lighting::read(&path) {
            let map = light.map(8, 4);
            assert!(map.texels().iter().all(|t| !t.is_nan()));
            let _ = light.peak_direction();
        }
        if let Ok(curves) = ToneCurves::read_json(&path) {
            let mapped = curves.mapper().object_pixel(Vec3::splat(0.5), 1.0);
            assert!(mapped.is_finite());
        }
        let _ = std::fs::remove_file(&path);
    }
});
