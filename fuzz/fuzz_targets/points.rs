#![no_main]
use dipir_cameras::{Camera, Lens, Pose, WorldUp, colmap};
use dipir_points::ground::{Search, Shape};
use dipir_points::{Cloud, depth, file, ground};
use glam::{DVec2, DVec3};
use libfuzzer_sys::fuzz_target;

/// The ground under the points, as a camera in their midst sees it.
fn look_for_ground(cloud: &Cloud) {
    let camera = Camera {
        pose: Pose::IDENTITY,
        lens: Lens::pinhole([640.0, 480.0], DVec2::splat(500.0)),
    };
    let search = Search {
        camera: &camera,
        up: DVec3::Y,
        shape: Shape::Relief,
        seed: 0,
    };
    if let Ok(found) = ground(cloud, &search) {
        assert!(found.normal.is_finite() && found.point.is_finite());
        assert!(found.relief.is_none_or(|relief| relief.is_whole()));
    }
}

fuzz_target!(|bytes: &[u8]| {
    for cloud in [file::ply(bytes), file::pcd(bytes), file::sweep(bytes)]
        .into_iter()
        .flatten()
    {
        assert!(cloud.points.iter().all(|p| p.is_finite()));
        look_for_ground(&cloud);
    }
    let _ = colmap::read_points(bytes, true, WorldUp::MinusY);
    let _ = colmap::read_points(bytes, false, WorldUp::MinusY);
    let _ = file::depth_png(bytes);
    let _ = depth::png(bytes);
});
