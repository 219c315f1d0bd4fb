//! Maps and gradients against exact integrals and differences in f64.
use super::*;
use crate::testing::{cell_integral, directions, lobe, uniform};
use dipir_numerics::gradcheck::central_difference;

const SIGMAS: [f32; 10] = [1e-3, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.35, 1.0, 3.0, 10.0];

#[test]
fn the_map_holds_the_energy_of_the_closed_form_everywhere_at_every_width() {
    let mut worst = 0.0f64;
    for (w, h) in [(2, 1), (1, 1), (1, 2), (3, 5), (16, 8), (128, 64)] {
        for sigma in SIGMAS {
            for d in directions() {
                for radiance in [1.0, 1e6] {
                    let g = lobe(d, Vec3::splat(radiance), sigma);
                    let map = rasterize(&[g], w, h);
                    let error = (map.integral().x / g.integral().x - 1.0).abs();
                    worst = worst.max(error);
                    // Each node is off by less than 1e-3 of the peak, with alternating sign.
                    assert!(error < 1e-3, "{w} x {h}, sigma {sigma}, {d}: {error}");
                }
            }
        }
    }
    assert!(worst > 0.0);
}

#[test]
fn a_black_lobe_leaves_the_map_black() {
    let map = rasterize(&[lobe(Vec3::X, Vec3::ZERO, 0.2)], 8, 4);
    assert!(map.texels().iter().all(|t| *t == Vec3::ZERO));
    assert!(
        rasterize(&[], 8, 4)
            .texels()
            .iter()
            .all(|t| *t == Vec3::ZERO)
    );
}

/// A lobe in f64, moved along one of its six parameters: log-radiance (three), the direction's
/// two tangents, log sigma.
fn moved(g: &SphericalGaussian, parameter: usize, x: f64) -> (DVec3, DVec3, f64) {
    let mu = g.direction.as_dvec3().normalize();
    let (t, b) = mu.any_orthonormal_pair();
    let mut c = g.radiance.as_dvec3();
    let mut sigma = f64::from(g.sigma);
    let mut direction = mu;
    match parameter {
        0..3 => c[parameter] *= x.exp(),
        3 => direction = (mu + t * x).normalize(),
        4 => direction = (mu + b * x).normalize(),
        _ => sigma *= x.exp(),
    }
    (direction, c, sigma)
}

/// `sum of adjoint * map` from midpoints, sharing nothing with the code under test.
fn by_midpoints(
    (direction, c, sigma): (DVec3, DVec3, f64),
    (w, h): (usize, usize),
    points: usize,
    adjoint: &[Vec3],
) -> f64 {
    let mut sum = 0.0;
    for i in 0..h {
        let area = crate::environment::solid_angle(w, h, i);
        for j in 0..w {
            let y = adjoint[i * w + j].as_dvec3();
            let mean = cell_integral((w, h), (i, j), points, |v| {
                (-0.5 * (v - direction).length_squared() / (sigma * sigma)).exp()
            });
            sum += y.dot(c) * mean / area;
        }
    }
    sum
}

/// `sum of adjoint * map` in f64 at the nodes of the code under test.
fn at_nodes(
    (direction, c, sigma): (DVec3, DVec3, f64),
    (w, h): (usize, usize),
    adjoint: &[Vec3],
) -> f64 {
    let raster = Rasterizer::new(w, h);
    let lobe = raster.place(direction, Vec3::ONE, sigma);
    let mut sum = 0.0;
    for i in 0..h {
        let toned: Vec<f64> = (0..w)
            .map(|j| adjoint[i * w + j].as_dvec3().dot(c))
            .collect();
        raster.latitudes(&lobe, i, |latitude| {
            let half = Rasterizer::reach(&latitude);
            let nodes = node_count(raster.column_step(&lobe, &latitude));
            for run in raster.column_runs(lobe.phi, half) {
                let Some(n) = nodes else {
                    raster.panel_nodes(&lobe, &latitude, half, run, |j, _, _, value| {
                        sum += toned[j] * value;
                    });
                    continue;
                };
                for j in run {
                    for &(x, weight) in NODES[n - 1] {
                        let phi = (j as f64 + x) * TAU / w as f64;
                        let s = (0.5 * (phi - lobe.phi)).sin();
                        let value = (-latitude.a - latitude.b * s * s).exp();
                        sum += toned[j] * latitude.weight * weight * value;
                    }
                }
            }
        });
    }
    sum
}

fn adjoint(count: usize) -> Vec<Vec3> {
    (0..count as u32)
        .map(|k| {
            let (a, b) = (uniform(2 * k), uniform(2 * k + 1));
            Vec3::new(a.x, a.y, b.x) - Vec3::splat(0.4)
        })
        .collect()
}

fn components(g: &SphericalGaussian, gradient: &LobeGradient) -> [f64; 6] {
    let mu = g.direction.as_dvec3().normalize();
    let (t, b) = mu.any_orthonormal_pair();
    let radial = gradient.direction.dot(mu).abs();
    let size = gradient.direction.length() + gradient.log_sigma.abs();
    assert!(radial <= 1e-9 * size, "{g:?} {gradient:?}");
    let c = gradient.log_radiance;
    [
        c.x,
        c.y,
        c.z,
        gradient.direction.dot(t),
        gradient.direction.dot(b),
        gradient.log_sigma,
    ]
}

