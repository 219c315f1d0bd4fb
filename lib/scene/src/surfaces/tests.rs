use super::*;
use crate::camera::FieldOfView;

const SIZE: [u32; 2] = [240, 160];
/// Height of the camera, metres.
const EYE: f32 = 1.5;

fn camera() -> Camera {
    let (eye, to) = (Vec3::new(0.0, EYE, 0.0), Vec3::new(0.0, 0.8, -5.0));
    Camera::look_at(eye, to, Vec3::Y, FieldOfView::Vertical(0.8), SIZE)
}

/// Depth of the ground, infinite above the horizon.
fn ground_m(camera: &Camera, pixel: Vec2) -> f64 {
    let ray = camera.ray(pixel);
    let ahead = -ray.direction.dot(camera.rotation.z_axis);
    match ray.direction.y < 0.0 {
        true => f64::from(EYE / -ray.direction.y * ahead),
        false => f64::INFINITY,
    }
}

/// Depth of the plane through `point` across `normal`.
fn plane_m(camera: &Camera, pixel: Vec2, point: Vec3, normal: Vec3) -> f64 {
    let ray = camera.ray(pixel);
    let ahead = -ray.direction.dot(camera.rotation.z_axis);
    let t = normal.dot(point - ray.origin) / normal.dot(ray.direction);
    f64::from(if t > 0.0 { t * ahead } else { f32::INFINITY })
}

/// A wall that turns away to the right, 6 m ahead.
const WALL: (Vec3, Vec3) = (Vec3::new(0.0, 0.0, -6.0), Vec3::new(-0.6, 0.0, 0.8));
/// A table's top, .7 m high, to the left, from 2 to 4.5 m ahead.
const TOP: (Vec3, Vec3) = (Vec3::new(0.0, 0.7, 0.0), Vec3::Y);

fn middle(x: usize, y: usize) -> Vec2 {
    Vec2::new(x as f32, y as f32) + 0.5
}

/// What is seen at a pixel: the ground (0), the wall (1) or the table's top (2), and its depth.
fn seen(camera: &Camera, pixel: Vec2) -> (usize, f64) {
    let [wall, top] = [WALL, TOP].map(|(p, n)| plane_m(camera, pixel, p, n));
    let point = camera.ray(pixel);
    let ahead = f64::from(-point.direction.dot(camera.rotation.z_axis));
    let on_top = point.origin + point.direction * (top / ahead) as f32;
    let is_table = on_top.x > -3.0 && on_top.x < -0.3 && on_top.z > -4.5 && on_top.z < -2.0;
    let all = [
        (0, ground_m(camera, pixel)),
        (1, wall),
        (2, if is_table { top } else { f64::INFINITY }),
    ];
    all.into_iter().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap()
}

/// The surfaces of a map of `size` texels whose disparities are `noise(column, row)` times what they ought to be.
fn found(size: [usize; 2], deviation: f64, noise: impl Fn(usize, usize) -> f64) -> SeenSurfaces {
    let camera = camera();
    let own = camera.scaled(size.map(|n| n as u32));
    let at = |i: usize| (i % size[0], i / size[0]);
    let disparity = |i: usize| {
        let (x, y) = at(i);
        (noise(x, y) / seen(&own, middle(x, y)).1) as f32
    };
    let values = (0..size[0] * size[1]).map(disparity).collect();
    let disparities = Raster::from_pixels(size[0], size[1], values);
    let [w, h] = SIZE.map(|n| n as usize);
    let share = |i: usize| {
        let pixel = middle(i % w, i / w);
        let nearer = 1.0 - seen(&camera, pixel).1 / ground_m(&camera, pixel);
        ((nearer - 0.03) / 0.015).clamp(0.0, 1.0) as f32
    };
    let share = Raster::from_pixels(w, h, (0..w * h).map(share).collect());
    let map = Map {
        disparities: &disparities,
        deviation,
        margin: 0.03,
        camera: &camera,
    };
    SeenSurfaces::of_map(share, &map, |x, y| ground_m(&camera, middle(x, y)).recip())
}

