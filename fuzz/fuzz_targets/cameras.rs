#![no_main]
use dipir_cameras::file::{Wanted, Which};
use dipir_cameras::{
    Camera, Pose, WorldUp, chan, colmap, fspy, gltf, kitti, moving, nuscenes, opencv, transforms,
};
use glam::DVec2;
use libfuzzer_sys::fuzz_target;

const SIZE: [f64; 2] = [640.0, 480.0];

/// Panics if the camera's position or direction is not finite.
fn is_whole(camera: &Camera) {
    assert!(camera.pose.position.is_finite() && camera.pose.rotation.is_finite());
    let size = DVec2::from_array(camera.lens.size);
    for at in [DVec2::ZERO, 0.5 * size, 0.3 * size, size] {
        let Some(ray) = camera.ray(at) else { continue };
        assert!(
            (ray.length() - 1.0).abs() < 1e-6,
            "{ray} at {at} of {camera:?}"
        );
    }
}

fuzz_target!(|bytes: &[u8]| {
    let text = String::from_utf8_lossy(bytes);
    let named = [
        transforms::read(bytes, Some(SIZE), WorldUp::Z),
        gltf::read(bytes, SIZE),
        nuscenes::read(bytes, SIZE, WorldUp::Z),
    ];
    let named = named
        .into_iter()
        .flatten()
        .flatten()
        .map(|(_, camera)| camera);
    let frames = chan::read(&text, SIZE, Some(40.0)).into_iter().flatten();
    let single = [fspy::read(bytes, WorldUp::Z), kitti::read(&text, 2, SIZE)];
    let lens = opencv::read(&text, Some(SIZE)).ok().map(|lens| Camera {
        pose: Pose::IDENTITY,
        lens,
    });
    let all = named.chain(frames.map(|(_, camera)| camera));
    for camera in all.chain(single.into_iter().flatten()).chain(lens) {
        is_whole(&camera);
    }
    for frame in [0, 2] {
        let wanted = Wanted {
            size: SIZE,
            which: Which::Number(frame),
            up: None,
            fov_deg: None,
            turns: None,
        };
        let camera = moving::read(bytes, None, &wanted);
        camera.iter().for_each(is_whole);
    }
    let _ = kitti::read_scanner(&text);
    let _ = nuscenes::sensor(bytes, WorldUp::Z);
    // Cameras and images of COLMAP, with a line or eight bytes of 255 between them.
    let mut parts = text.split("\n---\n");
    let (cameras, images) = (parts.next().unwrap_or(""), parts.next().unwrap_or(""));
    let of_text = colmap::read_text(cameras, images, "", WorldUp::MinusY);
    let between = bytes.windows(8).position(|w| w == [255; 8]);
    let of_bytes =
        between.map(|n| colmap::read_binary(&bytes[..n], &bytes[n + 8..], &[], WorldUp::MinusY));
    for model in of_text.into_iter().chain(of_bytes.into_iter().flatten()) {
        model.images.iter().for_each(|(_, camera)| is_whole(camera));
    }
});
