//! Ray casting in rays a second, on one thread, by kind of ray and size of mesh; and builds.
//!
//! `cargo bench -p dipir-scene --bench ray_casting`. Every mesh is first checked against the
//! naive reference, a loop over all triangles in f64, which is timed too, on few rays.
use std::f32::consts::{PI, TAU};
use std::hint::black_box;
use std::sync::LazyLock;

use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::{Frame, square_to_cone, square_to_cosine_hemisphere, square_to_sphere};
use dipir_scene::bvh::Bvh;
use dipir_scene::camera::Ray;
use dipir_scene::mesh::TriangleMesh;
use dipir_scene::ray_offset::spawn_origin;
use divan::{Bencher, counter::ItemsCount};
use glam::Vec3;

fn main() {
    // Run as a test, the check of the smaller mesh is enough.
    let timed = std::env::args().any(|a| a == "--bench");
    SMALL.check();
    if timed {
        LARGE.check();
        divan::main();
    }
}

/// A bumpy ball of 192,200 triangles.
static SMALL: LazyLock<Subject> = LazyLock::new(|| Subject::new(310));
/// One of 980,000.
static LARGE: LazyLock<Subject> = LazyLock::new(|| Subject::new(700));

/// A mesh, its hierarchy and the rays to time.
struct Subject {
    mesh: TriangleMesh,
    bvh: Bvh,
    primary: Vec<Ray>,
    incoherent: Vec<Ray>,
    diffuse: Vec<Ray>,
    sun: Vec<Ray>,
    ground: Vec<Ray>,
}

/// A ball with `rows` rows and columns of quads, six octaves of bumps on it.
fn bumpy_ball(rows: u32) -> TriangleMesh {
    let bumps = |p: Vec3| {
        (0..6).fold(0.0, |sum, octave| {
            let scale = 2f32.powi(octave);
            let q = p * 3.0 * scale + Vec3::new(1.3 * octave as f32, 0.7, 2.1);
            let waves = q.x.sin() * q.y.cos() + q.y.sin() * q.z.cos() + q.z.sin() * q.x.cos();
            sum + 0.12 * waves / scale
        })
    };
    let mut mesh = TriangleMesh::default();
    for i in 0..=rows {
        for j in 0..rows {
            let (st, ct) = (PI * i as f32 / rows as f32).sin_cos();
            let (sp, cp) = (TAU * j as f32 / rows as f32).sin_cos();
            let p = Vec3::new(st * cp, ct, -st * sp);
            mesh.positions.push(p * (1.0 + bumps(p)));
        }
    }
    let at = |i: u32, j: u32| i * rows + j % rows;
    for i in 0..rows {
        for j in 0..rows {
            let (below, beside) = (at(i + 1, j), at(i, j + 1));
            let across = at(i + 1, j + 1);
            mesh.indices.push([at(i, j), below, across]);
            mesh.indices.push([at(i, j), across, beside]);
        }
    }
    mesh
}

fn any(_: u32, _: f32, _: f32) -> bool {
    true
}

impl Subject {
    fn new(rows: u32) -> Self {
        let mesh = bumpy_ball(rows);
        let bvh = Bvh::build(&mesh);
        let primary = primary_rays();
        let (mut diffuse, mut sun) = (Vec::new(), Vec::new());
        let sun_frame = Frame::from_normal(Vec3::new(0.5, 0.8, 0.4).normalize());
        for (k, ray) in primary.iter().enumerate() {
            let Some(hit) = bvh.closest(ray, f32::INFINITY, any) else {
                continue;
            };
            let point = bvh.surface_point(&mesh, &hit);
            let normal = point.geometric_normal;
            let mut numbers = Sampler::new(1, Stream::TEST, k as u32, 0);
            let leave = |direction: Vec3, rays: &mut Vec<Ray>| {
                if direction.dot(normal) > 0.0 {
                    let origin = spawn_origin(point.position, normal, direction, point.error);
                    rays.push(Ray { origin, direction });
                }
            };
            let up = square_to_cosine_hemisphere(numbers.next_2d());
            leave(Frame::from_normal(normal).to_world(up), &mut diffuse);
            let to_sun = square_to_cone(numbers.next_2d(), 0.995);
            leave(sun_frame.to_world(to_sun), &mut sun);
        }
        Self {
            mesh,
            bvh,
            primary,
            incoherent: incoherent_rays(),
            diffuse,
            sun,
            ground: ground_rays(),
        }
    }

    /// Distance of the nearest triangle, by a loop over all [Möller, Trumbore 1997].
    fn naive(&self, ray: &Ray) -> Option<f64> {
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let mut nearest: Option<f64> = None;
        for triangle in &self.mesh.indices {
            let [a, b, c] = triangle.map(|i| self.mesh.positions[i as usize].as_dvec3());
            let (e1, e2, s) = (b - a, c - a, o - a);
            let p = d.cross(e2);
            let det = e1.dot(p);
            let (u, q) = (s.dot(p) / det, s.cross(e1));
            let v = d.dot(q) / det;
            let t = e2.dot(q) / det;
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 {
                nearest = Some(nearest.map_or(t, |n| n.min(t)));
            }
        }
        nearest
    }

