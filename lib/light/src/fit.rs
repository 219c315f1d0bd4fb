//! Spherical Gaussians that stand for an environment map.
//!
//! Small bright sources come first: each is a connected region far above the mean, and becomes
//! the lobe with its energy, centre and second moment (`sigma^2` is the mean of `1 - cos` around
//! a narrow lobe). What is left is fitted on a coarse grid by limited-memory BFGS on log-radiance,
//! direction and log sigma, from lobes spread evenly over the sphere, with analytic gradients
//! through the rasteriser. Last, the wide lobes are scaled so that every channel keeps the map's
//! energy.
use std::f64::consts::PI;

use glam::{DVec3, Vec3};

use crate::environment::EnvironmentMap;
use crate::gaussian::{LobeParameters, MIN_SIGMA, SphericalGaussian};
use crate::lbfgs::minimise;
use crate::luminance::{luminance, luminance_f64};
use crate::rasterize::Rasterizer;

/// A texel this many times brighter than the mean belongs to a source of its own.
const PEAK_OVER_MEAN: f64 = 20.0;
/// A source ends where luminance falls below this share of its brightest texel, or below
/// [`EDGE_OVER_MEDIAN`]; or higher, where that is too large a region.
const PEAK_EDGE: f32 = 1e-3;
/// A source stands out this many times from the median over the sphere.
const EDGE_OVER_MEDIAN: f32 = 4.0;
/// The largest source, steradians, 9 degrees across: what is larger the coarse grid resolves.
const PEAK_SOLID_ANGLE: f64 = 0.02;
/// Grid on which what is left is fitted.
const COARSE: (usize, usize) = (64, 32);
/// Steps of the minimiser. Losses on the samples tried fall by less than 1% beyond.
const ITERATIONS: usize = 200;

/// Lobes fitted to a map, and how well they do.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// The lobes: small sources first, from the brightest.
    pub lobes: Vec<SphericalGaussian>,
    /// How many of them stand for small sources.
    pub sources: usize,
    /// Integrated luminance of the lobes over that of the map, minus 1; 0 for a black map.
    pub relative_energy: f64,
    /// Root mean square over the sphere and the channels of the difference in radiance, on the
    /// coarse grid (at most 64 x 32 texels), sources included.
    pub rmse: f64,
}

/// Fits at most `count` lobes to `map`. A black map, or a count of 0, gets none.
pub fn fit(map: &EnvironmentMap, count: usize) -> Fit {
    let mut rest = map.clone();
    let mut lobes = Vec::new();
    // One lobe always remains for the sky.
    while lobes.len() + 1 < count {
        match extract_source(&mut rest) {
            Some(lobe) => lobes.push(lobe),
            None => break,
        }
    }
    let sources = lobes.len();
    lobes.extend(fit_smooth(&rest, count - sources));
    report(map, lobes, sources)
}

fn report(map: &EnvironmentMap, lobes: Vec<SphericalGaussian>, sources: usize) -> Fit {
    let total = luminance_f64(map.integral());
    let ours: DVec3 = lobes.iter().map(|g| g.integral()).sum();
    let coarse = coarse(map);
    let raster = Rasterizer::new(coarse.width(), coarse.height()).rasterize(&lobes);
    let mut squares = 0.0;
    for (k, (a, b)) in coarse.texels().iter().zip(raster.texels()).enumerate() {
        let area = coarse.solid_angle(k / coarse.width());
        squares += area * (*a - *b).as_dvec3().length_squared();
    }
    Fit {
        lobes,
        sources,
        relative_energy: if total > 0.0 {
            luminance_f64(ours) / total - 1.0
        } else {
            0.0
        },
        rmse: (squares / (12.0 * PI)).sqrt(),
    }
}

fn coarse(map: &EnvironmentMap) -> EnvironmentMap {
    map.resampled(map.width().min(COARSE.0), map.height().min(COARSE.1))
}

