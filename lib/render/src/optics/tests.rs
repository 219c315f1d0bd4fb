//! What lens and shutter have in common.
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentSampler;
use dipir_numerics::sampler::Stream;
use dipir_scene::scene::Scene;
use glam::Quat;

use super::*;
use crate::adaptive::Stop;
use crate::film::Film;
use crate::gloss::Gloss;
use crate::job::REPLICATES;
use crate::render::Rendered;
use crate::shapes::icosphere;
use crate::shutter::CameraPose;
use crate::testing::{
    camera, carry_on, everything, glowing, ground, matte, render, scene, settings, sky, street, sun,
};

const SIDE: u32 = 64;
/// Paths a pixel and replicate by way of the ground.
const MIRRORED: u32 = 128;

fn through(radius: f32, focus: f32) -> Optics {
    Optics {
        lens: Some(ThinLens { radius, focus }),
        shutter: None,
    }
}

/// A camera that goes `by` metres to its right, up and back, and turns by `turn` radians about these, either way.
fn moving(camera: &Camera, by: Vec3, turn: Vec3) -> Optics {
    let middle = CameraPose::of(camera);
    let end = |share: f32| CameraPose {
        position: middle.position + middle.rotation * (by * share),
        rotation: middle.rotation * Quat::from_scaled_axis(turn * share),
    };
    Optics {
        lens: None,
        shutter: Some(Shutter {
            opens: end(-1.0),
            middle,
            closes: end(1.0),
        }),
    }
}

#[test]
fn the_stated_error_holds_at_edges_that_are_blurred() {
    let view = street(SIDE);
    let moving = moving(&view, Vec3::X * 0.3, Vec3::Z * 0.03);
    let both = Optics {
        lens: through(0.03, 1.5).lens,
        ..moving
    };
    for optics in [through(0.1, 1.5), both] {
        check_stated_error(optics);
    }
}

fn check_stated_error(optics: Optics) {
    let ball = icosphere(Vec3::new(0.0, 0.5, 0.0), 0.5, 4);
    let scene = scene(ball, matte(Vec3::splat(0.7)), street(SIDE), ground());
    let photo = LinearImage(Raster::filled(
        SIDE as usize,
        SIDE as usize,
        Vec3::splat(0.5),
    ));
    let light = sky(0.4);
    let with = |stop, seed, denoise| {
        let settings = Settings {
            seed,
            stop,
            denoise,
            optics,
            background: Some(&photo),
            transfer: Transfer::Srgb,
            ..Settings::default()
        };
        let simulation = everything(2);
        let renderer = Renderer::new(&scene);
        renderer
            .render(&light, &simulation, &settings, &mut carry_on)
            .expect("renders")
    };
    let shown = |film: &Film| -> Vec<f32> {
        let pixels = photo.0.pixels().iter().enumerate();
        let shown = pixels.map(|(i, b)| {
            let (o, a, s) = (
                film.object.pixels()[i],
                film.alpha.pixels()[i],
                film.shadow.pixels()[i],
            );
            Transfer::Srgb.encode_scalar((*b * s * (1.0 - a) + o).y)
        });
        shown.collect()
    };
    let truth = shown(&with(Stop::Samples(2048), 1, false).film);
    let error = |rendered: &Rendered| {
        let found = shown(&rendered.film);
        let touched = (0..truth.len()).filter(|&i| {
            rendered.film.alpha.pixels()[i] > 0.0
                || (rendered.film.shadow.pixels()[i].y - 1.0).abs() > 0.01
        });
        let squares: Vec<f32> = touched.map(|i| (found[i] - truth[i]).powi(2)).collect();
        f64::from(squares.iter().sum::<f32>() / squares.len() as f32).sqrt()
    };
    for denoise in [false, true] {
        let rendered = with(Stop::TargetError(0.008), 2, denoise);
        // Some thousand pixels know the error to a few per cent; the bound is one of 95%.
        let error = error(&rendered);
        assert!(
            error < 1.1 * rendered.error.upper_95,
            "{optics:?} {denoise}: {error} {:?}",
            rendered.error
        );
    }
    // Edges are filtered as well: otherwise their noise would stay.
    let [drawn, filtered] = [false, true].map(|denoise| {
        let rendered = with(Stop::Samples(8), 3, denoise);
        error(&rendered)
    });
    assert!(filtered < 0.6 * drawn, "{optics:?}: {filtered} {drawn}");
}

