//! Photographs and cameras unlike those that networks are trained on.
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_light::luminance::luminance;
use dipir_scene::camera::{Camera, FieldOfView};
use glam::Vec3;

use crate::histogram::STOPS;
use crate::tests::{camera, estimator, finite, photo};
use crate::{Estimator, LightEstimate, Visible};

/// The logarithm of all light, stops.
fn stops(e: &LightEstimate) -> f64 {
    f64::from(luminance(e.map().integral().as_vec3())).log2()
}

/// A photograph with bars of one shade beside and above it, and its camera.
fn framed(
    photo: &LinearImage,
    bars: [usize; 2],
    shade: f32,
    camera: &Camera,
) -> (LinearImage, Camera) {
    let (w, h) = (
        photo.0.width() + 2 * bars[0],
        photo.0.height() + 2 * bars[1],
    );
    let pixel = |k: usize| {
        let at = [(k % w).checked_sub(bars[0]), (k / w).checked_sub(bars[1])];
        match at {
            [Some(x), Some(y)] if x < photo.0.width() && y < photo.0.height() => *photo.0.get(x, y),
            _ => Vec3::splat(shade),
        }
    };
    let framed = LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()));
    let camera = Camera {
        principal_px: camera.principal_px + glam::Vec2::new(bars[0] as f32, bars[1] as f32),
        resolution: [w as u32, h as u32],
        ..*camera
    };
    (framed, camera)
}

#[test]
fn extreme_photographs_and_cameras_stay_finite() {
    let estimator = estimator();
    let flat = |v: f32, w: usize, h: usize| LinearImage(Raster::filled(w, h, Vec3::splat(v)));
    for photo in [
        flat(0.0, 30, 20),
        flat(1.0, 30, 20),
        flat(0.4, 1, 1),
        flat(f32::NAN, 3, 2),
        flat(f32::INFINITY, 2, 2),
    ] {
        let size = [photo.0.width() as u32, photo.0.height() as u32];
        assert!(finite(
            &estimator.estimate(&photo, &camera(10.0, size[0], size[1]))
        ));
        for to in [Vec3::NEG_Y, Vec3::Y] {
            let vertical = Camera::look_at(
                Vec3::ZERO,
                to,
                Vec3::NEG_Z,
                FieldOfView::Vertical(1.0),
                size,
            );
            assert!(finite(&estimator.estimate(&photo, &vertical)));
        }
    }
}

#[test]
fn a_frame_around_the_photograph_changes_neither_the_light_nor_what_is_seen() {
    let (photo, camera) = (photo(120, 80), camera(20.0, 120, 80));
    let embedded = Estimator::embedded().unwrap();
    let plain = embedded.estimate(&photo, &camera);
    for (bars, shade) in [([12, 12], 0.0), ([0, 30], 0.0), ([40, 0], 1.0)] {
        let (photo, camera) = framed(&photo, bars, shade, &camera);
        let found = embedded.estimate(&photo, &camera);
        // A pixel and a 250th of the picture are cut off with each bar. Bars made it 1.5 stops darker or brighter.
        assert!((stops(&found) - stops(&plain)).abs() < 0.2, "{bars:?}");
        assert!(
            (found.reference / plain.reference - 1.0).abs() < 0.02,
            "{bars:?}"
        );
        // The same in a camera's coordinates of half the size.
        let half = camera.scaled(camera.resolution.map(|n| n / 2));
        let other = embedded.estimate(&photo, &half);
        assert!((stops(&other) - stops(&found)).abs() < 1e-3);
        let seen = Visible::new(&photo, &camera, 64, 32, 6.0);
        let texels = seen
            .map
            .texels()
            .iter()
            .zip(&seen.alpha)
            .filter(|t| *t.1 > 0.0);
        let [low, high] = [f32::min, f32::max].map(|pick| {
            let all = texels.clone().map(|t| t.0.y);
            all.reduce(pick).unwrap()
        });
        // Green of the picture itself.
        assert!(low >= 0.3 && high <= 0.6 + 1e-5, "{bars:?}: {low} {high}");
    }
}

#[test]
fn photographs_of_any_shape_and_brightness_have_intervals_in_their_ranges() {
    let embedded = Estimator::embedded().unwrap();
    let of = |w: usize, h: usize, value: &dyn Fn(usize, usize, Vec3) -> Vec3| {
        let plain = photo(w, h);
        let pixel = |k: usize| value(k % w, k / w, *plain.0.get(k % w, k / w));
        LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()))
    };
    let corner = |x: usize, y: usize| ((x as f32 - 60.0) / 72.0).hypot((y as f32 - 40.0) / 72.0);
    let photos = [
        of(240, 80, &|_, _, p| p),
        of(80, 240, &|_, _, p| p),
        of(32, 24, &|_, _, p| p),
        of(1, 90, &|_, _, p| p),
        of(120, 80, &|_, _, p| 0.01 * p),
        of(120, 80, &|_, _, p| (8.0 * p).min(Vec3::ONE)),
        of(120, 80, &|_, _, p| 1e6 * p),
        of(120, 80, &|_, _, p| Vec3::splat(luminance(p))),
        of(120, 80, &|x, y, p| {
            p * (1.0 - corner(x, y).min(1.0)).powi(3)
        }),
        of(120, 80, &|x, y, p| {
            if (x + y) % 9 == 0 { Vec3::NAN } else { p }
        }),
    ];
    for (n, photo) in photos.iter().enumerate() {
        let [w, h] = [photo.0.width() as u32, photo.0.height() as u32];
        let e = embedded.estimate(photo, &camera(20.0, w, h));
        assert!(finite(&e), "{n}");
        let over = stops(&e) - (4.0 * std::f64::consts::PI * e.reference).log2();
        let [told, share] = [e.exposure_stops, e.share];
        assert!(
            STOPS.low <= told.low && told.high <= STOPS.high,
            "{n}: {told:?}"
        );
        // The map's brightness is told by other outputs of the same networks, and calibrated by .4 stops.
        assert!(
            told.low - 1.0 < over && over < told.high + 1.0,
            "{n}: {over} {told:?}"
        );
        assert!(0.0 <= share.low && share.high <= 1.0, "{n}: {share:?}");
        assert!((0.0..=1.0).contains(&e.sun_probability), "{n}");
        let total: f32 = e.posterior.weights.iter().sum();
        assert!((total - 1.0).abs() < 1e-5, "{n}: {total}");
    }
}