/// Takes the brightest small source out of `map`, which keeps the radiance around it.
fn extract_source(map: &mut EnvironmentMap) -> Option<SphericalGaussian> {
    let mean = luminance_f64(map.integral()) / (4.0 * PI);
    let (direction, peak) = map.peak();
    let brightest = luminance(peak);
    if mean <= 0.0 || f64::from(brightest) < PEAK_OVER_MEAN * mean {
        return None;
    }
    let start = map.texel_of(direction);
    let mut threshold = (PEAK_EDGE * brightest).max(EDGE_OVER_MEDIAN * median(map));
    while threshold < 0.5 * brightest {
        if let Some((region, around)) = region_above(map, start, threshold) {
            return Some(source_of(map, &region, around));
        }
        threshold *= 3.0;
    }
    None
}

/// Median luminance over the sphere.
fn median(map: &EnvironmentMap) -> f32 {
    let w = map.width();
    let mut all: Vec<(f32, f64)> = map
        .luminance()
        .into_iter()
        .enumerate()
        .map(|(k, l)| (l, map.solid_angle(k / w)))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut below = 0.0;
    let half = |&&(_, area): &&(f32, f64)| {
        below += area;
        below >= 2.0 * PI
    };
    all.iter().find(half).map_or(0.0, |m| m.0)
}

/// The texels above `threshold` that are connected to `start`, and the mean radiance just
/// outside; `None` for more than a source may cover.
fn region_above(
    map: &EnvironmentMap,
    start: (usize, usize),
    threshold: f32,
) -> Option<(Vec<(usize, usize)>, DVec3)> {
    let (w, h) = (map.width(), map.height());
    let mut seen = vec![false; w * h];
    seen[start.0 * w + start.1] = true;
    let mut region = vec![start];
    let (mut rim, mut rim_area, mut area) = (DVec3::ZERO, 0.0, 0.0);
    let mut next = 0;
    while next < region.len() {
        let (i, j) = region[next];
        next += 1;
        area += map.solid_angle(i);
        if area > PEAK_SOLID_ANGLE.max(2.0 * map.solid_angle(i)) {
            return None;
        }
        for (a, b) in neighbours(i, j, w, h) {
            if std::mem::replace(&mut seen[a * w + b], true) {
                continue;
            }
            let texel = map.texel(a, b);
            if luminance(texel) > threshold {
                region.push((a, b));
            } else {
                rim += texel.as_dvec3() * map.solid_angle(a);
                rim_area += map.solid_angle(a);
            }
        }
    }
    let around = if rim_area > 0.0 {
        rim / rim_area
    } else {
        DVec3::ZERO
    };
    Some((region, around))
}

/// Texels beside `(i, j)`, across the seam too.
fn neighbours(i: usize, j: usize, w: usize, h: usize) -> impl Iterator<Item = (usize, usize)> {
    let rows = i.saturating_sub(1)..(i + 2).min(h);
    rows.flat_map(move |a| [(j + w - 1) % w, j, (j + 1) % w].map(|b| (a, b)))
}

/// The lobe with the energy above `around`, the centre and the spread of `region`, which takes
/// on the radiance `around`.
fn source_of(
    map: &mut EnvironmentMap,
    region: &[(usize, usize)],
    around: DVec3,
) -> SphericalGaussian {
    let (w, h) = (map.width(), map.height());
    let excess = |t: Vec3| (t.as_dvec3() - around).max(DVec3::ZERO);
    let mut energy = DVec3::ZERO;
    let mut centre = DVec3::ZERO;
    for &(i, j) in region {
        let e = excess(map.texel(i, j)) * map.solid_angle(i);
        energy += e;
        centre += map.direction_of(i, j).as_dvec3() * luminance_f64(e);
    }
    let (i, j) = region[0];
    let centre = centre
        .try_normalize()
        .unwrap_or(map.direction_of(i, j).as_dvec3());
    let mut spread = 0.0;
    for &(i, j) in region {
        let weight = luminance_f64(excess(map.texel(i, j)) * map.solid_angle(i));
        let d = map.direction_of(i, j).as_dvec3();
        // The texel's own second moment: sides squared over 12, halved as 1 - cos is.
        let sides = (PI / h as f64).powi(2) + (2.0 * PI / w as f64).powi(2) * (1.0 - d.y * d.y);
        spread += weight * (0.5 * (d - centre).length_squared() + sides / 24.0);
    }
    let sigma = (spread / luminance_f64(energy))
        .sqrt()
        .max(MIN_SIGMA.into()) as f32;
    let unit = SphericalGaussian {
        direction: centre.as_vec3().normalize(),
        radiance: Vec3::ONE,
        sigma,
    };
    let mut texels = map.texels().to_vec();
    for &(i, j) in region {
        texels[i * w + j] = texels[i * w + j].min(around.as_vec3());
    }
    *map = EnvironmentMap::from_trusted(w, h, texels);
    SphericalGaussian {
        radiance: (energy / unit.solid_angle()).as_vec3(),
        ..unit
    }
}

