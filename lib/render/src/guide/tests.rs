use dipir_light::environment::EnvironmentSampler;
use dipir_numerics::stats::Running;
use dipir_scene::material::Material;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;
use glam::Vec2;

use super::*;
use crate::features::ALL;
use crate::foreground::PathContext;
use crate::light::SceneLight;
use crate::render::Renderer;
use crate::shapes;
use crate::testing::{camera, everything, sky, sun};

/// Pixels of a side of [`knot`]'s picture.
const SIDE: u32 = 24;

/// A knot of metal, whose folds reflect the sun to each other.
fn knot(roughness: f32) -> Scene {
    let mesh = shapes::torus_knot(Vec3::ZERO, 0.4, 0.13, 200, 24);
    let metal = Material {
        metallic: 1.0,
        roughness,
        ..Material::default()
    };
    let view = camera(Vec3::new(2.0, 1.2, 3.0), Vec3::ZERO, 30.0, SIDE);
    crate::testing::scene(mesh, metal, view, Proxy::None)
}

fn sunny() -> EnvironmentSampler {
    let direction = Vec3::new(0.55, 0.6, 0.35).normalize();
    EnvironmentSampler::new(sun(direction, 6e4, 0.3, 256))
}

fn under(world: &World, light: &EnvironmentSampler, pixels: usize, seed: u64) -> Option<PathGuide> {
    let rays = &mut RayCounts::default();
    PathGuide::new::<_, ALL>(world, &light.on_object(), pixels, seed, rays)
}

/// A guide as for a larger picture.
fn guide(world: &World, seed: u64) -> Option<PathGuide> {
    under(world, &sunny(), 1 << 14, seed)
}

/// The surfaces in the pixels of the picture that have cones, with the directions towards the camera.
fn guided(world: &World, guide: &PathGuide) -> Vec<(SurfacePoint, Vec3, Cones)> {
    let vertex = |pixel: u32| {
        let at = Vec2::new((pixel % SIDE) as f32, (pixel / SIDE) as f32);
        let ray = world.camera().ray(at + 0.5);
        let hit = world.closest::<ALL>(&ray, 0)?;
        let surfaces = &world.surfaces;
        let surface = surfaces.interact::<ALL>(ray.direction, hit.triangle, hit.u, hit.v);
        let wo = -ray.direction;
        let cones = guide.cones(&surface, wo)?;
        Some((surface, wo, cones))
    };
    (0..SIDE * SIDE).filter_map(vertex).collect()
}

#[test]
fn cones_are_drawn_with_their_density() {
    const DIRECTIONS: u32 = 1 << 18;
    const DRAWN: u32 = 1 << 12;
    let scene = knot(0.3);
    let world = Renderer::new(&scene).world(ALL).expect("a world");
    let guide = guide(&world, 1).expect("folds that reflect the sun");
    let vertices = guided(&world, &guide);
    let vertices = vertices.iter().filter(|(_, _, cones)| cones.share > 0.2);
    let mut tried = 0;
    for (_, _, cones) in vertices {
        let (mut integral, mut moment) = (0.0f64, Vec3::ZERO);
        for k in 0..DIRECTIONS {
            let mut draws = Sampler::new(5, Stream::TEST, 0, k);
            let wi = square_to_sphere(draws.next_2d());
            let density = cones.pdf(wi) * (4.0 * PI / DIRECTIONS as f32);
            integral += f64::from(density);
            moment += wi * density;
        }
        // The narrowest cone holds 59 of the directions, and one in eight of them may be at its edge.
        assert!((integral - 1.0).abs() < 0.05, "{integral}");
        let mut mean = Vec3::ZERO;
        for k in 0..DRAWN {
            let mut draws = Sampler::new(6, Stream::TEST, 0, k);
            let u_lobe = draws.next_1d();
            mean += cones.direction(u_lobe, draws.next_2d()) / DRAWN as f32;
        }
        // The same share of a unit vector.
        assert!(mean.distance(moment) < 0.05, "{mean} {moment}");
        tried += 1;
    }
    assert!(tried > 4, "{tried}");
}

#[test]
fn guided_directions_reflect_as_much_of_a_white_sky() {
    const SAMPLES: u32 = 1 << 12;
    let scene = knot(0.3);
    let world = Renderer::new(&scene).world(ALL).expect("a world");
    let guide = guide(&world, 1).expect("folds that reflect the sun");
    let (mut difference, mut variance) = (0.0, 0.0);
    for (pixel, (surface, wo, cones)) in guided(&world, &guide).iter().enumerate() {
        let bsdf = Bsdf::<ALL>::new(surface, *wo);
        let reflected = |draw: &dyn Fn(f32, Vec2) -> Option<BsdfSample>| {
            let mut weights = Running::default();
            for sample in 0..SAMPLES {
                let mut draws = Sampler::new(3, Stream::TEST, pixel as u32, sample);
                let (u_lobe, u) = (draws.next_1d(), draws.next_2d());
                weights.push(f64::from(draw(u_lobe, u).map_or(0.0, |s| s.weight.x)));
            }
            weights
        };
        let with = reflected(&|u_lobe, u| {
            let mut sample = cones.sample(&bsdf, u_lobe, u)?;
            cones.weigh(&mut sample);
            Some(sample)
        });
        let without = reflected(&|u_lobe, u| bsdf.sample(u_lobe, u));
        difference += with.mean() - without.mean();
        variance += with.std_error().powi(2) + without.std_error().powi(2);
    }
    // Standard errors are of independent samples: these are stratified, and closer.
    let bound = 3.0 * f64::sqrt(variance);
    assert!(difference.abs() < bound, "{difference} {bound}");
}