/// Pixels of the camera at least `margin` pixels from where something else is seen.
fn inner(margin: usize) -> Vec<(usize, usize, usize, f64)> {
    let camera = camera();
    let [w, h] = SIZE.map(|n| n as usize);
    let all = (0..w * h).map(|i| seen(&camera, middle(i % w, i / w)));
    let all: Vec<(usize, f64)> = all.collect();
    let pixels = (margin..h - margin).flat_map(|y| (margin..w - margin).map(move |x| (x, y)));
    let kept = pixels.filter_map(|(x, y)| {
        let (what, depth) = all[y * w + x];
        let mut rows = y - margin..=y + margin;
        let alone = rows.all(|v| {
            let row = &all[v * w + x - margin..=v * w + x + margin];
            row.iter().all(|other| other.0 == what)
        });
        alone.then_some((x, y, what, depth))
    });
    kept.collect()
}

/// The point of a surface that is seen in most of a pixel.
fn at(surfaces: &SeenSurfaces, x: usize, y: usize) -> Option<Seen> {
    let is_seen = surfaces.share_at(&camera(), middle(x, y)) > 0.5;
    surfaces
        .point_at(&camera(), middle(x, y))
        .filter(|_| is_seen)
}

#[test]
fn flat_surfaces_come_back_at_any_resolution_of_the_map() {
    let camera = camera();
    for size in [SIZE.map(|n| n as usize), [120, 80], [500, 333]] {
        let surfaces = found(size, 0.0, |_, _| 1.0);
        let mut counts = [0; 3];
        for (x, y, what, depth) in inner(8) {
            let found = at(&surfaces, x, y);
            let Some((_, normal)) = [None, Some(WALL), Some(TOP)][what] else {
                assert!(found.is_none(), "{size:?} {x} {y}");
                continue;
            };
            let found = found.unwrap_or_else(|| panic!("{size:?} {x} {y} {what}"));
            counts[what] += 1;
            // 32-bit disparities are exact to 1e-7 of their value, of which the slopes of a window are about a tenth.
            assert!(
                (f64::from(found.depth) / depth - 1.0).abs() < 1e-4,
                "{size:?} {x} {y}"
            );
            assert!(
                found.normal.dot(normal) > 0.9995,
                "{size:?} {x} {y} {}",
                found.normal
            );
            let seen = camera.project(found.position).unwrap();
            assert!(seen.distance(middle(x, y)) < 0.01);
        }
        assert!(counts[1] > 5000 && counts[2] > 400, "{size:?} {counts:?}");
    }
}

#[test]
fn noise_of_a_percent_leaves_depths_and_normals() {
    // Each value by itself off by up to 1%, .58% of standard deviation.
    let noise = |x: usize, y: usize| {
        let hash = (x * 7919 + y * 104_729).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        0.99 + 0.02 * (hash % 4096) as f64 / 4096.0
    };
    let surfaces = found([240, 160], 0.0058, noise);
    let (mut turned, mut count) = (0.0, 0.0);
    for (x, y, _, depth) in inner(8).into_iter().filter(|p| p.2 == 1) {
        let found = at(&surfaces, x, y).unwrap();
        assert!((f64::from(found.depth) / depth - 1.0).abs() < 0.01);
        turned += found.normal.dot(WALL.1).min(1.0).acos().to_degrees();
        count += 1.0;
    }
    // A slope by least squares over 7 x 7 values has a standard deviation of .0058 / 14 a texel of .0053 radians: 4.5 degrees,
    // the length of two such 1.25 times that, and Tukey's weights lose up to a fifth. Windows of 5 x 5 would have twice that.
    let mean: f32 = turned / count;
    assert!(mean < 4.5 * 1.25 * 1.2, "{mean}");
}