/// Least squares over the sphere with `count` lobes.
fn fit_smooth(map: &EnvironmentMap, count: usize) -> Vec<SphericalGaussian> {
    let energy = map.integral();
    if count == 0 || luminance_f64(energy) <= 0.0 {
        return Vec::new();
    }
    let map = coarse(map);
    let raster = Rasterizer::new(map.width(), map.height());
    let start = spread_lobes(energy / (4.0 * PI), count);
    let areas: Vec<f64> = (0..map.height()).map(|i| map.solid_angle(i)).collect();
    // The loss is measured in units of the map's own power.
    let square = |t: &Vec3| t.as_dvec3().length_squared();
    let power: f64 = map.texels().iter().map(square).sum::<f64>() / map.texels().len() as f64;
    let loss = |x: &[f64]| {
        let parameters = unpack(x);
        let lobes: Vec<_> = parameters.iter().map(LobeParameters::lobe).collect();
        let ours = raster.rasterize(&lobes);
        let (mut value, mut adjoint) = (0.0, Vec::with_capacity(ours.texels().len()));
        for (k, (a, b)) in ours.texels().iter().zip(map.texels()).enumerate() {
            let area = areas[k / map.width()] / power;
            let difference = *a - *b;
            value += area * difference.as_dvec3().length_squared();
            adjoint.push(difference * (2.0 * area) as f32);
        }
        let gradients = raster.rasterize_vjp(&lobes, &adjoint);
        let gradients = parameters
            .iter()
            .zip(&gradients)
            .map(|(p, g)| p.lobe_vjp(g));
        (value, pack(gradients))
    };
    let best = minimise(pack(start.into_iter()), ITERATIONS, loss);
    let mut lobes: Vec<_> = unpack(&best).iter().map(LobeParameters::lobe).collect();
    let ours: DVec3 = lobes.iter().map(|g| g.integral()).sum();
    let scale = DVec3::select(ours.cmpgt(DVec3::ZERO), energy / ours, DVec3::ONE);
    for g in &mut lobes {
        g.radiance *= scale.as_vec3();
    }
    lobes
}

/// One nearly constant lobe and `count - 1` on a Fibonacci spiral, together about as bright as
/// `mean`.
fn spread_lobes(mean: DVec3, count: usize) -> Vec<LobeParameters> {
    let around = count.saturating_sub(1);
    let share = 1.0 / count as f64;
    let golden = PI * (3.0 - 5f64.sqrt());
    let log = |c: DVec3| c.max(DVec3::splat(1e-12)).ln();
    let constant = LobeParameters {
        log_radiance: log(mean * share),
        direction: DVec3::Y,
        log_sigma: 2f64.ln(),
    };
    let spiral = (0..around).map(|k| {
        let y = 1.0 - (2 * k + 1) as f64 / around as f64;
        let s = (1.0 - y * y).sqrt();
        let angle = golden * k as f64;
        // Neighbours overlap at about one sigma.
        let sigma = (2.0 / (around as f64).sqrt()).min(1.0);
        LobeParameters {
            log_radiance: log(mean * (1.0 - share) * 2.0 / (around as f64 * sigma * sigma)),
            direction: DVec3::new(s * angle.cos(), y, s * angle.sin()),
            log_sigma: sigma.ln(),
        }
    });
    std::iter::once(constant).chain(spiral).collect()
}

fn pack(parameters: impl Iterator<Item = LobeParameters>) -> Vec<f64> {
    parameters
        .flat_map(|p| {
            let (c, d) = (p.log_radiance, p.direction);
            [c.x, c.y, c.z, d.x, d.y, d.z, p.log_sigma]
        })
        .collect()
}

