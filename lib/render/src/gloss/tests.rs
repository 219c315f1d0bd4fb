use dipir_imaging::raster::LinearImage;
use dipir_light::environment::EnvironmentSampler;
use dipir_numerics::warp::square_to_sphere;
use dipir_scene::material::Material;
use dipir_scene::proxy::Proxy;
use dipir_scene::surfaces::SeenSurfaces;
use glam::{Mat3, Quat};

use super::*;
use crate::lens::ThinLens;
use crate::shapes::icosphere;
use crate::shutter::{CameraPose, Shutter};
use crate::testing::{
    camera, carry_on, everything, ground, lambertian, matte, render, scene, settings, sky,
};

const SIDE: u32 = 64;
const MIRROR: Gloss = Gloss {
    roughness: 0.0,
    reflectance: 0.04,
};

fn view() -> Camera {
    camera(
        Vec3::new(0.0, 1.2, 5.0),
        Vec3::new(0.0, 0.3, 0.0),
        40.0,
        SIDE,
    )
}

/// A ball that floats above the ground, so that all of its mirror image is seen beside it.
fn ball() -> dipir_scene::mesh::TriangleMesh {
    icosphere(Vec3::new(0.0, 1.1, 0.0), 0.6, 4)
}

fn glowing(radiance: f32) -> Material {
    Material {
        emissive: Vec3::splat(radiance),
        ..matte(Vec3::ZERO)
    }
}

fn polished(gloss: Gloss) -> Settings<'static> {
    Settings {
        gloss: Some(gloss),
        ..settings(16, 3)
    }
}

/// The cosine at which the camera sees the ground in the middle of a pixel, and the direction that a mirror sends it on to.
fn seen(view: &Camera, x: usize, y: usize) -> Option<(Vec3, Vec3, f32)> {
    let ray = view.ray(Vec2::new(x as f32, y as f32) + 0.5);
    let cosine = -ray.direction.y;
    let way = ray.direction * Vec3::new(1.0, -1.0, 1.0);
    (cosine > 0.0).then(|| {
        (
            ray.origin + ray.direction * (ray.origin.y / cosine),
            way,
            cosine,
        )
    })
}

/// By how much a line passes the ball's centre, metres.
fn passes(from: Vec3, way: Vec3) -> f32 {
    let to = Vec3::new(0.0, 1.1, 0.0) - from;
    (to - way * to.dot(way)).length()
}

fn pixels() -> impl Iterator<Item = (usize, usize)> {
    (0..SIDE as usize).flat_map(|y| (0..SIDE as usize).map(move |x| (x, y)))
}

#[test]
fn lobes_are_drawn_as_they_are_evaluated() {
    for roughness in [0.15, 0.5, 1.0] {
        let gloss = Gloss {
            roughness,
            reflectance: 0.04,
        };
        for cosine in [0.1f32, 0.5, 0.95] {
            let wo = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
            let (mut drawn, mut even, mut squares) = (0.0, 0.0, 0.0);
            let n = 1 << 16;
            for index in 0..n {
                let mut sampler = Sampler::new(0, Stream::TEST, 0, index);
                if let Some(r) = gloss.sample(wo, sampler.next_2d()) {
                    let (value, pdf) = gloss.eval(wo, r.wi).unwrap();
                    assert!(
                        (value / pdf / r.weight - 1.0).abs() < 1e-2,
                        "{value} {pdf} {}",
                        r.weight
                    );
                    drawn += r.weight;
                }
                let wi = square_to_sphere(sampler.next_2d());
                let value = gloss.eval(wo, wi).map_or(0.0, |e| e.0) * 4.0 * std::f32::consts::PI;
                even += value;
                squares += value * value;
            }
            let n = n as f32;
            let (drawn, even) = (drawn / n, even / n);
            let error = ((squares / n - even * even) / n).sqrt();
            assert!((drawn - even).abs() < 5.0 * error, "{drawn} {even} {error}");
        }
    }
}

#[test]
fn a_mirror_shows_a_glowing_ball_by_fresnels_share() {
    let scene = scene(ball(), glowing(3.0), view(), ground());
    let rendered = render(&scene, &sky(0.0), &everything(2), &polished(MIRROR));
    let mirrored = rendered.film.mirrored.unwrap();
    let mut inside = 0;
    for (x, y) in pixels() {
        let light = mirrored.get(x, y).x;
        let Some((from, way, cosine)) =
            seen(&view(), x, y).filter(|_| *rendered.film.alpha.get(x, y) == 0.0)
        else {
            continue;
        };
        // A pixel is .05 m of the ground.
        if passes(from, way) < 0.5 {
            let fresnel = 0.04 + 0.96 * (1.0 - cosine).powi(5);
            assert!(
                (light / (3.0 * fresnel) - 1.0).abs() < 0.02,
                "{light} {fresnel}"
            );
            inside += 1;
        } else if passes(from, way) > 0.7 {
            assert_eq!(light, 0.0);
        }
    }
    assert!(inside > 100, "{inside}");
}

