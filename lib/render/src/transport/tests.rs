//! Replay against path tracing.
use std::ops::ControlFlow;

use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::stats::Running;
use dipir_scene::material::Material;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::{DVec3, Vec3};

mod adjoint;
mod file;

use super::*;
use crate::error::RenderError;
use crate::render::{Renderer, Simulation};
use crate::shapes::{quad, torus_knot};
use crate::testing::{camera, everything, ground, lambertian, matte, render, scene, settings, sun};

const ENVIRONMENT: [usize; 2] = [32, 16];

fn record(scene: &Scene, settings: &RecordSettings) -> Transport {
    Transport::record(&Renderer::new(scene), settings, &mut |_| {
        ControlFlow::Continue(())
    })
    .expect("records")
}

fn small(simulation: Simulation) -> RecordSettings<'static> {
    RecordSettings {
        environment: ENVIRONMENT,
        samples: 16,
        shadow_samples: 16,
        ..RecordSettings::new(simulation)
    }
}

/// A knot on the ground, which shadows itself and the ground.
fn knot(material: Material, proxy: Proxy) -> Scene {
    let view = camera(Vec3::new(0.0, 3.0, 4.0), Vec3::Y * 0.5, 35.0, 12);
    scene(
        torus_knot(Vec3::Y * 0.8, 0.5, 0.2, 48, 8),
        material,
        view,
        proxy,
    )
}

fn sheet() -> Proxy {
    Proxy::Mesh(quad(
        Vec3::new(-20.0, 0.0, 20.0),
        Vec3::X * 40.0,
        Vec3::NEG_Z * 40.0,
    ))
}

fn glossy() -> Material {
    Material {
        roughness: 0.3,
        metallic: 0.5,
        base_color: Vec3::new(0.9, 0.5, 0.2).extend(1.0),
        ..matte(Vec3::ONE)
    }
}

fn mirror() -> Material {
    Material {
        roughness: 0.0,
        metallic: 1.0,
        ..glossy()
    }
}

/// Texels between 0 and 1, none equal to another.
fn random_vectors(n: usize, seed: u64) -> Vec<Vec3> {
    (0..n as u32)
        .map(|k| {
            let mut s = Sampler::new(seed, Stream::TEST, k, 0);
            Vec3::new(s.next_1d(), s.next_1d(), s.next_1d())
        })
        .collect()
}

fn dot(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| a.as_dvec3().dot(b.as_dvec3()))
        .sum()
}

fn constant() -> EnvironmentMap {
    EnvironmentMap::constant(ENVIRONMENT[0], ENVIRONMENT[1], Vec3::new(0.5, 1.0, 0.7))
}

/// 0.5 degrees wide at this height of map: a texel of 360 rows.
fn fine_sun() -> EnvironmentMap {
    sun(Vec3::new(0.4, 0.8, 0.5).normalize(), 2e4, 0.3, 360)
}

/// Everything that reaches the ground by way of the object, too.
fn with_light_on_proxy(max_depth: u32) -> Simulation {
    Simulation {
        light_on_proxy: Some(LightOnProxy {
            emission: true,
            bounce: true,
        }),
        ..everything(max_depth)
    }
}

/// Mean over seeds of the sums of both layers over the picture, by replay and by path tracing.
fn replay_and_render(
    material: Material,
    light: &EnvironmentMap,
    proxy: Proxy,
    simulation: Simulation,
    samples: u32,
) -> [[Running; 2]; 2] {
    let scene = knot(material, proxy);
    let sampler = EnvironmentSampler::new(light.clone());
    let mut found = [[Running::default(); 2]; 2];
    for seed in 0..8 {
        let transport = record(
            &scene,
            &RecordSettings {
                environment: [light.width(), light.height()],
                precision: Precision::Single,
                light: Some(light),
                seed,
                samples,
                ..small(simulation)
            },
        );
        let again = settings(samples, 100 + seed);
        let traced = render(&scene, &sampler, &simulation, &again).film;
        let layers = [
            [
                transport.foreground(light.texels()),
                transport.shadow(light.texels()),
            ],
            [traced.object, traced.shadow],
        ];
        for (found, layers) in found.iter_mut().zip(layers) {
            for (found, layer) in found.iter_mut().zip(layers) {
                let sum: DVec3 = layer.pixels().iter().map(|p| p.as_dvec3()).sum();
                found.push(sum.dot(DVec3::new(1.0, 1.1, 0.9)) / layer.pixels().len() as f64);
            }
        }
    }
    found
}

