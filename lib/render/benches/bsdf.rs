//! Time of one scattering decision, by lobe: prepare for `wo`, evaluate for the light, draw.
//! Run with `cargo bench -p dipir-render --bench bsdf`; items are points on surfaces.
use std::hint::black_box;

use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::warp::square_to_cosine_hemisphere;
use dipir_render::bsdf::Bsdf;
use dipir_render::bsdf::features::{ALL, SPECULAR};
use dipir_render::surface::{CoatPoint, SurfacePoint};
use divan::{Bencher, counter::ItemsCount};
use glam::{Vec2, Vec3};

fn main() {
    divan::main();
}

/// Points a timed call.
const POINTS: u32 = 1024;

struct Point {
    wo: Vec3,
    wi: Vec3,
    u_lobe: f32,
    u: Vec2,
}

fn points() -> Vec<Point> {
    (0..POINTS)
        .map(|k| {
            let mut s = Sampler::new(1, Stream::TEST, k, 0);
            Point {
                wo: square_to_cosine_hemisphere(s.next_2d()),
                wi: square_to_cosine_hemisphere(s.next_2d()),
                u_lobe: s.next_1d(),
                u: s.next_2d(),
            }
        })
        .collect()
}

fn surface(roughness: f32, metallic: f32) -> SurfacePoint {
    SurfacePoint {
        base_color: Vec3::new(0.8, 0.5, 0.2),
        roughness,
        metallic,
        ..SurfacePoint::facing(Vec3::Z)
    }
}

fn decide<const F: u32>(bencher: Bencher, surface: SurfacePoint) {
    let points = points();
    bencher.counter(ItemsCount::new(POINTS)).bench(|| {
        for p in &points {
            let bsdf = Bsdf::<F>::new(black_box(&surface), p.wo);
            black_box(bsdf.eval_pdf(p.wi));
            black_box(bsdf.sample(p.u_lobe, p.u));
        }
    });
}

#[divan::bench]
fn lambert(bencher: Bencher) {
    decide::<0>(bencher, surface(1.0, 0.0));
}

#[divan::bench(args = [0.0, 0.1, 0.8])]
fn metal(bencher: Bencher, roughness: f32) {
    decide::<SPECULAR>(bencher, surface(roughness, 1.0));
}

#[divan::bench(args = [0.0, 0.1, 0.8])]
fn dielectric(bencher: Bencher, roughness: f32) {
    decide::<SPECULAR>(bencher, surface(roughness, 0.0));
}

#[divan::bench]
fn everything_compiled_in_but_absent(bencher: Bencher) {
    decide::<ALL>(bencher, surface(0.3, 0.0));
}

#[divan::bench]
fn coat_over_glass(bencher: Bencher) {
    let coated = SurfacePoint {
        transmission: 0.5,
        coat: CoatPoint {
            factor: 1.0,
            roughness: 0.1,
            normal: Vec3::Z,
            own_normal: false,
        },
        ..surface(0.3, 0.0)
    };
    decide::<ALL>(bencher, coated);
}
