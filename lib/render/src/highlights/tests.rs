use dipir_light::environment::EnvironmentSampler;
use dipir_scene::material::Material;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use proptest::prelude::*;

use super::*;
use crate::adaptive::Stop;
use crate::render::{Rendered, Settings};
use crate::shapes::icosphere;
use crate::testing::{camera, everything, matte, render, scene, settings, sky, sun};

const DISTANCE: f32 = 40.0;
const PIXELS: u32 = 12;
const FOV_DEG: f32 = 2.0;
const RADIUS: f32 = 0.5;

/// A mirror ball far away, of some 70 pixels.
fn mirror_ball(roughness: f32) -> Scene {
    let mirror = Material {
        metallic: 1.0,
        roughness,
        ..matte(Vec3::ONE)
    };
    let view = camera(Vec3::Z * DISTANCE, Vec3::ZERO, FOV_DEG, PIXELS);
    scene(icosphere(Vec3::ZERO, RADIUS, 6), mirror, view, Proxy::None)
}

/// A sun of .35 degrees in an otherwise black sky, and the irradiance from it.
fn small_sun() -> (EnvironmentSampler, f32) {
    let direction = Vec3::new(0.5, 0.6, 0.4).normalize();
    let map = sun(direction, 3000.0, 0.0, 512);
    let irradiance = luminance(map.integral().as_vec3());
    (EnvironmentSampler::new(map), irradiance)
}

fn sampled(roughness: f32, highlights: bool, seed: u64) -> Rendered {
    let settings = Settings {
        stop: Stop::TargetError(0.005),
        highlights,
        ..settings(0, seed)
    };
    let ball = mirror_ball(roughness);
    render(&ball, &small_sun().0, &everything(1), &settings)
}

/// Radiance over all pixels times their solid angle, on whom the picture shines.
fn received(rendered: &Rendered) -> f32 {
    let pixel = (0.5 * FOV_DEG).to_radians().tan() * 2.0 / PIXELS as f32;
    let sum: f32 = rendered.film.object.pixels().iter().map(|p| p.x).sum();
    sum * pixel * pixel
}

#[test]
fn a_mirror_ball_throws_a_quarter_of_what_it_catches_at_every_distant_eye() {
    // A ball mirrors a distant light into all directions alike: I = E R^2 / 4. A smoothed ball of 41k
    // triangles does so within a few percent, a camera at 80 radii within two.
    let expected = small_sun().1 * RADIUS * RADIUS / 4.0 / (DISTANCE * DISTANCE);
    for (roughness, seed) in [
        (0.02, 0),
        (0.02, 1),
        (0.02, 2),
        (0.0, 0),
        (0.0, 1),
        (0.0, 2),
    ] {
        let with = sampled(roughness, true, seed);
        let share = received(&with) / expected;
        assert!(
            (0.9..1.1).contains(&share),
            "{share}: roughness {roughness}, seed {seed}"
        );
        assert!(with.error.upper_95 <= 0.005);
    }
    // It is small: without looking for it, it is missed, and nobody is told.
    let missed = (0..3).filter(|&seed| {
        let without = sampled(0.02, false, seed);
        received(&without) < 0.5 * expected && without.error.upper_95 <= 0.005
    });
    assert!(missed.count() > 0);
}

#[test]
fn what_is_found_does_not_depend_on_threads() {
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("a pool").install(|| sampled(0.02, true, 7))
    };
    let (one, two) = (with(1), with(2));
    assert_eq!(one.film.object, two.film.object);
    assert_eq!((one.counts, one.error), (two.counts, two.error));
}

#[test]
fn under_an_even_sky_and_on_matte_surfaces_nothing_is_looked_for() {
    let rays = |scene: &Scene, light: &EnvironmentSampler, highlights| {
        let settings = Settings {
            // Where the number of samples is given, nothing is ever looked for.
            stop: Stop::TargetError(0.01),
            highlights,
            ..settings(0, 0)
        };
        render(scene, light, &everything(2), &settings)
            .counts
            .total()
    };
    let ball = mirror_ball(0.02);
    assert_eq!(rays(&ball, &sky(1.0), true), rays(&ball, &sky(1.0), false));
    let mut dull = mirror_ball(0.02);
    dull.materials[0] = matte(Vec3::ONE);
    let (sun, _) = small_sun();
    // But for the rays that see that it is matte.
    let seen = u64::from(PIXELS * PIXELS * RAYS_PER_PIXEL);
    assert!(rays(&dull, &sun, true) <= rays(&dull, &sun, false) + seen);
    // A polished ball in the sun is looked into: the test can fail.
    assert!(rays(&ball, &sun, true) > rays(&ball, &sun, false) + seen);
}