/// Asserts that the means agree within 4.5 standard errors, which `least` bounds from above so
/// that the test can fail: one of twenty comparisons would exceed that by chance in 7000 sets of
/// seeds, and the seeds are fixed.
fn assert_agree(name: &str, [replayed, traced]: [Running; 2], largest_error: f64) {
    let error = replayed.std_error().hypot(traced.std_error());
    let difference = (replayed.mean() - traced.mean()).abs();
    let mean = traced.mean();
    // Beside noise: sums of f32, a few ulp.
    assert!(
        difference < 4.5 * error + 1e-6 * mean,
        "{name}: {} instead of {mean} +- {error}",
        replayed.mean()
    );
    assert!(
        error < largest_error * mean,
        "{name}: error {error} of {mean}"
    );
}

#[test]
fn replay_is_unbiased_for_matte_glossy_and_mirror_under_a_constant_sky() {
    for (name, material) in [
        ("matte", matte(Vec3::splat(0.8))),
        ("glossy", glossy()),
        ("mirror", mirror()),
    ] {
        let [replayed, traced] =
            replay_and_render(material, &constant(), ground(), everything(3), 16);
        assert_agree(name, [replayed[0], traced[0]], 0.02);
        assert_agree(name, [replayed[1], traced[1]], 0.02);
    }
}

#[test]
fn replay_is_unbiased_for_matte_glossy_and_mirror_under_a_half_degree_sun() {
    // Only chance brings a mirror's paths to the sun: it needs more of them, and its error is larger.
    let cases = [
        ("matte", matte(Vec3::splat(0.8)), 0.02, 16),
        ("glossy", glossy(), 0.03, 16),
        ("mirror", mirror(), 0.2, 256),
    ];
    for (name, material, largest_error, samples) in cases {
        let [replayed, traced] =
            replay_and_render(material, &fine_sun(), ground(), everything(3), samples);
        assert_agree(name, [replayed[0], traced[0]], largest_error);
        assert_agree(name, [replayed[1], traced[1]], 0.02);
    }
}

#[test]
fn a_proxy_mesh_replays_as_it_renders() {
    let [replayed, traced] =
        replay_and_render(matte(Vec3::ONE), &constant(), sheet(), everything(3), 16);
    assert_agree("shadow", [replayed[1], traced[1]], 0.02);
}

#[test]
fn light_that_the_object_sends_to_the_proxy_replays_as_it_renders() {
    let mut material = glossy();
    material.emissive = Vec3::new(0.3, 0.2, 0.1);
    let sunny = sun(Vec3::new(0.4, 0.8, 0.5).normalize(), 50.0, 0.3, 32);
    for (name, proxy, light) in [
        ("plane, constant", ground(), constant()),
        ("plane, sun", ground(), sunny),
        ("mesh, constant", sheet(), constant()),
    ] {
        let mut simulation = with_light_on_proxy(2);
        let [replayed, traced] =
            replay_and_render(material.clone(), &light, proxy.clone(), simulation, 16);
        assert_agree(name, [replayed[1], traced[1]], 0.02);
        // It is there to be seen: more than the error by which the means agree.
        simulation.light_on_proxy = None;
        let [without, _] = replay_and_render(material.clone(), &light, proxy, simulation, 16);
        let error = replayed[1].std_error().hypot(traced[1].std_error());
        let more = replayed[1].mean() - without[1].mean();
        assert!(more > 9.0 * error, "{name}: {more} +- {error}");
    }
}

