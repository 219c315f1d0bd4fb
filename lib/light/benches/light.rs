//! Time of what a renderer or an optimiser asks of a light, over the sizes that matter.
//! Run with `cargo bench -p dipir-light`.
use std::hint::black_box;
use std::sync::Arc;

use dipir_light::cosine::CosineWeightedMap;
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler};
use dipir_light::fit::fit;
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_light::illuminant::Illuminant;
use dipir_light::rasterize::Rasterizer;
use dipir_numerics::sampler::{Sampler, Stream};
use divan::{Bencher, counter::ItemsCount};
use glam::{Vec2, Vec3};

fn main() {
    divan::main();
}

/// Draws per timed call.
const DRAWS: u32 = 4096;

fn uniform(k: u32) -> Vec2 {
    Sampler::new(1, Stream::TEST, k, 0).next_2d()
}

fn points() -> Vec<Vec2> {
    (0..DRAWS).map(uniform).collect()
}

fn lobes(count: u32, sigma: f32) -> Vec<SphericalGaussian> {
    (0..count)
        .map(|k| {
            let u = uniform(k);
            SphericalGaussian {
                direction: dipir_numerics::warp::square_to_sphere(u),
                radiance: Vec3::new(1.0, u.x, u.y),
                sigma,
            }
        })
        .collect()
}

/// A sky, a sun of 1e4 and some noise.
fn sky(height: usize) -> Arc<EnvironmentMap> {
    let width = 2 * height;
    let mut texels: Vec<Vec3> = (0..width * height)
        .map(|k| Vec3::splat(1.0 - k as f32 / (width * height) as f32 + uniform(k as u32).x))
        .collect();
    texels[height / 3 * width + width / 5] = Vec3::splat(1e4);
    Arc::new(EnvironmentMap::new(width, height, texels).expect("a legal map"))
}

#[divan::bench(args = [0.01, 0.05, 0.2, 0.4, 1.0, 10.0])]
fn rasterize_16_lobes_128x64(bencher: Bencher, sigma: f32) {
    let lobes = lobes(16, sigma);
    let raster = Rasterizer::new(128, 64);
    let mut texels = vec![Vec3::ZERO; 128 * 64];
    bencher.bench_local(|| raster.rasterize_into(black_box(&lobes), &mut texels));
}

#[divan::bench(args = [0.01, 0.05, 0.2, 0.4, 1.0, 10.0])]
fn rasterize_vjp_16_lobes_128x64(bencher: Bencher, sigma: f32) {
    let lobes = lobes(16, sigma);
    let raster = Rasterizer::new(128, 64);
    let adjoint = vec![Vec3::ONE; 128 * 64];
    bencher.bench_local(|| raster.rasterize_vjp(black_box(&lobes), &adjoint));
}

#[divan::bench(args = [64, 512, 2048])]
fn environment_sample(bencher: Bencher, height: usize) {
    let sampler = EnvironmentSampler::new(sky(height));
    let points = points();
    bencher
        .counter(ItemsCount::new(DRAWS))
        .bench_local(|| points.iter().map(|&u| sampler.sample(u).pdf).sum::<f32>());
}

#[divan::bench(args = [64, 512, 2048])]
fn environment_eval_pdf(bencher: Bencher, height: usize) {
    let sampler = EnvironmentSampler::new(sky(height));
    let directions: Vec<_> = points()
        .into_iter()
        .map(dipir_numerics::warp::square_to_sphere)
        .collect();
    let lookup = |&d: &Vec3| {
        let (radiance, pdf) = sampler.eval_pdf(d);
        radiance.x + pdf
    };
    bencher
        .counter(ItemsCount::new(DRAWS))
        .bench_local(|| directions.iter().map(lookup).sum::<f32>());
}

#[divan::bench(args = [64, 512, 2048])]
fn environment_sampler_build(bencher: Bencher, height: usize) {
    let map = sky(height);
    bencher.bench_local(|| EnvironmentSampler::new(map.clone()));
}

#[divan::bench(args = [1, 8, 16, 32])]
fn mixture_eval_pdf(bencher: Bencher, count: u32) {
    let mixture = SgMixture::new(lobes(count, 0.3)).expect("legal lobes");
    let directions: Vec<_> = points()
        .into_iter()
        .map(dipir_numerics::warp::square_to_sphere)
        .collect();
    bencher.counter(ItemsCount::new(DRAWS)).bench_local(|| {
        directions
            .iter()
            .map(|&d| mixture.eval_pdf(d).1)
            .sum::<f32>()
    });
}