fn unpack(x: &[f64]) -> Vec<LobeParameters> {
    x.chunks_exact(7)
        .map(|p| LobeParameters {
            log_radiance: DVec3::from_slice(p),
            direction: DVec3::from_slice(&p[3..]),
            log_sigma: p[6],
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rasterize::rasterize;
    use crate::testing::lobe;

    fn degrees_between(a: Vec3, b: Vec3) -> f32 {
        (2.0 * (0.5 * (a - b).length()).asin()).to_degrees()
    }

    #[test]
    fn a_sun_of_half_a_degree_in_a_soft_sky_is_found_with_its_energy() {
        for direction in [
            Vec3::new(0.4, 0.6, 0.5),
            Vec3::new(-0.001, 0.3, -1.0),
            Vec3::Y,
        ] {
            // Half a degree across: a disk of radius r has sigma r / 2.
            let sun = lobe(
                direction,
                Vec3::new(6e4, 5e4, 4e4),
                0.25f32.to_radians() / 2.0,
            );
            let sky = lobe(Vec3::Y, Vec3::new(0.5, 0.7, 1.2), 0.8);
            let map = rasterize(&[sun, sky, lobe(Vec3::Y, Vec3::splat(0.1), 30.0)], 512, 256);
            let fit = fit(&map, 8);
            assert_eq!(fit.sources, 1);
            let found = fit.lobes[0];
            // A texel is 0.7 degrees across, and its centre of light is known to it.
            assert!(
                degrees_between(found.direction, sun.direction) < 0.4,
                "{found:?}"
            );
            let energy = found.integral() / sun.integral();
            assert!((energy - 1.0).abs().max_element() < 0.01, "{energy}");
            assert!(fit.relative_energy.abs() < 1e-3, "{}", fit.relative_energy);
            // The sun is 1.8 W/m^2 in a coarse texel of 0.01 sr: 180 there, an rms of 5. The
            // fitted lobe is wider by a fine texel, a seventh of a coarse one: up to a fifth of
            // the energy may fall across an edge.
            assert!(fit.rmse < 1.0, "{}", fit.rmse);
        }
    }

    #[test]
    fn a_soft_sky_made_of_lobes_is_fitted_closely() {
        let sky = [
            lobe(Vec3::new(0.2, 1.0, 0.3), Vec3::new(1.0, 1.2, 2.0), 0.7),
            lobe(Vec3::new(-0.9, 0.1, 0.4), Vec3::new(2.0, 1.0, 0.4), 0.4),
            lobe(Vec3::NEG_Y, Vec3::splat(0.3), 1.0),
        ];
        let map = rasterize(&sky, 128, 64);
        let fit = fit(&map, 12);
        let mean = map.integral() / (4.0 * PI);
        assert_eq!(fit.sources, 0);
        assert!(fit.relative_energy.abs() < 1e-3);
        assert!(
            fit.rmse < 0.03 * mean.max_element(),
            "{} of {mean}",
            fit.rmse
        );
    }

    #[test]
    fn constant_black_and_tiny_maps_are_fitted() {
        let constant = fit(
            &EnvironmentMap::constant(32, 16, Vec3::new(1.0, 0.0, 3.0)),
            4,
        );
        assert!(
            constant.relative_energy.abs() < 1e-4 && constant.rmse < 0.05,
            "{constant:?}"
        );
        let black = fit(&EnvironmentMap::constant(32, 16, Vec3::ZERO), 4);
        assert!(black.lobes.is_empty() && black.rmse == 0.0);
        let none = fit(&EnvironmentMap::constant(32, 16, Vec3::ONE), 0);
        assert!(none.lobes.is_empty() && none.relative_energy == -1.0);
        let tiny = EnvironmentMap::new(2, 1, vec![Vec3::ONE, Vec3::splat(1e6)]).unwrap();
        for count in 1..4 {
            let tiny = fit(&tiny, count);
            assert!(tiny.relative_energy.abs() < 1e-3, "{tiny:?}");
            assert!(tiny.lobes.iter().all(|g| g.checked(0).is_ok()));
        }
    }
}