#[test]
fn emission_and_coverage_need_no_light() {
    let mut material = matte(Vec3::ONE);
    material.emissive = Vec3::new(3.0, 2.0, 1.0);
    let transport = record(&knot(material, ground()), &small(everything(1)));
    let dark = vec![Vec3::ZERO; 512];
    let picture = transport.foreground(&dark);
    assert_eq!(&picture, transport.base());
    let mut lit = 0;
    for (radiance, &coverage) in picture.pixels().iter().zip(transport.coverage().pixels()) {
        // One interaction sees emission where the path begins, and at the end of one bounce.
        assert!(radiance.x >= 3.0 * coverage * (1.0 - 1e-6));
        lit += usize::from(coverage == 1.0);
    }
    assert!(lit > 5, "{lit} pixels are covered");
    // Nothing arrives: nothing is taken.
    assert!(
        transport
            .shadow(&dark)
            .pixels()
            .iter()
            .all(|r| *r == Vec3::ONE)
    );
    let gradient = transport.shadow_vjp(&dark, &transport.shadow(&dark), &random_vectors(144, 1));
    assert!(gradient.iter().all(|g| *g == Vec3::ZERO));
}

/// Transports of all kinds of proxy, with and without light of the object on it, and both precisions.
fn transports() -> Vec<Transport> {
    let mut all = Vec::new();
    for precision in [Precision::Half, Precision::Single] {
        for proxy in [Proxy::None, ground(), sheet()] {
            for simulation in [everything(2), with_light_on_proxy(2)] {
                let mut material = glossy();
                if simulation.light_on_proxy.is_some() {
                    material.emissive = Vec3::new(0.3, 0.2, 0.1);
                }
                let scene = knot(material, proxy.clone());
                let settings = RecordSettings {
                    precision,
                    ..small(simulation)
                };
                all.push(record(&scene, &settings));
            }
        }
    }
    all
}

#[test]
fn one_and_three_threads_give_the_same_bytes() {
    let scene = knot(glossy(), sheet());
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads").install(|| {
            let transport = record(&scene, &small(everything(2)));
            let light = random_vectors(512, 1);
            let ratio = transport.shadow(&light);
            let y = random_vectors(144, 2);
            let file = tempfile::NamedTempFile::new().expect("a file");
            transport.save(file.path()).expect("saves");
            (
                std::fs::read(file.path()).expect("reads"),
                transport.foreground(&light),
                transport.foreground_vjp(&y),
                transport.shadow_vjp(&light, &ratio, &y),
                ratio,
            )
        })
    };
    assert!(run(1) == run(3));
}

#[test]
fn half_precision_differs_by_its_rounding_alone() {
    let scene = knot(glossy(), ground());
    let [half, single] = [Precision::Half, Precision::Single].map(|precision| {
        let settings = RecordSettings {
            precision,
            ..small(everything(2))
        };
        record(&scene, &settings)
    });
    assert_eq!(half.entries(), single.entries());
    assert!(half.bytes().0 < single.bytes().0);
    let light = random_vectors(512, 1);
    let pairs = [
        (half.foreground(&light), single.foreground(&light)),
        (half.shadow(&light), single.shadow(&light)),
    ];
    for (a, b) in pairs {
        for (a, b) in a.pixels().iter().zip(b.pixels()) {
            // Every weight is off by at most 2^-11 of itself, and all are positive.
            assert!(
                (*a - *b).abs().max_element() <= 4.9e-4 * b.max_element().max(1.0),
                "{a} {b}"
            );
        }
    }
}

