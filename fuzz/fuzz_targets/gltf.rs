#![no_main]
use dipir_scene::import::{Limits, NoFiles, load_gltf_bytes};
use dipir_scene::texture::decode_textures;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let limits = Limits {
        max_vertices: 1 << 18,
        max_triangles: 1 << 18,
    };
    if let Ok(imported) = load_gltf_bytes(bytes, &NoFiles, &limits) {
        assert!(imported.mesh.first_non_finite().is_none());
        let vertices = imported.mesh.positions.len();
        assert!(
            imported
                .mesh
                .indices
                .iter()
                .flatten()
                .all(|i| (*i as usize) < vertices)
        );
        let _ = decode_textures(&imported.textures, |_| true);
    }
});