#[test]
fn texels_and_gradients_agree_with_exact_integrals() {
    // Midpoints are a twelfth of sigma apart or finer, off by (1/12)^2 / 24 = 3e-4 at cell
    // borders; nodes by up to 9e-4 of the peak in every texel. Random adjoints average both
    // down: 2e-3 of the largest component holds them.
    let cases = [
        ((8, 4), 0.25f32, 60, Vec3::new(0.3, 0.5, 0.7)),
        ((8, 4), 1.0, 24, Vec3::new(-0.6, 0.2, 0.1)),
        ((8, 4), 10.0, 24, Vec3::X),
        ((2, 1), 0.4, 160, Vec3::new(1e-4, 1.0, -2e-4)),
        ((16, 8), 0.12, 60, Vec3::new(-1e-5, 0.2, -1.0)),
        ((16, 8), 0.12, 60, Vec3::NEG_Y),
        ((24, 12), 0.5, 12, Vec3::new(0.1, -0.7, -0.6)),
    ];
    for (size, sigma, points, d) in cases {
        let g = lobe(d, Vec3::new(2.0, 0.7, 1e2), sigma);
        let y = adjoint(size.0 * size.1);
        let value = |p: usize, x: f64| by_midpoints(moved(&g, p, x), size, points, &y);
        let map = rasterize(&[g], size.0, size.1);
        let products = map.texels().iter().zip(&y);
        let forward: f64 = products.map(|(t, y)| t.as_dvec3().dot(y.as_dvec3())).sum();
        let numeric = [0, 1, 2, 3, 4, 5].map(|p| central_difference(|x| value(p, x), 0.0, 1e-4));
        let largest = numeric.iter().fold(0f64, |m, x| m.max(x.abs()));
        assert!(
            (forward - value(0, 0.0)).abs() < 2e-3 * largest,
            "{size:?}, sigma {sigma}, {d}"
        );
        let ours = components(&g, &rasterize_vjp(&[g], size.0, size.1, &y)[0]);
        for (p, (a, n)) in ours.iter().zip(&numeric).enumerate() {
            let close = (a - n).abs() < 2e-3 * largest;
            assert!(
                close,
                "{size:?}, sigma {sigma}, {d}, parameter {p}: {a} against {n}"
            );
        }
    }
}

#[test]
fn gradients_agree_with_central_differences_of_the_same_nodes() {
    // f64 differences at h = 1e-5 of the lobe's width are right to 1e-8; f32 values carry
    // (1 + exponent) 1.2e-7. Panels move with the lobe, which their rule leaves at 1e-5.
    for size in [(2, 1), (1, 1), (3, 5), (16, 8), (128, 64)] {
        let y = adjoint(size.0 * size.1);
        for sigma in SIGMAS {
            for d in directions() {
                let g = lobe(d, Vec3::new(2.0, 0.7, 1e2), sigma);
                let ours = components(&g, &rasterize_vjp(&[g], size.0, size.1, &y)[0]);
                let h = 1e-5 * f64::from(sigma).min(1.0);
                let numeric = [0, 1, 2, 3, 4, 5]
                    .map(|p| central_difference(|x| at_nodes(moved(&g, p, x), size, &y), 0.0, h));
                // A direction matters in units of sigma: inside a texel its derivative is 0,
                // the difference of parts as large as the value over sigma.
                let unit = |p: usize| {
                    if p == 3 || p == 4 {
                        g.sigma.min(1.0).into()
                    } else {
                        1.0
                    }
                };
                let scaled = |p: usize, x: f64| unit(p) * x;
                let largest = (0..6).fold(0f64, |m, p| m.max(scaled(p, numeric[p]).abs()));
                for (p, (a, n)) in ours.iter().zip(&numeric).enumerate() {
                    let close = scaled(p, a - n).abs() < 1e-4 * largest;
                    assert!(
                        close,
                        "{size:?}, sigma {sigma}, {d}, parameter {p}: {a} against {n}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_lobe_on_a_pole_fills_rows_and_one_on_the_seam_is_one_in_the_middle_turned() {
    for sigma in SIGMAS {
        for pole in [Vec3::Y, Vec3::NEG_Y] {
            let map = rasterize(&[lobe(pole, Vec3::splat(1e6), sigma)], 12, 6);
            for row in map.texels().chunks(12) {
                let close = |t: &Vec3| (t.x - row[0].x).abs() <= 2e-6 * row[0].x;
                assert!(row.iter().all(close), "sigma {sigma}, {pole}: {row:?}");
            }
        }
        let height = Vec3::new(0.0, 0.3, 0.0);
        let seam = rasterize(&[lobe(Vec3::NEG_Z + height, Vec3::ONE, sigma)], 12, 6);
        let middle = rasterize(&[lobe(Vec3::Z + height, Vec3::ONE, sigma)], 12, 6);
        let largest = middle.peak().1.x;
        let pairs = seam
            .texels()
            .iter()
            .zip(middle.rotated_y(PI).texels())
            .map(|(a, b)| (a.x, b.x))
            .collect::<Vec<_>>();
        // Half a texel's rounding of the axis, 6e-8 rad, over sigma.
        let tolerance = largest * (2e-6 + 2e-7 / sigma);
        assert!(
            pairs.iter().all(|(a, b)| (a - b).abs() < tolerance),
            "sigma {sigma}: {pairs:?}"
        );
    }
}

#[test]
fn maps_and_gradients_are_the_same_bytes_for_any_number_of_threads() {
    let lobes: Vec<_> = directions()
        .into_iter()
        .enumerate()
        .map(|(k, d)| lobe(d, Vec3::new(1.0, 2.0, 0.1), SIGMAS[k % SIGMAS.len()]))
        .collect();
    let y = adjoint(64 * 32);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| (rasterize(&lobes, 64, 32), rasterize_vjp(&lobes, 64, 32, &y)))
    };
    assert_eq!(run(1), run(5));
}
