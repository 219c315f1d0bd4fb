#![no_main]
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = dipir_imaging::file::decode_texture(bytes, "input");
});
