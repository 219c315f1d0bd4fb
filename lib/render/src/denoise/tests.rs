use dipir_imaging::transfer::Transfer;
use dipir_numerics::hashing::hash_u64s;

use super::auxiliary::Seen;
use super::*;
use crate::job::PixelSet;
use crate::shadow::Block;

const SIDE: u32 = 32;
/// Samples of a half.
const SAMPLES: u32 = 16;

/// What is in a pixel: radiance, base colour, coverage.
type Surface = fn(u32, u32) -> (f32, f32, f32);

/// Nearly normal, of mean 0 and variance 1: the sum of twelve uniform numbers.
fn normal([a, b, c, d]: [u64; 4]) -> f32 {
    let uniform = |k| (hash_u64s(&[a, b, c, d, k]) >> 40) as f32 / (1u64 << 24) as f32;
    (0..12).map(uniform).sum::<f32>() - 6.0
}

/// The jobs of an object that fills the frame, with normal noise of `noise` on each half of `surface`.
fn object(surface: Surface, noise: f32, seed: u64) -> (Vec<Job>, Auxiliary, Film) {
    let mut auxiliary = Auxiliary::new(SIDE as usize, SIDE as usize);
    let mut jobs = Vec::new();
    for (x, y) in (0..SIDE)
        .step_by(BLOCK)
        .flat_map(|y| (0..SIDE).step_by(BLOCK).map(move |x| (x, y)))
    {
        let block = Block {
            x,
            y,
            width: BLOCK as u32,
            height: BLOCK as u32,
        };
        let pixels = PixelSet::new(block, |_| true);
        let mut job = Job::new(Layer::Object, block, pixels, None);
        for (index, (x, y)) in pixels.iter().enumerate() {
            let (radiance, colour, coverage) = surface(x, y);
            auxiliary.set(
                x as usize,
                y as usize,
                Seen::new(Vec3::Z, Vec3::splat(colour)),
            );
            for replicate in 0..REPLICATES {
                let n = SAMPLES as f32;
                let of_pixel = [seed, x.into(), y.into(), replicate as u64];
                let value = n * (radiance + noise * normal(of_pixel));
                job.add(index, replicate, &[value, value, value, coverage * n, n]);
            }
        }
        job.samples = SAMPLES;
        jobs.push(job);
    }
    let mut film = Film::new(SIDE as usize, SIDE as usize);
    film.develop(&jobs);
    (jobs, auxiliary, film)
}

const VIEWING: Viewing = Viewing {
    background: None,
    tone: None,
    transfer: Transfer::Linear,
    gain: 1.0,
    adds: false,
    is_blurred: false,
};

/// Squared error of `film` against `surface`, over the pixels that are wholly covered and for which `holds` is true.
fn squared_error(film: &Film, surface: Surface, holds: impl Fn(u32, u32) -> bool) -> f64 {
    let all = (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y)));
    let of = |(x, y): (u32, u32)| {
        let error = film.object.get(x as usize, y as usize).x - surface(x, y).0;
        f64::from(error * error)
    };
    let held = all.filter(|&(x, y)| surface(x, y).2 == 1.0 && holds(x, y));
    held.map(of).sum()
}

#[test]
fn noise_falls_and_what_is_left_of_it_is_measured() {
    let even: Surface = |_, _| (0.2, 0.5, 1.0);
    let ramp: Surface = |x, _| (0.1 + 0.01 * x as f32, 0.5, 1.0);
    let stripes: Surface = |x, _| (0.2 + 0.1 * (x / 4 % 2) as f32, 0.5, 1.0);
    // Most of the squared error that may be left, and of what may be stated for it. An average of the 49 pixels within
    // reach would leave 1/49 of an even surface; weights follow the noise of the guide. The halves measure the error of a
    // tile and those around it within s^2 / sqrt(25 * 64), s^2 the variance of a half: 5% of the samples' squared error,
    // two thirds of which count where the filter has no bias.
    for (surface, most, most_stated) in [(even, 0.06, 2.0), (ramp, 0.4, 1.2), (stripes, 0.8, 1.2)] {
        let (mut drawn, mut left, mut stated, mut stated_drawn) = (0.0, 0.0, 0.0, 0.0);
        for seed in 0..16 {
            let (jobs, auxiliary, mut film) = object(surface, 0.02, seed);
            drawn += squared_error(&film, surface, |_, _| true);
            let errors = Denoiser::new(&auxiliary).denoise(&mut film, &jobs, &VIEWING);
            left += squared_error(&film, surface, |_, _| true);
            stated += errors.iter().flatten().map(|e| e.left.sum).sum::<f64>();
            stated_drawn += errors.iter().flatten().map(|e| e.drawn).sum::<f64>();
            assert!(errors.iter().all(Option::is_some));
        }
        // Each is a sum of 16,384 squares, with a standard deviation of sqrt(2 / 16384), 1.1%: four times that of their ratio.
        assert!((stated_drawn / drawn - 1.0).abs() < 0.063);
        assert!(left < most * drawn, "{left} of {drawn}");
        eprintln!("{} stated {}", left / drawn, stated / left);
        // The noise of 16 frames of 1,024 pixels, of which some 10 are averaged: 4% of the sum.
        let ratio = stated / left;
        assert!((0.88..most_stated).contains(&ratio), "{ratio}");
    }
}

