use dipir_light::environment::EnvironmentSampler;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;

use super::*;
use crate::features::ALL;
use crate::shapes::{append, cuboid, icosphere};
use crate::surface::Surfaces;
use crate::testing::{camera, everything, matte, scene, sky, sun};
use crate::world::World;

/// A glossy ball that glows beside a box of half metal: they light each other.
fn pair(roughness: f32) -> Scene {
    let mut mesh = icosphere(Vec3::new(-0.6, 0.0, 0.0), 0.7, 2);
    mesh.normals.clear();
    append(
        &mut mesh,
        cuboid(Vec3::new(0.1, -0.8, -0.6), Vec3::new(1.2, 0.7, 0.5)),
        1,
    );
    let mut ball = matte(Vec3::new(0.7, 0.5, 0.3));
    // Inside its range: beyond an end, values are clamped.
    (ball.metallic, ball.roughness) = (0.2, roughness);
    ball.emissive = Vec3::new(0.2, 0.1, 0.3);
    let mut brick = matte(Vec3::new(0.3, 0.6, 0.8));
    (brick.metallic, brick.roughness) = (0.6, roughness);
    let view = camera(Vec3::new(0.0, 0.8, 4.0), Vec3::ZERO, 36.0, 10);
    let mut s = scene(mesh, ball, view, Proxy::None);
    s.materials.push(brick);
    s
}

fn light() -> EnvironmentSampler {
    EnvironmentSampler::new(sun(Vec3::new(0.5, 0.7, 0.6).normalize(), 300.0, 0.4, 16))
}

/// Some derivative of some loss: every pixel and channel counts, with either sign.
fn picture_gradient() -> Raster<Vec3> {
    let at = |k: usize| {
        let k = k as f32;
        Vec3::new((1.3 * k).sin(), 0.5 + (0.7 * k).cos(), (0.4 * k).sin())
    };
    Raster::from_pixels(10, 10, (0..100).map(at).collect())
}

/// What can be changed of a material.
const PARAMETERS: [&str; 6] = [
    "base colour, red",
    "base colour, blue",
    "metallic",
    "roughness",
    "emissive, green",
    "base colour, green",
];

fn change(scene: &Scene, material: usize, parameter: usize, by: f32) -> Scene {
    let mut moved = scene.clone();
    let m = &mut moved.materials[material];
    match parameter {
        0 => m.base_color.x += by,
        1 => m.base_color.z += by,
        2 => m.metallic += by,
        3 => m.roughness += by,
        4 => m.emissive.y += by,
        _ => m.base_color.y += by,
    }
    moved
}

fn derivative(g: &MaterialGradient, parameter: usize) -> f64 {
    match parameter {
        0 => g.base_color.x,
        1 => g.base_color.z,
        2 => g.metallic,
        3 => g.roughness,
        4 => g.emissive.y,
        _ => g.base_color.y,
    }
}

/// Evaluates the paths of one set of materials with the values of another, `values`.
struct FixedPath<'a> {
    values: &'a Surfaces<'a>,
    throughput: DVec3,
    lit: Option<DVec3>,
    sum: DVec3,
}

impl FixedPath<'_> {
    fn bsdf<const F: u32>(&self, vertex: &Vertex) -> Bsdf<F> {
        let hit = vertex.hit;
        let surface = self
            .values
            .interact::<F>(vertex.direction, hit.triangle, hit.u, hit.v);
        Bsdf::new(&surface, -vertex.direction)
    }
}

impl Gather for FixedPath<'_> {
    const DERIVATIVES: bool = true;

    fn distant(&mut self, _: Vec3, _: Vec3, radiance: Vec3, weight: f32) {
        let throughput = self.lit.take().unwrap_or(self.throughput);
        self.sum += throughput * (radiance * weight).as_dvec3();
    }

    fn local(&mut self, _: Vec3) {
        unreachable!("no photograph here");
    }

    fn emitted<const F: u32>(&mut self, vertex: &Vertex, _: Vec3) {
        let hit = vertex.hit;
        let surface = self
            .values
            .interact::<F>(vertex.direction, hit.triangle, hit.u, hit.v);
        self.sum += self.throughput * surface.emission.as_dvec3();
    }

    fn lit<const F: u32>(&mut self, _: &Bsdf<F>, vertex: &Vertex, _: Vec3, wi: Vec3, _: Vec3) {
        let value = self.bsdf::<F>(vertex).eval(wi);
        self.lit = Some(self.throughput * value.as_dvec3());
    }

    fn scattered<const F: u32>(
        &mut self,
        _: &Bsdf<F>,
        vertex: &Vertex,
        _: Vec3,
        _: f32,
        sample: &BsdfSample,
    ) {
        let value = self.bsdf::<F>(vertex).eval(sample.wi);
        self.throughput *= value.as_dvec3() / f64::from(sample.pdf);
    }

    fn survived(&mut self, scale: f32) {
        self.throughput *= f64::from(scale);
    }
}

/// `sum of gradient . object` along the paths of `drawn`, with the materials of `values`.
fn at_fixed_paths(drawn: &World, values: &World, samples: u32, depth: u32) -> f64 {
    let sampler = light();
    let on_object = sampler.on_object();
    let path = PathContext {
        world: drawn,
        light: &on_object,
        photo: None,
        max_depth: depth,
        start: PathStart::Camera,
        roulette_depth: 2,
    };
    let gradient = picture_gradient();
    let mut counts = RayCounts::default();
    let mut total = 0.0;
    for y in 0..10 {
        for x in 0..10 {
            let mut gather = FixedPath {
                values: &values.surfaces,
                throughput: DVec3::ONE,
                lit: None,
                sum: DVec3::ZERO,
            };
            let base = sequence(3, Stream::FOREGROUND, 0, (x, y));
            for sample in 0..samples {
                gather.throughput = DVec3::ONE;
                gather.lit = None;
                let corner = Vec2::new(x as f32, y as f32);
                let mut numbers = base.with_sample(sample);
                path.camera_trace::<ALL, _>(corner, &mut numbers, &mut counts, &mut gather);
            }
            let weight = gradient.get(x as usize, y as usize).as_dvec3();
            total += gather.sum.dot(weight) / f64::from(samples);
        }
    }
    total
}