#[test]
fn a_guided_picture_has_the_same_mean_and_less_noise() {
    const SEEDS: u32 = 24;
    const SAMPLES: u32 = 64;
    let scene = knot(0.3);
    let world = Renderer::new(&scene).world(ALL).expect("a world");
    let light = sunny().on_object();
    let guide = guide(&world, 1);
    let plain = PathContext::from_camera(&world, &light, &everything(3), None);
    // Mean of the picture, and noise of its pixels, by seed.
    let render = |guide: Option<&PathGuide>| -> (Running, f64) {
        let path = PathContext { guide, ..plain };
        let pixels = |seed: u32| -> Vec<f64> {
            let pixel = |p: u32| {
                let corner = Vec2::new((p % SIDE) as f32, (p / SIDE) as f32);
                let sum = (0..SAMPLES).map(|s| {
                    let mut draws = Sampler::new(u64::from(seed), Stream::TEST, p, s);
                    let found =
                        path.camera_sample::<ALL>(corner, &mut draws, &mut RayCounts::default());
                    f64::from(luminance(found.radiance))
                });
                sum.sum::<f64>() / f64::from(SAMPLES)
            };
            (0..SIDE * SIDE).map(pixel).collect()
        };
        let pictures: Vec<Vec<f64>> = (0..SEEDS).into_par_iter().map(pixels).collect();
        let mut means = Running::default();
        for picture in &pictures {
            means.push(picture.iter().sum::<f64>() / picture.len() as f64);
        }
        let noise = (0..pictures[0].len()).map(|i| {
            let mut values = Running::default();
            pictures.iter().for_each(|picture| values.push(picture[i]));
            values.variance()
        });
        (means, noise.sum())
    };
    let ((with, noise_with), (without, noise_without)) = (render(guide.as_ref()), render(None));
    // One in 16,000 pairs of pictures differs by more.
    let bound = 4.0 * with.std_error().hypot(without.std_error());
    let [mean_a, mean_b] = [with.mean(), without.mean()];
    assert!((mean_a - mean_b).abs() < bound, "{mean_a} {mean_b} {bound}");
    assert!(
        bound < 0.03 * mean_b,
        "the comparison says something: {bound} of {mean_b}"
    );
    // .52 of it is left; seeds are fixed, so the same each time.
    assert!(
        noise_with < 0.7 * noise_without,
        "{noise_with} {noise_without}"
    );
}

#[test]
fn surfaces_without_narrow_lobes_or_folds_have_no_guide() {
    let rough = knot(0.8);
    let world = Renderer::new(&rough).world(ALL).expect("a world");
    assert!(guide(&world, 1).is_none());
    let smooth = knot(0.0);
    let world = Renderer::new(&smooth).world(ALL).expect("a world");
    assert!(guide(&world, 1).is_none(), "mirrors reflect no cone");
    let ball = Scene {
        mesh: shapes::icosphere(Vec3::ZERO, 1.0, 3),
        ..knot(0.3)
    };
    let world = Renderer::new(&ball).world(ALL).expect("a world");
    assert!(guide(&world, 1).is_none());
    let folded = knot(0.3);
    let world = Renderer::new(&folded).world(ALL).expect("a world");
    assert!(under(&world, &sky(1.0), 1 << 14, 1).is_none());
    assert!(under(&world, &sunny(), LEAST_PIXELS - 1, 1).is_none());
}

#[test]
fn a_cell_keeps_the_flux_of_what_it_thins_out() {
    let arrivals: Vec<Arrival> = (0..1000)
        .map(|k| Arrival {
            cell: 0,
            from: Vec3::splat(k as f32),
            flux: if k == 500 { 1000.0 } else { 1.0 },
        })
        .collect();
    let group = Group::of(&arrivals, 0.5);
    let flux: f32 = group.flux.iter().sum();
    // Sums of a thousand terms.
    assert!((flux / (0.5 * 1999.0) - 1.0).abs() < 1e-4, "{flux}");
    let bright: f32 = (0..MOST)
        .filter(|&i| group.x[i] == 500.0)
        .map(|i| group.flux[i])
        .sum();
    // Systematic draws are off by one step at most.
    assert!(
        (bright - 500.0).abs() <= 0.5 * 1999.0 / MOST as f32,
        "{bright}"
    );
}

#[test]
fn the_guide_is_the_same_for_an_object_of_any_size() {
    let shares = |scale: f32| -> Vec<f32> {
        let mut scene = knot(0.3);
        scene.mesh.positions.iter_mut().for_each(|p| *p *= scale);
        scene.camera.position *= scale;
        let world = Renderer::new(&scene).world(ALL).expect("a world");
        let guide = guide(&world, 1).expect("folds that reflect the sun");
        let vertices = guided(&world, &guide);
        vertices.iter().map(|(_, _, cones)| cones.share).collect()
    };
    // Powers of two change no digit of a product, so the particles are the same.
    let metre = shares(1.0);
    assert!(metre.iter().any(|&share| share > 0.2));
    for exponent in [-30, -10, 10, 30] {
        assert_eq!(shares(2f32.powi(exponent)), metre, "2^{exponent}");
    }
}