#[test]
fn without_time_nothing_is_looked_into() {
    let with = |highlights| {
        let settings = Settings {
            stop: Stop::TimeBudget(Duration::ZERO),
            highlights,
            ..settings(0, 1)
        };
        let ball = mirror_ball(0.02);
        render(&ball, &small_sun().0, &everything(1), &settings)
    };
    let (looking, blind) = (with(true), with(false));
    assert_eq!(looking.film.object, blind.film.object);
    // But for the rays that see that it is polished.
    let seen = u64::from(PIXELS * PIXELS * RAYS_PER_PIXEL);
    assert!(looking.counts.total() <= blind.counts.total() + seen);
}

/// Scans whose shares are given by cell and response.
fn density_of(responses: Vec<Vec<(u32, f32)>>) -> PixelDensity {
    let scans = SIDES.into_iter().zip(responses);
    PixelDensity {
        scans: scans.filter_map(|(side, r)| Scan::new(side, r)).collect(),
    }
}

/// Cells without repetition and what they return.
fn responses(side: u32) -> impl Strategy<Value = Vec<(u32, f32)>> {
    let cells = prop::collection::btree_map(0..side * side, 0f32..10.0, 0..40);
    cells.prop_map(|cells| cells.into_iter().collect())
}

proptest! {
    #[test]
    fn weighted_samples_integrate_to_the_area(
        responses in (responses(16), responses(64), responses(256)),
    ) {
        let (a, b, c) = responses;
        let density = density_of(vec![a, b, c]);
        // Of a quarter of the square and of all of it. Weights are at most 2, so a sum of n independent ones has
        // a standard deviation of 1 / sqrt(n) at most, .008; these are stratified.
        let (n, mut quarter, mut whole) = (1 << 14, 0.0, 0.0);
        for sample in 0..n {
            let u = Sampler::new(3, Stream::TEST, 0, sample).next_2d();
            let (point, weight) = density.place(u);
            prop_assert!((0.0..=1.0).contains(&point.x) && (0.0..=1.0).contains(&point.y));
            prop_assert!(weight > 0.0 && weight <= 1.0 / EVEN + 1e-4);
            whole += f64::from(weight) / f64::from(n);
            if point.x < 0.5 && point.y < 0.5 {
                quarter += f64::from(weight) / f64::from(n);
            }
        }
        prop_assert!((whole - 1.0).abs() < 0.03, "{whole}");
        prop_assert!((quarter - 0.25).abs() < 0.03, "{quarter}");
    }
}

#[test]
fn places_stay_in_cells_that_have_a_share_however_numbers_are_rounded() {
    let (side, last) = (SIDES[2], SIDES[2] * SIDES[2] - 1);
    // The second response is lost in the sum of the first.
    let scan = Scan::new(side, vec![(7, 1e6), (last - 1, 1e-6), (last, 1.0)]).expect("responses");
    for x in [
        0.0,
        0.5,
        scan.cumulative[0],
        scan.cumulative[1],
        BELOW_1,
        1.0,
    ] {
        for y in [0.0, 0.5, BELOW_1, 1.0] {
            let point = scan.place(Vec2::new(x, y));
            assert!(scan.density(point) > 0.0, "{x} {y}: {point}");
        }
    }
    // The last of several scans takes what is rounded up to its end.
    let density = density_of(vec![vec![(0, 1.0)], vec![(1, 1.0)], vec![(last, 1.0)]]);
    let (point, weight) = density.place(Vec2::new(BELOW_1, BELOW_1));
    assert!(point.min_element() > 1.0 - 1.0 / side as f32, "{point}");
    assert!(weight < 1e-4, "{weight}");
}

#[test]
fn parts_of_cells_cover_them() {
    let mut all: Vec<u32> = (0..SIDES[0] * SIDES[0])
        .flat_map(|cell| parts(cell, SIDES[0], SIDES[1]))
        .collect();
    all.sort_unstable();
    assert_eq!(all, (0..SIDES[1] * SIDES[1]).collect::<Vec<_>>());
    let cell = 3 * SIDES[0] + 5;
    for part in parts(cell, SIDES[0], SIDES[1]) {
        let middle = (corner_of(part, SIDES[1]) + 0.5) / SIDES[1] as f32;
        assert_eq!((middle * SIDES[0] as f32).as_uvec2(), UVec2::new(5, 3));
    }
}
