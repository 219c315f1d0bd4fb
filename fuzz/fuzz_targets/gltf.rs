#![no_main]
mod imported;

use dipir_scene::import::{NoFiles, load_gltf_bytes};
use dipir_scene::texture::decode_textures;
use imported::{LIMITS, is_whole};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(imported) = load_gltf_bytes(bytes, &NoFiles, &LIMITS) {
        is_whole(&imported);
        let _ = decode_textures(&imported.textures, |_| true);
    }
});
