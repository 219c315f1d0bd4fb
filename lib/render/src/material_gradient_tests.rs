use dipir_light::environment::EnvironmentSampler;
use dipir_scene::proxy::Proxy;
use dipir_scene::scene::Scene;

use super::*;
use crate::bsdf::reference::Reference;
use crate::features::ALL;
use crate::shapes::{append, cuboid, icosphere};
use crate::testing::{camera, everything, matte, scene, sky, sun};

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

/// A parameter of a material, moved.
#[derive(Clone, Copy)]
struct Moved {
    material: usize,
    parameter: usize,
    by: f64,
}

/// Evaluates paths in f64, all that they meet by the equations, with one parameter moved.
struct FixedPath {
    moved: Moved,
    throughput: DVec3,
    lit: Option<DVec3>,
    sum: DVec3,
}

impl FixedPath {
    /// How far `parameter` is moved at `vertex`.
    fn step(&self, vertex: &Vertex, parameter: usize) -> f64 {
        let material = vertex.surfaces.material_index(vertex.hit.triangle) as usize;
        match (material, parameter) == (self.moved.material, self.moved.parameter) {
            true => self.moved.by,
            false => 0.0,
        }
    }

    fn eval(&self, vertex: &Vertex, wi: Vec3) -> DVec3 {
        let surface = vertex.surface;
        if wi.dot(surface.geometric_normal) <= 0.0 {
            return DVec3::ZERO;
        }
        let normal = surface.normal.as_dvec3().normalize();
        let tangent = normal.any_orthonormal_vector();
        let local = |w: DVec3| {
            let w = w.normalize();
            DVec3::new(w.dot(tangent), w.dot(normal.cross(tangent)), w.dot(normal))
        };
        let (wo, wi) = (local(-vertex.direction.as_dvec3()), local(wi.as_dvec3()));
        let channel = |color: f32, parameter: usize| {
            let reference = Reference {
                color: f64::from(color) + self.step(vertex, parameter),
                metallic: f64::from(surface.metallic) + self.step(vertex, 2),
                roughness: f64::from(surface.roughness) + self.step(vertex, 3),
                passing: 0.0,
                coat: None,
                glossy: true,
            };
            reference.eval(wo, wi)
        };
        let color = surface.base_color;
        DVec3::new(
            channel(color.x, 0),
            channel(color.y, 5),
            channel(color.z, 1),
        )
    }
}

impl Gather for FixedPath {
    const DERIVATIVES: bool = true;

    fn distant(&mut self, _: Vec3, _: Vec3, radiance: Vec3, weight: f32) {
        let throughput = self.lit.take().unwrap_or(self.throughput);
        self.sum += throughput * radiance.as_dvec3() * f64::from(weight);
    }

    fn local(&mut self, _: Vec3) {
        unreachable!("no photograph here");
    }

    fn emitted<const F: u32>(&mut self, vertex: &Vertex, _: Vec3) {
        let moved = DVec3::Y * self.step(vertex, 4);
        self.sum += self.throughput * (vertex.surface.emission.as_dvec3() + moved);
    }

    fn lit<const F: u32>(&mut self, _: &Bsdf<F>, vertex: &Vertex, _: Vec3, wi: Vec3, _: Vec3) {
        self.lit = Some(self.throughput * self.eval(vertex, wi));
    }

    fn scattered<const F: u32>(
        &mut self,
        _: &Bsdf<F>,
        vertex: &Vertex,
        _: Vec3,
        _: f32,
        sample: &BsdfSample,
    ) {
        self.throughput *= self.eval(vertex, sample.wi) / f64::from(sample.pdf);
    }

    fn survived(&mut self, scale: f32) {
        self.throughput *= f64::from(scale);
    }
}

/// `sum of gradient . object` along the paths of `path`, in f64, with a parameter moved.
fn at_fixed_paths<L: PathLight>(path: &PathContext<L>, samples: u32, moved: Moved) -> f64 {
    let gradient = picture_gradient();
    let mut counts = RayCounts::default();
    let mut total = 0.0;
    for y in 0..10 {
        for x in 0..10 {
            let mut gather = FixedPath {
                moved,
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
fn the_gradient_of_a_whole_render_equals_differences_in_f64_along_the_same_paths() {
    for roughness in [0.19, 0.4, 0.55] {
        let base = pair(roughness);
        let renderer = Renderer::new(&base);
        let samples = 16;
        let gradient = picture_gradient();
        let world = renderer.world(ALL).unwrap();
        let sampler = light();
        let on_object = sampler.on_object();
        let path = PathContext {
            roulette_depth: 2,
            ..PathContext::from_camera(&world, &on_object, &everything(4), None)
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
                // Truncation is h^2 / 6 of the third derivative, for roughness of the order of
                // its cube: 1e-8 at the least roughness here. Rounding is 1e-16 of 1e2 over h,
                // 1e-8. A share of some h of all vertices cross an edge of the energy table, each
                // with a slope that jumps by a few per cent: 1e-7.
                let h = 1e-6;
                let at = |by| {
                    at_fixed_paths(
                        &path,
                        samples,
                        Moved {
                            material,
                            parameter,
                            by,
                        },
                    )
                };
                let numeric = (at(h) - at(-h)) / (2.0 * h);
                let analytic = derivative(&found[material], parameter);
                // What is left is the rounding of single precision on the way, 6e-8 for each of some
                // twenty operations a vertex, in terms of both signs: 4e-6 at most was measured.
                // Where they cancel, relative to a tenth of the picture.
                let error = (analytic - numeric).abs() / numeric.abs().max(1.0);
                assert!(
                    error < 1e-5,
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
fn the_gradient_of_emission_is_that_of_what_passes_the_coat() {
    let mut s = pair(0.4);
    s.materials[0].clearcoat = Some(dipir_scene::material::Clearcoat {
        factor: 1.0,
        factor_texture: None,
        roughness: 0.3,
        roughness_texture: None,
        normal_texture: None,
    });
    let renderer = Renderer::new(&s);
    let gradient = picture_gradient();
    let settings = GradientSettings {
        seed: 3,
        samples: 16,
        background: None,
    };
    let dark = crate::testing::sky(0.0);
    let found = renderer
        .material_gradient(&dark, &everything(1), &settings, &gradient)
        .expect("has the camera's size");
    // The picture is linear in the emission, and nothing else shines.
    let world = renderer.world(ALL).expect("no textures");
    let light = dark.on_object();
    let path = PathContext::from_camera(&world, &light, &everything(1), None);
    let mut sum = DVec3::ZERO;
    for (k, weight) in gradient.pixels().iter().enumerate() {
        let (x, y) = (k as u32 % 10, k as u32 / 10);
        let base = sequence(settings.seed, Stream::FOREGROUND, 0, (x, y));
        for sample in 0..settings.samples {
            let corner = Vec2::new(x as f32, y as f32);
            let mut counts = RayCounts::default();
            let mut sampler = base.with_sample(sample);
            let seen = path.camera_sample::<ALL>(corner, &mut sampler, &mut counts);
            sum += (*weight * seen.radiance).as_dvec3() / f64::from(settings.samples);
        }
    }
    let of_emission = found[0].emissive * s.materials[0].emissive.as_dvec3();
    // Sums of 1600 numbers of single precision.
    let error = (of_emission - sum).abs().max_element();
    assert!(error < 1e-4 && sum.length() > 1.0, "{of_emission} {sum}");
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