#[test]
fn a_mirror_shows_what_a_camera_below_it_sees() {
    let scene = scene(ball(), matte(Vec3::new(0.8, 0.4, 0.2)), view(), ground());
    let light = EnvironmentSampler::new(crate::testing::sun(
        Vec3::new(0.4, 0.8, 0.3),
        200.0,
        0.0,
        32,
    ));
    // All light comes from where no mirrored ray goes: without the object the coat is black.
    let all = Gloss {
        roughness: 0.0,
        reflectance: 1.0,
    };
    let settings = Settings {
        stop: Stop::Samples(64),
        ..polished(all)
    };
    let mirrored = render(&scene, &light, &everything(2), &settings).film;
    let flip = Mat3::from_diagonal(Vec3::new(1.0, -1.0, 1.0));
    let below = Camera {
        position: flip * scene.camera.position,
        rotation: flip * scene.camera.rotation * flip,
        ..scene.camera
    };
    let settings = Settings {
        gloss: None,
        ..settings
    };
    let direct = Renderer::new(&scene).with_camera(below);
    let direct = direct
        .render(&light, &everything(2), &settings, &mut carry_on)
        .unwrap()
        .film;
    let (mut sums, mut worst) = ([Vec3::ZERO; 2], 0f32);
    for (x, y) in pixels().filter(|&(x, y)| *mirrored.alpha.get(x, y) == 0.0) {
        let seen = [
            *mirrored.mirrored.as_ref().unwrap().get(x, y),
            *direct.object.get(x, SIDE as usize - 1 - y),
        ];
        worst = worst.max((seen[0] - seen[1]).abs().max_element());
        sums = [sums[0] + seen[0], sums[1] + seen[1]];
    }
    // Half a thousand pixels with 64 samples of a tenth of standard deviation each.
    let off = (sums[0] / sums[1] - 1.0).abs().max_element();
    assert!(off < 0.01 && worst < 0.3, "{off} {worst}");
}

#[test]
fn what_the_object_hides_of_the_coat_and_what_it_leaves_are_weighed_by_the_coats_share() {
    let photo = LinearImage(Raster::filled(
        SIDE as usize,
        SIDE as usize,
        Vec3::new(0.1, 0.3, 0.6),
    ));
    // Black: it sends nothing.
    let scene = scene(ball(), matte(Vec3::ZERO), view(), ground());
    let matt = Settings {
        background: Some(&photo),
        ..settings(16, 3)
    };
    let light = sky(1.0);
    let before = render(&scene, &light, &lambertian(1), &matt).film;
    let gloss = Gloss {
        roughness: 0.0,
        reflectance: 0.2,
    };
    let after = render(
        &scene,
        &light,
        &lambertian(1),
        &Settings {
            gloss: Some(gloss),
            ..matt
        },
    )
    .film;
    assert!(
        after
            .mirrored
            .unwrap()
            .pixels()
            .iter()
            .all(|v| *v == Vec3::ZERO)
    );
    let (mut hidden, mut kept) = (0, 0);
    for (x, y) in pixels().filter(|&(x, y)| *before.alpha.get(x, y) == 0.0) {
        let Some((from, way, cosine)) = seen(&view(), x, y) else {
            continue;
        };
        let coat = 0.2 + 0.8 * (1.0 - cosine).powi(5);
        let share = (coat / Vec3::new(0.1, 0.3, 0.6)).min(Vec3::splat(MOST_OF_COAT));
        let (r, found) = (*before.shadow.get(x, y), *after.shadow.get(x, y));
        let left = match passes(from, way) {
            p if p < 0.5 => {
                hidden += 1;
                0.0
            }
            p if p > 0.7 => {
                kept += usize::from(r.x < 0.98);
                1.0
            }
            _ => continue,
        };
        // Schlick's curve bends by 20 * .8 * (1 - cosine)^3 a radian squared, 8 at most here. Between places four pixels or
        // .045 radians apart linear values are off by up to an eighth of .045 squared times that, .002, of photographs of .1.
        let expected = r + share * (left - r);
        assert!(
            found.abs_diff_eq(expected, 0.02),
            "{x} {y}: {found} {expected}"
        );
    }
    assert!(hidden > 100 && kept > 100, "{hidden} {kept}");
}

