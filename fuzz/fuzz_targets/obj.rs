#![no_main]
use dipir_scene::import::{Limits, Resolver, load_obj_bytes};
use libfuzzer_sys::fuzz_target;

/// Every file that the input names is the input itself.
struct Itself<'a>(&'a [u8]);

impl Resolver for Itself<'_> {
    fn read(&self, _uri: &str) -> std::io::Result<Vec<u8>> {
        Ok(self.0.to_vec())
    }
}

fuzz_target!(|bytes: &[u8]| {
    let limits = Limits {
        max_vertices: 1 << 18,
        max_triangles: 1 << 18,
    };
    if let Ok(imported) = load_obj_bytes(bytes, &Itself(bytes), &limits) {
        let vertices = imported.mesh.positions.len();
        assert!(
            imported
                .mesh
                .indices
                .iter()
                .flatten()
                .all(|i| (*i as usize) < vertices)
        );
    }
});
