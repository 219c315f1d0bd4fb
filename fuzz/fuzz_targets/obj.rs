#![no_main]
mod imported;

use dipir_scene::import::{Resolver, load_obj_bytes};
use imported::{LIMITS, is_whole};
use libfuzzer_sys::fuzz_target;

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