#[divan::bench(args = [1, 16])]
fn mixture_sample(bencher: Bencher, count: u32) {
    let mixture = SgMixture::new(lobes(count, 0.3)).expect("legal lobes");
    let points = points();
    bencher
        .counter(ItemsCount::new(DRAWS))
        .bench_local(|| points.iter().map(|&u| mixture.sample(u).pdf).sum::<f32>());
}

#[divan::bench(args = [64, 512, 2048])]
fn cosine_map_build(bencher: Bencher, height: usize) {
    let map = sky(height);
    bencher.bench_local(|| CosineWeightedMap::new(map.clone(), Vec3::Y));
}

#[divan::bench(args = [(64, 0.1), (64, 0.5), (512, 0.1), (512, 0.5), (2048, 0.1), (2048, 0.5)])]
fn cone_restrict(bencher: Bencher, (height, half_angle): (usize, f32)) {
    let map = CosineWeightedMap::new(sky(height), Vec3::Y);
    let mut cone = map.cone();
    let axis = Vec3::new(0.3, 0.5, -0.6).normalize();
    bencher.bench_local(|| {
        cone.restrict(black_box(axis), half_angle.cos());
        cone.mass()
    });
}

#[divan::bench(args = [64, 512, 2048])]
fn cone_sample(bencher: Bencher, height: usize) {
    let map = CosineWeightedMap::new(sky(height), Vec3::Y);
    let mut cone = map.cone();
    cone.restrict(Vec3::new(0.3, 0.5, -0.6).normalize(), 0.9);
    let points = points();
    bencher
        .counter(ItemsCount::new(DRAWS))
        .bench_local(|| points.iter().map(|&u| cone.sample(u).pdf).sum::<f32>());
}

#[divan::bench(args = [64, 512])]
fn fit_16_lobes(bencher: Bencher, height: usize) {
    let map = sky(height);
    bencher.bench_local(|| fit(&map, 16));
}

/// Ways to invert one cumulative distribution of `n` entries, the choice behind
/// `EnvironmentSampler`: plain binary search, search from a guide table, and an alias table
/// (which scatters stratified points).
mod inversion {
    use super::*;

    fn cumulative(n: usize) -> Vec<f32> {
        let masses: Vec<f64> = (0..n)
            .map(|k| f64::from(uniform(k as u32).x).powi(4))
            .collect();
        let total: f64 = masses.iter().sum();
        let mut sum = 0.0;
        masses
            .iter()
            .map(|m| {
                sum += m / total;
                sum as f32
            })
            .collect()
    }

    #[divan::bench(args = [128, 1024, 4096])]
    fn binary_search(bencher: Bencher, n: usize) {
        let cdf = cumulative(n);
        let points = points();
        bencher.counter(ItemsCount::new(DRAWS)).bench_local(|| {
            points
                .iter()
                .map(|u| cdf.partition_point(|&c| c <= u.x))
                .sum::<usize>()
        });
    }

    #[divan::bench(args = [128, 1024, 4096])]
    fn guide_table(bencher: Bencher, n: usize) {
        let cdf = cumulative(n);
        let guide: Vec<u16> = (0..n)
            .map(|k| cdf.partition_point(|&c| c <= k as f32 / n as f32) as u16)
            .collect();
        let points = points();
        let find = |u: &Vec2| {
            let mut k = guide[(u.x * n as f32) as usize] as usize;
            while cdf[k] <= u.x {
                k += 1;
            }
            k
        };
        bencher
            .counter(ItemsCount::new(DRAWS))
            .bench_local(|| points.iter().map(find).sum::<usize>());
    }

    #[divan::bench(args = [128, 1024, 4096])]
    fn alias_table(bencher: Bencher, n: usize) {
        // The lookup alone: a random slot, its threshold and its alias.
        let slots: Vec<(f32, u32)> = (0..n as u32)
            .map(|k| (uniform(k).x, (k * 7) % n as u32))
            .collect();
        let points = points();
        let find = |u: &Vec2| {
            let scaled = u.x * n as f32;
            let k = scaled as usize;
            let (threshold, alias) = slots[k];
            if scaled - (k as f32) < threshold {
                k
            } else {
                alias as usize
            }
        };
        bencher
            .counter(ItemsCount::new(DRAWS))
            .bench_local(|| points.iter().map(find).sum::<usize>());
    }
}