#[test]
fn effective_samples_are_most_under_a_constant_sky_and_few_under_an_unforeseen_sun() {
    let scene = knot(matte(Vec3::ONE), ground());
    let transport = record(&scene, &small(lambertian(1)));
    let even = constant();
    let unforeseen = sun(Vec3::new(0.4, 0.8, 0.5).normalize(), 1e4, 1.0, 16);
    let sizes = transport.effective_sample_size(even.texels());
    let covered: Vec<f64> = (0..144)
        .filter(|&p| transport.coverage().pixels()[p] == 1.0)
        .map(|p| f64::from(sizes.pixels()[p]))
        .collect();
    // Of 16 paths some are occluded, none counts for much more than another.
    let mean = covered.iter().sum::<f64>() / covered.len() as f64;
    assert!(mean > 8.0 && covered.iter().all(|&n| n < 17.0), "{mean}");
    // Where one path found the sun by chance, the picture hangs on it.
    let mut sunny = Vec::new();
    for seed in 0..6 {
        let chance = record(
            &scene,
            &RecordSettings {
                seed,
                ..small(lambertian(1))
            },
        );
        let picture = chance.foreground(unforeseen.texels());
        let sizes = chance.effective_sample_size(unforeseen.texels());
        let found = picture.pixels().iter().zip(sizes.pixels());
        sunny.extend(
            found
                .filter(|(radiance, _)| radiance.y > 100.0)
                .map(|(_, &n)| n),
        );
    }
    assert!(
        !sunny.is_empty() && sunny.iter().all(|&n| n < 4.5),
        "{sunny:?}"
    );
    // The others lack it, which only the light itself can tell.
    assert!((transport.light_sample_size(even.texels()) - 16.0).abs() < 1e-3);
    assert!(transport.light_sample_size(unforeseen.texels()) < 0.5);
    let prepared = record(
        &scene,
        &RecordSettings {
            light: Some(&unforeseen),
            ..small(lambertian(1))
        },
    );
    assert!(prepared.light_sample_size(unforeseen.texels()) > 12.0);
}

#[test]
fn occluders_hide_object_and_shadow_in_proportion() {
    let scene = knot(matte(Vec3::ONE), ground());
    let mask = Raster::filled(12, 12, 0.25f32);
    let light = random_vectors(512, 1);
    let seen = record(&scene, &small(lambertian(2)));
    let hidden = record(
        &scene,
        &RecordSettings {
            occluders: Some(&mask),
            ..small(lambertian(2))
        },
    );
    let pairs = [
        (seen.foreground(&light), hidden.foreground(&light), 0.0),
        (seen.shadow(&light), hidden.shadow(&light), 1.0),
    ];
    for (all, part, base) in pairs {
        for (a, b) in all.pixels().iter().zip(part.pixels()) {
            let expected = (*a - base) * 0.75 + base;
            // Half precision rounds both.
            assert!((*b - expected).abs().max_element() < 1e-3 * expected.max_element().max(1.0));
        }
    }
}

#[test]
fn sizes_that_do_not_fit_are_refused() {
    let scene = knot(glossy(), ground());
    let refused = |settings: RecordSettings| {
        Transport::record(&Renderer::new(&scene), &settings, &mut |_| {
            ControlFlow::Continue(())
        })
        .map(|_| ())
        .expect_err("is refused")
        .to_string()
    };
    let mut settings = small(lambertian(1));
    settings.environment = [512, 256];
    assert!(refused(settings.clone()).contains("512 x 256"));
    settings.environment = [0, 16];
    assert!(refused(settings.clone()).contains("0 x 16"));
    let mask = Raster::filled(3, 3, 0.0f32);
    settings = small(lambertian(1));
    settings.occluders = Some(&mask);
    assert!(refused(settings).contains("occluder mask"));
}

#[test]
fn recording_can_be_broken_off() {
    let scene = knot(glossy(), ground());
    let stopped = Transport::record(&Renderer::new(&scene), &small(lambertian(1)), &mut |_| {
        ControlFlow::Break(())
    });
    assert!(matches!(stopped, Err(RenderError::Interrupted)));
}

