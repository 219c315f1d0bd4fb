#![no_main]
use dipir_cameras::{WorldUp, gltf, nuscenes, transforms};
use libfuzzer_sys::fuzz_target;

const SIZE: [f64; 2] = [640.0, 480.0];

fuzz_target!(|bytes: &[u8]| {
    let found = [
        transforms::read(bytes, Some(SIZE), WorldUp::Z),
        gltf::read(bytes, SIZE),
        nuscenes::read(bytes, SIZE, WorldUp::Z),
    ];
    for (_, camera) in found.into_iter().flatten().flatten() {
        assert!(camera.pose.position.is_finite() && camera.pose.rotation.is_finite());
    }
});
