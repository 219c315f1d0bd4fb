#![no_main]
use dipir_scene::import::{Imported, Limits, load_stl_bytes};
use libfuzzer_sys::fuzz_target;

/// Small, so that no case takes much memory or time.
const LIMITS: Limits = Limits {
    triangles: 1 << 18,
    instances: 1 << 12,
    texture_pixels: 1 << 22,
    all_texture_pixels: 1 << 22,
    file_bytes: 1 << 30,
    photo_megapixels: 200,
    allow_outside: false,
};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(imported) = load_stl_bytes(bytes, &LIMITS) {
        is_whole(&imported);
    }
});

fn is_whole(imported: &Imported) {
    let mesh = &imported.mesh;
    assert!(mesh.first_non_finite().is_none());
    let (vertices, materials) = (mesh.positions.len(), imported.materials.len());
    assert!(mesh.indices.iter().flatten().all(|i| (*i as usize) < vertices));
    assert!(mesh.materials.iter().all(|m| (*m as usize) < materials));
}
