#![no_main]
use dipir_scene::import::{Imported, Limits, Resolver, load_obj_bytes};
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

/// Every file that the input names is the input itself.
struct Itself<'a>(&'a [u8]);

impl Resolver for Itself<'_> {
    fn read(&self, _uri: &str) -> std::io::Result<Vec<u8>> {
        Ok(self.0.to_vec())
    }
}

fuzz_target!(|bytes: &[u8]| {
    if let Ok(imported) = load_obj_bytes(bytes, &Itself(bytes), &LIMITS) {
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