#[test]
fn the_shadow_of_coloured_glass_has_its_colour_where_sent_light_is_recorded_else_its_luminance() {
    let color = Vec3::new(1.0, 0.5, 0.25);
    let mut glass = matte(color);
    glass.roughness = 0.0;
    glass.transmission = Some(dipir_scene::material::Transmission {
        factor: 1.0,
        texture: None,
    });
    // It hides the sky from the ground that is looked at.
    let sheet = quad(
        Vec3::new(-400.0, 2.0, 400.0),
        Vec3::X * 800.0,
        Vec3::NEG_Z * 800.0,
    );
    let view = camera(Vec3::new(0.0, 1.0, 2.0), Vec3::ZERO, 20.0, 4);
    let white = vec![Vec3::ONE; ENVIRONMENT[0] * ENVIRONMENT[1]];
    for proxy in [ground(), self::sheet()] {
        let s = scene(sheet.clone(), glass.clone(), view, proxy);
        let shadow = |light_on_proxy| {
            let simulation = Simulation {
                light_on_proxy,
                ..everything(2)
            };
            let settings = RecordSettings {
                precision: Precision::Single,
                ..small(simulation)
            };
            let ratios = record(&s, &settings).shadow(&white);
            ratios.pixels().iter().sum::<Vec3>() / ratios.pixels().len() as f32
        };
        let coloured = shadow(Some(LightOnProxy {
            emission: true,
            bounce: false,
        }));
        let grey = shadow(None);
        // The same rays pass in every channel. Sums of f32, a few ulp of 1.
        let most = coloured.x;
        assert!((0.7..1.0).contains(&most), "{coloured}");
        assert!(coloured.abs_diff_eq(most * color, 1e-5), "{coloured}");
        let wanted = Vec3::splat(luminance(coloured));
        assert!(grey.abs_diff_eq(wanted, 1e-5), "{grey} {wanted}");
    }
}

/// A sky with a patch of 3 x 3 texels, about 50 degrees high, that begins in `column`.
fn patch(column: usize) -> EnvironmentMap {
    let texels = (0..ENVIRONMENT[0] * ENVIRONMENT[1]).map(|k| {
        let (i, j) = (k / ENVIRONMENT[0], k % ENVIRONMENT[0]);
        match (3..=5).contains(&i) && (column..column + 3).contains(&j) {
            true => Vec3::new(5.0, 4.0, 3.0),
            false => Vec3::new(0.4, 0.5, 0.6),
        }
    });
    EnvironmentMap::new(ENVIRONMENT[0], ENVIRONMENT[1], texels.collect()).expect("a valid map")
}

#[test]
fn a_record_made_without_a_light_or_for_another_one_is_unbiased_too() {
    let (made_for, light) = (patch(4), patch(20));
    let sampler = EnvironmentSampler::new(light.clone());
    let simulation = everything(3);
    // Every pixel with a weight of its own, so that light in the wrong place counts.
    let weights = random_vectors(144, 40);
    for (name, material) in [("matte", matte(Vec3::splat(0.8))), ("glossy", glossy())] {
        let scene = knot(material, ground());
        for prepared in [None, Some(&made_for)] {
            let mut found = [[Running::default(); 2]; 2];
            for seed in 0..8 {
                let transport = record(
                    &scene,
                    &RecordSettings {
                        precision: Precision::Single,
                        light: prepared,
                        seed,
                        samples: 64,
                        shadow_samples: 64,
                        ..small(simulation)
                    },
                );
                let traced = render(&scene, &sampler, &simulation, &settings(64, 100 + seed)).film;
                let layers = [
                    [
                        transport.foreground(light.texels()),
                        transport.shadow(light.texels()),
                    ],
                    [traced.object, traced.shadow],
                ];
                for (found, [object, shadow]) in found.iter_mut().zip(layers) {
                    let lost = shadow.map(|r| Vec3::ONE - *r);
                    found[0].push(dot(object.pixels(), &weights));
                    found[1].push(dot(lost.pixels(), &weights));
                }
            }
            for (k, layer) in ["object", "lost light"].into_iter().enumerate() {
                let name = format!("{name}, {layer}, prepared: {}", prepared.is_some());
                // 50 pixels x 64 paths x 8 seeds, of which one in 20 meets a patch of 10 times
                // the rest: about 1%; a glossy one some times that.
                assert_agree(&name, [found[0][k], found[1][k]], 0.05);
            }
        }
    }
}