#[test]
fn polished_ground_mirrors_as_much_light_where_it_is_blurred() {
    let ball = icosphere(Vec3::new(0.0, 0.9, 0.0), 0.15, 4);
    let view = street(SIDE);
    let scene = scene(ball, glowing(), view, ground());
    let sum = |optics| {
        let settings = Settings {
            optics,
            gloss: Some(Gloss {
                roughness: 0.0,
                reflectance: 0.5,
            }),
            ..settings(MIRRORED, 3)
        };
        let rendered = render(&scene, &sky(0.0), &everything(1), &settings);
        let mirrored = rendered.film.mirrored.expect("is polished");
        mirrored.pixels().iter().map(|v| v.x).sum::<f32>()
    };
    let sharp = sum(Optics::default());
    // Four deviations of the number of paths that meet the ball; each brings light of at most 1.
    let hits = sharp * (MIRRORED * REPLICATES as u32) as f32;
    let noise = 4.0 / hits.sqrt();
    // A camera .2 metres aside is 1/800 farther from the ball four metres away, which looks 1/400 smaller.
    let across = moving(&view, Vec3::X * 0.2, Vec3::ZERO);
    for (optics, change) in [(through(0.06, 2.0), 0.0), (across, 1.0 / 400.0)] {
        let soft = sum(optics);
        assert!(
            (soft / sharp - 1.0).abs() < noise + change,
            "{sharp} {soft}"
        );
    }
}

#[test]
fn pictures_stay_finite_where_optics_and_scene_are_extreme() {
    let view = street(SIDE);
    let ball = |center: Vec3, radius: f32| icosphere(center, radius, 2);
    let from = view.position;
    let ahead = |far: f32| from - view.rotation.z_axis * far;
    let offset = Vec3::splat(1e6);
    let cases = [
        ("an object that encloses the camera", ball(from, 2.0), view),
        ("an object across the lens", ball(from, 0.05), view),
        ("a way through the object", ball(ahead(0.5), 0.3), view),
        ("an object behind the camera", ball(ahead(-2.0), 0.5), view),
        (
            "an object that the ground cuts",
            ball(Vec3::ZERO, 0.5),
            view,
        ),
        (
            "a camera in the plane",
            ball(Vec3::Y * 0.3, 0.3),
            camera(Vec3::Z * 3.0, Vec3::ZERO, 40.0, 16),
        ),
        (
            "a picture of one pixel",
            ball(Vec3::Y * 0.4, 0.4),
            view.scaled([1, 1]),
        ),
        (
            "a scene far from the origin",
            ball(offset + Vec3::Y, 1.0),
            camera(offset + Vec3::new(0.0, 1.0, 8.0), offset, 40.0, 16),
        ),
    ];
    for (name, mesh, view) in cases {
        let view = view.scaled(view.resolution.map(|n| n.min(16)));
        let scene = scene(mesh, glowing(), view, ground());
        for radius in [1e-6, 0.1, 10.0] {
            for focus in [1e-3, 3.0, 1e5] {
                check_finite(&scene, through(radius, focus), name);
            }
        }
        for by in [1e-6, 1.0, 1e4] {
            for turn in [0.0, 1.5, 3.2] {
                let optics = moving(&view, Vec3::NEG_Z * by, Vec3::Y * turn);
                check_finite(&scene, optics, name);
            }
        }
    }
}