#[test]
fn a_white_object_under_an_even_sky_leaves_rough_ground_as_it_was() {
    // Under an even sky a white, convex object that the ground does not darken is as bright as the sky: what it hides of the
    // coat's light it sends.
    let photo = LinearImage(Raster::filled(
        SIDE as usize,
        SIDE as usize,
        Vec3::splat(2.0),
    ));
    let scene = scene(ball(), matte(Vec3::ONE), view(), ground());
    for roughness in [0.1, 0.4] {
        let gloss = Gloss {
            roughness,
            reflectance: 1.0,
        };
        let settings = Settings {
            background: Some(&photo),
            stop: Stop::Samples(64),
            gloss: Some(gloss),
            ..settings(64, 3)
        };
        let with = render(&scene, &sky(1.0), &lambertian(1), &settings).film;
        let matt = render(
            &scene,
            &sky(1.0),
            &lambertian(1),
            &Settings {
                gloss: None,
                ..settings
            },
        )
        .film;
        let Proxy::Plane(plane) = ground() else {
            unreachable!()
        };
        let (mut change, mut hidden) = (0.0, 0.0);
        for (x, y) in pixels().filter(|&(x, y)| *matt.alpha.get(x, y) == 0.0) {
            let m = with.mirrored.as_ref().unwrap().get(x, y).x;
            let r = matt.shadow.get(x, y).x;
            let ray = view().ray(Vec2::new(x as f32, y as f32) + 0.5);
            let (coat, _) = gloss.radiance(&plane, &sky(1.0).on_object(), &ray, 0);
            change += (with.shadow.get(x, y).x - r) * 2.0 - coat.x * (1.0 - r) + m;
            if seen(&view(), x, y).is_some_and(|(from, way, _)| passes(from, way) < 0.6) {
                hidden += coat.x;
            }
        }
        // Paths differ by what is masked, a tenth: 64 of them in a hundred pixels by a thousandth.
        assert!(
            hidden > 100.0 && (change / hidden).abs() < 0.01,
            "{change} {hidden}"
        );
    }
}

#[test]
fn every_pixel_whose_lobe_meets_the_object_is_looked_at() {
    let scene = scene(ball(), glowing(1.0), view(), ground());
    let renderer = Renderer::new(&scene);
    let bvh = &renderer.geometry().bvh;
    let blocker = Blocker::new(bvh.bounding_sphere().unwrap(), bvh.clusters());
    let mut world = renderer.world(0).unwrap();
    let lens = ThinLens {
        radius: 0.08,
        focus: 3.0,
    };
    let sharp = Optics::default();
    let blurred = Optics {
        lens: Some(lens),
        ..sharp
    };
    let end = |by: f32| CameraPose {
        position: view().position + Vec3::new(0.3, 0.05, -0.1) * by,
        rotation: Quat::from_rotation_z(0.1 * by) * CameraPose::of(&view()).rotation,
    };
    let moving = Optics {
        shutter: Some(Shutter {
            opens: end(-1.0),
            middle: CameraPose::of(&view()),
            closes: end(1.0),
        }),
        ..sharp
    };
    for (roughness, optics) in [
        (0.0, sharp),
        (0.1, sharp),
        (0.3, sharp),
        (0.0, blurred),
        (0.3, blurred),
        (0.0, moving),
        (0.3, moving),
    ] {
        world.optics = optics;
        let gloss = Gloss {
            roughness,
            reflectance: 1.0,
        };
        let coat = Coat(Raster::filled(2, 2, CoatPoint::default()));
        let mut film = Film::new(SIDE as usize, SIDE as usize);
        let ground = Polished::new(gloss, coat, &mut film, &scene.camera, &settings(1, 0));
        let jobs = renderer.mirror_jobs(&ground, optics, &blocker);
        let of = |x: usize, y: usize| {
            jobs.iter()
                .any(|job| job.pixels.index_of(x as u32, y as u32).is_some())
        };
        let (mut hits, mut missed) = (0, 0);
        for (x, y) in pixels() {
            for index in 0..64 {
                let mut sampler = Sampler::new(0, Stream::TEST, (y * 64 + x) as u32, index);
                let place = Vec2::new(x as f32, y as f32) + sampler.next_2d();
                let ray = world.view_ray(place, &mut sampler);
                let drawn = gloss.ray(&world, &ray, sampler.next_2d());
                if drawn.is_some_and(|(ray, _)| world.closest::<0>(&ray, 0).is_some()) {
                    hits += 1;
                    missed += usize::from(!of(x, y));
                }
            }
        }
        // Of the microfacets a hundredth lean farther.
        assert!(
            hits > 5000 && missed * 100 <= hits,
            "{roughness}: {missed} of {hits}"
        );
        assert!(
            roughness > 0.0
                || missed == 0 && !optics.is_sharp()
                || missed == 0 && jobs.iter().map(|j| j.pixels.len()).sum::<usize>() < 2000
        );
    }
}

