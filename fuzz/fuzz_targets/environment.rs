#![no_main]
use dipir_light::environment::EnvironmentMap;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-environment-{}", std::process::id());
    let path = std::env::temp_dir().join(name);
    if std::fs::write(&path, bytes).is_ok() {
        if let Ok(map) = EnvironmentMap::read(&path) {
            assert!(map.texels().iter().all(|t| t.is_finite()));
        }
        let _ = std::fs::remove_file(&path);
    }
});
