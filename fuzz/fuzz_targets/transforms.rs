#![no_main]
use dipir_scene::camera::WorldUp;
use dipir_scene::transforms::camera;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok((camera, _)) = camera(bytes, 0, WorldUp::Z, [640, 480]) {
        assert!(camera.position.is_finite() && camera.rotation.is_finite());
    }
});
