//! The renderer's layers against those of the plain tracer.
use std::fmt;
use std::ops::ControlFlow;

use dipir_imaging::transfer::Transfer;
use dipir_render::adaptive::Stop;
use dipir_render::contribution::LeaveOut;
use dipir_render::film::Film;
use dipir_render::light::SceneLight;
use dipir_render::render::{Renderer, Settings};
use glam::{DVec3, Vec3};

use crate::scenes::{Case, Light};
use crate::tracer::{Mean, Picture, Tracer};

/// Pixels along a side of the tiles whose means are compared.
const TILE: usize = 8;
/// Relative difference that is due to rounding and to what may be left out, whatever the standard error.
const SLACK: f64 = 4e-4;
/// Samples that every pixel of the object has at least.
const LEAST_SAMPLES: f32 = 16.0;

/// The largest difference of a tile's mean, in standard errors.
#[derive(Clone, Copy, Debug, Default)]
pub struct Difference {
    pub sigmas: f64,
    pub tile: (usize, usize),
    pub found: DVec3,
    pub expected: DVec3,
    pub errors: DVec3,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            sigmas,
            tile,
            found,
            expected,
            errors,
        } = self;
        write!(
            f,
            "{sigmas:.1} sigma at {tile:?}: {found} instead of {expected}, standard error {errors}"
        )
    }
}

/// Object, coverage and shadow of a case, `samples` plain samples a pixel.
pub fn compare(case: &Case, settings: &Settings, samples: u32, seed: u64) -> [Difference; 3] {
    let settings = &Settings {
        background: case.photo.as_ref(),
        ..*settings
    };
    let renderer = Renderer::new(&case.scene);
    let film = match &case.light {
        Light::Map(light) => rendered(&renderer, light, case, settings),
        Light::Lobes(light) => rendered(&renderer, light, case, settings),
        Light::Both(light) => rendered(&renderer, light, case, settings),
    };
    let light = |direction| case.light.eval(direction);
    let tracer = Tracer::new(&renderer, &light, case.photo.as_ref(), case.simulation);
    differences(&film, &tracer.picture(samples, seed))
}

fn rendered<L: SceneLight>(
    renderer: &Renderer,
    light: &L,
    case: &Case,
    settings: &Settings,
) -> Film {
    let carry_on = &mut |_: &_| ControlFlow::Continue(());
    let rendered = renderer.render(light, &case.simulation, settings, carry_on);
    rendered.expect("renders").film
}

/// A fixed number of samples.
pub fn fixed(samples: u32, seed: u64) -> Settings<'static> {
    Settings {
        seed,
        stop: Stop::Samples(samples),
        transfer: Transfer::Linear,
        shadow_tolerance: 0.0,
        ..Settings::default()
    }
}

/// Adaptive samples, highlights, and everything left out that costs next to nothing.
pub fn adaptive(target: f32, seed: u64) -> Settings<'static> {
    Settings {
        stop: Stop::TargetError(target),
        transfer: Transfer::Srgb,
        leave_out: Some(LeaveOut {
            tolerance: 2e-4,
            depth: true,
            emission_on_proxy: true,
            bounce_to_proxy: true,
            bounce_from_proxy: true,
        }),
        ..fixed(0, seed)
    }
}

fn differences(film: &Film, expected: &Picture) -> [Difference; 3] {
    let shape = (film.alpha.width(), film.alpha.height());
    let value = |v: Vec3, variance: Vec3| Mean {
        mean: v.as_dvec3(),
        variance: variance.as_dvec3(),
    };
    let object = |x, y| value(*film.object.get(x, y), film.object_variance(x, y));
    // Stratified samples spread no more than as many independent ones; so many are drawn at least.
    let alpha = |x: usize, y: usize| {
        let a = expected.alpha[y * shape.0 + x].mean.x as f32;
        let variance = a * (1.0 - a) / LEAST_SAMPLES;
        value(Vec3::splat(*film.alpha.get(x, y)), Vec3::splat(variance))
    };
    let shadow = |x, y| value(*film.shadow.get(x, y), film.shadow_variance(x, y));
    [
        worst(shape, &object, &expected.object),
        worst(shape, &alpha, &expected.alpha),
        worst(shape, &shadow, &expected.shadow),
    ]
}

fn worst(
    (width, height): (usize, usize),
    found: &dyn Fn(usize, usize) -> Mean,
    expected: &[Mean],
) -> Difference {
    let mut worst = Difference::default();
    let tiles = |n: usize| (0..n.div_ceil(TILE)).map(move |i| (i * TILE, ((i + 1) * TILE).min(n)));
    let whole = [((0, width), (0, height))];
    let parts = tiles(height).flat_map(|y| tiles(width).map(move |x| (x, y)));
    for ((x0, x1), (y0, y1)) in parts.chain(whole) {
        let (mut a, mut b) = (Mean::default(), Mean::default());
        for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
            let (f, e) = (found(x, y), expected[y * width + x]);
            a.mean += f.mean;
            a.variance += f.variance;
            b.mean += e.mean;
            b.variance += e.variance;
        }
        let n = ((x1 - x0) * (y1 - y0)) as f64;
        let difference = (a.mean - b.mean).abs() / n;
        let error = ((a.variance + b.variance) / (n * n)).map(f64::sqrt);
        // And as much of black.
        let error_and_slack = error + SLACK * (b.mean / n).abs() + 1e-4;
        let sigmas = (difference / error_and_slack).max_element();
        if sigmas > worst.sigmas || !sigmas.is_finite() {
            worst = Difference {
                sigmas,
                tile: (x0, y0),
                found: a.mean / n,
                expected: b.mean / n,
                errors: error,
            };
        }
    }
    worst
}
