#![no_main]
use dipir_scene::import::{Limits, Resolver, load_obj_bytes};
use libfuzzer_sys::fuzz_target;

/// A triangle of the library's material `a`.
const OBJECT: &[u8] = b"mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n";

/// Every file that the input names is the input itself.
struct Itself<'a>(&'a [u8]);

impl Resolver for Itself<'_> {
    fn read(&self, _uri: &str) -> std::io::Result<Vec<u8>> {
        Ok(self.0.to_vec())
    }
}

fuzz_target!(|bytes: &[u8]| {
    if let Ok(imported) = load_obj_bytes(OBJECT, &Itself(bytes), &Limits::default()) {
        for texture in imported.materials.iter().flat_map(|m| m.texture_refs()) {
            assert!((texture.texture as usize) < imported.textures.len());
        }
    }
});
