//! What the targets that import objects share.
use dipir_scene::import::{Imported, Limits};

/// Small, so that no case takes much memory or time.
pub const LIMITS: Limits = Limits {
    triangles: 1 << 18,
    instances: 1 << 12,
    texture_pixels: 1 << 22,
    all_texture_pixels: 1 << 22,
    file_bytes: 1 << 30,
    photo_megapixels: 200,
    allow_outside: false,
};

/// Panics on an object whose indices lead nowhere.
pub fn is_whole(imported: &Imported) {
    let mesh = &imported.mesh;
    assert!(mesh.first_non_finite().is_none());
    let (vertices, materials) = (mesh.positions.len(), imported.materials.len());
    assert!(mesh.indices.iter().flatten().all(|i| (*i as usize) < vertices));
    assert!(mesh.materials.iter().all(|m| (*m as usize) < materials));
}
