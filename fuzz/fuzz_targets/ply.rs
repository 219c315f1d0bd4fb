#![no_main]
mod imported;

use dipir_scene::import::{load_ply_bytes};
use imported::{LIMITS, is_whole};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(imported) = load_ply_bytes(bytes, &LIMITS) {
        is_whole(&imported);
    }
});
