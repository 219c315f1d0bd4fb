#![no_main]
use dipir_imaging::layers::Layers;
use dipir_pipeline::manifest::Manifest;
use dipir_scene::description::SceneDescription;
use libfuzzer_sys::fuzz_target;

// What one stage leaves for the next: a manifest, a scene description, image layers.
fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-artifacts-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    if std::fs::create_dir_all(&folder).is_ok() {
        for name in ["stage.json", "scene.json", "layers.exr"] {
            let _ = std::fs::write(folder.join(name), bytes);
        }
        let _ = Manifest::read(&folder, "dipir-scene");
        let _ = SceneDescription::read(&folder.join("scene.json"));
        let _ = Layers::read_exr(folder.join("layers.exr"));
        let _ = std::fs::remove_dir_all(&folder);
    }
});