#[test]
fn what_base_colours_tell_apart_stays_apart_whatever_the_noise() {
    // Noise of half the contrast, which no comparison of radiances sees through.
    let tiles: Surface = |x, _| match x / 8 % 2 {
        0 => (0.2, 0.2, 1.0),
        _ => (0.3, 0.8, 1.0),
    };
    let alike: Surface = |x, _| (0.2 + 0.1 * (x / 8 % 2) as f32, 0.5, 1.0);
    let at_border = |x: u32, _: u32| matches!(x % 8, 0 | 7);
    let [told, untold] = [tiles, alike].map(|surface| {
        let mut left = 0.0;
        for seed in 0..16 {
            let (jobs, auxiliary, mut film) = object(surface, 0.05, seed);
            Denoiser::new(&auxiliary).denoise(&mut film, &jobs, &VIEWING);
            left += squared_error(&film, surface, at_border);
        }
        left
    });
    assert!(told < 0.5 * untold, "{told}, {untold}");
}

#[test]
fn glints_and_edges_stay() {
    let surface: Surface = |x, y| match (x, y) {
        (13, 17) => (5.0, 0.5, 1.0),
        (0..4, _) => (0.1, 0.5, 0.5),
        _ => (0.2, 0.5, 1.0),
    };
    let (jobs, auxiliary, mut film) = object(surface, 0.02, 1);
    let drawn = film.clone();
    Denoiser::new(&auxiliary).denoise(&mut film, &jobs, &VIEWING);
    // What is around it looks like what is around others. The halves measure what averaging it costs: it is not filtered.
    let glint = film.object.get(13, 17).x;
    assert!((glint - drawn.object.get(13, 17).x).abs() < 1e-5, "{glint}");
    for (x, y) in [(12, 17), (14, 17), (13, 16), (13, 18), (11, 15)] {
        // Not brighter than noise of three standard deviations makes it: 0.02 / sqrt(2) each.
        assert!(film.object.get(x, y).x < 0.2 + 3.0 * 0.0142);
    }
    for x in 0..4 {
        assert_eq!(film.object.get(x, 9), drawn.object.get(x, 9));
        assert_eq!(film.object_variance(x, 9), drawn.object_variance(x, 9));
    }
    assert_eq!(film.alpha, drawn.alpha);
}

#[test]
fn nothing_happens_before_every_job_has_samples() {
    let even: Surface = |_, _| (0.2, 0.5, 1.0);
    let (mut jobs, auxiliary, mut film) = object(even, 0.02, 1);
    jobs[3].samples = 0;
    let drawn = film.clone();
    let errors = Denoiser::new(&auxiliary).denoise(&mut film, &jobs, &VIEWING);
    assert!(errors.iter().all(Option::is_none));
    assert_eq!(film.object, drawn.object);
}

#[test]
fn a_radiance_whose_square_overflows_stays() {
    let surface: Surface = |x, y| match (x, y) {
        (13, 17) => (1e30, 0.5, 1.0),
        _ => (0.2, 0.5, 1.0),
    };
    let (jobs, auxiliary, mut film) = object(surface, 0.02, 1);
    let drawn = film.clone();
    let errors = Denoiser::new(&auxiliary).denoise(&mut film, &jobs, &VIEWING);
    assert_eq!(film.object.get(13, 17), drawn.object.get(13, 17));
    assert!(film.object.pixels().iter().all(|v| v.is_finite()));
    assert!(errors.iter().flatten().all(|e| e.left.sum.is_finite()));
}

#[test]
fn filtering_what_has_grown_gives_what_filtering_all_does() {
    // A glint keeps tiles from being filtered, until its samples turn out to be wrong; tiles that it does not reach itself, too,
    // by way of those between.
    let glint: Surface = |x, y| match (x, y) {
        (7, 7) => (5.0, 0.5, 1.0),
        _ => (0.2, 0.5, 1.0),
    };
    let even: Surface = |_, _| (0.2, 0.5, 1.0);
    let (columns, mut turned) = (SIDE as usize / BLOCK, 0);
    let is_far = |index: usize| index % columns > AFFECTED || index / columns > AFFECTED;
    for seed in 0..4 {
        let (mut jobs, auxiliary, mut film) = object(glint, 0.02, seed);
        let mut denoiser = Denoiser::new(&auxiliary);
        let mut errors = denoiser.denoise(&mut film, &jobs, &VIEWING);
        for noise in [0.02, 0.03, 0.01] {
            let before: Vec<u32> = jobs.iter().map(|job| job.samples).collect();
            let (more, ..) = object(even, noise, seed + 100);
            jobs[0] = more[0].clone();
            jobs[0].samples = before[0] + 1;
            film.develop_more(&jobs, &before);
            let errors_before =
                std::mem::replace(&mut errors, denoiser.denoise(&mut film, &jobs, &VIEWING));
            let mut anew = Film::new(SIDE as usize, SIDE as usize);
            anew.develop(&jobs);
            let expected = Denoiser::new(&auxiliary).denoise(&mut anew, &jobs, &VIEWING);
            assert_eq!(film.object, anew.object);
            let pixels = (0..SIDE as usize).flat_map(|y| (0..SIDE as usize).map(move |x| (x, y)));
            for (x, y) in pixels {
                let [a, b] = [&film, &anew].map(|film| film.object_variance(x, y));
                // Errors are weighed by slopes over a step of 2e-4, of values of 0.2 or near it that are filtered already or
                // are not, rounded to 2^-26: 1.5e-4 of a squared slope.
                assert!(
                    (a / b - 1.0).abs().max_element() < 1e-3,
                    "{a} and {b} at {x}, {y}"
                );
            }
            for (index, (error, expected)) in errors.iter().zip(expected).enumerate() {
                assert_eq!(error.is_some(), expected.is_some());
                if let (Some(a), Some(b)) = (error, expected) {
                    assert!((a.left.sum / b.left.sum - 1.0).abs() < 1e-3);
                }
                let turns = error.is_some() && errors_before[index].is_none();
                turned += u32::from(is_far(index) && turns);
            }
        }
    }
    assert!(turned > 0, "none was filtered that was not before");
}