    /// Compares with the naive reference, on a few rays of each kind.
    fn check(&self) {
        for rays in [
            &self.primary,
            &self.incoherent,
            &self.diffuse,
            &self.sun,
            &self.ground,
        ] {
            for ray in rays.iter().step_by(rays.len() / 20) {
                let expected = self.naive(ray);
                let found = self
                    .bvh
                    .closest(ray, f32::INFINITY, any)
                    .map(|h| h.t as f64);
                let agrees = match (expected, found) {
                    // 1e-4: far above rounding, far below the size of a triangle.
                    (Some(a), Some(b)) => (a - b).abs() < 1e-4,
                    (a, b) => a.is_some() == b.is_some(),
                };
                assert!(agrees, "{ray:?}: {found:?} instead of {expected:?}");
                let occluded = self.bvh.occluded(ray, f32::INFINITY, any);
                assert_eq!(occluded, expected.is_some(), "{ray:?}");
            }
        }
    }
}

/// One ray a pixel of a square image that the ball half fills.
fn primary_rays() -> Vec<Ray> {
    const SIDE: u32 = 512;
    let pixel = |k: u32| {
        let (x, y) = ((k % SIDE) as f32 + 0.5, (k / SIDE) as f32 + 0.5);
        Vec3::new(x / SIDE as f32 - 0.5, 0.5 - y / SIDE as f32, -1.0)
    };
    (0..SIDE * SIDE)
        .map(|k| Ray {
            origin: Vec3::new(0.1, 0.2, 3.0),
            direction: pixel(k).normalize(),
        })
        .collect()
}

/// From anywhere around the ball to anywhere in it.
fn incoherent_rays() -> Vec<Ray> {
    (0..200_000)
        .map(|k| {
            let mut numbers = Sampler::new(2, Stream::TEST, k, 0);
            let origin = square_to_sphere(numbers.next_2d()) * 1.5;
            let target = square_to_sphere(numbers.next_2d()) * numbers.next_1d().cbrt() * 1.2;
            Ray {
                origin,
                direction: (target - origin).normalize(),
            }
        })
        .collect()
}

/// From points on the ground, 16 each, into the cone around the ball: the shadow ratio's.
fn ground_rays() -> Vec<Ray> {
    (0..100 * 100)
        .flat_map(|k| {
            let at = |i: u32| 4.0 * (i as f32 / 100.0 - 0.5);
            let origin = Vec3::new(at(k % 100), -1.3, at(k / 100));
            let cos_max = (1.0 - 1.69 / origin.length_squared()).max(0.0).sqrt();
            let frame = Frame::from_normal(-origin.normalize());
            (0..16).map(move |sample| {
                let mut numbers = Sampler::new(3, Stream::TEST, k, sample);
                let direction = frame.to_world(square_to_cone(numbers.next_2d(), cos_max));
                Ray { origin, direction }
            })
        })
        .collect()
}

fn time_closest(bencher: Bencher, subject: &Subject, rays: &[Ray]) {
    let counter = ItemsCount::new(rays.len());
    bencher.counter(counter).bench_local(|| {
        for ray in rays {
            black_box(subject.bvh.closest(ray, f32::INFINITY, any));
        }
    });
}

fn time_occluded(bencher: Bencher, subject: &Subject, rays: &[Ray]) {
    let counter = ItemsCount::new(rays.len());
    bencher.counter(counter).bench_local(|| {
        for ray in rays {
            black_box(subject.bvh.occluded(ray, f32::INFINITY, any));
        }
    });
}

macro_rules! mesh_benches {
    ($name:ident, $subject:ident) => {
        #[divan::bench_group(sample_count = 10, sample_size = 1)]
        mod $name {
            use super::*;

            #[divan::bench]
            fn closest_primary(bencher: Bencher) {
                time_closest(bencher, &$subject, &$subject.primary);
            }
            #[divan::bench]
            fn closest_incoherent(bencher: Bencher) {
                time_closest(bencher, &$subject, &$subject.incoherent);
            }
            #[divan::bench]
            fn closest_diffuse(bencher: Bencher) {
                time_closest(bencher, &$subject, &$subject.diffuse);
            }
            #[divan::bench]
            fn occluded_sun(bencher: Bencher) {
                time_occluded(bencher, &$subject, &$subject.sun);
            }
            #[divan::bench]
            fn occluded_diffuse(bencher: Bencher) {
                time_occluded(bencher, &$subject, &$subject.diffuse);
            }
            #[divan::bench]
            fn occluded_ground(bencher: Bencher) {
                time_occluded(bencher, &$subject, &$subject.ground);
            }
            #[divan::bench]
            fn naive_primary(bencher: Bencher) {
                let rays = &$subject.primary[100_000..100_010];
                bencher
                    .counter(ItemsCount::new(rays.len()))
                    .bench_local(|| {
                        for ray in rays {
                            black_box($subject.naive(ray));
                        }
                    });
            }
            /// Items are triangles; all threads.
            #[divan::bench(sample_count = 3)]
            fn build(bencher: Bencher) {
                bencher
                    .counter(ItemsCount::new($subject.mesh.indices.len()))
                    .bench_local(|| Bvh::build(&$subject.mesh));
            }
        }
    };
}

mesh_benches!(ball_of_192_thousand, SMALL);
mesh_benches!(ball_of_980_thousand, LARGE);

/// One triangle: what a ray costs when there is next to nothing to find.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn one_triangle(bencher: Bencher) {
    let mesh = TriangleMesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
        indices: vec![[0, 1, 2]],
        ..Default::default()
    };
    let bvh = Bvh::build(&mesh);
    let rays = primary_rays();
    bencher
        .counter(ItemsCount::new(rays.len()))
        .bench_local(|| {
            for ray in &rays {
                black_box(bvh.closest(ray, f32::INFINITY, any));
            }
        });
}
