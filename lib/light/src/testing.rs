//! What the tests of this crate share.
use std::f64::consts::{PI, TAU};

use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::stats::chi_squared_p_value;
use glam::{DVec3, Vec2, Vec3};

use crate::environment::{EnvironmentMap, texel_of};
use crate::gaussian::SphericalGaussian;

/// Independent uniform points: chi-squared tests assume that samples know nothing of each other.
pub(crate) fn uniform(k: u32) -> Vec2 {
    Sampler::new(17, Stream::TEST, k, 0).next_2d()
}

/// Unit vectors: the axes (poles and seam among them), and some in general position.
pub(crate) fn directions() -> Vec<Vec3> {
    let mut all = vec![
        Vec3::X,
        Vec3::NEG_X,
        Vec3::Y,
        Vec3::NEG_Y,
        Vec3::Z,
        Vec3::NEG_Z,
        Vec3::new(1e-4, 1.0, -2e-4),
        Vec3::new(-1e-5, 0.2, -1.0),
        Vec3::new(0.3, 0.5, 0.7),
        Vec3::new(-0.6, -0.2, 0.4),
    ];
    all.iter_mut().for_each(|d| *d = d.normalize());
    all
}

pub(crate) fn lobe(direction: Vec3, radiance: Vec3, sigma: f32) -> SphericalGaussian {
    SphericalGaussian {
        direction: direction.normalize(),
        radiance,
        sigma,
    }
}

/// A map with a dim gradient and a few texels up to 1e4 times as bright.
pub(crate) fn speckled(width: usize, height: usize) -> EnvironmentMap {
    let texels = (0..width * height)
        .map(|k| {
            let u = uniform(k as u32 + 9_000_000);
            let spike = if k % 37 == 5 { 300.0 * u.x } else { 0.0 };
            Vec3::new(u.x + spike, 0.5 * u.y + spike, 0.2)
        })
        .collect();
    EnvironmentMap::new(width, height, texels).unwrap()
}

/// The integral over a cell of a `width` x `height` grid, by `n` x `n` midpoints in polar angle
/// and azimuth.
pub(crate) fn cell_integral(
    (width, height): (usize, usize),
    (i, j): (usize, usize),
    n: usize,
    f: impl Fn(DVec3) -> f64,
) -> f64 {
    let (dtheta, dphi) = (PI / (height * n) as f64, TAU / (width * n) as f64);
    let mut sum = 0.0;
    for a in 0..n {
        let theta = ((i * n + a) as f64 + 0.5) * dtheta;
        let area = 2.0 * theta.sin() * (0.5 * dtheta).sin() * dphi;
        for b in 0..n {
            let phi = ((j * n + b) as f64 + 0.5) * dphi;
            let (s, c) = theta.sin_cos();
            sum += area * f(DVec3::new(phi.sin() * s, c, -phi.cos() * s));
        }
    }
    sum
}

/// The p-value of `count` draws against `pdf`, both over the cells of a grid; also checks that
/// the density integrates to `total` within `tolerance`.
pub(crate) fn chi_squared(
    grid: (usize, usize),
    points: usize,
    count: u32,
    draw: impl Fn(Vec2) -> Vec3,
    pdf: impl Fn(Vec3) -> f32,
    tolerance: f64,
) -> f64 {
    let mut observed = vec![0.0; grid.0 * grid.1];
    for k in 0..count {
        let (i, j) = texel_of(draw(uniform(k)), grid.0, grid.1);
        observed[i * grid.0 + j] += 1.0;
    }
    let expected: Vec<f64> = (0..grid.0 * grid.1)
        .map(|k| {
            let cell = (k / grid.0, k % grid.0);
            cell_integral(grid, cell, points, |d| f64::from(pdf(d.as_vec3())))
        })
        .collect();
    let total: f64 = expected.iter().sum();
    assert!(
        (total - 1.0).abs() < tolerance,
        "density integrates to {total}"
    );
    let expected: Vec<f64> = expected
        .iter()
        .map(|e| e / total * f64::from(count))
        .collect();
    chi_squared_p_value(&observed, &expected, 5.0)
}
