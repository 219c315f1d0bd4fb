#![no_main]
use dipir_imaging::file::{PhotoLimits, read_linear, read_mask, read_photo_within};
use dipir_imaging::transfer::Transfer;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-photograph-{}", std::process::id());
    let path = std::env::temp_dir().join(name);
    if std::fs::write(&path, bytes).is_ok() {
        // Small, so that no case takes much memory or time.
        let limits = PhotoLimits { megapixels: 4.0 };
        if let Ok(photo) = read_photo_within(&path, Transfer::Srgb, limits) {
            let pixels = photo.image.0.pixels();
            assert!(pixels.iter().all(|p| p.is_finite()));
            assert!(photo.radiance().0.pixels().iter().all(|p| p.is_finite()));
            let _ = photo.encoding.encode_8(&photo.image);
        }
        let _ = read_mask(&path);
        let _ = read_linear(&path);
        let _ = std::fs::remove_file(&path);
    }
});
