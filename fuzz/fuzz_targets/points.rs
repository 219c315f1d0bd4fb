#![no_main]
use dipir_cameras::{WorldUp, colmap};
use dipir_points::file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for cloud in [file::ply(bytes), file::pcd(bytes), file::sweep(bytes)]
        .into_iter()
        .flatten()
    {
        assert!(cloud.points.iter().all(|p| p.is_finite()));
    }
    let _ = colmap::read_points(bytes, true, WorldUp::MinusY);
    let _ = colmap::read_points(bytes, false, WorldUp::MinusY);
    let _ = file::depth_png(bytes);
});