#[test]
fn the_gradient_of_a_whole_render_equals_differences_along_the_same_paths() {
    // In the middle of a cell of the energy table's 128, so that steps of up to half of a third
    // of a cell meet no edge of it.
    for roughness in [24.5 / 128.0, 70.5 / 128.0] {
        let base = pair(roughness);
        let renderer = Renderer::new(&base);
        let (samples, depth) = (16, 4);
        let gradient = picture_gradient();
        let world = renderer.world(ALL).unwrap();
        let sampler = light();
        let on_object = sampler.on_object();
        let path = PathContext {
            world: &world,
            light: &on_object,
            photo: None,
            max_depth: depth,
            start: PathStart::Camera,
            roulette_depth: 2,
        };
        let settings = GradientSettings {
            seed: 3,
            samples,
            background: None,
        };
        let pixels: Vec<_> = (0..100).map(|k| (k % 10, k / 10)).collect();
        let found = replay::<_, ALL>(&path, &settings, &gradient, &pixels);
        for material in 0..2 {
            for parameter in 0..PARAMETERS.len() {
                // Five points, whose truncation is negligible. Colours, metalness and emission
                // are left with the rounding of single precision, measured below 4e-5. With the
                // roughness, some paths cross an edge of the table's octaves of cosine over alpha,
                // which differences see in proportion to their step, while rounding grows with its
                // inverse: at this step both together stay below 2e-4.
                let h = if parameter == 3 { 6e-4 } else { 4e-3 };
                let at = |step: f32| {
                    let moved = change(&base, material, parameter, step);
                    let moved = renderer
                        .with_materials_of(&moved)
                        .world(ALL)
                        .map(|w| at_fixed_paths(&world, &w, samples, depth));
                    moved.unwrap()
                };
                let near = at(h) - at(-h);
                let far = at(2.0 * h) - at(-2.0 * h);
                let numeric = (8.0 * near - far) / (12.0 * f64::from(h));
                let analytic = derivative(&found[material], parameter);
                // Where derivatives of both signs cancel, relative to a tenth of the picture.
                let error = (analytic - numeric).abs() / numeric.abs().max(1.0);
                assert!(
                    error < 3e-4,
                    "roughness {roughness}, material {material}, {}: {analytic} for {numeric}, {error:.1e}",
                    PARAMETERS[parameter]
                );
            }
        }
    }
}

/// Mean and standard error.
fn summary(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

#[test]
fn the_gradient_is_unbiased_against_renders_that_sample_the_changed_material() {
    let base = pair(0.4);
    let renderer = Renderer::new(&base);
    let gradient = picture_gradient();
    let simulation = crate::render::Simulation {
        shadow: false,
        ..everything(3)
    };
    let sampler = light();
    let seeds = 8u64;
    let found: Vec<_> = (0..seeds)
        .map(|seed| {
            let settings = GradientSettings {
                seed,
                samples: 16,
                background: None,
            };
            renderer
                .material_gradient(&sampler, &simulation, &settings, &gradient)
                .unwrap()
        })
        .collect();
    let value = |scene: &Scene, seed: u64| {
        let r = renderer
            .with_materials_of(scene)
            .render(
                &sampler,
                &simulation,
                &crate::testing::settings(64, 100 + seed),
                &mut crate::testing::carry_on,
            )
            .unwrap();
        let pixels = r.film.object.pixels().iter().zip(gradient.pixels());
        pixels.map(|(a, g)| f64::from(a.dot(*g))).sum::<f64>()
    };
    for (material, parameter, h) in [(0, 0, 0.1f32), (1, 2, 0.1), (1, 3, 0.05), (0, 4, 0.1)] {
        let numeric: Vec<f64> = (0..seeds)
            .map(|seed| {
                let at = |step| value(&change(&base, material, parameter, step), seed);
                (at(h) - at(-h)) / (2.0 * f64::from(h))
            })
            .collect();
        let analytic: Vec<f64> = found
            .iter()
            .map(|g| derivative(&g[material], parameter))
            .collect();
        let ((a, sa), (n, sn)) = (summary(&analytic), summary(&numeric));
        // Five standard errors, and the truncation of wide steps: h^2 / 6 f''' of order 1e-2.
        let tolerance = 5.0 * sa.hypot(sn) + 0.02 * n.abs();
        assert!(
            (a - n).abs() < tolerance,
            "{}: {a} +- {sa} for {n} +- {sn}",
            PARAMETERS[parameter]
        );
        // The test can fail: what is compared is larger than its tolerance.
        assert!(
            tolerance < n.abs(),
            "{}: {n} +- {tolerance}",
            PARAMETERS[parameter]
        );
    }
}

#[test]
fn the_gradient_has_the_same_bytes_for_any_number_of_threads() {
    let base = pair(0.4);
    let renderer = Renderer::new(&base);
    let settings = GradientSettings {
        seed: 1,
        samples: 2,
        background: None,
    };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| {
            renderer
                .material_gradient(&sky(1.0), &everything(3), &settings, &picture_gradient())
                .unwrap()
        })
    };
    assert_eq!(run(1), run(3));
}