fn check_finite(scene: &Scene, optics: Optics, name: &str) {
    let settings = Settings {
        optics,
        denoise: true,
        ..settings(4, 1)
    };
    // Without light a shadow's ratio is one of nothing to nothing.
    for radiance in [1.0, 0.0] {
        let film = render(scene, &sky(radiance), &everything(2), &settings).film;
        let finite = |r: &Raster<Vec3>| r.pixels().iter().all(|v| v.is_finite());
        let case = format!("{name}, {radiance}, {optics:?}");
        assert!(finite(&film.object) && finite(&film.shadow), "{case}");
        let covers = |a: &f32| (0.0..=1.0 + 1e-6).contains(a);
        assert!(film.alpha.pixels().iter().all(covers), "{case}");
    }
}

#[test]
fn shadows_are_averaged_over_what_each_pixel_sees_of_the_ground() {
    let view = street(SIDE);
    let light = sun(Vec3::new(0.5, 1.0, 0.3).normalize(), 4e3, 0.3, 128);
    let light = EnvironmentSampler::new(light);
    // Above the ground, and on it: what the ball hides is in its shadow then, and what is beside it in the sun.
    for height in [0.5, 0.34] {
        let ball = icosphere(Vec3::new(0.0, height, 0.0), 0.35, 4);
        let scene = scene(ball, matte(Vec3::splat(0.5)), view, ground());
        let shadow = |optics| {
            let settings = Settings {
                optics,
                ..settings(256, 5)
            };
            render(&scene, &light, &everything(1), &settings)
                .film
                .shadow
        };
        let sharp = shadow(Optics::default());
        let ratio_at = |p: Vec2| {
            let last = Vec2::splat(SIDE as f32 - 1.0);
            let [x, y] = p.floor().clamp(Vec2::ZERO, last).to_array();
            sharp.get(x as usize, y as usize).x
        };
        let renderer = Renderer::new(&scene);
        let world = renderer.world(0).unwrap();
        let lens = through(0.06, 1.2);
        let along = moving(&view, Vec3::X * 0.15, Vec3::ZERO);
        let into = moving(&view, Vec3::Z * -0.3, Vec3::ZERO);
        let turning = moving(&view, Vec3::ZERO, Vec3::new(0.02, 0.04, 0.08));
        let all = moving(
            &view,
            Vec3::new(0.1, 0.04, 0.1),
            Vec3::new(-0.02, 0.05, 0.03),
        );
        for optics in [lens, along, into, turning, all] {
            let soft = shadow(optics);
            let (mut most, mut changed) = (0f32, 0f32);
            for i in 0..(SIDE * SIDE) as usize {
                let (x, y) = (i % SIDE as usize, i / SIDE as usize);
                let corner = Vec2::new(x as f32, y as f32);
                // What of the ground is seen beside the ball, and its ratio, looked up where the pinhole sees it.
                let (mut seen, mut sum, mut is_whole) = (0.0, 0.0, true);
                for k in 0..512 {
                    let mut sampler = Sampler::new(7, Stream::TEST, 0, k);
                    let place = corner + sampler.next_2d();
                    let ray = optics.ray(&view, place, &mut sampler);
                    if world.closest::<0>(&ray, 0).is_some() {
                        continue;
                    }
                    let ahead = -ray.origin.y / ray.direction.y;
                    match view.project(ray.origin + ray.direction * ahead) {
                        Some(p) if ahead > 0.0 => {
                            is_whole &= p.min_element() >= 0.0 && p.max_element() <= SIDE as f32;
                            seen += 1.0 / 512.0;
                            sum += ratio_at(p) / 512.0;
                        }
                        _ => is_whole = false,
                    }
                }
                // Beside the picture nothing is known.
                if is_whole {
                    let off = (sum - seen * soft.get(x, y).x).abs();
                    most = most.max(off);
                    changed = changed.max((sharp.get(x, y).x - soft.get(x, y).x).abs());
                }
            }
            // A ratio is looked up as that of a whole pixel, up to half a pixel off: of an edge by .8 over lines and discs of
            // eight pixels that is .05.
            assert!(most < 0.05 && changed > 0.1, "{height} {most} {changed}");
        }
    }
}