#[test]
fn masks_and_surfaces_before_the_ground_show_no_mirror_image() {
    let scene = scene(ball(), glowing(3.0), view(), ground());
    let n = SIDE as usize;
    let left = |i: usize| f32::from(u8::from(i % n < n / 2));
    let mask = Raster::from_pixels(n, n, (0..n * n).map(left).collect());
    let surfaces = SeenSurfaces::new(mask.clone(), Raster::filled(n, n, Vec3::ZERO));
    let hidden = Settings {
        occluders: Some(&mask),
        ..polished(MIRROR)
    };
    let covered = Settings {
        seen_surfaces: Some(&surfaces),
        ..polished(MIRROR)
    };
    for settings in [hidden, covered] {
        let film = render(&scene, &sky(1.0), &everything(2), &settings).film;
        let mirrored = film.mirrored.unwrap();
        let sum = |is_left: f32| -> f32 {
            let pixels = mirrored.pixels().iter().enumerate();
            pixels
                .filter(|(i, _)| left(*i) == is_left)
                .map(|(_, v)| v.x)
                .sum()
        };
        assert!(
            sum(1.0) == 0.0 && sum(0.0) > 10.0,
            "{} {}",
            sum(1.0),
            sum(0.0)
        );
    }
}

#[test]
fn without_a_polished_plane_that_is_seen_there_is_no_mirror_image() {
    let wall = crate::shapes::icosphere(Vec3::new(0.0, -3.0, 0.0), 3.0, 3);
    let under = Proxy::Plane(Plane {
        point: Vec3::new(0.0, 3.0, 0.0),
        normal: Vec3::Y,
    });
    for proxy in [Proxy::None, Proxy::Mesh(wall), under] {
        let scene = scene(ball(), glowing(1.0), view(), proxy);
        assert!(
            render(&scene, &sky(1.0), &everything(2), &polished(MIRROR))
                .film
                .mirrored
                .is_none()
        );
    }
    let scene = scene(ball(), glowing(1.0), view(), ground());
    let matt = Settings {
        gloss: None,
        ..polished(MIRROR)
    };
    assert!(
        render(&scene, &sky(1.0), &everything(2), &matt)
            .film
            .mirrored
            .is_none()
    );
}

#[test]
fn the_mirror_image_does_not_need_the_shadow() {
    let scene = scene(ball(), glowing(1.0), view(), ground());
    let [with, without] = [true, false].map(|shadow| {
        let simulation = Simulation {
            shadow,
            ..everything(2)
        };
        let film = render(&scene, &sky(1.0), &simulation, &polished(MIRROR)).film;
        film.mirrored.expect("is polished")
    });
    assert_eq!(with, without);
}

#[test]
fn every_way_to_stop_keeps_its_word() {
    let photo = LinearImage(Raster::filled(
        SIDE as usize,
        SIDE as usize,
        Vec3::splat(0.3),
    ));
    let scene = scene(ball(), matte(Vec3::splat(0.8)), view(), ground());
    let light = EnvironmentSampler::new(crate::testing::sun(
        Vec3::new(0.4, 0.8, 0.3),
        500.0,
        0.5,
        32,
    ));
    let gloss = Gloss {
        roughness: 0.2,
        reflectance: 0.3,
    };
    let with = |stop: Stop, most_pixels: Option<u64>| {
        let settings = Settings {
            background: Some(&photo),
            stop,
            most_pixels,
            denoise: true,
            ..polished(gloss)
        };
        render(&scene, &light, &everything(2), &settings)
    };
    let exact = with(Stop::Samples(1024), None);
    let shown = |r: &Rendered, i: usize| {
        let film = &r.film;
        photo.0.pixels()[i] * film.shadow.pixels()[i] * (1.0 - film.alpha.pixels()[i])
            + film.object.pixels()[i]
            + film.mirrored.as_ref().unwrap().pixels()[i]
    };
    for target in [0.02, 0.005] {
        let found = with(Stop::TargetError(target), None);
        assert!(
            found.error.upper_95 <= f64::from(target),
            "{:?}",
            found.error
        );
        let n = photo.0.pixels().len();
        let squares: f32 = (0..n)
            .map(|i| (shown(&found, i) - shown(&exact, i)).length_squared() / 3.0)
            .sum();
        let rmse = (f64::from(squares) / found.error.touched_pixels as f64).sqrt();
        assert!(rmse < 1.5 * f64::from(target), "{rmse} {:?}", found.error);
    }
    let small = with(Stop::Samples(64), Some(1024));
    assert_eq!(small.film.mirrored.unwrap().width(), SIDE as usize);
    let timed = with(Stop::TimeBudget(std::time::Duration::ZERO), None);
    assert_eq!(timed.film.mirrored.unwrap().width(), SIDE as usize);
}