#[test]
fn at_its_foot_a_wall_meets_the_ground() {
    let camera = camera();
    let surfaces = found([240, 160], 0.0, |_, _| 1.0);
    let [w, h] = SIZE.map(|n| n as usize);
    let mut wrong = 0;
    for x in 120..w {
        for y in 0..h {
            let is_wall = seen(&camera, middle(x, y)).0 == 1;
            wrong += usize::from((*surfaces.share().get(x, y) > 0.5) != is_wall);
        }
    }
    // The foot passes through each column once: a pixel there may go to either side.
    assert!(wrong <= w - 120, "{wrong}");
}

#[test]
fn what_stands_before_the_camera_s_ground_alone_is_a_surface() {
    let surfaces = found([240, 160], 0.0, |_, _| 1.0);
    let camera = camera();
    let [w, h] = SIZE.map(|n| n as usize);
    let bottom = middle(w - 1, h - 1);
    assert_eq!(seen(&camera, bottom).0, 0);
    assert!(at(&surfaces, w - 1, h - 1).is_none());
    assert!(!surfaces.are_seen([216, 152], SIZE, SIZE));
    assert!(surfaces.are_seen([96, 0], [144, 16], SIZE));
    // At a tenth of the resolution.
    assert!(!surfaces.are_seen([22, 15], [24, 16], [24, 16]));
    assert!(surfaces.are_seen([9, 0], [15, 2], [24, 16]));
    let scaled = camera.scaled([24, 16]);
    assert_eq!(surfaces.share_at(&scaled, Vec2::new(12.0, 1.0)), 1.0);
    assert_eq!(surfaces.share_at(&scaled, Vec2::new(24.0, 16.0)), 0.0);
    // What hides the ground behind them does not hide the shadow on them.
    let mask = surfaces.shadow_mask(&Raster::filled(w, h, 1.0));
    assert_eq!(*mask.get(120, 10), 0.0);
    assert_eq!(*mask.get(w - 1, h - 1), 1.0);
}

#[test]
fn where_nothing_is_known_there_is_no_surface() {
    let surfaces = found([240, 160], 0.0, |x, _| if x < 120 { f64::NAN } else { 1.0 });
    assert!(at(&surfaces, 60, 10).is_none());
    assert_eq!(*surfaces.share().get(60, 10), 0.0);
    assert!(at(&surfaces, 200, 10).is_some());
    // The mask may reach so far beyond what the map has.
    assert!(at(&surfaces, 118, 10).is_some() && at(&surfaces, 117, 10).is_none());
    // A plane that the camera is in, one behind it, and one that is infinitely far.
    for plane in [Vec3::ZERO, Vec3::NEG_Z, Vec3::Z * 1e-7, Vec3::INFINITY] {
        let [w, h] = SIZE.map(|n| n as usize);
        let everywhere = SeenSurfaces::new(Raster::filled(w, h, 1.0), Raster::filled(1, 1, plane));
        assert!(at(&everywhere, 60, 10).is_none(), "{plane}");
    }
}

#[test]
fn beyond_an_edge_is_another_surface() {
    let camera = camera();
    let surfaces = found([60, 40], 0.0, |_, _| 1.0);
    let [w, h] = SIZE.map(|n| n as usize);
    let mut between = 0;
    for y in 0..h {
        for x in 0..w {
            let Some(found) = at(&surfaces, x, y) else {
                continue;
            };
            // The plane of something that is seen within two texels, of four pixels. Few texels at an edge show its slope, so it is
            // up to 5% off; two of them are 50% apart.
            let around = (y.saturating_sub(8)..(y + 9).min(h))
                .step_by(4)
                .flat_map(|v| {
                    (x.saturating_sub(8)..(x + 9).min(w))
                        .step_by(4)
                        .map(move |u| (u, v))
                });
            let near = around.into_iter().any(|(u, v)| {
                let pixel = middle(x, y);
                let depth = match seen(&camera, middle(u, v)).0 {
                    0 => ground_m(&camera, pixel),
                    1 => plane_m(&camera, pixel, WALL.0, WALL.1),
                    _ => plane_m(&camera, pixel, TOP.0, TOP.1),
                };
                (f64::from(found.depth) / depth - 1.0).abs() < 0.05
            });
            between += usize::from(!near);
        }
    }
    assert_eq!(between, 0);
}
